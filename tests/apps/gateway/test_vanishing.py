"""Clients, lines and devices that go away in the middle of something, and come back."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest
from handlers import HeldReplies, ScriptedHandler
from handles import open_handles
from scripted_peer import ScriptedPeer
from waiting import until
from whole_frames import line_of_whole_frames

import busway
from busway.apps.gateway.configuration import parse_gateway
from busway.apps.gateway.gateway import Gateway
from busway.apps.gateway.gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings, simple_plan
from busway.apps.gateway.routes import Route, RoutingTable
from busway.framing.mbap import MbapFrame, encode_mbap
from busway.server.listener import Listener

ANY_PORT = "tcp://127.0.0.1:0"
BAUD = 115_200

pytestmark = pytest.mark.clause("T32")


def device(unit: int = 1) -> busway.Device:
    return busway.Device(holding_registers=[1000 * unit + n for n in range(300)])


@contextlib.asynccontextmanager
async def gateway(line: str, *, route: Route | None = None, **options: Any) -> AsyncIterator[Gateway]:
    plan = GatewayPlan(
        (GatewayListener("office", Listener(ANY_PORT)),),
        (UpstreamSettings.of("line", line, **options),),
        RoutingTable((route or Route(upstream="line", units=frozenset(range(1, 248))),)),
    )
    async with Gateway(plan) as made:
        yield made


def client(made: Gateway, **options: Any) -> busway.AsyncLink:
    return busway.open(made.endpoints[0], shared=False, **{"timeout": 5.0, "retries": 0, **options})


async def code_of(asked: Any) -> int:
    with pytest.raises(busway.ExceptionReply) as error:
        await asked
    return error.value.code


async def first_answer(unit: Any) -> list[int]:
    """Ask for register 5, as a client does that goes on polling, until there is no 0A any more."""
    async with asyncio.timeout(60):
        while True:
            try:
                return await unit.read_holding_registers(5, count=1)  # type: ignore[no-any-return]
            except busway.ExceptionReply as error:
                if error.code != 0x0A:
                    raise
                await asyncio.sleep(0.005)


class Slow:
    """A server on TCP that answers reads with their address, one answer for each `let`, and keeps what it is asked."""

    def __init__(self) -> None:
        self.allowed = asyncio.Semaphore(0)
        self.asked: list[bytes] = []

    def decide(self, context: busway.RequestContext, request: Any) -> Any:
        self.asked.append(request.encode())
        return self._answer(request)

    async def _answer(self, request: Any) -> busway.Message:
        await self.allowed.acquire()
        if isinstance(request, busway.ReadHoldingRegisters):
            return request.Reply(b"".join((request.address + n).to_bytes(2, "big") for n in range(request.count)))
        return request.Reply(request.address, request.count)  # type: ignore[no-any-return]

    def let(self, times: int) -> None:
        for _ in range(times):
            self.allowed.release()


# --- clients -------------------------------------------------------------------------------------


async def test_the_rest_of_a_split_read_is_not_asked_for_a_client_that_has_gone() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], route=Route(upstream="line", max_registers=10), timeout=5) as made,
    ):
        leaving = client(made)
        asked = asyncio.create_task(leaving.unit(1).read_holding_registers(0, count=100))
        await until(lambda: len(slow.asked) == 1)
        slow.let(2)
        await until(lambda: len(slow.asked) == 3)
        await leaving.close()
        await asyncio.gather(asked, return_exceptions=True)
        await until(lambda: not made.open_requests)
        slow.let(10)
        async with client(made) as link:
            assert await link.unit(1).read_holding_registers(200, count=2) == [200, 201]
        assert len(slow.asked) == 4


async def test_a_split_write_that_has_begun_is_written_to_its_end() -> None:
    """Half a block would be worse than all of it; and no client may read the range as unchanged meanwhile."""
    slow = Slow()
    route = Route(upstream="line", max_registers=2, split_writes=True, cache=60)
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], route=route, timeout=5) as made,
    ):
        leaving = client(made)
        asked = asyncio.create_task(leaving.unit(1).write_multiple_registers(0, [1, 2, 3, 4, 5]))
        await until(lambda: len(slow.asked) == 1)
        await leaving.close()
        await asyncio.gather(asked, return_exceptions=True)
        await until(lambda: made.status().upstreams[0].counters.abandoned == 1)
        assert made.open_requests == 1
        slow.let(10)
        await until(lambda: not made.open_requests)
        assert [one[1:3] for one in slow.asked] == [b"\0\0", b"\0\2", b"\0\4"]


async def test_a_shared_read_lives_as_long_as_a_client_waits_for_it() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], timeout=5) as made,
    ):
        links = [client(made) for _ in range(3)]
        asked = []
        for count, link in enumerate(links):
            asked.append(asyncio.create_task(link.unit(1).read_holding_registers(7, count=1)))
            await until(lambda expected=count: made.status().upstreams[0].counters.shared == expected and slow.asked)
        counters = made.status().upstreams[0].counters
        await links[0].close()  # who asked first
        await until(lambda: counters.abandoned == 1)
        assert made.open_requests == 1
        async with client(made) as late:  # comes to it after the first has gone
            joining = asyncio.create_task(late.unit(1).read_holding_registers(7, count=1))
            await until(lambda: counters.shared == 3)
            await links[2].close()
            await until(lambda: counters.abandoned == 2)
            slow.let(1)
            assert await asked[1] == [7]
            assert await joining == [7]
        await asyncio.gather(*asked, return_exceptions=True)
        assert len(slow.asked) == 1
        await links[1].close()


async def test_a_shared_read_that_all_clients_have_left_is_shared_no_more() -> None:
    slow = Slow()
    async with (
        busway.serve(ANY_PORT, responder=ScriptedHandler(slow.decide)) as server,
        gateway(server.endpoints[0], timeout=5, max_transactions=4) as made,
    ):
        links = [client(made) for _ in range(2)]
        asked = [asyncio.create_task(link.unit(1).read_holding_registers(7, count=1)) for link in links]
        await until(lambda: made.status().upstreams[0].counters.shared == 1 and slow.asked)
        for link in links:
            await link.close()
        await until(lambda: not made.open_requests)
        await asyncio.gather(*asked, return_exceptions=True)
        async with client(made) as link:
            read = asyncio.create_task(link.unit(1).read_holding_registers(7, count=1))
            await until(lambda: len(slow.asked) == 2)
            slow.let(2)
            assert await read == [7]


@pytest.mark.parametrize("cache", [None, 60.0])
async def test_clients_that_keep_going_away_leave_nothing_behind(cache: float | None) -> None:
    before = open_handles()
    held_replies = HeldReplies()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server:
        route = Route(upstream="line", cache=cache, max_registers=3)
        async with gateway(server.endpoints[0], route=route, timeout=5, queue=1000) as made:
            for turn in range(15):
                links = [client(made, max_transactions=8) for _ in range(4)]
                asked = [
                    asyncio.create_task(link.unit(unit).read_holding_registers(1000 + turn, count=1 + unit))
                    for link in links
                    for unit in range(1, 6)
                ]
                await until(lambda: made.status().upstreams[0].counters.shared >= 15 * (turn + 1))  # noqa: B023
                for link in links:
                    await link.close()
                await asyncio.gather(*asked, return_exceptions=True)
                await until(lambda: not made.open_requests)
            status = made.status().upstreams[0].links[0]
            assert status.queued == 0
            held_replies.opened.set()
            await until(lambda: made.status().upstreams[0].links[0].in_flight == 0)
    await until(lambda: open_handles() == before)


# --- lines ---------------------------------------------------------------------------------------


@pytest.mark.real_time
async def test_a_port_that_is_pulled_out_fails_fast_and_works_again_when_it_is_back() -> None:
    before = open_handles()
    with line_of_whole_frames(ports=2, baud=BAUD) as line:
        urls = [f"rtu://{path}?baud={BAUD}" for path in line.paths]
        async with (
            busway.serve(urls[1], units={1: device(1), 2: device(2)}),
            gateway(urls[0], timeout=1.0, retries=0, reopen_first=0.05, reopen_most=0.1) as made,
            client(made, max_transactions=16) as link,
        ):
            assert await link.unit(1).read_holding_registers(1, count=1) == [1001]
            during: int | None = None
            for _ in range(2):
                line.cut(1)  # so that what is asked stays in the queue
                asked = [
                    asyncio.create_task(link.unit(unit).read_holding_registers(n, count=1))
                    for n in range(4)
                    for unit in (1, 2)
                ]
                await until(lambda: made.open_requests == 8 and made.status().upstreams[0].links[0].in_flight)
                loop = asyncio.get_running_loop()
                begun = loop.time()
                line.unplug(0)
                line.mend(1)
                codes = [await code_of(one) for one in asked]
                assert sorted(codes) == [0x0A] * 7 + [0x0B]  # one was on the wire
                assert await code_of(link.unit(1).read_holding_registers(9, count=1)) == 0x0A
                assert loop.time() - begun < 5  # nine timeouts, one after the other, take nine
                line.replug(0)
                assert await first_answer(link.unit(2)) == [2005]
                assert await link.unit(1).read_holding_registers(5, count=1) == [1005]
                now = open_handles()
                assert during in (None, now)
                during = now
            assert link.counters.connections == 1
            assert made.open_requests == 0
    await until(lambda: open_handles() == before)


async def test_a_server_behind_that_restarts_is_dialled_again_without_a_restart_of_the_gateway() -> None:
    server = busway.serve(ANY_PORT, units={1: device()})
    await server.start()
    endpoint = server.endpoints[0]
    quick = {"reconnect_first": 0.01, "reconnect_most": 0.02}
    async with gateway(endpoint, timeout=2.0, retries=1, **quick) as made, client(made) as link:
        assert await link.unit(1).read_holding_registers(1, count=1) == [1001]
        await server.stop()
        assert await code_of(link.unit(1).read_holding_registers(2, count=1)) == 0x0A
        again = busway.serve(endpoint, units={1: device(7)})
        await again.start()
        assert await first_answer(link.unit(1)) == [7005]
        assert link.counters.connections == 1
        await again.stop()


async def test_a_server_that_restarts_while_idle_costs_no_request() -> None:
    server = busway.serve(ANY_PORT, units={1: device()})
    await server.start()
    endpoint = server.endpoints[0]
    async with gateway(endpoint, timeout=2.0, retries=0) as made, client(made) as link:
        assert await link.unit(1).read_holding_registers(1, count=1) == [1001]
        await server.stop()
        async with busway.serve(endpoint, units={1: device(7)}):
            await until(lambda: made.status().upstreams[0].links[0].state != "up")
            assert await link.unit(1).read_holding_registers(1, count=1) == [7001]
            await link.unit(1).write_single_register(1, 5)


async def test_a_server_that_closes_after_every_answer_is_asked_all_the_same() -> None:
    def answer(peer: ScriptedPeer, frame: MbapFrame) -> bytes:
        return encode_mbap(frame.transaction, frame.unit, b"\x03\x02" + frame.pdu[1:3])

    async with (
        ScriptedPeer(answer, close_after=1) as peer,
        gateway(peer.endpoint, timeout=2.0, retries=2) as made,
        client(made) as link,
    ):
        for n in range(10):
            assert await link.unit(1).read_holding_registers(n, count=1) == [n]


async def test_a_write_whose_connection_is_lost_is_0b_and_one_that_waited_is_0a() -> None:
    """The first may have been executed, the second not: the client can tell."""
    async with contextlib.AsyncExitStack() as stack:
        peer = await stack.enter_async_context(ScriptedPeer(lambda peer, frame: None))
        made = await stack.enter_async_context(gateway(peer.endpoint, timeout=5.0, retries=1))
        link = await stack.enter_async_context(client(made, max_transactions=4))
        asked = [asyncio.create_task(link.unit(1).write_single_register(n, n)) for n in range(3)]
        await until(lambda: made.open_requests == 3 and peer.frames)
        peer._server.close()  # type: ignore[union-attr]  # no listener any more
        peer.writers[0].transport.abort()
        found = await asyncio.gather(*asked, return_exceptions=True)
        assert isinstance(found[0], busway.WriteOutcomeUnknown)
        assert [one.code for one in found[1:]] == [0x0A, 0x0A]  # type: ignore[union-attr]
        assert len(peer.frames) == 1


async def test_a_gateway_that_stops_while_clients_wait_leaves_nothing_open() -> None:
    before = open_handles()
    held_replies = HeldReplies()
    async with busway.serve(ANY_PORT, responder=ScriptedHandler(held_replies.decide)) as server:
        made = Gateway(simple_plan([ANY_PORT], server.endpoints[0], timeout=5, share_reads=False))
        await made.start()
        async with client(made, max_transactions=8) as link:
            asked = [asyncio.create_task(link.unit(1).read_holding_registers(1000, count=1)) for _ in range(6)]
            await until(lambda: made.open_requests == 6)
            await made.stop()
            for one in await asyncio.gather(*asked, return_exceptions=True):
                assert isinstance(one, busway.LinkDown)
        held_replies.opened.set()
        assert made.open_requests == 0
    await until(lambda: open_handles() == before)


PORT_WAITS: list[tuple[str, dict[str, float], float]] = [
    ("rtu:///dev/not-there", {}, 0.0),
    ("rtu:///dev/not-there?port_wait=3", {}, 3.0),
    ("rtu:///dev/not-there", {"port_wait": 2.0}, 2.0),
]
"""URL of a serial port, options of its link, and the seconds for which a gateway waits for the port."""


def port_wait_of(upstream: UpstreamSettings) -> float:
    line = upstream.link.line
    assert line is not None
    return line.opening.port_wait


@pytest.mark.parametrize(
    ("url", "options", "seconds"), [*PORT_WAITS, ("rtu:///dev/not-there?port_wait=3", {"port_wait": 2.0}, 2.0)]
)
def test_a_port_that_is_not_there_is_waited_for_only_where_that_is_said(
    url: str, options: dict[str, Any], seconds: float
) -> None:
    assert port_wait_of(UpstreamSettings.of("line", url, **options)) == seconds


@pytest.mark.parametrize(("url", "options", "seconds"), PORT_WAITS)
def test_a_port_that_is_not_there_is_waited_for_only_where_the_file_says_so(
    url: str, options: dict[str, Any], seconds: float
) -> None:
    """In a file, a link and its URL cannot differ."""
    told = "".join(f"{key} = {value}\n" for key, value in options.items())
    text = f'listen = ["{ANY_PORT}"]\n[[link]]\nname = "line"\nurl = "{url}"\n{told}'
    assert port_wait_of(parse_gateway(text, "gateway.toml").plan.upstreams[0]) == seconds


class DeadThenGone:
    """A server of serial frames that answers no request, and then closes at the next request."""

    def __init__(self) -> None:
        self.asked = 0
        self.closes = False

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while await reader.read(1000):
                self.asked += 1
                if self.closes:
                    break
        writer.close()


async def test_what_waits_for_a_unit_whose_probe_was_lost_with_the_connection_is_told() -> None:
    """Nothing else happens on such a line, so nothing else would have told it."""
    behind = DeadThenGone()
    server = await asyncio.start_server(behind.serve, "127.0.0.1", 0)
    endpoint = f"rtu+tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    pauses = {"open_after": 1, "first_pause": 0.05, "longest_pause": 0.05, "probe_timeout": 5.0}
    async with (
        gateway(endpoint, timeout=0.05, retries=0, reconnect_first=0.01, quiet_window=0.01, **pauses) as made,
        client(made, max_transactions=4) as link,
    ):
        assert await code_of(link.unit(5).read_holding_registers(0, count=1)) == 0x0B
        assert await code_of(link.unit(5).read_holding_registers(0, count=1)) == 0x0B  # suspended
        assert behind.asked == 1
        behind.closes = True
        asked: list[int] = []
        while behind.asked == 1:  # until the unit is probed
            reads = (code_of(link.unit(5).read_holding_registers(n, count=1)) for n in range(3))
            asked += await asyncio.gather(*reads)
        # On a busy machine one that waits is asked over a second connection, which is closed too: there is no path.
        assert set(asked) <= {0x0A, 0x0B}
        assert made.open_requests == 0
    server.close()
    await server.wait_closed()
