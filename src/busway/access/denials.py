"""Counts repeated denials of one client by one rule: the first is recorded at once, later ones as a number.

Pure: knows names and how to make a line; looks at no clock and writes nothing.

1. Every denial is in a line: the sum of the lines and their counts is the number of denials.
2. At most `MOST_APART` combinations are counted separately, the others together, because senders of datagrams can be
   forged without limit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

DenialLine = Callable[[int], str]
"""Makes the line of a denial; takes the number of denials that it counts, 0 for itself alone."""
About = tuple[str, str, str]
"""Host, role and rule."""

MOST_APART: Final = 1024
"""Combinations of host, role and rule that are counted apart."""


@dataclass(slots=True)
class _Repeated:
    """Denials of one client by one rule since the last audit line: their number, and the line of the latest."""

    count: int = 0
    line: DenialLine | None = None


class RepeatedDenials:
    """Denials that were counted but are not in the audit log yet.

    Attributes:
        others: number of those beyond `MOST_APART` combinations.
    """

    def __init__(self) -> None:
        self.others: int = 0
        self._repeated: dict[About, _Repeated] = {}

    def __bool__(self) -> bool:
        return bool(self._repeated or self.others)

    def is_first(self, about: About, line: DenialLine) -> bool:
        """Whether a denial is to be recorded now; if not, it was counted as a repetition."""
        repeated = self._repeated.get(about)
        if repeated is not None:
            repeated.count += 1
            repeated.line = line
            return False
        if len(self._repeated) >= MOST_APART:
            self.others += 1
            return False
        self._repeated[about] = _Repeated()
        return True

    def take(self) -> list[tuple[DenialLine, int]]:
        """The audit lines for counted denials, each with its number. Combinations without denials are dropped."""
        again = {about: each for about, each in self._repeated.items() if each.count}
        found = [(each.line, each.count) for each in again.values() if each.line is not None]
        self._repeated = {about: _Repeated() for about in again}
        return found

    def take_others(self) -> int:
        """The number of denials beyond the combinations that are counted separately; resets it to 0."""
        others, self.others = self.others, 0
        return others
