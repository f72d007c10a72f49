"""The clock that gives samples their time: follows the system's wall clock, but never runs backwards.

Pure: knows readings of two clocks; reads none itself.

1. The time of a sample is a monotonic time plus an offset, so that the order of samples is that of their transactions.
2. The offset follows the wall clock. A wall clock that was set forward is followed at once. One that was set back is
   followed by going at half speed, because a jump would put new samples before old ones; until that is done, the time
   is not known to be right.
3. A wall clock that shows a time before this program was written is not right: many devices have no battery, and begin
   in 1970. Until it is set it is not followed. Then the difference is that of all times given before, and they are
   mended. Times while a clock that was set back is made up for are not: to move them would change their order.
"""

from typing import Final

NANOSECONDS: Final = 1_000_000_000
EARLIEST: Final = 1_767_225_600 * NANOSECONDS
"""2026-01-01, nanoseconds since 1970: a wall clock that shows less is wrong, because this program is younger."""
TOLERANCE: Final = NANOSECONDS // 2
"""Nanoseconds that the wall clock may be behind while the time still counts as right."""


class SampleClock:
    """Converts monotonic times into the times that samples get, nanoseconds since 1970.

    Args:
        monotonic: seconds of the monotonic clock, now.
        wall: nanoseconds since 1970 by the wall clock, at the same time.
    """

    def __init__(self, monotonic: float, wall: int) -> None:
        self._offset = wall - int(monotonic * NANOSECONDS)
        self._behind = 0  # nanoseconds that the wall clock is behind, still to be made up for
        self._since = monotonic
        self._wall_is_right = wall >= EARLIEST
        self._was_never_set = not self._wall_is_right

    @property
    def is_right(self) -> bool:
        """Whether the wall clock is known to be set right."""
        return self._wall_is_right and self._behind <= TOLERANCE

    def adjust(self, monotonic: float, wall: int) -> int:
        """Follow the computer's wall clock, which shows ``wall`` at ``monotonic``. To be called every few seconds.

        Returns:
            Nanoseconds that all times before `EARLIEST` given so far were behind, once that is known,
            when the wall clock has been set; else 0.
        """
        self._offset += self._made_up(monotonic)
        self._since = monotonic
        self._wall_is_right = wall >= EARLIEST
        if self._was_never_set and not self._wall_is_right:
            return 0
        ahead = wall - int(monotonic * NANOSECONDS) - self._offset
        self._offset += max(ahead, 0)
        self._behind = max(-ahead, 0)
        was_set_now, self._was_never_set = self._was_never_set, False
        return max(ahead, 0) if was_set_now else 0

    def time_ns(self, monotonic: float) -> int:
        """Return nanoseconds since 1970 for a monotonic time since the last `adjust`."""
        time = int(monotonic * NANOSECONDS) + self._offset
        return time + self._made_up(monotonic) if self._behind else time

    def _made_up(self, monotonic: float) -> int:
        """Return how much of a backward step of the wall clock sample times have absorbed since `adjust`: 0 or less."""
        return -min(self._behind, max(0, int((monotonic - self._since) * NANOSECONDS)) // 2)
