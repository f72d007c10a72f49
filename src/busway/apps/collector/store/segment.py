"""A segment: the SQLite file that samples are written to, for ten minutes or 256 MB; then the next one begins.

Knows one file and its tables; knows nothing of the manifest.

1. A commit is one transaction: samples, intervals, and one row that says which times it covers. So rows can be read
   in the order of their commits without an index on each sample.
2. The key is (time, point): rows arrive in the order of time, and only in that order can 400 000 of them be inserted in
   a second. A sample with the key of an earlier one replaces it.
3. NULL as the value of a sample that is not bad stands for NaN, which SQLite cannot store. Integers of 2**63 and more
   are stored as eight bytes.
4. The write-ahead log is moved into the file when it is larger than `LOG_LIMIT`.
5. A segment ends, and the next commit begins another, when its ten minutes by the clock are over, when it is larger
   than ``segment_size`` of the store's options, or when a reader keeps its write-ahead log from shrinking. See
   `Segment.has_ended`.
6. While a connection is open, this process opens and closes the file by no other means than Python's SQLite: that would
   release the locks of the connection (POSIX), and a reader in another process that closes the file would remove the
   log that is being written.
"""

import contextlib
import os
import sqlite3
from collections.abc import Iterable, Sequence
from dataclasses import astuple, replace
from itertools import repeat
from pathlib import Path
from typing import Final

from ..alarms.events import AlarmEvent
from ..samples import CounterState, Gap, Quality, Reason, SampleBatch, SampleValue, StateInterval, quality_of
from .clock_correction import CommitCorrection, mend_segment
from .database import open_database
from .folder import size_of, sync_file
from .manifest import INSERT_ALARM, AlarmRow, CounterRow, IntervalRow, StorePart

SLOT: Final = 600 * 1_000_000_000
"""Nanoseconds that a segment lasts at most, and that a sealed part of late samples covers: ten minutes."""
LOG_LIMIT: Final = 32 * 1024 * 1024
"""Bytes of the write-ahead log above which it is moved into the segment's file after each commit."""
LOG_STUCK: Final = 2 * LOG_LIMIT
"""Bytes of the write-ahead log above which it is clear that a reader keeps the log from shrinking."""

_SCHEMA: Final = """
BEGIN;
CREATE TABLE IF NOT EXISTS samples (
    time INTEGER NOT NULL, point INTEGER NOT NULL, value, reason INTEGER NOT NULL, half_width INTEGER NOT NULL,
    commit_number INTEGER NOT NULL, PRIMARY KEY (time, point)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS commits (
    number INTEGER PRIMARY KEY, at INTEGER NOT NULL, low INTEGER, high INTEGER, samples INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS intervals (
    device TEXT, begin INTEGER NOT NULL, "end" INTEGER, reason INTEGER NOT NULL, lost INTEGER NOT NULL,
    commit_number INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS alarms (
    commit_number INTEGER NOT NULL, place INTEGER NOT NULL, point INTEGER NOT NULL, "limit" TEXT NOT NULL,
    event TEXT NOT NULL, at INTEGER NOT NULL, value, by TEXT NOT NULL, needs INTEGER NOT NULL, text TEXT NOT NULL,
    PRIMARY KEY (commit_number, place)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS counters (
    point INTEGER PRIMARY KEY, total NOT NULL, last NOT NULL, commit_number INTEGER NOT NULL
);
COMMIT;
"""
_INSERT: Final = "INSERT OR REPLACE INTO samples VALUES (?, ?, ?, ?, ?, ?)"
_COUNTER: Final = "INSERT OR REPLACE INTO counters VALUES (?, ?, ?, ?)"

KeyedBatch = tuple[Sequence[int], SampleBatch]
"""The ids of the points of a batch, and the batch."""
KeyedAlarm = tuple[int, AlarmEvent]
"""The id of the point of an alarm event, and the event."""
KeyedCounter = tuple[int, CounterState]
"""The id of the point of an accumulator, and its state."""


