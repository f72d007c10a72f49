"""What one entry of a zone's table remembers of keys: results while they fit, keys for long, never more than fits."""

import json

import pytest

from busway.apps.collector.commands.claims import KeysUnavailable
from busway.apps.collector.commands.command import (
    LONGEST_VALUE,
    CommandResult,
    CommandState,
    CommandValue,
    OldValue,
    PointCommand,
)
from busway.apps.fleet.coordinator import LONGEST_VALUE as LONGEST_ENTRY
from busway.apps.fleet.key_memory import MOST_KEYS, REMEMBERED, KeyMemory, decode_memory
from busway.errors import Overloaded
from busway.options.sinks import LONGEST_SECONDS


def opened(key: str, value: CommandValue = 7) -> CommandResult:
    command = PointCommand(key, "boiler", "setpoint", value, "anna", "api", 1030.0)
    return CommandResult(command, CommandState.OPEN, 1000.0, OldValue(6, "good", 999.0))


def test_a_key_is_found_with_its_result_after_it_went_through_the_table() -> None:
    memory = KeyMemory()
    assert memory.found(opened("k1")) is None
    memory.add(opened("k1"), "west/1", 1000.0)
    memory = decode_memory(memory.encode())
    found = memory.found(opened("k1"))
    assert found is not None
    assert (found.state, found.reason.partition(",")[0]) == (CommandState.UNKNOWN, "west has begun it")
    done = opened("k1").finished(CommandState.DONE, read_back=7)
    assert memory.end(done)
    assert decode_memory(memory.encode()).found(opened("k1")) == done
    assert not memory.end(opened("k2"))
    assert memory.found(opened("k2")) is None


def test_a_memory_includes_an_older_one_and_keeps_the_final_results_of_both() -> None:
    older, newer = KeyMemory(), KeyMemory()
    for key in ("k1", "k2"):
        older.add(opened(key), "west/1", 1000.0)
        newer.add(opened(key), "west/1", 1000.0)
    older.add(opened("k0"), "west/1", 999.0)
    done = [opened(key).finished(CommandState.DONE) for key in ("k1", "k2")]
    older.end(done[0])
    newer.end(done[1])
    newer.add(opened("k3"), "east/1", 1001.0)
    newer.include(older)
    assert [newer.found(opened(key)) for key in ("k1", "k2")] == done
    assert list(newer.results) == ["k1", "k2", "k0", "k3"]
    assert len(newer.used) == 4


def test_only_who_took_a_key_finds_it_open() -> None:
    memory = KeyMemory()
    memory.add(opened("k1"), "west/1", 1000.0)
    assert memory.is_open("k1", "west/1")
    assert not memory.is_open("k1", "west/2")
    assert not memory.is_open("k2", "west/1")
    memory.end(opened("k1").finished(CommandState.DONE))
    assert not memory.is_open("k1", "west/1")


def test_a_key_whose_result_had_to_go_is_refused_and_the_entry_always_fits() -> None:
    memory = KeyMemory()
    for number in range(MOST_KEYS):
        memory.add(opened(f"k{number}"), "west/1", 1000.0)
    for number in range(20):
        longest = opened(f"long{number}", "\u20ac" * (LONGEST_VALUE - 1)).finished(CommandState.DONE, "x" * 3000)
        memory.used.pop(next(iter(memory.used)))
        memory.add(longest, "west/1", 1000.0)
    encoded = memory.encode()
    assert len(encoded) < LONGEST_ENTRY / 2
    memory = decode_memory(encoded)
    assert len(memory.used) == MOST_KEYS
    assert list(memory.results)[-1] == "long19"
    found = memory.found(opened("k100"))
    assert found is not None
    assert (found.state, found.reason) == (
        CommandState.REFUSED,
        "this key was used before, long ago; nothing was sent now",
    )


def test_keys_are_forgotten_when_there_is_no_room_and_they_are_old_the_oldest_first_and_never_before() -> None:
    memory = KeyMemory()
    for number in range(MOST_KEYS):
        memory.add(opened(f"k{number}"), "west/1", 1000.0 + number)
    memory = decode_memory(memory.encode())
    with pytest.raises(Overloaded, match="remembers keys for 90 days"):
        memory.add(opened("new"), "west/1", 1000.0 + REMEMBERED)
    memory.add(opened("new"), "west/1", 1000.0 + REMEMBERED + 10.5)
    assert len(memory.used) == MOST_KEYS - 10
    assert memory.found(opened("k10")) is None
    assert memory.found(opened("k11")) is not None
    assert memory.found(opened("new")) is not None
    assert REMEMBERED > LONGEST_SECONDS, "a command that says until when it may be sent is too late before"


def test_keys_that_a_collector_makes_are_their_results_alone() -> None:
    memory = KeyMemory()
    memory.add(opened("busway-0000000001000-ab"), "west/1", 1000.0)
    assert not memory.used
    assert memory.found(opened("busway-0000000001000-ab")) is not None


@pytest.mark.parametrize(
    "value",
    [
        b"{",
        b"[]",
        b'{"keys":"","results":[["west"]]}',
        b'{"keys":"AAAA","results":[]}',
        b'{"keys":"!","results":[]}',
        b'{"results":[]}',
        json.dumps({"keys": "", "results": [["w", "", "d", "p", 1, "b", "o", 1, "done", 1, None, None, ""]]}).encode(),
        json.dumps({"keys": "", "results": [["w", "k", "d", "p", 1, "b", "o", 1, "new", 1, None, None, ""]]}).encode(),
    ],
)
def test_what_cannot_be_read_is_an_error_and_never_an_empty_memory(value: bytes) -> None:
    with pytest.raises(KeysUnavailable):
        decode_memory(value)
