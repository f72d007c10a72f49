"""Sniffing: passive listening to a serial line, which is opened to receive and never to send.

Knows ports, and sockets to device servers that mirror a line; knows no Modbus beyond its receiver and `Pairing`.

1. Nothing in this file sends. A device server is connected to over TCP; over UDP the device server must be set up to
   send its datagrams here, and the URL names the local address.
2. A frame that the port marks as damaged is dropped, as by every unit on the line (Serial Line V1.02 §2.5.1).
3. A port that vanishes is waited for if there is a ``vanished`` callback; otherwise listening ends.
   A TCP connection that ends always ends it: the device server has decided so.
"""

import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol, Self

from ..errors import ConfigError, LinkDown
from ..framing.character_times import SerialTiming
from ..framing.frame_direction import LineRole
from ..framing.received import Damaged, FrameOrDamage
from ..options.accepted_options import MONITORS, AcceptedOptions, canonical
from ..options.endpoints import Endpoint, parse_endpoint, require_host
from ..options.lines import FramingParameters
from ..options.ports import OpeningParameters, SerialSettings
from ..options.sockets import SocketParameters
from ..session.line_framing import line_framing
from ..transport.local_end import connect_failure
from ..transport.serial.blocking import BlockingSerialPort
from ..transport.serial.port_claims import PortClaim
from ..transport.serial.reopen import ReopenPolicy
from ..transport.tcp import configure, network_kind, network_reason, set_buffers
from ..transport.udp import MAX_DATAGRAM
from .pairing import Heard, Pairing

_READ_SIZE: Final = 65_536
_LONGEST_WAIT: Final = 0.2
"""Most seconds of one wait, so that the caller can check for other events between two waits."""

_LAST_READS: Final = 64
"""Most reads at the end, far more than a line needs: a peer that sends without end must not keep the program."""


class ByteSource(Protocol):
    """Interface of a source of a serial line's bytes: a port, or a device server that forwards the line's bytes."""

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Return received bytes as soon as there are some, and how many of them the port marked as damaged.

        No bytes if none came within ``timeout`` seconds; None waits for ever. Raises `LinkDown` if the port has
        vanished or the connection has ended.
        """

    def close(self) -> None:
        """Stop listening to the line. May be called twice."""


class SocketByteSource:
    """Source of a serial line's bytes: a TCP connection to a device server that forwards them."""

    def __init__(self, endpoint: Endpoint, parameters: SocketParameters) -> None:
        """Connect to the device server that forwards the line's bytes. Raises `LinkDown` if that fails."""
        self._name = endpoint.url
        address, own = (endpoint.host, endpoint.port or 0), parameters.local_address
        try:
            self._socket = socket.create_connection(address, parameters.connect_timeout, (own, 0) if own else None)
            try:
                configure(self._socket, parameters)
            except OSError:
                self._socket.close()
                raise
        except OSError as error:
            raise connect_failure(error, endpoint=self._name, host=endpoint.host, local_address=own) from error

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Return received bytes as soon as there are some, and 0: TCP marks no bytes as damaged.

        No bytes if none came within ``timeout`` seconds; None waits for ever. Raises `LinkDown` if the connection has
        ended.
        """
        try:
            self._socket.settimeout(None if timeout is None else max(timeout, 0.000_001))
            data = self._socket.recv(_READ_SIZE)
        except TimeoutError:
            return b"", 0
        except OSError as error:
            raise LinkDown(network_reason(error), kind=network_kind(error), endpoint=self._name) from error
        if not data:
            raise LinkDown("the peer closed the connection", kind="lost", endpoint=self._name)
        return data, 0

    def close(self) -> None:
        """Close the connection to the device server that forwards the line's bytes."""
        self._socket.close()


