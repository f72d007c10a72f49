"""``busway query``: prints samples from a store of the collector.

1. Samples are printed while they are read, so any length of time can be asked for. With buckets all are read first.
2. A time without reads is a line without a value that gives the reason; in buckets it is a bucket with 0 samples.
3. Times are UTC. A table shows milliseconds. CSV and JSON have nanoseconds, and as ``half_width`` half of the seconds
   that the transaction took.
4. The first line of a table and of CSV has the names of the columns.
"""

import contextlib
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
from ..safe_files import past_links
from ..values.counts import counted
from .arguments import CSV, JSON, QUIET
from .exits import ExitCode
from .output import float32_digits, json_value, print_aligned, print_csv, print_json, say, shown_value

if TYPE_CHECKING:
    from ..apps.collector.alarms.events import AlarmEvent
    from ..apps.collector.store.query_results import BucketTable, SampleTable
    from ..apps.collector.store.store_reader import Store

EXAMPLES = """\b
Examples:
  busway query data --list
  busway query data "meter-7/*" --since 1h
  busway query data --points "*/power" --since 2026-11-22 --until 2026-11-23 --bucket 5m --csv
  busway query data --since 1d --parquet yesterday.parquet
  busway query data --alarms --since 1d

Times are 1h (an hour ago) or ISO 8601, UTC where no offset is given.
"""


def query(
    store: str = typer.Argument(..., metavar="STORE", help="The folder of the store."),
    patterns: list[str] | None = typer.Argument(None, metavar="POINT...", help="Which points: meter-7/*, meter-7."),
    points: list[str] | None = typer.Option(
        None, "--points", metavar="POINT", help="Which points, as the arguments; several times if need be."
    ),
    since: str | None = typer.Option(None, "--since", metavar="TIME", help="From this time on: 1h, 2026-11-22T14:00."),
    until: str | None = typer.Option(None, "--until", metavar="TIME", help="Up to this time, without it."),
    bucket: str | None = typer.Option(
        None, "--bucket", metavar="TIME", help="Minimum, maximum and mean for each: 10s, 5m, 1h."
    ),
    parquet: str | None = typer.Option(
        None, "--parquet", metavar="FILE", help="Write a new Parquet file instead; half_width in ns, elsewhere in s."
    ),
    alarms: bool = typer.Option(False, "--alarms", help="Show the journal of alarms instead."),
    names: bool = typer.Option(False, "--list", help="List the points of the store."),
    as_json: bool = JSON,
    as_csv: bool = CSV,
    quiet: bool = QUIET,
) -> int:
    """Show what a store of the collector holds."""
    from ..apps.collector.store.store_reader import Store

    given = [name for name, on in (("--json", as_json), ("--csv", as_csv), ("--parquet", parquet is not None)) if on]
    if len(given) > 1:
        raise ConfigError("one of --json, --csv and --parquet is possible", key=given[-1])
    asked = Store(store)
    wanted = [*(patterns or ()), *(points or ())] or ["*"]
    if names:
        _list_points(asked, as_json=as_json, as_csv=as_csv)
        return ExitCode.DONE
    if alarms:
        if bucket is not None or parquet is not None:
            raise ConfigError("goes not with --bucket and --parquet", key="--alarms")
        events = asked.alarms(wanted if wanted != ["*"] else "*", since=since, until=until)
        _print(_alarm_rows(events), as_json=as_json, as_csv=as_csv)
        return ExitCode.DONE
    single = frozenset(point.name for point in asked.points() if point.is_float32)
    if bucket is not None:
        table = asked.read(wanted, since=since, until=until, bucket=bucket)
        if parquet is not None:
            return _write_parquet(parquet, [table])
        _print(_bucket_rows(table, single), as_json=as_json, as_csv=as_csv)
        return ExitCode.DONE
    pieces = asked.pieces(wanted if wanted != ["*"] else "*", since=since, until=until)
    if parquet is not None:
        return _write_parquet(parquet, pieces)
    _print((row for piece in pieces for row in _sample_rows(piece, single)), as_json=as_json, as_csv=as_csv)
    return ExitCode.DONE


def _list_points(store: "Store", *, as_json: bool, as_csv: bool) -> None:
    rows = [{"point": point.name, "unit_of_measure": point.unit_of_measure} for point in store.points()]
    _print(rows, as_json=as_json, as_csv=as_csv)


