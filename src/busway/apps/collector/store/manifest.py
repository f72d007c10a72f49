"""The manifest of a store: one small SQLite file that lists the store's parts, points and sinks.

Knows parts, points, intervals of sealed parts, cursors and files to be deleted. It alone decides which files belong to
the store: a reader reads it first, a writer changes it last.

1. Every change is one transaction, and durable when it returns (``synchronous=FULL``); changes are rare.
2. If a transaction makes a file superfluous, it lists the file in the table ``unlinks``; the file is deleted after the
   transaction. Files that are listed there at a start were left by a crash.
3. Commit numbers are reserved in blocks. After a start they continue with a new block, so that no number is used twice,
   even if a power failure lost the commits that had it.
4. A point that is renamed keeps its id, and so its history. All new names of a configuration are given at once, so that
   points may exchange their names. A rename is made only once: later starts with the same configuration do not repeat
   it.
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
from ..sample_clock import ClockCorrection
from ..samples import PointDescription, SampleValue
from .clock_correction import EVERY, CommitCorrection
from .database import open_database, transaction
from .folder import MANIFEST, check_store

FORMAT: Final = 1
"""The format of a store that this version reads and writes; another format is refused."""
RESERVED_NUMBERS: Final = 10_000
"""How many commit numbers are reserved in one transaction."""

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
_FLOAT32: Final = "SELECT value FROM json_each((SELECT value FROM facts WHERE name = 'float32'))"
"""SQL query for the ids of the points of type float32."""
_LAST: Final = chr(0x10FFFF)
"""A character that comes after all others, and is in no name."""
INSERT_ALARM: Final = "INSERT OR REPLACE INTO alarms VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"


@dataclass(frozen=True, slots=True)
class StorePart:
    """One file with samples (a segment file or a sealed file), as the manifest lists it.

    Attributes:
        id: number of the part.
        segment: number of the segment that its rows were written to.
        file: name in the folder ``segments``.
        kind: ``open`` (being written), ``closed`` (SQLite, finished) or ``sealed`` (Parquet).
        low, high: times of the first and last sample, nanoseconds since 1970 UTC; None while it is open, or if it has
            no samples.
        first_commit, last_commit: numbers of the first and last commit in it; None while it is open.
        alive: time of the last commit in it, nanoseconds since 1970 UTC; None while it is open.
        rows: number of samples; None while it is open.
        bytes: size of the file in bytes; None while it is open.

    Readers make copies of the entry of an open segment in which these values are filled in.
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
class DeviceChoice:
    """The devices whose points are wanted: those with one of some names, and those whose names begin with some text.

    Attributes:
        names: whole names.
        beginnings: what other names begin with; not empty texts.
    """

    names: frozenset[str]
    beginnings: frozenset[str]

    def condition(self) -> tuple[str, list[str]]:
        """Return a clause ``WHERE`` for the table of points, and its values; SQLite finds the rows by their index."""
        beginnings = sorted(self.beginnings)
        listed = f"device IN ({', '.join('?' * len(self.names))})"
        clauses = [listed, *["device >= ? AND device < ?"] * len(beginnings)]
        limits = [limit for each in beginnings for limit in (each, each + _LAST)]
        return f"WHERE {' OR '.join(clauses)}", [*sorted(self.names), *limits]


@dataclass(frozen=True, slots=True)
class IntervalRow:
    """An interval in which a device was not read, or a gap of the whole collector, as it is stored.

    Attributes:
        device: name of the device; None for a gap.
        begin, end: nanoseconds since 1970 UTC; the end is None in the row that was stored when the interval began.
        reason: number of the reason why nothing was read.
        lost: number of samples lost in a gap; 0 otherwise.
        commit_number: number of the commit that stored the row.
    """

    device: str | None
    begin: int
    end: int | None
    reason: int
    lost: int
    commit_number: int

    @property
    def key(self) -> tuple[str | None, int, int]:
        """Device, begin and reason: the same in the two rows of an interval, stored when it begins and when it ends."""
        return self.device, self.begin, self.reason


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """An alarm event as it is stored.

    Attributes:
        commit_number, place: number of its commit and position in it.
        point: id of its point.
        limit, event, at, by, text: as in `AlarmEvent`; ``event`` is its ``kind``.
        value: the value as SQLite stores it (`stored_value`); None for no value.
        needs: 1 if the alarm needs an acknowledgement, else 0.
    """

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
    """The state of an accumulator (running total) as it is stored.

    Attributes:
        point: id of its point.
        total, last: the total, and the counter reading from which it was computed, as SQLite stores them.
        commit_number: number of the commit that stored the state.
    """

    point: int
    total: Any  # as SQLite has it
    last: Any
    commit_number: int


