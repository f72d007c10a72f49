"""When the last value of a point is held: older than it should be, because no read has come when one was due.

Pure: knows periods and points; knows no clock.

1. A value is held when it was not read again within its period and once more that long, at least `LATE`. One round may
   be late or skipped; a device that is not read at all has another reason long before.
2. A computed point is due with the input that is read most often.
3. A held value is uncertain, and shown or used as such: on the page, for Prometheus, as the input of a computed point,
   and as the scale factor of another point. Its samples in the store stay what they were: their time is theirs.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from ...points.expression import parse_expression
from ...points.point import Point
from .samples import NANOSECONDS, SampleBatch

LATE: Final = 2.0
"""Seconds that a value may be late, at least: a timeout, the transaction of another device, and the commit."""


def held_after(period: float) -> float:
    """Return how many seconds after its last read a value is held that is read every ``period`` seconds."""
    return period + max(period, LATE)


def age_of(batch: SampleBatch, at: int) -> float:
    """Return the seconds from the end of the read of ``batch`` to ``at``, nanoseconds since 1970 UTC; never below 0."""
    return max(0, at - batch.time - batch.half_width) / NANOSECONDS


def hold_limits(
    points: Iterable[Point], items: Mapping[str, Sequence[Point]], periods: Mapping[str, float]
) -> dict[str, float]:
    """Return for each point of a device the seconds after which its value is held; a point without period is left out.

    A computed point has the shortest limit of its inputs.

    Args:
        points: all points of the device, computed ones included.
        items: the points that are read, by poll class.
        periods: the periods in seconds, by poll class.
    """
    found: dict[str, float] = {}
    for name, read in items.items():
        limit = held_after(periods[name])
        for point in read:
            found[point.name] = min(limit, found.get(point.name, limit))
    inputs = {point.name: parse_expression(point.formula).names for point in points if point.formula}
    has_changed = True
    while has_changed:  # a computed point may use another one
        has_changed = False
        for name, used in inputs.items():
            known = [found[each] for each in used if each in found]
            if known and found.get(name) != min(known):
                found[name], has_changed = min(known), True
    return found
