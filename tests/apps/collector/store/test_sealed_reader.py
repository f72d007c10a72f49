"""Sealed files: DuckDB and pyarrow give the same rows and sums, and a store reads the same with both."""

import os
from collections.abc import Callable, Iterator
from dataclasses import astuple
from pathlib import Path
from random import Random
from typing import Any

import pytest
from collected import NOON, SECOND, at, read_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from busway.apps.collector.samples import PointGroup, Reason, SampleBatch
from busway.apps.collector.store import sealed_reader, store_reader
from busway.apps.collector.store.file_rows import Sums
from busway.apps.collector.store.manifest import StorePart
from busway.apps.collector.store.sealed_reader import sealed_rows, sealed_sums
from busway.apps.collector.store.store_reader import Store, TimePiece, pieces_of, runs_of
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("duckdb", minversion="2.0")

TYPES = {
    "point": pa.int32(),
    "time": pa.int64(),
    "real": pa.float64(),
    "integer": pa.int64(),
    "text": pa.string(),
    "large": pa.uint64(),
    "reason": pa.int16(),
    "half_width": pa.int64(),
    "commit_number": pa.int64(),
}
FILE_SECONDS = 100
"""Time that each file of a property covers; none has samples of another's."""

values = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False, width=32).map(lambda value: ("real", value)),
    st.integers(-(2**63), 2**63 - 1).map(lambda value: ("integer", value)),
    st.integers(2**63, 2**64 - 1).map(lambda value: ("large", value)),
    st.text(max_size=3).filter(lambda text: text.isprintable()).map(lambda value: ("text", value)),
    st.none().map(lambda _: ("real", None)),
)
samples = st.tuples(
    st.integers(0, FILE_SECONDS * SECOND - 1),
    st.integers(1, 4),
    values,
    st.sampled_from([0, Reason.HELD, Reason.TIMEOUT, Reason.LOST]).map(int),
)
files_of_samples = st.lists(st.lists(samples, max_size=12, unique_by=lambda one: one[:2]), min_size=2, max_size=4)
moments = st.integers(-SECOND, 5 * FILE_SECONDS * SECOND)


@pytest.fixture
def with_pyarrow(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], Any]], Any]:
    """A function that calls another one as if DuckDB were not installed."""

    def called(ask: Callable[[], Any]) -> Any:
        with monkeypatch.context() as patch:
            for module in (sealed_reader, store_reader):
                patch.setattr(module, "reads_many", lambda: False)
            return ask()

    assert sealed_reader.reads_many()
    return called


def written(folder: Path, files: list[list[Any]]) -> list[Path]:
    """Sealed files with samples: the names and types of columns are those that `sealed_writer` writes."""
    paths = []
    for place, rows in enumerate(files):
        columns: dict[str, list[Any]] = {name: [] for name in TYPES}
        for number, (time, point, (kind, value), reason) in enumerate(rows):
            for name in ("real", "integer", "text", "large"):
                columns[name].append(value if name == kind else None)
            when = NOON + place * FILE_SECONDS * SECOND + time
            for name, cell in zip(TYPES, (point, when, *[0] * 4, reason, 7, number + 1), strict=True):
                if name not in ("real", "integer", "text", "large"):
                    columns[name].append(cell)
        table = pa.table({name: pa.array(column, TYPES[name]) for name, column in columns.items()})
        table = table.set_column(1, "time", table["time"].cast(pa.timestamp("ns", "UTC")))
        paths.append(folder / f"{place}.parquet")
        pq.write_table(table, paths[-1], compression="zstd")
    return paths


