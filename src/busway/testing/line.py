"""A serial bus in real time, over pseudo-terminals: programs open its ports as they open real ones.

Knows pseudo-terminals (ptys), a thread and the clock; `VirtualLine` decides what is on the line at which time. It knows
no Modbus.

::

    with PacedLine(ports=2, baud=9600) as line:
        with BlockingSerialPort(line.paths[0], settings) as port:
            port.write(request)

1. Only the line's thread uses the line and the ptys. It also executes what other threads ask for by calling methods.
2. A character is delivered at the moment its last bit has passed. Where characters are shorter than `GRANULARITY`,
   several are delivered together, as by a UART with a buffer; the last one of a transmission is always on time.
3. A pty takes some 50 µs from a write until the reader has woken up, unlike a wire. This time is measured when the line
   is created: transmissions begin, and characters are delivered, that much earlier. The shortest of several
   measurements is used, so that no character arrives before its time.
4. A pty has no parity bit and no stop bits: the line's baud rate and parity determine the length of a character, not
   the settings of the programs.
"""

import ctypes
import os
import sys
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Self

from ..options.ports import Parity, SerialSettings
from ..transport.serial.waiting import wait_ready
from .virtual_line import NOISE, LineByte, Transmission, VirtualLine, VirtualPort, gathered

__all__ = ["NOISE", "LineByte", "PacedLine", "Transmission", "VirtualLine", "VirtualPort"]

GRANULARITY = 0.0005
"""Characters within this many seconds may be delivered together, by default.

To wake two programs for every character at 115 200 baud would take more than a processor. It is shorter than t1.5 at
every baud rate: the specification fixes t1.5 at 750 µs for rates above 19 200 baud.
"""

SPIN = 0.0001
"""Seconds before each delivery at which the thread wakes up; it waits for the rest in a loop.

A sleeping thread is woken some 50 µs late, and finding out what to deliver takes as long.
"""
ROUNDING = 1e-9
"""Largest error of a time, in seconds, after the transit time of a pty was subtracted and added again."""

TRANSIT_SAMPLES = 11
"""Number of measurements of the time that a pty takes."""
TIME_TO_FALL_ASLEEP = 0.002
"""Seconds without activity before each measurement: a processor that has slept for long wakes up more slowly."""
LONGEST_TRANSIT = 0.0002
"""Longest time that is assumed for a pty, in seconds.

A machine that is busy while it is measured must not make characters arrive before their time.
"""

LARGEST_BACKLOG = 4096
"""Most characters of a port that wait to be sent; beyond, its program is made to wait, as by a real port."""


@dataclass(slots=True)
class _Pty:
    """One pseudo-terminal of a simulated line: the line uses one end, a program opens the other."""

    near: int
    far: int

    @classmethod
    def opened(cls) -> Self:
        near, far = os.openpty()
        tty.setraw(far)
        os.set_blocking(near, False)
        return cls(near, far)

    @property
    def device(self) -> str:
        return os.ttyname(self.far)

    def close(self) -> None:
        os.close(self.near)
        os.close(self.far)


@dataclass(slots=True)
class _Order:
    """A function call that another thread wants the thread of the simulated line to make, and the error it raised."""

    action: Callable[[], object]
    done: threading.Event = field(default_factory=threading.Event)
    failure: Exception | None = None


@dataclass(slots=True)
class _Listener:
    """The wait of one thread for a silence of the simulated line, which lasts ``silence`` seconds."""

    silence: float
    heard: threading.Event = field(default_factory=threading.Event)


