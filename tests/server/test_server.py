"""A server's life: listeners, start, stop, reset and status, over real sockets."""

import asyncio
import contextlib
import socket
import time
from urllib.parse import urlsplit

import pytest
from foreign_servers import free_port
from handlers import HeldReplies, ScriptedHandler, later
from waiting import until

import busway
from busway.testing.line import PacedLine

ANY_PORT = "tcp://127.0.0.1:0"


def _device() -> busway.Device:
    return busway.Device(holding_registers=list(range(100)))


async def _read(endpoint: str, address: int = 7, **options: object) -> list[int]:
    async with busway.open(endpoint, **options) as link:
        return await link.unit(1).read_holding_registers(address, count=1)


def _has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.mark.clause("T3")
async def test_server_listens_on_all_its_endpoints() -> None:
    async with busway.serve(ANY_PORT, ANY_PORT, ANY_PORT, units=_device()) as server:
        assert len(set(server.endpoints)) == 3
        for endpoint in server.endpoints:
            assert await _read(endpoint) == [7]


async def test_port_0_is_shown_as_the_port_that_was_taken() -> None:
    async with busway.serve(ANY_PORT, units=_device()) as server:
        port = urlsplit(server.endpoints[0]).port
        assert port
        assert server.status().endpoints == (f"tcp://127.0.0.1:{port}",)


@pytest.mark.clause("T20")
async def test_server_listens_on_ipv6_and_names_its_peers_and_endpoints_in_brackets() -> None:
    assert _has_ipv6(), "this test needs the IPv6 loopback"
    async with busway.serve("tcp://[::1]:0", units=_device()) as server:
        assert server.endpoints[0].startswith("tcp://[::1]:")
        async with busway.open(server.endpoints[0]) as link:
            assert await link.unit(1).read_holding_registers(3, count=2) == [3, 4]
            assert server.status().connections[0].peer.startswith("[::1]:")


@pytest.mark.clause("T20")
async def test_empty_host_listens_on_ipv4_and_ipv6() -> None:
    assert _has_ipv6(), "this test needs the IPv6 loopback"
    port = free_port()
    async with busway.serve(f"tcp://:{port}", units=_device()):
        assert await _read(f"tcp://127.0.0.1:{port}") == [7]
        assert await _read(f"tcp://[::1]:{port}") == [7]


@pytest.mark.clause("T34")
@pytest.mark.clause("T38")
async def test_server_answers_only_between_start_and_stop() -> None:
    server = busway.serve(ANY_PORT, units=_device())
    assert not server.is_running
    assert server.endpoints == []
    await server.start()
    endpoint = server.endpoints[0]
    assert server.is_running
    assert await _read(endpoint) == [7]
    await server.stop()
    assert not server.is_running
    with pytest.raises(busway.LinkDown):
        await _read(endpoint)


@pytest.mark.clause("T38")
async def test_start_and_stop_may_be_repeated() -> None:
    server = busway.serve(ANY_PORT, units=_device())
    for _ in range(3):
        await server.start()
        await server.start()
        assert len(server.endpoints) == 1
        assert await _read(server.endpoints[0]) == [7]
        await server.stop()
        await server.stop()


@pytest.mark.clause("T38")
async def test_listener_that_cannot_be_had_is_named_and_the_others_are_closed_again() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        busy = taken.getsockname()[1]
        server = busway.serve(ANY_PORT, f"tcp://127.0.0.1:{busy}", units=_device())
        with pytest.raises(busway.LinkDown, match=f"127.0.0.1:{busy}"):
            await server.start()
        assert not server.is_running
        assert server.endpoints == []
    await server.start()  # now the port is free
    await server.stop()


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("tls://127.0.0.1:0", "needs a certificate"),
        ("rtu:///dev/ttyUSB0?baud=1", "baud: must be"),
        ("rtu:///dev/ttyUSB0?timeout=1", "unknown option.*parity"),
        ("tcp://127.0.0.1:0?timeout=1", "timeout"),
        ("tcp:/127.0.0.1", "no endpoint"),
        ("tcp://127.0.0.1:70000", "70000|[Pp]ort"),
    ],
)
def test_endpoint_that_cannot_be_listened_on_is_refused_at_construction(endpoint: str, words: str) -> None:
    with pytest.raises(busway.ConfigError, match=words):
        busway.serve(endpoint, units=_device())


