"""Timeouts of a listener's connections: which connections are overdue, and when to check again.

Pure: knows connections and the times that it is given; closes nothing and has no timer. One check serves all
connections.

1. A frame that has begun has a timeout for its header and a timeout for the whole; both run from its first byte.
2. Replies that a client does not read have a timeout; it starts anew when the client reads some of them.
3. A connection that is paused has a time at which reading is resumed.
4. Idle connections are looked for 16 times per idle timeout, so that the check costs little with thousands of them: a
   connection is closed late by at most a sixteenth of the timeout.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, Protocol, TypeVar

from ..options.server import ListenerParameters

HEADER_SIZE: Final = 7
"""Bytes of an MBAP header (Messaging on TCP/IP V1.0b §3.1.3)."""
_LOOKS: Final = 16


class Timed(Protocol):
    """Interface of a connection whose timeouts are watched.

    Attributes:
        last_used: when it was last used, in seconds of the clock of ``now`` in `Deadlines`.
    """

    last_used: float

    @property
    def unfinished(self) -> int:
        """Number of received bytes that belong to an incomplete frame."""

    @property
    def unsent(self) -> int:
        """Number of reply bytes that the socket has not taken yet."""

    @property
    def is_idle(self) -> bool:
        """Whether the idle timeout, once it is over, may close the connection.

        It may not while a request is incomplete or in progress, a reply is unsent, or reading is paused; never if the
        client is a priority host.
        """


One = TypeVar("One", bound=Timed)


class Overdue(Enum):
    """What has run out for a connection: its header, frame, write or idle timeout, or the pause of reading."""

    HEADER = "header_timeout"
    FRAME = "frame_timeout"
    WRITE = "write_timeout"
    IDLE = "idle_timeout"
    PAUSE = "pause"


@dataclass(slots=True)
class _Stuck:
    since: float
    unsent: int


class Deadlines(Generic[One]):
    """The running timeouts and pauses of all connections of one listener."""

    def __init__(self, parameters: ListenerParameters) -> None:
        self._parameters = parameters
        self._begun: dict[One, float] = {}
        self._stuck: dict[One, _Stuck] = {}
        self._paused: dict[One, float] = {}
        self._next_look: float | None = None

    # What happens.

    def frame_begun(self, one: One, now: float, *, anew: bool) -> float | None:
        """Start the timeout of a frame that was received in part, at ``now`` (seconds).

        Returns the time at which to call `due`; None if no timeout of the listener applies to the frame. ``anew``: True
        for a frame that began just now; False if it may have begun earlier: a running timeout then stays.
        """
        since = self._begun[one] = now if anew else self._begun.get(one, now)
        return self._frame_deadline(one, since)

    def stuck(self, one: One, now: float) -> float | None:
        """Start the write timeout of a client that has stopped reading its replies, at ``now`` (seconds).

        Returns the time at which to call `due`; None if the listener has no write timeout.
        """
        timeout = self._parameters.write_timeout
        if timeout is None:
            return None
        self._stuck[one] = _Stuck(now, one.unsent)
        return now + timeout

    def taken(self, one: One) -> None:
        """Stop the write timeout of a client that reads its replies again."""
        self._stuck.pop(one, None)

    def pause(self, one: One, until: float) -> float:
        """Record that reading from a connection is paused until the time ``until`` (seconds). Returns ``until``."""
        self._paused[one] = until
        return until

    def is_paused(self, one: One) -> bool:
        """Whether reading from a connection is paused: from `pause` until `due` has returned its end, or `forget`."""
        return one in self._paused

    def forget(self, one: One) -> None:
        """Drop all timeouts of a connection that has ended."""
        self._begun.pop(one, None)
        self._stuck.pop(one, None)
        self._paused.pop(one, None)

    # What is due.

    def next_due(self, now: float, *, has_connections: bool) -> float | None:
        """Return the time (seconds) at which to call `due` next; None while no timeout or pause runs.

        ``has_connections``: whether any connection is open. If so, this call sets when idle ones are looked for, unless
        that is set already.
        """
        times = [self._frame_deadline(one, since) for one, since in self._begun.items()]
        times += [stuck.since + (self._parameters.write_timeout or 0.0) for stuck in self._stuck.values()]
        times += self._paused.values()
        if self._parameters.idle_timeout is not None and has_connections:
            if self._next_look is None:
                self._next_look = now + self._parameters.idle_timeout / _LOOKS
            times.append(self._next_look)
        return min((one for one in times if one is not None), default=None)

    def due(self, connections: Iterable[One], now: float) -> list[tuple[One, Overdue]]:
        """Return each connection whose timeout or pause is over at ``now``, together with what is over.

        A timeout of a frame or a write, or a pause, is returned once and then forgotten. Idle connections are searched
        among ``connections``, which has all open ones, only at the times that `next_due` has set (rule 4). They are
        returned again each time until they are closed. A connection can be in the list more than once.
        """
        found = [*self._frames(now), *self._writes(now)]
        for one, until in list(self._paused.items()):
            if now >= until:
                del self._paused[one]
                found.append((one, Overdue.PAUSE))
        idle = self._parameters.idle_timeout
        if idle is not None and self._next_look is not None and now >= self._next_look:
            self._next_look = None
            found += [(one, Overdue.IDLE) for one in connections if now >= one.last_used + idle and one.is_idle]
        return found

    def _frame_deadline(self, one: One, since: float) -> float | None:
        whole, header = self._parameters.frame_timeout, self._parameters.header_timeout
        if header is not None and one.unfinished < HEADER_SIZE:
            return since + (header if whole is None else min(header, whole))
        return None if whole is None else since + whole

    def _frames(self, now: float) -> list[tuple[One, Overdue]]:
        found = []
        whole = self._parameters.frame_timeout
        for one, since in list(self._begun.items()):
            deadline = self._frame_deadline(one, since)
            if not one.unfinished:
                del self._begun[one]
            elif deadline is not None and now >= deadline:
                del self._begun[one]
                in_header = whole is None or deadline < since + whole
                found.append((one, Overdue.HEADER if in_header else Overdue.FRAME))
        return found

    def _writes(self, now: float) -> list[tuple[One, Overdue]]:
        found = []
        timeout = self._parameters.write_timeout or 0.0
        for one, stuck in list(self._stuck.items()):
            if now < stuck.since + timeout:
                continue
            if one.unsent < stuck.unsent:
                stuck.since, stuck.unsent = now, one.unsent
            else:
                del self._stuck[one]
                found.append((one, Overdue.WRITE))
        return found
