"""Connections over which checks send any bytes as they are: TCP, TLS and serial ports, opened as by a client's link.

Knows the connectors of the client; knows no request and no frame.
"""

import contextlib
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

from ...client.connector import TcpConnector
from ...client.settings import LinkSettings, link_settings
from ...errors import ConfigError, LinkDown
from ...observe.connection_trace import ConnectionTrace, trace_for
from ...observe.trace import TRACE
from ...options.endpoints import Endpoint
from ...transport.serial.waiting import wait_ready
from ...transport.tcp import link_down
from .check import TlsChange

if TYPE_CHECKING:
    from ...options.ports import SerialSettings
    from .tls_wire import ClientCertificate

_RECEIVE_SIZE = 65_536
_LONGEST_STALL = 10.0
"""Seconds after which a connection is over whose other end takes no bytes (a TCP window of 0)."""


class Wire(Protocol):
    """Interface of an open connection, or of an open serial port, that sends and receives bytes."""

    def send(self, data: bytes) -> None:
        """Send bytes unchanged. Raises `LinkDown` if the connection has ended, or takes no bytes for too long."""

    def receive(self, timeout: float) -> bytes | None:
        """Return received bytes as soon as there are any; empty if none come within ``timeout`` seconds.

        None if the connection has ended.
        """

    def close(self) -> None:
        """Close the connection or port."""


class Dialer(Protocol):
    """Interface of an object that opens connections to the checked device, and has the clock of a run.

    Attributes:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        has_connections: True for a network, where a connection can be closed and made again; False for a serial port.
    """

    framing: str
    has_connections: bool

    def open(self) -> Wire:
        """Open a connection or the port. Raises `LinkDown` if that fails."""

    def now(self) -> float:
        """Return the time of a monotonic clock, in seconds."""

    def sleep(self, seconds: float) -> None:
        """Wait for this many seconds."""

    def changed(self, change: TlsChange) -> "Dialer":
        """Return a dialer whose connections have a changed TLS handshake; on a serial port this dialer itself.

        Its `open` raises `CannotOffer` if this machine cannot make the changed handshake, or the user's certificate for
        it is missing or unsuitable.
        """


def dialer_for(
    url: str | Endpoint,
    options: Mapping[str, object] | None = None,
    *,
    certificates: "Mapping[TlsChange, ClientCertificate] | None" = None,
) -> "NetworkDialer | SerialDialer":
    """Return the dialer of an endpoint, which opens connections (or the serial port) with the options of a link.

    Nothing is opened yet.

    Args:
        url: the endpoint.
        options: options of the link, in addition to those in the URL.
        certificates: client certificates that the user has given for checks of TLS handshakes, by the change that each
            is for; None for none.

    Raises:
        ConfigError: the URL or an option is invalid, or the endpoint is neither TCP, TLS nor a serial port.
    """
    settings = link_settings(url, options or {})
    endpoint = settings.endpoint
    if endpoint.carrier in ("tcp", "tls"):
        return NetworkDialer(settings, certificates or {})
    if endpoint.carrier == "serial":
        return SerialDialer(settings)
    raise ConfigError(f"{endpoint.url}: checks go over TCP, TLS and serial ports", key="URL")


class _RealTime:
    """The clock of the system, for dialers."""

    def now(self) -> float:
        """Return the time of the monotonic clock, in seconds."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for this many seconds."""
        time.sleep(seconds)


class NetworkDialer(_RealTime):
    """Opens TCP or TLS connections to a device; the framing over TCP may also be RTU or ASCII."""

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
        """Open a connection. Raises `LinkDown` if that fails."""
        return NetworkWire(self._connector.dial(), self._settings)

    def changed(self, change: TlsChange) -> "Dialer":
        """Return a dialer whose connections have a changed TLS handshake."""
        return _ChangedDialer(self._settings, change, self._certificates)


class _ChangedDialer(_RealTime):
    """Opens connections with one change in the TLS handshake, so that a secure device must refuse them."""

    has_connections = True

    def __init__(
        self, settings: LinkSettings, change: TlsChange, certificates: "Mapping[TlsChange, ClientCertificate]"
    ) -> None:
        self.framing: str = settings.endpoint.framing
        self._settings, self._change, self._certificates = settings, change, certificates

    def open(self) -> "NetworkWire":
        """Open a connection with the changed handshake.

        Raises:
            LinkDown: the device cannot be reached, or refuses the handshake.
            CannotOffer: this machine cannot make the handshake, or the user's certificate for it is missing or
                unsuitable.
            ConfigError: a certificate or key cannot be read.
        """
        from .tls_wire import changed_channel

        return NetworkWire(changed_channel(self._settings, self._change, self._certificates), self._settings)

    def changed(self, change: TlsChange) -> "Dialer":
        """Return a dialer whose TLS handshake is changed in another way."""
        return _ChangedDialer(self._settings, change, self._certificates)