def close_to(sums: dict[tuple[int, int], Sums]) -> dict[tuple[int, int], Any]:
    """Sums whose totals may differ in their last digits: numbers are added in any order."""
    scale = max((abs(each) for one in sums.values() for each in (one.low, one.high) if each is not None), default=0)
    return {
        key: (*astuple(one)[:3], pytest.approx(one.total, rel=1e-12, abs=1e-12 * scale), *astuple(one)[4:])
        for key, one in sums.items()
    }


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    files=files_of_samples,
    edges=st.tuples(moments, moments),
    ids=st.none() | st.lists(st.integers(1, 5), max_size=3),
    bucket=st.sampled_from([1, SECOND // 1000, SECOND, 30 * SECOND, 3600 * SECOND]),
)
def test_rows_and_sums_by_duckdb_are_those_by_pyarrow(
    tmp_path: Path,
    with_pyarrow: Callable[[Callable[[], Any]], Any],
    files: list[list[Any]],
    edges: tuple[int, int],
    ids: list[int] | None,
    bucket: int,
) -> None:
    paths = written(tmp_path, files)
    period = NOON + min(edges), NOON + max(edges) + 1
    rows = sealed_rows(paths, ids, *period)
    assert sorted(rows, key=repr) == sorted(with_pyarrow(lambda: sealed_rows(paths, ids, *period)), key=repr)
    sums = sealed_sums(paths, ids, *period, bucket)
    wanted = with_pyarrow(lambda: sealed_sums(paths, ids, *period, bucket))
    assert {key: astuple(one) for key, one in sums.items()} == close_to(wanted)


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreWriter]:
    """A store of sealed parts, a closed and an open segment, with late samples, replaced ones, and a gap."""
    chance = Random(5)
    group = PointGroup("d", ("a", "b", "c"))
    with StoreWriter(tmp_path_factory.mktemp("store"), StoreOptions(), now=at(0)) as writer:
        for number in range(200):
            when = number * 20 - chance.choice((0, 0, 0, 0, 1500))
            read = read_of(
                group, when, chance.randrange(100) / 4, chance.randrange(9), chance.choice(("x", None, 2**64 - 1))
            )
            reasons = (0, chance.choice((0, Reason.HELD)), Reason.TIMEOUT if read.values[2] is None else 0)
            writer.commit([SampleBatch(group, read.time, 7, read.values, reasons)], [], at(number * 20))
            if number % 60 == 59:
                writer.roll()
                writer.seal_closed()
            if number == 190:
                writer.roll()
        yield writer


@pytest.mark.parametrize("bucket", [None, "100s", "1h"])
@pytest.mark.parametrize(
    ("points", "since", "until"), [("*", None, None), ("d/b", at(333), at(2777)), ("d", at(900), None)]
)
def test_a_store_reads_the_same_with_duckdb_and_without(
    overlapping: StoreWriter,
    with_pyarrow: Callable[[Callable[[], Any]], Any],
    points: str,
    since: int | None,
    until: int | None,
    bucket: str | None,
) -> None:
    kinds = [part.kind for part in overlapping.manifest.parts()]
    assert kinds.count("sealed") > 3
    assert {"open", "closed", "sealed"} == set(kinds)
    store = Store(overlapping.folder)
    arguments = {"since": since, "until": until if bucket is None else until or at(5000)}

    def read() -> Any:
        return store.read(points, **arguments) if bucket is None else store.read(points, **arguments, bucket=bucket)

    found, wanted = read(), with_pyarrow(read)
    assert len(found) > 0
    for name in type(found).__dataclass_fields__:
        one, other = getattr(found, name), getattr(wanted, name)
        assert one == (pytest.approx(other) if name == "mean" else other), name


def test_one_question_is_about_sealed_parts_that_follow_one_another() -> None:
    def part(number: int, low: int, high: int, kind: str = "sealed") -> StorePart:
        return StorePart(number, number, f"{number}", kind, low, high, 1, 1, high, 100, 1)

    parts = [*(part(n, 1000 * n, 1000 * n + 900) for n in range(8)), part(8, 3500, 3600), part(9, 8000, 8900, "open")]
    found = list(runs_of(pieces_of(parts, 0, 10_000, 1000), 250))
    assert [(piece.is_run, [each.id for each in piece.parts]) for piece in found] == [
        (True, [0, 1]),
        (True, [2, 3]),
        (False, [3, 8]),
        (True, [3, 4, 5]),
        (True, [6, 7]),
        (False, [9]),
    ]
    assert found[1] == TimePiece(2000, 3500, (parts[2], parts[3]), is_run=True)


def test_a_file_that_was_dropped_and_one_that_is_damaged_are_two_errors(tmp_path: Path) -> None:
    paths = written(tmp_path, [[(1, 1, ("real", 1.0), 0)], [(1, 1, ("real", 2.0), 0)]])
    paths[1].unlink()
    with pytest.raises(FileNotFoundError):
        sealed_rows(paths, None, 0, 2**63 - 1)
    with pytest.raises(FileNotFoundError):
        sealed_sums(paths, None, 0, 2**63 - 1, SECOND)
    paths[1].write_bytes(b"PAR1, but nothing else of it")
    with pytest.raises(OSError, match="cannot be read") as caught:
        sealed_rows(paths, None, 0, 2**63 - 1)
    assert not isinstance(caught.value, FileNotFoundError)


def test_names_of_folders_are_no_patterns_and_nothing_is_written_beside_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "hall [1] *?"
    folder.mkdir()
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    paths = written(folder, [[(1, 1, ("real", 1.0), 0)], [(1, 1, ("real", 2.0), 0)]])
    assert sorted(row[2] for row in sealed_rows(paths, [1], 0, 2**63 - 1)) == [1.0, 2.0]
    assert os.listdir() == []
