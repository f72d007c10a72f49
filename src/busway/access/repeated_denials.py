"""Counts repeated denials of one client by one rule: the audit log gets the first at once, later only numbers.

Pure: knows names and how to make a line; looks at no clock and writes nothing. What a denial is, and with which code a
request is refused, is decided by `authorizer`.

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
    """How often one rule denied one client since the last audit line, and the audit line of the latest denial."""

    count: int = 0
    line: DenialLine | None = None


class RepeatedDenials:
    """Counts of denied requests that the audit log does not show yet, by client and rule.

    Attributes:
        others: number of those beyond `MOST_APART` combinations.
    """

    def __init__(self) -> None:
        self.others: int = 0
        self._repeated: dict[About, _Repeated] = {}

    def __bool__(self) -> bool:
        return bool(self._repeated or self.others)

    def is_first(self, about: About, line: DenialLine) -> bool:
        """Whether a denied request needs an audit line now; if not, it was counted as a repetition."""
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
        """Return the audit lines for counted denials, each with its number, and set the counts to 0."""
        again = {about: each for about, each in self._repeated.items() if each.count}
        found = [(each.line, each.count) for each in again.values() if each.line is not None]
        self._repeated = {about: _Repeated() for about in again}
        return found

    def take_others(self) -> int:
        """Return the number of denials beyond the limit of those counted by client and rule, and set it to 0."""
        others, self.others = self.others, 0
        return others