class NetworkWire:
    """One TCP or TLS connection, whose socket does not block."""

    def __init__(self, channel: "_Channel", settings: LinkSettings) -> None:
        self._channel = channel
        self._url = settings.endpoint.url
        self._trace = _trace(settings, channel)
        self._buffer = bytearray(_RECEIVE_SIZE)

    def send(self, data: bytes) -> None:
        """Send bytes, in one write if the socket takes them at once; else wait until it takes the rest.

        Raises:
            LinkDown: the connection has ended, or the device takes no bytes for 10 s; bytes may have gone out.
        """
        rest = data
        if self._trace is not None:
            self._trace.sent(data)
        try:
            while rest:
                try:
                    rest = rest[self._channel.send(rest) :]
                except BlockingIOError:
                    if not wait_ready([], [self._channel.fileno()], _LONGEST_STALL):
                        words = f"the device takes no bytes for {_LONGEST_STALL:g} s"
                        raise LinkDown(words, kind="timeout", endpoint=self._url) from None
        except LinkDown:
            raise
        except OSError as error:
            raise link_down(error, endpoint=self._url) from error

    def receive(self, timeout: float) -> bytes | None:
        """Return received bytes as soon as there are any; empty if none come within ``timeout`` seconds.

        None if the connection has ended.
        """
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
                data = bytes(self._buffer[:size])
                if self._trace is not None and data:
                    self._trace.received(data)
                return data or None

    def close(self) -> None:
        """Close the connection."""
        with contextlib.suppress(OSError):
            self._channel.close()


class _Channel(Protocol):
    """Interface of a non-blocking socket, plain or over TLS."""

    def fileno(self) -> int: ...
    def recv_into(self, buffer: bytearray, /) -> int: ...
    def send(self, data: bytes, /) -> int: ...
    def close(self) -> None: ...


class SerialDialer(_RealTime):
    """Opens a serial port with the settings (baud rate, parity) of its URL."""

    has_connections = False

    def __init__(self, settings: LinkSettings) -> None:
        assert settings.line is not None
        assert settings.line.port is not None
        self.framing: str = settings.endpoint.framing
        self._settings = settings
        self._port = settings.line.port

    def changed(self, change: TlsChange) -> "Dialer":
        """Return this dialer: a serial line has no handshake."""
        return self

    def open(self) -> "SerialWire":
        """Open the port.

        Raises:
            LinkDown: the port cannot be opened.
            ConfigError: the port does not support the settings of its URL.
        """
        return SerialWire(self._settings, self._port)


class SerialWire:
    """An open serial port."""

    def __init__(self, settings: LinkSettings, port: "SerialSettings") -> None:
        from ...transport.serial.blocking import BlockingSerialPort

        self._port = BlockingSerialPort(settings.endpoint.path, port)
        self._trace = _trace(settings, None)

    def send(self, data: bytes) -> None:
        """Send bytes and wait until they have left the port.

        Raises:
            LinkDown: the port has gone, or holds bytes back for more than 10 s; bytes may have gone out.
        """
        if self._trace is not None:
            self._trace.sent(data)
        self._port.write(data)
        self._port.drain(_LONGEST_DRAIN)

    def receive(self, timeout: float) -> bytes | None:
        """Return received bytes as soon as there are any; empty if none come within ``timeout`` seconds.

        Also empty, and earlier, if only the beginning of a damage mark has come. None if the port has gone.
        """
        try:
            data = self._port.read(timeout)[0]
        except LinkDown:
            return None
        if self._trace is not None and data:
            self._trace.received(data)
        return data

    def close(self) -> None:
        """Close the port."""
        self._port.close()


_LONGEST_DRAIN = 10.0


def _trace(settings: LinkSettings, carrier: object) -> ConnectionTrace | None:
    """Return a new traffic log for one connection; None if traffic is neither logged nor captured."""
    if not TRACE.level:
        return None
    return trace_for(settings.endpoint.framing, settings.endpoint.url, is_server=False, carrier=carrier)
