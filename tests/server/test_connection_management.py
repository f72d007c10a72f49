"""Connection management over real sockets: pools, limits and times, and what a status shows of them."""

import asyncio
import contextlib
import logging
import socket
import struct
from typing import Any
from urllib.parse import urlsplit

import pytest
from handlers import ScriptedHandler, address_of, later, registers
from waiting import set_forward, until

import busway
import busway.server.connection_slots
from busway.access.addresses import AddressList, HostAuthorizer
from busway.framing.rtu import encode_rtu
from busway.options.networks import Networks
from busway.options.server import ListenerParameters
from busway.server.connection_slots import SlotLimits, SlotPool
from busway.server.listener import Listener
from busway.server.status import ServedConnectionState
from busway.testing import golden_adu

pytestmark = pytest.mark.usefixtures("transport")

ANY_PORT = "tcp://127.0.0.1:0"
PRIORITY_HOST, STRANGER = "127.0.0.2", "127.0.0.3"
QUESTION = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
ANSWER = bytes.fromhex("0001 0000 0005 01 03 02 0000")


def served(**options: Any) -> busway.Server:  # Any: see serve
    options.setdefault("units", busway.Device(holding_registers=1000))
    return busway.serve(options.pop("endpoint", ANY_PORT), **options)


class Client:
    """A connection from a chosen address."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def of(cls, server: busway.Server, host: str = STRANGER, index: int = 0) -> "Client":
        port = urlsplit(server.endpoints[index]).port
        return cls(*await asyncio.open_connection("127.0.0.1", port, local_addr=(host, 0)))

    async def ask(self) -> None:
        self.writer.write(QUESTION)
        assert await self.reader.readexactly(len(ANSWER)) == ANSWER

    async def is_closed(self) -> bool:
        """Wait for the other end to close; False if it answers after all."""
        async with asyncio.timeout(60):
            try:
                return await self.reader.read(100) == b""
            except ConnectionResetError:
                return True

    async def close(self) -> None:
        self.writer.close()
        with contextlib.suppress(ConnectionError):
            await self.writer.wait_closed()


async def closed(*clients: Client) -> None:
    for client in clients:
        await client.close()


# --- pools ---------------------------------------------------------------------------------------


@pytest.mark.clause("T13")
@pytest.mark.clause("T14")
async def test_new_connections_push_out_strangers_and_never_a_marked_connection() -> None:
    options = {"max_priority_connections": 2, "max_priority_per_host": 2, "max_connections": 2}
    async with served(priority=[PRIORITY_HOST], **options) as server:
        priority = [await Client.of(server, PRIORITY_HOST) for _ in range(2)]
        for one in priority:
            await one.ask()
        strangers = [await Client.of(server) for _ in range(6)]
        await strangers[-1].ask()
        for one in strangers[:4]:
            assert await one.is_closed()
        for one in (*priority, *strangers[4:]):
            await one.ask()
        status = server.status()
        assert status.counters.evicted == 4
        assert (status.supported_connections, status.remote_connections) == (4, 4)
        assert [one.pool for one in status.connections] == [SlotPool.PRIORITY] * 2 + [SlotPool.OTHER] * 2
        assert (status.listeners[0].priority_connections, status.listeners[0].other_connections) == (2, 2)
        await closed(*priority, *strangers)


@pytest.mark.clause("T13", "T18")
@pytest.mark.parametrize("ends", ["a reset", "the end of the stream"])
async def test_sixty_that_connect_and_close_push_no_other_off(ends: str) -> None:
    async with served() as server:
        client = await Client.of(server)
        await client.ask()
        assert server.status().supported_connections < 60 + 8
        knocks = [
            socket.create_connection(("127.0.0.1", urlsplit(server.endpoints[0]).port), timeout=60) for _ in range(60)
        ]
        for one in knocks:
            if ends == "a reset":
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            one.close()
        await until(lambda: server.counters.accepted + server.counters.refused_full >= 61)
        await until(lambda: len(server.status().connections) == 1)
        await client.ask()
        await client.close()


@pytest.mark.clause("T13")
async def test_those_who_connect_and_say_nothing_make_room_among_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(busway.server.connection_slots, "SECONDS_TO_SPEAK", 0.0)
    async with served(max_connections=5) as server:
        client = await Client.of(server)
        await client.ask()
        silent = [await Client.of(server) for _ in range(12)]
        for one in silent[:8]:
            assert await one.is_closed()
        await client.ask()
        await closed(client, *silent)


@pytest.mark.clause("T13")
async def test_marked_new_connection_beyond_its_limit_is_accepted_and_takes_a_place_of_the_others() -> None:
    options = {"max_priority_connections": 4, "max_priority_per_host": 1, "max_connections": 1}
    async with served(priority=["127.0.0.2/32"], **options) as server:
        stranger = await Client.of(server)
        await stranger.ask()
        priority = [await Client.of(server, PRIORITY_HOST) for _ in range(2)]
        for one in priority:
            await one.ask()
        assert await stranger.is_closed()
        refused = await Client.of(server)
        assert await refused.is_closed()
        for one in priority:
            await one.ask()
        assert [one.pool for one in server.status().connections] == [SlotPool.PRIORITY, SlotPool.OTHER]
        assert server.counters.refused_full == 1
        await closed(*priority, stranger, refused)


@pytest.mark.clause("T13")
@pytest.mark.clause("T15")
async def test_a_host_that_may_not_connect_pushes_no_other_out() -> None:
    async with served(max_connections=1, authorize=lambda host: host == STRANGER) as server:
        client = await Client.of(server)
        await client.ask()
        for _ in range(3):
            refused = await Client.of(server, "127.0.0.9")
            assert await refused.is_closed()
            await refused.close()
        await client.ask()
        assert (server.counters.unauthorized, server.counters.evicted, server.counters.accepted) == (3, 0, 1)
        await client.close()


@pytest.mark.clause("T18")
async def test_with_one_connection_for_each_address_the_new_connection_replaces_the_old_one() -> None:
    async with served(max_per_host=1) as server:
        other, old = await Client.of(server, "127.0.0.4"), await Client.of(server)
        for one in (other, old):
            await one.ask()
        new = await Client.of(server)
        await new.ask()
        assert await old.is_closed()
        await other.ask()
        assert [one.peer.split(":")[0] for one in server.status().connections] == ["127.0.0.4", STRANGER]
        await closed(other, old, new)


@pytest.mark.clause("T14")
async def test_each_listener_has_its_own_places_unless_they_are_shared() -> None:
    for shared, evicted in ((False, 0), (True, 2)):
        units = busway.Device(holding_registers=10)
        async with busway.serve(
            ANY_PORT, ANY_PORT, units=units, max_connections=2, max_priority_connections=3, shared_slots=shared
        ) as server:
            clients = [await Client.of(server, index=index) for index in (0, 0, 1, 1)]
            await clients[-1].ask()
            await until(lambda server=server, evicted=evicted: server.counters.evicted == evicted)
            assert server.status().supported_connections == (5 if shared else 10)
            await closed(*clients)


@pytest.mark.clause("T13")
@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"max_priority_connections": 2, "max_priority_per_host": 3}, "max_priority_per_host"),
        ({"max_connections": 2, "max_per_host": 3}, "max_per_host"),
        ({"max_priority_connections": 0, "priority": ["10.0.0.0/8"]}, "priority"),
        ({"priority": ["10.0.0.300"]}, "priority"),
        ({"header_timeout": 0}, "header_timeout"),
        ({"idle_timeout": -1}, "idle_timeout"),
        ({"write_timeout": 0}, "write_timeout"),
        ({"request_rate": 0}, "request_rate"),
        ({"interface": ""}, "interface"),
    ],
)
def test_limits_that_do_not_fit_are_refused_and_named(options: dict[str, Any], key: str) -> None:
    with pytest.raises(busway.ConfigError) as caught:
        served(**options)
    assert caught.value.key == key


def test_without_a_limit_of_its_own_a_device_may_have_half_of_the_priority_places() -> None:
    assert [
        SlotLimits.of(ListenerParameters(max_priority_connections=places)).priority_per_host for places in (0, 1, 2, 8)
    ] == [
        1,
        1,
        1,
        4,
    ]


@pytest.mark.clause("T12")
async def test_evictions_under_load_touch_no_marked_connection_and_no_answer_reaches_another_one() -> None:
    handler = ScriptedHandler(lambda context, request: registers(address_of(request)))
    loop = asyncio.get_running_loop()
    stop = asyncio.Event()
    answered = {"priority": 0, "others": 0}

    async def ask_for_ever(server: busway.Server, host: str, number: int, kind: str) -> None:
        """Ask for an address of one's own, again and again; a stranger that is pushed out comes back."""
        while not stop.is_set():
            client = await Client.of(server, host)
            try:
                while not stop.is_set():
                    transaction = answered[kind] & 0xFFFF
                    question = busway.ReadHoldingRegisters(number, 1).encode()
                    client.writer.write(golden_adu(question, transaction=transaction))
                    reply = await client.reader.readexactly(11)
                    assert reply == golden_adu(registers(number).encode(), transaction=transaction)
                    answered[kind] += 1
            except (ConnectionError, asyncio.IncompleteReadError):
                assert kind == "others"
            finally:
                client.writer.transport.abort()

    options = {"max_priority_connections": 4, "max_priority_per_host": 4, "max_connections": 6}
    async with served(units=None, responder=handler, priority=[PRIORITY_HOST], **options) as server:
        priority = [loop.create_task(ask_for_ever(server, PRIORITY_HOST, number, "priority")) for number in range(4)]
        await until(lambda: server.status().counters.priority.accepted == 4)
        others = [loop.create_task(ask_for_ever(server, STRANGER, 100 + n, "others")) for n in range(18)]
        await until(lambda: server.counters.evicted >= 300 and answered["priority"] >= 500, 50)
        assert not any(task.done() for task in (*priority, *others))
        status = server.status()
        assert status.counters.priority.accepted == 4
        assert status.listeners[0].other_connections <= 6
        stop.set()
        await asyncio.gather(*priority, *others)
        await until(lambda: server.counters.closed == server.counters.accepted)
        assert server.status().counters.priority.closed == 4


