"""Acceptors take new connections from a listening socket: through an `EpollSet`, or by the event loop's own server.

Knows sockets that listen, and how their connections begin; knows no Modbus.

1. In one turn of the event loop only a limited number of connections is accepted, so that open ones are served too.
2. If the system lacks resources for another connection (file handles, memory), it still reports waiting clients. Then
   nothing is accepted for a second; open connections are not affected.
3. A connection is accepted in one call, from the socket to its protocol, so it always has an owner that closes it.
"""

import asyncio
import contextlib
import socket
from collections.abc import Callable
from typing import Final, Protocol

from .epoll.stream import EpollStream
from .epoll.watcher import READABLE, EpollSet

ACCEPTED_PER_TURN: Final = 64
PAUSE_SECONDS: Final = 1.0
"""Seconds until accepting is tried again after an error, as in asyncio: by then resources may be free."""

Protocols = Callable[[], asyncio.BaseProtocol]


class Acceptor(Protocol):
    """Interface of the object that accepts connections from one listening socket, and owns that socket."""

    def accept_no_more(self) -> None:
        """Stop accepting connections; the socket stays bound."""

    def close(self) -> None:
        """Close the listening socket. Accepted connections stay open."""


async def accept_from(
    listening: socket.socket,
    protocols: Protocols,
    *,
    loop: asyncio.AbstractEventLoop,
    epoll_set: EpollSet | None,
    backlog: int,
    failed: Callable[[OSError], None],
) -> Acceptor:
    """Start to accept connections, each with a new transport and protocol. Returns the acceptor.

    Args:
        listening: bound, non-blocking socket; the acceptor closes it.
        protocols: creates the protocol of a new connection: a buffered one, or one that replaces itself by a buffered
            one in `connection_made`.
        loop: the event loop.
        epoll_set: watches the listening socket and the connections; None to let the event loop do that.
        backlog: connections that the system may hold until they are accepted.
        failed: called with the error if a waiting client cannot be accepted; then nothing is accepted for a second.
            Without an epoll set the event loop logs the error instead.

    Raises:
        OSError: the socket cannot listen, or cannot be watched.
    """
    if epoll_set is not None:
        return EpollAcceptor(epoll_set, listening, protocols, backlog=backlog, failed=failed)
    return LoopAcceptor(loop, await loop.create_server(protocols, sock=listening, backlog=backlog))


class EpollAcceptor:
    """Accepts connections through an epoll set; arguments and errors of its creation are those of `accept_from`."""

    def __init__(
        self,
        epoll_set: EpollSet,
        listening: socket.socket,
        protocols: Protocols,
        *,
        backlog: int,
        failed: Callable[[OSError], None],
    ) -> None:
        self._epoll_set = epoll_set
        self._listening = listening
        self._protocols = protocols
        self._failed = failed
        self._descriptor = listening.fileno()
        self._timer: asyncio.TimerHandle | None = None
        self._is_watched = False
        listening.listen(backlog)
        self._watch()

    def ready(self, events: int) -> None:
        """Accept clients that wait at the listening socket, at most `ACCEPTED_PER_TURN`; the rest in later turns."""
        for _ in range(ACCEPTED_PER_TURN):
            if not (self._is_watched and self._accept()):
                return

    def _accept(self) -> bool:
        """Accept one client at the listening socket. Returns False if none waits or accepting had to be paused."""
        try:
            connection, peer = self._listening.accept()
        except (BlockingIOError, InterruptedError):
            return False
        except ConnectionAbortedError:
            return True  # gone before it was taken
        except OSError as error:
            self._pause(error)
            return False
        connection.setblocking(False)
        try:
            protocol = self._protocols()
        except Exception as error:
            connection.close()
            context = {"message": "no protocol for a connection that was accepted", "exception": error}
            self._epoll_set.loop.call_exception_handler(context)
            return True
        try:
            EpollStream(self._epoll_set, connection, protocol, peer).begin()
        except OSError as error:
            self._pause(error)
            return False
        return True

    def accept_no_more(self) -> None:
        """Stop accepting connections; the socket stays bound."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._unwatch()

    def close(self) -> None:
        """Close the listening socket. Accepted connections stay open."""
        self.accept_no_more()
        self._listening.close()

    def _pause(self, error: OSError) -> None:
        self._unwatch()
        self._timer = self._epoll_set.loop.call_later(PAUSE_SECONDS, self._go_on)
        self._failed(error)

    def _go_on(self) -> None:
        self._timer = None
        try:
            self._watch()
        except OSError as error:
            self._pause(error)

    def _watch(self) -> None:
        self._epoll_set.watch(self._descriptor, READABLE, self)
        self._is_watched = True

    def _unwatch(self) -> None:
        if self._is_watched:
            self._is_watched = False
            self._epoll_set.forget(self._descriptor)


class LoopAcceptor:
    """Accepts connections through the event loop's own server, where there is no epoll."""

    def __init__(self, loop: asyncio.AbstractEventLoop, server: asyncio.Server) -> None:
        self._loop = loop
        self._server = server

    def accept_no_more(self) -> None:
        """Stop accepting connections; those just accepted still arrive within a few turns of the event loop.

        Call `close` only after these turns: asyncio would forget connections that it is just accepting, and they would
        stay open without an owner until garbage collection.
        """
        for bound in self._server.sockets:
            with contextlib.suppress(NotImplementedError):  # loops that do not accept by readiness
                self._loop.remove_reader(bound.fileno())

    def close(self) -> None:
        """Close the listening socket. Accepted connections stay open."""
        self._server.close()
