"""The switch of the trace: logs traffic at three levels, which can be changed at run time, and into a capture file.

Knows levels and interfaces of recorders; knows no frame: `mbap_trace` and `line_trace` write the log lines.

1. ``message``: each request and reply with its fields. ``frame``: the ADU in hexadecimal too. ``bytes``: the bytes of
   each receive and send too, in the pieces in which they were received or sent.
2. Off costs a driver one attribute test (``TRACE.level``). A capture file switches it on too, without log lines.
3. Lines go to the logger ``busway.trace`` at level DEBUG, lazily formatted.
"""

import logging
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

from .socket_addresses import SocketAddresses

if TYPE_CHECKING:
    from ..framing.received import FrameOrDamage

_log = logging.getLogger("busway.trace")


class TraceLevel(IntEnum):
    """How much of the traffic the log shows: nothing (CAPTURE and OFF), messages, frames or bytes.

    Each level shows also what the levels below it show.
    """

    CAPTURE = -1
    """No log lines, only a capture file. At the levels above OFF, a capture file is written besides the log lines."""
    OFF = 0
    MESSAGE = 1
    FRAME = 2
    BYTES = 3


class ConnectionRecorder(Protocol):
    """Interface of an object that records the bytes of one connection, such as in a capture file."""

    def received(self, data: bytes) -> None:
        """Record bytes that the connection received."""

    def sent(self, data: bytes) -> None:
        """Record bytes that the connection sent."""


class LineRecorder(Protocol):
    """Interface of an object that records the frames of one serial line, or of a connection with serial framing."""

    def heard(self, found: "FrameOrDamage", *, at: float | None = None, is_outgoing: bool = False) -> None:
        """Record a frame, or damaged bytes, that began at ``at`` (seconds since 1970; None for now).

        ``is_outgoing``: whether this program sent them.
        """


class Recorder(Protocol):
    """Interface of an object that records traffic, such as a capture file (`busway.observe.capture.Capture`)."""

    def connection(self, addresses: SocketAddresses) -> ConnectionRecorder:
        """Return a recorder for a connection between these addresses."""

    def line(self, name: str, *, is_server: bool = True) -> LineRecorder:
        """Return a recorder for the serial line with this name.

        ``is_server``: whether requests are received here, and replies sent.
        """


class Undecided(Protocol):
    """Interface of a line's log that holds received bytes, because it is not known yet whether they are a frame."""

    def settle(self) -> None:
        """Log the held bytes now, as frames or as damaged bytes."""


class Trace:
    """The switch of the traffic log, for all connections of the process. There is one object: `TRACE`.

    Attributes:
        level: how much is logged. Drivers check it before they pass traffic to a log.
        capture: recorder of the traffic, such as a capture file; None for none.
        undecided: logs of lines that hold received bytes of an unfinished frame.
    """

    __slots__ = ("capture", "level", "undecided")

    def __init__(self) -> None:
        self.level: TraceLevel = TraceLevel.OFF
        self.capture: Recorder | None = None
        self.undecided: set[Undecided] = set()

    def set(self, level: TraceLevel) -> None:
        """Log the traffic at this level from now on.

        Above OFF, the level of the logger ``busway.trace`` is set to DEBUG; its handlers must let DEBUG pass. OFF
        becomes CAPTURE while there is a recorder.
        """
        if level is TraceLevel.OFF and self.capture is not None:
            level = TraceLevel.CAPTURE
        self.level = level
        if level > TraceLevel.OFF:
            _log.setLevel(logging.DEBUG)

    def capture_into(self, capture: Recorder | None) -> None:
        """Record the traffic into a capture file or another recorder; None ends that.

        A connection that has been logged before keeps the recorder that it began with, or none: only connections whose
        log begins later use the new one.
        """
        self.settle()
        self.capture = capture
        self.set(TraceLevel.OFF if self.level is TraceLevel.CAPTURE else self.level)

    def settle(self) -> None:
        """Log the received bytes that logs of lines still hold, as frames or as damaged bytes."""
        for line in tuple(self.undecided):
            line.settle()


TRACE = Trace()
"""The switch of the traffic log of this process: the only `Trace` object."""