# --- times ---------------------------------------------------------------------------------------


@pytest.mark.clause("T40")
async def test_half_a_header_and_half_a_request_are_closed_in_their_time_and_a_marked_client_is_not() -> None:
    options = {"header_timeout": 0.05, "frame_timeout": 0.1, "idle_timeout": 0.2, "write_timeout": 0.05}
    async with served(priority=[PRIORITY_HOST], **options) as server:
        priority = await Client.of(server, PRIORITY_HOST)
        priority.writer.write(QUESTION[:3])
        header, body, idle = [await Client.of(server) for _ in range(3)]
        header.writer.write(QUESTION[:6])
        body.writer.write(QUESTION[:7])
        for one in (header, body, idle):
            assert await one.is_closed()
        counters = server.counters
        assert (counters.header_timeouts, counters.frame_timeouts, counters.idle_timeouts) == (1, 1, 1)
        assert server.status().listeners[0].damaged == 2
        assert server.status().listeners[0].indicators.error.value == "flashing"
        (status,) = server.status().connections
        assert (status.state, status.pool) == (ServedConnectionState.RECEIVING, SlotPool.PRIORITY)
        priority.writer.write(QUESTION[3:])
        assert await priority.reader.readexactly(len(ANSWER)) == ANSWER
        await closed(priority, header, body, idle)


