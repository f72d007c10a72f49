"""The connection tap: lets a simulated device send bytes of its own on the connections of a server.

Knows connections and how to send on them; knows no request. A simulated device that answers twice, in pieces or late
uses it: its responder returns `SILENCE`, and sends its own bytes on the tapped connection.

1. Answering a request looks up no tapped connection: the tap keeps those it is given, and finds them by listener and
   peer, as a request's context names them. Without a tap none are made.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class TappedConnection:
    """An open connection, UDP peer or serial port on which a connection tap can send bytes of its own.

    Attributes:
        listener, peer: as in `RequestContext`.
        framing: ``mbap``, ``rtu`` or ``ascii``.
        carrier: ``tcp``, ``tls``, ``udp`` or ``serial``.
        gap: seconds of silence that a frame needs before it; 0 over a network.
        send: sends bytes as they are, at the end of this turn of the event loop at the latest.
        close: closes the connection after what was sent; does nothing over UDP and on a serial port.
    """

    listener: str
    peer: str
    framing: str
    carrier: str
    gap: float
    send: Callable[[bytes], None]
    close: Callable[[], None]


class ConnectionTap(Protocol):
    """Observer of a server's opened and closed connections, called in the thread of the server's event loop."""

    def connection_opened(self, connection: TappedConnection) -> None:
        """Called when a connection was admitted, a UDP peer sent its first datagram, or a serial port was opened."""

    def connection_closed(self, connection: TappedConnection) -> None:
        """Called when a connection or port was closed, or a UDP peer was forgotten."""


def stay() -> None:
    """Do nothing when asked to close a UDP peer or serial port, which cannot be closed (`TappedConnection.close`)."""
