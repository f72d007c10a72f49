"""The clock that gives samples their time: follows the wall clock of the machine, but never runs backwards.

Pure: knows readings of two clocks; reads none itself.

1. The time of a sample is a monotonic time plus an offset, so that the order of samples is that of their transactions.
2. The offset follows the wall clock. A wall clock that was set forward is followed at once. If it was set back, sample
   times go at half speed until the wall clock has caught up, because a jump would put new samples before old ones;
   while they are more than `TOLERANCE` ahead, the time counts as not right.
3. A wall clock that shows a time before this program was written is not right: many computers have no battery, and
   begin in 1970. A wall clock that is not known to be right (`time_service`) counts as not right too: many computers
   begin with the time of their last end. A clock that is not right at the start is not followed until it is. The
   difference is then added to all times given before. Times given at half speed (rule 2) are never changed: that would
   change their order.
"""

from dataclasses import dataclass
from typing import Final

NANOSECONDS: Final = 1_000_000_000
"""Nanoseconds in a second."""
EARLIEST: Final = 1_767_225_600 * NANOSECONDS
"""2026-01-01, nanoseconds since 1970: a wall clock that shows less is wrong, because this program is younger."""
TOLERANCE: Final = NANOSECONDS // 2
"""Nanoseconds that the wall clock may be behind while the time still counts as right."""


@dataclass(frozen=True, slots=True)
class ClockCorrection:
    """The correction of sample times that were given before the wall clock was known to be right.

    Attributes:
        shift: nanoseconds to be added to these times; negative if the clock was ahead.
        begin, end: the times from ``begin`` to before ``end`` are corrected, nanoseconds since 1970 UTC.
    """

    shift: int
    begin: int = 0
    end: int = EARLIEST

    def corrected(self, time: int) -> int:
        """Return a time (nanoseconds since 1970 UTC) with ``shift`` added; unchanged if not in ``begin`` to ``end``."""
        return time + self.shift if self.begin <= time < self.end else time


class SampleClock:
    """Converts monotonic times into the times that samples get, nanoseconds since 1970 UTC. Reads no clock itself.

    Args:
        monotonic: what the monotonic clock shows now, seconds.
        wall: what the wall clock shows at the same moment, nanoseconds since 1970 UTC.
        is_known: whether the wall clock is known to be right (`ClockJudge.is_known`).
    """

    def __init__(self, monotonic: float, wall: int, *, is_known: bool = True) -> None:
        self._offset = wall - int(monotonic * NANOSECONDS)
        self._behind = 0  # nanoseconds that the wall clock is behind, still to be made up for
        self._since = monotonic
        self._wall_is_right = wall >= EARLIEST and is_known
        self._was_never_right = not self._wall_is_right
        self._begin = wall

    @property
    def is_right(self) -> bool:
        """Whether sample times can be trusted, as of the last `adjust`.

        True if the wall clock is right, and sample times were at most `TOLERANCE` ahead of it.
        """
        return self._wall_is_right and self._behind <= TOLERANCE

    def adjust(self, monotonic: float, wall: int, *, is_known: bool = True) -> ClockCorrection | None:
        """Follow the computer's wall clock. To be called every few seconds.

        Args:
            monotonic: what the monotonic clock shows now, seconds.
            wall: what the wall clock shows at the same moment, nanoseconds since 1970 UTC.
            is_known: whether the wall clock is known to be right (`ClockJudge.is_known`).

        Returns:
            After a start with a wrong wall clock, the first call that finds it right returns the correction of all
            times given so far. Every other call returns None.
        """
        self._offset += self._made_up(monotonic)
        self._since = monotonic
        self._wall_is_right = wall >= EARLIEST and is_known
        now = int(monotonic * NANOSECONDS) + self._offset
        if self._was_never_right:
            if not self._wall_is_right:
                return None
            self._was_never_right = False
            self._offset += wall - now
            return ClockCorrection(wall - now, self._begin, now + 1) if now >= EARLIEST else ClockCorrection(wall - now)
        ahead = wall - now
        self._offset += max(ahead, 0)
        self._behind = max(-ahead, 0)
        return None

    def time_ns(self, monotonic: float) -> int:
        """Return the sample time (nanoseconds since 1970 UTC) for a time of the monotonic clock, in seconds.

        The monotonic time should not be before the last `adjust`.
        """
        time = int(monotonic * NANOSECONDS) + self._offset
        return time + self._made_up(monotonic) if self._behind else time

    def _made_up(self, monotonic: float) -> int:
        """Return how far sample times have fallen back since the last `adjust` (rule 2), in nanoseconds: 0 or less."""
        return -min(self._behind, max(0, int((monotonic - self._since) * NANOSECONDS)) // 2)
