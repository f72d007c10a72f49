"""Reads samples and sums from sealed files (Parquet): many at once with DuckDB if it is installed, else with pyarrow.

Knows the columns of sealed files; knows nothing of the manifest, nor which files overlap.

1. DuckDB and pyarrow give the same rows and the same sums; a test compares them.
2. DuckDB reads many files in one query, which takes a third of the time for long periods. One file is read with
   pyarrow, which is quicker for that. DuckDB works in memory alone: it loads no extension and writes no files.
3. The first version of DuckDB that keeps nanoseconds is 2.0; an older one is not used.
4. `FileNotFoundError` means that a file was dropped since the manifest was read.
"""

from collections.abc import Sequence
from functools import cache
from glob import escape
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from ..samples import Reason
from .file_rows import FileRow, Sums, SumsByBucket, add_sums
from .sealing import arrow

FILES_AT_ONCE: Final = 256
"""Most sealed files that are read together (`busway.apps.collector.store.store_reader.runs_of`)."""
_COLUMNS: Final = ["time", "point", "real", "integer", "text", "large", "reason", "half_width", "commit_number"]
_SUMMED: Final = ["time", "point", "real", "integer", "large", "reason"]
_ROWS: Final = f"SELECT {', '.join(_COLUMNS)} FROM read_parquet($files) WHERE "
_SUMS: Final = f"""
SELECT epoch_ns(time) // $bucket, point, count(number), min(number), max(number), coalesce(sum(number), 0),
    count(*), max(reason)
FROM (
    SELECT time, point, reason,
        CASE WHEN reason < {int(Reason.TIMEOUT)} THEN coalesce(real, integer::DOUBLE, large::DOUBLE) END AS number
    FROM read_parquet($files) WHERE {{}}
) GROUP BY 1, 2
"""
_WITHIN: Final = "epoch_ns(time) >= $low AND epoch_ns(time) < $high"
_SETTINGS: Final = {
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "temp_directory": "",
}


@cache
def reads_many() -> bool:
    """Whether many sealed files can be read in one query: DuckDB is installed, and new enough (rule 3)."""
    if find_spec("duckdb") is None:
        return False
    try:
        return int(version("duckdb").partition(".")[0]) >= 2
    except (PackageNotFoundError, ValueError):
        return False


def sealed_rows(files: Sequence[Path], ids: Sequence[int] | None, low: int, high: int) -> list[FileRow]:
    """Return the samples in sealed files within a period, in no particular order.

    Args:
        files: the Parquet files.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.

    Raises:
        FileNotFoundError: a file was dropped.
        OSError: a file cannot be read.
        MissingExtra: pyarrow is not installed.
    """
    arrow()
    if len(files) > 1 and reads_many():
        return rows_of_table(_asked(_ROWS + _where(ids), "to_arrow_table", files, low, high))
    return [row for file in files for row in rows_of_table(_table(file, ids, low, high, _COLUMNS))]


def sealed_sums(files: Sequence[Path], ids: Sequence[int] | None, low: int, high: int, bucket: int) -> SumsByBucket:
    """Return count, total, minimum, maximum and worst reason of the samples in sealed files, by time bucket and point.

    Args:
        files: the Parquet files; no two may have samples of the same point and time.
        ids: ids of the wanted points; None for all points.
        low, high: the period in nanoseconds since 1970 UTC, ``high`` excluded.
        bucket: length of a time bucket in nanoseconds.

    Raises:
        FileNotFoundError: a file was dropped.
        OSError: a file cannot be read.
        MissingExtra: pyarrow is not installed.
    """
    arrow()
    if len(files) > 1 and reads_many():
        found = _asked(_SUMS.format(_where(ids)), "fetchall", files, low, high, bucket=bucket)
        return {(number, point): Sums(*rest) for number, point, *rest in found}
    sums: SumsByBucket = {}
    for file in files:
        add_sums(sums, _sums_of_table(_table(file, ids, low, high, _SUMMED), bucket))
    return sums


# DuckDB


def _where(ids: Sequence[int] | None) -> str:
    return _WITHIN if ids is None else f"{_WITHIN} AND point IN ({', '.join(map(str, ids)) or 'NULL'})"


def _asked(question: str, form: str, files: Sequence[Path], low: int, high: int, **more: int) -> Any:
    """Run a query of DuckDB over Parquet files, and return its result.

    Args:
        question: the SQL query.
        form: name of the method of DuckDB's relation that returns the result in the wanted form, such as ``fetchall``.
        files: the Parquet files; parameter ``$files`` of the query.
        low, high: the period in nanoseconds since 1970 UTC; parameters ``$low`` and ``$high`` of the query.
        more: further parameters of the query.

    Raises:
        FileNotFoundError: a file was dropped.
        OSError: a file cannot be read.
    """
    duckdb = import_module("duckdb")
    names = [escape(str(file)) for file in files]  # DuckDB takes names for patterns
    try:
        with duckdb.connect(config=_SETTINGS) as database:
            relation = database.sql(question, params={"files": names, "low": low, "high": high, **more})
            return getattr(relation, form)()
    except duckdb.Error as error:
        for file in files:
            file.stat()
        raise OSError(f"{files[0].name} or a file that follows it cannot be read: {error}") from error


# pyarrow


def _table(file: Path, ids: Sequence[int] | None, low: int, high: int, columns: list[str]) -> Any:
    """Return columns of a sealed file as a table of pyarrow, with only the wanted points and times.

    Row groups of the file that have no wanted point or time are not read.
    """
    pa = arrow()

    def moment(nanoseconds: int) -> Any:
        return pa.scalar(nanoseconds, pa.timestamp("ns", "UTC"))

    wanted = [("time", ">=", moment(low)), ("time", "<", moment(high))]
    if ids is not None:
        wanted.append(("point", "in", list(ids)))
    return arrow("parquet").read_table(file, columns=columns, filters=wanted)


def rows_of_table(table: Any) -> list[FileRow]:
    """Convert a table read from a Parquet file to rows in the form in which a segment file has them (`FileRow`)."""
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


def _sums_of_table(table: Any, bucket: int) -> SumsByBucket:
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
