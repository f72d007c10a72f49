"""A timer of an event loop that is exact to less than a millisecond.

Knows the event loop, and Linux' timers as descriptors; knows no port.

1. An event loop based on ``epoll`` waits in whole milliseconds, rounded up. The silence between two frames is 1.75 ms
   above 19 200 baud, so a timer that is 1 ms late costs a tenth of the line.
2. Linux offers a timer as a descriptor, exact to microseconds, that the loop watches like any other. On other systems
   the loop's own timers are used.
3. A sleeping processor takes some 60 µs to wake up, and the loop takes some more. So the timer is set earlier, by the
   delay that was seen lately. If it fires too early, the remaining time is waited for: the function is never called
   before its time, and seldom much after it.
"""

import asyncio
import ctypes
import os
import sys
import time
from collections.abc import Callable
from typing import Final

_CLOCK_MONOTONIC = 1  # the clock of time.monotonic
_TFD_TIMER_ABSTIME = 1
_NANOSECONDS = 1_000_000_000
_NEVER = (0, 0)

LONGEST_LEAD: Final = 0.0001
"""Most seconds that a timer is set earlier than it is due; it then blocks its event loop for the rest of this time."""
_SLOWLY: Final = 1 / 16
"""If the timer was later than its lead (how much earlier it is set), the lead grows by this share of the difference; if
it was earlier, the lead falls at once.
"""


class ExactTimer:
    """A timer of the running event loop, exact to less than a millisecond where the system allows; it can be set again.

    Attributes:
        exact: True if a timer of Linux is used, which is exact to microseconds; False if the event loop's own is.
    """

    def __init__(self, ring: Callable[[], None]) -> None:
        """Create a timer, not set yet, that calls ``ring`` in the event loop each time it is due."""
        self._loop = asyncio.get_running_loop()
        self._ring = ring
        self._handle: asyncio.TimerHandle | None = None
        self._when = 0.0
        self._lead = 0.0
        self._descriptor = _new_timer()
        self.exact: bool = self._descriptor is not None
        if self._descriptor is not None:
            self._loop.add_reader(self._descriptor, self._expired, self._descriptor)

    def set(self, when: float) -> None:
        """Set the timer to call its function once, at ``when`` (``time.monotonic``) and never earlier.

        Replaces an earlier setting. A time in the past means at once.
        """
        if self._descriptor is not None:
            self._when = when
            # All zero would mean never.
            _set_timer(self._descriptor, divmod(max(int((when - self._lead) * _NANOSECONDS), 1), _NANOSECONDS))
            return
        self.cancel()
        self._handle = self._loop.call_later(max(when - time.monotonic(), 0.0), self._late)

    def cancel(self) -> None:
        """Unset the timer, so that it calls nothing; it can be set again."""
        if self._descriptor is not None:
            _set_timer(self._descriptor, _NEVER)
        elif self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def close(self) -> None:
        """Close the timer for good; its function is not called any more. A second call does nothing.

        The timer must not be set again.
        """
        self.cancel()
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            if not self._loop.is_closed():
                self._loop.remove_reader(descriptor)
            os.close(descriptor)

    def __del__(self) -> None:
        # A timer that was never closed, because its loop was closed first, keeps no descriptor.
        if getattr(self, "_descriptor", None) is not None:
            self.close()

    def _expired(self, descriptor: int) -> None:
        try:
            os.read(descriptor, 8)
        except BlockingIOError:
            return  # it was set anew since
        late = min(time.monotonic() - self._when + self._lead, LONGEST_LEAD)
        while time.monotonic() < self._when:
            pass  # less than the lead
        self._lead = min(late, self._lead + (late - self._lead) * _SLOWLY)
        self._ring()

    def _late(self) -> None:
        self._handle = None
        self._ring()


_libc = ctypes.CDLL(None) if sys.platform == "linux" else None
_Times = ctypes.c_long * 4  # seconds and nanoseconds of the interval, and of the first expiry


def _new_timer() -> int | None:
    """Return the descriptor of a new system timer; None if the system has none."""
    if _libc is None or not hasattr(_libc, "timerfd_create"):
        return None
    descriptor: int = _libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC)
    return descriptor if descriptor >= 0 else None


def _set_timer(descriptor: int, when: tuple[int, int]) -> None:
    assert _libc is not None
    _libc.timerfd_settime(descriptor, _TFD_TIMER_ABSTIME, _Times(0, 0, *when), None)