class Segment:
    """A segment file that is being written. Not safe for several threads."""

    def __init__(self, path: Path, *, every_commit_durable: bool) -> None:
        """Open a segment file for writing; it is created if it is missing.

        Args:
            path: the file.
            every_commit_durable: whether each commit waits for the disk, so that it survives a power failure.

        Raises:
            sqlite3.Error: the file cannot be opened.
        """
        self.path = path
        self._log = path.with_name(path.name + "-wal")
        self._database = open_database(
            path,
            "PRAGMA journal_mode=WAL",
            f"PRAGMA synchronous={'FULL' if every_commit_durable else 'NORMAL'}",
            "PRAGMA wal_autocheckpoint=0",
            script=_SCHEMA,
        )

    def begin(
        self,
        number: int,
        at: int,
        batches: Sequence[KeyedBatch],
        intervals: Sequence[StateInterval | Gap],
        alarms: Sequence[KeyedAlarm] = (),
        counters: Sequence[KeyedCounter] = (),
    ) -> None:
        """Begin a transaction and write a commit to the segment file; `commit` or `rollback` must follow.

        Args:
            number: number of the commit.
            at: time of the commit, nanoseconds since 1970 UTC.
            batches: samples, with the ids of their points.
            intervals: intervals in which devices were not read, and gaps.
            alarms: alarm events, with the ids of their points.
            counters: states of accumulators that are in no batch, with the ids of their points.

        Raises:
            sqlite3.Error: the file cannot be written; call `rollback`.
        """
        database = self._database
        database.execute("BEGIN IMMEDIATE")
        for ids, batch in batches:
            insert_batch(database, ids, batch, number)
            if batch.counters:
                known = dict(zip(batch.points, ids, strict=True))
                database.executemany(
                    _COUNTER, _counter_rows([(known[each.point], each) for each in batch.counters], number)
                )
        database.executemany(_COUNTER, _counter_rows(counters, number))
        times = [batch.time for _, batch in batches]
        low, high = (min(times), max(times)) if times else (None, None)
        count = sum(len(ids) for ids, _ in batches)
        database.execute("INSERT INTO commits VALUES (?, ?, ?, ?, ?)", (number, at, low, high, count))
        database.executemany("INSERT INTO intervals VALUES (?, ?, ?, ?, ?, ?)", _interval_rows(intervals, number))
        if alarms:
            database.executemany(INSERT_ALARM, [astuple(row) for row in _alarm_rows(alarms, number)])

    def commit(self) -> None:
        """End the transaction that `begin` started, then move the write-ahead log into the file if the log has grown.

        The log is moved if it is larger than `LOG_LIMIT`. If that fails (a full disk), the commit is valid
        nevertheless, and the next one tries again.

        Raises:
            sqlite3.Error: the transaction cannot be committed.
        """
        self._database.execute("COMMIT")
        if self.log_size() > LOG_LIMIT:
            with contextlib.suppress(sqlite3.Error):
                self._database.execute("PRAGMA wal_checkpoint(PASSIVE)")

    def rollback(self) -> None:
        """Undo the transaction that `begin` started. Errors of SQLite are ignored."""
        with contextlib.suppress(sqlite3.Error):
            self._database.execute("ROLLBACK")

    def log_size(self) -> int:
        """Return the size of the segment file's write-ahead log in bytes; 0 if there is none."""
        try:
            return self._log.stat().st_size
        except FileNotFoundError:
            return 0

    def has_ended(self, begun: int, now: int, most: int) -> bool:
        """Whether the next segment must begin before another commit (rule 5).

        True if ``begun`` and ``now`` are in different ten minutes of the clock (`SLOT`), if the file with its log is
        larger than ``most``, or if the log `is_stuck`.

        Args:
            begun: when the segment began, nanoseconds since 1970 UTC.
            now: the present time, nanoseconds since 1970 UTC.
            most: most bytes that the segment may have.
        """
        return now // SLOT != begun // SLOT or self.size() > most or self.is_stuck

    @property
    def is_stuck(self) -> bool:
        """Whether the segment file's write-ahead log is larger than `LOG_STUCK`: a reader keeps it from shrinking."""
        return self.log_size() > LOG_STUCK

    def size(self) -> int:
        """Return the size of the segment file on disk in bytes, its write-ahead log included."""
        return size_of(self.path)

    def mend(self, correction: CommitCorrection) -> int:
        """Correct wrong times in the segment as `mend_segment` does; return the number of corrected samples."""
        return mend_segment(self._database, correction)

    def sync(self) -> None:
        """Make all commits so far survive a power failure: write the write-ahead log to the disk.

        SQLite itself makes the data durable that it moves from the log into the file.

        Raises:
            OSError: the log cannot be written to the disk.
        """
        sync_file(self._log)

    def limit_pages(self, pages: int) -> None:
        """Limit the number of SQLite pages of the segment's file, to simulate a full disk; for tests."""
        self._database.execute(f"PRAGMA max_page_count={pages}")

    def close(self) -> None:
        """Close the segment's file; if no reader uses it, SQLite moves the write-ahead log into it. Raises nothing."""
        with contextlib.suppress(sqlite3.Error):
            self._database.close()


