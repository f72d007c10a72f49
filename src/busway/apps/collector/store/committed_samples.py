"""Reads a store's samples in the order of their commits, from a commit number on; sinks use it.

Knows how each kind of part is read in that order; knows no sink.

1. Nothing is read that was not committed. An interval in which a device was not read is given as a sample without a
   value for each point of the device, at the begin of the interval. Skipped rounds, and gaps of the whole collector,
   are not given.
2. Samples are ordered by commit, then by time, then by point.
3. A segment is read from the first wanted commit on. Sealed parts, which are sorted by point, are read by ranges of
   commits.
4. A sample has the name that its point had when it was committed: if it is read again after a rename, its name is the
   same.
"""

from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from ..alarms.events import AlarmEvent
from ..sample_clock import EARLIEST
from ..samples import Quality, SampleValue, quality_of
from .alarm_events import alarm_events, alarm_rows
from .clock_correction import EVERY
from .file_rows import FileRow
from .folder import SEGMENTS
from .manifest import AlarmRow, IntervalRow, Manifest, StoredPoint, StorePart
from .part_reader import open_part_facts, part_intervals
from .sealed_reader import rows_of_table
from .sealing import arrow
from .segment import open_for_reading, sample_value

Result = TypeVar("Result")

_TRIES: Final = 10
_COLUMNS: Final = ["time", "point", "real", "integer", "text", "large", "reason", "half_width", "commit_number"]


class CommittedSample(NamedTuple):
    """A sample as sinks read it from the store, with its commit number.

    Attributes:
        commit: number of its commit. With device, point and time it identifies the sample, also when it is read again.
        device, point: names.
        time: nanoseconds since 1970 UTC, the middle of the transaction.
        half_width: half the length of the transaction, nanoseconds.
        value: the value; None if the sample is bad and has none.
        reason: number of the reason, 0 for good.
        unit_of_measure: the unit of measure of the point; empty for none.
        revision: revision of the fleet's configuration with which it was taken; 0 for a sample read from a store.
    """

    commit: int
    device: str
    point: str
    time: int
    half_width: int
    value: SampleValue | None
    reason: int
    unit_of_measure: str = ""
    revision: int = 0

    @property
    def quality(self) -> Quality:
        """The quality of the sample: good, uncertain or bad."""
        return quality_of(self.reason)


@dataclass(frozen=True, slots=True)
class CommittedAlarm:
    """An alarm event as sinks read it from the store, with its commit number.

    Attributes:
        commit, place: number of its commit, and its position in that, 0-based. They identify the event, also when it is
            read again.
        event: the alarm event.
    """

    commit: int
    place: int
    event: AlarmEvent


@dataclass(frozen=True, slots=True)
class CommitRange:
    """The samples and alarm events of consecutive commits of a store.

    Attributes:
        last: number of the last of these commits.
        samples: ordered by commit, time and point.
        alarms: alarm events of these commits, ordered by commit and place.
        more: whether the store already has later commits.
    """

    last: int
    samples: list[CommittedSample]
    alarms: list[CommittedAlarm] = field(default_factory=list)
    more: bool = False