@dataclass(frozen=True, slots=True)
class MaintenanceRow:
    """The record that a device is in maintenance.

    Attributes:
        device: name of the device.
        begin: since when, nanoseconds since 1970 UTC.
        by: who began it.
        why: the reason, as text.
    """

    device: str
    begin: int
    by: str
    why: str


@dataclass(frozen=True, slots=True)
class ReportedSample:
    """The last sample of a point that a sink got; the report rule of the point compares the next sample with it.

    Attributes:
        device, point: names.
        time: nanoseconds since 1970 UTC.
        value: the value; None if the sample is bad and has none.
        reason: number of the reason, 0 for good.
    """

    device: str
    point: str
    time: int
    value: SampleValue | None
    reason: int


@dataclass(frozen=True, slots=True)
class StoredPoint:
    """A point as the manifest lists it. Its id stays the same when the point is renamed.

    Attributes:
        id: number of the point in the store.
        device, point: present names of its device and of itself.
        unit_of_measure: its unit of measure, such as ``kW``; empty without one.
        is_state: whether its values are states, true or false.
        is_float32: whether its values are numbers of type float32 without a scale, which need fewer digits.
    """

    id: int
    device: str
    point: str
    unit_of_measure: str
    is_state: bool
    is_float32: bool = False

    @property
    def name(self) -> str:
        """Device and name of the point: ``device/point``."""
        return f"{self.device}/{self.point}"


