"""How much there may be of everything, and that no more is kept than that."""

import asyncio
import contextlib
import struct
import tracemalloc
from typing import Any

import pytest
from handles import open_handles
from scripted_peer import ScriptedPeer, first_address
from waiting import until

import busway
from busway.apps.gateway.forwarding import Forwarder
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings, simple_plan
from busway.apps.gateway.router import ListenerRouter
from busway.apps.gateway.routes import ALL_UNITS, ListenerRoutes, Route, RoutingTable
from busway.apps.gateway.upstream import Upstream
from busway.client.settings import link_settings
from busway.framing.mbap import MbapFrame
from busway.options.server import ListenerParameters
from busway.server.listener import Listener
from busway.session.call import Call
from busway.session.diagnostic_counters import CommunicationState
from busway.session.responder import ALONE, ClientIdentity, Forwarding, RequestContext

ANY_PORT = "tcp://127.0.0.1:0"

pytestmark = pytest.mark.clause("T32")


async def test_three_hundred_clients_are_served_over_one_connection_and_leave_nothing() -> None:
    before = open_handles()
    limits = ListenerParameters(max_connections=300)
    device = busway.Device(holding_registers=list(range(2000)))
    async with busway.serve(ANY_PORT, units={1: device}) as server:
        plan = GatewayPlan(
            (GatewayListener("office", Listener(ANY_PORT, limits=limits)),),
            (UpstreamSettings.of("line", server.endpoints[0], queue=300, timeout=10, max_transactions=16),),
            RoutingTable((Route(upstream="line"),)),
        )
        async with Gateway(plan) as gateway:
            host, port = gateway.endpoints[0].removeprefix("tcp://").split(":")
            streams = [await asyncio.open_connection(host, int(port)) for _ in range(300)]
            await until(lambda: len(gateway.status().connections) == 300)
            for turn in range(2):
                for number, (_, writer) in enumerate(streams):
                    writer.write(struct.pack(">HHHBBHH", number, 0, 6, 1, 3, number + turn, 2))
                for number, (reader, _) in enumerate(streams):
                    reply = await reader.readexactly(13)
                    first = number + turn
                    assert reply == struct.pack(">HHHBBBHH", number, 0, 7, 1, 3, 4, first, first + 1)
            assert server.status().counters.accepted == 1
            for _, writer in streams:
                writer.close()
            await until(lambda: not gateway.status().connections)
            assert gateway.open_requests == 0
    await until(lambda: open_handles() == before)


async def test_the_queue_of_a_line_is_bounded_for_all_clients_together_and_served_in_turn() -> None:
    def held(peer: ScriptedPeer, frame: MbapFrame) -> bytes | None:
        return first_address(peer, frame) if frame.pdu[2] == 99 else None

    async with ScriptedPeer(held) as peer:
        options: dict[str, Any] = {"shared": False, "timeout": 30, "retries": 0, "max_connections": 20}
        plan = simple_plan([ANY_PORT], peer.endpoint, queue=10, timeout=30, retries=0, share_reads=False)
        async with Gateway(plan) as gateway, contextlib.AsyncExitStack() as stack:
            links = [await stack.enter_async_context(busway.open(gateway.endpoints[0], **options)) for _ in range(20)]
            assert await links[0].unit(1).read_holding_registers(99, count=1) == [99]
            asked = [asyncio.create_task(link.unit(1).read_holding_registers(1, count=1)) for link in links]
            counters = gateway.status().upstreams[0].counters
            await until(lambda: counters.no_path == 9)  # one is on the wire, ten wait
            assert gateway.status().upstreams[0].links[0].queued == 10
            await asyncio.sleep(0)
            assert counters.no_path == 9
            for task in asked:
                task.cancel()
            await asyncio.gather(*asked, return_exceptions=True)


class Taking:
    """A link that takes everything and answers when it is told to."""

    def __init__(self) -> None:
        self.taken: list[Call] = []

    def now(self) -> float:
        return 0.0

    def begin(self, call: Call, now: float) -> None:
        self.taken.append(call)

    def give_up(self, call: Call) -> None:
        self.taken.remove(call)

    def answer_all(self) -> None:
        for call in self.taken:
            call.requests[0].prepare()
            call.outcomes[0] = call.requests[0].accept(bytes((3, 20)) + bytes(20))
            call.open, call.ended = 0, True
        taken, self.taken = self.taken, []
        for call in taken:
            call.owner.set_result(None)


def lines_of(connections: int) -> tuple[Upstream, list[Taking]]:
    line = Upstream("line", link_settings("tcp://127.0.0.1:1", {}), connections=connections)
    links = [Taking() for _ in range(connections)]
    line.links.extend(links)  # type: ignore[arg-type]  # instead of connections
    return line, links


@pytest.mark.parametrize("goes", [False, True])
def test_ten_thousand_clients_that_came_and_went_are_not_remembered(goes: bool) -> None:
    line, links = lines_of(4)
    forwarder = Forwarder(line)
    handler = ListenerRouter("office", busway.STANDARD)
    handler.follow(ListenerRoutes([Route(upstream="line", units=ALL_UNITS, cache=60.0)]), {"line": forwarder})
    diagnostics = CommunicationState()

    def some_clients(first: int) -> None:
        contexts = []
        for number in range(first, first + 100):
            context = RequestContext(
                unit=number % 256,
                function=3,
                diagnostics=diagnostics,
                finish=_ignored,
                client=ClientIdentity(peer=f"10.0.0.1:{number}"),
            )
            handler.answer(context, busway.ReadHoldingRegisters(number % 65_000, 10))
            contexts.append(context)
        if goes:
            for context in contexts:
                context.abandon()
        else:
            for link in links:
                link.answer_all()
        assert forwarder.open_requests == 0

    for first in range(0, 5000, 100):
        some_clients(first)
    tracemalloc.start()
    try:
        begun = tracemalloc.get_traced_memory()[0]
        for first in range(5000, 10_000, 100):
            some_clients(first)
        grown = tracemalloc.get_traced_memory()[0] - begun
    finally:
        tracemalloc.stop()
    # What may be kept is bounded: 4096 clients with their connection, and 64 blocks of 20 bytes for each of 256 units.
    assert len(line._link_of) <= 4096
    cache: Any = forwarder.cache
    assert len(cache._units) <= 256
    assert all(len(unit.blocks) <= 64 and not unit.reading for unit in cache._units.values())
    assert grown < 6_000_000, grown


def _ignored(context: RequestContext, reply: object) -> None:
    """The answers are not looked at."""


def test_a_client_that_goes_on_asking_keeps_its_connection_however_many_others_come() -> None:
    line, links = lines_of(4)
    forwarder = Forwarder(line)
    handler = ListenerRouter("office", busway.STANDARD)
    handler.follow(ListenerRoutes([Route(upstream="line")]), {"line": forwarder})

    def ask(peer: str, address: int) -> Taking:
        context = RequestContext(
            unit=1, function=3, diagnostics=CommunicationState(), finish=_ignored, client=ClientIdentity(peer=peer)
        )
        forwarding = handler.answer(context, busway.ReadHoldingRegisters(address, 10))
        assert isinstance(forwarding, Forwarding)
        for target, asked in forwarding.asks:
            target.ask(forwarding, ALONE, (asked,))
        (used,) = [link for link in links if link.taken]
        used.answer_all()
        return used

    own = ask("the one", 0)
    for number in range(9000):
        ask(f"client {number}", 1)
        if not number % 1000:
            assert ask("the one", 0) is own