class PacedLine:
    """A serial bus in real time with the given number of ports. A context manager that closes it at the end.

    Its methods may be called from any thread. After `close`, all that need the bus raise `ValueError`.

    Attributes:
        paths: path of each port, by number. A path is a symbolic link; it stays the same when its port is unplugged and
            plugged in again, unless `replug` gets a new name.
        settings: baud rate and character format, which determine the length of a character.
        character_time: seconds that one character takes.
        overruns: number of characters that were lost because no program read them, since the beginning or `forget`.
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
        granularity: float = GRANULARITY,
    ) -> None:
        """Create the simulated line with its ports and start its thread.

        Args:
            ports: number of ports, at least 1.
            baud, parity, data_bits, stop_bits: baud rate and character format, as in `SerialSettings`.
            echo: whether ports receive what they send: True, False, or the numbers of those that do.
            noise: probability that a character is damaged, 0…1.
            seed: seed of random choices.
            granularity: characters within this many seconds may be delivered together; 0 delivers each by itself.

        Raises:
            ValueError: ``ports`` is below 1.
        """
        self._line = VirtualLine(
            ports, baud, parity, data_bits=data_bits, stop_bits=stop_bits, echo=echo, noise=noise, seed=seed
        )
        self._granularity = granularity
        self._directory = tempfile.TemporaryDirectory(prefix="busway-line-")
        self._ptys: list[_Pty | None] = [_Pty.opened() for _ in range(ports)]
        self.paths: list[str] = [os.path.join(self._directory.name, f"port{number}") for number in range(ports)]
        for path, pty in zip(self.paths, self._ptys, strict=True):
            if pty is not None:
                os.symlink(pty.device, path)
        self._transit = _transit_time()
        self.overruns: int = 0
        self._orders: deque[_Order] = deque()
        self._listeners: list[_Listener] = []
        self._bell_read, self._bell = os.pipe()
        os.set_blocking(self._bell, False)
        self._ended = False
        self._last_sound = time.monotonic()
        self._handed_over_at = 0.0
        self._thread = threading.Thread(target=self._run, name="busway-line", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def settings(self) -> SerialSettings:
        """Baud rate and character format of the line, which determine how long a character takes."""
        return self._line.settings

    @property
    def character_time(self) -> float:
        """Seconds that one character takes on the line."""
        return self._line.character_time

    @property
    def collisions(self) -> int:
        """Number of characters damaged because two ports sent at once, since the beginning or `forget`."""
        return self._line.collisions

    @property
    def noise(self) -> float:
        """Probability, 0…1, that a character is damaged in transit. May be changed at any time."""
        return self._line.noise

    @noise.setter
    def noise(self, probability: float) -> None:
        self._line.noise = probability

    @property
    def tap(self) -> list[LineByte]:
        """The last 200 000 characters seen on the line, with time (``time.monotonic``) and port, the oldest first."""
        copied: list[LineByte] = []
        self._do(lambda: copied.extend(self._line.tap))
        return copied

    def transmissions(self, silence: float | None = None) -> list[Transmission]:
        """Return the characters of `tap`, split at silences and at changes of the sending port.

        ``silence`` is the number of seconds that separate two transmissions of one port; 1.5 characters if None.
        """
        return gathered(self.tap, self.character_time, silence)

    def forget(self) -> None:
        """Clear the recorded characters (`tap`) and the counters ``collisions`` and ``overruns`` of the line."""

        def clear() -> None:
            self._line.tap.clear()
            self._line.collisions = 0
            self.overruns = 0

        self._do(clear)

    def cut(self, *ports: int) -> None:
        """Disconnect these ports, or all if none is given, from the simulated line, like a cut cable."""
        self._do(lambda: self._line.cut(*ports))

    def mend(self, *ports: int) -> None:
        """Reconnect these ports, or all if none is given, to the simulated line after `cut`."""
        self._do(lambda: self._line.mend(*ports))

    def inject(self, data: bytes) -> None:
        """Put characters on the line that no port has sent, to simulate noise."""
        self._do(lambda: self._line.inject(data, max(time.monotonic(), self._line.now)))

    def unplug(self, port: int) -> None:
        """Remove a port, as if its adapter was pulled out: the path is gone, programs that have it open get an error.

        Raises:
            ValueError: the port is unplugged already.
        """
        self._do(lambda: self._unplug(port))

    def replug(self, port: int, name: str | None = None) -> str:
        """Bring an unplugged port back. Returns its path: the one it had, or ``name`` in the same directory.

        Raises:
            ValueError: the port is plugged in.
        """
        self._do(lambda: self._replug(port, name))
        return self.paths[port]

    def wait_quiet(self, silence: float | None = None, timeout: float = 10.0) -> None:
        """Wait until the line has been silent for a time. Silence before the call counts.

        Args:
            silence: seconds of silence; 3.5 characters if None.
            timeout: seconds to wait at most.

        Raises:
            TimeoutError: the line was not quiet in that time.
        """
        listener = _Listener(3.5 * self.character_time if silence is None else silence)
        self._do(lambda: self._listeners.append(listener))
        if not listener.heard.wait(timeout):
            raise TimeoutError(f"the line was not quiet for {listener.silence:g} s within {timeout:g} s")

    def close(self) -> None:
        """Close the line: its ports vanish, and programs that have one open get an error. May be called twice."""
        if self._ended:
            return
        self._ended = True
        self._ring()
        self._thread.join()
        for pty in self._ptys:
            if pty is not None:
                pty.close()
        os.close(self._bell)
        os.close(self._bell_read)
        self._directory.cleanup()

    def _do(self, action: Callable[[], object]) -> None:
        if self._ended:
            raise ValueError("the line is closed")
        order = _Order(action)
        self._orders.append(order)
        self._ring()
        while not order.done.wait(1.0):
            if not self._thread.is_alive():
                raise RuntimeError("the line's thread has ended")
        if order.failure is not None:
            raise order.failure

    def _ring(self) -> None:
        with suppress(BlockingIOError):  # it has been rung often enough
            os.write(self._bell, b"\0")

    # From here on: the line's own thread.

    def _run(self) -> None:
        _ask_for_exact_timers()
        while not self._ended:
            wake_at = self._wake_at()
            ready = self._wait(wake_at)
            now = time.monotonic()
            written_at = max(now - self._transit, self._line.now)
            for port, pty in enumerate(self._ptys):
                if pty is not None and pty.near in ready:
                    self._take(port, pty, written_at)
            at = now if ready or wake_at is None else max(now, wake_at)
            self._hand_over(self._line.advance(at + self._transit + ROUNDING), at)
            if self._bell_read in ready:
                self._obey()
            if self._listeners:
                self._wake_listeners(now)

    def _wake_at(self) -> float | None:
        """Return when the line's thread must next deliver characters or report a silence; None if it has neither."""
        next_byte, next_pause = self._line.deadline(), self._line.pause_at()
        if next_byte is not None and next_pause is not None:
            return min(next_pause, max(next_byte, self._handed_over_at + self._granularity)) - self._transit
        if self._listeners:
            return self._last_sound + min(listener.silence for listener in self._listeners)
        return None

    def _wait(self, wake_at: float | None) -> list[int]:
        watched = [self._bell_read]
        for port, pty in zip(self._line.ports, self._ptys, strict=True):
            if pty is not None and port.backlog < LARGEST_BACKLOG:
                watched.append(pty.near)
        timeout = None if wake_at is None else max(wake_at - SPIN - time.monotonic(), 0.0)
        return wait_ready(watched, [], timeout)

    def _take(self, port: int, pty: _Pty, written_at: float) -> None:
        """Put bytes that a program has written to a port at ``written_at`` on the simulated line."""
        try:
            data = os.read(pty.near, LARGEST_BACKLOG)
        except BlockingIOError:
            return
        self._line.ports[port].write(data, written_at)
        self._last_sound = written_at

    def _hand_over(self, passed: list[LineByte], at: float) -> None:
        """Deliver characters of the line to the programs at the ports; wait first if ``at`` is still to come."""
        if not passed:
            return
        self._handed_over_at = self._last_sound = at
        arrived: dict[int, bytearray] = {}
        for byte in passed:
            for port in byte.heard_by:
                arrived.setdefault(port, bytearray()).append(byte.value)
        while time.monotonic() < at:
            pass
        for port, data in arrived.items():
            self._line.ports[port].read()  # the pty takes them instead
            pty = self._ptys[port]
            if pty is None:
                continue
            try:
                written = os.write(pty.near, data)
            except BlockingIOError:
                written = 0
            self.overruns += len(data) - written

    def _obey(self) -> None:
        os.read(self._bell_read, 4096)
        while self._orders:
            order = self._orders.popleft()
            try:
                order.action()
            except Exception as failure:
                order.failure = failure  # it is the caller's, and raised there
            order.done.set()

    def _wake_listeners(self, now: float) -> None:
        if self._line.deadline() is not None:
            return
        for listener in [each for each in self._listeners if now - self._last_sound >= each.silence]:
            listener.heard.set()
            self._listeners.remove(listener)

    def _unplug(self, port: int) -> None:
        pty = self._ptys[port]
        if pty is None:
            raise ValueError(f"port {port} is unplugged already")
        self._ptys[port] = None
        os.unlink(self.paths[port])
        pty.close()

    def _replug(self, port: int, name: str | None) -> None:
        if self._ptys[port] is not None:
            raise ValueError(f"port {port} is plugged in")
        pty = _Pty.opened()
        if name is not None:
            self.paths[port] = os.path.join(self._directory.name, name)
        os.symlink(pty.device, self.paths[port])
        self._ptys[port] = pty