class Manifest:
    """The manifest of a store: the list of its files, points, sinks and facts. One writer, any number of readers.

    Attributes:
        path: the SQLite file of the manifest.
        descriptions: how often `describe_points` was called on this object; if it grew, names read before may be old.
    """

    def __init__(self, folder: Path, *, writes: bool = False) -> None:
        """Open the manifest in the folder of a store.

        Args:
            folder: the folder of the store.
            writes: whether to open it for changes; then it is created if it is missing.

        Raises:
            ConfigError: there is no store, it has another format, or the file is damaged or cannot be written.
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
        """Return a context manager that makes a transaction: durable when the block ends, undone if the block raises.

        The block gets the connection to the database; other threads that use this object wait meanwhile.
        """
        with self._lock, transaction(self._database):
            yield self._database

    def _all(self, sql: str, *values: object) -> list[Any]:  # rows of SQLite have any type
        with self._lock:
            return self._database.execute(sql, values).fetchall()

    # Facts

    def fact(self, name: str) -> int | None:
        """Return the number that the manifest stores under a name; None if there is none."""
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
        """Reserve the next `RESERVED_NUMBERS` commit numbers; return the first one, and the number after the last."""
        with self.transaction() as database:
            row = database.execute("SELECT value FROM facts WHERE name = 'reserved'").fetchone()
            first = 1 if row is None else row[0]
            database.execute("INSERT OR REPLACE INTO facts VALUES ('reserved', ?)", (first + RESERVED_NUMBERS,))
        return first, first + RESERVED_NUMBERS

    # Parts

    def parts(self) -> list[StorePart]:
        """Return all parts (files with samples), in the order in which they were listed."""
        return [StorePart(*row) for row in self._all("SELECT * FROM parts ORDER BY id")]

    def add_segment(self) -> StorePart:
        """List a new open segment (SQLite file of samples), and return its part; the file does not exist yet."""
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
        """List a segment as closed, and copy its alarm events and the states of its accumulators into the manifest.

        Args:
            part: the entry of the segment, with times, commit numbers and size from its file (`facts_of`).
            alarms: its alarm events.
            counters: the states of its accumulators.
            is_mended: whether its times, and those of all segments before it, were corrected after the clock was set.
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
        """List Parquet files in place of the segment file that they were made from; the caller then deletes that file.

        Args:
            old: the segment.
            new: the parts to list; their ids are given here.
            intervals: the intervals of the segment, which are stored in the manifest from now on.
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

    def drop_parts(self, parts: Iterable[StorePart], before: int, intervals: Iterable[IntervalRow] = ()) -> None:
        """Remove parts, and intervals that ended before a time, from the manifest; the caller then deletes the files.

        For a sink that has not got all samples of a part, all samples of that part are counted as lost.

        Args:
            parts: the parts.
            before: nanoseconds since 1970 UTC; intervals that ended earlier are removed.
            intervals: intervals of dropped segments to be kept in the manifest.
        """
        with self.transaction() as database:
            database.executemany(
                "INSERT INTO intervals VALUES (?, ?, ?, ?, ?, ?)",
                [(row.device, row.begin, row.end, row.reason, row.lost, row.commit_number) for row in intervals],
            )
            for part in parts:
                database.execute("DELETE FROM parts WHERE id = ?", (part.id,))
                database.execute("INSERT OR REPLACE INTO unlinks VALUES (?)", (part.file,))
                database.execute(
                    "UPDATE cursors SET lost = lost + ? WHERE commit_number < ?",
                    (part.rows or 0, part.last_commit or 0),
                )
            database.execute(  # the row of its begin goes with that of its end: alone it has no end
                'DELETE FROM intervals WHERE "end" IS NULL AND (device, begin, reason) IN'
                ' (SELECT device, begin, reason FROM intervals WHERE "end" < ?)',
                (before,),
            )
            database.execute('DELETE FROM intervals WHERE "end" < ?', (before,))

    def files_to_unlink(self) -> list[str]:
        """Return the names of files that are no longer listed and still have to be deleted."""
        return [row[0] for row in self._all("SELECT file FROM unlinks")]

    def unlinked(self, file: str) -> None:
        """Record that a file that is no longer listed was deleted."""
        with self.transaction() as database:
            database.execute("DELETE FROM unlinks WHERE file = ?", (file,))

    def intervals(self, after: int = 0) -> list[IntervalRow]:
        """Return the intervals in the manifest that were stored after a commit number, ordered by commit.

        They are those of sealed segments, and some of dropped ones. Intervals of open and closed segments are in the
        segment files.
        """
        rows = self._all("SELECT * FROM intervals WHERE commit_number > ? ORDER BY commit_number", after)
        return [IntervalRow(*row) for row in rows]

    # Alarms, accumulators, maintenance

    def alarms(self, after: int = 0) -> list[AlarmRow]:
        """Return the alarm events of finished segments that were stored after a commit number, ordered by commit."""
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
        """Return the states of accumulators (running totals) at the end of all finished segments."""
        return [CounterRow(*row) for row in self._all("SELECT * FROM counters")]

    def maintenance(self) -> list[MaintenanceRow]:
        """Return the devices that are in maintenance, ordered by name."""
        return [MaintenanceRow(*row) for row in self._all("SELECT * FROM maintenance ORDER BY device")]

    def begin_maintenance(self, row: MaintenanceRow) -> None:
        """Record in the store that a device is in maintenance, since when, why and by whom; replaces an earlier record.

        Raises:
            sqlite3.Error: nothing was recorded.
        """
        with self.transaction() as database:
            database.execute("INSERT OR REPLACE INTO maintenance VALUES (?, ?, ?, ?)", astuple(row))

    def end_maintenance(self, device: str) -> None:
        """Record in the store that a device is no longer in maintenance."""
        with self.transaction() as database:
            database.execute("DELETE FROM maintenance WHERE device = ?", (device,))

    def begin_maintenance_again(self, earliest: int, now: int) -> None:
        """Set the begin of each maintenance to ``now`` if it was taken from a wrong wall clock.

        Args:
            earliest: nanoseconds since 1970 UTC; an earlier time is from a clock that was not set.
            now: nanoseconds since 1970 UTC.
        """
        with self.transaction() as database:
            database.execute("UPDATE maintenance SET begin = ? WHERE begin < ?", (now, earliest))

    def begin_mending(self, correction: CommitCorrection) -> None:
        """Record a correction of times in segments that is to be made; correct the begin of maintenance at once."""
        clock = correction.clock
        facts = {
            "mend_by": clock.shift,
            "mend_from": correction.first,
            "mend_to": correction.last,
            "mend_begin": clock.begin,
            "mend_end": clock.end,
        }
        with self.transaction() as database:
            database.execute("DELETE FROM facts WHERE name = 'mended'")
            database.executemany("INSERT OR REPLACE INTO facts VALUES (?, ?)", facts.items())
            database.execute(
                "UPDATE maintenance SET begin = begin + ? WHERE begin >= ? AND begin < ?",
                (clock.shift, clock.begin, clock.end),
            )

    def correction(self) -> CommitCorrection | None:
        """Return the correction of times that was begun and is not complete; None if there is none."""
        first, shift = self.fact("mend_from"), self.fact("mend_by")
        if first is None or shift is None:
            return None
        last, begin, end = self.fact("mend_to"), self.fact("mend_begin"), self.fact("mend_end")
        if last is None or begin is None or end is None:  # of a version that corrected times before 2026 alone
            return CommitCorrection(first, EVERY, ClockCorrection(shift))
        return CommitCorrection(first, last, ClockCorrection(shift, begin, end))

    # Points

    def points(self, devices: DeviceChoice | None = None) -> list[StoredPoint]:
        """Return the points of the store, also those that are no longer read, in the order of their ids.

        Args:
            devices: the devices whose points are wanted; None for all.
        """
        where, values = ("", []) if devices is None else devices.condition()
        rows = self._all(
            f"SELECT id, device, point, unit_of_measure, is_state, id IN ({_FLOAT32}) FROM points {where} ORDER BY id",
            *values,
        )
        return [
            StoredPoint(number, device, point, unit, bool(state), bool(single))
            for number, device, point, unit, state, single in rows
        ]

    def point_texts(self) -> list[tuple[int, str, str, str]]:
        """Return id, device, name and unit of measure of all points, in the order of their ids; quicker than `points`.

        These are the texts that a sealed file has of its points.
        """
        return self._all("SELECT id, device, point, unit_of_measure FROM points ORDER BY id")

    def point_names(self) -> PointNames:
        """Return the present names of all points, and the former names that points have taken over (`PointNames`)."""
        with self._lock:
            return _names_of(self._database)

    def count_points(self) -> int:
        """Return the number of points of the store."""
        found: int = self._all("SELECT count(*) FROM points")[0][0]
        return found

    def former_names(self) -> list[tuple[str, int]]:
        """Return former names of points that no point has now, each with the point that had it.

        Returns:
            Pairs of a name, ``device/point``, and the id of its point.
        """
        return self._all(
            "SELECT DISTINCT device || '/' || renames.name, points.id"
            " FROM renames JOIN points ON points.id = renames.point WHERE NOT EXISTS"
            " (SELECT 1 FROM points AS now WHERE now.device = points.device AND now.point = renames.name)"
        )

    def renames(self) -> list[tuple[int, str, int]]:
        """Return the former names of points, in the order in which the points were renamed.

        Returns:
            Tuples of the id of a point, a former name, and the number of the last commit under that name.
        """
        return self._all("SELECT point, name, last_commit FROM renames ORDER BY rowid")

    def describe_points(self, descriptions: Iterable[PointDescription], last_commit: int) -> None:
        """Write descriptions of points; a point with a new name keeps its id, and so its history.

        Points that are not listed yet are added. Points that are listed and not described stay as they are.

        Args:
            descriptions: the points; ``was`` is the name of a renamed point before. All new names are given at once, so
                that points may exchange their names.
            last_commit: number of the last commit; samples up to it keep the names that the points had before.
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
            _note_float32(database, described)
        self.descriptions += 1

    def point_ids(self, device: str, points: Sequence[str], states: frozenset[str] = frozenset()) -> list[int]:
        """Return the ids of points of a device, in the order of ``points``; points that are not listed yet are added.

        Args:
            device: name of the device.
            points: names of the points.
            states: names of those points whose values are states, true or false; used only for added points.
        """
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
        """Return by name of sink the number of the last commit that it got (its cursor), and of samples lost for it.

        The cursor is 0 for a sink that has got nothing yet.
        """
        return {sink: (number, lost) for sink, number, lost in self._all("SELECT * FROM cursors")}

    def set_cursor(self, sink: str, number: int, lost: int, reported: Iterable[ReportedSample] = ()) -> None:
        """Record up to which commit a sink has got everything (its cursor).

        Args:
            sink: name of the sink.
            number: number of the commit.
            lost: number of samples, over all time, that the sink did not get because they were dropped before.
            reported: the last sent samples of points of which the sink gets only some samples; they replace earlier
                ones of the same points.
        """
        rows = [(sink, each.device, each.point, each.time, json.dumps(each.value), each.reason) for each in reported]
        with self.transaction() as database:
            database.execute("INSERT OR REPLACE INTO cursors VALUES (?, ?, ?)", (sink, number, lost))
            database.executemany("INSERT OR REPLACE INTO reported VALUES (?, ?, ?, ?, ?, ?)", rows)

    def reported(self, sink: str) -> list[ReportedSample]:
        """Return the last samples that a sink got of its points with a report rule; see `set_cursor`."""
        rows = self._all("SELECT device, point, time, value, reason FROM reported WHERE sink = ?", sink)
        return [
            ReportedSample(device, point, time, json.loads(value), reason)
            for device, point, time, value, reason in rows
        ]


