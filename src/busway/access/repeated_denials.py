"""Counts repeated denials of one client by one rule: the audit log gets the first at once, later only their number.

Pure: knows names and how to create a line; has no clock and writes nothing. Which requests are denied, and with which
exception code, is decided by `authorizer`.

1. No denial is missing in the log: each has a line of its own or is counted in a later line.
2. At most `MOST_APART` combinations are counted separately, the others together, because senders of datagrams can be
   forged without limit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

DenialLine = Callable[[int], str]
"""Function that creates the audit line of a denial.

Its argument is the number of denials that the line stands for; 0 for this denial alone.
"""
About = tuple[str, str, str]
"""Host, role and rule of a denial; equal denials have all three in common. The role is empty without one."""

MOST_APART: Final = 1024
"""Most combinations of host, role and rule that are counted separately."""


@dataclass(slots=True)
class _Repeated:
    """How often one rule denied one client since the last audit line about that, and how to create the next line.

    Attributes:
        count: denials since that line.
        line: creates the audit line of the latest of them; None while ``count`` is 0.
    """

    count: int = 0
    line: DenialLine | None = None


class RepeatedDenials:
    """Counts of denied requests that the audit log does not show yet, by host, role and rule.

    True as a condition if a combination of these, or a denial in ``others``, is remembered.

    Attributes:
        others: number of denials that are not counted by client and rule, because there are `MOST_APART` combinations.
    """

    def __init__(self) -> None:
        self.others: int = 0
        self._repeated: dict[About, _Repeated] = {}

    def __bool__(self) -> bool:
        return bool(self._repeated or self.others)

    def is_first(self, about: About, line: DenialLine) -> bool:
        """Whether a denied request is the first of its host, role and rule, and needs an audit line of its own now.

        If False, it was counted: as a repetition, or in ``others`` if `MOST_APART` combinations are remembered already.

        ``line`` creates the audit line of this denial; the latest one is kept for the line about the repetitions.
        """
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
        """Return a function for each audit line about repeated denials, with their number, and set the counts to 0.

        There is one line for each host, role and rule with repetitions. Those without a repetition since the last call
        are forgotten: their next denial is a first one again. Denials in ``others`` are not in the result.
        """
        again = {about: each for about, each in self._repeated.items() if each.count}
        found = [(each.line, each.count) for each in again.values() if each.line is not None]
        self._repeated = {about: _Repeated() for about in again}
        return found

    def take_others(self) -> int:
        """Return the number of denials in ``others``, and set it to 0."""
        others, self.others = self.others, 0
        return others
