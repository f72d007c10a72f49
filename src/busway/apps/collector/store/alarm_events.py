"""Reads the alarm events of a store, from the open segment and the manifest together, and deletes old ones.

Knows segments and the manifest. A segment has its own events; when it ends, they are copied into the manifest, in the
transaction that lists the segment as closed, so that they outlive its samples.
"""

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from ..alarms.events import AlarmEvent, AlarmEventKind, AlarmKey, RaisedAlarm, fold_event
from ..sample_clock import EARLIEST
from .folder import SEGMENTS
from .manifest import AlarmRow, Manifest
from .segment import alarms_of, is_unmade, open_for_reading, sample_value

MOST_EVENTS: Final = 100_000
"""Most alarm events that are kept; events of alarms that are active or not acknowledged are kept beyond it."""


def alarm_rows(folder: Path, manifest: Manifest, after: int = 0) -> list[AlarmRow]:
    """Return the alarm events stored after a commit number, as database rows in the order of their commits.

    Args:
        folder: the folder of the store.
        manifest: its manifest.
        after: number of a commit; events of this commit and earlier ones are left out. 0 for all events.
    """
    rows: dict[tuple[int, int], AlarmRow] = {}
    for part in manifest.parts():
        if part.kind == "open":
            rows.update(
                ((row.commit_number, row.place), row) for row in _of_segment(folder / SEGMENTS / part.file, after)
            )
    # The manifest last: a segment that ended meanwhile has moved its events there.
    rows.update(((row.commit_number, row.place), row) for row in manifest.alarms(after))
    return [rows[key] for key in sorted(rows)]


def _of_segment(path: Path, after: int) -> list[AlarmRow]:
    try:
        with closing(open_for_reading(path)) as database:
            return alarms_of(database, after)
    except FileNotFoundError:  # not made yet, or sealed already
        return []
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
        return []


def alarm_events(rows: Iterable[AlarmRow], manifest: Manifest) -> list[AlarmEvent]:
    """Convert database rows of alarm events to `AlarmEvent` objects, with the names that their points have now.

    Rows of points that are not in the manifest are left out.
    """
    return [event for _, event in _with_events(rows, manifest)]


def _with_events(rows: Iterable[AlarmRow], manifest: Manifest) -> Iterator[tuple[AlarmRow, AlarmEvent]]:
    """Yield each database row with its `AlarmEvent`, but those of points that are not in the manifest."""
    points = {point.id: point for point in manifest.points()}
    for row in rows:
        point = points.get(row.point)
        if point is None:
            continue
        value = None if row.value is None else sample_value(row.value, 0, point.is_state)
        kind = AlarmEventKind(row.event)
        yield (
            row,
            AlarmEvent(point.device, point.point, row.limit, kind, row.at, value, row.by, bool(row.needs), row.text),
        )


def forget_old_alarms(manifest: Manifest, before: int, most: int = MOST_EVENTS) -> int:
    """Delete old alarm events from the manifest.

    Of an alarm that is active or not acknowledged, the last event `AlarmEventKind.RAISED` and those after it stay.

    Args:
        manifest: the manifest of the store.
        before: nanoseconds since 1970 UTC; events of earlier times are deleted. An event from before the wall clock was
            set counts as old as the next event with a right time.
        most: number of events to keep; if there are more, the oldest are deleted too.

    Returns:
        The number of deleted events.
    """
    rows = manifest.alarms()
    excess = max(0, len(rows) - most)
    old = {place for place, at in _known_times(rows) if at < before or place < excess}
    if not old:
        return 0
    needed = _rows_of_active(_with_events(rows, manifest))
    gone = [row for place, row in enumerate(rows) if place in old and row not in needed]
    manifest.forget_alarms(gone)
    return len(gone)


def _rows_of_active(journal: Iterable[tuple[AlarmRow, AlarmEvent]]) -> set[AlarmRow]:
    """Return the rows of the events that explain the alarms active or not acknowledged at the end of ``journal``.

    For each of these alarms they are its last raising and its own later events.
    """
    alarms: dict[AlarmKey, RaisedAlarm] = {}
    rows: dict[AlarmKey, list[AlarmRow]] = {}
    for row, event in journal:
        fold_event(alarms, event)
        if event.kind is AlarmEventKind.RAISED:
            rows[event.key] = []
        rows.setdefault(event.key, []).append(row)
    return {row for key in alarms for row in rows[key]}


def _known_times(rows: Sequence[AlarmRow]) -> Iterator[tuple[int, int]]:
    """Yield the position of each event, the last first, and the time (nanoseconds since 1970 UTC) that decides its age.

    An event from before the clock was set gets the time of the next event that has a right time; without one a time
    later than all others.
    """
    known = 2**63
    for place in range(len(rows) - 1, -1, -1):
        known = rows[place].at if rows[place].at >= EARLIEST else known
        yield place, known
