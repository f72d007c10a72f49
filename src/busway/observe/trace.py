"""Trace: logs the traffic of connections, at three levels that can be switched at run time, and into a capture file.

Knows frames and messages; knows no connection: a driver passes in what it received and sent.

1. ``message``: each request and reply with its fields. ``frame``: the ADU in hexadecimal too. ``bytes``: the bytes of
   each receive and send too, in the pieces in which they were received or sent.
2. Off costs a driver one attribute test (``TRACE.level``). A capture file switches it on too, without log lines.
3. Lines go to the logger ``busway.trace`` at level DEBUG, lazily formatted.
"""

import logging
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

from ..framing.mbap import FrameKind, MbapFrame, MbapReceiver
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed import MalformedPdu
from .socket_addresses import SocketAddresses, socket_addresses_of

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


class StreamTrace:
    """Log of the traffic of one MBAP connection.

    If a capture file is in use (``TRACE.capture``) when the log is created, the bytes are recorded there too.

    Args:
        name: name of the connection in the log.
        is_server: whether requests are received here, and replies sent.
        functions: the table of functions with which messages are decoded.
        carrier: socket or transport of the connection, from which a capture file has its addresses.
    """

    __slots__ = ("_capture", "_functions", "_incoming", "_is_server", "_name", "_outgoing")

    def __init__(
        self, name: str, *, is_server: bool, functions: FunctionTable = STANDARD, carrier: object = None
    ) -> None:
        self._capture = None if TRACE.capture is None else TRACE.capture.connection(socket_addresses_of(carrier))
        self._name = name
        self._is_server = is_server
        self._functions = functions
        self._incoming = MbapReceiver()
        self._outgoing = MbapReceiver()

    def received(self, data: bytes) -> None:
        """Log bytes that the connection received, at the present level, and write them to the capture file, if any."""
        if self._capture is not None:
            self._capture.received(data)
        if TRACE.level < TraceLevel.MESSAGE:
            return
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s < %d bytes: %s", self._name, len(data), data.hex(" "))
        for frame in self._incoming.receive(data):
            self._show("<", frame, is_request=self._is_server)

    def sent(self, data: bytes) -> None:
        """Log bytes that the connection sent, at the present level, and write them to the capture file, if any."""
        if self._capture is not None:
            self._capture.sent(data)
        if TRACE.level < TraceLevel.MESSAGE:
            return
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s > %d bytes: %s", self._name, len(data), data.hex(" "))
        for frame in self._outgoing.receive(data):
            self._show(">", frame, is_request=not self._is_server)

    def note(self, text: str) -> None:
        """Log an event of the connection that its frames do not show."""
        if TRACE.level >= TraceLevel.MESSAGE:
            _log.debug("%s %s", self._name, text)

    def _show(self, arrow: str, frame: MbapFrame, *, is_request: bool) -> None:
        if frame.kind is not FrameKind.FRAME:
            _log.debug("%s %s %s: %s", self._name, arrow, frame.kind.value, frame.reason or frame.protocol)
            return
        if TRACE.level >= TraceLevel.FRAME:
            _log.debug(
                "%s %s transaction %d unit %d: %s",
                self._name,
                arrow,
                frame.transaction,
                frame.unit,
                frame.pdu.hex(" "),
            )
        try:
            message: object = (
                self._functions.decode_request(frame.pdu) if is_request else self._functions.decode_reply(frame.pdu)
            )
        except MalformedPdu as error:
            message = f"malformed: {error.reason}: {frame.pdu.hex(' ')}"
        _log.debug("%s %s %d/%d %s", self._name, arrow, frame.transaction, frame.unit, message)
