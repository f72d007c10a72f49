"""The transport of an epoll set keeps what asyncio promises: each promise is tried on its own transports as well."""

import asyncio
import contextlib
import select
import socket
import struct
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Any

import pytest
from event_loops import LOOPS, run_on
from waiting import until

from busway.transport.accepting import accept_from
from busway.transport.epoll.stream import EpollStream
from busway.transport.epoll.watcher import EpollSet, epoll_set_for

pytestmark = pytest.mark.skipif(not hasattr(select, "epoll"), reason="this system has no epoll objects")

MUCH = 4 * 1024 * 1024
"""More than the system takes at once, in either direction."""
RESET = struct.pack("ii", 1, 0)
TRANSPORTS = ["asyncio's own", *(f"an epoll set on {name}" for name in LOOPS)]
EPOLL_SETS = TRANSPORTS[1:]


class Recorder(asyncio.BufferedProtocol):
    """Writes down what it hears."""

    def __init__(self) -> None:
        self.transport: Any = None  # asyncio.Transport; those of uvloop are of no such class
        self.heard: list[object] = []
        self.received = b""
        self.stays_after_the_end = False
        self.answer: Callable[[bytes], None] | None = None
        self.fails: dict[str, Exception] = {}
        self.lost = asyncio.Event()
        self.depth = 0
        self._buffer = bytearray(65_536)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport
        self._note("made")

    def get_buffer(self, sizehint: int) -> bytearray:
        if "get_buffer" in self.fails:
            raise self.fails["get_buffer"]
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        data = bytes(self._buffer[:nbytes])
        self.received += data
        self.depth += 1
        if self.answer is not None:
            self.answer(data)
        self.depth -= 1
        self._note("bytes")

    def eof_received(self) -> bool:
        self._note("end")
        return self.stays_after_the_end

    def pause_writing(self) -> None:
        self._note("pause")

    def resume_writing(self) -> None:
        self._note("resume")

    def connection_lost(self, exc: Exception | None) -> None:
        assert self.depth == 0, "told from within a call of the protocol's own"
        self.heard.append(("lost", type(exc)))
        self.lost.set()

    def _note(self, what: str) -> None:
        if what != "bytes" or not self.heard or self.heard[-1] != "bytes":
            self.heard.append(what)
        if what in self.fails:
            raise self.fails[what]


@dataclass
class Meeting:
    """A client socket and the protocol of its connection, on the transport under test."""

    loop: asyncio.AbstractEventLoop
    epoll_set: EpollSet | None
    reported: list[dict[str, Any]] = field(default_factory=list)
    protocols: list[Recorder] = field(default_factory=list)
    port: int = 0
    prepare: Callable[[Recorder], None] = lambda one: None

    async def dial(self) -> tuple[socket.socket, Recorder]:
        before = len(self.protocols)
        client = socket.socket()
        client.setblocking(False)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65_536)
        await self.loop.sock_connect(client, ("127.0.0.1", self.port))
        await until(lambda: len(self.protocols) > before and self.protocols[-1].heard)
        return client, self.protocols[-1]

    def new_connection(self) -> Recorder:
        one = Recorder()
        self.prepare(one)
        self.protocols.append(one)
        return one


@contextlib.asynccontextmanager
async def meeting(transport: str) -> AsyncIterator[Meeting]:
    loop = asyncio.get_running_loop()
    here = Meeting(loop, None if transport == TRANSPORTS[0] else epoll_set_for(loop))
    loop.set_exception_handler(lambda loop, context: here.reported.append(context))
    with socket.socket() as listening:
        listening.setblocking(False)
        listening.bind(("127.0.0.1", 0))
        here.port = listening.getsockname()[1]
        acceptor = await accept_from(
            listening, here.new_connection, loop=loop, epoll_set=here.epoll_set, backlog=100, failed=pytest.fail
        )
        yield here
        acceptor.close()
        for one in here.protocols:
            if one.transport is not None and not one.lost.is_set():
                one.transport.abort()
        await until(lambda: all(one.lost.is_set() for one in here.protocols))
    if here.epoll_set is not None:
        assert len(here.epoll_set) == 0


