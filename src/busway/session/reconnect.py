"""When a connection may be made anew: one table of states, and a backoff.

Knows outcomes and times; knows no socket. ``jitter`` is handed in (a number 0…1 per call), so a test can fix it.

1. A connection that brought a valid reply and ends is made anew at the next need, at once.
2. One that could not be had, or ended without a valid reply, is followed by a pause that doubles each time. Only a
   valid reply resets it: a peer that accepts and closes is not a peer that works.
3. One that ends while nothing was ever asked on it, or is closed because nobody uses it, proves nothing either way.
4. Every change is news once. Attempts that fail in a row are counted, and told when something answers again.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final


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
    RELEASED = "released"
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
    (_S.UP, _E.RELEASED): _S.DOWN,
    (_S.SUSPECT, _E.RELEASED): _S.DOWN,
}
"""LOST leads to BACKING_OFF instead where the connection brought no valid reply (rule 2). RELEASED is an end that
proves nothing (rule 3)."""

FIRST_PAUSE: Final = 0.1
"""Seconds of the first pause."""
LONGEST_PAUSE: Final = 5.0
"""Seconds of the longest pause: so long an operator waits at most for a device that is back."""


class Reconnect:
    """The state of one link's connection.

    Attributes:
        state: where it stands.
        failures: connections in a row that brought no valid reply.
        not_before: when the next attempt may be made, in the clock of ``now``.
    """

    __slots__ = ("_first", "_jitter", "_most", "failures", "not_before", "state")

    def __init__(self, jitter: Callable[[], float], *, first: float = FIRST_PAUSE, most: float = LONGEST_PAUSE) -> None:
        self._jitter = jitter
        self._first = first
        self._most = most
        self.state = ConnectionState.DOWN
        self.failures = 0
        self.not_before = 0.0

    def move(self, event: ConnectionEvent, now: float, *, reason: str = "", had_reply: bool = False) -> str:
        """Follow an event. One that the table does not know in this state changes nothing.

        Args:
            event: what happened.
            now: when, in seconds.
            reason: why, in words.
            had_reply: of a connection that was lost, whether it had brought a valid reply.

        Returns:
            What there is to tell about it, or an empty text where nothing is new.
        """
        before, failed = self.state, self.failures
        target = TRANSITIONS.get((before, event))
        if target is None:
            return ""
        if event is ConnectionEvent.VALID_REPLY or (event is ConnectionEvent.LOST and had_reply):
            self.failures = 0
        elif event in (ConnectionEvent.FAILED, ConnectionEvent.LOST):
            self.failures += 1
            pause = min(self._first * 2 ** min(self.failures - 1, 16), self._most)
            self.not_before = now + pause * (0.5 + 0.5 * self._jitter())
            target = ConnectionState.BACKING_OFF
        self.state = target
        return _news(event, reason, failed, target, new_state=before is not target)

    @property
    def is_flapping(self) -> bool:
        """Whether it backs off after more than one attempt: then nobody is kept waiting for the next one."""
        return self.state is ConnectionState.BACKING_OFF and self.failures > 1

    def may_dial(self, now: float) -> bool:
        """Whether a connection may be made now; ends a pause that is over."""
        if self.state is ConnectionState.BACKING_OFF and now >= self.not_before:
            self.move(ConnectionEvent.PAUSE_OVER, now)
        return self.state is ConnectionState.DOWN


def _news(event: ConnectionEvent, reason: str, failed: int, state: ConnectionState, *, new_state: bool) -> str:
    """What is new about an event, after ``failed`` attempts in a row without a valid reply."""
    if event is ConnectionEvent.VALID_REPLY:
        if failed:
            return f"up: it answers again, after {failed} {'attempt' if failed == 1 else 'attempts'} without a reply"
        return "up: it answers again" if new_state else ""
    if failed or not new_state:
        return ""
    if event is ConnectionEvent.CONNECTED:
        return "up: connected"
    if event is ConnectionEvent.TIMEOUT:
        return "suspect: no reply in time"
    if event in (ConnectionEvent.FAILED, ConnectionEvent.LOST, ConnectionEvent.RELEASED):
        return f"{state.value}: {reason}"
    return ""
