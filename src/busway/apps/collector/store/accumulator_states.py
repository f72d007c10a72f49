"""States of accumulators (running totals) in a store, from which a collector goes on counting after a restart.

Knows the manifest, into which the states are copied when a segment ends; knows no segment.
"""

from ..samples import CounterState
from .manifest import Manifest
from .segment import sample_value


def counters_by_device(manifest: Manifest) -> dict[str, list[CounterState]]:
    """Return for each device the last states of its accumulators (running totals) in the finished segments.

    Newer states in the open segment are not read. Devices without such a state, and states that are no numbers, are
    left out. The points have their present names.
    """
    points = {point.id: point for point in manifest.points()}
    found: dict[str, list[CounterState]] = {}
    for row in manifest.counters():
        point = points.get(row.point)
        if point is not None:
            total, last = (sample_value(each, 0, False) for each in (row.total, row.last))
            if isinstance(total, int | float) and isinstance(last, int | float):
                found.setdefault(point.device, []).append(CounterState(point.point, total, last))
    return found
