"""UDP listeners and RTU and ASCII over networks, with our own clients."""

import asyncio
import contextlib
import socket
from urllib.parse import urlsplit

import pytest
from handlers import ScriptedHandler, later, registers
from waiting import until

import busway
from busway.access.addresses import AddressList
from busway.access.rules import Policy
from busway.framing.ascii import encode_ascii
from busway.framing.mbap import encode_mbap
from busway.framing.rtu import encode_rtu
from busway.options.networks import Networks
from busway.pdu.read_items import ReadHoldingRegisters
from busway.server.listener import Listener

READ = ReadHoldingRegisters(0, 2).encode()
REPLY = bytes.fromhex("03 04 00 00 00 01")
NETWORK = ["udp", "rtu+udp", "ascii+udp", "rtu+tcp", "ascii+tcp"]


def device() -> busway.Device:
    made = busway.Device(holding_registers=100)
    made.holding_registers[0:10] = list(range(10))
    return made


def frame_of(scheme: str, unit: int, pdu: bytes) -> bytes:
    if scheme == "udp":
        return encode_mbap(9, unit, pdu)
    return (encode_rtu if scheme.startswith("rtu") else encode_ascii)(unit, pdu)


class Sender:
    """A plain UDP socket towards a server."""

    def __init__(self, endpoint: str) -> None:
        parts = urlsplit(endpoint)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(5.0)
        self.socket.connect((parts.hostname, parts.port))

    def __enter__(self) -> "Sender":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    async def ask(self, data: bytes) -> bytes:
        self.socket.send(data)
        return await asyncio.to_thread(self.socket.recv, 2048)


@pytest.mark.parametrize("scheme", NETWORK)
async def test_clients_of_both_kinds_and_a_server_talk_over_a_network(scheme: str) -> None:
    async with busway.serve(f"{scheme}://127.0.0.1:0", units={1: device(), 7: device()}) as server:
        (endpoint,) = server.endpoints
        async with busway.open(endpoint) as link:
            values = await asyncio.gather(*(link.unit(7).read_holding_registers(n, count=2) for n in range(5)))
            assert values == [[n, n + 1] for n in range(5)]
            await link.unit(1).write_multiple_registers(20, [1, 2, 3])
            assert await link.unit(1).diagnostics(0, b"abcdef") == b"abcdef"

        def blocking() -> list[int]:
            with busway.connect(endpoint) as link:
                return link.unit(1).read_holding_registers(20, count=3)

        assert await asyncio.to_thread(blocking) == [1, 2, 3]
        assert server.status().counters.requests == 8


@pytest.mark.parametrize("scheme", ["udp", "rtu+udp", "ascii+udp"])
async def test_malformed_datagram_is_dropped_and_counted_and_the_next_one_answered(scheme: str) -> None:
    async with busway.serve(f"{scheme}://127.0.0.1:0", units={1: device()}) as server:
        whole = frame_of(scheme, 1, READ)
        with Sender(server.endpoints[0]) as sender:
            bad = [b"", b"\x00", whole[:-1], whole + b"\x00", whole + whole, bytes(1500)]
            for data in bad:
                sender.socket.send(data)
            assert await sender.ask(whole) == frame_of(scheme, 1, REPLY)
        status = server.status()
        assert status.listeners[0].damaged == len(bad)
        assert status.counters.discarded_frames == len(bad)
        assert status.counters.requests == 1


@pytest.mark.parametrize("scheme", ["udp", "rtu+udp", "ascii+udp"])
async def test_each_datagram_is_one_frame_and_answers_go_to_the_sender_alone(scheme: str) -> None:
    async with busway.serve(f"{scheme}://127.0.0.1:0", units={1: device()}) as server:
        with Sender(server.endpoints[0]) as one, Sender(server.endpoints[0]) as other:
            for _ in range(3):
                assert await one.ask(frame_of(scheme, 1, READ)) == frame_of(scheme, 1, REPLY)
            other.socket.settimeout(0.05)
            with pytest.raises(TimeoutError):
                await asyncio.to_thread(other.socket.recv, 2048)
            assert [peer.requests for peer in server.status().connections] == [3]


async def test_there_are_as_many_peers_as_connections_may_be() -> None:
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}, max_connections=2) as server:
        for _ in range(4):
            with Sender(server.endpoints[0]) as sender:
                await sender.ask(frame_of("udp", 1, READ))
        status = server.status()
        assert len(status.connections) == 2
        assert (status.counters.accepted, status.counters.evicted, status.counters.requests) == (4, 2, 4)


