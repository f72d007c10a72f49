"""How a link gets its connection: the seam between links and transports.

Knows which transport an endpoint needs; knows no conversation.
"""

import contextlib
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from ..config.endpoints import Endpoint
from ..errors import ConfigError
from ..transport.tcp import SocketParameters, link_down

if TYPE_CHECKING:
    import asyncio


class Connector(Protocol):
    """Makes connections to one endpoint."""

    async def connect(self, protocol: Callable[[], "asyncio.BaseProtocol"]) -> Any:  # an asyncio.Transport, or alike
        """A transport with ``protocol`` behind it. Raises `LinkDown`."""

    def dial(self) -> socket.socket:
        """A connected, non-blocking socket for a blocking link. Raises `LinkDown`."""


class TcpConnector:
    """TCP, by the parameters of T19 (Messaging on TCP/IP V1.0b §4.3.2)."""

    def __init__(self, endpoint: Endpoint, sockets: SocketParameters) -> None:
        self._endpoint = endpoint
        self._sockets = sockets
        self._host = endpoint.host or "127.0.0.1"
        # The port of a client is the system's choice (above 1024): a fixed one meets the half-open past of itself.
        self._local = (sockets.local_address, 0) if sockets.local_address else None

    async def connect(self, protocol: Callable[[], "asyncio.BaseProtocol"]) -> Any:
        """A connected transport. Raises `LinkDown`."""
        import asyncio  # here: blocking programs, and every start of the command line, do without it

        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(self._sockets.connect_timeout):
                transport, _ = await loop.create_connection(
                    protocol, self._host, self._endpoint.port or 0, local_addr=self._local
                )
        except (OSError, ValueError) as error:
            raise link_down(error, endpoint=self._endpoint.url) from error
        self._sockets.apply(transport.get_extra_info("socket"))
        return transport

    def dial(self) -> socket.socket:
        """A connected, non-blocking socket. Raises `LinkDown`."""
        try:
            connection = socket.create_connection(
                (self._host, self._endpoint.port or 0), self._sockets.connect_timeout, self._local
            )
        except (OSError, ValueError) as error:
            raise link_down(error, endpoint=self._endpoint.url) from error
        with contextlib.suppress(OSError):  # a peer that is gone already says so at the first read
            self._sockets.apply(connection)
        connection.setblocking(False)
        return connection


def connector_for(endpoint: Endpoint, sockets: SocketParameters) -> Connector:
    """The connector of an endpoint. Raises `ConfigError` for a carrier that a client can not use."""
    if endpoint.scheme == "tcp":
        return TcpConnector(endpoint, sockets)
    raise ConfigError(f"{endpoint}: a client can not use {endpoint.scheme}:// yet")
