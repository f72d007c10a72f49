"""Traffic as log lines, at three levels that can be switched while the program runs.

Knows frames and messages; knows no connection: a driver hands it what it received and sent.

1. ``message``: each request and reply with its fields. ``frame``: the ADU in hexadecimal too. ``bytes``: what each
   receive and send carried, however it was cut.
2. Off costs a driver one attribute test (``TRACE.level``).
3. Lines go to the logger ``busway.trace`` at level DEBUG, lazily formatted.
"""

import logging
from enum import IntEnum

from ..framing.mbap import FrameKind, MbapFrame, MbapReceiver
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed import MalformedPdu

_log = logging.getLogger("busway.trace")


class TraceLevel(IntEnum):
    """How much is shown."""

    OFF = 0
    MESSAGE = 1
    FRAME = 2
    BYTES = 3


class Trace:
    """The switch. One for the process: `TRACE`."""

    __slots__ = ("level",)

    def __init__(self) -> None:
        self.level = TraceLevel.OFF

    def set(self, level: TraceLevel) -> None:
        """Show traffic from now on; the logger ``busway.trace`` must let DEBUG pass."""
        self.level = level
        if level:
            _log.setLevel(logging.DEBUG)


TRACE = Trace()


class StreamTrace:
    """Shows one MBAP connection."""

    __slots__ = ("_functions", "_incoming", "_is_server", "_name", "_outgoing")

    def __init__(self, name: str, *, is_server: bool, functions: FunctionTable = STANDARD) -> None:
        self._name = name
        self._is_server = is_server
        self._functions = functions
        self._incoming = MbapReceiver()
        self._outgoing = MbapReceiver()

    def received(self, data: bytes) -> None:
        """Show what came in."""
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s < %d bytes: %s", self._name, len(data), data.hex(" "))
        for frame in self._incoming.receive(data):
            self._show("<", frame, is_request=self._is_server)

    def sent(self, data: bytes) -> None:
        """Show what went out."""
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s > %d bytes: %s", self._name, len(data), data.hex(" "))
        for frame in self._outgoing.receive(data):
            self._show(">", frame, is_request=not self._is_server)

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