@pytest.mark.clause("T6")
async def test_idle_connection_is_closed_and_one_with_a_request_in_work_is_not() -> None:
    handler = ScriptedHandler(later)
    async with served(units=None, responder=handler, idle_timeout=0.1) as server:
        busy, idle = await Client.of(server), await Client.of(server)
        busy.writer.write(QUESTION)
        assert await idle.is_closed()
        await until(lambda: server.counters.closed == 1)
        assert [one.state for one in server.status().connections] == [ServedConnectionState.BUSY]
        handler.contexts[0].reply(registers(0))
        assert await busy.reader.readexactly(len(ANSWER)) == ANSWER
        assert await busy.is_closed()
        assert server.counters.idle_timeouts == 2
        await closed(busy, idle)


async def broadcast(client: Client, device: busway.Device, value: int) -> None:
    """Write to register 0 of all units, over RTU, and wait until it was done; there is no reply."""
    client.writer.write(encode_rtu(0, bytes.fromhex("06 0000") + value.to_bytes(2, "big")))
    await until(lambda: device.holding_registers[0] == value)


@pytest.mark.clause("T6")
async def test_client_whose_requests_get_no_reply_is_not_idle(monkeypatch: pytest.MonkeyPatch) -> None:
    device = busway.Device(holding_registers=10)
    async with served(endpoint="rtu+tcp://127.0.0.1:0", units={1: device}, idle_timeout=10.0) as server:
        client = await Client.of(server)
        for value in range(1, 6):
            set_forward(monkeypatch, 4.0)
            await broadcast(client, device, value)
        assert server.counters.idle_timeouts == 0
        assert server.status().connections[0].idle < 4
        set_forward(monkeypatch, 11.0)
        assert await client.is_closed()
        await client.close()


