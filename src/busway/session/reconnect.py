"""When a link connects again: the states of its connection, and the pauses between attempts.

Knows outcomes and times; knows no socket. ``jitter`` is passed in (it returns a number 0…1), so a test can fix it.

1. After a connection that brought a valid reply, the next request reconnects at once.
2. After a connection that could not be opened, or ended without a valid reply, there is a pause. It doubles each time.
   Only a valid reply resets it: a peer that accepts connections and closes them does not work.
3. A connection that ends without any request sent, or is closed because it is unused, changes neither pause nor count.
4. A change of state gives one log message at most. Of several failures in a row only the first gives one; the message
   when the peer answers again has their number.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final


class ConnectionState(Enum):
    """States of a client's connection.

    DOWN: not connected, and an attempt may be made at once. CONNECTING: an attempt is in progress. UP: connected.
    SUSPECT: connected, and the last request timed out. BACKING_OFF: not connected, in a pause before the next attempt.
    """

    DOWN = "down"
    CONNECTING = "connecting"
    UP = "up"
    SUSPECT = "suspect"
    BACKING_OFF = "backing off"


class ConnectionEvent(Enum):
    """Events that change the state of a client's connection.

    DIALLED: an attempt to connect has begun. CONNECTED, FAILED: how it ended. LOST: the connection ended unexpectedly.
    RELEASED: it was closed as unused. VALID_REPLY: it has brought a valid reply. TIMEOUT: a request timed out.
    PAUSE_OVER: the pause before the next attempt is over.
    """

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
"""The next state, by present state and event; an event without an entry changes nothing.

LOST leads to BACKING_OFF instead if the connection brought no valid reply (rule 2). RELEASED is an end that counts
neither as a success nor as a failure (rule 3).
"""

FIRST_PAUSE: Final = 0.1
"""Longest time of the first pause, in seconds; with jitter a pause lasts half to all of its longest time."""
LONGEST_PAUSE: Final = 5.0
"""Most seconds of any pause: a device that is back waits no longer than this to be connected to."""


class Reconnect:
    """State of one link's connection, and the pause before its next attempt to connect.

    Args:
        jitter: returns a random number 0…1, for the length of a pause.
        first: longest time of the first pause, in seconds; it doubles with each further failure.
        most: longest time of any pause, in seconds.

    Attributes:
        state: the current state.
        failures: number of attempts and connections in a row that brought no valid reply.
        is_settled: whether the state is UP and there are no such failures: then a valid reply changes nothing.
        not_before: when the next attempt may be made, in the clock of ``now``.
    """

    __slots__ = ("_first", "_jitter", "_most", "failures", "is_settled", "not_before", "state")

    def __init__(self, jitter: Callable[[], float], *, first: float = FIRST_PAUSE, most: float = LONGEST_PAUSE) -> None:
        self._jitter = jitter
        self._first = first
        self._most = most
        self.state: ConnectionState = ConnectionState.DOWN
        self.failures: int = 0
        self.is_settled: bool = False
        self.not_before: float = 0.0

    def move(self, event: ConnectionEvent, now: float, *, reason: str = "", had_reply: bool = False) -> str:
        """Change the state of the connection by an event. An event without an entry in `TRANSITIONS` changes nothing.

        Args:
            event: the event.
            now: the time of the event, in seconds.
            reason: the cause of the event, in words.
            had_reply: for `LOST`: whether the connection had brought a valid reply.

        Returns:
            A message for the log, or an empty text if there is nothing new.
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
        self.is_settled = target is ConnectionState.UP and not self.failures
        return _news(event, reason, failed, target, new_state=before is not target)

    def begin_again(self) -> None:
        """Reset to the state DOWN, in which the next attempt may be made at once; the number of failures stays."""
        self.state = ConnectionState.DOWN
        self.is_settled = False

    @property
    def is_flapping(self) -> bool:
        """Whether the link pauses after at least two attempts or connections in a row without a valid reply.

        Then calls fail at once instead of waiting for the next attempt.
        """
        return self.state is ConnectionState.BACKING_OFF and self.failures > 1

    def may_dial(self, now: float) -> bool:
        """Whether an attempt to connect may be made now. Also ends the state BACKING_OFF if its pause is over."""
        if self.state is ConnectionState.BACKING_OFF and now >= self.not_before:
            self.move(ConnectionEvent.PAUSE_OVER, now)
        return self.state is ConnectionState.DOWN


def _news(event: ConnectionEvent, reason: str, failed: int, state: ConnectionState, *, new_state: bool) -> str:
    """Return the log message for a connection event; empty if it needs none.

    ``failed``: attempts and connections in a row without a valid reply before the event. ``state``: the state after the
    event. ``new_state``: whether that differs from the state before.
    """
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
