"""A simulated serial bus without real time: ports, characters with durations, collisions and cut wires.

Knows character times and which port hears which; knows no clock, no thread and no device: a call that needs the time
gets it as an argument, so that hours on a line pass in seconds and every run is the same. `PacedLine` gives the line
real ports.

1. A character is received when its last bit has passed, by every other port, and by its sender if that has an echo.
2. Two ports that send at once damage each other's characters. A port receives nothing while it sends (a driver that
   sends has its receiver off), unless it has an echo.
3. Times never run backwards. A write must come before the line is advanced beyond its time.
"""

import random
from collections import deque
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from ..options.ports import Parity, SerialSettings
from ..transport.serial.marks import UnmarkedBytes

NOISE = -1
"""Port number of recorded characters that no port has sent: `VirtualLine.inject` has put them on the line."""

TAP_SIZE = 200_000
"""Characters that are recorded, some 100 bytes of memory each: four minutes of uninterrupted traffic at 9600 baud."""


@dataclass(slots=True)
class LineByte:
    """One character that was seen on the simulated line, with its time and port.

    Attributes:
        time: when its last bit passed, in seconds.
        port: number of the port that sent it, or `NOISE`.
        value: its value as it was received, 0…255.
        damaged: whether the value differs from what was sent.
        heard_by: numbers of the ports that received it.
    """

    time: float
    port: int
    value: int
    damaged: bool
    heard_by: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Transmission:
    """Characters that one port of the simulated line sent without a silence between them.

    Attributes:
        port: number of the port that sent them, or `NOISE`.
        begin, end: times of the beginning of the first character and of the end of the last one, in seconds.
        data: the characters as they were received.
        damaged: number of characters that differ from what was sent.
    """

    port: int
    begin: float
    end: float
    data: bytes
    damaged: int


class VirtualLine:
    """A simulated serial bus with the given number of ports; methods that send or advance get the time as an argument.

    Attributes:
        ports: its ports, by number.
        settings: baud rate and character format of all ports.
        character_time: seconds that one character takes.
        tap: the recorded characters: every one that has passed, the oldest first; the last 200 000 by default.
        now: the time up to which the line has been advanced, in seconds; minus infinity before the first `advance`.
        collisions: number of characters that were damaged because two ports sent at once.
        noise: probability that a character is damaged on its way, 0…1. May be changed at any time.
    """

    def __init__(
        self,
        ports: int = 2,
        baud: int = 9600,
        parity: str | Parity = Parity.EVEN,
        *,
        data_bits: int = 8,
        stop_bits: int | None = None,
        echo: bool | Collection[int] = False,
        noise: float = 0.0,
        seed: int = 0,
        tap_size: int = TAP_SIZE,
    ) -> None:
        """Create a line on which nothing is sent yet.

        Args:
            ports: number of ports, at least 1.
            baud, parity, data_bits, stop_bits: baud rate and character format, as in `SerialSettings`.
            echo: whether ports receive what they send: True, False, or the numbers of those that do.
            noise: probability that a character is damaged, 0…1.
            seed: seed of random choices; the same seed gives the same run.
            tap_size: most characters that are recorded.

        Raises:
            ValueError: ``ports`` is below 1.
        """
        if ports < 1:
            raise ValueError(f"a line has at least one port, not {ports}")
        self.settings: SerialSettings = SerialSettings(
            baud=baud, parity=Parity(parity), data_bits=data_bits, stop_bits=stop_bits
        )
        self.character_time: float = self.settings.character_time
        self.noise = noise
        self.collisions: int = 0
        self.tap: deque[LineByte] = deque(maxlen=tap_size)
        numbers = range(ports)
        echoing = frozenset(numbers if echo is True else () if echo is False else echo)
        self.ports: tuple[VirtualPort, ...] = tuple(
            VirtualPort(self, number, echo=number in echoing) for number in numbers
        )
        self._noise_source = VirtualPort(self, NOISE, echo=False)
        self._talkers = (*self.ports, self._noise_source)
        self._cut: set[int] = set()
        self._random = random.Random(seed)
        self.now: float = float("-inf")
        self._tolerance = self.character_time * 1e-6

    def deadline(self) -> float | None:
        """Return the time at which the next character on the line will have been sent; None while no port sends."""
        return min((port.head_end for port in self._talkers if port.talking), default=None)

    def pause_at(self) -> float | None:
        """Return the earliest time at which one of the sending ports will have sent everything; None if none sends."""
        return min((port.free_at for port in self._talkers if port.talking), default=None)

    def quiet_at(self) -> float | None:
        """Return the time at which all written characters will have been sent; None while no port sends."""
        return max((port.free_at for port in self._talkers if port.talking), default=None)

    def advance(self, until: float) -> list[LineByte]:
        """Move the time to ``until`` (seconds). Returns the characters that were completely sent by then, in order.

        The ports that heard a character get it in `VirtualPort.read`.
        """
        passed: list[LineByte] = []
        while True:
            talking = [port for port in self._talkers if port.talking]
            if not talking:
                break
            sender = min(talking, key=lambda port: port.head_end) if len(talking) > 1 else talking[0]
            if sender.head_end > until:
                break
            passed.append(self._pass(sender))
        self.now = max(self.now, until)
        return passed

    def cut(self, *ports: int) -> None:
        """Disconnect these ports, or all if none is given, from the line: characters from and to them are lost."""
        self._cut.update(ports or range(len(self.ports)))

    def mend(self, *ports: int) -> None:
        """Reconnect these ports, or all if none is given, to the simulated line after `cut`."""
        self._cut.difference_update(ports or range(len(self.ports)))

    def inject(self, data: bytes, now: float) -> float:
        """Put characters on the line that no port has sent.

        Returns the time at which the last of them will have passed.
        """
        return self._noise_source.write(data, now)

    def transmissions(self, silence: float | None = None) -> list[Transmission]:
        """Return the recorded characters, split at silences and where another port began to send.

        Args:
            silence: seconds that separate two transmissions of one port; 1.5 characters if None.
        """
        return gathered(list(self.tap), self.character_time, silence)

    def _pass(self, sender: "VirtualPort") -> LineByte:
        begin, end, value = sender.take()
        damaged = False
        if sender.number in self._cut:
            heard_by: tuple[int, ...] = (sender.number,) if sender.echo else ()
        else:
            deaf = self._talking_between(begin, end, sender)
            if deaf:
                self.collisions += 1
                damaged = True
            elif self.noise and self._random.random() < self.noise:
                damaged = True
            heard_by = tuple(
                port.number
                for port in self.ports
                if port.number not in self._cut and (port.echo or (port is not sender and port not in deaf))
            )
        if damaged:
            value ^= 1 + self._random.randrange(255)
        byte = LineByte(end, sender.number, value, damaged, heard_by)
        for number in heard_by:
            self.ports[number].hear(value, damaged)
        self.tap.append(byte)
        return byte

    def _talking_between(self, begin: float, end: float, sender: "VirtualPort") -> "list[VirtualPort]":
        begin += self._tolerance
        end -= self._tolerance
        return [
            port
            for port in self._talkers
            if port is not sender
            and port.number not in self._cut
            and (port.passed_at > begin or (port.talking and port.head_begin < end))
        ]

    def _earliest(self, now: float) -> float:
        if now < self.now - self._tolerance:
            raise ValueError(f"the line is at {self.now:.6f} s already, {now:.6f} s has passed")
        return max(now, self.now)


