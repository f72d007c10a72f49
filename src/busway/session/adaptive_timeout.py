"""Adaptive timeout of a scan for units: as short as the replies seen so far allow without missing one.

Knows response times; knows no line and no clock.

1. It begins with the longest time, and keeps it until a unit has answered.
2. Then it is `FACTOR` times the slowest answer so far, and never below the floor: the next unit may be slower.
3. A reply after the timeout shows that it was too short: from then on the longest time applies.
"""

from typing import Final

FACTOR: Final = 4.0
"""Multiple of the slowest answer. Units of one line differ by their processors and their other work; a unit that
differs by more is noticed by its late reply."""
ROOM: Final = 0.1
"""Seconds of any floor in addition to the time of its characters: adapters and systems take up to 20 ms each way."""
CHARACTERS: Final = 32
"""Longest request and reply of a probe together, in characters, in ASCII and with their silences."""


def floor_for(character: float) -> float:
    """Return the shortest safe timeout on a line whose characters take so many seconds; 0 for a network."""
    return ROOM + CHARACTERS * character


class AdaptiveTimeout:
    """Adaptive timeout of one scan for units; it shrinks with the replies seen so far.

    Attributes:
        longest, floor: the limits in seconds.
        slowest: seconds of the slowest answer so far; 0 without any.
        was_late: whether a reply has come too late.
        learns: whether the time is ever shortened.
    """

    __slots__ = ("floor", "learns", "longest", "slowest", "was_late")

    def __init__(self, longest: float, floor: float, *, learns: bool = True) -> None:
        """Start with ``longest`` seconds (above 0); never go below ``floor``, or ``longest`` if that is less."""
        self.longest: float = longest
        self.floor: float = min(floor, longest)
        self.slowest: float = 0.0
        self.was_late: bool = False
        self.learns: bool = learns

    @property
    def timeout(self) -> float:
        """Seconds to wait for the reply of the next unit that the scan asks."""
        if not self.learns or self.was_late or not self.slowest:
            return self.longest
        return min(max(FACTOR * self.slowest, self.floor), self.longest)

    def answered(self, seconds: float) -> None:
        """Adapt the timeout to a unit that answered after ``seconds``."""
        self.slowest = max(self.slowest, seconds)

    def late(self) -> None:
        """Lengthen the timeout because a reply came after it was over (rule 3)."""
        self.was_late = True
