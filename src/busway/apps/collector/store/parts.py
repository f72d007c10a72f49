"""Reads samples and sums from one file of a store, whatever its format: SQLite for a segment, Parquet if sealed.

Knows how to ask each format; knows nothing of how parts overlap.

1. A question to a segment takes one short transaction, so that a reader does not hold the log of the writer.
2. `FileNotFoundError` means that the part was sealed or dropped since the manifest was read.
"""

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ..samples import Reason
from .folder import SEGMENTS
from .manifest import IntervalRow, StorePart
from .sealing import arrow
from .segment import facts_of, intervals_of, is_unmade, open_for_reading

Row = tuple[int, int, Any, int, int, int]
"""Time, point, stored value, reason, half width, commit number: as a segment holds them, for loops over millions."""


@dataclass(slots=True)
class Sums:
    """Count, total, minimum, maximum and worst reason of one point in one time bucket; `add` combines two of them.

    Attributes:
        count: numbers that were not bad.
        low, high: the least and the greatest of them.
        total: their sum.
        samples: all samples, bad ones and texts too.
        reason: the worst reason, 0 where all were good.
    """

    count: int
    low: float | int | None
    high: float | int | None
    total: float | int
    samples: int
    reason: int

    def add(self, other: "Sums") -> None:
        """Add the sums (count, total, …) of other samples of the same time bucket."""
        self.count += other.count
        self.total += other.total
        self.samples += other.samples
        self.reason = max(self.reason, other.reason)
        if other.low is not None:
            self.low = other.low if self.low is None else min(self.low, other.low)
        if other.high is not None:
            self.high = other.high if self.high is None else max(self.high, other.high)


SumsByBucket = dict[tuple[int, int], Sums]
"""The sums of samples, by the number of the time bucket (time // its length) and the id of the point."""

_ROWS: Final = "SELECT time, point, value, reason, half_width, commit_number FROM samples WHERE time >= ? AND time < ?"
_CHOSEN: Final = " AND point IN (SELECT value FROM json_each(?))"
_SUMS: Final = f"""
SELECT time / ?, point, count(number), min(number), max(number), total(number), count(*), max(reason) FROM (
    SELECT time, point, reason,
        CASE WHEN reason < {int(Reason.TIMEOUT)} AND typeof(value) IN ('integer', 'real') THEN value END AS number
    FROM samples WHERE time >= ? AND time < ?"""
_COLUMNS: Final = ["time", "point", "real", "integer", "text", "large", "reason", "half_width", "commit_number"]


def open_part_facts(folder: Path, part: StorePart) -> StorePart:
    """Return the manifest entry of an open segment with the times and numbers of its commits so far.

    If nothing was written to the segment yet, ``part`` is returned unchanged.

    Raises:
        FileNotFoundError: the file is not created yet, or the segment was sealed or dropped.
    """
    path = folder / SEGMENTS / part.file
    try:
        with closing(open_for_reading(path)) as database:
            return facts_of(database, part, path.stat().st_size)
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
        return part


def part_intervals(folder: Path, part: StorePart) -> list[IntervalRow]:
    """Return the intervals in which devices were not read, and gaps, that a segment file holds.

    Empty if nothing was written to the segment yet.

    Raises:
        FileNotFoundError: the file is not created yet, or the segment was sealed or dropped.
    """
    try:
        with closing(open_for_reading(folder / SEGMENTS / part.file)) as database:
            return intervals_of(database)
    except sqlite3.OperationalError as error:
        if not is_unmade(error):
            raise
        return []


def part_rows(folder: Path, part: StorePart, ids: Sequence[int] | None, low: int, high: int) -> list[Row]:
    """Return the samples in one file of the store within a period, in no particular order.

    Args:
        folder: the folder of the store.
        part: the file.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.

    Raises:
        FileNotFoundError: the file was sealed or dropped.
    """
    if part.kind == "sealed":
        return rows_of_table(_sealed(folder, part, ids, low, high, _COLUMNS))
    with closing(open_for_reading(folder / SEGMENTS / part.file)) as database:
        if ids is None:
            return database.execute(_ROWS, (low, high)).fetchall()
        return database.execute(_ROWS + _CHOSEN, (low, high, json.dumps(list(ids)))).fetchall()


