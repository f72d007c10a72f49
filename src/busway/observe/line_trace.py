"""Trace of RTU and ASCII traffic: log lines, and packets in a capture file; levels as in `busway.observe.trace`.

Knows frames and messages; knows no port: a driver passes in what it received and sent. A log follows the line as an
observer does, so frames of other masters are shown too.

1. A driver sends whole frames: each is shown at once, after what was received before it has been decided.
2. Received bytes that are undecided (a function of unknown length, the beginning of a frame) are decided when silence
   ends them, by a timer of their own: drivers have none for traffic that is only watched. The end of a capture decides
   everything.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final, Protocol

from ..framing.character_times import SerialTiming
from ..framing.frame_direction import LineRole
from ..framing.received import Damaged, Direction, FrameOrDamage, SerialFrame
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed_pdu import MalformedPdu
from .trace import TRACE, TraceLevel

_log = logging.getLogger("busway.trace")

_SOONEST: Final = 0.001
"""Fewest seconds that the silence timer is set to: one that fires a little early would be restarted again and again."""


class SilenceTimer(Protocol):
    """Interface of a timer that calls a function after a silence of the line, such as `threading.Timer`."""

    def start(self) -> None:
        """Start the timer: it calls its function once, after its time."""

    def cancel(self) -> None:
        """Stop the timer, so that its function is not called."""


def _timer(delay: float, call: Callable[[], None]) -> SilenceTimer:
    timer = threading.Timer(delay, call)
    timer.daemon = True  # the program does not wait for it at its end
    return timer


class LineTrace:
    """Log of the traffic of one serial line. Its methods may be called from several threads.

    If a capture file is in use (``TRACE.capture``) when the log is created, the frames are recorded there too.
    """

    __slots__ = (
        "__weakref__",
        "_capture",
        "_clock",
        "_functions",
        "_lock",
        "_make_timer",
        "_name",
        "_receiver",
        "_sends",
        "_timer",
    )

    def __init__(
        self,
        framing: str,
        name: str,
        functions: FunctionTable = STANDARD,
        *,
        is_server: bool = False,
        clock: Callable[[], float] = time.monotonic,
        make_timer: Callable[[float, Callable[[], None]], SilenceTimer] = _timer,
    ) -> None:
        """Create the log of a line on which nothing was seen yet.

        Args:
            framing: ``rtu`` or ``ascii``.
            name: the line's name in the log.
            functions: the functions whose lengths are known.
            is_server: whether replies are sent here, and not requests.
            clock: returns the time in seconds, monotonic.
            make_timer: called with a number of seconds and a function; returns a timer, not started yet, that calls the
                function after these seconds.
        """
        from ..session.line_framing import line_framing  # here: Modbus TCP does without it

        self._capture = None if TRACE.capture is None else TRACE.capture.line(name, is_server=is_server)
        self._name = name
        self._functions = functions
        self._receiver = line_framing(
            framing, LineRole.OBSERVER, SerialTiming.of_network(), functions=functions
        ).receiver
        self._sends = Direction.REPLY if is_server else Direction.REQUEST
        self._clock = clock
        self._lock = threading.RLock()
        self._make_timer = make_timer
        self._timer: SilenceTimer | None = None

    def received(self, data: bytes) -> None:
        """Log the frames that received bytes complete; an unfinished frame is kept for later."""
        with self._lock:
            now = self._heard("<", data)
            self._take("<", self._receiver.receive(data, now), now)
            self._wait(now)

    def sent(self, data: bytes) -> None:
        """Log bytes that this station sent: one or several whole frames."""
        with self._lock:
            self.settle()
            now = self._heard(">", data)
            found = [*self._receiver.receive(data, now), *self._receiver.flush(now)]
            self._take(">", found, now)

    def note(self, text: str) -> None:
        """Log an event of the serial line that its frames do not show."""
        if TRACE.level >= TraceLevel.MESSAGE:
            _log.debug("%s %s", self._name, text)

    def tick(self) -> None:
        """Log the frames that the silence of the line until now has ended; the timer calls it."""
        with self._lock:
            self._timer = None
            now = self._clock()
            self._take("<", self._receiver.tick(now), now)
            self._wait(now)

    def settle(self) -> None:
        """Log all received bytes now, as frames or as damaged bytes, without waiting for the silence that ends one."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None
            TRACE.undecided.discard(self)
            now = self._clock()
            self._take("<", self._receiver.flush(now), now)

    def _heard(self, arrow: str, data: bytes) -> float:
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s %s %d bytes: %s", self._name, arrow, len(data), data.hex(" "))
        return self._clock()

    def _wait(self, now: float) -> None:
        """Set the timer for the moment when silence decides whether received bytes are a frame."""
        due = self._receiver.deadline()
        if due is None:
            TRACE.undecided.discard(self)
            return
        TRACE.undecided.add(self)
        if self._timer is None:  # one that comes too early sets the next
            self._timer = self._make_timer(max(due - now, _SOONEST), self.tick)
            self._timer.start()

    def _take(self, arrow: str, all_found: list[FrameOrDamage], now: float) -> None:
        for found in all_found:
            if arrow == ">" and isinstance(found, SerialFrame):
                found = replace(found, direction=self._sends)
            if self._capture is not None:
                self._capture.heard(found, at=time.time() - (now - found.began), is_outgoing=arrow == ">")
            if TRACE.level >= TraceLevel.MESSAGE:
                self._show(arrow, found)

    def _show(self, arrow: str, found: FrameOrDamage) -> None:
        if isinstance(found, Damaged):
            _log.debug("%s %s damaged: %s: %s", self._name, arrow, found.reason.value, found.raw.hex(" "))
            return
        if TRACE.level >= TraceLevel.FRAME:
            _log.debug("%s %s unit %d: %s", self._name, arrow, found.unit, found.raw.hex(" "))
        try:
            message: object = (
                self._functions.decode_request(found.pdu)
                if found.direction is not Direction.REPLY
                else self._functions.decode_reply(found.pdu)
            )
        except MalformedPdu as error:
            message = f"malformed: {error.reason}: {found.pdu.hex(' ')}"
        _log.debug("%s %s %d %s", self._name, arrow, found.unit, message)
