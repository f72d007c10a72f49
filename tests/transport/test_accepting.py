"""Taking connections from a listening socket: how many at once, what stops it, and what is left when it ends."""

import asyncio
import errno
import select
import socket
from collections.abc import Callable
from typing import Any

import pytest
from event_loops import LOOPS, run_on
from handles import settled_handles
from waiting import until

from busway.transport import accepting
from busway.transport.accepting import ACCEPTED_PER_TURN, EpollAcceptor, accept_from
from busway.transport.epoll.watcher import READABLE, EpollSet, epoll_set_for

pytestmark = pytest.mark.skipif(not hasattr(select, "epoll"), reason="this system has no epoll objects")


class AcceptedProtocol(asyncio.BufferedProtocol):
    """A connection that only stands."""

    def __init__(self) -> None:
        self.transport: Any = None
        self.ended = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def connection_lost(self, exc: Exception | None) -> None:
        self.ended = True


class AcceptedProtocols(list[AcceptedProtocol]):
    """Those that have come; called, it makes the next one."""

    def __call__(self) -> AcceptedProtocol:
        self.append(AcceptedProtocol())
        return self[-1]

    async def leave(self) -> None:
        for one in self:
            if one.transport is not None:
                one.transport.abort()
        await until(lambda: all(one.ended for one in self if one.transport is not None))


class Listening(socket.socket):
    """A listening socket that fails with what stands in ``failures`` before it accepts."""

    failures: list[OSError]

    def accept(self) -> tuple[socket.socket, Any]:
        if self.failures:
            raise self.failures.pop(0)
        return super().accept()


def listening(*failures: OSError) -> Listening:
    made = Listening()
    made.failures = list(failures)
    made.setblocking(False)
    made.bind(("127.0.0.1", 0))
    return made


def acceptor_of(
    epoll_set: EpollSet, bound: socket.socket, accepted_protocols: Callable[[], AcceptedProtocol], failed: list[OSError]
) -> EpollAcceptor:
    return EpollAcceptor(epoll_set, bound, accepted_protocols, backlog=1000, failed=failed.append)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("with_epoll_set", [False, True])
def test_new_connections_are_taken_until_no_more_are_wanted_and_then_wait(loop: str, with_epoll_set: bool) -> None:
    async def main() -> None:
        running, accepted_protocols = asyncio.get_running_loop(), AcceptedProtocols()
        bound = listening()
        acceptor = await accept_from(
            bound,
            accepted_protocols,
            loop=running,
            epoll_set=epoll_set_for(running) if with_epoll_set else None,
            backlog=100,
            failed=pytest.fail,
        )
        address = bound.getsockname()
        with socket.create_connection(address), socket.create_connection(address):
            await until(lambda: len(accepted_protocols) == 2 and all(one.transport for one in accepted_protocols))
            if loop == "uvloop" and not with_epoll_set:
                await accepted_protocols.leave()  # its servers accept by other means than readiness
                acceptor.close()
                return
            acceptor.accept_no_more()
            with socket.create_connection(address) as late:
                for _ in range(10):
                    await asyncio.sleep(0)
                assert len(accepted_protocols) == 2
                await accepted_protocols.leave()
                acceptor.close()
                with pytest.raises(ConnectionError):
                    late.recv(1)

    run_on(loop, main)


async def test_one_turn_takes_so_many_and_leaves_the_rest_to_the_next() -> None:
    epoll_set, accepted_protocols = EpollSet(asyncio.get_running_loop()), AcceptedProtocols()
    bound = listening()
    acceptor = acceptor_of(epoll_set, bound, accepted_protocols, [])
    clients = [socket.create_connection(bound.getsockname()) for _ in range(ACCEPTED_PER_TURN + 3)]
    acceptor.ready(READABLE)
    assert len(accepted_protocols) == ACCEPTED_PER_TURN
    acceptor.ready(READABLE)
    assert len(accepted_protocols) == ACCEPTED_PER_TURN + 3
    acceptor.close()
    await accepted_protocols.leave()
    for client in clients:
        client.close()


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM, errno.EPROTO])
async def test_system_that_has_nothing_left_is_asked_again_after_a_pause(
    number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accepting, "PAUSE_SECONDS", 0.01)
    epoll_set, accepted_protocols = EpollSet(asyncio.get_running_loop()), AcceptedProtocols()
    failures: list[OSError] = []
    bound = listening(OSError(number, "nothing left"), OSError(number, "nothing left"))
    acceptor = acceptor_of(epoll_set, bound, accepted_protocols, failures)
    with socket.create_connection(bound.getsockname()):
        await until(lambda: failures)
        assert len(epoll_set) == 0  # or the loop would turn without an end
        await until(lambda: accepted_protocols)
        assert [one.errno for one in failures] == [number, number]
        acceptor.close()
        await accepted_protocols.leave()


