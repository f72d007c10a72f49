"""Corrects the times of samples that were stored before the wall clock was set, once it is set.

Knows one segment and how far its times were behind; the writer says which segments, and when.

1. A segment is mended by one transaction: samples, commits, intervals and alarms whose time is before `EARLIEST` move
   by the measured difference, and samples that were uncertain only because of the clock become good. Numbers of commits
   stay.
2. To mend a segment again changes nothing, so a crash in between is made good by doing all of it again.
3. Only the commits of the process that measured the difference are corrected by it: those of earlier processes had
   another difference.
"""

import sqlite3
from typing import Final

from ..sample_clock import EARLIEST
from ..samples import Reason
from .database import transaction

_MOVED: Final = "CASE WHEN {0} < :earliest THEN {0} + :shift ELSE {0} END"


def mend_segment(database: sqlite3.Connection, first: int, shift: int) -> int:
    """Add ``shift`` nanoseconds to the times in a segment that a wrong wall clock gave: those before `EARLIEST`.

    The times of samples, commits, intervals and alarm events are changed in one transaction, from commit ``first`` on.
    Samples that were uncertain only because the clock was not set become good.

    Args:
        database: the SQLite file of the segment.
        first: number of the first commit of the process that measured the shift.
        shift: how far the clock was behind, in nanoseconds.

    Returns:
        The number of corrected samples.

    Raises:
        sqlite3.Error: the segment is as it was.
    """
    known = {"earliest": EARLIEST, "shift": shift, "first": first, "clock": int(Reason.CLOCK)}
    with transaction(database):
        moved = database.execute(
            "UPDATE OR REPLACE samples SET time = time + :shift,"
            " reason = CASE reason WHEN :clock THEN 0 ELSE reason END"
            " WHERE time < :earliest AND commit_number >= :first",
            known,
        ).rowcount
        columns = ", ".join(f"{name} = {_MOVED.format(name)}" for name in ("at", "low", "high"))
        database.execute(f"UPDATE commits SET {columns} WHERE number >= :first", known)
        columns = ", ".join(f"{name} = {_MOVED.format(name)}" for name in ("begin", '"end"'))
        database.execute(  # the first commit also ends what an earlier process left open, by the clock of then
            f"UPDATE intervals SET {columns}"
            " WHERE commit_number >= :first AND (device IS NULL OR commit_number > :first)",
            known,
        )
        database.execute(  # the time from the end of an earlier process to the first commit of this one
            'UPDATE intervals SET "end" = max("end", (SELECT at FROM commits WHERE number = :first))'
            " WHERE device IS NULL AND commit_number = :first",
            known,
        )
        database.execute(f"UPDATE alarms SET at = {_MOVED.format('at')} WHERE commit_number >= :first", known)
    return moved