def _note_float32(database: sqlite3.Connection, described: Sequence[PointDescription]) -> None:
    """Record which of the described points are of type float32; what is recorded of others stays.

    It is stored as a fact and not in the table of points, so that stores written by earlier versions can be read.
    """
    ids = {
        (device, point): number for device, point, number in database.execute("SELECT device, point, id FROM points")
    }
    before = {number for (number,) in database.execute(_FLOAT32)}
    found = before - {ids[one.device, one.point] for one in described}
    found |= {ids[one.device, one.point] for one in described if one.is_float32}
    if found != before:
        database.execute("INSERT OR REPLACE INTO facts VALUES ('float32', ?)", (json.dumps(sorted(found)),))


def copy_points(source: Path, target: sqlite3.Connection) -> None:
    """Copy the points and the reserved commit numbers from a manifest into a copy of it, replacing those in the copy.

    Points are copied with their present and former names. Commits made with the copy get numbers above those of all
    commits that were made with the original before.

    Args:
        source: the file of the original manifest.
        target: the open copy.
    """
    target.execute("ATTACH ? AS source", (str(source),))
    with target:
        for table in ("points", "renames", "carried_names"):
            target.execute(f"DELETE FROM main.{table}")
            target.execute(f"INSERT INTO main.{table} SELECT * FROM source.{table}")
        target.execute("INSERT OR REPLACE INTO main.facts SELECT * FROM source.facts WHERE name = 'reserved'")


def _names_of(database: sqlite3.Connection) -> PointNames:
    rows = database.execute("SELECT device, point, id FROM points").fetchall()
    ids = {(device, point): number for device, point, number in rows}
    return PointNames(ids, set(database.execute("SELECT point, was FROM carried_names")))


def _give_new_names(database: sqlite3.Connection, described: Sequence[PointDescription], last_commit: int) -> None:
    """Rename the points whose descriptions have a new name, all at once, and record their former names.

    A point is not renamed if another point has the new name and keeps it, or if the point with the new name has taken
    over the former name before (rule 4).
    """
    moves = _names_of(database).moves(described)
    for old, one in moves.items():
        database.execute("INSERT INTO renames VALUES (?, ?, ?)", (old, one.was, last_commit))
        database.execute("UPDATE points SET point = char(0) || id WHERE id = ?", (old,))  # until all have left theirs
    for old, one in moves.items():
        database.execute("UPDATE points SET point = ? WHERE id = ?", (one.point, old))