class DatagramByteSource:
    """Source of a serial line's bytes: a local UDP port to which a device server sends them, from any address."""

    def __init__(self, endpoint: Endpoint, parameters: SocketParameters) -> None:
        """Bind the local UDP port at which a device server's datagrams arrive. Raises `LinkDown` if that fails."""
        self._name = endpoint.url
        try:
            places = socket.getaddrinfo(
                endpoint.host or "0.0.0.0", endpoint.port or 0, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
            )
            family, kind, protocol, _, address = places[0]
            self._socket = socket.socket(family, kind, protocol)
        except OSError as error:
            raise self._not_here(error) from error
        try:
            set_buffers(self._socket, parameters)
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise self._not_here(error) from error

    @property
    def port(self) -> int:
        """Number of the local UDP port that receives."""
        return int(self._socket.getsockname()[1])

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Return the next datagram as soon as it has come, and 0: UDP marks no bytes as damaged.

        No bytes if none came within ``timeout`` seconds; None waits for ever. Raises `LinkDown` if the system reports
        an error.
        """
        try:
            self._socket.settimeout(None if timeout is None else max(timeout, 0.000_001))
            return self._socket.recv(MAX_DATAGRAM), 0
        except TimeoutError:
            return b"", 0
        except OSError as error:
            raise LinkDown(network_reason(error), kind=network_kind(error), endpoint=self._name) from error

    def close(self) -> None:
        """Close the local UDP port that receives."""
        self._socket.close()

    def _not_here(self, error: OSError) -> LinkDown:
        down = LinkDown(
            f"datagrams cannot be taken there: {network_reason(error)}", kind=network_kind(error), endpoint=self._name
        )
        down.__cause__ = error
        return down


@dataclass(frozen=True, slots=True)
class SniffedLine:
    """A serial line to listen to, as its URL describes it; not opened yet. Created by `sniffed_line`.

    Attributes:
        endpoint: its endpoint.
        framing: options of the framing.
        port: settings of the serial port; None over a network.
        sockets: options of the connection; without effect for a serial port.
        opening: the pauses between attempts to open a port that has vanished; without effect over a network.
    """

    endpoint: Endpoint
    framing: FramingParameters
    port: SerialSettings | None
    sockets: SocketParameters
    opening: OpeningParameters

    @property
    def timing(self) -> SerialTiming:
        """Times of the line, such as the silence between frames: from the port's settings, or fixed over a network."""
        return SerialTiming.of_network() if self.port is None else self.port.timing

    def open(self) -> ByteSource:
        """Open the line, and return the source of its bytes.

        Raises:
            LinkDown: the port or connection cannot be opened.
            ConfigError: this process uses the port already, or the port refuses its settings.
        """
        if self.port is None:
            source = DatagramByteSource if self.endpoint.carrier == "udp" else SocketByteSource
            return source(self.endpoint, self.sockets)
        return _ClaimedPort(self.endpoint.path, self.port)


class _ClaimedPort:
    """A serial port open for listening; other users in this process cannot open it meanwhile."""

    def __init__(self, path: str, settings: SerialSettings) -> None:
        self._claim = PortClaim(path, "a listener to the line")
        try:
            self._port = BlockingSerialPort(path, settings)
        except BaseException:
            self._claim.release()
            raise
        self.read = self._port.read

    def close(self) -> None:
        """Close the port; other users in this process can open it again."""
        self._port.close()
        self._claim.release()


def sniffed_line(url: str | Endpoint, options: Mapping[str, object] | None = None) -> SniffedLine:
    """Return the serial line that a URL describes, to listen to; nothing is opened.

    Args:
        url: ``rtu:///dev/…``, ``rtu+tcp://host:port`` or ``rtu+udp://:port``; or the same with ``ascii``. Options
            behind ``?`` are ``preset``, fields of `FramingParameters`, and those of `SerialSettings` with
            ``reopen_first`` and ``reopen_most`` of `OpeningParameters`; over TCP those of `SocketParameters`, over UDP
            only its ``receive_buffer``. The host of a UDP URL is one of this machine, empty for all its IPv4 addresses.
        options: more of these options, as values or as texts; where the URL gives the same one, this one counts.

    Raises:
        ConfigError: another scheme, no host of a device server on TCP, or an unknown option or value.
    """
    endpoint = parse_endpoint(url)
    if endpoint.framing == "mbap":
        raise ConfigError(
            f"{endpoint.url}: only a line can be listened to: rtu or ascii, alone or with +tcp or +udp",
        )
    if endpoint.carrier == "tcp":
        require_host(endpoint)
    given = {**canonical(endpoint.options), **canonical(options or {})}
    chosen = AcceptedOptions.at(endpoint, "monitor", MONITORS).chosen(given, of=endpoint.url)
    return SniffedLine(
        endpoint,
        chosen.build(FramingParameters),
        chosen.serial_settings(),
        chosen.build(SocketParameters),
        chosen.build(OpeningParameters),
    )


