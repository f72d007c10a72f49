"""``busway counters`` against our own server, and peers that offer less."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from busway.cli.counters import COUNTERS, event_text

Run = Callable[..., Any]


def framed(answer: Callable[[bytes], bytes]) -> Callable[[bytes], bytes]:
    """The answer to a PDU as the answer to an ADU; none where it is empty."""

    def reply(adu: bytes) -> bytes:
        pdu = answer(adu[7:])
        return adu[:4] + (len(pdu) + 1).to_bytes(2, "big") + adu[6:7] + pdu if pdu else b""

    return reply


def refusing(code: int) -> Callable[[bytes], bytes]:
    """A device that answers everything with an exception."""
    return framed(lambda pdu: bytes((pdu[0] | 0x80, code)))


def test_every_counter_is_read_and_named(run: Run, url: str) -> None:
    result = run("counters", url, "--unit", "1")
    assert result.code == 0
    assert not result.err
    lines = [line.split() for line in result.out.splitlines()]
    functions = [line[0] for line in lines if line]
    assert functions[: len(COUNTERS)] == [f"08/{code:02X}" for code, _ in COUNTERS]
    assert {"11", "12", "07"} <= set(functions)
    assert "server message count" in result.out
    assert "0b00000000" in result.out


def test_json_has_numbers_and_explains_the_events(run: Run, url: str) -> None:
    run("read", url, "4x1", "--unit", "1")
    result = run("counters", url, "--unit", "1", "--json")
    facts = {fact["name"]: fact for fact in map(json.loads, result.out.splitlines())}
    assert facts["server_message_count"]["value"] >= 1
    assert facts["server_message_count"]["function"] == "08/0E"
    events = facts["events"]
    assert len(events["events"]) == len(events["value"])
    assert "received" in events["events"]


def test_asking_changes_nothing_but_the_count_of_what_was_asked(run: Run, url: str) -> None:
    def messages() -> int:
        lines = run("counters", url, "--unit", "1", "--json").out.splitlines()
        return next(fact["value"] for fact in map(json.loads, lines) if fact["name"] == "bus_message_count")

    before = messages()
    assert messages() == before + len(COUNTERS) + 3


def test_what_is_not_offered_is_said_and_the_rest_is_shown(run: Run, peer: Callable[..., str]) -> None:
    def answer(pdu: bytes) -> bytes:
        return b"\x07\x6d" if pdu == b"\x07" else bytes((pdu[0] | 0x80, 1))

    result = run("counters", peer(framed(answer)))
    assert result.code == 0
    assert result.out.split()[:4] == ["07", "exception", "status", "0b01101101"]
    assert "08/0B (bus message count) is not offered: exception 01" in result.err
    assert len(result.err.splitlines()) == len(COUNTERS) + 2


def test_a_device_that_offers_nothing_is_refused(run: Run, peer: Callable[..., str]) -> None:
    result = run("counters", peer(refusing(1)))
    assert result.code == 4
    assert not result.out


def test_a_gateway_without_the_device_ends_the_command(run: Run, peer: Callable[..., str]) -> None:
    result = run("counters", peer(refusing(0x0B)))
    assert result.code == 4
    assert len(result.err.splitlines()) == 1


def test_a_device_that_does_not_answer_is_asked_once(run: Run, peer: Callable[..., str]) -> None:
    asked: list[bytes] = []

    def answer(pdu: bytes) -> bytes:
        asked.append(pdu)
        return b""

    result = run("counters", peer(framed(answer)), "--timeout", "50ms", "--retries", "0")
    assert result.code == 3
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("event", "text"),
    [
        (0x00, "communication restarted"),
        (0x04, "listen-only mode entered"),
        (0x80, "received"),
        (0xC2, "received: communication error, broadcast"),
        (0x40, "sent"),
        (0x61, "sent: exception 1…3, in listen-only mode"),
        (0x01, "an event outside the specification"),
    ],
)
def test_events_in_words(event: int, text: str) -> None:
    assert event_text(event) == text