@pytest.mark.clause("T33")
def test_unknown_option_lists_those_there_are() -> None:
    with pytest.raises(busway.ConfigError, match="max_connections") as caught:
        busway.serve(ANY_PORT, units=_device(), max_conections=3)
    assert caught.value.key == "max_conections"


@pytest.mark.clause("T33")
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("max_transactions", 0),
        ("max_transactions", 17),
        ("scope", "world"),
        ("max_connections", 0),
        ("write_buffer", 100),
        ("backlog", 0),
        ("receive_buffer", 899),
        ("frame_timeout", 0),
    ],
)
def test_option_out_of_range_is_refused_and_named(name: str, value: object) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        busway.serve(ANY_PORT, units=_device(), **{name: value})
    assert caught.value.key == name


@pytest.mark.clause("T34")
@pytest.mark.real_time
async def test_stop_ends_within_a_second_with_busy_clients_attached() -> None:
    held_replies = HeldReplies()
    handler = ScriptedHandler(held_replies.decide)
    server = busway.serve(ANY_PORT, responder=handler)
    await server.start()
    async with busway.open(server.endpoints[0], max_transactions=16, timeout=30, retries=0) as link:
        unit = link.unit(1)
        waiting = [asyncio.create_task(unit.read_holding_registers(1000 + n, count=1)) for n in range(8)]

        async def keep_asking() -> None:
            while True:
                await unit.read_holding_registers(1, count=1)

        asking = asyncio.create_task(keep_asking())
        await until(lambda: len(handler.contexts) > 20)
        begin = time.monotonic()
        await server.stop()
        assert time.monotonic() - begin < 1.0
        for task in (*waiting, asking):
            with pytest.raises(busway.LinkDown):
                await task
    assert server.status().connections == ()


@pytest.mark.clause("T34")
@pytest.mark.real_time
async def test_stop_ends_within_a_second_though_a_client_takes_none_of_its_replies() -> None:
    device = busway.Device(holding_registers=1000)
    server = busway.serve(ANY_PORT, units=device, write_buffer=4096)
    await server.start()
    with socket.socket() as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", urlsplit(server.endpoints[0]).port))
        client.setblocking(False)
        await _fill(client, lambda: server.counters.reading_paused > 0)
        begin = time.monotonic()
        await server.stop()
        assert time.monotonic() - begin < 1.0
    assert server.status().connections == ()


async def _fill(client: socket.socket, enough: object) -> None:
    """Ask without reading until the server has had enough."""
    assert callable(enough)
    question = bytes.fromhex("0001 0000 0006 01 03 0000 007D") * 100
    while not enough():
        with contextlib.suppress(BlockingIOError):
            client.send(question)
        await asyncio.sleep(0)


@pytest.mark.clause("T34")
async def test_reset_clears_the_counters_and_serves_again() -> None:
    server = busway.serve(ANY_PORT, units=_device())
    await server.start()
    await _read(server.endpoints[0])
    await until(lambda: server.counters.closed == 1)
    assert server.status().counters.requests == 1
    await server.reset()
    assert server.status().counters.requests == server.counters.accepted == 0
    assert await _read(server.endpoints[0]) == [7]
    await server.stop()


@pytest.mark.clause("T34")
async def test_status_shows_connections_and_counters_as_they_stand() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve(ANY_PORT, responder=handler) as server:
        assert server.status().connections == ()
        async with busway.open(server.endpoints[0], timeout=30) as link:
            asked = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
            await until(lambda: handler.contexts)
            status = server.status()
            (connection,) = status.connections
            assert status.running
            assert 0 <= status.uptime < 60
            assert connection.listener == server.endpoints[0]
            assert connection.peer == handler.contexts[0].peer
            assert (connection.requests, connection.waiting, connection.received, connection.sent) == (1, 1, 12, 0)
            assert 0 <= connection.idle <= connection.age
            assert (status.counters.accepted, status.counters.requests) == (1, 1)
            handler.contexts[0].reply(busway.ReadHoldingRegisters.Reply(b"\x00\x05"))
            assert await asked == [5]
            assert server.status().connections[0].sent == 11
        await until(lambda: not server.status().connections)
        assert server.status().counters.requests == 1
    assert not server.status().running
    assert server.status().uptime == 0