def insert_batch(database: sqlite3.Connection, ids: Sequence[int], batch: SampleBatch, number: int) -> None:
    """Insert the samples of one read into a segment file.

    A value that cannot be stored (`is_storable`) becomes a bad sample without a value, with `Reason.CONFIGURATION`.

    Args:
        database: the segment file, in a transaction.
        ids: ids of the points of the batch, in its order.
        batch: the samples.
        number: number of the commit.

    Raises:
        sqlite3.Error: the file cannot be written.
    """
    reasons = repeat(batch.reasons) if isinstance(batch.reasons, int) else batch.reasons
    try:
        _insert(database, ids, batch, batch.values, reasons, number)
    except (OverflowError, sqlite3.Error) as error:
        if isinstance(error, sqlite3.Error) and not isinstance(
            error, sqlite3.ProgrammingError | sqlite3.InterfaceError
        ):
            raise
        plain = [stored_value(value) for value in batch.values]
        cannot = [
            reason if is_storable(value) else Reason.CONFIGURATION
            for value, reason in zip(batch.values, batch.reason_column(), strict=True)
        ]
        _insert(database, ids, batch, plain, cannot, number)


def _insert(
    database: sqlite3.Connection,
    ids: Sequence[int],
    batch: SampleBatch,
    values: Sequence[object],
    reasons: Iterable[int],
    number: int,
) -> None:
    rows = zip(repeat(batch.time), ids, values, reasons, repeat(batch.half_width), repeat(number))
    database.executemany(_INSERT, rows)


def is_storable(value: object) -> bool:
    """Whether the store can keep a value unchanged: None, a state, a float, a text, or an integer -2**63…2**64 - 1."""
    if isinstance(value, int):
        return -(2**63) <= value < 2**64
    return value is None or isinstance(value, float | str)


def stored_value(value: object) -> object:
    """Return a value as SQLite stores it: integers of 2**63 and more as eight bytes, others unchanged.

    None for a value that cannot be stored.
    """
    if not is_storable(value):
        return None
    if isinstance(value, int) and value >= 2**63:
        return value.to_bytes(8, "big")
    return value


def sample_value(stored: int | float | str | bytes | None, reason: int, is_state: bool) -> SampleValue | None:
    """Convert a value as SQLite stores it to the value of the sample.

    Args:
        stored: the stored value; bytes are an integer of 2**63 or more; None is no value or NaN.
        reason: number of the sample's reason. It decides what a stored None is: no value if bad, NaN otherwise.
        is_state: whether values of the point are states; then 1 and 0 become True and False. Other numbers stay
            unchanged: they are from a time when the point had another type.
    """
    if stored is None:
        return None if quality_of(reason) is Quality.BAD else float("nan")
    if isinstance(stored, bytes):
        return int.from_bytes(stored, "big")
    return bool(stored) if is_state and isinstance(stored, int) and stored in (0, 1) else stored