class PrioritySender(Sender):
    """A sender from an address that the priority slots are for."""

    def __init__(self, endpoint: str) -> None:
        super().__init__(endpoint)
        self.socket.close()
        parts = urlsplit(endpoint)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(5.0)
        self.socket.bind(("127.0.0.2", 0))
        self.socket.connect((parts.hostname, parts.port))


@pytest.mark.clause("T13")
async def test_strangers_push_out_no_marked_peer_however_many_senders_there_are() -> None:
    options = {"priority": ["127.0.0.2"], "max_connections": 1, "max_priority_connections": 1}
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}, **options) as server:
        with PrioritySender(server.endpoints[0]) as priority:
            await priority.ask(frame_of("udp", 1, READ))
            for _ in range(5):
                with Sender(server.endpoints[0]) as sender:
                    await sender.ask(frame_of("udp", 1, READ))
            await priority.ask(frame_of("udp", 1, READ))
            status = server.status()
            assert [(one.pool.value, one.requests) for one in status.connections] == [("priority", 2), ("other", 1)]
            assert status.counters.priority.accepted == 1
            assert status.listeners[0].priority_connections == 1


@pytest.mark.clause("T13")
async def test_priority_sender_that_asks_from_many_ports_keeps_no_other_out() -> None:
    options = {"priority": ["127.0.0.2"], "max_connections": 2, "max_priority_connections": 2}
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}, **options) as server:
        for _ in range(5):
            with PrioritySender(server.endpoints[0]) as priority:
                await priority.ask(frame_of("udp", 1, READ))
        with Sender(server.endpoints[0]) as stranger:
            await stranger.ask(frame_of("udp", 1, READ))
        assert server.counters.refused_full == 0
        assert [one.pool.value for one in server.status().connections] == ["priority", "other", "other"]
        with PrioritySender(server.endpoints[0]) as priority:
            await priority.ask(frame_of("udp", 1, READ))


@pytest.mark.clause("T40")
async def test_sender_without_a_place_gets_nothing() -> None:
    options = {"priority": ["127.0.0.2"], "max_connections": 1, "max_priority_connections": 1}
    slow = ScriptedHandler(lambda context, request: registers(0) if context.unit == 1 else busway.LATER)
    async with busway.serve("udp://127.0.0.1:0", responder=slow, **options) as server:
        with (
            PrioritySender(server.endpoints[0]) as first,
            PrioritySender(server.endpoints[0]) as second,
            Sender(server.endpoints[0]) as third,
        ):
            await first.ask(frame_of("udp", 1, READ))
            second.socket.send(frame_of("udp", 2, READ))
            third.socket.send(frame_of("udp", 1, READ))
            await first.ask(frame_of("udp", 1, READ))  # sent after it, and so answered after it was looked at
            assert server.counters.refused_full == 1
            third.socket.setblocking(False)
            with pytest.raises(BlockingIOError):
                third.socket.recv(2048)


async def test_datagrams_over_the_rate_of_a_host_are_dropped_and_counted_and_a_marked_host_has_none() -> None:
    options = {"priority": ["127.0.0.2"], "request_rate": 0.001}
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}, **options) as server:
        with Sender(server.endpoints[0]) as sender, PrioritySender(server.endpoints[0]) as priority:
            await sender.ask(frame_of("udp", 1, READ))
            for _ in range(3):
                sender.socket.send(frame_of("udp", 1, READ))
            for _ in range(3):
                await priority.ask(frame_of("udp", 1, READ))
            assert (server.counters.rate_limited, server.status().counters.requests) == (3, 4)


@pytest.mark.clause("T15")
async def test_listener_over_udp_has_access_rules_of_its_own_and_the_policy_of_the_server() -> None:
    units = {1: device()}
    listener = Listener("udp://127.0.0.1:0", access=AddressList(deny=Networks(["127.0.0.2"])))
    async with busway.serve(listener, units=units, policy=Policy.read_only()) as server:
        with Sender(server.endpoints[0]) as sender, PrioritySender(server.endpoints[0]) as refused:
            refused.socket.send(frame_of("udp", 1, READ))
            write = frame_of("udp", 1, bytes.fromhex("06 0000 0009"))
            assert await sender.ask(write) == frame_of("udp", 1, bytes.fromhex("86 01"))
            assert server.counters.unauthorized == 1
    assert units[1].holding_registers[0] == 0


