"""Parses the points, times and periods that a query of a store names.

Pure: for "an hour ago", the present time comes as an argument.
"""

import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Final

from ....errors import InvalidRequest
from ....points.name_patterns import is_meant, point_pattern
from ....values.durations import duration
from ....values.unfit_values import shown
from ..samples import NANOSECONDS
from .manifest import DeviceChoice, StoredPoint

QueryTime = str | datetime | int
"""A time: ``1h`` (an hour ago), ISO 8601 text, a `datetime`, or nanoseconds since 1970 UTC."""

EVER: Final = 2**63 - 1
"""The last nanosecond that a store can name."""
_MOST_LOOKED_UP: Final = 100
"""Most patterns whose devices are looked up by name; with more, all points are read, which is quicker then."""
_LITERAL: Final = re.compile(r"[^*?]*")


def period(since: QueryTime | None, until: QueryTime | None, now: int) -> tuple[int, int]:
    """Return begin and end of a period as nanoseconds since 1970 UTC; the end is excluded.

    Args:
        since, until: begin and end, in the forms that `moment` takes; None for no limit.
        now: the present time, nanoseconds since 1970 UTC.

    Raises:
        InvalidRequest: begin or end cannot be understood, or the end is not after the begin.
    """
    low = 0 if since is None else moment(since, now)
    high = EVER if until is None else moment(until, now)
    if until is not None and low >= high:  # a begin after `EVER` is a period that holds nothing
        raise InvalidRequest(f"the end of the period, {shown(until)}, is not after its begin, {shown(since)}")
    return low, high


def moment(given: QueryTime, now: int) -> int:
    """Convert a time given by a user to nanoseconds since 1970 UTC.

    Args:
        given: nanoseconds, a `datetime`, ISO 8601 text, or a duration before now such as ``1h``. A `datetime` or text
            without an offset is UTC.
        now: the present time, nanoseconds since 1970 UTC.

    Raises:
        InvalidRequest: the text cannot be understood as a time.
    """
    if isinstance(given, int):
        return given
    if isinstance(given, str):
        ago = duration(given)
        if ago is not None:
            return now - int(ago * NANOSECONDS)
        try:
            given = datetime.fromisoformat(given.strip())
        except ValueError:
            raise InvalidRequest(f"{shown(given)} is no time; write 1h for an hour ago, or 2026-11-22T14:00Z") from None
    aware = given if given.tzinfo else given.replace(tzinfo=UTC)
    whole = aware.replace(microsecond=0)
    return int(whole.timestamp()) * NANOSECONDS + aware.microsecond * 1000


def span(given: str | float) -> int:
    """Convert the length of a time bucket, given by a user, to nanoseconds.

    Args:
        given: a duration such as ``10s`` or ``5m``, or a number of seconds; 0.001 seconds to 366 days.

    Raises:
        InvalidRequest: the text cannot be understood as a duration, or the length is out of range.
    """
    length = (duration(given) or 0.0) if isinstance(given, str) else float(given)
    if not 0.001 <= length <= 366 * 86_400:
        raise InvalidRequest(f"a bucket is 1ms to 366d, such as 10s or 5m, not {shown(given)}")
    return round(length * NANOSECONDS)


def chosen_devices(patterns: str | Sequence[str]) -> DeviceChoice | None:
    """Return the devices whose points patterns can match, so that the points of all others need not be read.

    Devices with no matching point may be among them. A name of a device may have a ``/`` in it.

    Args:
        patterns: one or several patterns, as `chosen_points` takes them.

    Returns:
        The devices; None if all devices are meant, or if there are too many patterns.
    """
    given = [patterns] if isinstance(patterns, str) else patterns
    if len(given) > _MOST_LOOKED_UP:
        return None
    names: set[str] = set()
    beginnings: set[str] = set()
    for pattern in map(point_pattern, given):
        beginning = _LITERAL.match(pattern)
        if beginning is None or not beginning[0] or not pattern.isprintable():
            return None
        beginnings.add(beginning[0])
        names.update(pattern[: each.start()] for each in re.finditer("/", pattern))
    return DeviceChoice(frozenset(names), frozenset(beginnings))


def chosen_points(
    patterns: str | Sequence[str], points: Iterable[StoredPoint], former: Iterable[tuple[str, int]]
) -> list[StoredPoint]:
    """Return the points that match patterns, ordered by device and point, each once.

    Args:
        patterns: one or several patterns ``device/point``, with ``*`` and ``?``; a device alone means all its points. A
            pattern that equals the present name of a point chooses this point alone, even with ``*`` or ``?`` in it.
        points: all points of the store.
        former: former names of points, ``device/point``, each with the id of its point; patterns match these names too.

    Raises:
        InvalidRequest: a pattern other than ``*`` and ``*/*`` matches no point of the store.
    """
    known, before = list(points), list(former)
    chosen: dict[int, StoredPoint] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        whole = point_pattern(pattern)
        found = [point for point in known if point.name == pattern]
        if found:
            chosen.update((point.id, point) for point in found)
            continue
        found = [point for point in known if is_meant(point.name, whole)]
        ids = {number for name, number in before if is_meant(name, whole)}
        found += [point for point in known if point.id in ids]
        if not found and whole not in ("*", "*/*"):
            raise InvalidRequest(
                f"{shown(pattern)} names no point of this store; `busway query STORE --list` lists them"
            )
        chosen.update((point.id, point) for point in found)
    return sorted(chosen.values(), key=lambda point: (point.device, point.point))
