"""Reads samples and sums from one file of a store, whatever its format: SQLite for a segment, Parquet if sealed.

Knows how a segment is read; `sealed_reader` reads Parquet. Knows nothing of how parts overlap.

1. A segment is read in one short transaction, so that a reader does not keep the write-ahead log of the writer from
   shrinking.
2. `FileNotFoundError` means that the part was sealed or dropped since the manifest was read.
"""

import json
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

from ..samples import Reason
from .file_rows import FileRow, Sums, SumsByBucket, number_of
from .folder import SEGMENTS
from .manifest import IntervalRow, StorePart
from .sealed_reader import sealed_rows, sealed_sums
from .segment import facts_of, intervals_of, is_unmade, open_for_reading

_ROWS: Final = "SELECT time, point, value, reason, half_width, commit_number FROM samples WHERE time >= ? AND time < ?"
_CHOSEN: Final = " AND point IN (SELECT value FROM json_each(?))"
_SUMS: Final = f"""
SELECT time / ?, point, count(number), min(number), max(number), coalesce(total(number), 'nan'), count(*), max(reason)
FROM (
    SELECT time, point, reason,
        CASE WHEN reason < {int(Reason.TIMEOUT)} THEN CASE typeof(value)
            WHEN 'integer' THEN CAST(value AS REAL) WHEN 'real' THEN value WHEN 'blob' THEN number_of(value)
        END END AS number
    FROM samples WHERE time >= ? AND time < ?"""


def open_part_facts(folder: Path, part: StorePart) -> StorePart:
    """Return the manifest entry of an open segment with its present times, commit numbers, rows and size filled in.

    If the file has no tables yet, ``part`` is returned unchanged.

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


def part_rows(folder: Path, part: StorePart, ids: Sequence[int] | None, low: int, high: int) -> list[FileRow]:
    """Return the samples in one file of the store within a period, in no particular order.

    Args:
        folder: the folder of the store.
        part: the file.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.

    Raises:
        FileNotFoundError: the file was sealed or dropped.
        MissingExtra: the file is sealed, and pyarrow is not installed.
    """
    if part.kind == "sealed":
        return sealed_rows([folder / SEGMENTS / part.file], ids, low, high)
    with closing(open_for_reading(folder / SEGMENTS / part.file)) as database:
        if ids is None:
            return database.execute(_ROWS, (low, high)).fetchall()
        return database.execute(_ROWS + _CHOSEN, (low, high, json.dumps(list(ids)))).fetchall()


def part_sums(
    folder: Path, part: StorePart, ids: Sequence[int] | None, low: int, high: int, bucket: int
) -> SumsByBucket:
    """Return count, total, minimum, maximum and worst reason of the samples in one file of the store.

    They are by time bucket and point (`Sums`).

    Args:
        folder: the folder of the store.
        part: the file.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.
        bucket: length of a time bucket in nanoseconds.

    Raises:
        FileNotFoundError: the file was sealed or dropped.
        MissingExtra: the file is sealed, and pyarrow is not installed.
    """
    if part.kind == "sealed":
        return sealed_sums([folder / SEGMENTS / part.file], ids, low, high, bucket)
    chosen, values = ("", ()) if ids is None else (_CHOSEN, (json.dumps(list(ids)),))
    with closing(open_for_reading(folder / SEGMENTS / part.file)) as database:
        database.create_function("number_of", 1, number_of, deterministic=True)
        found = database.execute(f"{_SUMS}{chosen}) GROUP BY 1, 2", (bucket, low, high, *values)).fetchall()
    return {
        (number, point): Sums(count, least, most, float(total), samples, reason)
        for number, point, count, least, most, total, samples, reason in found
    }