def _sample_rows(table: "SampleTable", single: frozenset[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each sample: column names and values.

    ``single`` has the names (``device/point``) of points of type float32; their values get the digits of 32 bits.
    """
    from ..apps.collector.samples import reason_text

    for sample in table:
        name = f"{sample.device}/{sample.point}"
        yield {
            "time": sample.time,
            "point": name,
            "value": float32_digits(sample.value) if name in single else sample.value,
            "quality": sample.quality.name.lower(),
            "reason": reason_text(sample.reason),
            "half_width": sample.half_width / 1e9,
        }


def _alarm_rows(events: "Iterable[AlarmEvent]") -> Iterator[dict[str, Any]]:
    for event in events:
        yield {
            "time": event.at,
            "point": f"{event.device}/{event.point}",
            "limit": event.limit,
            "event": event.kind.value,
            "value": event.value,
            "text": event.text,
            "by": event.by,
        }


def _bucket_rows(table: "BucketTable", single: frozenset[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each bucket: column names and values.

    ``single`` has the names (``device/point``) of points of type float32; their minimum and maximum get the digits of
    32 bits.
    """
    columns = table.columns()
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        row["point"] = f"{row.pop('device')}/{row['point']}"
        if row["point"] in single:
            row |= {name: float32_digits(row[name]) for name in ("minimum", "maximum")}
        yield row


_CHUNK = 1000
"""Number of rows that are printed together; only their columns are aligned with each other."""


def _print(rows: Iterable[dict[str, Any]], *, as_json: bool, as_csv: bool) -> None:
    chunk: list[dict[str, Any]] = []
    header, is_empty = True, True
    for row in rows:
        is_empty = False
        if as_json:
            print_json({name: _iso(value) if name == "time" else json_value(value) for name, value in row.items()})
            continue
        chunk.append(row)
        if len(chunk) == _CHUNK:
            _print_chunk(chunk, as_csv=as_csv, header=header)
            chunk, header = [], False
    if chunk:
        _print_chunk(chunk, as_csv=as_csv, header=header)
    if is_empty:
        say("the store has nothing that fits")


def _print_chunk(rows: list[dict[str, Any]], *, as_csv: bool, header: bool) -> None:
    if as_csv:
        lines = [[_cell(name, value, whole=True) for name, value in row.items()] for row in rows]
        print_csv(list(rows[0]) if header else [], lines)
        return
    names = [name for name in rows[0] if name != "half_width"]
    lines = [[_cell(name, row[name], whole=False) for name in names] for row in rows]
    print_aligned([[name.replace("_", " ") for name in names], *lines] if header else lines)


def _cell(name: str, value: Any, *, whole: bool) -> str:
    if name == "time":
        return _iso(value) if whole else f"{_iso(value)[:23]}Z"
    if value is None:
        return "" if whole else "–"
    if not whole and isinstance(value, float):
        return f"{value:.10g}"
    return shown_value(value)


def _iso(nanoseconds: int) -> str:
    """Return a time, given in nanoseconds since 1970 UTC, as ISO 8601 text in UTC with nanoseconds."""
    whole, rest = divmod(nanoseconds, 1_000_000_000)
    return f"{datetime.fromtimestamp(whole, UTC):%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"


def _write_parquet(name: str, tables: "Iterable[SampleTable | BucketTable]") -> int:
    """Write tables of samples or buckets to a new Parquet file, print the number of rows, and return the exit code.

    If writing fails or is interrupted, the unfinished file is removed. A file that existed before is not touched.

    Raises:
        ConfigError: the file exists, or cannot be written.
    """
    from ..apps.collector.store.sealing import arrow

    path = Path(past_links(name))
    if path.exists():
        raise _there_already(name)
    writer, file, rows = None, None, 0
    try:
        for table in tables:
            if not len(table) and writer is not None:
                continue
            content = _plain(table.to_arrow())
            if writer is None:
                file = path.open("xb")  # not one that came in the meantime
                writer = arrow("parquet").ParquetWriter(file, content.schema, compression="zstd")
            writer.write_table(content.cast(writer.schema))
            rows += content.num_rows
        if writer is not None and file is not None:
            writer.close()
            file.close()
    except BaseException as error:
        with contextlib.suppress(OSError):
            if writer is not None:
                writer.close()
        if file is not None:
            with contextlib.suppress(OSError):
                file.close()
            path.unlink(missing_ok=True)  # a part of it would be in the way of the next attempt
        if isinstance(error, FileExistsError):
            raise _there_already(name) from error
        if isinstance(error, OSError):
            raise ConfigError(f"cannot be written: {error.strerror or error}", file=name) from error
        raise
    say(f"{name} has {counted(rows, 'row')}")
    return ExitCode.DONE


def _there_already(name: str) -> ConfigError:
    return ConfigError("exists already, and nothing was written; name a new file", file=name)


def _plain(table: Any) -> Any:
    """Return an Arrow table with its columns ``value``, ``minimum`` and ``maximum`` converted to float64.

    So all tables that are written to one Parquet file have equal column types.
    """
    for name in ("value", "minimum", "maximum"):
        if name in table.column_names:
            index = table.column_names.index(name)
            table = table.set_column(index, name, table[name].cast("float64", safe=False))
    return table