async def test_acceptor_that_is_closed_in_its_pause_stays_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(accepting, "PAUSE_SECONDS", 0.0)
    epoll_set, failures = EpollSet(asyncio.get_running_loop()), list[OSError]()
    bound = listening(OSError(errno.EMFILE, "nothing left"))
    acceptor = acceptor_of(epoll_set, bound, AcceptedProtocols(), failures)
    with socket.create_connection(bound.getsockname()):
        acceptor.ready(READABLE)
        acceptor.close()
        for _ in range(5):
            await asyncio.sleep(0)
        assert (len(failures), len(epoll_set)) == (1, 0)


async def test_client_that_has_gone_before_it_was_taken_does_not_stop_the_next() -> None:
    epoll_set, accepted_protocols = EpollSet(asyncio.get_running_loop()), AcceptedProtocols()
    bound = listening(ConnectionAbortedError())
    acceptor = acceptor_of(epoll_set, bound, accepted_protocols, [])
    with socket.create_connection(bound.getsockname()):
        acceptor.ready(READABLE)
        assert len(accepted_protocols) == 1
        acceptor.close()
        await accepted_protocols.leave()


async def test_new_connection_for_whom_no_protocol_can_be_made_is_closed_and_reported() -> None:
    loop = asyncio.get_running_loop()
    reported: list[dict[str, Any]] = []
    loop.set_exception_handler(lambda loop, context: reported.append(context))
    failure = ZeroDivisionError("a bug")

    def make() -> AcceptedProtocol:
        raise failure

    bound = listening()
    acceptor = acceptor_of(EpollSet(loop), bound, make, [])
    with socket.create_connection(bound.getsockname()) as client:
        acceptor.ready(READABLE)
        assert client.recv(1) == b""
    acceptor.close()
    assert [one["exception"] for one in reported] == [failure]


class Full(EpollSet):
    """Watches the listening socket alone."""

    def watch(self, descriptor: int, events: int, member: object) -> None:
        if not isinstance(member, EpollAcceptor):
            raise OSError(errno.ENOSPC, "no room for another descriptor")
        super().watch(descriptor, events, member)


async def test_new_connection_that_cannot_be_watched_is_closed_and_counts_as_a_lack_of_means() -> None:
    loop, accepted_protocols = asyncio.get_running_loop(), AcceptedProtocols()
    failures: list[OSError] = []
    bound = listening()
    acceptor = acceptor_of(Full(loop), bound, accepted_protocols, failures)
    with socket.create_connection(bound.getsockname()) as client:
        acceptor.ready(READABLE)
        await until(lambda: accepted_protocols[0].ended)
        assert client.recv(1) == b""
    assert [one.errno for one in failures] == [errno.ENOSPC]
    acceptor.close()


async def test_acceptor_and_its_connections_leave_no_descriptor_behind() -> None:
    before = settled_handles()
    epoll_set, accepted_protocols = EpollSet(asyncio.get_running_loop()), AcceptedProtocols()
    bound = listening()
    acceptor = acceptor_of(epoll_set, bound, accepted_protocols, [])
    with socket.create_connection(bound.getsockname()):
        await until(lambda: accepted_protocols)
        acceptor.close()
        assert len(epoll_set) == 1  # connections stay when their listener is closed
        await accepted_protocols.leave()
        assert len(epoll_set) == 0
    assert settled_handles() == before
