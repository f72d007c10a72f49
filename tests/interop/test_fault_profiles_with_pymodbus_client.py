"""What a user of pymodbus sees of servers that misbehave: recorded as it is, neither praised nor blamed.

pymodbus 3.16.1, its blocking client with ``retries=0``. What our own client makes of the same servers is in
``tests/simulator/faults/test_seen_by_a_client.py``; where the two differ, a comment says how.

1. Fault profiles of serial lines are left out: they are about lines, and are played on a paced one.
"""

import threading
from collections.abc import Iterator
from typing import Any

import foreign
import pytest
from played_devices import played

from busway.faults.switchboard import FaultSwitchboard
from busway.testing import FAULT_PROFILES, Carrier

TIMEOUT_MS = 700

NOTHING = "ModbusIOException: Modbus Error: [Input/Output] No response received after 0 retries"
CLOSED = "ConnectionException: Modbus Error: [Connection] ModbusTcpClient"
UNREADABLE = "ModbusIOException: Modbus Error: [Input/Output] Unable to decode request"
GOOD = [3, 4]
DONE = "done"

READ, READ_2, READ_TEN = "read 1 3 2", "read 2 3 2", "read 1 10 10"
WRITE_ONE, WRITE_TWO = "write 1 5 7", "write 1 6 7 8"
WAIT = "wait until the server has closed the connection"

Seen = list[int] | int | str
"""Values, an exception code, ``done``, or how an error in words begins."""

SEEN: dict[str, tuple[dict[str, Any], list[tuple[str, Seen]]]] = {
    # Timeouts alike; that the device is slow, and by how much, is not said.
    "late": ({"delay": 1.5}, [(READ, NOTHING)]),
    "queue-lag": ({}, [(READ, NOTHING), (READ_TEN, NOTHING)]),
    "foreign-transaction": ({}, [(READ, GOOD), (WRITE_ONE, DONE)]),
    "transaction+1": ({}, [(READ, NOTHING)]),
    # 0 is taken for a broken reply at once. Ours waits for a right one.
    "transaction=0": (
        {},
        [
            (
                READ,
                "ModbusIOException: Modbus Error: [Input/Output] ERROR: request uses transaction id=1 but received 0.",
            )
        ],
    ),
    "transaction=random": ({}, [(READ, NOTHING)]),
    # Dropped without a word. Ours says which unit has answered.
    "unit=255": ({}, [(READ, NOTHING)]),
    "unit=0": ({}, [(READ, NOTHING)]),
    "unit=1": ({}, [(READ, GOOD), (READ_2, NOTHING)]),
    "mute-after-connect": ({"seconds": 30}, [(READ, NOTHING)]),
    # A close while idle fails the next request. Ours opens again in silence.
    "close-if-silent": ({"seconds": 0.3}, [(WAIT, DONE), (READ, CLOSED), (READ, GOOD)]),
    "idle-close": ({"seconds": 0.3}, [(READ, GOOD), (WAIT, DONE), (READ, CLOSED), (READ, GOOD)]),
    "single-client": ({}, [(READ, GOOD), (WRITE_ONE, DONE)]),
    "wedged": ({}, [(READ, NOTHING), (WRITE_ONE, NOTHING)]),
    "min-gap": ({"seconds": 30}, [(READ, GOOD), (READ, NOTHING)]),
    "unit-switch": ({}, [(READ, GOOD), (READ_2, NOTHING), (READ_2, GOOD)]),
    "max-block": ({"items": 5}, [(READ, GOOD), (READ_TEN, 3)]),
    "hole": ({"address": 3}, [(READ, 2), (READ_TEN, list(range(10, 20)))]),
    # Four registers where two were asked, as data. Ours: `BadReply`, or right data with `register_width`.
    "wide-register": ({}, [(READ, [0, 3, 0, 4])]),
    "short": ({}, [(READ, UNREADABLE)]),
    # The byte too many is not noticed. Ours: `BadReply`.
    "long": ({}, [(READ, GOOD), (WRITE_ONE, DONE)]),
    "dribble": ({}, [(READ, GOOD), (WRITE_ONE, DONE)]),
    "glue": ({}, [(READ, GOOD), (WRITE_ONE, DONE)]),
    "busy": ({}, [(READ, 6), (WRITE_ONE, 6)]),
    # A closed connection, which does not say that the write may have been executed. Ours: `WriteOutcomeUnknown`.
    "execute-then-drop": ({}, [(READ, GOOD), (WRITE_ONE, CLOSED), ("read 1 5 1", [7])]),
    # A reply that confirms another value than was written passes for success. Ours: `WriteOutcomeUnknown`.
    "wrong-echo": ({}, [(READ, GOOD), (WRITE_ONE, DONE), ("read 1 5 1", [7])]),
    "odd-exception": ({}, [(READ, 0x63)]),
    "fc6-only": ({}, [(WRITE_ONE, DONE), (WRITE_TWO, NOTHING)]),
    "fc16-only": ({}, [(WRITE_TWO, DONE), (WRITE_ONE, NOTHING)]),
}


@pytest.fixture(scope="module")
def user() -> Iterator[foreign.Program]:
    with foreign.python_peer("pymodbus_user.py", TIMEOUT_MS) as program:
        yield program


def _seen(answer: dict[str, Any]) -> Seen:
    if answer["ok"]:
        values: list[int] | str = answer.get("values", DONE)
        return values
    exception: int = answer["exception"]
    return exception or str(answer["error"])


def _wait_until_closed(switchboard: FaultSwitchboard) -> None:
    pause = threading.Event()
    for _ in range(1000):
        if switchboard.tap.accepted and not len(switchboard.tap):
            return
        pause.wait(0.01)
    raise AssertionError("the server did not close the connection")


@pytest.mark.parametrize("name", SEEN)
def test_what_a_user_of_pymodbus_sees(user: foreign.Program, name: str) -> None:
    parameters, actions = SEEN[name]
    switchboard = FaultSwitchboard()
    switchboard.add(name, parameters=parameters)
    with played(switchboard, "tcp://127.0.0.1:0") as endpoint:
        user.ask(f"open {endpoint.rpartition(':')[2]}")
        for command, expected in actions:
            if command == WAIT:
                _wait_until_closed(switchboard)
                continue
            seen = _seen(user.ask(command))
            if isinstance(expected, str) and expected != DONE:
                assert str(seen).startswith(expected), command
            else:
                assert seen == expected, command
        user.ask("close")


# Refused, it hears of it as an end of the connection, a reset or a silence, as the moments fall.
@pytest.mark.parametrize(("starve", "expected"), [(False, ""), (True, NOTHING)])
def test_a_second_user_of_pymodbus_is_refused_or_starved_by_who_takes_a_single_client(
    user: foreign.Program, starve: bool, expected: str
) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("single-client", parameters={"starve": starve})
    with (
        played(switchboard, "tcp://127.0.0.1:0") as endpoint,
        foreign.python_peer("pymodbus_user.py", TIMEOUT_MS) as second,
    ):
        for one in (user, second):
            one.ask(f"open {endpoint.rpartition(':')[2]}")
            first_read = _seen(one.ask(READ))
            if one is user:
                assert first_read == GOOD
            else:
                assert isinstance(first_read, str), first_read
                assert first_read.startswith(expected)
        assert _seen(user.ask(READ)) == GOOD
        user.ask("close")


def test_every_fault_profile_of_servers_is_shown() -> None:
    assert set(SEEN) == {name for name, one in FAULT_PROFILES.items() if one.carriers != {Carrier.SERIAL}}
