"""Check of a store, while it is written."""

import sqlite3
from pathlib import Path

import pytest
from collected import at, filled, parts_of_all_kinds

from busway.apps.collector.store.backup import restore
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.folder import OWNERSHIP, SEGMENTS, check_store
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet.ownership_log import OwnershipLog
from busway.errors import ConfigError

pytest.importorskip("pyarrow")


def test_a_whole_store_has_no_problems_while_it_is_written(tmp_path: Path) -> None:
    with parts_of_all_kinds(tmp_path) as writer:
        assert {part.kind for part in writer.manifest.parts()} == {"sealed", "closed", "open"}
        assert check_store_files(tmp_path) == []


def test_each_damage_is_told(tmp_path: Path) -> None:
    with parts_of_all_kinds(tmp_path) as writer:
        by_kind = {part.kind: part for part in writer.manifest.parts()}
        sealed, closed = by_kind["sealed"], by_kind["closed"]
    (tmp_path / SEGMENTS / sealed.file).write_bytes(b"PAR1 and nothing")
    with sqlite3.connect(tmp_path / SEGMENTS / closed.file) as database:
        database.execute("INSERT INTO samples VALUES (1, 99, 1, 0, 0, 1)")
        database.execute("INSERT INTO samples VALUES (2, 1, 1, 0, 0, 1)")
    database.close()
    (tmp_path / SEGMENTS / "00000099.parquet").write_bytes(b"")
    told = check_store_files(tmp_path)
    assert len(told) == 4, told
    assert any(sentence.startswith(f"{sealed.file} cannot be read") for sentence in told)
    assert f"{closed.file} has samples of points that are not listed: [99]" in told
    assert any("but its commits made" in sentence for sentence in told)
    assert "00000099.parquet is in the folder, but not listed" in told
    (tmp_path / SEGMENTS / sealed.file).unlink()
    assert f"{sealed.file} is listed, but the file is not there" in check_store_files(tmp_path)


def test_a_segment_without_a_file_that_no_process_writes_may_be_lost_or_not_made_yet(tmp_path: Path) -> None:
    with filled(tmp_path, 3) as writer:
        writer.roll()
        begun = writer.manifest.add_segment()
        assert check_store_files(tmp_path) == []
    why = "it is lost, or a collector was killed before it made it"
    assert check_store_files(tmp_path) == [f"{begun.file} is listed, but the file is not there: {why}"]
    with StoreWriter(tmp_path, now=at(10)):
        pass
    assert check_store_files(tmp_path) == []


def test_a_damaged_record_of_ownership_is_told_and_such_a_backup_is_not_restored(tmp_path: Path) -> None:
    with filled(tmp_path, 3):
        OwnershipLog(tmp_path).close()
    assert check_store_files(tmp_path) == []
    (tmp_path / OWNERSHIP).write_bytes(b"no database at all, but long enough to be looked at" * 100)
    (problem,) = check_store_files(tmp_path)
    assert problem.startswith("fleet.sqlite cannot be read")
    with pytest.raises(ConfigError, match=r"the backup is not whole: fleet\.sqlite"):
        restore(tmp_path, tmp_path / "again")


def test_a_folder_whose_name_is_too_long_is_refused_in_a_sentence() -> None:
    with pytest.raises(ConfigError, match="the store cannot be read: File name too long"):
        check_store(Path("x" * 5000))
