"""`Store`: reads the samples of a store's folder, also while a collector writes it.

Knows how parts overlap; knows no format.

1. The axis of time is cut where parts begin and end. If one part covers a piece, it is asked for rows or sums. If
   several do, their rows are merged by time and point, and the row of the later commit counts.
2. Pieces are small enough for memory: `_PIECE` wanted rows, roughly, or ten times as many if only sums are kept.
3. Sealed parts that follow one another are read together, up to the size of a piece, if that is quicker than one after
   the other (`sealed_reader`).
4. If a part is sealed or dropped while it is read, the parts are looked up again for the time that is still to be read.
5. Points that the store gets while it is read are not in the result.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any, Final, TypeVar, overload

from ....errors import InvalidRequest
from ..alarms.events import AlarmEvent
from ..samples import Gap, StateInterval
from .alarm_events import alarm_events, alarm_rows
from .file_rows import FileRow, Sums, SumsByBucket, add_sums, sums_of_rows
from .folder import SEGMENTS, check_store
from .manifest import IntervalRow, Manifest, StoredPoint, StorePart
from .part_reader import open_part_facts, part_intervals, part_rows, part_sums
from .query_results import BucketTable, SampleTable
from .sealed_reader import FILES_AT_ONCE, reads_many, sealed_rows, sealed_sums
from .segment import sample_value
from .selection import QueryTime, chosen_devices, chosen_points, period, span

MOST_SAMPLES: Final = 10_000_000
"""Most samples that one call of `Store.read` returns: some 2 GB."""
MOST_BUCKETS: Final = 1_000_000
_PIECE: Final = 500_000
_TRIES: Final = 10

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class TimePiece:
    """A piece of a queried period, with the parts (files of the store) that have samples in it.

    Attributes:
        low, high: the piece in nanoseconds since 1970 UTC, ``high`` excluded.
        parts: the parts. If the piece is no run, the times of each part cover the whole piece.
        is_run: whether the piece is a run: its parts are sealed and follow one another in it, so that no two have
            samples of the same time there.
    """

    low: int
    high: int
    parts: tuple[StorePart, ...]
    is_run: bool = False


class Store:
    """The samples of a collector in a folder, opened for reading, also while it is being written.

    >>> frame = busway.Store("data").read("meter-7/*", since="1h")          # doctest: +SKIP
    """

    def __init__(self, folder: str | PathLike[str]) -> None:
        """Check that the folder has a store; nothing is read yet.

        Raises:
            ConfigError: there is no store in the folder.
        """
        self.folder: Path = Path(folder)
        check_store(self.folder)

    def points(self) -> list[StoredPoint]:
        """Return all points of the store, also those that are no longer read, in the order in which they were added.

        Raises:
            ConfigError: the store cannot be read.
        """
        return self._from_manifest(Manifest.points)

    @overload
    def read(
        self, points: str | Sequence[str] = "*", *, since: QueryTime | None = None, until: QueryTime | None = None
    ) -> SampleTable: ...

    @overload
    def read(
        self,
        points: str | Sequence[str] = "*",
        *,
        since: QueryTime | None = None,
        until: QueryTime | None = None,
        bucket: str | float,
    ) -> BucketTable: ...

    def read(
        self,
        points: str | Sequence[str] = "*",
        *,
        since: QueryTime | None = None,
        until: QueryTime | None = None,
        bucket: str | float | None = None,
    ) -> SampleTable | BucketTable:
        """Return samples, or minimum, maximum and mean for each time bucket.

        Args:
            points: one or several patterns ``device/point``, with ``*`` and ``?``; a device alone means all its points.
                Former names of points match too.
            since: from this time on: ``1h`` for an hour ago, ISO 8601, a `datetime`, or nanoseconds since 1970 UTC.
                None for the begin of the store.
            until: up to this time, without it; in the same forms. None for no limit.
            bucket: length of a bucket: text such as ``10s``, or seconds, 0.001 to 366 days; None for samples.

        Returns:
            A `SampleTable`, ordered by time; with ``bucket`` a `BucketTable`.

        Raises:
            InvalidRequest: a pattern names no point, a time or length cannot be understood, ``until`` is not after
                ``since``, or there are more than `MOST_SAMPLES` samples or `MOST_BUCKETS` buckets.
            ConfigError: the store cannot be read.
            MissingExtra: parts are sealed, and pyarrow is not installed.
        """
        if bucket is not None:
            return self._buckets(points, since, until, span(bucket))
        whole = SampleTable()
        for table in self.pieces(points, since=since, until=until):
            _extend(whole, table)
            if len(whole) > MOST_SAMPLES:
                raise InvalidRequest(f"there are more than {MOST_SAMPLES} samples; ask for less time, or for buckets")
        return whole

    def pieces(
        self, points: str | Sequence[str] = "*", *, since: QueryTime | None = None, until: QueryTime | None = None
    ) -> Iterator[SampleTable]:
        """Yield the samples that `read` returns in several tables of limited size, in the order of time.

        The last table, and only that, has the intervals and gaps of the whole period. Arguments and errors are those of
        `read`, but the number of samples has no limit. Errors are raised by the iteration, not by the call.
        """
        low, high = period(since, until, time.time_ns())
        chosen = self._chosen(points)
        by_id = {point.id: point for point in chosen}
        ids = self._ids_of(points, chosen)
        intervals = self._intervals({point.device for point in chosen}, low, high)
        marks = _marks(intervals, chosen, low)
        most = self._rows_in_piece(chosen)
        for piece, found in self._walk((low, high, most), lambda piece: self._merged(piece, ids)):
            rows = found if {row[1] for row in found} <= by_id.keys() else [row for row in found if row[1] in by_id]
            before = [mark for mark in marks if mark[0] < piece.high]
            marks = marks[len(before) :]
            yield _table(sorted(rows + before, key=lambda row: row[:2]), by_id, [])
        yield _table(marks, by_id, intervals)

    def alarms(
        self, points: str | Sequence[str] = "*", *, since: QueryTime | None = None, until: QueryTime | None = None
    ) -> list[AlarmEvent]:
        """Return the alarm events of points, in the order in which they were stored.

        Args:
            points, since, until: as for `read`.

        Raises:
            InvalidRequest: a pattern names no point, a time cannot be understood, or ``until`` is not after ``since``.
            ConfigError: the store cannot be read.
        """
        low, high = period(since, until, time.time_ns())
        names = {(point.device, point.point) for point in self._chosen(points)}
        events = self._from_manifest(lambda manifest: alarm_events(alarm_rows(self.folder, manifest), manifest))
        return [each for each in events if low <= each.at < high and (each.device, each.point) in names]

    def _buckets(
        self, points: str | Sequence[str], since: QueryTime | None, until: QueryTime | None, bucket: int
    ) -> BucketTable:
        now = time.time_ns()
        low, high = period(since, until, now)
        chosen = self._chosen(points)
        by_id = {point.id: point for point in chosen}
        ids = self._ids_of(points, chosen)
        sums: SumsByBucket = {}
        most = 10 * self._rows_in_piece(chosen)
        for _, found in self._walk((low, high, most), lambda piece: self._sums(piece, ids, bucket)):
            add_sums(sums, {key: one for key, one in found.items() if key[1] in by_id})
            if len(sums) > MOST_BUCKETS:
                raise InvalidRequest(f"there are more than {MOST_BUCKETS} buckets; make them longer")
        known = max([now, *((number + 1) * bucket for number, _ in sums)])
        if until is None:
            high = known
        intervals = self._intervals({point.device for point in chosen}, low, high)
        _add_gaps(sums, intervals, chosen, (low, high), known, bucket)
        return _bucket_table(sums, by_id, bucket)

    # Parts

    def _from_manifest(self, ask: Callable[[Manifest], Result]) -> Result:
        with closing(Manifest(self.folder)) as manifest:
            return ask(manifest)

    def _chosen(self, points: str | Sequence[str]) -> list[StoredPoint]:
        devices = chosen_devices(points)
        return self._from_manifest(
            lambda manifest: chosen_points(points, manifest.points(devices), manifest.former_names())
        )

    def _ids_of(self, points: str | Sequence[str], chosen: list[StoredPoint]) -> list[int] | None:
        return None if points in ("*", "*/*") else [point.id for point in chosen]

    def _parts(self) -> list[StorePart]:
        """Return the files of the store that have samples, an open segment with its present times and commits."""
        return self._tried(lambda: [part for part in map(self._facts, self._listed()) if part.low is not None])

    def _listed(self) -> list[StorePart]:
        return self._from_manifest(Manifest.parts)

    def _facts(self, part: StorePart) -> StorePart:
        if part.kind != "open":
            return part
        return self._unless_unmade(part, lambda: open_part_facts(self.folder, part), part)

    def _unless_unmade(self, part: StorePart, ask: Callable[[], Result], otherwise: Result) -> Result:
        """Return the result of ``ask``, which reads a file; ``otherwise`` if the writer has not created the file yet.

        Raises:
            FileNotFoundError: the file was sealed or dropped.
        """
        try:
            return ask()
        except FileNotFoundError:
            if part.kind == "open" and part in self._listed():
                return otherwise
            raise

    def _tried(self, ask: Callable[[], Result]) -> Result:
        """Return the result of ``ask``, which reads files; call it again if one was sealed or dropped meanwhile.

        Raises:
            FileNotFoundError: that happened more than `_TRIES` times.
        """
        for _ in range(_TRIES):
            try:
                return ask()
            except FileNotFoundError:
                continue
        return ask()

    def _rows_in_piece(self, chosen: list[StoredPoint]) -> int:
        """Return how many samples of all points a piece may have, for about `_PIECE` samples of the chosen points."""
        return _PIECE * max(1, self._from_manifest(Manifest.count_points)) // max(1, len(chosen))

    def _walk(
        self, stretch: tuple[int, int, int], ask: Callable[[TimePiece], Result]
    ) -> Iterator[tuple[TimePiece, Result]]:
        """Cut a period into pieces, call ``ask`` with each, and yield each piece with the result.

        If a file is sealed or dropped meanwhile, the rest of the period is cut again.

        Args:
            stretch: begin and end of the period (nanoseconds since 1970 UTC), and the number of samples of a piece.
            ask: reads a piece.
        """
        reached, high, most = stretch
        tries = 0
        while True:
            try:
                for piece in self._pieces(reached, high, most):
                    yield piece, ask(piece)
                    reached, tries = piece.high, 0
                return
            except FileNotFoundError:
                tries += 1
                if tries > _TRIES:
                    raise

    def _pieces(self, low: int, high: int, most: int) -> Iterator[TimePiece]:
        pieces = pieces_of(self._parts(), low, high, most)
        return runs_of(pieces, most) if reads_many() else pieces

    def _files(self, piece: TimePiece) -> list[Path]:
        return [self.folder / SEGMENTS / part.file for part in piece.parts]

    def _merged(self, piece: TimePiece, ids: list[int] | None) -> list[FileRow]:
        if piece.is_run:
            return sealed_rows(self._files(piece), ids, piece.low, piece.high)
        found = [part_rows(self.folder, part, ids, piece.low, piece.high) for part in piece.parts]
        if len(found) == 1:
            return found[0]
        merged: dict[tuple[int, int], FileRow] = {}
        for rows in found:
            for row in rows:
                other = merged.get(row[:2])
                if other is None or other[5] < row[5]:
                    merged[row[:2]] = row
        return list(merged.values())

    def _sums(self, piece: TimePiece, ids: list[int] | None, bucket: int) -> SumsByBucket:
        if piece.is_run:
            return sealed_sums(self._files(piece), ids, piece.low, piece.high, bucket)
        if len(piece.parts) == 1:
            return part_sums(self.folder, piece.parts[0], ids, piece.low, piece.high, bucket)
        return sums_of_rows(self._merged(piece, ids), bucket)

    def _all_intervals(self) -> list[IntervalRow]:
        rows: list[IntervalRow] = []
        for part in self._listed():
            if part.kind != "sealed":
                rows += self._unless_unmade(part, partial(part_intervals, self.folder, part), [])
        return rows + self._from_manifest(Manifest.intervals)  # last: sealing moves them there

    def _intervals(self, devices: set[str], low: int, high: int) -> list[IntervalRow]:
        """Return the intervals of these devices, and the gaps, that overlap a period, each once, ordered by begin."""
        rows = self._tried(self._all_intervals)
        latest = {(row.device, row.begin, row.reason): row for row in sorted(rows, key=lambda row: row.commit_number)}
        return sorted(
            (
                row
                for row in latest.values()
                if row.begin < high
                and (row.end is None or row.end > low)
                and (row.device is None or row.device in devices)
            ),
            key=lambda row: row.begin,
        )


def pieces_of(parts: Sequence[StorePart], low: int, high: int, most: int) -> Iterator[TimePiece]:
    """Yield the pieces of a period, in order; times that no part covers are left out.

    The period is cut where parts begin and end. A piece that is estimated to have more than ``most`` samples is cut
    further.

    Args:
        parts: the parts (files) of the store, with their times and numbers of samples.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.
        most: most samples of a piece, roughly.
    """
    spans = [(max(part.low or 0, low), min((part.high or 0) + 1, high), part) for part in parts if part.low is not None]
    spans = sorted((each for each in spans if each[0] < each[1]), key=lambda span: span[0])
    cuts = sorted({cut for begin, end, _ in spans for cut in (begin, end)})
    covering: list[tuple[int, int, StorePart]] = []
    place = 0
    for begin, end in pairwise(cuts):
        covering = [span for span in covering if span[1] > begin]
        while place < len(spans) and spans[place][0] <= begin:
            covering.append(spans[place])
            place += 1
        if not covering:
            continue
        there = tuple(part for _, _, part in covering)
        rows = sum(_share(part, begin, end) for part in there)
        count = max(1, min(-(-int(rows) // most), end - begin))
        edges = [begin + (end - begin) * number // count for number in range(count + 1)]
        for first, last in pairwise(edges):
            yield TimePiece(first, last, there)


def runs_of(pieces: Iterator[TimePiece], most: int) -> Iterator[TimePiece]:
    """Yield the pieces in their order, with neighbours that have one sealed part each joined to runs.

    A run has at most `FILES_AT_ONCE` of the pieces.

    Args:
        pieces: pieces of a period, in order.
        most: most samples of a run, roughly.
    """
    run: list[TimePiece] = []
    rows = 0.0
    for piece in pieces:
        is_single = len(piece.parts) == 1 and piece.parts[0].kind == "sealed"
        more = _share(piece.parts[0], piece.low, piece.high) if is_single else 0.0
        if run and (not is_single or rows + more > most or len(run) == FILES_AT_ONCE):
            yield _run(run)
            run, rows = [], 0.0
        if is_single:
            run.append(piece)
            rows += more
        else:
            yield piece
    if run:
        yield _run(run)


def _run(pieces: Sequence[TimePiece]) -> TimePiece:
    parts = tuple(dict.fromkeys(part for piece in pieces for part in piece.parts))
    return TimePiece(pieces[0].low, pieces[-1].high, parts, is_run=True)


def _share(part: StorePart, begin: int, end: int) -> float:
    """Return an estimate of how many samples of a part are between the times ``begin`` and ``end``."""
    return (part.rows or 0) * (end - begin) / ((part.high or 0) + 1 - (part.low or 0))


def _marks(intervals: list[IntervalRow], points: list[StoredPoint], low: int) -> list[FileRow]:
    """Return the samples without a value that stand for intervals and gaps in query results.

    There is one for each interval or gap and each point concerned, at the begin of the interval but not before ``low``
    (nanoseconds since 1970 UTC). They are in the order of time.
    """
    found = [
        (max(row.begin, low), point.id, None, row.reason, 0, row.commit_number)
        for row in intervals
        for point in points
        if row.device is None or row.device == point.device
    ]
    return sorted(found, key=lambda row: row[:2])


def _table(rows: Sequence[FileRow], points: dict[int, StoredPoint], intervals: list[IntervalRow]) -> SampleTable:
    table = SampleTable()
    if rows:
        times, ids, values, reasons, widths, _ = (list(column) for column in zip(*rows, strict=True))
        known = [points[number] for number in ids]
        table = SampleTable(
            [point.device for point in known],
            [point.point for point in known],
            times,
            widths,
            [
                sample_value(value, reason, point.is_state)
                for value, reason, point in zip(values, reasons, known, strict=True)
            ],
            reasons,
        )
    for row in intervals:
        if row.device is None:
            table.gaps.append(Gap(row.begin, row.end or row.begin, row.reason, row.lost))
        else:
            table.intervals.append(StateInterval(row.device, row.begin, row.end, row.reason))
    return table


def _extend(whole: SampleTable, other: SampleTable) -> None:
    for name in SampleTable.__dataclass_fields__:
        column: list[Any] = getattr(whole, name)
        column.extend(getattr(other, name))


def _add_gaps(
    sums: SumsByBucket,
    intervals: list[IntervalRow],
    points: list[StoredPoint],
    stretch: tuple[int, int],
    known: int,
    bucket: int,
) -> None:
    """Put the reasons of intervals and gaps into the sums of the buckets that they overlap, if no worse one is there.

    Changes ``sums``; sums without samples are added for buckets that have none. ``stretch`` is begin and end of the
    period. An interval that has not ended yet counts up to the time ``known``: whether it goes on is not known.

    Raises:
        InvalidRequest: there would be more than `MOST_BUCKETS` buckets.
    """
    low, high = stretch
    for row in intervals:
        end = min(known if row.end is None else row.end, high)
        if end <= low:
            continue
        first, last = max(row.begin, low) // bucket, max(end - 1, row.begin, low) // bucket
        concerned = [point for point in points if row.device is None or row.device == point.device]
        if len(sums) + (last - first + 1) * len(concerned) > MOST_BUCKETS:
            raise InvalidRequest(f"there are more than {MOST_BUCKETS} buckets; make them longer")
        for number in range(first, last + 1):
            for point in concerned:
                one = sums.setdefault((number, point.id), Sums(0, None, None, 0, 0, row.reason))
                one.reason = max(one.reason, row.reason)


def _bucket_table(sums: SumsByBucket, points: dict[int, StoredPoint], bucket: int) -> BucketTable:
    order = sorted((number, points[key].device, points[key].point, key) for number, key in sums)
    table = BucketTable()
    for number, device, point, key in order:
        one = sums[number, key]
        table.device.append(device)
        table.point.append(point)
        table.time.append(number * bucket)
        table.minimum.append(one.low)
        table.maximum.append(one.high)
        table.mean.append(one.total / one.count if one.count else None)
        table.count.append(one.count)
        table.samples.append(one.samples)
        table.reason.append(one.reason)
    return table
