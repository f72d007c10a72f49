"""A TCP or TLS listener: its sockets, and the connections that come by them.

Knows sockets and when they stop to accept; knows no request.
"""

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

from ..transport.tcp import SocketParameters
from .connection import ServerConnection
from .connections import ConnectionManagement
from .listener_settings import ListenerSettings
from .naming import bound_name, listening_sockets

TURNS_TO_SETTLE: Final = 4
"""Turns of the loop until a connection that is being accepted stands, and until one that was closed has gone."""


class TcpListener:
    """One endpoint, on a socket for each of its addresses.

    Attributes:
        management: of its connections.
        names: URLs as they are bound.
    """

    def __init__(self, management: ConnectionManagement, settings: ListenerSettings, sockets: SocketParameters) -> None:
        self.management = management
        self.names: list[str] = []
        self._settings = settings
        self._sockets = sockets
        self._servers: list[asyncio.Server] = []

    async def open(self) -> None:
        """Listen. Raises `OSError` or `ConfigError`; then nothing is open."""
        settings, loop = self._settings, self.management.loop
        bound = await listening_sockets(loop, settings)
        with contextlib.ExitStack() as undo:
            for one in bound:
                undo.callback(one.close)
            protocols = self._protocols()
            for one in bound:
                self._sockets.apply_buffers(one)
                made = await loop.create_server(protocols, sock=one, backlog=settings.limits.backlog)
                self._servers.append(made)
                undo.callback(made.close)
            undo.pop_all()
        self.names = [bound_name(settings.endpoint.scheme, one) for one in bound]
        reception = self.management.reception
        reception.listener = self.names[0]
        reception.hosts = tuple(str(one.getsockname()[0]) for one in bound)
        reception.diagnosis.is_open = True

    def _protocols(self) -> Callable[[], asyncio.BaseProtocol]:
        """What makes the protocol of each newcomer: over TLS, a gate that lets it in after the handshake."""
        management = self.management
        if self._settings.tls is None:
            return lambda: ServerConnection(management)
        from .secure import gate

        return gate(management, self._settings.tls)

    def accept_no_more(self) -> None:
        """Take no newcomer. Those that are being accepted arrive within `settle`.

        asyncio forgets a connection whose acceptance has begun when its listener is closed: it would stay open, in
        nobody's hands, until the garbage collection finds it.
        """
        for server in self._servers:
            for bound in server.sockets:
                with contextlib.suppress(NotImplementedError):  # loops that do not accept by readiness
                    self.management.loop.remove_reader(bound.fileno())

    def close(self) -> None:
        """Close the listener, and the connections after what is written has gone out."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        if self.management.gate is not None:
            self.management.gate.close()
        self.management.reception.diagnosis.is_open = False
        self.management.close_all()


async def settle() -> None:
    """Let what has begun in the event loop come to its end."""
    for _ in range(TURNS_TO_SETTLE):
        await asyncio.sleep(0)
