"""The record of which links this collector owned when, and in which epoch: an SQLite file beside the store.

Knows epochs and commit numbers; knows no coordinator. Which collector owns a shard now is decided by `lease_holder`,
not here.

1. A link's ownership begins after everything that was taken before is committed, so the epoch of a sample follows from
   the number of its commit.
2. A row is on disk before the first transaction of its epoch.
3. An ownership whose end is missing ended with the process; the next start records that end.
4. A gap before an ownership (`ownership_gaps`) is on disk together with it.
5. The outbox asks `OwnershipLog.gaps` for each range of commits once. So an ownership that is recorded later begins
   after the last commit that was asked for, even if the caller names an earlier one: commits of other links may be sent
   while a record waits for the disk.
6. Of two ownerships that begin after the same commit, the one that was recorded later is later. Their times say
   nothing: the wall clock can be set back.
"""

import json
import secrets
import sqlite3
import threading
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ...errors import ConfigError
from ..collector.sample_clock import ClockCorrection
from ..collector.store.folder import OWNERSHIP
from .epoch import Epoch
from .ownership_gaps import OwnershipGap

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS identity (store TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS ownership (
    link TEXT NOT NULL, generation INTEGER NOT NULL, revision INTEGER NOT NULL, after_commit INTEGER NOT NULL,
    begin INTEGER NOT NULL, last_commit INTEGER, "end" INTEGER, PRIMARY KEY (link, generation, revision)
);
CREATE TABLE IF NOT EXISTS configuration (after_commit INTEGER NOT NULL, revision INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS gap (
    link TEXT NOT NULL, generation INTEGER NOT NULL, revision INTEGER NOT NULL, after_commit INTEGER NOT NULL,
    devices TEXT NOT NULL, begin INTEGER NOT NULL, "end" INTEGER NOT NULL, PRIMARY KEY (link, generation, revision)
);
CREATE INDEX IF NOT EXISTS gap_commits ON gap (after_commit)
"""
_BEGIN: Final = """
INSERT INTO ownership VALUES (?, ?, ?, ?, ?, NULL, NULL)
ON CONFLICT DO UPDATE SET last_commit = NULL, "end" = NULL
"""
"""SQL that records an ownership; a link that was out of the configuration for a while continues in the same epoch."""
_GAP: Final = "INSERT OR IGNORE INTO gap VALUES (?, ?, ?, ?, ?, ?, ?)"
_END: Final = """
UPDATE ownership SET last_commit = ?, "end" = ? WHERE link = ? AND generation = ? AND revision = ?
"""
_MEND: Final = """
UPDATE {table} SET {column} = {column} + ? WHERE after_commit >= ? AND {column} >= ? AND {column} < ?
"""


@dataclass(frozen=True, slots=True)
class Ownership:
    """A period in which this collector owned a link: its epoch, its times and its first and last commits.

    Attributes:
        link: name of the link.
        epoch: the epoch of the ownership.
        after_commit: number of the collector's last commit before the period.
        begin: begin of the period, nanoseconds since 1970 UTC.
        last_commit: number of the last commit in the period; None while the period lasts. If the process was killed in
            the period, None until its next start.
        end: end of the period, nanoseconds since 1970 UTC; None if ``last_commit`` is None.
    """

    link: str
    epoch: Epoch
    after_commit: int
    begin: int
    last_commit: int | None = None
    end: int | None = None


class OwnershipLog:
    """The record of which links this collector owned when, in the file ``fleet.sqlite`` beside its store.

    The file is created if missing. May be used from any thread.

    Args:
        folder: folder of the store; this process must hold the store's lock.

    Attributes:
        store: a random word that names this store, the same at every start.

    Raises:
        ConfigError: the file cannot be used.
    """

    store: str

    def __init__(self, folder: Path) -> None:
        path = folder / OWNERSHIP
        self._lock = threading.Lock()
        try:
            self._database = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            path.chmod(0o600)
            self._database.execute("PRAGMA journal_mode=WAL")
            self._database.execute("PRAGMA synchronous=FULL")
            self._database.executescript(_SCHEMA)
            self._database.execute(
                "INSERT INTO identity SELECT ? WHERE NOT EXISTS (SELECT 1 FROM identity)", (secrets.token_hex(6),)
            )
            (self.store,) = self._database.execute("SELECT store FROM identity").fetchone()
        except (sqlite3.Error, OSError) as error:
            raise ConfigError(f"the log of ownership cannot be used: {error}", file=str(path)) from error
        self._asked = 0
        self._epochs: dict[str, list[tuple[int, Epoch]]] = {}
        self._revisions: list[tuple[int, int]] = list(
            self._database.execute("SELECT after_commit, revision FROM configuration ORDER BY rowid")
        )
        for each in self.all():
            self._epochs.setdefault(each.link, []).append((each.after_commit, each.epoch))

    def close(self) -> None:
        """Close the file that records which links were owned."""
        with self._lock:
            self._database.close()

    def begin(
        self, owned: Iterable[tuple[str, Epoch]], after_commit: int, now: int, gaps: Iterable[OwnershipGap] = ()
    ) -> None:
        """Record on disk that links are owned from now on, all of them or none; only then may they be polled.

        A link that was owned in the same epoch before goes on in that period: its begin and ``after_commit`` stay.

        Args:
            owned: names of the links, each with the epoch of its ownership.
            after_commit: number of the last commit before the ownership. If `gaps` was asked up to a later commit, that
                one is recorded instead (rule 5).
            now: the begin of the ownership, nanoseconds since 1970 UTC.
            gaps: the times just before, in which some of the links had no owner. Their own ``commit`` is ignored: they
                are recorded with the same commit as the ownership.

        Raises:
            sqlite3.Error: nothing was recorded; the links must not be polled.
        """
        with self._lock:
            after_commit = max(after_commit, self._asked)  # rule 5
            rows = [(link, epoch.generation, epoch.revision, after_commit, now) for link, epoch in owned]
            before = [
                (
                    gap.link,
                    gap.epoch.generation,
                    gap.epoch.revision,
                    after_commit,
                    json.dumps(gap.devices),
                    gap.begin,
                    gap.end,
                )
                for gap in gaps
            ]
            self._write([(_BEGIN, rows), (_GAP, before)])
            for link, generation, revision, *_ in rows:
                self._epochs.setdefault(link, []).append((after_commit, Epoch(generation, revision)))

    def end(self, owned: Iterable[tuple[str, Epoch]], last_commit: int, now: int) -> None:
        """Record that links are no longer owned. All samples taken from them must be committed before.

        Args:
            owned: names of the links, each with the epoch of the ownership that ends.
            last_commit: number of the last commit in the ownership.
            now: the end of the ownership, nanoseconds since 1970 UTC.

        Raises:
            sqlite3.Error: nothing was recorded.
        """
        rows = [(last_commit, now, link, epoch.generation, epoch.revision) for link, epoch in owned]
        with self._lock:
            self._write([(_END, rows)])

    def mend(self, correction: ClockCorrection, after_commit: int, *, of_one_clock: bool) -> None:
        """Correct times of this start of the collector that were recorded before its wall clock was right.

        Args:
            correction: which times are wrong, and by how much.
            after_commit: number of the last commit before this start: only records that begin after it are corrected.
            of_one_clock: True to correct the begin of gaps too. They are by the clock of the former owner, so this is
                right only if that clock was wrong in the same way.

        Raises:
            sqlite3.Error: nothing was corrected.
        """
        columns = [("ownership", "begin"), ("ownership", '"end"'), ("gap", '"end"')]
        if of_one_clock:
            columns.append(("gap", "begin"))
        numbers = (correction.shift, after_commit, correction.begin, correction.end)
        with self._lock:
            self._write([(_MEND.format(table=table, column=column), [numbers]) for table, column in columns])

    def _write(self, steps: Iterable[tuple[str, Sequence[tuple[str | int, ...]]]]) -> None:
        """Execute SQL statements for all their rows in one transaction, to wait for the disk only once."""
        self._database.execute("BEGIN IMMEDIATE")
        try:
            for statement, rows in steps:
                self._database.executemany(statement, rows)
        except sqlite3.Error:
            self._database.execute("ROLLBACK")
            raise
        self._database.execute("COMMIT")

    def epoch_of(self, link: str, commit: int) -> Epoch | None:
        """Return the epoch in which a link's samples of a commit were taken; None if no ownership began before it.

        That is the epoch of the last ownership of the link that began before the commit, even if it has ended since.
        """
        known = self._epochs.get(link, ())
        place = bisect_left(known, commit, key=lambda each: each[0])
        return known[place - 1][1] if place else None

    def set_configuration(self, revision: int, after_commit: int) -> None:
        """Record the revision of the configuration with which samples after a commit are taken.

        Does nothing if this revision was recorded last. If `gaps` was asked up to a later commit, the revision counts
        from that one (rule 5).

        Raises:
            sqlite3.Error: nothing was recorded.
        """
        with self._lock:
            if self._revisions and self._revisions[-1][1] == revision:
                return
            after_commit = max(after_commit, self._asked)  # rule 5
            self._database.execute("INSERT INTO configuration VALUES (?, ?)", (after_commit, revision))
            self._revisions.append((after_commit, revision))

    def revision_of(self, commit: int) -> int:
        """Return the revision of the configuration with which a commit's samples were taken; 0 if none is known."""
        place = bisect_left(self._revisions, commit, key=lambda each: each[0])
        return self._revisions[place - 1][1] if place else 0

    def gaps(self, after: int, last: int) -> list[OwnershipGap]:
        """Return the gaps of ownerships that begin with commits ``after`` + 1 to ``last``, ordered by commit and link.

        Whatever is recorded after this call begins after ``last`` (rule 5).
        """
        with self._lock, closing(self._database.cursor()) as cursor:
            self._asked = max(self._asked, last)
            rows = cursor.execute(
                "SELECT * FROM gap WHERE after_commit >= ? AND after_commit < ? ORDER BY after_commit, link",
                (after, last),
            ).fetchall()
        return [
            OwnershipGap(link, Epoch(generation, revision), commit + 1, tuple(json.loads(devices)), begin, end)
            for link, generation, revision, commit, devices, begin, end in rows
        ]

    def unended(self) -> dict[str, Epoch]:
        """Return by name of each link the epoch of its last ownership, for links whose last ownership has no end.

        At the start of a process these are the links that it owned when it was killed (rule 3).
        """
        newest = {each.link: each for each in self.all()}
        return {link: each.epoch for link, each in newest.items() if each.end is None}

    def all(self) -> list[Ownership]:
        """Return all recorded periods in which this collector owned a link, the oldest first."""
        with self._lock, closing(self._database.cursor()) as cursor:
            rows = cursor.execute("SELECT * FROM ownership ORDER BY after_commit, rowid").fetchall()
        return [
            Ownership(link, Epoch(generation, revision), after_commit, begin, last_commit, end)
            for link, generation, revision, after_commit, begin, last_commit, end in rows
        ]
