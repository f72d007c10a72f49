"""What a user of our client sees of every fault profile, word for word, on Modbus TCP and on a serial line.

The server is the real one; the line has the pace of 115 200 baud.
"""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from played_devices import played

import busway
from busway.client.kept_serial_late_replies import KEPT
from busway.faults.switchboard import FaultSwitchboard
from busway.testing import FAULT_PROFILES, Carrier
from busway.testing.line import PacedLine

TIMEOUT = 0.12
"""Seconds that a test waits for a reply that does not come."""
AMPLE = 5.0
"""Seconds in which one comes that does, however busy the machine is."""
BAUD = 115_200

ACTIONS: dict[str, Callable[[busway.BlockingLink, float], object]] = {
    "read": lambda link, timeout: link.unit(1).read_holding_registers(3, count=2, timeout=timeout),
    "read unit 2": lambda link, timeout: link.unit(2).read_holding_registers(3, count=2, timeout=timeout),
    "read ten": lambda link, timeout: link.unit(1).read_holding_registers(10, count=10, timeout=timeout),
    "write one": lambda link, timeout: link.unit(1).write_single_register(5, 7, timeout=timeout),
    "write two": lambda link, timeout: link.unit(1).write_multiple_registers(5, [7, 8], timeout=timeout),
}

READ = "unit 1, function 3 (read holding registers), address 3: "
READ_2 = "unit 2, function 3 (read holding registers), address 3: "
READ_TEN = "unit 1, function 3 (read holding registers), address 10: "
WRITE = "unit 1, function 6 (write single register), address 5: "
WRITE_TWO = "unit 1, function 16 (write multiple registers), address 5: "
NOTHING = "no reply within 0.12 s (after … s)"
SENT = "the write was sent and may have been executed; no valid answer came (after … s{})"
GOOD = "[3, 4]"
DONE = "None"


def _refused(code: str) -> str:
    return f"ExceptionReply: {READ}the device answered with exception {code} (after … s, received …)"


BOTH: dict[str, tuple[dict[str, Any], list[tuple[str, str]]]] = {
    "wedged": ({}, [("read", f"NoReply: {READ}{NOTHING}"), ("write one", f"WriteOutcomeUnknown: {WRITE}{SENT}")]),
    "mute-after-connect": ({"seconds": 30}, [("read", f"NoReply: {READ}{NOTHING}")]),
    "min-gap": ({"seconds": 30}, [("read", GOOD), ("read unit 2", f"NoReply: {READ_2}{NOTHING}")]),
    "unit-switch": ({}, [("read", GOOD), ("read unit 2", f"NoReply: {READ_2}{NOTHING}"), ("read unit 2", GOOD)]),
    "max-block": (
        {"items": 5},
        [
            ("read", GOOD),
            (
                "read ten",
                f"ExceptionReply: {READ_TEN}the device answered with exception 03, illegal data value: a quantity or "
                "a length in the request is not allowed (the code is not about a value that is written, though some "
                "devices use it so) (after … s, received …)",
            ),
        ],
    ),
    "hole": (
        {"address": 3},
        [
            (
                "read",
                _refused("02, illegal data address: an item in the range does not exist or may not be written"),
            ),
            ("read ten", str(list(range(10, 20)))),
        ],
    ),
    "busy": ({}, [("read", _refused("06, server device busy: the application decides on sending again"))]),
    "odd-exception": ({}, [("read", _refused("63, an exception code outside the specification"))]),
    "fc6-only": ({}, [("write one", DONE), ("write two", f"WriteOutcomeUnknown: {WRITE_TWO}{SENT}")]),
    "fc16-only": ({}, [("write two", DONE), ("write one", f"WriteOutcomeUnknown: {WRITE}{SENT}")]),
    "wide-register": (
        {},
        [
            (
                "read",
                f"BadReply: {READ}the reply is broken: 10 bytes where 6 answer the request (after … s, received …)",
            )
        ],
    ),
    "short": (
        {},
        [
            (
                "read",
                f"BadReply: {READ}the reply is broken: byte count 4 where 3 bytes follow (after … s, received …)",
            )
        ],
    ),
    "long": (
        {},
        [
            (
                "read",
                f"BadReply: {READ}the reply is broken: byte count 4 where 5 bytes follow (after … s, received …)",
            )
        ],
    ),
    "wrong-echo": ({}, [("read", GOOD), ("write one", f"WriteOutcomeUnknown: {WRITE}{SENT}")]),
    "dribble": ({}, [("read", GOOD), ("write one", DONE)]),
    "glue": ({}, [("read", GOOD), ("write one", DONE)]),
}
"""Fault profile → its parameters, and what is done and seen, one after the other; met everywhere."""

