"""Clocks that time delayed replies: that of an event loop, and a fake clock that a test moves by hand.

Knows times and callbacks; knows no Modbus.

1. `FakeClock` moves only in `FakeClock.advance`, which makes the scheduled calls in order, in the thread that calls it.
2. Functions can be scheduled with a `FakeClock` from any thread; with a `LoopClock` only in the thread of its loop.
"""

import asyncio
import heapq
import itertools
import threading
from collections.abc import Callable
from typing import Protocol


class Timer(Protocol):
    """Interface of a scheduled function call, which can be cancelled."""

    def cancel(self) -> None:
        """Cancel the scheduled function call; no effect if the call was made already."""


class Clock(Protocol):
    """Interface of a clock with timers: it tells the time, and calls a function when a given time has come."""

    def now(self) -> float:
        """Return the current time in seconds, monotonic."""

    def call_at(self, when: float, callback: Callable[[], object]) -> Timer:
        """Schedule one call of ``callback`` for the time ``when`` (seconds of this clock); returns the timer.

        If ``when`` is over already, the call comes soon: in the event loop, or at the next `FakeClock.advance`. From
        which threads it may be used: rule 2.
        """


class LoopClock:
    """The clock of an asyncio event loop, with its scheduled calls.

    Args:
        loop: the loop in whose thread callbacks run.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop

    def now(self) -> float:
        """Return the current time of the event loop, in seconds."""
        return self._loop.time()

    def call_at(self, when: float, callback: Callable[[], object]) -> Timer:
        """Schedule one call of ``callback`` for the time ``when`` (seconds of the loop's clock); returns the timer."""
        return self._loop.call_at(when, callback)


class FakeTimer:
    """A function call scheduled with a fake clock.

    Attributes:
        when: time of the call, in seconds of the clock.
        callback: the function to call.
        cancelled: whether the call was cancelled.
    """

    __slots__ = ("callback", "cancelled", "when")

    def __init__(self, when: float, callback: Callable[[], object]) -> None:
        self.when: float = when
        self.callback: Callable[[], object] = callback
        self.cancelled: bool = False

    def cancel(self) -> None:
        """Cancel the scheduled function call; no effect if the call was made already."""
        self.cancelled = True


class FakeClock:
    """A clock for tests: it moves only when `advance` is called, and makes scheduled calls then.

    Args:
        now: seconds that it shows at first.
    """

    def __init__(self, now: float = 0.0) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._order = itertools.count()
        self._timers: list[tuple[float, int, FakeTimer]] = []

    def now(self) -> float:
        """Return the current time of the fake clock, in seconds."""
        return self._now

    def call_at(self, when: float, callback: Callable[[], object]) -> FakeTimer:
        """Schedule one call of ``callback`` for the time ``when`` (seconds of this clock); returns the timer.

        `advance` makes the call when it reaches ``when``; if ``when`` is over already, the next `advance` makes it.
        """
        timer = FakeTimer(when, callback)
        with self._lock:
            heapq.heappush(self._timers, (when, next(self._order), timer))
        return timer

    def advance(self, seconds: float) -> None:
        """Move time forward by ``seconds`` (0 or more), and make each scheduled call at its time, in this thread.

        Calls that these calls schedule within the time are made too. Returns when all are made.

        Raises:
            ValueError: ``seconds`` is negative.
        """
        if seconds < 0:
            raise ValueError(f"time does not go back by {-seconds:g} s")
        end = self._now + seconds
        while (timer := self._next(end)) is not None:
            self._now = max(self._now, timer.when)
            timer.callback()
        self._now = end

    def _next(self, end: float) -> FakeTimer | None:
        with self._lock:
            while self._timers and self._timers[0][0] <= end:
                timer = heapq.heappop(self._timers)[2]
                if not timer.cancelled:
                    return timer
        return None

    @property
    def next_due(self) -> float | None:
        """Time of the next scheduled call, in seconds of this clock; None without any."""
        with self._lock:
            return min((when for when, _, timer in self._timers if not timer.cancelled), default=None)
