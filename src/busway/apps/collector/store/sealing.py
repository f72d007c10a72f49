"""Sealing: a finished segment becomes Parquet files, sorted by point and time, a tenth of its size or less.

Knows the steps and their order; knows nothing of commits that go on meanwhile.

1. The file is written under another name, its content made durable, renamed, the folder made durable; then one
   transaction of the manifest lists it instead of the segment, and then the segment is unlinked. Ended anywhere between
   these, nothing is lost and nothing counts twice: the manifest alone says what counts.
2. Samples from before the ten minutes of the segment are late. They become parts of their own, one for each ten
   minutes, so that a part covers the time that its neighbours do not; what has the same key is merged when it is read.
3. pyarrow is needed (``busway[store]``). Without it segments stay SQLite files.
"""

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from ....extras import require
from .folder import SEGMENTS, UNFINISHED, size_of, sync_file, sync_folder, unlink_part
from .manifest import Manifest, StoredPoint, StorePart
from .segment import intervals_of, open_for_reading

Step = Callable[[str], None]
"""Told the name of each step when it is done: tests end the process there."""

SLOT: Final = 600 * 1_000_000_000
"""Nanoseconds that a segment lasts, and that a late part covers."""
_NOT_LATE: Final = 60 * 1_000_000_000
"""Nanoseconds before the begin of a segment that its samples may have: a slow transaction, a slow commit."""
_CHUNK: Final = 2_000
"""Rows that are fetched at once: few enough for the cache of a processor, which is a third faster than 50 000."""
_ROW_GROUP: Final = 64 * 1024
"""Rows that are read at least where one point is asked for."""


def can_seal() -> bool:
    """Whether pyarrow is there."""
    return find_spec("pyarrow") is not None


def arrow(module: str = "") -> Any:  # pyarrow has no types of its own
    """pyarrow, or one of its modules. Raises `MissingExtra`."""
    require("pyarrow", "a sealed part of the store")
    return import_module(f"pyarrow{'.' * bool(module)}{module}")


def seal(folder: Path, manifest: Manifest, part: StorePart, step: Step) -> list[StorePart]:
    """Turn a closed segment into sealed parts; the parts."""
    source = folder / SEGMENTS / part.file
    with closing(open_for_reading(source)) as database:
        intervals = intervals_of(database)
        sealed = [
            _write_part(folder, part, name, table, step) for name, table in _tables(database, part, manifest.points())
        ]
    step("seal-folder-synced")
    manifest.replace_part(part, sealed, intervals)
    step("seal-listed")
    remove_unlisted(folder, manifest)
    step("seal-unlinked")
    return sealed


def remove_unlisted(folder: Path, manifest: Manifest) -> None:
    """Unlink files that the manifest has taken off its list."""
    for file in manifest.files_to_unlink():
        unlink_part(folder / SEGMENTS / file)
        manifest.unlinked(file)


def remove_unfinished(folder: Path, manifest: Manifest) -> None:
    """Unlink files that were being written when a process ended: their rows are still in the segment that is listed."""
    parts = manifest.parts()
    listed = {part.file for part in parts}
    segments = {part.file.removesuffix(".sqlite") for part in parts if part.kind != "sealed"}
    for path in (folder / SEGMENTS).iterdir():
        is_left_over = path.suffix == ".parquet" and path.name not in listed and path.name[:8] in segments
        if path.name.endswith(UNFINISHED) or is_left_over:
            path.unlink(missing_ok=True)


def _write_part(folder: Path, part: StorePart, name: str, table: Any, step: Step) -> StorePart:
    target = folder / SEGMENTS / name
    unfinished = target.with_name(name + UNFINISHED)
    arrow("parquet").write_table(
        table,
        unfinished,
        compression="zstd",
        row_group_size=_ROW_GROUP,
        use_dictionary=["device", "name", "text"],
        column_encoding={
            "time": "DELTA_BINARY_PACKED",
            "commit_number": "DELTA_BINARY_PACKED",
            "point": "DELTA_BINARY_PACKED",
        },
    )
    step("seal-written")
    sync_file(unfinished)
    step("seal-synced")
    unfinished.rename(target)
    step("seal-renamed")
    sync_folder(target.parent)
    return _part_of(table, part, name, size_of(target))


def _part_of(table: Any, part: StorePart, name: str, size: int) -> StorePart:
    bounds = arrow("compute").min_max(table["time"].cast("int64")).as_py()
    numbers = arrow("compute").min_max(table["commit_number"]).as_py()
    return StorePart(
        0,
        part.segment,
        name,
        "sealed",
        bounds["min"],
        bounds["max"],
        numbers["min"],
        numbers["max"],
        part.alive,
        table.num_rows,
        size,
    )