class CommitReader:
    """Reads the samples of a store in the order in which they were stored, from a commit number on.

    Used by one thread at a time.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        """Set the folder and the open manifest of the store; nothing is read yet."""
        self._folder = folder
        self._manifest = manifest
        self._points: dict[int, StoredPoint] = {}
        self._former: dict[int, list[tuple[int, str]]] = {}
        self._described = -1
        self._sealed: tuple[str, Any] | None = None

    def read(self, after: int, most: int) -> CommitRange | None:
        """Return the samples and alarm events of the next commits after a number; None if there are no such commits.

        Args:
            after: number of the commit that was read last; 0 to read from the first one.
            most: number of samples to return, roughly. There may be more, because only whole commits are returned, and
                at least one.

        Raises:
            FileNotFoundError: files were replaced or deleted faster than they could be read.
            sqlite3.Error, OSError: a file cannot be read.
            MissingExtra: a file is sealed, and pyarrow is not installed.
        """
        return self._tried(lambda: self._read(after, most))

    def count(self, after: int, last: int) -> int:
        """Return the number of samples in the commits with the numbers ``after + 1`` to ``last``.

        The samples without a value that `read` returns for intervals of devices are not counted. Raises errors like
        `read`.
        """
        return self._tried(lambda: self._count(after, last))

    def last_before(self, moment: int, after: int) -> int:
        """Return the number of the last commit up to which all commits were made before a time.

        A commit whose time may still be corrected, and all after it, do not count; a commit with a time from before the
        clock was set counts only together with a later one. Of a sealed part only the time of its last commit is known,
        so its commits count together or not at all.

        Args:
            moment: the time, nanoseconds since 1970 UTC.
            after: number of a commit; only later commits are looked at. Returned if none of them counts.
        """
        return self._tried(lambda: self._last_before(moment, after))

    def _tried(self, ask: Callable[[], Result]) -> Result:
        """Return the result of ``ask``; call it again, at most `_TRIES` times, if a file was replaced meanwhile."""
        for _ in range(_TRIES):
            try:
                return ask()
            except FileNotFoundError:
                self._sealed = None
        return ask()

    def _count(self, after: int, last: int) -> int:
        found = 0
        for part in self._parts(after):
            if (part.first_commit or 0) > last:
                continue
            if part.kind == "sealed":
                numbers = self._table(part)["commit_number"]
                pc = arrow("compute")
                found += pc.sum(pc.and_(pc.greater(numbers, after), pc.less_equal(numbers, last))).as_py() or 0
                continue
            with closing(open_for_reading(self._folder / SEGMENTS / part.file)) as database:
                asked = "SELECT coalesce(sum(samples), 0) FROM commits WHERE number > ? AND number <= ?"
                found += database.execute(asked, (after, last)).fetchone()[0]
        return found

    def _last_before(self, moment: int, after: int) -> int:
        last, unmended = after, self._manifest.fact("awaits_clock") or EVERY
        for part in self._parts(after):
            if part.kind == "sealed":
                if (part.alive or 0) >= moment:
                    break
                if (part.alive or 0) >= EARLIEST:
                    last = max(last, part.last_commit or 0)
                continue
            with closing(open_for_reading(self._folder / SEGMENTS / part.file)) as database:
                (young,) = database.execute(
                    "SELECT min(number) FROM commits WHERE number > ? AND at >= ?", (after, moment)
                ).fetchone()
                end = min(unmended, EVERY if young is None else young)
                (old,) = database.execute(
                    "SELECT max(number) FROM commits WHERE number < ? AND at >= ?", (end, EARLIEST)
                ).fetchone()
                last = max(last, old or 0)
                if young is not None or unmended <= (part.last_commit or 0):
                    break
        return last

    def _parts(self, after: int) -> list[StorePart]:
        """Return the parts (files) of the store that have commits after a number, in the order to read them."""
        found = []
        for part in self._manifest.parts():
            known = self._facts_of_open(part) if part.kind == "open" else part
            if known.last_commit is not None and known.last_commit > after:
                found.append(known)
        return sorted(found, key=lambda part: (part.segment, part.id))

    def _facts_of_open(self, part: StorePart) -> StorePart:
        """Return the manifest entry of an open segment with its present times, commit numbers and number of rows.

        Raises:
            FileNotFoundError: the segment was sealed meanwhile.
        """
        try:
            return open_part_facts(self._folder, part)
        except FileNotFoundError:
            if part in self._manifest.parts():
                return part  # its file is not made yet
            raise

    def _read(self, after: int, most: int) -> CommitRange | None:
        parts = self._parts(after)
        if not parts:
            found = self._of_intervals_alone(after)
            if found is not None and self._parts(after):
                raise FileNotFoundError("samples were committed and sealed since the parts were listed")
            return found
        segment = [part for part in parts if part.segment == parts[0].segment]
        if segment[0].kind == "sealed":
            last, rows = self._sealed_rows(segment, after, most)
        else:
            self._sealed = None
            last, rows = self._segment_rows(segment[0], after, most)
        more = len(segment) < len(parts) or last < max(part.last_commit or 0 for part in segment)
        intervals = [row for row in self._intervals(segment, after) if after < row.commit_number <= last]
        alarms = [row for row in alarm_rows(self._folder, self._manifest, after) if row.commit_number <= last]
        return CommitRange(last, self._samples(rows, intervals), self._committed_alarms(alarms), more)

    def _committed_alarms(self, rows: list[AlarmRow]) -> list[CommittedAlarm]:
        if not rows:
            return []
        self._look_up_points([], [])
        known = [row for row in rows if row.point in self._points]
        events = zip(known, alarm_events(known, self._manifest), strict=True)
        return [
            CommittedAlarm(row.commit_number, row.place, replace(event, point=self._name_then(row)))
            for row, event in events
        ]

    def _name_then(self, row: AlarmRow) -> str:
        return self._name_at(self._points[row.point], row.commit_number)

    def _of_intervals_alone(self, after: int) -> CommitRange | None:
        """Return the commits after a number that stored intervals and alarms, but no samples; None if there are none.

        When a segment without samples is sealed, it becomes no Parquet file: its intervals and alarms are only in the
        manifest.
        """
        intervals = self._manifest.intervals(after)
        alarms = self._manifest.alarms(after)
        numbers = [row.commit_number for row in intervals] + [row.commit_number for row in alarms]
        if not numbers:
            return None
        return CommitRange(max(numbers), self._samples([], intervals), self._committed_alarms(alarms))

    def _segment_rows(self, part: StorePart, after: int, most: int) -> tuple[int, list[FileRow]]:
        with closing(open_for_reading(self._folder / SEGMENTS / part.file)) as database:
            database.execute("BEGIN")
            last, total, low, high = after, 0, None, None
            for number, first, final, samples in database.execute(
                "SELECT number, low, high, samples FROM commits WHERE number > ? ORDER BY number", (after,)
            ):
                if total and total + samples > most:
                    break
                last, total = number, total + samples
                if first is not None:
                    low = first if low is None else min(low, first)
                    high = final if high is None else max(high, final)
            if low is None:
                return last, []
            rows = database.execute(
                "SELECT time, point, value, reason, half_width, commit_number FROM samples"
                " WHERE time BETWEEN ? AND ? AND commit_number > ? AND commit_number <= ?",
                (low, high, after, last),
            ).fetchall()
            return last, rows

    def _sealed_rows(self, parts: Sequence[StorePart], after: int, most: int) -> tuple[int, list[FileRow]]:
        final = max(part.last_commit or 0 for part in parts)
        first = max(min(part.first_commit or 0 for part in parts), after + 1)
        total = sum(part.rows or 0 for part in parts)
        whole = final + 1 - min(part.first_commit or 0 for part in parts)
        last = min(final, first + max(1, most * whole // max(1, total)) - 1)
        pc = arrow("compute")
        rows: list[FileRow] = []
        for part in parts:
            table = self._table(part)
            numbers = table["commit_number"]
            rows += rows_of_table(table.filter(pc.and_(pc.greater(numbers, after), pc.less_equal(numbers, last))))
        return last, rows

    def _table(self, part: StorePart) -> Any:
        """Return the columns of a sealed part as a table of pyarrow.

        The table is kept in memory until another part is read, because sinks read a part in several pieces.
        """
        if self._sealed is None or self._sealed[0] != part.file:
            path = self._folder / SEGMENTS / part.file
            self._sealed = (part.file, arrow("parquet").read_table(path, columns=_COLUMNS))
        return self._sealed[1]

    def _intervals(self, parts: Sequence[StorePart], after: int) -> Iterable[IntervalRow]:
        """Return the intervals in which devices were not read, of one segment and of the manifest, each once.

        Args:
            parts: the parts of the segment.
            after: number of a commit; of the manifest, only later intervals are returned.
        """
        own = [] if parts[0].kind == "sealed" else part_intervals(self._folder, parts[0])
        # The manifest last: a segment that is sealed meanwhile has moved its intervals there.
        return dict.fromkeys([*own, *self._manifest.intervals(after)])

    def _samples(self, rows: list[FileRow], intervals: list[IntervalRow]) -> list[CommittedSample]:
        self._look_up_points(rows, intervals)
        marks: list[FileRow] = [
            (row.begin, point.id, None, row.reason, 0, row.commit_number)
            for row in intervals
            if row.device is not None and row.end is None
            for point in self._points.values()
            if point.device == row.device
        ]
        samples = []
        for moment, number, value, reason, half_width, commit in sorted([*rows, *marks], key=_order):
            point = self._points[number]
            samples.append(
                CommittedSample(
                    commit,
                    point.device,
                    self._name_at(point, commit),
                    moment,
                    half_width,
                    sample_value(value, reason, point.is_state),
                    reason,
                    point.unit_of_measure,
                )
            )
        return samples

    def _look_up_points(self, rows: list[FileRow], intervals: list[IntervalRow]) -> None:
        described = self._manifest.descriptions
        if described == self._described and not intervals and all(row[1] in self._points for row in rows):
            return
        self._points = {point.id: point for point in self._manifest.points()}
        self._former = {}
        for number, name, last in self._manifest.renames():
            self._former.setdefault(number, []).append((last, name))
        self._described = described

    def _name_at(self, point: StoredPoint, commit: int) -> str:
        for last, name in self._former.get(point.id, ()):
            if commit <= last:
                return name
        return point.point


def _order(row: FileRow) -> tuple[int, int, int]:
    return row[5], row[0], row[1]