@pytest.mark.clause("T12")
async def test_client_whose_requests_get_no_reply_is_not_the_one_unused_longest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    device = busway.Device(holding_registers=10)
    async with served(endpoint="rtu+tcp://127.0.0.1:0", units={1: device}, max_connections=2) as server:
        broadcasts, asks = await Client.of(server, "127.0.0.3"), await Client.of(server, "127.0.0.4")
        asks.writer.write(encode_rtu(1, bytes.fromhex("03 0000 0001")))
        await asks.reader.readexactly(len(encode_rtu(1, bytes(4))))
        set_forward(monkeypatch, 1.0)
        await broadcast(broadcasts, device, 1)
        third = await Client.of(server)
        assert await asks.is_closed()
        await broadcast(broadcasts, device, 2)
        await closed(broadcasts, asks, third)


@pytest.mark.clause("T6")
async def test_connection_is_idle_only_from_the_end_of_a_request_that_gets_no_reply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    handler = ScriptedHandler(later)
    async with served(units=None, responder=handler, idle_timeout=10.0) as server:
        client = await Client.of(server)
        client.writer.write(QUESTION)
        await until(lambda: handler.contexts)
        set_forward(monkeypatch, 30.0)
        handler.contexts[0].reply(busway.SILENCE)
        await until(lambda: server.status().connections[0].state is ServedConnectionState.IDLE)
        set_forward(monkeypatch, 5.0)
        for _ in range(5):
            await asyncio.sleep(0)
        assert server.counters.idle_timeouts == 0
        await client.close()


