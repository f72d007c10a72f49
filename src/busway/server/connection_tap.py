"""The connection tap: lets a simulated device send bytes of its own on the connections of a server.

Knows connections and how to send on them; knows no request. A simulated device that answers twice, in pieces or late
uses it: its responder returns `SILENCE`, and sends its own bytes on the tapped connection.

1. The tap itself keeps the connections that it was told of, and finds the one of a request by the listener and peer in
   the request's context. Without a tap no tapped connections are made.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class TappedConnection:
    """An open connection, UDP peer or serial port on which a connection tap can send bytes of its own.

    Attributes:
        listener, peer: URL of the listener and address of the client, as in `RequestContext`.
        framing: ``mbap``, ``rtu`` or ``ascii``.
        carrier: ``tcp``, ``tls``, ``udp`` or ``serial``.
        gap: seconds of silence that the line needs before a frame; 0 over a network.
        send: sends bytes as they are, without a frame around them, at the end of this turn of the event loop at the
            latest; they are lost if the connection has ended.
        close: closes the connection after the bytes sent so far; does nothing over UDP and on a serial port.
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


def do_not_close() -> None:
    """Do nothing: this is `TappedConnection.close` of a UDP peer or a serial port, which cannot be closed."""
