"""Computes when the last value of a point is held: older than it should be, because a read that was due did not come.

Pure: knows periods and points; knows no clock.

1. A value is held if it was not read again for its period plus a margin: one more period, at least `LATE` seconds. So
   one round may be late or skipped. The values of a device that is not read at all get another reason long before.
2. The limit of a computed point is that of the input that is read most often.
3. A held value is uncertain, and is shown and used as such: on the page, for Prometheus, as the input of a computed
   point, and as the scale factor of another point. Samples in the store do not change: they were right at their time.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from ...points.expression import parse_expression
from ...points.point import Point
from .samples import NANOSECONDS, SampleBatch

LATE: Final = 2.0
"""Least margin in seconds before a late value is held: for a timeout, another device's transaction, and the commit."""


def held_after(period: float) -> float:
    """Return after how many seconds without a read a value is held, if its point is read every ``period`` seconds."""
    return period + max(period, LATE)


def age_of(batch: SampleBatch, at: int) -> float:
    """Return the age of samples in seconds: from the end of their read to ``at``; never below 0.

    Args:
        batch: the samples of the read.
        at: nanoseconds since 1970 UTC.
    """
    return max(0, at - batch.time - batch.half_width) / NANOSECONDS


def hold_limits(
    points: Iterable[Point], items: Mapping[str, Sequence[Point]], periods: Mapping[str, float]
) -> dict[str, float]:
    """Return the seconds without a read after which the value of a point is held, by name, for the points of a device.

    A computed point has the shortest limit of its inputs. Points that are not read, and computed points without an
    input that is read, are left out.

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
