"""Connections over which checks send bytes as they are: TCP, TLS and serial ports, opened as a link opens them.

Knows the connectors of the client; knows no request and no frame.
"""

import contextlib
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from ...client.connector import TcpConnector
from ...client.settings import LinkSettings, link_settings
from ...errors import ConfigError, LinkDown
from ...options.endpoints import Endpoint
from ...transport.serial.waiting import wait_ready
from ...transport.tcp import link_down
from .check import TlsChange

if TYPE_CHECKING:
    from .tls_wire import ClientCertificate

_RECEIVE_SIZE = 65_536


class Wire(Protocol):
    """One open connection, or an open serial port."""

    def send(self, data: bytes) -> None:
        """Send bytes. Raises `LinkDown` if the connection has ended."""

    def receive(self, timeout: float) -> bytes | None:
        """Return what comes within ``timeout`` seconds; no bytes if nothing does, None if the connection has ended."""

    def close(self) -> None:
        """Close the connection or port."""


class Dialer(Protocol):
    """Opens connections to the device that is checked."""

    framing: str
    has_connections: bool

    def open(self) -> Wire:
        """Open a connection or the port. Raises `LinkDown`."""

    def now(self) -> float:
        """Return the time in seconds, monotonic."""

    def sleep(self, seconds: float) -> None:
        """Let time pass, in which the device may do something."""

    def changed(self, change: TlsChange) -> "Dialer":
        """Return what opens connections with a changed handshake; raises `CannotOffer` when it opens one it cannot."""


def dialer_for(
    url: str | Endpoint,
    options: Mapping[str, object] | None = None,
    *,
    certificates: "Mapping[TlsChange, ClientCertificate] | None" = None,
) -> "NetworkDialer | SerialDialer":
    """Create what opens connections to an endpoint, with the options of a link.

    Args:
        url: the endpoint.
        options: options of the link, beside those in the URL.
        certificates: client certificates for checks that the user alone can supply, over TLS.

    Raises:
        ConfigError: an invalid URL or option, or an endpoint that checks cannot use, such as UDP.
    """
    settings = link_settings(url, options or {})
    endpoint = settings.endpoint
    if endpoint.carrier in ("tcp", "tls"):
        return NetworkDialer(settings, certificates or {})
    if endpoint.carrier == "serial":
        return SerialDialer(settings)
    raise ConfigError(f"{endpoint.url}: checks go over TCP, TLS and serial ports", key="URL")


class _RealTime:
    """The time of the system."""

    def now(self) -> float:
        """Return the time in seconds, monotonic."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class NetworkDialer(_RealTime):
    """Opens TCP and TLS connections; the framing may be that of a serial line."""

    has_connections = True

    def __init__(self, settings: LinkSettings, certificates: "Mapping[TlsChange, ClientCertificate]") -> None:
        endpoint = settings.endpoint
        self._certificates = certificates
        self.framing: str = endpoint.framing
        self._url = endpoint.url
        if endpoint.carrier == "tls" and settings.security is not None:
            from ...client.tls_connector import TlsConnector

            self._connector: TcpConnector | TlsConnector = TlsConnector(endpoint, settings.sockets, settings.security)
        else:
            self._connector = TcpConnector(endpoint, settings.sockets, interface=settings.management.interface)

        self._settings = settings

    def open(self) -> "NetworkWire":
        """Open a connection. Raises `LinkDown`."""
        return NetworkWire(self._connector.dial(), self._url)

    def changed(self, change: TlsChange) -> "Dialer":
        """Return what opens connections with a changed handshake."""
        return _ChangedDialer(self._settings, change, self._certificates)


class _ChangedDialer(_RealTime):
    """Opens connections with a changed TLS handshake."""

    has_connections = True

    def __init__(
        self, settings: LinkSettings, change: TlsChange, certificates: "Mapping[TlsChange, ClientCertificate]"
    ) -> None:
        self.framing: str = settings.endpoint.framing
        self._settings, self._change, self._certificates = settings, change, certificates

    def open(self) -> "NetworkWire":
        """Open a connection. Raises `LinkDown`, and `CannotOffer` where this machine cannot make it."""
        from .tls_wire import changed_channel

        return NetworkWire(
            changed_channel(self._settings, self._change, self._certificates), self._settings.endpoint.url
        )

    def changed(self, change: TlsChange) -> "Dialer":
        """Return what opens connections with another changed handshake."""
        return _ChangedDialer(self._settings, change, self._certificates)


class NetworkWire:
    """One TCP or TLS connection, whose socket does not block."""

    def __init__(self, channel: "_Channel", url: str) -> None:
        self._channel = channel
        self._url = url
        self._buffer = bytearray(_RECEIVE_SIZE)

    def send(self, data: bytes) -> None:
        """Send bytes in one write where the socket takes them at once. Raises `LinkDown`."""
        rest = data
        try:
            while rest:
                try:
                    rest = rest[self._channel.send(rest) :]
                except BlockingIOError:
                    wait_ready([], [self._channel.fileno()], None)
        except OSError as error:
            raise link_down(error, endpoint=self._url) from error

    def receive(self, timeout: float) -> bytes | None:
        """Return what comes within ``timeout`` seconds; None if the connection has ended."""
        until = time.monotonic() + timeout
        while True:
            try:
                size = self._channel.recv_into(self._buffer)
            except BlockingIOError:
                left = until - time.monotonic()
                if left <= 0 or not wait_ready([self._channel.fileno()], [], left):
                    return b""
            except OSError:
                return None
            else:
                return bytes(self._buffer[:size]) if size else None

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._channel.close()


class _Channel(Protocol):
    def fileno(self) -> int: ...
    def recv_into(self, buffer: bytearray, /) -> int: ...
    def send(self, data: bytes, /) -> int: ...
    def close(self) -> None: ...


class SerialDialer(_RealTime):
    """Opens a serial port with the settings of its URL."""

    has_connections = False

    def __init__(self, settings: LinkSettings) -> None:
        assert settings.line is not None
        assert settings.line.port is not None
        self.framing: str = settings.endpoint.framing
        self._path = settings.endpoint.path
        self._port = settings.line.port

    def changed(self, change: TlsChange) -> "Dialer":
        """Return this dialer: a serial line has no handshake."""
        return self

    def open(self) -> "SerialWire":
        """Open the port. Raises `LinkDown`; `ConfigError` if the port cannot be set so."""
        return SerialWire(self._path, self._port)


class SerialWire:
    """An open serial port."""

    def __init__(self, path: str, settings: object) -> None:
        from ...transport.serial.blocking import BlockingSerialPort

        self._port = BlockingSerialPort(path, settings)  # type: ignore[arg-type]

    def send(self, data: bytes) -> None:
        """Send bytes; return when they have left the port. Raises `LinkDown`."""
        self._port.write(data)
        self._port.drain(_LONGEST_DRAIN)

    def receive(self, timeout: float) -> bytes | None:
        """Return what comes within ``timeout`` seconds; None if the port has gone."""
        try:
            return self._port.read(timeout)[0]
        except LinkDown:
            return None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


_LONGEST_DRAIN = 10.0
