"""Writes sealed files: the samples of a segment as Parquet. Runs as a program of its own for one segment.

    python -m busway.apps.collector.store.sealed_writer   < a request in JSON   > what was written, in JSON

Knows rows and columns; knows nothing of the manifest.

1. Samples from more than a minute before the ten minutes of the segment are late. They become parts of their own, one
   for each ten minutes, so that no part covers a long time. If several parts have a sample of the same point and time,
   a reader takes that of the latest commit.
2. The driver of Arrow for SQLite fetches rows as columns, in half the time that rows take as objects of Python. It
   takes the type of a column from its first row: so the query puts an artificial row before the others, which is
   removed afterwards.
3. Only the needed packages of Arrow are loaded, and not pandas and numpy, which pyarrow would load if they are
   installed. So a start takes a third of the time.
4. SQLite gives rows in the order of their key, by time. Then a stable sort by point alone is enough, which takes a
   third of the time of a sort by both. The order is checked, not assumed.
5. The content of each file is durable when the program ends, under an unfinished name. The process that started the
   program renames it and lists it in the manifest.
"""

import json
import os
import sqlite3
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any, Final

from .folder import UNFINISHED, size_of, sync_file
from .sealing import arrow
from .segment import SLOT, open_for_reading

_NOT_LATE: Final = 60 * 1_000_000_000
"""Nanoseconds that a sample may be older than its segment without being late, because a read or commit was slow."""
_CHUNK: Final = 65_536
"""Rows that are fetched at once."""
_ROW_GROUP: Final = 64 * 1024
"""Rows of a row group in a Parquet file: at least so many are read, even for one sample."""
_NICENESS: Final = 5
"""How much the sealing process raises its nice value, so that it has a lower priority than polling."""
_KINDS: Final = {
    "real": ("real", "0.5"),
    "integer": ("integer", "0"),
    "text": ("text", "'-'"),
    "large": ("blob", "x'00'"),
}
"""Columns of values: for each, the name of its type in SQLite, and a value of this type as SQL."""
_NAMES: Final = ["point", "time", *_KINDS, "reason", "half_width", "commit_number"]

PointTexts = Sequence[tuple[int, str, str, str | None]]
"""Points, each as a tuple of id, name of the device, name of the point and unit of measure."""