SLOW = "; the unit is slow: its last late reply had taken … s, a longer timeout would take it (after … s)"
NOTHING_YET = "no reply within 0.12 s"

ON_TCP: dict[str, tuple[dict[str, Any], list[tuple[str, str]]]] = {
    "late": (
        {"delay": 0.18},
        [("read", f"NoReply: {READ}{NOTHING}"), ("read", f"NoReply: {READ}{NOTHING_YET}{SLOW}")],
    ),
    "queue-lag": ({}, [("read", f"NoReply: {READ}{NOTHING}"), ("read", f"NoReply: {READ}{NOTHING_YET}{SLOW}")]),
    "foreign-transaction": ({}, [("read", GOOD), ("write one", DONE)]),
    "transaction+1": ({}, [("read", f"NoReply: {READ}{NOTHING}")]),
    "transaction=0": ({}, [("read", f"NoReply: {READ}{NOTHING}")]),
    "transaction=random": ({}, [("read", f"NoReply: {READ}{NOTHING}")]),
    **{
        f"unit={number}": (
            {},
            [
                (
                    "read unit 2",
                    f"BadReply: {READ_2}the reply is broken: unit {number} answered where 2 was asked "
                    "(after … s, received …)",
                )
            ],
        )
        for number in (255, 0, 1)
    },
    "execute-then-drop": ({}, [("write one", f"WriteOutcomeUnknown: {WRITE}{SENT}"), ("read", GOOD)]),
    "close-if-silent": ({"seconds": 30}, [("read", GOOD)]),
    "idle-close": ({"seconds": 0.0}, [("read", f"LinkDown: {READ}")]),
    "single-client": ({}, [("read", GOOD), ("write one", DONE)]),
}

ON_A_LINE: dict[str, tuple[dict[str, Any], list[tuple[str, str]]]] = {
    # What the next request sees depends on when the late reply meets it: `test_serial_fault_profiles`, in virtual time.
    "late": ({"delay": 0.18}, [("read", f"NoReply: {READ}{NOTHING}")]),
    # The reply to the first read comes with the second one and is dropped; the reply to the second waits for a third.
    "queue-lag": ({}, [("read", f"NoReply: {READ}{NOTHING}"), ("read ten", f"NoReply: {READ_TEN}")]),
    # On a line, what another unit says is not the answer: silence is all that is left.
    **{f"unit={number}": ({}, [("read unit 2", f"NoReply: {READ_2}{NOTHING}")]) for number in (255, 0, 1)},
    "leading-zero": ({"zeros": 2}, [("read", GOOD), ("write one", DONE)]),
    "noise": ({}, [("read", GOOD), ("write one", DONE)]),
    "echo": ({}, [("read", GOOD), ("write one", DONE)]),
}


def _seen(link: busway.BlockingLink, action: str, timeout: float = AMPLE) -> str:
    """What a user sees: the result, or the class of the error and its sentence without what differs every time."""
    try:
        return repr(ACTIONS[action](link, timeout))
    except busway.ModbusError as error:
        sentence = str(error).removeprefix(f"{error.endpoint}, ")
        for what in (r"(?<=after )[\d.]+", r"(?<=had taken )[\d.]+", r"(?<=received )[0-9a-f ]+"):
            sentence = re.sub(what, "…", sentence)
        return f"{type(error).__name__}: {sentence}"


def _watch(link: busway.BlockingLink, actions: list[tuple[str, str]]) -> None:
    for action, expected in actions:
        is_awaited = expected.startswith(("NoReply", "WriteOutcomeUnknown"))
        seen = _seen(link, action, TIMEOUT if is_awaited else AMPLE)
        if "{}" in expected:  # bytes may have come, or none
            assert seen in (expected.format(""), expected.format(", received …"))
        elif expected.endswith(": "):
            assert seen.startswith(expected)
        else:
            assert seen == expected