def _tables(database: sqlite3.Connection, part: StorePart, points: list[StoredPoint]) -> Iterator[tuple[str, Any]]:
    """The rows of a segment as tables with the names of their files: late ones by their ten minutes, then the rest."""
    begin = first_time_of(database)
    if begin is None:
        return
    stem = part.file.removesuffix(".sqlite")
    slots = database.execute(
        "SELECT DISTINCT time / ? FROM samples WHERE time < ? ORDER BY 1", (SLOT, begin)
    ).fetchall()
    for (slot,) in slots:
        low, high = slot * SLOT, min((slot + 1) * SLOT, begin)
        yield f"{stem}-late-{slot}.parquet", _table(database, low, high, points)
    table = _table(database, begin, None, points)
    if table.num_rows:
        yield f"{stem}.parquet", table


def first_time_of(database: sqlite3.Connection) -> int | None:
    """The time from which on samples of a segment are not late; None if it has none."""
    row = database.execute("SELECT min(at) FROM commits").fetchone()
    if row[0] is None or database.execute("SELECT 1 FROM samples LIMIT 1").fetchone() is None:
        return None
    begin: int = row[0] // SLOT * SLOT - _NOT_LATE
    return begin


def _table(database: sqlite3.Connection, low: int, high: int | None, points: list[StoredPoint]) -> Any:
    """The rows from ``low`` up to ``high`` as a table, sorted by point and time."""
    pa = arrow()
    rows = database.execute(
        "SELECT time, point, value, reason, half_width, commit_number FROM samples WHERE time >= ? AND time < ?",
        (low, 2**63 - 1 if high is None else high),
    )
    chunks: list[list[Any]] = [[] for _ in range(9)]
    while fetched := rows.fetchmany(_CHUNK):
        times, ids, values, reasons, widths, numbers = zip(*fetched, strict=True)
        for chunk, column in zip(
            chunks,
            (
                pa.array(ids, pa.int32()),
                pa.array(times, pa.int64()),
                *value_columns(values),
                pa.array(reasons, pa.int16()),
                pa.array(widths, pa.int64()),
                pa.array(numbers, pa.int64()),
            ),
            strict=True,
        ):
            chunk.append(column)
    columns = [pa.chunked_array(chunk, kind) for chunk, kind in zip(chunks, _types(pa), strict=True)]
    table = pa.table(columns, names=_NAMES).combine_chunks()
    return named(table.sort_by([("point", "ascending"), ("time", "ascending")]), points)


_NAMES: Final = ["point", "time", "real", "integer", "text", "large", "reason", "half_width", "commit_number"]


def _types(pa: Any) -> list[Any]:
    whole = pa.int64()
    return [pa.int32(), whole, pa.float64(), whole, pa.string(), pa.uint64(), pa.int16(), whole, whole]


def value_columns(values: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
    """Values as columns for real numbers, integers, texts, integers beyond 63 bits; null where another holds."""
    pa = arrow()
    kinds = set(map(type, values))
    none = None

    def column(kind: type, wanted: Any) -> Any:
        if kind not in kinds:
            return pa.nulls(len(values), wanted)
        if kinds <= {kind, type(None)}:
            return pa.array(values, wanted)
        return pa.array([value if type(value) is kind else none for value in values], wanted)

    large = pa.nulls(len(values), pa.uint64())
    if bytes in kinds:
        large = pa.array(
            [int.from_bytes(value, "big") if type(value) is bytes else None for value in values], pa.uint64()
        )
    return column(float, pa.float64()), column(int, pa.int64()), column(str, pa.string()), large


def named(table: Any, points: list[StoredPoint]) -> Any:
    """The table with times as such and the names of its points, for those who read the file with another program."""
    pa = arrow()
    pc = arrow("compute")
    devices = dictionary_of(table["point"], {point.id: point.device for point in points}, pa, pc)
    names = dictionary_of(table["point"], {point.id: point.point for point in points}, pa, pc)
    table = table.set_column(1, "time", table["time"].cast(pa.timestamp("ns", "UTC")))
    table = table.append_column("device", devices).append_column("name", names)
    ids = json.dumps({point.id: [point.device, point.point, point.unit_of_measure] for point in points})
    return table.replace_schema_metadata({"busway.points": ids})


def dictionary_of(ids: Any, texts: Mapping[int, str], pa: Any, pc: Any) -> Any:
    """A column of texts, one for each id, as a dictionary."""
    known = pa.array(list(texts), pa.int32())
    indices = pc.index_in(ids.combine_chunks(), value_set=known)
    return pa.DictionaryArray.from_arrays(indices, pa.array(list(texts.values()), pa.string()))