def tried(transport: str, test: Callable[[Meeting, socket.socket, Recorder], Any]) -> None:
    """Run a test with one connection."""

    async def main() -> None:
        async with meeting(transport) as here:
            client, protocol = await here.dial()
            with client:
                await test(here, client, protocol)

    run_on(transport.rpartition(" ")[2] if transport in EPOLL_SETS else "asyncio", main)


async def all_from(loop: asyncio.AbstractEventLoop, client: socket.socket, size: int | None = None) -> bytes:
    """What the server sends, until its end or so many bytes."""
    found = bytearray()
    while size is None or len(found) < size:
        data = await loop.sock_recv(client, 1 << 20)
        if not data:
            break
        found += data
    return bytes(found)


# --- bytes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_bytes_come_and_go_and_the_end_is_told_once(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.answer = lambda data: protocol.transport.write(data[::-1])
        for said in (b"abc", b"defg"):
            client.send(said)
            assert await all_from(here.loop, client, len(said)) == said[::-1]
        protocol.transport.writelines([b"one", bytearray(b"two"), memoryview(b"three")])
        assert await all_from(here.loop, client, 11) == b"onetwothree"
        client.close()
        await protocol.lost.wait()
        assert protocol.heard == ["made", "bytes", "end", ("lost", type(None))]
        assert here.reported == []

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_what_the_system_does_not_take_waits_and_leaves_in_order(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        data = bytes(range(256)) * (MUCH // 256)
        transport = protocol.transport
        transport.set_write_buffer_limits(high=100_000)
        transport.write(data)
        assert protocol.heard == ["made", "pause"]
        assert 100_000 < transport.get_write_buffer_size() < MUCH
        transport.write(memoryview(data)[:1000])
        assert await all_from(here.loop, client, MUCH + 1000) == data + data[:1000]
        assert protocol.heard == ["made", "pause", "resume"]
        assert transport.get_write_buffer_size() == 0
        transport.write(b"straight again")
        assert await all_from(here.loop, client, 14) == b"straight again"

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_items_of_a_view_may_be_of_any_width(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        data = bytes(range(256)) * (MUCH // 256)
        protocol.transport.write(memoryview(b"abcd").cast("H"))
        protocol.transport.write(memoryview(data).cast("I"))
        assert await all_from(here.loop, client, 4 + MUCH) == b"abcd" + data

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_what_is_written_while_it_resumes_goes_behind_what_waits(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        def write_more() -> None:
            protocol.heard.append("resume")
            protocol.transport.write(b"more")

        protocol.resume_writing = write_more  # type: ignore[method-assign]
        protocol.transport.write(bytes(MUCH))
        assert await all_from(here.loop, client, MUCH + 4) == bytes(MUCH) + b"more"
        assert protocol.heard == ["made", "pause", "resume"]

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_nothing_is_heard_while_reading_is_paused(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        transport = protocol.transport
        transport.pause_reading()
        assert not transport.is_reading()
        client.send(b"abc")
        for _ in range(10):
            await asyncio.sleep(0)
        assert protocol.received == b""
        transport.resume_reading()
        assert transport.is_reading()
        await until(lambda: protocol.received == b"abc")

    tried(transport, test)


# --- ends -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_closing_sends_what_waits_and_reads_no_more(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.transport.write(bytes(MUCH))
        protocol.transport.close()
        protocol.transport.close()
        assert protocol.transport.is_closing()
        assert not protocol.transport.is_reading()
        assert len(await all_from(here.loop, client, MUCH)) == MUCH
        await protocol.lost.wait()
        if here.epoll_set is not None:  # asyncio's own raises here, after an end that came with the last bytes
            protocol.transport.write(b"goes nowhere")
            protocol.transport.abort()
        for _ in range(3):
            await asyncio.sleep(0)
        assert [one for one in protocol.heard if isinstance(one, tuple)] == [("lost", type(None))]

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("how", ["close", "abort"])
def test_end_that_the_protocol_wishes_is_told_in_a_later_turn(transport: str, how: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.answer = lambda data: getattr(protocol.transport, how)()  # depth is looked at by connection_lost
        client.send(b"!")
        await protocol.lost.wait()
        assert protocol.heard == ["made", "bytes", ("lost", type(None))]
        assert await all_from(here.loop, client) == b""

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_aborting_drops_what_waits(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.transport.write(bytes(MUCH))
        protocol.transport.abort()
        assert protocol.transport.get_write_buffer_size() == 0
        assert protocol.transport.is_closing()
        await protocol.lost.wait()
        with contextlib.suppress(ConnectionError):
            assert len(await all_from(here.loop, client)) < MUCH
        assert protocol.heard == ["made", "pause", ("lost", type(None))]

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("waiting", [False, True])
def test_reset_ends_the_connection_with_its_reason(transport: str, waiting: bool) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        if waiting:
            protocol.transport.write(bytes(MUCH))
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.close()
        await protocol.lost.wait()
        assert [one for one in protocol.heard if isinstance(one, tuple)] == [("lost", ConnectionResetError)]
        assert here.reported == []

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_write_to_a_peer_that_has_gone_ends_the_connection_in_a_later_turn(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.transport.pause_reading()  # nothing but the write can notice
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.close()
        protocol.transport.write(b"!")
        protocol.transport.write(b"!")
        assert not protocol.lost.is_set()
        await protocol.lost.wait()
        assert len([one for one in protocol.heard if isinstance(one, tuple)]) == 1

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_peer_that_sends_no_more_may_still_be_written_to(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.stays_after_the_end = True
        client.send(b"last words")
        client.shutdown(socket.SHUT_WR)
        await until(lambda: "end" in protocol.heard)
        assert protocol.received == b"last words"
        protocol.transport.write(bytes(MUCH))
        assert len(await all_from(here.loop, client, MUCH)) == MUCH
        assert protocol.heard == ["made", "bytes", "end", "pause", "resume"]
        protocol.transport.close()
        assert await all_from(here.loop, client) == b""
        await protocol.lost.wait()

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_end_is_told_once_whatever_is_paused_behind_it(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.stays_after_the_end = True
        client.shutdown(socket.SHUT_WR)
        await until(lambda: "end" in protocol.heard)
        protocol.transport.pause_reading()
        protocol.transport.resume_reading()
        for _ in range(5):
            await asyncio.sleep(0)
        assert protocol.heard == ["made", "end"]

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("size", [3, MUCH])
def test_own_end_goes_behind_what_waits_and_leaves_the_other_direction_open(transport: str, size: int) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        assert protocol.transport.can_write_eof()
        protocol.transport.write(bytes(size))
        protocol.transport.write_eof()
        protocol.transport.write_eof()
        with pytest.raises(RuntimeError):
            protocol.transport.write(b"behind the end")
        assert len(await all_from(here.loop, client)) == size
        client.send(b"still here")
        await until(lambda: protocol.received == b"still here")

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_own_end_behind_that_of_the_connection_is_no_error(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol.transport.pause_reading()
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
        client.close()
        protocol.transport.write_eof()

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_connection_that_nothing_is_wanted_of_is_not_watched(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        assert here.epoll_set is not None
        assert len(here.epoll_set) == 2
        protocol.transport.pause_reading()
        assert len(here.epoll_set) == 1  # the listener: or a peer that goes would keep the loop busy
        protocol.transport.resume_reading()
        assert len(here.epoll_set) == 2

    tried(transport, test)


# --- protocols that fail ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("where", ["get_buffer", "bytes", "end"])
def test_protocol_that_raises_is_reported_and_loses_its_connection_alone(transport: str, where: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        other_client, other = await here.dial()
        with other_client:
            failure = protocol.fails[where] = ZeroDivisionError("a bug")
            client.send(b"!")
            if where == "end":
                client.shutdown(socket.SHUT_WR)
            await protocol.lost.wait()
            assert protocol.heard[-1] == ("lost", ZeroDivisionError)
            assert [one["exception"] for one in here.reported] == [failure]
            other_client.send(b"who else")
            await until(lambda: other.received == b"who else")

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_protocol_that_fails_at_its_beginning_is_reported_and_loses_its_connection(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        failure = ZeroDivisionError("a bug")
        here.prepare = lambda one: one.fails.update(made=failure)
        other_client, other = await here.dial()
        with other_client:
            await other.lost.wait()
            assert [one["exception"] for one in here.reported] == [failure]
            assert await all_from(here.loop, other_client) == b""

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_buffer_without_room_is_a_fault_of_the_protocol_and_no_end(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        protocol._buffer = bytearray()
        client.send(b"!")
        await protocol.lost.wait()
        assert protocol.heard == ["made", ("lost", RuntimeError)]
        assert "empty buffer" in str(here.reported[0]["exception"])

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize("where", ["pause", "resume"])
def test_protocol_that_fails_to_pause_is_reported_and_goes_on(transport: str, where: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        failure = protocol.fails[where] = ZeroDivisionError("a bug")
        protocol.transport.write(bytes(MUCH))
        assert len(await all_from(here.loop, client, MUCH)) == MUCH
        await until(lambda: protocol.heard == ["made", "pause", "resume"])
        assert [one["exception"] for one in here.reported] == [failure]
        assert not protocol.transport.is_closing()

    tried(transport, test)


# --- what it knows ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_transport_knows_its_socket_and_both_addresses(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        transport = protocol.transport
        assert transport.get_extra_info("peername") == client.getsockname()
        assert transport.get_extra_info("sockname") == client.getpeername()
        assert transport.get_extra_info("socket").getpeername() == client.getsockname()
        assert transport.get_extra_info("cipher", "none") == "none"
        assert transport.get_protocol() is protocol

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_limits_of_what_may_wait(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        transport = protocol.transport
        assert transport.get_write_buffer_limits() == (16_384, 65_536)
        for given, limits in (
            ({"high": 1000}, (250, 1000)),
            ({"low": 100}, (100, 400)),
            ({"high": 0}, (0, 0)),
            ({"high": 9, "low": 9}, (9, 9)),
        ):
            transport.set_write_buffer_limits(**given)
            assert transport.get_write_buffer_limits() == limits
        with pytest.raises(ValueError, match="high"):
            transport.set_write_buffer_limits(high=1, low=2)

    tried(transport, test)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_another_protocol_may_take_over(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        after = Recorder()
        after.transport = protocol.transport
        protocol.transport.set_protocol(after)
        client.send(b"hello")
        await until(lambda: after.received == b"hello")
        assert protocol.received == b""
        client.close()
        await after.lost.wait()
        protocol.lost.set()

    tried(transport, test)


@pytest.mark.parametrize("transport", EPOLL_SETS)
def test_what_is_no_bytes_is_refused(transport: str) -> None:
    async def test(here: Meeting, client: socket.socket, protocol: Recorder) -> None:
        for size in (1, MUCH):
            protocol.transport.write(bytes(size))
            with pytest.raises(TypeError):
                protocol.transport.write("text")

    tried(transport, test)


async def test_transport_that_was_not_closed_is_named_when_it_is_collected() -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        stream = EpollStream(EpollSet(asyncio.get_running_loop()), ours, Recorder(), "a peer")
        assert "open" in repr(stream)
        with pytest.warns(ResourceWarning, match="unclosed transport <EpollStream open"):
            del stream  # nothing else holds it
        assert theirs.recv(1) == b""
