"""Ears on a line: opened to listen, never to send.

Knows ports, and sockets to device servers that mirror a line; knows no Modbus beyond what its receiver and `Pairing`
tell.

1. There is no way to send: nothing here writes.
2. A frame that is marked by the port as damaged is none, as for everybody else on the line (Serial Line V1.02 §2.5.1).
"""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self

from ..config.endpoints import Endpoint, parse_endpoint
from ..config.options import build_parameters, option_names
from ..errors import ConfigError, LinkDown
from ..framing.conversation import Role
from ..framing.received import Damaged, Received
from ..framing.timing import Parity, SerialTiming
from ..session.line_framing import FramingParameters, line_framing
from ..transport.serial.blocking import BlockingSerialPort
from ..transport.serial.opening import Claim
from ..transport.serial.settings import SerialSettings
from ..transport.tcp import SocketParameters, link_down, network_reason
from .pairing import Heard, Pairing

_READ_SIZE: Final = 65_536
_LONGEST_WAIT: Final = 0.2
"""Seconds of one wait, so that whoever listens can look at other things between."""

_LAST_READS: Final = 64
"""Reads at the end, far more than a line needs: a peer that sends without end must not keep us."""


class Ear(Protocol):
    """What hears bytes: `BlockingSerialPort` has it, and `SocketEar`."""

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Bytes within ``timeout`` seconds, and how many are damaged. Raises `LinkDown`."""

    def close(self) -> None:
        """Stop listening. May be called twice."""


class SocketEar:
    """A TCP connection to a device server that passes on what is on its line."""

    def __init__(self, endpoint: Endpoint, parameters: SocketParameters) -> None:
        """Connect. Raises `LinkDown`."""
        self._name = endpoint.url
        address = endpoint.host or "127.0.0.1", endpoint.port or 0
        try:
            self._socket = socket.create_connection(address, parameters.connect_timeout)
            parameters.apply(self._socket)
        except OSError as error:
            raise link_down(error, endpoint=self._name) from error

    def read(self, timeout: float | None) -> tuple[bytes, int]:
        """Bytes within ``timeout`` seconds; none of them is ever marked as damaged. Raises `LinkDown`."""
        try:
            self._socket.settimeout(None if timeout is None else max(timeout, 0.000_001))
            data = self._socket.recv(_READ_SIZE)
        except TimeoutError:
            return b"", 0
        except OSError as error:
            raise LinkDown(network_reason(error), endpoint=self._name) from error
        if not data:
            raise LinkDown("the peer closed the connection", endpoint=self._name)
        return data, 0

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


@dataclass(frozen=True, slots=True)
class LineToHear:
    """A line as a URL describes it, not opened yet. Made by `line_to_hear`.

    Attributes:
        endpoint: where it is.
        framing: how frames are found.
        port: what the line is set to; None over a network.
        sockets: of the connection, over a network.
    """

    endpoint: Endpoint
    framing: FramingParameters
    port: SerialSettings | None
    sockets: SocketParameters

    @property
    def timing(self) -> SerialTiming:
        """The times of the line; of a network where there is no port."""
        port = self.port
        if port is None:
            return SerialTiming.of_network()
        return SerialTiming.of_line(
            port.baud, data_bits=port.data_bits, parity=Parity(port.parity.value), stop_bits=port.stop_bits
        )

    def open(self) -> Ear:
        """Open port or connection. Raises `LinkDown`, and `ConfigError` where this process has the port already."""
        if self.port is None:
            return SocketEar(self.endpoint, self.sockets)
        return _ClaimedPort(self.endpoint.path, self.port)


class _ClaimedPort:
    """A port that nobody else in this process uses meanwhile."""

    def __init__(self, path: str, settings: SerialSettings) -> None:
        self._claim = Claim(path, "somebody who listens")
        try:
            self._port = BlockingSerialPort(path, settings)
        except BaseException:
            self._claim.release()
            raise
        self.read = self._port.read

    def close(self) -> None:
        self._port.close()
        self._claim.release()


def line_to_hear(url: str | Endpoint) -> LineToHear:
    """The line of a URL: ``rtu:///dev/…``, ``ascii:///dev/…``, ``rtu+tcp://host:port``, ``ascii+tcp://…``.

    Options behind ``?`` are fields of `SerialSettings` and `FramingParameters`, over a network of `SocketParameters`.

    Raises:
        ConfigError: another scheme, or an option that can not be.
    """
    endpoint = parse_endpoint(url)
    if endpoint.framing == "mbap" or endpoint.carrier not in ("serial", "tcp"):
        raise ConfigError(f"{endpoint.url}: only a line can be listened to: rtu, ascii, rtu+tcp or ascii+tcp")
    kinds: tuple[type[Any], ...] = (  # parameter classes share no base
        FramingParameters,
        SerialSettings if endpoint.carrier == "serial" else SocketParameters,
    )
    chosen: dict[type[Any], dict[str, object]] = {kind: {} for kind in kinds}
    for name, value in endpoint.options.items():
        owner = next((kind for kind in kinds if name in option_names(kind)), None)
        if owner is None:
            known = sorted(one for kind in kinds for one in option_names(kind))
            raise ConfigError(f"unknown option of {endpoint.url}; there are {', '.join(known)}", key=name)
        chosen[owner][name] = value
    port = None
    if endpoint.carrier == "serial":
        port = SerialSettings.from_options(chosen[SerialSettings], binary=endpoint.framing == "rtu")
    framing = build_parameters(FramingParameters, chosen[FramingParameters])
    return LineToHear(endpoint, framing, port, build_parameters(SocketParameters, chosen.get(SocketParameters, {})))


class Listening:
    """Listens to one line; a context manager that closes the ear.

    Attributes:
        pairing: what is made of the frames, with the statistics.
        bytes_heard: all bytes, good or not.
    """

    def __init__(
        self, line: LineToHear, pairing: Pairing | None = None, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Open the line.

        Args:
            line: where to listen.
            pairing: what is made of the frames; a new one if None.
            clock: seconds of what `hear` reports.

        Raises:
            LinkDown: port or connection can not be had.
            ConfigError: it can not be set so.
        """
        self.pairing = pairing or Pairing()
        self.bytes_heard = 0
        self._clock = clock
        self._receiver = line_framing(
            line.endpoint.framing,
            Role.OBSERVER,
            line.timing,
            line.framing,
            strip_parity=line.port is not None and line.port.data_bits == 8,
        ).receiver
        self._ear = line.open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def hear(self, until: float) -> list[Heard]:
        """What is heard next; empty where nothing was, or nothing that is whole, before ``until`` (clock seconds).

        Raises:
            LinkDown: the port vanished, or the connection ended.
        """
        now = self._clock()
        due = self._receiver.deadline() or self.pairing.deadline() or until
        data, damaged = self._ear.read(max(min(due, until, now + _LONGEST_WAIT) - now, 0.0))
        now = self._clock()
        self.bytes_heard += len(data)
        return self._understand(data, damaged, now)

    def finish(self) -> list[Heard]:
        """At the end: what has come and was not read yet, and what is made of bytes that are still undecided.

        Raises:
            LinkDown: the port vanished, or the connection ended.
        """
        events: list[Heard] = []
        for _ in range(_LAST_READS):
            data, damaged = self._ear.read(0.0)
            self.bytes_heard += len(data)
            if not data:
                break
            events += self._understand(data, damaged, self._clock())
        found = self._receiver.flush(self._clock())
        return events + [event for each in found for event in self.pairing.heard(each)]

    def close(self) -> None:
        """Stop listening. May be called twice."""
        self._ear.close()

    def _understand(self, data: bytes, damaged: int, now: float) -> list[Heard]:
        found: list[Received]
        if damaged:
            found = [each for each in self._receiver.receive(data, now) if isinstance(each, Damaged)]
            found += self._receiver.damaged(now)
        else:
            found = self._receiver.receive(data, now) if data else self._receiver.tick(now)
        events = [event for each in found for event in self.pairing.heard(each)]
        # A reply that is being received is not missing.
        return events if self._receiver.deadline() is not None else events + self.pairing.tick(now)
