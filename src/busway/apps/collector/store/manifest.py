"""The manifest of a store: one small SQLite file that lists the store's parts, points and sinks.

Knows parts, points, intervals of sealed parts, cursors and files that are to be unlinked. It alone says which files
count: a reader reads it first, a writer changes it last.

1. Every change is one transaction, and durable when it returns (``synchronous=FULL``); changes are rare.
2. A file that a transaction makes superfluous is named in ``unlinks`` by that transaction, and unlinked after it. What
   is found there at the start was left by a crash.
3. Commit numbers are reserved in blocks, and a start goes on behind the block: a number is never used twice, even where
   a power failure took the commits that had it.
4. A point that is renamed keeps its id, and so its history. All new names of a configuration are given at once, so that
   points may exchange theirs; each once, so that the next start gives them no second time.
"""

import json
import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, Final

from ....errors import ConfigError
from ..point_names import PointNames
from ..samples import PointDescription, Value
from .database import open_database, transaction
from .folder import MANIFEST, check_store

FORMAT: Final = 1
"""Of the folder; a store of a later format is refused."""
RESERVED_NUMBERS: Final = 10_000
"""Commit numbers that are reserved at once."""

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS parts (
    id INTEGER PRIMARY KEY, segment INTEGER NOT NULL, file TEXT NOT NULL UNIQUE, kind TEXT NOT NULL,
    low INTEGER, high INTEGER, first_commit INTEGER, last_commit INTEGER, alive INTEGER, rows INTEGER, bytes INTEGER
);
CREATE TABLE IF NOT EXISTS points (
    id INTEGER PRIMARY KEY, device TEXT NOT NULL, point TEXT NOT NULL, unit_of_measure TEXT NOT NULL DEFAULT '',
    is_state INTEGER NOT NULL DEFAULT 0, UNIQUE (device, point)
);
CREATE TABLE IF NOT EXISTS renames (point INTEGER NOT NULL, name TEXT NOT NULL, last_commit INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS carried_names (
    point INTEGER NOT NULL, was TEXT NOT NULL, PRIMARY KEY (point, was)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS intervals (
    device TEXT, begin INTEGER NOT NULL, "end" INTEGER, reason INTEGER NOT NULL, lost INTEGER NOT NULL DEFAULT 0,
    commit_number INTEGER NOT NULL
);
CREATE INDEX IF NOT EXISTS intervals_by_end ON intervals ("end");
CREATE INDEX IF NOT EXISTS intervals_by_commit ON intervals (commit_number);
CREATE TABLE IF NOT EXISTS cursors (
    sink TEXT PRIMARY KEY, commit_number INTEGER NOT NULL, lost INTEGER NOT NULL DEFAULT 0
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS reported (
    sink TEXT NOT NULL, device TEXT NOT NULL, point TEXT NOT NULL, time INTEGER NOT NULL, value TEXT NOT NULL,
    reason INTEGER NOT NULL, PRIMARY KEY (sink, device, point)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS unlinks (file TEXT PRIMARY KEY) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS alarms (
    commit_number INTEGER NOT NULL, place INTEGER NOT NULL, point INTEGER NOT NULL, "limit" TEXT NOT NULL,
    event TEXT NOT NULL, at INTEGER NOT NULL, value, by TEXT NOT NULL, needs INTEGER NOT NULL, text TEXT NOT NULL,
    PRIMARY KEY (commit_number, place)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS counters (
    point INTEGER PRIMARY KEY, total NOT NULL, last NOT NULL, commit_number INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS maintenance (
    device TEXT PRIMARY KEY, begin INTEGER NOT NULL, by TEXT NOT NULL, why TEXT NOT NULL
) WITHOUT ROWID;
"""
INSERT_ALARM: Final = "INSERT OR REPLACE INTO alarms VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True, slots=True)
class StorePart:
    """One file with samples (a segment file or a sealed file), as the manifest lists it.

    Attributes:
        id: number of the part.
        segment: number of the segment that its rows were written to.
        file: name in the folder ``segments``.
        kind: ``open`` (being written), ``closed`` (SQLite, finished) or ``sealed`` (Parquet).
        low, high: nanoseconds since 1970 UTC of the first and last sample; None while it is open, or if it is empty.
        first_commit, last_commit: commit numbers of its rows; None likewise.
        alive: nanoseconds since 1970 UTC of its last commit; None likewise.
        rows: number of samples; None while it is open.
        bytes: size; None while it is open.
    """

    id: int
    segment: int
    file: str
    kind: str
    low: int | None
    high: int | None
    first_commit: int | None
    last_commit: int | None
    alive: int | None
    rows: int | None
    bytes: int | None


@dataclass(frozen=True, slots=True)
class IntervalRow:
    """An interval in which a device (or, if None, every device) was not read, as it is stored."""

    device: str | None
    begin: int
    end: int | None
    reason: int
    lost: int
    commit_number: int


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """An alarm event as it is stored: its commit, its position there, the id of its point, and the rest."""

    commit_number: int
    place: int
    point: int
    limit: str
    event: str
    at: int
    value: Any  # as SQLite has it
    by: str
    needs: int
    text: str


@dataclass(frozen=True, slots=True)
class CounterRow:
    """The state of a running total as it is stored: the id of its point, total, last counter reading, and commit."""

    point: int
    total: Any  # as SQLite has it
    last: Any
    commit_number: int


@dataclass(frozen=True, slots=True)
class MaintenanceRow:
    """A device that is in maintenance: since when (nanoseconds since 1970 UTC), who began it, and why."""

    device: str
    begin: int
    by: str
    why: str


@dataclass(frozen=True, slots=True)
class ReportedSample:
    """The last sample of a point that a sink got, to which the point's report rule compares the next one."""

    device: str
    point: str
    time: int
    value: Value | None
    reason: int


@dataclass(frozen=True, slots=True)
class StoredPoint:
    """A point in the store's list; its id stays when the name changes."""

    id: int
    device: str
    point: str
    unit_of_measure: str
    is_state: bool

    @property
    def name(self) -> str:
        """Name of the point: ``device/point``."""
        return f"{self.device}/{self.point}"


class Manifest:
    """The manifest of a store: list of its files, points, sinks and facts. One writer, any number of readers.

    Attributes:
        descriptions: how often points were described by this object: names that were read before may be others now.
    """

    def __init__(self, folder: Path, *, writes: bool = False) -> None:
        """Open the store's list of files and points; with ``writes`` it is created if missing.

        Raises:
            ConfigError: there is no store, it is of a later format, or the file is damaged; names the folder.
        """
        if not writes:
            check_store(folder)
        self.path: Path = folder / MANIFEST
        self.descriptions: int = 0
        self._lock = threading.RLock()
        try:
            self._database = open_database(self.path, "PRAGMA synchronous=FULL")
            with ExitStack() as unless_open:
                unless_open.callback(self._database.close)
                if writes:
                    self.path.chmod(0o600)
                    self._database.execute("PRAGMA journal_mode=WAL")
                    self._database.executescript(_SCHEMA)
                self._check_format(writes)
                unless_open.pop_all()
        except sqlite3.Error as error:
            if writes and isinstance(error, sqlite3.OperationalError):  # a full disk, for one; the file may be sound
                raise ConfigError(f"the store cannot be written: {error}", file=str(folder)) from error
            raise ConfigError(f"the manifest of the store cannot be read: {error}", file=str(self.path)) from error

    def _check_format(self, writes: bool) -> None:
        found = self.fact("format")
        if found is None and writes:
            self.set_fact("format", FORMAT)
        elif found != FORMAT:
            raise ConfigError(f"the store has format {found}, and this busway knows {FORMAT}", file=str(self.path))

    def close(self) -> None:
        """Close the SQLite file of the manifest."""
        with self._lock:
            self._database.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Context manager of a transaction: durable when the block ends, undone if it raises."""
        with self._lock, transaction(self._database):
            yield self._database

    def _all(self, sql: str, *values: object) -> list[Any]:  # rows of SQLite have any type
        with self._lock:
            return self._database.execute(sql, values).fetchall()

    # Facts

    def fact(self, name: str) -> int | None:
        """Return a number that the manifest stores under a name; None if there is none."""
        rows = self._all("SELECT value FROM facts WHERE name = ?", name)
        return None if not rows else rows[0][0]

    def set_fact(self, name: str, value: int | None) -> None:
        """Store a number under a name in the manifest; None deletes it."""
        with self.transaction() as database:
            if value is None:
                database.execute("DELETE FROM facts WHERE name = ?", (name,))
            else:
                database.execute("INSERT OR REPLACE INTO facts VALUES (?, ?)", (name, value))

    def reserve_numbers(self) -> tuple[int, int]:
        """Reserve a range of commit numbers; returns the first, and the one after the last."""
        with self.transaction() as database:
            row = database.execute("SELECT value FROM facts WHERE name = 'reserved'").fetchone()
            first = 1 if row is None else row[0]
            database.execute("INSERT OR REPLACE INTO facts VALUES ('reserved', ?)", (first + RESERVED_NUMBERS,))
        return first, first + RESERVED_NUMBERS

    # Parts

    def parts(self) -> list[StorePart]:
        """Return all files with samples, in the order in which they were begun."""
        return [StorePart(*row) for row in self._all("SELECT * FROM parts ORDER BY id")]

    def add_segment(self) -> StorePart:
        """Add a new segment (SQLite file of samples) to the list of files; the file does not exist yet."""
        with self.transaction() as database:
            row = database.execute("SELECT value FROM facts WHERE name = 'segment'").fetchone()
            number = 1 if row is None else row[0] + 1
            database.execute("INSERT OR REPLACE INTO facts VALUES ('segment', ?)", (number,))
            file = f"{number:08d}.sqlite"
            cursor = database.execute("INSERT INTO parts (segment, file, kind) VALUES (?, ?, 'open')", (number, file))
            identity = cursor.lastrowid or 0
        return StorePart(identity, number, file, "open", None, None, None, None, None, None, None)

    def close_segment(
        self,
        part: StorePart,
        alarms: Iterable[AlarmRow] = (),
        counters: Iterable[CounterRow] = (),
        *,
        is_mended: bool = False,
    ) -> None:
        """Record what a finished segment file contains, and copy its alarms and running totals into the manifest.

        With ``is_mended`` its times are corrected, and so are those of all segments before it.
        """
        with self.transaction() as database:
            database.executemany(INSERT_ALARM, [astuple(row) for row in alarms])
            database.executemany(
                "INSERT INTO counters VALUES (?, ?, ?, ?) ON CONFLICT (point) DO UPDATE SET total = excluded.total,"
                " last = excluded.last, commit_number = excluded.commit_number"
                " WHERE excluded.commit_number > commit_number",
                [astuple(row) for row in counters],
            )
            database.execute(
                "UPDATE parts SET kind = 'closed', low = ?, high = ?, first_commit = ?, last_commit = ?, alive = ?,"
                " rows = ?, bytes = ? WHERE id = ?",
                (part.low, part.high, part.first_commit, part.last_commit, part.alive, part.rows, part.bytes, part.id),
            )
            if is_mended:
                database.execute("INSERT OR REPLACE INTO facts VALUES ('mended', ?)", (part.id,))
            database.execute(  # by number, not by time: the clock may have been set back
                "INSERT OR REPLACE INTO facts SELECT name, value FROM"
                " (SELECT 'alive' AS name, :alive AS value UNION ALL SELECT 'alive_commit', :commit)"
                " WHERE :commit >= coalesce((SELECT value FROM facts WHERE name = 'alive_commit'), 0)",
                {"alive": part.alive, "commit": part.last_commit},
            )

    def replace_part(self, old: StorePart, new: Sequence[StorePart], intervals: Iterable[IntervalRow]) -> None:
        """List Parquet files in place of the segment file that they were made from, whose file is to be
        deleted then.
        """
        with self.transaction() as database:
            database.execute("DELETE FROM parts WHERE id = ?", (old.id,))
            for part in new:
                database.execute(
                    "INSERT INTO parts (segment, file, kind, low, high, first_commit, last_commit, alive, rows, bytes)"
                    " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                    astuple(part)[1:],
                )
            database.executemany(
                "INSERT INTO intervals VALUES (?, ?, ?, ?, ?, ?)",
                [(row.device, row.begin, row.end, row.reason, row.lost, row.commit_number) for row in intervals],
            )
            database.execute("INSERT OR REPLACE INTO unlinks VALUES (?)", (old.file,))

    def drop_parts(self, parts: Iterable[StorePart], before: int) -> None:
        """Remove files, and silences that ended before a time, from the list; the caller then deletes the files.

        Samples that a sink does not have are lost for it, and counted: all of a part that it has not finished.
        """
        with self.transaction() as database:
            for part in parts:
                database.execute("DELETE FROM parts WHERE id = ?", (part.id,))
                database.execute("INSERT OR REPLACE INTO unlinks VALUES (?)", (part.file,))
                database.execute(
                    "UPDATE cursors SET lost = lost + ? WHERE commit_number < ?",
                    (part.rows or 0, part.last_commit or 0),
                )
            database.execute('DELETE FROM intervals WHERE "end" < ?', (before,))

    def files_to_unlink(self) -> list[str]:
        """Return the names of files that are off the list and still have to be deleted."""
        return [row[0] for row in self._all("SELECT file FROM unlinks")]

    def unlinked(self, file: str) -> None:
        """Record that a file that is no longer listed was deleted."""
        with self.transaction() as database:
            database.execute("DELETE FROM unlinks WHERE file = ?", (file,))

    def intervals(self, after: int = 0) -> list[IntervalRow]:
        """Return the silences of devices in finished files that were stored after a commit number."""
        rows = self._all("SELECT * FROM intervals WHERE commit_number > ? ORDER BY commit_number", after)
        return [IntervalRow(*row) for row in rows]

    # Alarms, accumulators, maintenance

    def alarms(self, after: int = 0) -> list[AlarmRow]:
        """Return the alarm events of finished segment files after a commit, in the order of their commits."""
        rows = self._all("SELECT * FROM alarms WHERE commit_number > ? ORDER BY commit_number, place", after)
        return [AlarmRow(*row) for row in rows]

    def forget_alarms(self, rows: Iterable[AlarmRow]) -> None:
        """Delete alarm events from the manifest."""
        with self.transaction() as database:
            database.executemany(
                "DELETE FROM alarms WHERE commit_number = ? AND place = ?",
                [(row.commit_number, row.place) for row in rows],
            )

    def counters(self) -> list[CounterRow]:
        """Return the states of running totals (accumulators) at the end of finished segment files."""
        return [CounterRow(*row) for row in self._all("SELECT * FROM counters")]

    def maintenance(self) -> list[MaintenanceRow]:
        """Return the devices that are in maintenance."""
        return [MaintenanceRow(*row) for row in self._all("SELECT * FROM maintenance ORDER BY device")]

    def begin_maintenance(self, row: MaintenanceRow) -> None:
        """Record in the store that a device is in maintenance."""
        with self.transaction() as database:
            database.execute("INSERT OR REPLACE INTO maintenance VALUES (?, ?, ?, ?)", astuple(row))

    def end_maintenance(self, device: str) -> None:
        """Record in the store that a device is no longer in maintenance."""
        with self.transaction() as database:
            database.execute("DELETE FROM maintenance WHERE device = ?", (device,))

    def begin_maintenance_again(self, earliest: int, now: int) -> None:
        """Set the begin of maintenance to now if it is unknown, because it was recorded without the time."""
        with self.transaction() as database:
            database.execute("UPDATE maintenance SET begin = ? WHERE begin < ?", (now, earliest))

    def begin_mending(self, first: int, shift: int, earliest: int) -> None:
        """Record that times before ``earliest`` are to be corrected from a commit on; correct those of maintenance."""
        with self.transaction() as database:
            database.execute("DELETE FROM facts WHERE name = 'mended'")
            database.execute("INSERT OR REPLACE INTO facts VALUES ('mend_by', ?), ('mend_from', ?)", (shift, first))
            database.execute("UPDATE maintenance SET begin = begin + ? WHERE begin < ?", (shift, earliest))

    # Points

    def points(self) -> list[StoredPoint]:
        """Return all points that the store ever had samples of."""
        rows = self._all("SELECT id, device, point, unit_of_measure, is_state FROM points ORDER BY id")
        return [StoredPoint(number, device, point, unit, bool(state)) for number, device, point, unit, state in rows]

    def point_names(self) -> PointNames:
        """Return the names that all points have now, and had before."""
        with self._lock:
            return _names_of(self._database)

    def count_points(self) -> int:
        """Return the number of points of the store."""
        found: int = self._all("SELECT count(*) FROM points")[0][0]
        return found

    def former_names(self) -> list[tuple[str, int]]:
        """Return names that points had before and none has now, as ``device/point``, with the points' ids."""
        return self._all(
            "SELECT DISTINCT device || '/' || renames.name, points.id"
            " FROM renames JOIN points ON points.id = renames.point WHERE NOT EXISTS"
            " (SELECT 1 FROM points AS now WHERE now.device = points.device AND now.point = renames.name)"
        )

    def renames(self) -> list[tuple[int, str, int]]:
        """Return ids of points with earlier names, and the last commit under each name, in order."""
        return self._all("SELECT point, name, last_commit FROM renames ORDER BY rowid")

    def describe_points(self, descriptions: Iterable[PointDescription], last_commit: int) -> None:
        """Write descriptions of points; a point with a new name keeps its id, and so its history.

        Args:
            descriptions: the points; names that change among them change at once.
            last_commit: number of the last commit, whose samples go by the names of before.
        """
        described = list(descriptions)
        with self.transaction() as database:
            _give_new_names(database, described, last_commit)
            for one in described:
                database.execute(
                    "INSERT INTO points (device, point, unit_of_measure, is_state) VALUES (?, ?, ?, ?)"
                    " ON CONFLICT (device, point) DO UPDATE SET unit_of_measure = excluded.unit_of_measure,"
                    " is_state = excluded.is_state",
                    (one.device, one.point, one.unit_of_measure, one.is_state),
                )
            database.executemany(
                "INSERT OR IGNORE INTO carried_names SELECT id, ? FROM points WHERE device = ? AND point = ?",
                [(one.was, one.device, one.point) for one in described if one.was is not None],
            )
        self.descriptions += 1

    def point_ids(self, device: str, points: Sequence[str], states: frozenset[str] = frozenset()) -> list[int]:
        """Return the ids of points of a device; new ones get one, and count as states if ``states`` names them."""
        found = dict(self._all("SELECT point, id FROM points WHERE device = ?", device))
        new = [point for point in points if point not in found]
        if new:
            with self.transaction() as database:
                for point in new:
                    cursor = database.execute(
                        "INSERT INTO points (device, point, is_state) VALUES (?, ?, ?)",
                        (device, point, point in states),
                    )
                    found[point] = cursor.lastrowid or 0
        return [found[point] for point in points]

    # Cursors

    def cursors(self) -> dict[str, tuple[int, int]]:
        """Return by sink its cursor: the last commit that it got, and the number of samples dropped for it."""
        return {sink: (number, lost) for sink, number, lost in self._all("SELECT * FROM cursors")}

    def set_cursor(self, sink: str, number: int, lost: int, reported: Iterable[ReportedSample] = ()) -> None:
        """Record the last commit that a sink got, and the last sent samples of points that it gets only in part."""
        rows = [(sink, each.device, each.point, each.time, json.dumps(each.value), each.reason) for each in reported]
        with self.transaction() as database:
            database.execute("INSERT OR REPLACE INTO cursors VALUES (?, ?, ?)", (sink, number, lost))
            database.executemany("INSERT OR REPLACE INTO reported VALUES (?, ?, ?, ?, ?, ?)", rows)

    def reported(self, sink: str) -> list[ReportedSample]:
        """Return the last samples that a sink got of points of which it gets only some, by its report rules."""
        rows = self._all("SELECT device, point, time, value, reason FROM reported WHERE sink = ?", sink)
        return [
            ReportedSample(device, point, time, json.loads(value), reason)
            for device, point, time, value, reason in rows
        ]


def copy_points(source: Path, target: sqlite3.Connection) -> None:
    """Write the points of one manifest, with all their names, into a copy of it."""
    target.execute("ATTACH ? AS source", (str(source),))
    with target:
        for table in ("points", "renames", "carried_names"):
            target.execute(f"DELETE FROM main.{table}")
            target.execute(f"INSERT INTO main.{table} SELECT * FROM source.{table}")


def _names_of(database: sqlite3.Connection) -> PointNames:
    rows = database.execute("SELECT device, point, id FROM points").fetchall()
    ids = {(device, point): number for device, point, number in rows}
    return PointNames(ids, set(database.execute("SELECT point, was FROM carried_names")))


def _give_new_names(database: sqlite3.Connection, described: Sequence[PointDescription], last_commit: int) -> None:
    """Rename points to their current names, unless another point still has such a name."""
    moves = _names_of(database).moves(described)
    for old, one in moves.items():
        database.execute("INSERT INTO renames VALUES (?, ?, ?)", (old, one.was, last_commit))
        database.execute("UPDATE points SET point = char(0) || id WHERE id = ?", (old,))  # until all have left theirs
    for old, one in moves.items():
        database.execute("UPDATE points SET point = ? WHERE id = ?", (one.point, old))