def _transit_time() -> float:
    """Measure the seconds from a write at one end of a pseudo-terminal until a program at the other end wakes up.

    Returns the shortest of `TRANSIT_SAMPLES` measurements, at most `LONGEST_TRANSIT`.
    """
    pty = _Pty.opened()
    taken = []
    asleep = threading.Semaphore(0)
    woken_at: SimpleQueue[float] = SimpleQueue()

    def sleeper() -> None:
        for _ in range(TRANSIT_SAMPLES):
            asleep.release()
            wait_ready([pty.far], [], 1.0)
            woken_at.put(time.monotonic())
            os.read(pty.far, 1)

    thread = threading.Thread(target=sleeper, name="busway-line-transit", daemon=True)
    thread.start()
    try:
        for _ in range(TRANSIT_SAMPLES):
            asleep.acquire()
            time.sleep(TIME_TO_FALL_ASLEEP)
            begun = time.monotonic()
            os.write(pty.near, b"\0")
            taken.append(woken_at.get() - begun)
    finally:
        thread.join()
        pty.close()
    return min(*taken, LONGEST_TRANSIT)


_PR_SET_TIMERSLACK = 29


def _ask_for_exact_timers() -> None:
    """Ask Linux for exact timers in this thread.

    By default timers may be 50 µs late, half a character at 115 200 baud.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
