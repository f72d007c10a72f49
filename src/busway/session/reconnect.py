"""When a connection may be made anew: one table of states, and a backoff.

Knows outcomes and times; knows no socket. ``jitter`` is handed in (a number 0…1 per call), so a test can fix it.

1. A connection that brought a valid reply and ends is made anew at the next need, at once.
2. One that could not be had, or ended without a valid reply, is followed by a pause that doubles each time. Only a
   valid reply resets it: a peer that accepts and closes is not a peer that works.
"""

from collections.abc import Callable
from enum import Enum


class ConnectionState(Enum):
    """Where a link stands."""

    DOWN = "down"
    CONNECTING = "connecting"
    UP = "up"
    SUSPECT = "suspect"
    BACKING_OFF = "backing off"


class ConnectionEvent(Enum):
    """What moves it."""

    DIALLED = "dialled"
    CONNECTED = "connected"
    FAILED = "failed"
    LOST = "lost"
    VALID_REPLY = "valid reply"
    TIMEOUT = "timeout"
    PAUSE_OVER = "pause over"


_S, _E = ConnectionState, ConnectionEvent

TRANSITIONS: dict[tuple[ConnectionState, ConnectionEvent], ConnectionState] = {
    (_S.DOWN, _E.DIALLED): _S.CONNECTING,
    (_S.BACKING_OFF, _E.PAUSE_OVER): _S.DOWN,
    (_S.CONNECTING, _E.CONNECTED): _S.UP,
    (_S.CONNECTING, _E.FAILED): _S.BACKING_OFF,
    (_S.UP, _E.VALID_REPLY): _S.UP,
    (_S.UP, _E.TIMEOUT): _S.SUSPECT,
    (_S.SUSPECT, _E.VALID_REPLY): _S.UP,
    (_S.SUSPECT, _E.TIMEOUT): _S.SUSPECT,
    (_S.UP, _E.LOST): _S.DOWN,
    (_S.SUSPECT, _E.LOST): _S.DOWN,
}
"""LOST leads to BACKING_OFF instead where the connection brought no valid reply (rule 2)."""


class Reconnect:
    """The state of one link's connection.

    Attributes:
        state: where it stands.
        failures: connections in a row that brought no valid reply.
        not_before: when the next attempt may be made, in the clock of ``now``.
    """

    __slots__ = ("_first", "_jitter", "_most", "failures", "not_before", "state")

    def __init__(self, jitter: Callable[[], float], *, first: float = 0.1, most: float = 5.0) -> None:
        self._jitter = jitter
        self._first = first
        self._most = most
        self.state = ConnectionState.DOWN
        self.failures = 0
        self.not_before = 0.0

    def move(self, event: ConnectionEvent, now: float, *, had_reply: bool = False) -> None:
        """Follow an event. One that the table does not know in this state changes nothing."""
        target = TRANSITIONS.get((self.state, event))
        if target is None:
            return
        if event is ConnectionEvent.VALID_REPLY or (event is ConnectionEvent.LOST and had_reply):
            self.failures = 0
        elif event in (ConnectionEvent.FAILED, ConnectionEvent.LOST):
            self.failures += 1
            pause = min(self._first * 2 ** min(self.failures - 1, 16), self._most)
            self.not_before = now + pause * (0.5 + 0.5 * self._jitter())
            target = ConnectionState.BACKING_OFF
        self.state = target

    def may_dial(self, now: float) -> bool:
        """Whether a connection may be made now; ends a pause that is over."""
        if self.state is ConnectionState.BACKING_OFF and now >= self.not_before:
            self.move(ConnectionEvent.PAUSE_OVER, now)
        return self.state is ConnectionState.DOWN
