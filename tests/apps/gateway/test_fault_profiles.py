"""Devices that misbehave behind a gateway, on every kind of line, and what its client gets.

Each row of the table: the right values, or the exception that is true. Whatever happens, no client gets what belongs
to another request, the other unit of the line answers as ever, and when the device behaves again it is answered for
again, without a restart.
"""

import asyncio
import itertools
import struct
from dataclasses import dataclass, field, replace
from typing import Any, Final

import pytest
from faulty_line import FaultyLine, faulty_line, value
from waiting import until

import busway
from busway.apps.gateway.routes import Route
from busway.faults.fault import Carrier
from busway.faults.profiles import FAULT_PROFILES

TIMEOUT = 0.12
"""Seconds that the line waits for a reply that does not come."""
AMPLE = 5.0
RIGHT: Final = "right"
LINES = ("tcp", "rtu+tcp", "rtu")
_CARRIERS = {
    "tcp": {Carrier.TCP, Carrier.CONNECTION},
    "rtu+tcp": {Carrier.SERIAL, Carrier.CONNECTION},
    "rtu": {Carrier.SERIAL},
}
PATIENT: Final[dict[str, Any]] = {"timeout": AMPLE}

pytestmark = [pytest.mark.clause("T32"), pytest.mark.clause("T31")]


@dataclass(frozen=True)
class Row:
    """One fault profile, what the line was told of it, and what a client sees of unit 1."""

    name: str
    seen: str | int | tuple[str | int, ...]
    fault: dict[str, Any] = field(default_factory=dict)
    line: dict[str, Any] = field(default_factory=dict)
    only: tuple[str, ...] = LINES
    write: bool = False
    route: Route | None = None
    count: int = 2

    def __str__(self) -> str:
        told = ",".join(f"{key}={value}" for key, value in {**self.fault, **self.line}.items())
        return f"{self.name}({told}){'w' if self.write else ''}"


def timed(row: Row) -> Row:
    """A row of a device that lets the line wait: with a short timeout, and all that follows from it quick."""
    return replace(row, line={"timeout": TIMEOUT, "retries": 0, **row.line})


BROKEN = 0x0B
UNREACHED = 0x0A
ROWS = (
    timed(Row("late", BROKEN, {"delay": 0.2})),
    Row("late", RIGHT, {"delay": 0.05}, PATIENT),
    timed(Row("queue-lag", BROKEN)),  # each reply waits for a further request: no value in time, and no wrong one
    Row("foreign-transaction", RIGHT, line=PATIENT),
    timed(Row("foreign-transaction", BROKEN, {"instead": True})),
    *(timed(Row(name, BROKEN)) for name in ("transaction+1", "transaction=0", "transaction=random")),
    *(
        Row(name, RIGHT, line={"transaction_policy": "automatic", **PATIENT}, only=("tcp",))
        for name in ("transaction+1", "transaction=0", "transaction=random")
    ),
    *(timed(Row(name, BROKEN, only=("tcp",))) for name in ("unit=255", "unit=0")),
    *(
        Row(name, RIGHT, line={"unit_policy": "automatic", **PATIENT}, only=("tcp",))
        for name in ("unit=255", "unit=0", "unit=1")
    ),
    timed(Row("mute-after-connect", BROKEN, {"seconds": 60}, only=("tcp", "rtu+tcp"))),
    Row("mute-after-connect", RIGHT, {"seconds": 0.05}, {"connect_delay": 0.1, **PATIENT}),
    Row("close-if-silent", RIGHT, {"seconds": 0.05}, PATIENT),
    Row("single-client", RIGHT, {"starve": True}, PATIENT),
    Row("single-client", RIGHT, {"starve": False}, PATIENT),
    Row("idle-close", RIGHT, {"seconds": 0.02}, PATIENT),
    timed(Row("wedged", BROKEN)),
    timed(Row("wedged", BROKEN, write=True)),
    Row("min-gap", RIGHT, {"seconds": 0.03}, {"request_gap": 0.05, **PATIENT}),
    Row("unit-switch", RIGHT, line={"timeout": TIMEOUT, "retries": 1}),
    Row("max-block", 3, {"items": 5}, count=6),
    Row("max-block", RIGHT, {"items": 5}, count=17, route=Route(upstream="line", max_registers=5)),
    Row("hole", 2, {"address": 10}),
    Row("short", BROKEN, {"missing": 1}, {"timeout": TIMEOUT, "retries": 0}),
    Row("long", BROKEN, {"extra": 1}, {"timeout": TIMEOUT, "retries": 0}, only=("tcp",)),
    Row("long", BROKEN, {"extra": 300}, {"timeout": TIMEOUT, "retries": 0}, only=("tcp",)),
    Row("dribble", RIGHT, {"piece": 1, "pause": 0.0}, PATIENT),
    Row("glue", RIGHT, line=PATIENT),
    Row("busy", 6),
    Row("busy", 6, write=True),
    Row("execute-then-drop", BROKEN, write=True, only=("tcp", "rtu+tcp")),
    Row("wrong-echo", BROKEN, line={"timeout": TIMEOUT}, write=True),
    *(Row("odd-exception", code, {"code": code}) for code in (0x00, 0x05, 0x09, 0x0A, 0x0B, 0x0C, 0x63, 0xFF)),
    *(
        Row("odd-exception", BROKEN, {"code": 2, "size": size}, {"timeout": TIMEOUT, "retries": 0}, only=("tcp",))
        for size in (1, 3, 200)
    ),
    timed(Row("fc6-only", BROKEN, write=True)),
    Row("fc6-only", 1, {"refuses": True}, write=True),
    timed(Row("wide-register", BROKEN, {"size": 4})),
    Row("leading-zero", RIGHT, {"zeros": 3}, PATIENT),
    Row("noise", RIGHT, {"size": 3}, PATIENT),
    Row("noise", RIGHT, {"size": 200, "after": False}, PATIENT),
    Row("echo", RIGHT, line={"echo": "automatic", **PATIENT}, only=("rtu",)),
)
CASES = [
    (line, row)
    for line, row in itertools.product(LINES, ROWS)
    if line in row.only and FAULT_PROFILES[row.name].carriers & _CARRIERS[line]
]