async def test_serve_until_cancelled_stops_when_it_is_cancelled() -> None:
    server = busway.serve(ANY_PORT, units=_device())
    serving = asyncio.create_task(server.serve_until_cancelled())
    await until(lambda: server.is_running)
    assert await _read(server.endpoints[0]) == [7]
    serving.cancel()
    with pytest.raises(asyncio.CancelledError):
        await serving
    assert not server.is_running


def test_server_needs_an_endpoint_and_either_units_or_a_handler() -> None:
    with pytest.raises(busway.ConfigError, match="endpoint"):
        busway.Server((), ScriptedHandler(later))
    with pytest.raises(busway.ConfigError, match="units or a responder"):
        busway.serve(ANY_PORT)
    with pytest.raises(busway.ConfigError, match="units or a responder"):
        busway.serve(ANY_PORT, units=_device(), responder=ScriptedHandler(later))


@pytest.mark.clause("S16")
@pytest.mark.clause("S17")
@pytest.mark.parametrize("endpoint", ["tcp://127.0.0.1:0", "udp://127.0.0.1:0", "rtu+tcp://127.0.0.1:0"])
async def test_units_of_a_network_listener_have_counters_and_modes_of_their_own(endpoint: str) -> None:
    units = {1: busway.Device(holding_registers=4), 3: busway.Device(holding_registers=4)}
    async with (
        busway.serve(endpoint, units=units, diagnostics_changes=True) as server,
        busway.open(server.endpoints[0], timeout=2.0) as link,
    ):
        for unit in (1, 3, 3):
            await link.unit(unit).read_holding_registers(0, count=1)
        assert await link.unit(3).diagnostics(0x0A) == b"\x00\x00"
        await link.unit(3).read_holding_registers(0, count=1)
        assert await link.unit(3).diagnostics(0x0E) == b"\x00\x02"
        assert await link.unit(1).diagnostics(0x0E) == b"\x00\x02"
        (status,) = server.status().listeners
        assert (status.requests, status.counters.bus_message_count, status.listen_only_units) == (7, 7, ())


@pytest.mark.clause("S16")
async def test_device_that_also_answers_as_0_and_255_has_one_set_of_counters() -> None:
    async with (
        busway.serve("tcp://127.0.0.1:0", units={7: busway.Device(holding_registers=4)}) as server,
        busway.open(server.endpoints[0]) as link,
    ):
        for unit in (7, 255, 255):
            await link.unit(unit).read_holding_registers(0, count=1)
        assert await link.unit(255).diagnostics(0x0E) == b"\x00\x04"
        assert await link.unit(7).diagnostics(0x0E) == b"\x00\x05"


@pytest.mark.parametrize("endpoint", [ANY_PORT, "udp://127.0.0.1:0", pytest.param("rtu", marks=pytest.mark.real_time)])
async def test_responders_that_are_cancelled_by_the_end_of_the_server_have_ended_with_it(endpoint: str) -> None:
    answering, ended = asyncio.Event(), asyncio.Event()

    async def answer() -> busway.Message:
        answering.set()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            for _ in range(20):  # ending takes turns of the loop, as closing a connection does
                await asyncio.sleep(0)
            ended.set()
        raise AssertionError

    with contextlib.ExitStack() as stack:
        near = endpoint
        if endpoint == "rtu":
            line = stack.enter_context(PacedLine(ports=2, baud=115_200))
            near, endpoint = (f"rtu://{path}?baud=115200" for path in line.paths)
        async with busway.serve(endpoint, responder=ScriptedHandler(lambda context, request: answer())) as server:
            asking = asyncio.create_task(_read(near if near.startswith("rtu") else server.endpoints[0]))
            await asyncio.wait_for(answering.wait(), 60)
        assert ended.is_set()
        asking.cancel()
        await asyncio.wait([asking])
