"""How long a line tries, and for whom it no longer does."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from handlers import ScriptedHandler
from scripted_peer import ScriptedPeer, first_address
from waiting import until

import busway
from busway.framing.mbap import MbapFrame
from busway.gateway.gateway import Front, Gateway, GatewayPlan, LineSettings
from busway.gateway.routes import Route, RoutingTable
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"

pytestmark = pytest.mark.clause("T32")


@contextlib.asynccontextmanager
async def gateway(
    line: str, *, deadlines: tuple[float | None, ...] = (None,), route: Route | None = None, **options: Any
) -> AsyncIterator[Gateway]:
    """A gateway with one front for each deadline."""
    plan = GatewayPlan(
        tuple(Front(f"front {n}", Listener(ANY_PORT), deadline=one) for n, one in enumerate(deadlines)),
        (LineSettings.of("line", line, **options),),
        RoutingTable((route or Route(line="line", units=frozenset(range(1, 248))),)),
    )
    async with Gateway(plan) as made:
        yield made


def client(made: Gateway, front: int = 0, **options: Any) -> busway.AsyncLink:
    return busway.open(made.endpoints[front], shared=False, **{"timeout": 5.0, "retries": 0, **options})


async def code_of(asked: Any) -> int:
    with pytest.raises(busway.ExceptionReply) as error:
        await asked
    return error.value.code


class Slow:
    """Answers only when it is told to."""

    def __init__(self) -> None:
        self.allowed = asyncio.Semaphore(0)
        self.asked: list[bytes] = []

    def decide(self, context: busway.RequestContext, request: Any) -> Any:
        self.asked.append(request.encode())
        return self._answer(request)

    async def _answer(self, request: Any) -> busway.Message:
        await self.allowed.acquire()
        if isinstance(request, busway.WriteSingleRegister):
            return request
        return request.Reply(b"\0\7" * request.count)  # type: ignore[no-any-return]


async def test_what_waited_beyond_its_clients_deadline_is_never_sent_and_0a() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, handler=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, None), timeout=5) as made,
        client(made, 1) as patient,
        client(made, 0, max_transactions=4) as hurried,
    ):
        first = asyncio.create_task(patient.unit(1).read_holding_registers(0, count=1))
        await until(lambda: slow.asked)
        reads = [code_of(hurried.unit(1).read_holding_registers(n, count=1)) for n in (1, 2)]
        assert await asyncio.gather(*reads) == [0x0A, 0x0A]
        assert await code_of(hurried.unit(1).write_single_register(3, 3)) == 0x0A  # surely not executed
        slow.allowed.release()
        assert await first == [7]
        assert len(slow.asked) == 1
        assert made.status().lines[0].links[0].queued == made.open_requests == 0


async def test_the_request_on_the_wire_at_the_deadline_is_0b() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, handler=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1,), timeout=5) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert len(slow.asked) == 1


async def test_a_broadcast_has_the_deadline_of_its_client_too() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, handler=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, None), timeout=5, broadcast=True) as made,
        client(made, 1) as patient,
        client(made, 0) as hurried,
    ):
        first = asyncio.create_task(patient.unit(1).read_holding_registers(0, count=1))
        await until(lambda: slow.asked)
        assert await code_of(hurried.unit(0).write_single_register(3, 3)) == 0x0A
        slow.allowed.release()
        assert await first == [7]
        assert len(slow.asked) == 1


@pytest.mark.parametrize("later", [None, 2.0])
async def test_who_shares_a_read_has_his_own_deadline_and_not_that_of_the_one_before(later: float | None) -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, handler=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, later), timeout=5) as made,
        client(made, 1, max_transactions=2) as patient,
        client(made, 0) as hurried,
    ):
        blocking = asyncio.create_task(patient.unit(1).read_holding_registers(0, count=1))
        await until(lambda: slow.asked)
        first = asyncio.create_task(hurried.unit(1).read_holding_registers(1, count=1))
        await until(lambda: made.open_requests == 2)
        second = asyncio.create_task(patient.unit(1).read_holding_registers(1, count=1))
        counters = made.status().lines[0].counters
        await until(lambda: counters.shared == 1)
        await asyncio.sleep(0.15)  # the deadline of the first is over
        slow.allowed.release()
        slow.allowed.release()
        assert await asyncio.gather(blocking, first, second) == [[7], [7], [7]]
        assert len(slow.asked) == 2


async def test_a_read_is_repeated_as_often_as_the_line_says_and_a_write_never() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: None) as peer,
        gateway(peer.endpoint, timeout=0.05, retries=2) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert [frame.pdu for frame in peer.frames] == [bytes.fromhex("03 0000 0001")] * 3
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(1).write_single_register(0, 1)
        assert len(peer.frames) == 4


async def test_a_repeated_read_that_is_answered_brings_its_data_and_a_client_sees_no_more() -> None:
    def every_third(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        return None if len(peer.frames) % 3 else first_address(peer, frame)

    async with (
        ScriptedPeer(every_third) as peer,
        gateway(peer.endpoint, timeout=0.05, retries=2) as made,
        client(made) as link,
    ):
        for n in range(3):
            assert await link.unit(1).read_holding_registers(n, count=1) == [n]
        assert made.status().lines[0].links[0].counters.retries == 6
        assert made.status().lines[0].counters.no_answer == 0


async def test_a_retry_is_not_begun_for_a_client_whose_deadline_is_over() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: None) as peer,
        gateway(peer.endpoint, deadlines=(0.12,), timeout=0.1, retries=5) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert len(peer.frames) <= 2


async def test_a_route_has_its_own_timeout() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: None) as peer,
        gateway(peer.endpoint, route=Route(line="line", timeout=0.05), timeout=60, retries=0) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