def write_parts(segment: Path, points: PointTexts, parent: int) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Write the samples of a closed segment as Parquet files, under unfinished names, and yield each file.

    If the process ``parent`` has ended, no more files are written, because they would not be listed.

    Args:
        segment: the segment file.
        points: the points of the store; their names are written into the files too.
        parent: number of the process that started this one.

    Yields:
        The path of the written file, and its entry for the manifest: final name, bytes, times, commit numbers, rows.
    """
    with closing(open_for_reading(segment)) as database:
        ranges = list(_ranges(database, segment.stem))
        kinds = {kind for (kind,) in database.execute("SELECT DISTINCT typeof(value) FROM samples")}
    for name, low, high in ranges:
        table = _named(_table(segment, kinds, low, high), points)
        target = segment.with_name(f"{name}.{os.getpid()}{UNFINISHED}")
        with ExitStack() as unless_wanted:
            unless_wanted.callback(target.unlink, missing_ok=True)
            _write(table, target)
            if os.getppid() != parent:
                return
            unless_wanted.pop_all()
        yield target, {"file": name, "bytes": size_of(target), **_facts(table)}


def _write(table: Any, target: Path) -> None:
    """Write a table with its metadata; not in the schema of Arrow, which each reader of the file would decode."""
    with arrow("parquet").ParquetWriter(
        target,
        table.schema,
        compression="zstd",
        use_dictionary=["device", "name", "text"],
        column_encoding={
            "time": "DELTA_BINARY_PACKED",
            "commit_number": "DELTA_BINARY_PACKED",
            "point": "DELTA_BINARY_PACKED",
        },
        store_schema=False,
    ) as writer:
        writer.write_table(table, row_group_size=_ROW_GROUP)
        writer.add_key_value_metadata(table.schema.metadata)
    sync_file(target)


def _facts(table: Any) -> dict[str, int]:
    bounds = arrow("compute").min_max(table["time"].cast("int64")).as_py()
    numbers = arrow("compute").min_max(table["commit_number"]).as_py()
    return {
        "low": bounds["min"],
        "high": bounds["max"],
        "first_commit": numbers["min"],
        "last_commit": numbers["max"],
        "rows": table.num_rows,
    }


def _ranges(database: sqlite3.Connection, stem: str) -> Iterator[tuple[str, int, int]]:
    """Yield the Parquet files to write for a segment: one for each ten minutes of late samples, then one for the rest.

    Each file is given as its name and its period in nanoseconds since 1970 UTC: begin, and end, which is excluded.
    """
    begin = first_time_of(database)
    if begin is None:
        return
    late = "SELECT DISTINCT time / ? FROM samples WHERE time < ? ORDER BY 1"
    for (slot,) in database.execute(late, (SLOT, begin)).fetchall():
        yield f"{stem}-late-{slot}.parquet", slot * SLOT, min((slot + 1) * SLOT, begin)
    if database.execute("SELECT 1 FROM samples WHERE time >= ? LIMIT 1", (begin,)).fetchone() is not None:
        yield f"{stem}.parquet", begin, 2**63 - 1


def first_time_of(database: sqlite3.Connection) -> int | None:
    """Return the time before which samples of a segment count as late, in nanoseconds since 1970 UTC.

    None for a segment without samples or without commits.
    """
    row = database.execute("SELECT min(at) FROM commits").fetchone()
    if row[0] is None or database.execute("SELECT 1 FROM samples LIMIT 1").fetchone() is None:
        return None
    begin: int = row[0] // SLOT * SLOT - _NOT_LATE
    return begin


def _table(segment: Path, kinds: set[str], low: int, high: int) -> Any:
    """Return the samples of a segment from time ``low`` up to ``high``, as a table of pyarrow sorted by point and time.

    Args:
        segment: the segment file.
        kinds: the SQLite types of the values in the segment, such as ``real``.
        low, high: nanoseconds since 1970 UTC, ``high`` excluded.
    """
    pa = arrow()
    import adbc_driver_sqlite  # with its own SQLite: not beside an open connection of Python's
    from adbc_driver_manager import AdbcConnection, AdbcStatement

    with (
        adbc_driver_sqlite.connect(os.fspath(segment)) as database,
        AdbcConnection(database) as connection,
        AdbcStatement(connection) as statement,
    ):
        statement.set_options(**{"adbc.sqlite.query.batch_rows": str(_CHUNK)})
        statement.set_sql_query(_query(kinds, low, high))
        stream, _ = statement.execute_query()
        rows = pa.RecordBatchReader.from_stream(stream).read_all().slice(1)
    columns = {name: rows[name].combine_chunks() for name in rows.column_names}
    if "large" in columns:
        whole = [None if one is None else int.from_bytes(one, "big") for one in columns["large"].to_pylist()]
        columns["large"] = pa.array(whole, pa.uint64())
    types = [pa.int32(), pa.int64(), pa.float64(), pa.int64(), pa.string(), pa.uint64(), pa.int16(), pa.int64()]
    schema = dict(zip(_NAMES, [*types, pa.int64()], strict=True))
    columns = {name: column.cast(schema[name]) for name, column in columns.items()}
    order = _order(columns["point"], columns["time"])
    return pa.table(
        {
            name: columns[name].take(order) if name in columns else pa.nulls(rows.num_rows, kind)
            for name, kind in schema.items()
        }
    )


def _order(points: Any, times: Any) -> Any:
    """Return the positions of rows in the order of point and time; fastest for rows in the order of time (rule 4)."""
    compute = arrow("compute")
    if compute.all(compute.greater_equal(times[1:], times[:-1])).as_py() is not False:
        return compute.sort_indices(points)
    keys = arrow().table({"point": points, "time": times})
    return compute.sort_indices(keys, [("point", "ascending"), ("time", "ascending")])


def _query(kinds: set[str], low: int, high: int) -> str:
    """Return the SQL query for the samples of a period, with one column for each type of value in ``kinds``.

    The first row of its result is no sample: it gives the driver the types of the columns (rule 2).
    """
    samples, values = "", ""
    for name, (kind, sample) in _KINDS.items():
        if kind in kinds:
            samples += f"{sample} AS {name}, "
            values += "value, " if kinds <= {kind, "null"} else f"CASE typeof(value) WHEN '{kind}' THEN value END, "
    return (
        f"SELECT 0 AS point, 0 AS time, {samples}0 AS reason, 0 AS half_width, 0 AS commit_number "
        f"UNION ALL SELECT point, time, {values}reason, half_width, commit_number FROM samples "
        f"WHERE time >= {low:d} AND time < {high:d}"
    )


def _named(table: Any, points: PointTexts) -> Any:
    """Return the table with added columns ``device`` and ``name`` of the points, and with times as timestamps.

    They are for people who open the Parquet file with other programs. Its metadata have the points of its samples as
    JSON, with their units of measure.
    """
    pa = arrow()
    held = set(arrow("compute").unique(table["point"]).to_pylist())
    points = [point for point in points if point[0] in held]
    known = pa.array([id for id, *_ in points], pa.int32())
    indices = arrow("compute").index_in(table["point"].combine_chunks(), value_set=known)
    table = table.set_column(1, "time", table["time"].cast(pa.timestamp("ns", "UTC")))
    for column, texts in (("device", [point[1] for point in points]), ("name", [point[2] for point in points])):
        table = table.append_column(column, pa.DictionaryArray.from_arrays(indices, pa.array(texts, pa.string())))
    return table.replace_schema_metadata({"busway.points": json.dumps({point[0]: point[1:] for point in points})})


class _NotNeeded(MetaPathFinder):
    """Import hook that hides numpy and pandas, which pyarrow would load if they are installed (rule 3)."""

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        """Raise `ModuleNotFoundError` for numpy and pandas; return None, so that Python imports all other modules."""
        if fullname in ("numpy", "pandas"):
            raise ModuleNotFoundError(f"{fullname} is not needed here", name=fullname)


def main() -> None:
    """Write the Parquet files of one segment.

    Standard input is JSON: path of the segment, points, and number of the process that started this one. Standard
    output is a JSON list: for each file its path, and its entry for the manifest.
    """
    asked = json.load(sys.stdin)
    sys.meta_path.insert(0, _NotNeeded())
    os.nice(_NICENESS)
    written = write_parts(Path(asked["segment"]), asked["points"], asked["parent"])
    json.dump([(os.fspath(target), facts) for target, facts in written], sys.stdout)


if __name__ == "__main__":
    main()
