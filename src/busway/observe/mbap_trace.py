"""Trace of MBAP traffic (TCP, TLS, UDP): log lines, and bytes in a capture file; levels as in `busway.observe.trace`.

Knows frames and messages; knows no connection: a driver passes in what it received and sent.
"""

import logging

from ..framing.mbap import FrameKind, MbapFrame, MbapReceiver
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed_pdu import MalformedPdu
from .socket_addresses import socket_addresses_of
from .trace import TRACE, TraceLevel

_log = logging.getLogger("busway.trace")


class MbapTrace:
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