async def test_no_datagram_is_answered_by_more_than_the_reply_of_its_request() -> None:
    """Whatever is sent, at most one datagram comes back; to what is no request, none."""
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}) as server:
        with Sender(server.endpoints[0]) as sender:
            reply = frame_of("udp", 1, bytes.fromhex("03 FA") + bytes(250))
            for data in (b"", b"\0" * 7, frame_of("udp", 1, READ) * 2, frame_of("udp", 1, REPLY)[:-1], bytes(1472)):
                sender.socket.send(data)
            answer = await sender.ask(frame_of("udp", 1, ReadHoldingRegisters(20, 80).encode()))
            assert len(answer) == 9 + 160 <= len(reply)
            sender.socket.setblocking(False)
            with pytest.raises(BlockingIOError):
                sender.socket.recv(2048)


@pytest.mark.parametrize("scheme", ["udp", "rtu+udp"])
async def test_datagrams_that_wait_together_are_each_answered_to_their_own_sender(scheme: str) -> None:
    async with busway.serve(f"{scheme}://127.0.0.1:0", units={1: device()}) as server:
        with contextlib.ExitStack() as senders:
            asking = [senders.enter_context(Sender(server.endpoints[0])) for _ in range(5)]
            for number in range(10):  # more than are answered in one go; one in ten is no frame
                for first, sender in enumerate(asking):
                    pdu = ReadHoldingRegisters(first, 1).encode()
                    sender.socket.send(frame_of(scheme, 1, pdu) + bytes(2000 if number == 4 else 0))
            for first, sender in enumerate(asking):
                expected = frame_of(scheme, 1, bytes((3, 2, 0, first)))
                for _ in range(9):
                    assert await asyncio.to_thread(sender.socket.recv, 2048) == expected
        assert server.status().counters.discarded_frames == 5


@pytest.mark.clause("T38")
async def test_server_that_takes_no_more_answers_what_is_in_work_and_drops_what_comes() -> None:
    handler = ScriptedHandler(later)
    async with busway.serve("udp://127.0.0.1:0", responder=handler) as server:
        with Sender(server.endpoints[0]) as sender:
            sender.socket.send(frame_of("udp", 1, READ))
            await until(lambda: len(handler.contexts) == 1)
            await server.take_no_more()
            sender.socket.send(frame_of("udp", 1, READ))
            handler.contexts[0].reply(registers(7, 8))
            answer = await asyncio.to_thread(sender.socket.recv, 2048)
            assert answer == frame_of("udp", 1, bytes.fromhex("03 04 0007 0008"))
        assert len(handler.contexts) == 1


@pytest.mark.clause("T39")
async def test_while_the_system_takes_no_datagrams_answers_are_lost_and_nothing_piles_up() -> None:
    async with busway.serve("udp://127.0.0.1:0", units={1: device()}) as server:
        (bound,) = server._datagrams[0]._sockets
        bound.pause_writing()
        with Sender(server.endpoints[0]) as sender:
            sender.socket.send(frame_of("udp", 1, READ))
            await until(lambda: server.status().counters.requests == 1)
            bound.resume_writing()
            assert await sender.ask(frame_of("udp", 7, READ)) == frame_of("udp", 7, bytes.fromhex("83 0B"))
        assert server.counters.reading_paused == 1


@pytest.mark.clause("T20")
async def test_empty_host_hears_datagrams_of_both_families_on_one_port_and_counts_them_together() -> None:
    async with busway.serve("udp://:0", units={1: device()}) as server:
        assert sorted(url.rpartition(":")[0] for url in server.endpoints) == ["udp://0.0.0.0", "udp://[::]"]
        port = urlsplit(server.endpoints[0]).port
        for host in ("127.0.0.1", "[::1]"):
            async with busway.open(f"udp://{host}:{port}") as link:
                assert await link.unit(1).read_holding_registers(0, count=2) == [0, 1]
        status = server.status()
        assert (status.counters.requests, len(status.listeners), len(status.connections)) == (2, 1, 2)


@pytest.mark.clause("S2")
@pytest.mark.parametrize("scheme", ["rtu+udp", "rtu+tcp", "ascii+tcp"])
async def test_units_and_broadcasts_are_those_of_a_line(scheme: str) -> None:
    one, other = device(), device()
    async with (
        busway.serve(f"{scheme}://127.0.0.1:0", units={1: one, 7: other}) as server,
        busway.open(server.endpoints[0], timeout=0.1, retries=0, turnaround_delay=0.01) as link,
    ):
        await link.unit(0).write_single_register(5, 99)
        assert one.holding_registers[5] == other.holding_registers[5] == 99
        with pytest.raises(busway.NoReply):
            await link.unit(2).read_holding_registers(0, count=1)
        with pytest.raises(busway.InvalidRequest):
            await link.unit(0).read_holding_registers(0, count=1)


