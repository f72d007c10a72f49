"""Corrects the times of samples that were stored before the wall clock was set, once it is set.

Knows one segment and how wrong its times are; the writer says which segments, and when.

1. A segment is corrected in one transaction: the wrong times of samples, commits, intervals and alarms move by the
   measured difference, and samples that were uncertain only because of the clock become good. Commit numbers stay.
2. The transaction records in the segment that it was corrected (``user_version``). Correcting it again changes nothing,
   so after a crash everything is simply done again.
3. Only times that one process wrote before it knew the time are moved by the difference that it measured: commits of
   earlier processes had another difference, and its later commits have the right time.
4. If wrong and corrected times overlap, samples first move to times that none has, because meanwhile two samples could
   have the same key.
"""

import sqlite3
from dataclasses import dataclass
from typing import Final

from ..sample_clock import EARLIEST, ClockCorrection
from ..samples import Reason
from .database import transaction

EVERY: Final = 2**63 - 1
"""A commit number greater than that of every commit, for "up to the last commit"."""
_MOVED: Final = "CASE WHEN {0} >= :begin AND {0} < :end THEN {0} + :shift ELSE {0} END"
_OF_CLOCK: Final = "commit_number BETWEEN :first AND :last"
_OWN_GAP: Final = f"(device IS NULL AND (begin < {EARLIEST} OR begin = (SELECT at FROM commits WHERE number = :first)))"
"""SQL condition: a row is the gap of the first commit, and its begin was taken from the wrong clock of this process."""


@dataclass(frozen=True, slots=True)
class CommitCorrection:
    """The correction of the times that one process wrote into a store before it knew the right time.

    Attributes:
        first, last: numbers of the first commit of the process, and of its last commit with wrong times.
        clock: which times are wrong, and by how much.
    """

    first: int
    last: int
    clock: ClockCorrection

    @property
    def mark(self) -> int:
        """The number that a segment file gets as ``user_version`` when it was corrected by this correction; never 0."""
        return 1 + self.first % (2**31 - 1)


def mend_segment(database: sqlite3.Connection, correction: CommitCorrection) -> int:
    """Correct the times that one process wrote into a segment before it knew the right time.

    In one transaction, the wrong times (`ClockCorrection`) of samples, commits, intervals and alarm events of the
    commits ``first`` to ``last`` are moved. Of the commit ``first``, only the gap before it is corrected: its other
    intervals have times of an earlier process. Samples that were uncertain only because the clock was not set become
    good. A moved sample replaces another one of its point at the new time. If this correction was made in the segment
    before, nothing is changed.

    Args:
        database: the SQLite file of the segment.
        correction: which commits and times are wrong, and by how much.

    Returns:
        The number of corrected samples; 0 if the correction was made before.

    Raises:
        sqlite3.Error: the segment could not be corrected, and is unchanged.
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
