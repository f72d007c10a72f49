"""Turns: connections that share an event loop are served in turn, so that a busy connection does not delay the others.

Knows who waits, in which order, and the clock; knows no connection and no request.

1. A connection does one share of work in a turn of the loop, and waits here if it has more to do. So a client that
   sends requests without end delays the others by one share in each turn, however many of its requests have arrived.
2. Priority hosts go first: new requests of theirs never wait here, and the rest of their requests is served in every
   turn.
3. Then come connections with few requests that found no time left in the turn in which they arrived, then those with
   more requests than one share. Each of these two kinds has its own queue, first come first served, and a part of every
   turn.
4. While no client sends more than a few requests at once, none waits, and nothing is timed.
"""

import asyncio
from collections import deque
from time import perf_counter as seconds  # by a name that tests can move
from typing import Final, Protocol

TURN_SECONDS: Final = 0.001
"""Seconds in one turn of the loop for the requests of all but priority hosts; one more share may be added."""
_QUEUE_SECONDS: Final = 0.0005
"""Part of `TURN_SECONDS` for connections that have waited. The rest is for requests that arrive in this turn."""


class Waiting(Protocol):
    """Interface of a connection with unprocessed requests that waits for its next turn on the event loop.

    Attributes:
        is_priority: whether the client is a priority host.
        is_greedy: whether the client has sent more requests than one share.
    """

    is_priority: bool
    is_greedy: bool

    def take_turn(self) -> bool:
        """Process requests for one share of a turn; returns whether some are left. Must not raise an exception."""


class Turns:
    """The queue of connections whose requests wait for their next turn on one event loop.

    Attributes:
        is_crowded: whether other connections wait, or the time of this turn is used up.
    """

    __slots__ = ("_greedy", "_is_due", "_loop", "_modest", "_preferred", "_until", "is_crowded")

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._preferred: deque[Waiting] = deque()
        self._modest: deque[Waiting] = deque()
        self._greedy: deque[Waiting] = deque()
        self._until = 0.0
        self._is_due = False  # the next turn will be told
        self.is_crowded: bool = False

    @property
    def has_time(self) -> bool:
        """Whether time is left for connections in the current turn of the event loop.

        False also before the first call of `worked` or `wait`, which start to time a turn.
        """
        return seconds() < self._until

    def worked(self) -> None:
        """Record that a connection has processed more than one request, or many bytes, in this turn.

        The first call in a turn starts to time it. A later one sets `is_crowded` if the time is used up.
        """
        if not self._is_due:
            self._begin()
        elif not self.has_time:
            self.is_crowded = True

    def wait(self, one: Waiting) -> None:
        """Put a connection into the queue for its next turn. It must not be in the queue already."""
        self._row(one).append(one)
        self.is_crowded = True
        if not self._is_due:
            self._begin()

    def _row(self, one: Waiting) -> deque[Waiting]:
        if one.is_priority:
            return self._preferred
        return self._greedy if one.is_greedy else self._modest

    def _begin(self) -> None:
        self._until = seconds() + TURN_SECONDS
        self._is_due = True
        self._loop.call_soon(self._next_turn)

    def _next_turn(self) -> None:
        """Let the queued connections process requests until the time of this turn is used up."""
        self._is_due = False
        if not self.is_crowded:
            return  # no connection waits
        began = seconds()
        self._work(self._preferred, None)
        self._work(self._modest, began + _QUEUE_SECONDS)
        self._work(self._greedy, began + _QUEUE_SECONDS)
        self.is_crowded = bool(self._preferred or self._modest or self._greedy)
        if self.is_crowded:
            self._begin()
            self._until = began + TURN_SECONDS

    def _work(self, row: deque[Waiting], until: float | None) -> None:
        """Let each connection in a queue process requests once, in order, until the time ``until``; None: no limit.

        The first connection is served even if the time is over. Connections with requests left are put into the queue
        again.
        """
        for _ in range(len(row)):
            one = row.popleft()
            if one.take_turn():
                self._row(one).append(one)
            if until is not None and seconds() >= until:
                return