def part_sums(
    folder: Path, part: StorePart, ids: Sequence[int] | None, low: int, high: int, bucket: int
) -> SumsByBucket:
    """Return count, total, minimum and maximum of the samples in one file of the store, by time bucket and point.

    Args:
        folder: the folder of the store.
        part: the file.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.
        bucket: length of a time bucket in nanoseconds.

    Raises:
        FileNotFoundError: the file was sealed or dropped.
    """
    if part.kind == "sealed":
        return _sealed_sums(
            _sealed(folder, part, ids, low, high, ["time", "point", "real", "integer", "large", "reason"]), bucket
        )
    chosen, values = ("", ()) if ids is None else (_CHOSEN, (json.dumps(list(ids)),))
    with closing(open_for_reading(folder / SEGMENTS / part.file)) as database:
        found = database.execute(f"{_SUMS}{chosen}) GROUP BY 1, 2", (bucket, low, high, *values)).fetchall()
    return {(number, point): Sums(*rest) for number, point, *rest in found}


def _sealed(folder: Path, part: StorePart, ids: Sequence[int] | None, low: int, high: int, columns: list[str]) -> Any:
    """Return columns of a Parquet file of the store as a table of pyarrow, with the wanted points and times alone.

    Row groups of the file that have no wanted point or time are not read.
    """
    pa = arrow()

    def moment(nanoseconds: int) -> Any:
        return pa.scalar(nanoseconds, pa.timestamp("ns", "UTC"))

    wanted = [("time", ">=", moment(low)), ("time", "<", moment(high))]
    if ids is not None:
        wanted.append(("point", "in", list(ids)))
    return arrow("parquet").read_table(folder / SEGMENTS / part.file, columns=columns, filters=wanted)


def rows_of_table(table: Any) -> list[Row]:
    """Return the samples of a table read from a Parquet file as rows, in the form that segment files give."""
    if not table.num_rows:
        return []
    columns = {name: table[name] for name in _COLUMNS if name != "time"}
    values = columns["real"].to_pylist()
    for name in ("integer", "text", "large"):
        if columns[name].null_count < table.num_rows:
            found = columns[name].to_pylist()
            values = [value if value is not None else other for value, other in zip(values, found, strict=True)]
    if columns["large"].null_count < table.num_rows:
        values = [value.to_bytes(8, "big") if type(value) is int and value >= 2**63 else value for value in values]
    times = table["time"].cast("int64").to_pylist()
    rest = [columns[name].to_pylist() for name in ("reason", "half_width", "commit_number")]
    return list(zip(times, columns["point"].to_pylist(), values, *rest, strict=True))


def _sealed_sums(table: Any, bucket: int) -> SumsByBucket:
    pa, pc = arrow(), arrow("compute")
    number = pc.coalesce(
        table["real"], table["integer"].cast("float64", safe=False), table["large"].cast("float64", safe=False)
    )
    number = pc.if_else(
        pc.less(table["reason"], pa.scalar(int(Reason.TIMEOUT), pa.int16())), number, pa.scalar(None, pa.float64())
    )
    keyed = pa.table(
        {
            "bucket": pc.divide(table["time"].cast("int64"), bucket),
            "point": table["point"],
            "number": number,
            "reason": table["reason"],
        }
    )
    wanted = [
        ("number", "count"),
        ("number", "min"),
        ("number", "max"),
        ("number", "sum"),
        ("reason", "count"),
        ("reason", "max"),
    ]
    found = keyed.group_by(["bucket", "point"]).aggregate(wanted)
    names = ["bucket", "point", "number_count", "number_min", "number_max", "number_sum", "reason_count", "reason_max"]
    rows = zip(*(found[name].to_pylist() for name in names), strict=True)
    return {
        (number, point): Sums(count, low, high, total or 0, samples, reason)
        for number, point, count, low, high, total, samples, reason in rows
    }


def sums_of_rows(rows: Sequence[Row], bucket: int) -> SumsByBucket:
    """Return count, total, minimum and maximum of samples by time bucket and point.

    It is for samples that were merged from several files; `part_sums` reads the sums of one file.

    Args:
        rows: the samples.
        bucket: length of a time bucket in nanoseconds.
    """
    found: SumsByBucket = {}
    for time, point, value, reason, _, _ in rows:
        usable = reason < Reason.TIMEOUT and type(value) in (int, float)
        one = Sums(1, value, value, value, 1, reason) if usable else Sums(0, None, None, 0, 1, reason)
        key = (time // bucket, point)
        if key in found:
            found[key].add(one)
        else:
            found[key] = one
    return found
