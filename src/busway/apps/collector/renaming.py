"""Decides which points of a device have other names after its configuration was read again.

Pure: knows points; knows no store. The store decides alike, by the names that it has (`store.manifest`, rule 4).
"""

from collections.abc import Iterable, Sequence

from ...points.point import Point


def new_names(old: Sequence[Point], new: Sequence[Point], known: Iterable[str] = ()) -> dict[str, str]:
    """Return the new name of each point that is renamed, by its old one. Points may exchange their names.

    Args:
        old: the points before.
        new: the points after; ``was`` of a point that had it before has had its effect.
        known: names of points that are in neither, but in what is kept of the device.
    """
    before = {point.name: point.was for point in old}
    there = {*before, *known}
    found: dict[str, str] = {}
    for point in new:
        if point.was in there and point.was not in (point.name, before.get(point.name)):
            found.setdefault(point.was, point.name)
    while blocked := [was for was, name in found.items() if name in there and name not in found]:
        for was in blocked:
            del found[was]
    return found