def _interval_rows(
    intervals: Sequence[StateInterval | Gap], number: int
) -> list[tuple[str | None, int, int | None, int, int, int]]:
    return [
        (None, each.begin, each.end, each.reason, each.lost, number)
        if isinstance(each, Gap)
        else (each.device, each.begin, each.end, each.reason, 0, number)
        for each in intervals
    ]


def _alarm_rows(alarms: Sequence[KeyedAlarm], number: int) -> list[AlarmRow]:
    return [
        AlarmRow(
            number,
            place,
            point,
            event.limit,
            event.kind.value,
            event.at,
            stored_value(event.value),
            event.by,
            event.needs_acknowledgement,
            event.text,
        )
        for place, (point, event) in enumerate(alarms)
    ]


def _counter_rows(counters: Sequence[KeyedCounter], number: int) -> list[tuple[int, object, object, int]]:
    return [(point, _stored_number(each.total), _stored_number(each.last), number) for point, each in counters]


def _stored_number(value: float) -> object:
    return stored_value(value) if is_storable(value) else float(value)


def open_for_reading(path: Path) -> sqlite3.Connection:
    """Open a segment file, or another SQLite file of a store, for reading; the caller closes the connection.

    Raises:
        FileNotFoundError: there is no such file.
        sqlite3.OperationalError: the file cannot be opened.
    """
    if not path.exists():
        raise FileNotFoundError(os.fspath(path))
    try:
        return open_database(path, "PRAGMA query_only=1", makes=False)  # not read-only: a log that was left is read
    except sqlite3.OperationalError as error:
        if path.exists():
            raise
        raise FileNotFoundError(os.fspath(path)) from error


def facts_of(database: sqlite3.Connection, part: StorePart, size: int) -> StorePart:
    """Return the manifest's entry of a segment, with times, commit numbers and number of samples from its file.

    Args:
        database: the segment file.
        part: the entry so far; its id, segment, file and kind are kept.
        size: size of the file in bytes, for the entry.

    Returns:
        The entry; ``low`` and ``high`` are None if the file has no samples, ``alive`` and the commit numbers if it has
        no commits.

    Raises:
        sqlite3.OperationalError: the file has no tables yet (`is_unmade`), or cannot be read.
    """
    low, high, first, last, alive, rows = database.execute(
        "SELECT min(low), max(high), min(number), max(number),"
        " (SELECT at FROM commits ORDER BY number DESC LIMIT 1), coalesce(sum(samples), 0) FROM commits"
    ).fetchone()
    return replace(part, low=low, high=high, first_commit=first, last_commit=last, alive=alive, rows=rows, bytes=size)


def is_unmade(error: sqlite3.OperationalError) -> bool:
    """Whether an error of SQLite means that a segment has no tables yet, because nothing was written to it."""
    return "no such table" in str(error)


def alarms_of(database: sqlite3.Connection, after: int = 0) -> list[AlarmRow]:
    """Return the alarm events in a segment file after commit number ``after``, in the order of their commits.

    Empty if the file has no tables yet.
    """
    try:
        rows = database.execute("SELECT * FROM alarms WHERE commit_number > ? ORDER BY commit_number, place", (after,))
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
        return []
    return [AlarmRow(*row) for row in rows]


def counters_of(database: sqlite3.Connection) -> list[CounterRow]:
    """Return the latest state of each accumulator (running total) that has a state in a segment file.

    Empty if the file has no tables yet.
    """
    try:
        rows = database.execute("SELECT point, total, last, commit_number FROM counters")
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
        return []
    return [CounterRow(*row) for row in rows]


def intervals_of(database: sqlite3.Connection) -> list[IntervalRow]:
    """Return the intervals in which devices were not read, and the gaps, of a segment file, ordered by commit."""
    return [IntervalRow(*row) for row in database.execute("SELECT * FROM intervals ORDER BY commit_number")]
