"""Check, backup and restore, while a store is written."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from collected import NOON, PUMP, at, filled, read_of

from busway.apps.collector.store import check_and_backup
from busway.apps.collector.store.check_and_backup import back_up, check_store_files, restore
from busway.apps.collector.store.folder import SEGMENTS
from busway.apps.collector.store.reading import Store
from busway.apps.collector.store.writer import StoreWriter
from busway.errors import ConfigError

pytest.importorskip("pyarrow")


def parts_of_all_kinds(folder: Path) -> StoreWriter:
    writer = filled(folder, 15, step=60.0)
    writer.seal_closed()
    writer.roll()
    return filled_further(writer)


def filled_further(writer: StoreWriter) -> StoreWriter:
    from collected import at, meter_read

    writer.commit([meter_read(2000, 7)], [], at(2000))
    return writer


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


def test_a_backup_is_a_store_and_is_restored_into_a_new_folder(tmp_path: Path) -> None:
    with parts_of_all_kinds(tmp_path / "store") as writer:
        assert back_up(tmp_path / "store", tmp_path / "backup") == 3
        before = Store(tmp_path / "store").read()
        filled_further(writer)
    assert list(Store(tmp_path / "backup").read()) == list(before)
    assert restore(tmp_path / "backup", tmp_path / "again") == 3
    assert list(Store(tmp_path / "again").read()) == list(before)
    with StoreWriter(tmp_path / "again", now=NOON * 2) as again:
        assert again.commit([], [], NOON * 2).number > 10_000


def test_a_backup_never_overwrites_and_a_damaged_one_is_not_restored(tmp_path: Path) -> None:
    with filled(tmp_path / "store", 2):
        (tmp_path / "there").mkdir()
        with pytest.raises(ConfigError, match="exists already"):
            back_up(tmp_path / "store", tmp_path / "there")
        with pytest.raises(ConfigError, match="is not empty"):
            restore(tmp_path / "store", tmp_path / "store")
        with pytest.raises(ConfigError, match="there is no store"):
            back_up(tmp_path / "there", tmp_path / "backup")
        back_up(tmp_path / "store", tmp_path / "backup")
    for path in (tmp_path / "backup" / SEGMENTS).iterdir():
        path.unlink()
    with pytest.raises(ConfigError, match=r"the backup is not whole|listed"):
        restore(tmp_path / "backup", tmp_path / "again")


def test_a_backup_of_a_segment_that_has_no_tables_yet_is_whole(tmp_path: Path) -> None:
    with filled(tmp_path / "data", 3) as writer:
        writer.roll()
        begun = writer.manifest.add_segment()
        with closing(sqlite3.connect(tmp_path / "data" / SEGMENTS / begun.file)) as database:
            database.execute("PRAGMA journal_mode=WAL")
        assert check_store_files(tmp_path / "data") == []
        back_up(tmp_path / "data", tmp_path / "copy")
    restore(tmp_path / "copy", tmp_path / "again")
    assert len(Store(tmp_path / "again").read()) == 9


@pytest.mark.parametrize("meanwhile", ["sealed", "new point"])
def test_what_happens_while_a_backup_is_made_takes_nothing_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    copied: list[str] = []
    copy = check_and_backup._copy_database

    def copy_slowly(source: Path, target: Path) -> None:
        copy(source, target)
        copied.append(source.name)
        if len(copied) == 1 and meanwhile == "sealed":
            writer.roll()
            writer.seal_closed()
        elif len(copied) == 1:
            writer.commit([read_of(PUMP, 100, 1.0)], [], at(100))

    monkeypatch.setattr(check_and_backup, "_copy_database", copy_slowly)
    with filled(tmp_path / "data", 3) as writer:
        back_up(tmp_path / "data", tmp_path / "copy")
    restore(tmp_path / "copy", tmp_path / "again")
    kept = Store(tmp_path / "again").read()
    assert len(kept) == (9 if meanwhile == "sealed" else 10)
    assert kept == Store(tmp_path / "data").read()