@pytest.mark.clause("T39")
@pytest.mark.parametrize(("host", "stays"), [(STRANGER, False), (PRIORITY_HOST, True)])
async def test_client_that_takes_no_replies_is_closed_in_time_unless_it_is_marked(host: str, stays: bool) -> None:
    options = {"write_buffer": 4096, "send_buffer": 4096, "write_timeout": 0.1}
    async with served(priority=[PRIORITY_HOST], **options) as server:
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.bind((host, 0))
            client.connect(("127.0.0.1", urlsplit(server.endpoints[0]).port))
            client.setblocking(False)
            while not server.counters.reading_paused:
                with contextlib.suppress(BlockingIOError):
                    client.send(bytes.fromhex("0001 0000 0006 01 03 0000 007D") * 100)
                await asyncio.sleep(0)
            if stays:
                async with served(header_timeout=0.3) as clock:  # three times as long as it takes with a stranger
                    slow = await Client.of(clock)
                    slow.writer.write(b"\0")
                    assert await slow.is_closed()
                    await slow.close()
                assert server.status().connections[0].state is ServedConnectionState.PAUSED
                assert server.counters.write_timeouts == 0
            else:
                await until(lambda: server.counters.closed == 1)
                assert server.counters.write_timeouts == 1


# --- rates ---------------------------------------------------------------------------------------


@pytest.mark.clause("T39")
async def test_host_over_its_rate_is_slowed_down_by_all_its_connections_and_others_are_not() -> None:
    async with served(request_rate=50, priority=[PRIORITY_HOST]) as server:
        clients = [await Client.of(server) for _ in range(2)]
        other, priority = await Client.of(server, "127.0.0.4"), await Client.of(server, PRIORITY_HOST)
        begin = asyncio.get_running_loop().time()
        for client in clients:
            client.writer.write(QUESTION * 35)
            await client.reader.readexactly(35 * len(ANSWER))
        clients[1].writer.write(QUESTION)  # not read before the debt of both is paid: (70 - 50) / 50 s
        await until(lambda: server.counters.rate_limited == 1)
        assert ServedConnectionState.PAUSED in [one.state for one in server.status().connections]
        await other.ask()
        for _ in range(60):
            await priority.ask()
        assert server.counters.rate_limited == 1
        await clients[1].reader.readexactly(len(ANSWER))
        assert asyncio.get_running_loop().time() - begin >= 0.35
        await closed(*clients, other, priority)


async def test_a_flood_on_a_host_with_a_rate_is_taken_in_small_pieces() -> None:
    async with served(request_rate=10) as server:
        client = await Client.of(server)
        client.writer.write(QUESTION * 1000)
        await until(lambda: server.counters.rate_limited == 1)
        assert server.status().connections[0].received <= 260
        client.writer.transport.abort()


# --- access --------------------------------------------------------------------------------------


@pytest.mark.clause("T15")
@pytest.mark.clause("T35")
async def test_a_listener_has_access_rules_of_its_own_beside_the_servers() -> None:
    lists: list[HostAuthorizer] = [AddressList(allow=Networks([STRANGER, "127.0.0.9"]), secure=True), lambda host: True]
    endpoints = [Listener(ANY_PORT, access=one) for one in lists]
    units = busway.Device(holding_registers=10)
    async with busway.serve(*endpoints, units=units, authorize=lambda host: host != "127.0.0.9") as server:
        for index, host, welcome in (
            (0, STRANGER, True),
            (0, "127.0.0.4", False),
            (0, "127.0.0.9", False),
            (1, "127.0.0.4", True),
            (1, "127.0.0.9", False),
        ):
            client = await Client.of(server, host, index)
            if welcome:
                await client.ask()
            else:
                assert await client.is_closed()
            await client.close()
        assert (server.counters.unauthorized, server.counters.accepted) == (3, 2)


@pytest.mark.clause("T15")
async def test_refusals_are_counted_each_and_logged_once_for_a_host(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "busway.server")
    async with served(authorize=lambda host: False) as server:
        for host in (STRANGER, STRANGER, STRANGER, "127.0.0.4"):
            client = await Client.of(server, host)
            assert await client.is_closed()
            await client.close()
        assert server.counters.unauthorized == 4
    lines = [record.getMessage() for record in caplog.records if "not authorized" in record.getMessage()]
    assert len(lines) == 2


# --- what is shown -------------------------------------------------------------------------------


