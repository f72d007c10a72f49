"""Sealing in a process of its own: where it fails, or the one that asked has ended, the segment stays and counts."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from collected import METER, NOON, at, filled, meter_read, read_of

from busway.apps.collector.samples import PointDescription, PointGroup
from busway.apps.collector.store import sealed_writer, sealing
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.folder import SEGMENTS
from busway.apps.collector.store.sealing import SealingFailed
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter

pytest.importorskip("pyarrow")
pytest.importorskip("adbc_driver_sqlite")


def test_a_segment_stays_where_the_process_that_seals_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = filled(tmp_path, 3)
    writer.roll()
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", "/bin/false")
        with pytest.raises(SealingFailed, match=r"00000001\.sqlite could not be sealed: it ended with 1"):
            writer.seal_closed()
    assert [part.kind for part in writer.manifest.parts()] == ["closed"]
    assert len(Store(tmp_path).read()) == 9
    assert writer.seal_closed() == 1
    assert len(Store(tmp_path).read()) == 9
    writer.close(at(10))
    assert check_store_files(tmp_path) == []


def test_a_segment_stays_where_the_process_that_seals_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = filled(tmp_path, 3)
    writer.roll()
    with monkeypatch.context() as patched:
        patched.setattr(sealing, "_LONGEST", 0)
        with pytest.raises(SealingFailed, match=r"00000001\.sqlite could not be sealed within 0 s"):
            writer.seal_closed()
    assert [part.kind for part in writer.manifest.parts()] == ["closed"]
    writer.close(at(10))


def test_nothing_is_imported_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "pyarrow.py").write_text("raise SystemExit('another pyarrow')\n")
    monkeypatch.chdir(tmp_path / "work")
    writer = filled(tmp_path / "store", 3)
    writer.roll()
    assert writer.seal_closed() == 1
    writer.close(at(10))


def test_nothing_is_left_where_the_process_that_asked_has_ended(tmp_path: Path) -> None:
    writer = filled(tmp_path, 3)
    writer.roll()
    (part,) = writer.manifest.parts()
    asked = {"segment": str(tmp_path / SEGMENTS / part.file), "points": [], "parent": 1}
    command = [sys.executable, "-m", "busway.apps.collector.store.sealed_writer"]
    ended = subprocess.run(command, input=json.dumps(asked), capture_output=True, encoding="utf-8", check=True)
    assert json.loads(ended.stdout) == []
    assert [path.name for path in (tmp_path / SEGMENTS).iterdir() if path.suffix != ".sqlite"] == []
    writer.close(at(10))


@pytest.mark.parametrize("values", [(None, "on", 7), (3, 0.5, 2**64 - 1), (None, None, None)])
def test_values_of_one_point_that_change_their_type_stay_what_they_were(
    tmp_path: Path, values: tuple[object, ...]
) -> None:
    group = PointGroup("d", ("p",))
    with StoreWriter(tmp_path, now=NOON) as writer:
        for number, value in enumerate(values):
            writer.commit([read_of(group, number, value, reasons=0 if value is not None else 64)], [], at(number))
        before = Store(tmp_path).read()
        writer.roll()
        assert writer.seal_closed() == 1
        after = Store(tmp_path).read()
    assert after.value == before.value
    assert list(map(type, after.value)) == list(map(type, before.value))


def test_late_samples_are_sealed_in_files_of_their_own(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([meter_read(-3600, 1), meter_read(0, 2)], [], at(1))
        writer.roll()
        writer.seal_closed()
        files = sorted(part.file for part in writer.manifest.parts())
        assert sorted("late" in file for file in files) == [False, True]
        assert len(Store(tmp_path).read(METER.device + "/*")) == 6


def test_sealed_files_are_compressed_with_zstd(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([meter_read(0, 1)], [], at(1))
        writer.roll()
        writer.seal_closed()
        (part,) = [part for part in writer.manifest.parts() if part.kind == "sealed"]
    columns = pq.ParquetFile(tmp_path / "segments" / part.file).metadata.row_group(0)
    assert {columns.column(number).compression for number in range(columns.num_columns)} == {"ZSTD"}


def test_metadata_have_the_points_of_the_file_once_and_no_others(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit(
            [read_of(PointGroup("d", tuple(f"p{number}" for number in range(1000))), 0, *range(1000))], [], at(1)
        )
        writer.roll()
        writer.commit([meter_read(0, 1)], [], at(2))
        writer.describe_points([PointDescription("meter-7", "voltage", "V")])
        writer.roll()
        writer.seal_closed()
        files = [tmp_path / SEGMENTS / part.file for part in writer.manifest.parts() if part.kind == "sealed"]
    many, few = (pq.ParquetFile(file).metadata for file in files)
    points = json.loads(few.metadata[b"busway.points"])
    assert list(points.values()) == [["meter-7", "voltage", "V"], ["meter-7", "current", ""], ["meter-7", "state", ""]]
    assert len(json.loads(many.metadata[b"busway.points"])) == 1000
    assert set(many.metadata) == {b"busway.points"}, "each reader decodes all that is there"


@pytest.mark.parametrize("times", [[1, 1, 2, 2, 3], [3, 1, 2, 2, 1]], ids=["as SQLite gives them", "in another order"])
def test_rows_are_sorted_by_point_and_time_whatever_their_order_was(times: list[int]) -> None:
    import pyarrow as pa

    points = [2, 1, 2, 1, 1]
    order = sealed_writer._order(pa.array(points, pa.int32()), pa.array(times, pa.int64())).to_pylist()
    found = [(points[place], times[place]) for place in order]
    assert found == sorted(zip(points, times, strict=True))
