"""Corrects the times of samples that were stored before the wall clock was set, once it is set.

Knows one segment and how far its times were behind; the writer says which segments, and when.

1. A segment is mended by one transaction: samples, commits, intervals and alarms whose time is one of those to be
   corrected move by the measured difference, and samples that were uncertain for the clock alone become good. Numbers
   of commits stay.
2. The transaction notes in the segment that it was mended (``user_version``). To mend a segment again changes nothing,
   so a crash in between is made good by doing all of it again.
3. Only what one process wrote before it knew the time is moved by what it measured: commits of earlier ones had another
   difference, and later ones have the right time.
4. Where the times overlap those that they become, samples are moved out of the way first: two could have one key for a
   moment.
"""

import sqlite3
from dataclasses import dataclass
from typing import Final

from ..sample_clock import EARLIEST, ClockCorrection
from ..samples import Reason
from .database import transaction

EVERY: Final = 2**63 - 1
"""A number above those of all commits."""
_MOVED: Final = "CASE WHEN {0} >= :begin AND {0} < :end THEN {0} + :shift ELSE {0} END"
_OF_CLOCK: Final = "commit_number BETWEEN :first AND :last"
_OWN_GAP: Final = f"(device IS NULL AND (begin < {EARLIEST} OR begin = (SELECT at FROM commits WHERE number = :first)))"
"""Whether a gap in the first commit begins by the clock of this process: nothing better was known of the one before."""


@dataclass(frozen=True, slots=True)
class CommitCorrection:
    """The correction of the times that one process wrote before it knew the time.

    Attributes:
        first, last: the numbers of its first commit, and of its last one with such times.
        clock: the correction.
    """

    first: int
    last: int
    clock: ClockCorrection

    @property
    def mark(self) -> int:
        """The number that a segment has once it was mended so; an integer of SQLite's header, which is never 0."""
        return 1 + self.first % (2**31 - 1)


def mend_segment(database: sqlite3.Connection, correction: CommitCorrection) -> int:
    """Correct the times that one process wrote into a segment before it knew the time; none if that was done before.

    The times of samples, commits, intervals and alarm events are changed in one transaction, from commit ``first`` on.
    Samples that were uncertain only because the clock was not set become good.

    Args:
        database: the SQLite file of the segment.
        correction: the commits and times, and what is added.

    Returns:
        The number of corrected samples.

    Raises:
        sqlite3.Error: the segment is as it was.
    """
    clock = correction.clock
    known = {"begin": clock.begin, "end": clock.end, "shift": clock.shift, "clock": int(Reason.CLOCK)}
    known |= {"first": correction.first, "last": correction.last}
    good = "reason = CASE reason WHEN :clock THEN 0 ELSE reason END"
    with transaction(database):
        if database.execute("PRAGMA user_version").fetchone()[0] == correction.mark:
            return 0
        database.execute(f"PRAGMA user_version = {correction.mark}")
        here = f"time >= :begin AND time < :end AND {_OF_CLOCK}"
        if abs(clock.shift) >= clock.end - clock.begin:
            moved = database.execute(
                f"UPDATE OR REPLACE samples SET time = time + :shift, {good} WHERE {here}", known
            ).rowcount
        else:
            moved = database.execute(f"UPDATE samples SET time = -1 - time, {good} WHERE {here}", known).rowcount
            database.execute("UPDATE OR REPLACE samples SET time = -1 - time + :shift WHERE time < 0", known)
        columns = ", ".join(f"{name} = {_MOVED.format(name)}" for name in ("begin", '"end"'))
        database.execute(  # the first commit has times of an earlier process too, by its clock
            f"UPDATE intervals SET {columns} WHERE {_OF_CLOCK} AND (commit_number > :first OR {_OWN_GAP})",
            known,
        )
        columns = ", ".join(f"{name} = {_MOVED.format(name)}" for name in ("at", "low", "high"))
        database.execute(f"UPDATE commits SET {columns} WHERE number BETWEEN :first AND :last", known)
        database.execute(  # the time from the end of an earlier process to the first commit of this one
            'UPDATE intervals SET "end" = max(begin, (SELECT at FROM commits WHERE number = :first))'
            " WHERE device IS NULL AND commit_number = :first",
            known,
        )
        database.execute(  # an earlier process had a clock that was further ahead
            f'UPDATE intervals SET "end" = begin WHERE "end" < begin AND {_OF_CLOCK}', known
        )
        database.execute(f"UPDATE alarms SET at = {_MOVED.format('at')} WHERE {_OF_CLOCK}", known)
    return moved
