"""A listener and the connections that wait with it in one place: on both event loops, and at the end of the means."""

import asyncio
import contextlib
import os
import resource
import select
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from event_loops import LOOPS, run_on
from handles import settled_handles
from waiting import until

import busway
from busway.server.status_indicators import StatusIndicator
from busway.transport import accepting
from busway.transport.epoll.watcher import EpollSet

pytestmark = pytest.mark.skipif(not hasattr(select, "epoll"), reason="this system has no epoll objects")

ANY_PORT = "tcp://127.0.0.1:0"
QUESTION = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
ANSWER = bytes.fromhex("0001 0000 0005 01 03 02 0000")


def served(*endpoints: str) -> busway.Server:
    return busway.serve(*endpoints, units=busway.Device(holding_registers=100))


def address_of(server: busway.Server, index: int = 0) -> tuple[str, int]:
    parts = urlsplit(server.endpoints[index])
    assert parts.hostname is not None
    assert parts.port is not None
    return parts.hostname, parts.port


@contextlib.contextmanager
def no_descriptor_left() -> Iterator[None]:
    """This process may open nothing more within."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken = [os.dup(0)]
    try:
        # All numbers below the greatest that is in use are taken, and no greater one is allowed.
        resource.setrlimit(resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 1, limits[1]))
        with contextlib.suppress(OSError):
            while True:
                taken.append(os.dup(0))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        for one in taken:
            os.close(one)


@pytest.mark.parametrize("loop", LOOPS)
def test_all_listeners_of_a_server_and_their_connections_wait_in_one_place(
    loop: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[EpollSet] = []
    monkeypatch.setattr("busway.server.opening.epoll_set_for", lambda loop: made.append(EpollSet(loop)) or made[-1])

    async def live(server: busway.Server) -> None:
        async with server:
            epoll_set = made[-1]
            assert len(epoll_set) == 2
            async with busway.open(server.endpoints[0]) as one, busway.open(server.endpoints[1]) as other:
                for link in (one, other):
                    assert await link.unit(1).read_holding_registers(0, count=3) == [0, 0, 0]
                assert len(epoll_set) == 4
            await until(lambda: len(epoll_set) == 2)
        assert len(epoll_set) == 0

    async def main() -> None:
        server = served(ANY_PORT, ANY_PORT)
        await live(server)  # what a loop opens once for itself is open now
        before = settled_handles()
        await live(server)
        assert settled_handles() == before

    run_on(loop, main)


async def test_server_without_descriptors_says_so_serves_on_and_takes_who_waits_when_there_are_some(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(accepting, "PAUSE_SECONDS", 0.01)
    loop = asyncio.get_running_loop()
    async with served(ANY_PORT) as server:
        with socket.create_connection(address_of(server)) as early, socket.socket() as late:
            await until(lambda: server.counters.accepted == 1)
            early.setblocking(False)
            late.setblocking(False)
            with no_descriptor_left():
                await loop.sock_connect(late, address_of(server))
                await until(
                    lambda: "no client can be accepted for now: this process has no file handles left" in caplog.text
                )
                early.send(QUESTION)
                assert await loop.sock_recv(early, 100) == ANSWER
                assert server.counters.accepted == 1
            late.send(QUESTION)
            assert await loop.sock_recv(late, 100) == ANSWER
            assert server.counters.accepted == 2
            assert server.status().listeners[0].indicators.error is StatusIndicator.ON


async def test_many_clients_that_ask_all_the_time_leave_the_loop_to_others_as_well() -> None:
    loop = asyncio.get_running_loop()
    async with served(ANY_PORT) as server:
        clients = [socket.create_connection(address_of(server)) for _ in range(50)]
        await until(lambda: server.counters.accepted == len(clients))
        for client in clients:
            client.setblocking(False)
        turns = 0
        timed = asyncio.Event()
        loop.call_later(0.05, timed.set)
        while not timed.is_set():
            for client in clients:
                with contextlib.suppress(BlockingIOError):
                    client.recv(4096)
                client.send(QUESTION)
            await asyncio.sleep(0)
            turns += 1
        assert turns > 1
        assert server.status().counters.requests >= turns
        for client in clients:
            client.close()


async def test_no_connection_made_in_the_moment_of_the_end_stays_open() -> None:
    before = settled_handles()
    server = served(ANY_PORT)
    await server.start()
    clients = [socket.create_connection(address_of(server)) for _ in range(10)]
    await server.stop()
    for client in clients:
        with contextlib.suppress(ConnectionError):
            assert client.recv(1) == b""
        client.close()
    assert settled_handles() == before
