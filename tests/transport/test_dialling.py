"""Connections that are opened here: how an address is found, what they wait in, and what becomes of those that fail."""

import asyncio
import errno
import gc
import select
import socket
import weakref
from collections.abc import Iterator
from typing import Any

import pytest
from event_loops import LOOPS, run_on
from waiting import until

from busway.transport import dialling
from busway.transport.epoll.stream import EpollStream

CROWDED = pytest.mark.skipif(not hasattr(select, "epoll"), reason="this system has no epoll objects")


class Listener(asyncio.BufferedProtocol):
    """Keeps what comes."""

    def __init__(self) -> None:
        self.buffer = bytearray(100)
        self.received = b""
        self.lost: list[Exception | None] = []

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.received += self.buffer[:nbytes]

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.append(exc)


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


async def opened(server: socket.socket, host: str = "127.0.0.1", **options: Any) -> tuple[asyncio.Transport, Listener]:
    protocol = Listener()
    wanted: dict[str, Any] = {"local_address": None, "interface": None, "prepare": lambda connection: None, **options}
    return await dialling.open_stream(lambda: protocol, host, server.getsockname()[1], **wanted), protocol


@pytest.mark.parametrize("name", LOOPS)
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_a_connection_carries_bytes_both_ways(listening: socket.socket, name: str, host: str) -> None:
    async def main() -> None:
        transport, protocol = await opened(listening, host)
        far, _ = listening.accept()
        with far:
            transport.write(b"ask")
            assert far.recv(10) == b"ask"
            far.sendall(b"answer")
            await until(lambda: protocol.received == b"answer")
        await until(lambda: protocol.lost == [None])

    run_on(name, main)


@CROWDED
@pytest.mark.parametrize("name", LOOPS)
def test_connections_of_a_loop_wait_together(listening: socket.socket, name: str) -> None:
    async def main() -> None:
        streams = [(await opened(listening))[0] for _ in range(3)]
        assert all(isinstance(one, EpollStream) for one in streams)
        (epoll_set,) = {one._epoll_set for one in streams if isinstance(one, EpollStream)}
        assert len(epoll_set) == 3
        for one in streams:
            one.close()
        await until(lambda: len(epoll_set) == 0)

    run_on(name, main)


@CROWDED
def test_a_loop_is_kept_no_longer_than_its_connections(listening: socket.socket) -> None:
    kept: list[weakref.ref[asyncio.AbstractEventLoop]] = []

    async def main() -> None:
        kept.append(weakref.ref(asyncio.get_running_loop()))
        transport, protocol = await opened(listening)
        transport.close()
        await until(lambda: bool(protocol.lost))

    run_on("asyncio", main)
    gc.collect()
    assert kept[0]() is None


@pytest.mark.parametrize("waits_together", [pytest.param(True, marks=CROWDED), False])
def test_the_socket_is_prepared_once_it_is_connected_and_a_peer_that_has_gone_is_no_matter(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch, waits_together: bool
) -> None:
    monkeypatch.setattr(dialling, "can_watch", lambda loop: waits_together)
    prepared: list[Any] = []

    def prepare(connection: socket.socket) -> None:
        prepared.append(connection.getpeername())
        raise OSError("gone")

    async def main() -> None:
        transport, protocol = await opened(listening, prepare=prepare)
        assert prepared == [listening.getsockname()]
        transport.close()
        await until(lambda: bool(protocol.lost))

    run_on("asyncio", main)


def test_it_leaves_from_the_address_that_is_named(listening: socket.socket) -> None:
    async def main() -> None:
        transport, protocol = await opened(listening, local_address="127.0.0.9")
        far, address = listening.accept()
        far.close()
        assert address[0] == "127.0.0.9"
        await until(lambda: bool(protocol.lost))
        transport.close()

    run_on("asyncio", main)


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_without_a_listener_the_reason_is_the_last_one(host: str) -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as server:
            free = server.getsockname()
            server.close()
            with pytest.raises(ConnectionRefusedError):
                await dialling.open_stream(
                    Listener, host, free[1], local_address=None, interface=None, prepare=lambda connection: None
                )

    run_on("asyncio", main)


@CROWDED
@pytest.mark.parametrize("name", LOOPS)
def test_zone_of_a_link_local_address_reaches_the_system(listening: socket.socket, name: str) -> None:
    async def main() -> None:
        # Which error it is depends on the system; where the zone was lost, it is this one.
        with pytest.raises(OSError, match=rf"Errno (?!{errno.EINVAL}\b)"):
            await opened(listening, "fe80::1%lo")

    run_on(name, main)


@CROWDED
def test_address_of_a_family_that_the_system_does_not_have_is_left_out(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = listening.getsockname()
    missing = (255, socket.SOCK_STREAM, 0, "", ("::1", address[1], 0, 0))
    found: list[tuple[Any, ...]] = [missing, (socket.AF_INET, socket.SOCK_STREAM, 0, "", address)]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *asked, **also: found)

    async def main() -> None:
        transport, protocol = await opened(listening)
        transport.close()
        await until(lambda: bool(protocol.lost))
        found[:] = [missing]
        with pytest.raises(OSError, match=f"Errno {errno.EAFNOSUPPORT}"):
            await opened(listening)

    run_on("asyncio", main)


@CROWDED
def test_a_cancelled_connect_leaves_no_socket_behind(listening: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        begun: list[socket.socket] = []

        async def never(connection: socket.socket, address: object) -> None:
            begun.append(connection)
            await asyncio.Event().wait()

        monkeypatch.setattr(loop, "sock_connect", never)
        task = asyncio.create_task(opened(listening))
        await until(lambda: bool(begun))
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert begun[0].fileno() == -1

    run_on("asyncio", main)


@pytest.mark.parametrize("waits_together", [pytest.param(True, marks=CROWDED), False])
def test_protocol_that_cannot_be_made_leaves_no_connection_behind(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch, waits_together: bool
) -> None:
    monkeypatch.setattr(dialling, "can_watch", lambda loop: waits_together)

    def fails() -> asyncio.BaseProtocol:
        raise RuntimeError("no memory left")

    async def main() -> None:
        port = listening.getsockname()[1]
        with pytest.raises(RuntimeError, match="no memory"):
            await dialling.open_stream(
                fails, "127.0.0.1", port, local_address=None, interface=None, prepare=lambda connection: None
            )

    run_on("asyncio", main)
    listening.setblocking(False)
    with pytest.raises(BlockingIOError):
        listening.accept()


@pytest.mark.parametrize("interface", [None, "lo"])
def test_a_loop_that_can_have_no_epoll_set_uses_its_own_transports(
    listening: socket.socket, monkeypatch: pytest.MonkeyPatch, interface: str | None
) -> None:
    monkeypatch.setattr(dialling, "can_watch", lambda loop: False)

    async def main() -> None:
        try:
            transport, protocol = await opened(listening, interface=interface)
        except PermissionError:
            return  # naming an interface needs rights on some systems
        assert not isinstance(transport, EpollStream)
        transport.close()
        await until(lambda: bool(protocol.lost))

    run_on("asyncio", main)