@pytest.mark.parametrize("name", [name for name, one in FAULT_PROFILES.items() if one.carriers != {Carrier.SERIAL}])
def test_fault_profile_on_modbus_tcp(name: str) -> None:
    parameters, actions = {**BOTH, **ON_TCP}[name]
    switchboard = FaultSwitchboard()
    switchboard.add(name, parameters=parameters)
    with (
        played(switchboard, "tcp://127.0.0.1:0") as endpoint,
        busway.connect(endpoint, timeout=TIMEOUT, retries=0, shared=False) as link,
    ):
        _watch(link, actions)


@pytest.fixture(autouse=True)
def other_units_each_time() -> None:
    """The line is the same for all tests, and the units are not."""
    KEPT.clear()


@pytest.fixture(scope="module")
def line() -> Iterator[PacedLine]:
    with PacedLine(ports=2, baud=BAUD) as made:
        yield made


ON_LINES = [name for name, one in FAULT_PROFILES.items() if Carrier.SERIAL in one.carriers]


@pytest.mark.parametrize("name", [name for name in ON_LINES if name != "broadcast-reply"])
@pytest.mark.alone
@pytest.mark.real_time
def test_fault_profile_on_a_serial_line(line: PacedLine, name: str) -> None:
    parameters, actions = {**BOTH, **ON_A_LINE}[name]
    switchboard = FaultSwitchboard()
    switchboard.add(name, parameters=parameters)
    with (
        played(switchboard, f"rtu://{line.paths[1]}?baud={BAUD}"),
        busway.connect(
            f"rtu://{line.paths[0]}?baud={BAUD}&parity=even", timeout=TIMEOUT, retries=0, shared=False
        ) as link,
    ):
        _watch(link, actions)
    line.wait_quiet(0.02)


@pytest.mark.alone
@pytest.mark.real_time
def test_broadcast_reply_is_swallowed_within_the_turnaround(line: PacedLine) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("broadcast-reply", units={2})
    with (
        played(switchboard, f"rtu://{line.paths[1]}?baud={BAUD}"),
        busway.connect(
            f"rtu://{line.paths[0]}?baud={BAUD}&parity=even", timeout=TIMEOUT, retries=0, shared=False
        ) as link,
    ):
        link.unit(0).write_single_register(9, 77)
        assert [link.unit(number).read_holding_registers(9, count=1) for number in (1, 2)] == [[77], [77]]
    assert switchboard.status("broadcast-reply").struck == 1


@pytest.mark.alone
@pytest.mark.real_time
def test_broadcast_is_not_heard_by_a_unit_that_is_wedged(line: PacedLine) -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("wedged", units={2})
    with (
        played(switchboard, f"rtu://{line.paths[1]}?baud={BAUD}"),
        busway.connect(
            f"rtu://{line.paths[0]}?baud={BAUD}&parity=even", timeout=TIMEOUT, retries=0, shared=False
        ) as link,
    ):
        link.unit(0).write_single_register(9, 78)
        assert link.unit(1).read_holding_registers(9, count=1) == [78]
        switchboard.switch("wedged", on=False)
        assert link.unit(2).read_holding_registers(9, count=1) == [9]


def test_second_connection_is_closed_by_who_takes_a_single_client() -> None:
    switchboard = FaultSwitchboard()
    switchboard.add("single-client")
    with (
        played(switchboard, "tcp://127.0.0.1:0") as endpoint,
        busway.connect(endpoint, timeout=TIMEOUT, retries=0, shared=False) as first,
        busway.connect(endpoint, timeout=TIMEOUT, retries=0, shared=False) as second,
    ):
        assert _seen(first, "read") == GOOD
        assert _seen(second, "read").startswith(f"LinkDown: {READ}")
        assert _seen(first, "read") == GOOD
    assert switchboard.status("single-client").struck >= 1


def test_every_fault_profile_is_seen() -> None:
    told = {*BOTH, *ON_TCP, *ON_A_LINE, "broadcast-reply"}
    assert told == set(FAULT_PROFILES)
