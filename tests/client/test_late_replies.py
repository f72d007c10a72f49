"""One hiccup of a unit that is prompt otherwise, over real sockets and ports: no call gets what another asked.

The unit answers in 30 ms, takes 1.2 s once, longer than the timeout of 1 s, and then answers both frames that it got.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncIterator, Iterator

import pytest
from late_unit import LateUnit

import busway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import simple_plan
from busway.testing.line import PacedLine

pytestmark = pytest.mark.real_time

SCHEMES = ["rtu+tcp", "ascii+tcp", "rtu+udp", "rtu"]
RECOVERY = 10.0
"""Seconds at most until calls succeed again."""
ADDRESSES = [10 * number for number in range(12)]


@contextlib.contextmanager
def late_unit(scheme: str, hiccups: tuple[int, ...] = (3,)) -> Iterator[LateUnit]:
    if "+" in scheme:
        with LateUnit(scheme, hiccups=hiccups) as unit:
            yield unit
        return
    with (
        PacedLine(ports=2, baud=115_200) as line,
        LateUnit(scheme, path=line.paths[1], hiccups=hiccups) as unit,
    ):
        unit.url = f"rtu://{line.paths[0]}?baud=115200"
        yield unit


@contextlib.asynccontextmanager
async def late_unit_meanwhile(scheme: str, hiccups: tuple[int, ...] = (3,)) -> AsyncIterator[LateUnit]:
    with late_unit(scheme, hiccups) as unit:
        yield unit


@pytest.mark.parametrize("retries", [0, 1])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_blocking_reads_after_one_hiccup_are_each_their_own(scheme: str, retries: int) -> None:
    with late_unit(scheme) as unit, busway.connect(unit.url, retries=retries) as link:
        found = []
        for address in ADDRESSES:
            with contextlib.suppress(busway.NoReply):
                found.append((address, link.unit(1).read_holding_registers(address, count=2)[0]))
        assert found == [(address, address) for address, _ in found]
        until = time.monotonic() + RECOVERY
        in_row = 0
        while in_row < 5:
            assert time.monotonic() < until
            try:
                assert link.unit(1).read_holding_registers(500 + in_row, count=2)[0] == 500 + in_row
                in_row += 1
            except busway.NoReply:
                in_row = 0
                time.sleep(0.05)


@pytest.mark.parametrize("retries", [0, 1])
@pytest.mark.parametrize("scheme", SCHEMES)
async def test_asynchronous_reads_after_one_hiccup_are_each_their_own(scheme: str, retries: int) -> None:
    async with late_unit_meanwhile(scheme) as unit, busway.open(unit.url, retries=retries) as link:
        outcomes = await asyncio.gather(
            *(link.unit(1).read_holding_registers(address, count=2) for address in ADDRESSES), return_exceptions=True
        )
        wrong = [
            (address, found)
            for address, found in zip(ADDRESSES, outcomes, strict=True)
            if not isinstance(found, busway.NoReply) and (isinstance(found, BaseException) or found[0] != address)
        ]
        assert wrong == []
        until = time.monotonic() + RECOVERY
        in_row = 0
        while in_row < 5:
            assert time.monotonic() < until
            try:
                assert (await link.unit(1).read_holding_registers(500 + in_row, count=2))[0] == 500 + in_row
                in_row += 1
            except busway.NoReply:
                in_row = 0
                await asyncio.sleep(0.05)


@pytest.mark.parametrize("scheme", ["rtu+tcp", "rtu"])
def test_value_of_before_a_write_is_not_read_after_it(scheme: str) -> None:
    with late_unit(scheme, hiccups=(2,)) as unit, busway.connect(unit.url, retries=0) as link:
        assert link.unit(1).read_holding_registers(0, count=1) == [0]
        with pytest.raises(busway.NoReply):
            link.unit(1).read_holding_registers(0, count=1)
        written = read = False
        until = time.monotonic() + RECOVERY
        while not read and time.monotonic() < until:
            with contextlib.suppress(busway.NoReply, busway.WriteOutcomeUnknown):
                if not written:
                    link.unit(1).write_single_register(0, 7)
                    written = True
                assert link.unit(1).read_holding_registers(0, count=1) == [7]
                read = True
        assert read


@pytest.mark.parametrize("scheme", ["rtu+tcp", "rtu+udp", "rtu"])
def test_write_is_confirmed_by_its_own_reply_only(scheme: str) -> None:
    """All replies to 16 of one range are equal. The unit is gone when the last write is confirmed by the one before."""
    with late_unit(scheme, hiccups=(2,)) as unit, busway.connect(unit.url) as link:
        link.unit(1).write_multiple_registers(0, [50, 50])
        for value in (100, 200, 300):
            heard = sum(pdu[0] == 16 for pdu in unit.heard)
            begun = time.monotonic()
            try:
                link.unit(1).write_multiple_registers(0, [value, value])
            except (busway.NoReply, busway.WriteOutcomeUnknown):
                assert sum(pdu[0] == 16 for pdu in unit.heard) <= heard + 1
                continue
            assert unit.registers[0] == value
            assert time.monotonic() - begun >= 0.03, "before the unit had answered it"


@pytest.mark.parametrize("over_a_port", [False, True])
async def test_client_of_a_gateway_never_gets_registers_that_it_is_denied(over_a_port: bool) -> None:
    scheme = "rtu" if over_a_port else "rtu+tcp"
    policy = busway.Policy.of(
        busway.Rule.of(name="own only", action="deny", peers=["127.0.0.2"], table="holding", addresses="0-99"),
        default="allow",
    )
    async with late_unit_meanwhile(scheme, hiccups=(5, 25)) as unit:
        plan = simple_plan(["tcp://127.0.0.1:0"], unit.url)
        async with (
            Gateway(plan, policy=policy) as gateway,
            busway.open(gateway.endpoints[0], timeout=6.0) as permitted,
            busway.open(gateway.endpoints[0], timeout=6.0, local_address="127.0.0.2", shared=False) as denied,
        ):
            with pytest.raises(busway.ExceptionReply):
                await denied.unit(1).read_holding_registers(0, count=2)

            async def read(link: busway.AsyncLink, first: int) -> list[tuple[int, int]]:
                found = []
                for number in range(15):
                    address = first + 2 * number
                    with contextlib.suppress(busway.NoReply, busway.ExceptionReply):
                        found.append((address, (await link.unit(1).read_holding_registers(address, count=2))[0]))
                return found

            async with asyncio.timeout(40):
                of_permitted, of_denied = await asyncio.gather(read(permitted, 0), read(denied, 100))
        assert [found for _, found in of_denied if found < 100] == []
        for found in (of_permitted, of_denied):
            assert [(address, value) for address, value in found if value != address] == []
            assert len(found) > 5


async def test_late_reply_shows_in_status_and_trace_and_in_the_next_error_of_its_unit(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with LateUnit("rtu+tcp", hiccups=(2, 4)) as slow:
        async with busway.open(slow.url, timeout=0.5, retries=0, shared=False) as link:
            unit = link.unit(1)
            await unit.read_holding_registers(0, count=2)
            busway.TRACE.set(busway.TraceLevel.MESSAGE)
            try:
                with caplog.at_level(logging.DEBUG, "busway.trace"), pytest.raises(busway.NoReply):
                    await unit.read_holding_registers(1, count=2)
                (status,) = [one for one in busway.local_connections() if one.endpoint == slow.url.split("?")[0]]
                assert status.in_doubt == (1,)
                with caplog.at_level(logging.DEBUG, "busway.trace"):
                    await unit.read_holding_registers(2, count=2)
            finally:
                busway.TRACE.set(busway.TraceLevel.OFF)
            (status,) = [one for one in busway.local_connections() if one.endpoint == slow.url.split("?")[0]]
            assert (status.late_replies, status.in_doubt) == (1, ())
            assert any("a reply that was owed came after 1." in line for line in caplog.messages)
            assert link.counters.late_replies == 1
