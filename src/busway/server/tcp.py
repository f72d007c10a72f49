"""A TCP or TLS listener: its listening sockets and the connections they accept.

Knows sockets and when they stop accepting connections; knows no request.
"""

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from typing import Final

from ..options.sockets import SocketParameters
from ..transport.accepting import Acceptor, accept_from
from ..transport.epoll.watcher import EpollSet
from ..transport.tcp import network_reason, set_buffers
from .bound_sockets import bound_name, listening_sockets
from .connection import ServerConnection
from .connection_management import ConnectionManagement
from .listener_settings import ListenerSettings

TURNS_TO_SETTLE: Final = 4
"""Turns of the event loop after which a connection being accepted is open, and a closed one has been removed."""


class TcpListener:
    """One TCP or TLS endpoint of a server, with a listening socket for each of its addresses.

    Args:
        management: the management of its connections.
        settings: the settings of the listener, with its endpoint.
        sockets: parameters of its sockets.
        epoll_set: epoll object that its sockets and connections use; None leaves them to the event loop.

    Attributes:
        management: the management of its connections.
        names: URLs with the addresses and ports that are really bound.
    """

    def __init__(
        self,
        management: ConnectionManagement,
        settings: ListenerSettings,
        sockets: SocketParameters,
        epoll_set: EpollSet | None = None,
    ) -> None:
        self.management = management
        self.names: list[str] = []
        self._settings = settings
        self._sockets = sockets
        self._epoll_set = epoll_set
        self._acceptors: list[Acceptor] = []

    async def open(self) -> None:
        """Start listening on all addresses. Raises `OSError` or `ConfigError`; then nothing is open."""
        settings, loop = self._settings, self.management.loop
        bound = await listening_sockets(loop, settings)
        with contextlib.ExitStack() as undo:
            for one in bound:
                undo.callback(one.close)
            protocols = self._protocols()
            for one in bound:
                set_buffers(one, self._sockets)
                made = await accept_from(
                    one,
                    protocols,
                    loop=loop,
                    epoll_set=self._epoll_set,
                    backlog=settings.limits.backlog,
                    failed=self._cannot_accept,
                )
                self._acceptors.append(made)
                undo.callback(made.close)
            undo.pop_all()
        self.names = [bound_name(settings.endpoint.scheme, one) for one in bound]
        listener_context = self.management.listener_context
        listener_context.bound_as(self.names)
        listener_context.hosts = tuple(str(one.getsockname()[0]) for one in bound)
        listener_context.diagnosis.is_open = True

    def _protocols(self) -> Callable[[], asyncio.BaseProtocol]:
        """Return the function that creates the asyncio protocol of each new connection; over TLS, of its handshake."""
        management = self.management
        if self._settings.tls is None:
            return lambda: ServerConnection(management)
        from .tls_acceptor import handshake_acceptor

        return handshake_acceptor(management, self._settings.tls)

    def _cannot_accept(self, error: OSError) -> None:
        """Log that a client waits but the system has no resources for another connection."""
        listener_context = self.management.listener_context
        listener_context.diagnosis.internal_fault = time.monotonic()
        sentence = "%s: no client can be accepted for now: %s"
        listener_context.say(logging.ERROR, "", sentence, listener_context.listener, network_reason(error))

    def accept_no_more(self) -> None:
        """Accept no more connections; the sockets stay bound.

        Clients still in the system's queue are not accepted. Connections that were just accepted reach the listener
        until `settle` has ended.
        """
        for acceptor in self._acceptors:
            acceptor.accept_no_more()

    def close(self) -> None:
        """Close the listener, and each connection after its written replies were sent."""
        for acceptor in self._acceptors:
            acceptor.close()
        self._acceptors.clear()
        if self.management.handshake_acceptor is not None:
            self.management.handshake_acceptor.close()
        self.management.listener_context.diagnosis.is_open = False
        self.management.close_all()


async def settle() -> None:
    """Let the event loop run a few times, so that connections just accepted have reached their listener."""
    for _ in range(TURNS_TO_SETTLE):
        await asyncio.sleep(0)
