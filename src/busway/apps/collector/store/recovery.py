"""Recovery of a store at the start of its writer: what an earlier process left unfinished, after a crash or a stop.

Knows the files of a store and their manifest; knows no commits to come. `writer` calls it before its first commit.

1. A commit that was half written when the process ended is undone by SQLite when the segment is opened: no row of it is
   seen. Everything here is about whole commits.
2. A segment that was left open is listed in the manifest as closed, with what it contains, and is not written any more;
   one without commits is removed.
3. The time since the last commit is a `Gap`; its reason says whether the process ended on purpose. Intervals in which a
   device was not read, and which have no end yet, end at that commit, except maintenance, which goes on. Where the
   clock was set meanwhile: `_begin_of_gap` and `_end_of`.
"""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from ..sample_clock import EARLIEST
from ..samples import Gap, Reason, StateInterval
from .database import name_if_damaged
from .folder import SEGMENTS
from .manifest import AlarmRow, CounterRow, Manifest, StorePart
from .sealing import remove_unlisted
from .segment import alarms_of, counters_of, facts_of, intervals_of, is_unmade, open_for_reading


def close_open_segments(folder: Path, manifest: Manifest) -> None:
    """List as closed the segments that an earlier process left open, and delete files that are no longer listed."""
    for part in manifest.parts():
        if part.kind == "open":
            close_segment(folder, manifest, part)
    remove_unlisted(folder, manifest)


def close_segment(folder: Path, manifest: Manifest, part: StorePart) -> bool:
    """List a segment as closed, with what its file contains; a segment without commits is removed from the manifest.

    Returns:
        Whether the segment contains commits.
    """
    path = folder / SEGMENTS / part.file
    found = part
    alarms: list[AlarmRow] = []
    counters: list[CounterRow] = []
    try:
        with name_if_damaged(path), closing(open_for_reading(path)) as database:
            found = facts_of(database, part, path.stat().st_size)
            alarms, counters = alarms_of(database), counters_of(database)
    except FileNotFoundError:
        pass
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
    if found.last_commit is not None:
        manifest.close_segment(found, alarms, counters)
        return True
    manifest.drop_parts([part], before=0)
    return False


def intervals_since_end(folder: Path, manifest: Manifest, now: int) -> list[StateInterval | Gap]:
    """Return the ends of intervals that an earlier process left open, and the gap since that process ended.

    Args:
        folder: the folder of the store.
        manifest: its manifest.
        now: the present time, nanoseconds since 1970 UTC.

    Returns:
        The intervals with their ends, and the gap, to be committed by the caller; empty if nothing was ever committed.
    """
    alive = manifest.fact("alive")
    if alive is None:  # nothing was ever committed
        return []
    reason = Reason.KILLED if manifest.fact("ended") is None else Reason.STOPPED
    ended = [replace(each, end=_end_of(each, alive)) for each in _open_intervals(folder, manifest)]
    begin = _begin_of_gap(manifest, alive, now)
    return [*ended, Gap(begin, max(begin, now), reason)]


def _begin_of_gap(manifest: Manifest, alive: int, now: int) -> int:
    """Return when the gap before this start began, in nanoseconds since 1970 UTC.

    This is ``alive``, if the clock of the earlier process was right. If that was wrong, and the clock is right now, it
    is the latest right time up to ``now`` that the manifest has of the last commit of a finished part, or else ``now``.
    If the clock is wrong now too, it is ``alive``, or ``now`` if that is earlier.

    Args:
        manifest: the manifest of the store.
        alive: time of the last commit of the earlier process by its clock, nanoseconds since 1970 UTC.
        now: the present time, nanoseconds since 1970 UTC.
    """
    if alive >= EARLIEST or alive <= now < EARLIEST:
        return alive
    if now < EARLIEST:  # the machine was started again, and counts from 1970 anew
        return now
    right = (part.alive for part in manifest.parts() if (part.alive or 0) >= EARLIEST)
    return max((at for at in right if at is not None and at <= now), default=now)


def _open_intervals(folder: Path, manifest: Manifest) -> list[StateInterval]:
    """Return the stored intervals in which a device was not read and which have no end yet.

    Maintenance that continues after the restart is left out. Segments must be closed before.
    """
    rows = list(manifest.intervals())
    for part in manifest.parts():
        if part.kind == "closed":
            path = folder / SEGMENTS / part.file
            with name_if_damaged(path), closing(open_for_reading(path)) as database:
                rows += intervals_of(database)
    ended = {(row.device, row.begin, row.reason) for row in rows if row.end is not None}
    ended |= {(row.device, row.begin, int(Reason.MAINTENANCE)) for row in manifest.maintenance()}  # it goes on
    return [
        StateInterval(row.device, row.begin, None, row.reason)
        for row in rows
        if row.end is None and row.device is not None and (row.device, row.begin, row.reason) not in ended
    ]


def _end_of(interval: StateInterval, alive: int) -> int:
    """Return the end (nanoseconds since 1970 UTC) of an interval that an earlier process left open.

    The end is ``alive``, the time of the last commit of that process. It is the begin of the interval if ``alive`` is
    earlier, or if the clock was set between the two.
    """
    is_known = (interval.begin < EARLIEST) is (alive < EARLIEST)  # else the clock was set in between, and not mended
    return max(alive, interval.begin) if is_known else interval.begin
