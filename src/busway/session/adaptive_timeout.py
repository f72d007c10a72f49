"""How long to wait for units that may not be there: as short as the replies seen so far make safe.

Knows response times; knows no line and no clock.

1. It begins with the longest time, and keeps it until somebody has answered.
2. Then it is `FACTOR` times the slowest answer so far, and never below the floor: the next unit may be slower.
3. A reply that comes after its time has run out shows that this was too short: the longest time holds again, and stays.
"""

from typing import Final

FACTOR: Final = 4.0
"""Times the slowest answer. Units of one line differ by their processors and by what they do beside answering; those
that differ by more betray themselves by a late reply."""
ROOM: Final = 0.1
"""Seconds that any floor has beside the time of its characters: adapters and systems take up to 20 ms each way."""
CHARACTERS: Final = 32
"""What request and reply of a probe have at most, in ASCII, with their silences."""


def floor_for(character: float) -> float:
    """The shortest safe time on a line whose characters take so many seconds each; 0 for a network."""
    return ROOM + CHARACTERS * character


class AdaptiveTimeout:
    """What a scan waits.

    Attributes:
        longest, floor: the limits in seconds.
        slowest: seconds of the slowest answer so far; 0 without any.
        was_late: whether a reply has come too late.
        learns: whether the time is ever shortened.
    """

    __slots__ = ("floor", "learns", "longest", "slowest", "was_late")

    def __init__(self, longest: float, floor: float, *, learns: bool = True) -> None:
        """Wait ``longest`` seconds at first, above 0, and never less than ``floor``, or ``longest`` if that is less."""
        self.longest = longest
        self.floor = min(floor, longest)
        self.slowest = 0.0
        self.was_late = False
        self.learns = learns

    @property
    def timeout(self) -> float:
        """Seconds to wait for the next unit."""
        if not self.learns or self.was_late or not self.slowest:
            return self.longest
        return min(max(FACTOR * self.slowest, self.floor), self.longest)

    def answered(self, seconds: float) -> None:
        """A unit has answered, after so long."""
        self.slowest = max(self.slowest, seconds)

    def late(self) -> None:
        """A reply has come after its time."""
        self.was_late = True
