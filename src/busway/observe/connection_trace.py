"""The trace of one connection, of the kind that fits its framing.

Knows the framings by name; `mbap_trace` and `line_trace` write the log lines.
"""

from typing import Protocol

from .line_trace import LineTrace
from .mbap_trace import MbapTrace


class ConnectionTrace(Protocol):
    """Interface of an object that logs the traffic of one connection."""

    def received(self, data: bytes) -> None:
        """Log bytes that the connection received."""

    def sent(self, data: bytes) -> None:
        """Log bytes that the connection sent."""

    def note(self, text: str) -> None:
        """Log an event of the connection that its frames do not show."""


def trace_for(framing: str, name: str, *, is_server: bool, carrier: object = None) -> ConnectionTrace:
    """Return a new log for a connection.

    Args:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        name: name of the connection in the log.
        is_server: whether requests are received here, and replies sent.
        carrier: socket or transport of the connection, from which a capture file has its addresses; used for ``mbap``
            only.
    """
    if framing == "mbap":
        return MbapTrace(name, is_server=is_server, carrier=carrier)
    return LineTrace(framing, name, is_server=is_server)