async def outcome(asked: Any) -> str | int | list[int]:
    """The values, the code, or that nothing was said."""
    try:
        return await asked  # type: ignore[no-any-return]
    except busway.ExceptionReply as error:
        return error.code
    except busway.WriteOutcomeUnknown as error:  # what our own client makes of 0B to a write
        cause = error.__cause__
        assert isinstance(cause, busway.ExceptionReply)
        return cause.code


async def ask(link: busway.AsyncLink, row: Row, number: int, unit: int = 1) -> str | int:
    """Ask what the row asks; never the same twice, so that the answer to something else is known at once."""
    address = 10 if row.name == "hole" else 10 + 20 * number
    if row.write:
        found = await outcome(link.unit(unit).write_multiple_registers(address, [number, number]))
        return RIGHT if found is None else found  # type: ignore[return-value]
    count = row.count + number
    found = await outcome(link.unit(unit).read_holding_registers(address, count=count))
    if isinstance(found, list):
        assert found == [value(unit, address + n) for n in range(count)], "another's answer"
        return RIGHT
    return found


@pytest.mark.parametrize(("carrier", "row"), CASES, ids=[f"{line}-{row}" for line, row in CASES])
@pytest.mark.alone
async def test_the_client_sees_what_is_true_and_the_line_stays_in_step(carrier: str, row: Row) -> None:
    async with faulty_line(carrier, route=row.route, **row.line) as line:
        line.add(row.name, **row.fault)
        async with (
            busway.open(line.endpoint, timeout=AMPLE, retries=0) as link,
            busway.open(line.endpoint, timeout=AMPLE, retries=0, shared=False) as neighbour,
        ):
            for number in range(2):
                found, beside = await asyncio.gather(ask(link, row, number), ask(neighbour, row, 5 + number, unit=2))
                assert found == (row.seen)
                assert beside == RIGHT
            assert len(line.written[1]) == (2 if row.name in ("execute-then-drop", "wrong-echo") else 0)
            line.off()
            await healthy(line, link)


async def healthy(line: FaultyLine, link: busway.AsyncLink) -> None:
    """Both units answer, their own, and nothing is left behind."""
    for unit in (1, 2, 1):
        right = [value(unit, 200 + n) for n in range(3)]
        for _ in range(
            10
        ):  # a busy machine may be late for a short timeout, and the gateway has to find its line again
            found = await outcome(link.unit(unit).read_holding_registers(200, count=3))
            if found not in (BROKEN, UNREACHED):
                break
            await asyncio.sleep(0.1 if found == UNREACHED else 0.0)
        assert found == right
    await link.unit(2).write_single_register(300, 7)
    assert await link.unit(2).read_holding_registers(300, count=1) == [7]
    await until(lambda: not line.gateway.open_requests)
    assert line.gateway.status().upstreams[0].links[0].queued == 0


