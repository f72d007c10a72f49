"""Traffic of RTU and ASCII lines as log lines, and into a capture file; the levels are those of `busway.observe.trace`.

Knows frames and messages; knows no port: a driver hands it what it received and sent. It follows the line as an
observer does, so frames of others are shown too.
"""

import logging
import time
from typing import Protocol

from ..framing.conversation import Role
from ..framing.received import Damaged, Direction, Received
from ..framing.timing import SerialTiming
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed import MalformedPdu
from ..session.line_framing import line_framing
from .trace import TRACE, StreamTrace, TraceLevel

_log = logging.getLogger("busway.trace")


class Trace(Protocol):
    """Shows one connection."""

    def received(self, data: bytes) -> None:
        """Show what came in."""

    def sent(self, data: bytes) -> None:
        """Show what went out."""

    def note(self, text: str) -> None:
        """Show what the frames do not tell."""


def trace_for(framing: str, name: str, *, is_server: bool, carrier: object = None) -> Trace:
    """The trace of a connection whose framing is ``mbap``, ``rtu`` or ``ascii``.

    ``carrier`` is its socket or transport, from which a capture file has its addresses.
    """
    if framing == "mbap":
        return StreamTrace(name, is_server=is_server, carrier=carrier)
    return LineTrace(framing, name)


class LineTrace:
    """Shows one line."""

    __slots__ = ("_capture", "_functions", "_name", "_receiver")

    def __init__(self, framing: str, name: str, functions: FunctionTable = STANDARD) -> None:
        self._capture = None if TRACE.capture is None else TRACE.capture.line(name)
        self._name = name
        self._functions = functions
        self._receiver = line_framing(framing, Role.OBSERVER, SerialTiming.of_network(), functions=functions).receiver

    def received(self, data: bytes) -> None:
        """Show what came in."""
        self._take("<", data)

    def sent(self, data: bytes) -> None:
        """Show what went out."""
        self._take(">", data)

    def note(self, text: str) -> None:
        """Show what the frames do not tell."""
        if TRACE.level >= TraceLevel.MESSAGE:
            _log.debug("%s %s", self._name, text)

    def _take(self, arrow: str, data: bytes) -> None:
        if TRACE.level >= TraceLevel.BYTES:
            _log.debug("%s %s %d bytes: %s", self._name, arrow, len(data), data.hex(" "))
        now = time.monotonic()
        for found in self._receiver.receive(data, now):
            if self._capture is not None:
                self._capture.heard(found, at=time.time() - (now - found.began), is_outgoing=arrow == ">")
            if TRACE.level >= TraceLevel.MESSAGE:
                self._show(arrow, found)

    def _show(self, arrow: str, found: Received) -> None:
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
