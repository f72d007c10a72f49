"""Connectors: objects that open the connections of a link, over TCP, UDP, TLS or a serial port.

Knows the transports; passes the session on to them.
"""

import contextlib
import socket
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import ConfigError, LinkDown
from ..framing.datagram import WHOLE
from ..options.endpoints import Endpoint
from ..options.sockets import SocketParameters
from ..session.serial_client import SerialClientSession
from ..session.tcp_client import TcpClientSession
from ..transport.local_end import connect_failure
from ..transport.tcp import configure
from .channel import Channel, LinkEnd
from .settings import LinkSettings

if TYPE_CHECKING:
    import asyncio


class Connector(Protocol):
    """Interface of the object that opens the connections of a link to one endpoint."""

    async def connect(self, protocol: Callable[[], Any]) -> Any:  # an asyncio.Transport with its protocol, or alike
        """Open a connection for an asyncio link and return its transport. Raises `LinkDown`.

        ``protocol`` is called once, and returns the object that gets the events of the transport.
        """

    def dial(self) -> Channel:
        """Open a connection for a blocking link and return its non-blocking socket or port. Raises `LinkDown`."""

    def release(self) -> None:
        """Free what the connector holds, such as a serial port; called when the link is closed for good."""


class TcpConnector:
    """Opens the TCP connections of a link, and sets their socket options (Messaging on TCP/IP V1.0b §4.3.2).

    Args:
        endpoint: host and port of the server.
        sockets: options of each connection, with its local address and the time allowed to connect.
        interface: name of the network interface that the connections must use; None leaves it to the system.
    """

    def __init__(self, endpoint: Endpoint, sockets: SocketParameters, *, interface: str | None = None) -> None:
        self._endpoint = endpoint
        self._sockets = sockets
        self._interface = interface
        self._host = endpoint.host
        # The port of a client is the system's choice (above 1024): a fixed one meets the half-open past of itself.
        self._local = (sockets.local_address, 0) if sockets.local_address else None

    async def connect(self, protocol: Callable[[], "asyncio.BaseProtocol"]) -> Any:
        """Open a TCP connection for an asyncio link and return its transport. Raises `LinkDown`.

        ``protocol`` is called once, and returns the object that gets the events of the transport.
        """
        import asyncio  # here: blocking programs, and every start of the command line, do without it

        from ..transport.dialling import open_stream

        try:
            async with asyncio.timeout(self._sockets.connect_timeout):
                transport = await open_stream(
                    protocol,
                    self._host,
                    self._endpoint.port or 0,
                    local_address=self._sockets.local_address,
                    interface=self._interface,
                    prepare=lambda connection: configure(connection, self._sockets),
                )
        except (OSError, ValueError) as error:
            raise self._failure(error) from error
        return transport

    def dial(self) -> socket.socket:
        """Open a TCP connection and return its non-blocking socket. Raises `LinkDown`."""
        try:
            if self._interface is not None:
                from ..transport.dialling import dial_through

                connection = dial_through(
                    self._interface,
                    self._host,
                    self._endpoint.port or 0,
                    self._sockets.local_address,
                    self._sockets.connect_timeout,
                )
            else:
                # As bytes: for a text the standard library loads its tables of international names, 4 ms.
                host: Any = self._host.encode() if self._host.isascii() else self._host  # either; its types know one
                connection = socket.create_connection(
                    (host, self._endpoint.port or 0), self._sockets.connect_timeout, self._local
                )
        except (OSError, ValueError) as error:
            raise self._failure(error) from error
        with contextlib.suppress(OSError):  # a peer that is gone already says so at the first read
            configure(connection, self._sockets)
        connection.setblocking(False)
        return connection

    def release(self) -> None:
        """Do nothing: a TCP connector holds no resources."""

    def _failure(self, error: BaseException) -> LinkDown:
        return connect_failure(
            error,
            endpoint=self._endpoint.url,
            host=self._host,
            local_address=self._sockets.local_address,
            interface=self._interface,
        )


class UdpConnector:
    """Opens the UDP sockets of a link; each frame is one datagram.

    Received datagrams that are not one whole frame are dropped, and counted as damaged frames in the counters of
    ``session``, the session of the link.
    """

    def __init__(
        self, endpoint: Endpoint, sockets: SocketParameters, session: TcpClientSession | SerialClientSession
    ) -> None:
        self._endpoint = endpoint
        self._sockets = sockets
        self._session = session
        self._host = endpoint.host
        self._is_whole = WHOLE[endpoint.framing]

    async def connect(self, protocol: Callable[[], LinkEnd]) -> Any:
        """Open a UDP socket to the endpoint for an asyncio link, and return its transport. Raises `LinkDown`.

        ``protocol`` is called once, and returns the object that gets each received frame.
        """
        from ..transport.udp import open_datagram

        return await open_datagram(
            self._host,
            self._endpoint.port or 0,
            self._sockets,
            endpoint=self._endpoint.url,
            whole=self._whole,
            received=protocol().arrived,
        )

    def dial(self) -> Channel:
        """Open a UDP socket to the endpoint for a blocking link, and return it. Raises `LinkDown`."""
        from ..transport.udp import BlockingDatagramSocket

        return BlockingDatagramSocket(
            self._host, self._endpoint.port or 0, self._sockets, endpoint=self._endpoint.url, whole=self._whole
        )

    def release(self) -> None:
        """Do nothing: a UDP connector holds no resources."""

    def _whole(self, data: bytes) -> bool:
        if self._is_whole(data):
            return True
        self._session.counters.damaged_frames += 1
        return False


def connector_for(settings: LinkSettings, session: TcpClientSession | SerialClientSession, *, user: str) -> Connector:
    """Create the object that opens the connections of a link. Nothing is opened yet.

    Args:
        settings: the settings of the link.
        session: the session of the link; a serial port tells it when characters leave or arrive damaged.
        user: who will hold the serial port, in words, for the error that a second user of the port gets.

    Raises:
        ConfigError: a client cannot use this kind of endpoint, this process uses the serial port already, or a file
            for TLS cannot be used.
    """
    endpoint = settings.endpoint
    if endpoint.carrier == "tcp":
        return TcpConnector(endpoint, settings.sockets, interface=settings.management.interface)
    if endpoint.carrier == "tls" and settings.security is not None:
        from .tls_connector import TlsConnector

        return TlsConnector(endpoint, settings.sockets, settings.security, settings.ssl_context)
    if endpoint.carrier == "udp":
        return UdpConnector(endpoint, settings.sockets, session)
    if endpoint.carrier == "serial" and settings.line is not None and settings.line.port is not None:
        from .serial_connector import SerialConnector

        assert isinstance(session, SerialClientSession)
        return SerialConnector(endpoint, settings.line.port, settings.line.opening, session, user=user)
    raise ConfigError(f"{endpoint}: a client cannot use {endpoint.scheme}:// yet")
