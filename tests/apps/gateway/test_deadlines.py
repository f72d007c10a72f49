"""How long a line tries, and for whom it no longer does."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from handlers import ScriptedHandler
from scripted_peer import ScriptedPeer, first_address
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.configuration import simple_gateway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from busway.apps.gateway.route_checks import worst_case
from busway.apps.gateway.routes import Route, RoutingTable
from busway.framing.mbap import MbapFrame
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"

pytestmark = pytest.mark.clause("T32")


@contextlib.asynccontextmanager
async def gateway(
    line: str, *, deadlines: tuple[float | None, ...] = (None,), route: Route | None = None, **options: Any
) -> AsyncIterator[Gateway]:
    """A gateway with one listener for each deadline."""
    plan = GatewayPlan(
        tuple(GatewayListener(f"listener {n}", Listener(ANY_PORT), deadline=one) for n, one in enumerate(deadlines)),
        (UpstreamSettings.of("line", line, **options),),
        RoutingTable((route or Route(upstream="line", units=frozenset(range(1, 248))),)),
    )
    async with Gateway(plan) as made:
        yield made


def client(made: Gateway, listener: int = 0, **options: Any) -> busway.AsyncLink:
    return busway.open(made.endpoints[listener], shared=False, **{"timeout": 5.0, "retries": 0, **options})


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
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
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
        assert made.status().upstreams[0].links[0].queued == made.open_requests == 0


async def test_the_request_on_the_wire_at_the_deadline_is_0b() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1,), timeout=5) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert len(slow.asked) == 1


async def test_a_broadcast_has_the_deadline_of_its_client_too() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
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
async def test_who_shares_a_read_has_his_own_deadline_and_not_that_of_another(later: float | None) -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, later), timeout=5) as made,
        client(made, 1, max_transactions=2) as patient,
        client(made, 0) as hurried,
    ):
        blocking = asyncio.create_task(patient.unit(1).read_holding_registers(0, count=1))
        await until(lambda: slow.asked)
        first = asyncio.create_task(hurried.unit(1).read_holding_registers(1, count=1))
        await until(lambda: made.open_requests == 2)
        second = asyncio.create_task(patient.unit(1).read_holding_registers(1, count=1))
        counters = made.status().upstreams[0].counters
        await until(lambda: counters.shared == 1)
        with pytest.raises(busway.ExceptionReply, match="exception 0A"):  # it was not sent yet
            await first
        slow.allowed.release()
        slow.allowed.release()
        assert await asyncio.gather(blocking, second) == [[7], [7]]
        assert len(slow.asked) == 2
        assert made.open_requests == 0


@pytest.mark.parametrize("cache", [None, 5.0])  # by the road of batches, and by the other
async def test_who_joins_a_read_with_less_time_than_the_first_has_0b_when_his_is_over(cache: float | None) -> None:
    slow = Slow()
    route = Route(upstream="line", cache=cache)
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, None), route=route, timeout=5) as made,
        client(made, 1) as patient,
        client(made, 0) as hurried,
    ):
        first = asyncio.create_task(patient.unit(1).read_holding_registers(1, count=1))
        await until(lambda: slow.asked)
        assert await code_of(hurried.unit(1).read_holding_registers(1, count=1)) == 0x0B
        assert made.status().upstreams[0].counters.shared == 1
        assert not first.done()
        slow.allowed.release()
        assert await first == [7]
        assert made.open_requests == 0


@pytest.mark.parametrize("cache", [None, 5.0])
async def test_a_read_for_which_no_client_has_time_left_is_taken_back(cache: float | None) -> None:
    slow = Slow()
    route = Route(upstream="line", cache=cache)
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], deadlines=(0.1, 0.15, None), route=route, timeout=5) as made,
        client(made, 2) as patient,
        client(made, 1) as second,
        client(made, 0) as first,
    ):
        blocking = asyncio.create_task(patient.unit(1).read_holding_registers(0, count=1))
        await until(lambda: slow.asked)
        reads = [code_of(link.unit(1).read_holding_registers(9, count=1)) for link in (first, second)]
        assert await asyncio.gather(*reads) == [0x0A, 0x0A]
        slow.allowed.release()
        assert await blocking == [7]
        await until(lambda: not made.open_requests)
        assert len(slow.asked) == 1


async def test_where_nothing_is_said_a_request_is_answered_within_two_and_a_half_seconds() -> None:
    listener = GatewayListener("office", Listener(ANY_PORT))
    assert listener.deadline == 2.5
    line = UpstreamSettings.of("line", "tcp://127.0.0.1:1")
    assert line.link.parameters.timeout == 1.0
    timeout = busway.open("tcp://127.0.0.1:1").parameters.timeout
    assert worst_case(line, Route(upstream="line")).seconds < listener.deadline < timeout == 3.0


@pytest.mark.alone
@pytest.mark.parametrize("scheme", ["rtu", "ascii", "tcp"])
async def test_a_client_on_defaults_hears_0b_of_a_dead_unit_and_no_timeout_of_its_own(scheme: str) -> None:
    """From end to end, over sockets and a line, every option as it is where nothing is said."""
    with line_of_whole_frames(ports=2, baud=19200) as bus:
        near, far = (f"{scheme}://{path}?baud=19200" for path in bus.paths)
        if scheme == "tcp":
            far = ANY_PORT
        async with busway.serve(far, units={1: busway.Device(holding_registers=[5])}, unlisted="silence") as server:
            configuration = simple_gateway([ANY_PORT], server.endpoints[0] if scheme == "tcp" else near)
            async with configuration.serve() as made, busway.open(made.endpoints[0], shared=False) as link:
                assert await link.unit(1).read_holding_registers(0, count=1) == [5]
                loop = asyncio.get_running_loop()
                begun = loop.time()
                assert await code_of(link.unit(9).read_holding_registers(0, count=1)) == 0x0B
                print(f"{scheme}: 0B after {loop.time() - begun:.2f} s")
                assert loop.time() - begun < 2.75
                assert link.counters.timeouts == 0


async def test_what_waits_for_a_connection_is_0a_at_the_deadline() -> None:
    async with (
        ScriptedPeer(first_address) as peer,
        gateway(peer.endpoint, deadlines=(0.2,), connect_delay=30.0) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0A
        assert peer.frames == []
        assert made.open_requests == 0


@pytest.mark.alone
async def test_the_deadline_holds_whatever_the_timeouts_of_the_line_add_up_to() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: None) as peer,
        gateway(peer.endpoint, deadlines=(0.3,), timeout=0.2, retries=10) as made,
        client(made) as link,
    ):
        loop = asyncio.get_running_loop()
        begun = loop.time()
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert 0.29 < loop.time() - begun < 1.0


async def test_a_read_is_repeated_as_often_as_the_line_says_and_a_write_never() -> None:
    async with (
        ScriptedPeer(lambda peer, frame: None) as peer,
        gateway(peer.endpoint, timeout=0.05, retries=2, open_after=0) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
        assert [frame.pdu for frame in peer.frames] == [bytes.fromhex("03 0000 0001")] * 3
        with pytest.raises(busway.WriteOutcomeUnknown):
            await link.unit(1).write_single_register(0, 1)
        assert len(peer.frames) == 4


async def test_a_silent_unit_of_a_server_on_tcp_is_not_asked_for_a_while_and_the_others_are() -> None:
    def all_but_nine(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        return None if frame.unit == 9 else first_address(peer, frame)

    pauses = {"first_pause": 60.0, "longest_pause": 60.0}
    async with (
        ScriptedPeer(all_but_nine) as peer,
        gateway(peer.endpoint, timeout=0.05, retries=0, **pauses) as made,
        client(made) as link,
    ):
        for _ in range(5):
            assert await code_of(link.unit(9).read_holding_registers(0, count=1)) == 0x0B
            assert await link.unit(1).read_holding_registers(7, count=1) == [7]
        assert [frame.unit for frame in peer.frames].count(9) == 3
        (unit,) = made.status().upstreams[0].links[0].suspended
        assert (unit.unit, unit.state, 0 < unit.next_probe <= 60) == (9, "open", True)


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
        assert made.status().upstreams[0].links[0].counters.retries == 6
        assert made.status().upstreams[0].counters.no_answer == 0


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
        gateway(peer.endpoint, route=Route(upstream="line", timeout=0.05), timeout=60, retries=0) as made,
        client(made) as link,
    ):
        assert await code_of(link.unit(1).read_holding_registers(0, count=1)) == 0x0B