@pytest.mark.clause("T34")
async def test_a_server_counts_the_connections_that_its_own_program_has_opened() -> None:
    async with served() as server:
        before = server.status().local_connections
        async with busway.open(server.endpoints[0]) as link:
            await link.unit(1).read_holding_registers(0, count=1)
            assert server.status().local_connections == before + 1
        assert server.status().local_connections == before


@pytest.mark.clause("T34")
async def test_connections_and_classes_of_devices_are_shown_with_what_they_did() -> None:
    async with served(priority=[PRIORITY_HOST], local_connections=lambda: 3) as server:
        priority, other = await Client.of(server, PRIORITY_HOST), await Client.of(server)
        for client in (priority, priority, other):
            await client.ask()
        status = server.status()
        assert status.local_connections == 3
        assert (status.remote_connections, status.supported_connections) == (2, 64)
        first, second = status.connections
        assert (first.pool, first.state, first.requests, first.received, first.sent, first.role) == (
            SlotPool.PRIORITY,
            ServedConnectionState.IDLE,
            2,
            2 * len(QUESTION),
            2 * len(ANSWER),
            None,
        )
        assert (second.pool, second.requests, second.listener) == (SlotPool.OTHER, 1, server.endpoints[0])
        assert 0 <= first.idle <= first.age
        await closed(priority, other)
        await until(lambda: server.counters.closed == 2)
        counters = server.status().counters
        assert (counters.priority.accepted, counters.priority.requests, counters.other.requests) == (1, 2, 1)
        assert counters.other.received == len(QUESTION)
        server.reset_counters()
        assert server.status().counters.priority.requests == server.status().counters.accepted == 0


@pytest.mark.clause("T28")
async def test_stream_that_cannot_be_followed_shows_on_the_indicators() -> None:
    async with served() as server:
        client = await Client.of(server)
        assert server.status().listeners[0].indicators.error.value == "off"
        client.writer.write(bytes.fromhex("0001 0000 0000 01 03"))
        assert await client.is_closed()
        assert server.status().listeners[0].indicators.error.value == "flashing"
        assert server.counters.broken_streams == server.status().listeners[0].damaged == 1
        await client.close()


@pytest.mark.clause("T38")
async def test_counters_set_to_zero_while_connections_live_count_on_from_zero() -> None:
    async with served() as server:
        client = await Client.of(server)
        for _ in range(3):
            await client.ask()
        server.reset_counters()
        assert server.status().counters.requests == 0
        await client.ask()
        assert server.status().counters.requests == server.status().counters.other.requests == 1
        await client.close()
        await until(lambda: server.counters.closed == 1)
        assert server.status().counters.requests == 1


# --- the end -------------------------------------------------------------------------------------


@pytest.mark.clause("T38")
async def test_server_that_takes_no_more_reads_nothing_more_and_still_gives_the_answers_it_owes() -> None:
    handler = ScriptedHandler(later)
    async with served(units=None, responder=handler, request_rate=5) as server:
        client = await Client.of(server)
        client.writer.write(QUESTION * 6)  # one more than its rate: it is held for a moment
        await until(lambda: len(handler.contexts) == 6)
        await server.take_no_more()
        client.writer.write(QUESTION)
        slow = served(header_timeout=0.3)  # longer than the moment
        async with slow:
            clock = await Client.of(slow)
            clock.writer.write(b"\0")
            assert await clock.is_closed()
            await clock.close()
        assert len(handler.contexts) == 6
        for context in handler.contexts:
            context.reply(registers(0))
        assert await client.reader.readexactly(6 * len(ANSWER)) == ANSWER * 6
        await client.close()


async def test_all_who_wait_for_the_last_connection_to_end_learn_of_its_end() -> None:
    async with served() as server:
        client = await Client.of(server)
        await client.ask()
        management = server._streams[0].management
        async with asyncio.timeout(20), asyncio.TaskGroup() as tasks:
            for _ in range(2):
                tasks.create_task(management.wait_until_empty())
            await asyncio.sleep(0)
            await client.close()