class Listening:
    """Listens to one serial line and pairs requests and replies; a context manager that closes it.

    Attributes:
        pairing: turns the frames into events, and has the statistics.
        bytes_heard: number of bytes received, good or not.
        lost: the error with which the port vanished, while opening it is tried again; None while the port is open.
    """

    def __init__(
        self,
        line: SniffedLine,
        pairing: Pairing | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        vanished: Callable[[LinkDown], None] | None = None,
        returned: Callable[[], None] = lambda: None,
    ) -> None:
        """Open a serial line and start listening to it.

        Args:
            line: the line to listen to.
            pairing: turns the frames into events; None for a new one.
            clock: returns the time in seconds; all times in events and of `hear` are of this clock.
            vanished: called when a serial port vanishes, which is then opened again as soon as possible; None ends the
                listening instead.
            returned: called when the port is open again.

        Raises:
            LinkDown: the port or connection cannot be opened.
            ConfigError: this process uses the port already, or the port refuses its settings.
        """
        self.pairing: Pairing = pairing or Pairing()
        self.bytes_heard: int = 0
        self._clock = clock
        self._receiver = line_framing(
            line.endpoint.framing,
            LineRole.OBSERVER,
            line.timing,
            line.framing,
            strip_parity=line.port is not None and line.port.data_bits == 8,
        ).receiver
        self.lost: LinkDown | None = None
        self._line = line
        self._vanished = vanished if line.port is not None else None
        self._returned = returned
        self._failures = 0
        self._try_at = 0.0
        self._source = line.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def hear(self, until: float) -> list[Heard]:
        """Wait for bytes from the line, and return the events that they or the silence complete; often none.

        Returns as soon as bytes have come, or a silence has ended a frame or the wait for a reply. Returns at ``until``
        (seconds of the clock) at the latest, and after a fifth of a second at most, also while a vanished port is
        awaited; only the call that opens it again can take up to twice that. So an empty list does not mean that
        ``until`` has come.

        Raises:
            LinkDown: the port vanished and is not to be opened again, or the connection ended.
            ConfigError: a vanished port is there again, but is in use in this process or refuses its settings.
        """
        now = self._clock()
        if self.lost is not None and not self._try_again(now, until):
            return self._understand(b"", 0, self._clock())
        due = self._receiver.deadline() or self.pairing.deadline() or until
        try:
            data, damaged = self._source.read(max(min(due, until, now + _LONGEST_WAIT) - now, 0.0))
        except LinkDown as error:
            return self._lose(error)
        now = self._clock()
        self.bytes_heard += len(data)
        return self._understand(data, damaged, now)

    def finish(self) -> list[Heard]:
        """Return the last events: from received bytes not processed yet, and from unfinished frames.

        Raises:
            LinkDown: the connection ended, or the port vanished and is not to be opened again.
        """
        events: list[Heard] = []
        for _ in range(_LAST_READS):
            if self.lost is not None:
                break
            try:
                data, damaged = self._source.read(0.0)
            except LinkDown as error:
                return events + self._lose(error)
            self.bytes_heard += len(data)
            if not data:
                break
            events += self._understand(data, damaged, self._clock())
        return events + self._flushed()

    def close(self) -> None:
        """Stop listening to the line. May be called twice."""
        self._source.close()

    def _lose(self, error: LinkDown) -> list[Heard]:
        """Handle the loss of the port: begin to wait for it, and return the events of an unfinished frame.

        Raises ``error`` if a vanished port is not to be opened again.
        """
        if self._vanished is None:
            raise error
        self.lost = error
        self._source.close()
        self._failures = 0
        self._try_at = self._clock()
        self._vanished(error)
        return self._flushed()

    def _try_again(self, now: float, until: float) -> bool:
        """Open the vanished port again if the next attempt is due, else wait up to a fifth of a second.

        Returns whether the port is open. `ConfigError` if it is in use in this process or refuses its settings.
        """
        pause = min(self._try_at, until, now + _LONGEST_WAIT) - now
        if pause > 0:
            time.sleep(pause)
        if self._clock() < self._try_at:
            return False
        try:
            self._source = self._line.open()
        except LinkDown as error:
            self.lost = error
            self._failures += 1
            self._try_at = self._clock() + (ReopenPolicy.of(self._line.opening).pause(self._failures) or 0.0)
            return False
        self.lost = None
        self._returned()
        return True

    def _flushed(self) -> list[Heard]:
        found = self._receiver.flush(self._clock())
        return [event for each in found for event in self.pairing.heard(each)]

    def _understand(self, data: bytes, damaged: int, now: float) -> list[Heard]:
        found: list[FrameOrDamage]
        if damaged:
            found = [each for each in self._receiver.receive(data, now) if isinstance(each, Damaged)]
            found += self._receiver.damaged(now)
        else:
            found = self._receiver.receive(data, now) if data else self._receiver.tick(now)
        events = [event for each in found for event in self.pairing.heard(each)]
        # A reply that is being received is not missing.
        return events if self._receiver.deadline() is not None else events + self.pairing.tick(now)