def test_every_fault_profile_of_a_server_is_in_the_table() -> None:
    assert set(FAULT_PROFILES) - {row.name for row in ROWS} == {"broadcast-reply", "fc16-only"}  # below


async def test_a_write_that_is_ignored_is_0b_and_the_one_that_is_taken_goes_through() -> None:
    async with (
        faulty_line("tcp", timeout=TIMEOUT) as line,
        busway.open(line.endpoint, timeout=AMPLE, retries=0) as link,
    ):
        line.add("fc16-only")
        assert await outcome(link.unit(1).write_single_register(5, 1)) == BROKEN
        await link.unit(1).write_multiple_registers(5, [1])
        assert line.written[1] == [[1]]  # and nothing was asked twice


@pytest.mark.parametrize("carrier", ["rtu+tcp", "rtu"])
@pytest.mark.alone
async def test_the_answer_to_a_broadcast_is_not_taken_for_that_of_the_next_unit(carrier: str) -> None:
    async with (
        faulty_line(carrier, turnaround_delay=0.1) as line,
        busway.open(line.endpoint, timeout=AMPLE, retries=0) as link,
    ):
        line.add("broadcast-reply", unit=None)
        for number in range(3):
            await link.unit(0).write_multiple_registers(5, [number, number])
            assert await link.unit(1).read_holding_registers(5, count=2) == [number, number]
        await link.unit(0).write_single_register(6, 9)
        await healthy(line, link)


async def test_wide_registers_go_through_in_their_width_where_the_line_is_told_of_it() -> None:
    route = Route(upstream="line", shift=5, max_registers=10, cache=60.0)
    async with (
        faulty_line("tcp", route=route, register_width=4, timeout=AMPLE) as line,
        busway.open(line.endpoint, timeout=AMPLE, retries=0, register_width=4) as link,
    ):
        line.add("wide-register", size=4)
        unit = link.unit(1)
        right = [value(1, 15 + n) for n in range(25)]
        assert await unit.read("4x11", "uint32", count=25) == right
        assert await unit.read("4x11", "uint32", count=25) == right  # from memory
        assert await unit.read("4x13", "uint32", count=3) == right[2:5]  # out of a larger block
        assert line.gateway.status().upstreams[0].counters.recalled == 2
        assert await outcome(link.unit(1).execute(busway.ReadHoldingRegisters(0, 63))) == 3  # too much


@pytest.mark.alone
async def test_a_device_that_was_slow_for_one_is_answered_in_time_for_the_next() -> None:
    async with (
        faulty_line("rtu", timeout=TIMEOUT, retries=1) as line,
        busway.open(line.endpoint, timeout=AMPLE, retries=0) as link,
    ):
        late = line.add("late", delay=1.4 * TIMEOUT)
        assert await outcome(link.unit(1).read_holding_registers(0, count=3)) in ([1000, 1001, 1002], BROKEN)
        late.off()
        await healthy(line, link)


async def test_a_single_client_device_serves_many_clients_over_one_connection() -> None:
    async with faulty_line("tcp", timeout=AMPLE) as line:
        line.add("single-client", unit=None)
        links = [busway.open(line.endpoint, shared=False, timeout=AMPLE) for _ in range(8)]
        found = await asyncio.gather(
            *(link.unit(1).read_holding_registers(10 * n, count=2) for n, link in enumerate(links))
        )
        assert found == [[value(1, 10 * n), value(1, 10 * n + 1)] for n in range(8)]
        assert line.server.status().counters.accepted == 1
        for link in links:
            await link.close()


def test_an_answer_of_the_device_is_told_as_it_is() -> None:
    """Not by a client of ours: the bytes."""

    async def bytes_of(asked: bytes) -> bytes:
        async with faulty_line("rtu+tcp") as line:
            line.add("busy")
            host, port = line.endpoint.removeprefix("tcp://").split(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(asked)
            head = await reader.readexactly(7)
            rest = await reader.readexactly(struct.unpack(">H", head[4:6])[0] - 1)
            writer.close()
            return head + rest

    found = asyncio.run(bytes_of(bytes.fromhex("1234 0000 0006 01 03 0000 0001")))
    assert found == bytes.fromhex("1234 0000 0003 01 83 06")