async def test_lost_datagrams_are_timeouts_and_late_ones_go_to_no_call() -> None:
    """A server that answers the first request only when it gets the second."""
    loop = asyncio.get_running_loop()
    held: list[tuple[bytes, object]] = []

    class Late(asyncio.DatagramProtocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            self.transport = transport

        def datagram_received(self, data: bytes, addr: object) -> None:
            held.append((data, addr))
            for request, peer in held[:-1] if len(held) == 2 else held[-1:] if len(held) > 2 else []:
                value = request[8:10] * 2
                self.transport.sendto(request[:4] + b"\x00\x07" + request[6:8] + b"\x04" + value, peer)  # type: ignore[attr-defined]

    transport, _ = await loop.create_datagram_endpoint(Late, local_addr=("127.0.0.1", 0))
    host, port = transport.get_extra_info("sockname")[:2]
    async with busway.open(f"udp://{host}:{port}", timeout=0.1, retries=0) as link:
        for address in (1, 2):
            with pytest.raises(busway.NoReply):
                await link.unit(1).read_holding_registers(address, count=2)
        assert await link.unit(1).read_holding_registers(3, count=2, timeout=10) == [3, 3]
        assert link.counters.late_replies == 1
    transport.close()


async def test_no_peer_is_a_timeout() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    async with busway.open(f"rtu+udp://127.0.0.1:{port}", timeout=0.05, retries=1) as link:
        with pytest.raises(busway.NoReply):
            await link.unit(1).read_coils(0, count=1)

    def blocking() -> None:
        with busway.connect(f"udp://127.0.0.1:{port}", timeout=0.05, retries=1) as link, pytest.raises(busway.NoReply):
            link.unit(1).read_coils(0, count=1)

    await asyncio.to_thread(blocking)


async def test_client_drops_datagrams_that_are_no_frame() -> None:
    loop = asyncio.get_running_loop()

    class Noisy(asyncio.DatagramProtocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            self.transport = transport

        def datagram_received(self, data: bytes, addr: object) -> None:
            for answer in (b"\x00", encode_rtu(1, REPLY)[:-1], encode_rtu(1, REPLY)):
                self.transport.sendto(answer, addr)  # type: ignore[attr-defined]

    transport, _ = await loop.create_datagram_endpoint(Noisy, local_addr=("127.0.0.1", 0))
    port = transport.get_extra_info("sockname")[1]
    async with busway.open(f"rtu+udp://127.0.0.1:{port}") as link:
        assert await link.unit(1).read_holding_registers(0, count=2) == [0, 1]
        assert link.counters.damaged_frames == 2

    def blocking() -> list[int]:
        with busway.connect(f"rtu+udp://127.0.0.1:{port}") as link:
            return link.unit(1).read_holding_registers(0, count=2)

    assert await asyncio.to_thread(blocking) == [0, 1]
    transport.close()


async def test_wedged_converter_is_connected_anew() -> None:
    """RTU over TCP to something that takes everything and says nothing."""
    accepted: list[asyncio.StreamWriter] = []

    async def swallow(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accepted.append(writer)
        await reader.read()
        writer.close()

    server = await asyncio.start_server(swallow, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with busway.open(f"rtu+tcp://127.0.0.1:{port}", timeout=0.05, retries=0, open_after=0) as link:
        for _ in range(4):
            with pytest.raises(busway.NoReply):
                await link.unit(1).read_coils(0, count=1)
        assert link.counters.recycled == 1
    server.close()
    await server.wait_closed()
    for writer in accepted:
        writer.close()
    assert len(accepted) == 2


async def test_several_listeners_of_every_kind_share_one_handler() -> None:
    endpoints = [f"{scheme}://127.0.0.1:0" for scheme in ("tcp", *NETWORK)]
    shared = device()
    async with busway.serve(*endpoints, units={1: shared}) as server:
        for number, endpoint in enumerate(server.endpoints):
            async with busway.open(endpoint) as link:
                await link.unit(1).write_single_register(number, 500 + number)
        assert shared.holding_registers[0:6] == [500, 501, 502, 503, 504, 505]
        assert len(server.status().listeners) == 6
        assert all(one.is_open for one in server.status().listeners)
    assert server.status().listeners == () or not any(one.is_open for one in server.status().listeners)
