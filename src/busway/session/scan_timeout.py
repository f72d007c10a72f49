"""Timeout of a scan for units: as short as possible without missing a unit, judged by the replies so far.

Knows response times; knows no line and no clock.

1. The timeout begins with its longest value, and keeps it until a unit has answered.
2. Then it is `FACTOR` times the slowest response so far, because the next unit may be slower; never below the floor.
3. A reply after the timeout shows that the timeout was too short: from then on the longest value applies.
"""

from typing import Final

FACTOR: Final = 4.0
"""The timeout is the slowest response time so far, multiplied by this: units of one line differ in speed. If a unit is
slower still, its late reply is noticed (rule 3).
"""
ROOM: Final = 0.1
"""Seconds that `floor_for` adds to the time of the characters: adapters and systems take up to 20 ms each way."""
CHARACTERS: Final = 32
"""Characters for which `floor_for` leaves time: the request of a scan and its reply, a read of one holding register.

In ASCII they have 17 and 15 characters; in RTU 8 and 7, which leaves time for the silences around the frames.
"""


def floor_for(character: float) -> float:
    """Return the shortest timeout of a scan, in seconds, on a line whose characters take ``character`` seconds.

    For a network ``character`` is 0.
    """
    return ROOM + CHARACTERS * character


class ScanTimeout:
    """Timeout of one scan for units: the time to wait for each unit's reply, shortened by the replies seen so far.

    Attributes:
        longest, floor: upper and lower limit of the timeout, in seconds.
        slowest: seconds that the slowest answer so far took; 0 before the first.
        was_late: whether a reply has come after its timeout; then ``longest`` applies for the rest of the scan.
        learns: whether the timeout is ever shortened; if False, it is always ``longest``.
    """

    __slots__ = ("floor", "learns", "longest", "slowest", "was_late")

    def __init__(self, longest: float, floor: float, *, learns: bool = True) -> None:
        """Create a timeout that begins with ``longest`` seconds (above 0) and never goes below ``floor`` seconds.

        Where ``floor`` is above ``longest``, the timeout is always ``longest``.
        """
        self.longest: float = longest
        self.floor: float = min(floor, longest)
        self.slowest: float = 0.0
        self.was_late: bool = False
        self.learns: bool = learns

    @property
    def timeout(self) -> float:
        """Seconds to wait for the reply of the unit that the scan asks next, from ``floor`` to ``longest``."""
        if not self.learns or self.was_late or not self.slowest:
            return self.longest
        return min(max(FACTOR * self.slowest, self.floor), self.longest)

    def answered(self, seconds: float) -> None:
        """Adapt the timeout to a unit that answered after ``seconds``."""
        self.slowest = max(self.slowest, seconds)

    def late(self) -> None:
        """Return to the longest timeout for good, because a reply came after its timeout (rule 3)."""
        self.was_late = True
