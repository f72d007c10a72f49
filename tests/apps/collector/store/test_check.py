"""Check of a store, while it is written."""

import sqlite3
from pathlib import Path

import pytest
from collected import parts_of_all_kinds

from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.folder import SEGMENTS, check_store
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


def test_a_folder_whose_name_is_too_long_is_refused_in_a_sentence() -> None:
    with pytest.raises(ConfigError, match="the store cannot be read: File name too long"):
        check_store(Path("x" * 5000))
