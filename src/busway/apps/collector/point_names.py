"""Keeps the names of points over time: finds which points a new configuration renames, and to what.

Pure. The manifest of a store, the alarms and the totals of counters all use the renames found here, so that they agree.

1. A point with the key ``was = OLD`` takes over the history of the point that has the name OLD, once. This is
   remembered: if the key stays in the file, it renames nothing again, even if another point has the name OLD meanwhile.
2. All names of a configuration change at once, so two points can exchange their names. A name that another point has
   and keeps is not given to a second point.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from .samples import PointDescription

PointKey = tuple[str, str]
"""Device and name of a point."""


@dataclass(slots=True)
class PointNames:
    """The present names of all points of a store, and the former names that points have taken over (``was``).

    Attributes:
        ids: number of each point, by its device and its present name. The number stays when the point is renamed; it is
            negative if no store has numbered the point.
        taken_over: pairs of a point's number and a name that its key ``was`` has named. Such a name renames nothing
            again; it is here even if no point had it.
    """

    ids: dict[PointKey, int] = field(default_factory=dict)
    taken_over: set[tuple[int, str]] = field(default_factory=set)
    _next: int = -1

    def moves(self, described: Iterable[PointDescription]) -> dict[int, PointDescription]:
        """Return the new descriptions of the points that a new configuration renames, by number of the point.

        Changes nothing. A point is left out if its key ``was`` has renamed it before (rule 1), or if another point has
        its new name and keeps it (rule 2).

        Args:
            described: the descriptions of all points of the new configuration.
        """
        moves: dict[int, PointDescription] = {}
        for one in described:
            old = None if one.was in (None, one.point) else self.ids.get((one.device, one.was))
            if old is not None and (self.ids.get((one.device, one.point)), one.was) not in self.taken_over:
                moves.setdefault(old, one)
        while blocked := [old for old, one in moves.items() if self.ids.get((one.device, one.point), old) not in moves]:
            for old in blocked:
                del moves[old]
        return moves

    def describe(self, described: Iterable[PointDescription]) -> Mapping[PointKey, str]:
        """Use the point names of a new configuration: rename points (``was``), and add new points.

        Args:
            described: the descriptions of all points of the new configuration.

        Returns:
            The new name of each renamed point, by its device and its old name.
        """
        points = list(described)
        moves = self.moves(points)
        before = {number: key for key, number in self.ids.items() if number in moves}
        for key in before.values():
            del self.ids[key]
        for number, one in moves.items():
            self.ids[one.device, one.point] = number
        for one in points:
            number = self.ids.setdefault((one.device, one.point), self._next)
            self._next -= number == self._next
            if one.was is not None:
                self.taken_over.add((number, one.was))
        return {key: moves[number].point for number, key in before.items()}