class VirtualPort:
    """One port of a `VirtualLine`, with which a station writes and reads.

    Attributes:
        number: its number on the line.
        echo: whether it receives what it sends.
        talking: whether it has characters to send.
        free_at: time at which the last character written will have passed, in seconds; minus infinity before the first.
        passed_at: time at which its last character passed, in seconds; minus infinity before the first.
    """

    __slots__ = (
        "_data",
        "_errors",
        "_line",
        "_outgoing",
        "_start",
        "echo",
        "free_at",
        "number",
        "passed_at",
        "talking",
    )

    def __init__(self, line: VirtualLine, number: int, *, echo: bool) -> None:
        self._line = line
        self._outgoing: deque[tuple[float, int]] = deque()
        self._data = bytearray()
        self._errors = 0
        self.number: int = number
        self.echo: bool = echo
        self.talking: bool = False
        self.free_at: float = float("-inf")
        self.passed_at: float = float("-inf")

    def write(self, data: bytes, now: float) -> float:
        """Put characters on the line from ``now`` (seconds) on, or as soon as earlier ones of this port are sent.

        Returns:
            The time at which the last of them will have passed.

        Raises:
            ValueError: the line has been advanced beyond ``now``.
        """
        start = max(self._line._earliest(now), self.free_at)
        length = self._line.character_time
        self._outgoing.extend((start + index * length, value) for index, value in enumerate(data))
        if data:
            self.free_at = self._outgoing[-1][0] + length  # to the last bit what `advance` compares with
            self.talking = True
        return self.free_at

    def read(self) -> UnmarkedBytes:
        """Return the bytes received by this port since the last call, and how many of them are damaged.

        Without a parity bit no byte counts as damaged, as on a real port; damaged bytes are returned nevertheless.
        """
        received = UnmarkedBytes(bytes(self._data), self._errors)
        self._data.clear()
        self._errors = 0
        return received

    @property
    def backlog(self) -> int:
        """Number of characters written to this port that are not sent yet."""
        return len(self._outgoing)

    # What the line asks.

    @property
    def head_begin(self) -> float:
        """Time at which the next character of this port begins. Only while the port is sending."""
        return self._outgoing[0][0]

    @property
    def head_end(self) -> float:
        """Time at which the next character of this port ends. Only while the port is sending."""
        return self._outgoing[0][0] + self._line.character_time

    def take(self) -> tuple[float, float, int]:
        """Remove the first waiting character, which was just sent. Returns when it began and ended, and its value."""
        begin, value = self._outgoing.popleft()
        self.talking = bool(self._outgoing)
        end = self.passed_at = begin + self._line.character_time
        return begin, end, value

    def hear(self, value: int, damaged: bool) -> None:
        """Store a character received from the line until this port reads it."""
        self._data.append(value)
        if damaged and self._line.settings.parity is not Parity.NONE:
            self._errors += 1


def gathered(tap: Iterable[LineByte], character_time: float, silence: float | None = None) -> list[Transmission]:
    """Group a line's recorded characters, in order, into transmissions; see `VirtualLine.transmissions`.

    Args:
        tap: the recorded characters.
        character_time: seconds that one character takes.
        silence: seconds that separate two transmissions of one port; 1.5 characters if None.
    """
    limit = 1.5 * character_time if silence is None else silence
    found: list[Transmission] = []
    data = bytearray()
    damaged = 0
    first: LineByte | None = None
    last: LineByte | None = None
    for byte in tap:
        if (
            last is not None
            and first is not None
            and (byte.port != last.port or byte.time - last.time - character_time > limit)
        ):
            found.append(Transmission(last.port, first.time - character_time, last.time, bytes(data), damaged))
            data.clear()
            damaged = 0
            first = None
        if first is None:
            first = byte
        data.append(byte.value)
        damaged += byte.damaged
        last = byte
    if first is not None and last is not None:
        found.append(Transmission(last.port, first.time - character_time, last.time, bytes(data), damaged))
    return found
