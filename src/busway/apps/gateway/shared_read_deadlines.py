"""Deadlines of clients that share a read: each client has its own, and the read goes on for the others.

Knows waiters and times; knows no read. There is one timer for each shared read, set to the nearest deadline. A read
that only one client waits for has no timer here: its call has the deadline.
"""

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

Waiter = TypeVar("Waiter")


class DeadlineTimer(Protocol):
    """Interface of a timer that can be cancelled."""

    def cancel(self) -> None:
        """Cancel the timer, so that it calls nothing."""


CallAt = Callable[[float, Callable[[], None]], DeadlineTimer]
"""Function that starts a timer: it takes a time in seconds, and a function that the timer calls once at that time."""


class SharedReadDeadlines(Generic[Waiter]):
    """The deadlines of clients that wait for the same read, watched by one timer for the earliest deadline.

    Args:
        now: returns the time in seconds, by the clock of the deadlines.
        call_at: starts a timer of that clock.
        over: called with each waiter whose deadline has passed, after the waiter was forgotten here.
    """

    __slots__ = ("_call_at", "_deadlines", "_now", "_over", "_timer")

    def __init__(self, now: Callable[[], float], call_at: CallAt, over: Callable[[Waiter], None]) -> None:
        self._now = now
        self._call_at = call_at
        self._over = over
        self._deadlines: list[tuple[float, Waiter]] = []
        self._timer: DeadlineTimer | None = None

    def add(self, waiter: Waiter, deadline: float) -> None:
        """Add a client that waits for the read.

        Args:
            waiter: the client, in the form in which ``over`` gets it.
            deadline: when the client must be answered, in seconds by the clock of ``now``.
        """
        self._deadlines.append((deadline, waiter))
        if self._timer is None or deadline < self._nearest(self._deadlines[:-1]):
            self._arm()

    def close(self) -> None:
        """Forget all deadlines and cancel the timer, because the shared read has ended; ``over`` is not called."""
        self._deadlines.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    @staticmethod
    def _nearest(deadlines: list[tuple[float, Waiter]]) -> float:
        return min(deadline for deadline, _ in deadlines)

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._call_at(self._nearest(self._deadlines), self._ring)

    def _ring(self) -> None:
        self._timer = None
        now = self._now()
        late = [waiter for deadline, waiter in self._deadlines if deadline <= now]
        self._deadlines = [one for one in self._deadlines if one[0] > now]
        for waiter in late:
            self._over(waiter)
        if self._deadlines and self._timer is None:
            self._arm()
