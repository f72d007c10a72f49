"""The ways by which bytes leave a server, for whoever sends something else by them than the handler's replies.

Knows where a way is and what it takes; knows no request. A simulated device that answers twice, in pieces or not in
time does it here: its handler says `SILENCE`, and what is sent instead goes out by the wire.

1. Nothing asks for a wire while a request is answered: whoever is told of them keeps them, and finds them by listener
   and peer, the names that a request's context has. Without anybody to tell, none are made.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class TappedConnection:
    """One way: a connection, a peer over UDP, or an open serial port.

    Attributes:
        listener, peer: as in `RequestContext`.
        framing: ``mbap``, ``rtu`` or ``ascii``.
        carrier: ``tcp``, ``tls``, ``udp`` or ``serial``.
        gap: seconds of silence that a frame needs before it; 0 over a network.
        send: sends bytes as they are, at the end of this turn of the event loop at the latest.
        close: closes the connection behind what was sent; where there is none, nothing happens.
    """

    listener: str
    peer: str
    framing: str
    carrier: str
    gap: float
    send: Callable[[bytes], None]
    close: Callable[[], None]


class ConnectionTap(Protocol):
    """Is told of every way; in the thread of the server's event loop."""

    def connection_opened(self, connection: TappedConnection) -> None:
        """A connection has a place, a peer was heard for the first time, or a port was opened."""

    def connection_closed(self, connection: TappedConnection) -> None:
        """It is there no more."""


def stay() -> None:
    """What `TappedConnection.close` does where no connection is."""
