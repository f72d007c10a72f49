"""Backup and restore, while a store is written."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from collected import NOON, PUMP, at, filled, meter_read, parts_of_all_kinds, read_of

from busway.apps.collector.store import backup, manifest
from busway.apps.collector.store.backup import back_up, restore
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.folder import LOCK, SEGMENTS, StoreLock, is_alive
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter
from busway.errors import ConfigError

pytest.importorskip("pyarrow")


def test_a_backup_is_a_store_and_is_restored_into_a_new_folder(tmp_path: Path) -> None:
    with parts_of_all_kinds(tmp_path / "store") as writer:
        assert back_up(tmp_path / "store", tmp_path / "backup") == 3
        before = Store(tmp_path / "store").read()
        writer.commit([meter_read(2100, 7)], [], at(2100))
    assert list(Store(tmp_path / "backup").read()) == list(before)
    assert restore(tmp_path / "backup", tmp_path / "again") == 3
    assert list(Store(tmp_path / "again").read()) == list(before)
    with StoreWriter(tmp_path / "again", now=NOON * 2) as again:
        assert again.commit([], [], NOON * 2).number > 10_000


def test_a_sink_of_a_restored_store_gets_what_comes_after_however_long_the_backup_took(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifest, "RESERVED_NUMBERS", 10)
    copy_database = backup._copy_database
    with StoreWriter(tmp_path / "store", now=NOON) as writer:

        def after_more_commits(source: Path, target: Path) -> None:
            if source.parent.name == SEGMENTS:
                for number in range(25):
                    writer.commit([read_of(PUMP, number, number)], [], at(number))
            copy_database(source, target)

        writer.commit([read_of(PUMP, 0, 0)], [], NOON)
        with monkeypatch.context() as patched:
            patched.setattr(backup, "_copy_database", after_more_commits)
            back_up(tmp_path / "store", tmp_path / "backup")
        before = writer.newest_commit
    restore(tmp_path / "backup", tmp_path / "again")
    with StoreWriter(tmp_path / "again", now=at(30)) as again:
        again.commit([read_of(PUMP, 31, 31)], [], at(31))
        found = CommitReader(tmp_path / "again", again.manifest).read(before, 10)
        assert found is not None
        assert [each.value for each in found.samples] == [31]


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


def test_a_backup_is_not_restored_into_a_folder_that_a_writer_has_locked(tmp_path: Path) -> None:
    with filled(tmp_path / "store", 2):
        back_up(tmp_path / "store", tmp_path / "backup")
    folder = tmp_path / "again"
    folder.mkdir()
    lock = StoreLock(folder)
    with pytest.raises(ConfigError, match="collects into this store") as caught:
        restore(tmp_path / "backup", folder)
    assert caught.value.file == str(folder)
    with pytest.raises(ConfigError, match="collects into this store"):
        StoreLock(folder)
    lock.release()
    assert (folder / LOCK).exists()
    assert restore(tmp_path / "backup", folder) == 1


@pytest.mark.parametrize("holder", ["9" * 31, "4294967296", "0"])
def test_a_locked_store_whose_lock_file_is_damaged_is_refused_as_locked(tmp_path: Path, holder: str) -> None:
    lock = StoreLock(tmp_path)
    (tmp_path / LOCK).write_text(f"{holder}\n")
    with pytest.raises(ConfigError, match="collects into this store"):
        StoreLock(tmp_path)
    lock.release()


def test_a_process_is_alive_only_under_a_number_that_a_process_can_have() -> None:
    assert is_alive(os.getpid())
    assert not any(is_alive(number) for number in (0, -1, 2**31, 2**63))


@pytest.mark.parametrize("moment", ["before the lock", "between open and lock"])
def test_a_restore_deletes_no_store_that_was_made_while_it_looked_and_leaves_no_lock_of_a_deleted_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    with filled(tmp_path / "store", 2):
        back_up(tmp_path / "store", tmp_path / "backup")
    folder = tmp_path / "again"
    folder.mkdir()
    begins = [True]

    def lock_late(folder: Path) -> StoreLock:
        if begins.pop():
            filled(folder, 1).close(at(2))
        return StoreLock(folder)

    def take_late(lock: StoreLock) -> None:
        if begins and begins.pop():
            restore(tmp_path / "backup", folder)
        take(lock)

    take = StoreLock._take
    with monkeypatch.context() as patched:
        if moment == "before the lock":
            patched.setattr(backup, "StoreLock", lock_late)
            with pytest.raises(ConfigError, match="is not empty"):
                restore(tmp_path / "backup", folder)
            assert len(Store(folder).read("meter-7/voltage")) == 1
            return
        patched.setattr(StoreLock, "_take", take_late)
        lock = StoreLock(folder)
    assert len(Store(folder).read()) == 6, "the restored store"
    with pytest.raises(ConfigError, match="collects into this store"):
        StoreLock(folder)
    lock.release()


def test_a_backup_is_not_restored_into_a_file(tmp_path: Path) -> None:
    with filled(tmp_path / "store", 2):
        back_up(tmp_path / "store", tmp_path / "backup")
    (tmp_path / "again").write_text("mine")
    with pytest.raises(ConfigError, match="Not a directory") as caught:
        restore(tmp_path / "backup", tmp_path / "again")
    assert caught.value.file == str(tmp_path / "again")
    assert (tmp_path / "again").read_text() == "mine"


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


def test_a_backup_does_not_list_a_segment_that_is_not_made_yet_and_can_be_restored(tmp_path: Path) -> None:
    steps: list[str] = []
    copied: list[int] = []

    def back_up_before_the_second_is_made(step: str) -> None:
        steps.append(step)
        if step == "segment-listed" and steps.count(step) == 2:
            copied.append(back_up(tmp_path / "data", tmp_path / "copy"))

    with StoreWriter(tmp_path / "data", now=NOON, step=back_up_before_the_second_is_made) as writer:
        writer.commit([meter_read(1, 1)], [], at(1))
        writer.roll()
        writer.commit([meter_read(2, 2)], [], at(2))
    assert copied == [1]
    assert check_store_files(tmp_path / "copy") == []
    assert restore(tmp_path / "copy", tmp_path / "again") == 1
    assert len(Store(tmp_path / "again").read()) == 3
    with StoreWriter(tmp_path / "again", now=at(3)) as again:
        again.commit([meter_read(4, 4)], [], at(4))
    assert check_store_files(tmp_path / "again") == []


@pytest.mark.parametrize("meanwhile", ["sealed", "new point"])
def test_what_happens_while_a_backup_is_made_takes_nothing_from_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, meanwhile: str
) -> None:
    copied: list[str] = []
    copy = backup._copy_database

    def copy_slowly(source: Path, target: Path) -> None:
        copy(source, target)
        copied.append(source.name)
        if len(copied) == 1 and meanwhile == "sealed":
            writer.roll()
            writer.seal_closed()
        elif len(copied) == 1:
            writer.commit([read_of(PUMP, 100, 1.0)], [], at(100))

    monkeypatch.setattr(backup, "_copy_database", copy_slowly)
    with filled(tmp_path / "data", 3) as writer:
        back_up(tmp_path / "data", tmp_path / "copy")
    restore(tmp_path / "copy", tmp_path / "again")
    kept = Store(tmp_path / "again").read()
    assert len(kept) == (9 if meanwhile == "sealed" else 10)
    assert kept == Store(tmp_path / "data").read()


def test_a_segment_that_is_sealed_just_before_it_is_copied_is_in_the_backup_and_leaves_no_file_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []
    open_really = backup.open_for_reading

    def open_and_seal(path: Path) -> sqlite3.Connection:
        database = open_really(path)
        if path.parent.name == SEGMENTS and not opened:
            opened.append(path)
            writer.roll()
            writer.seal_closed()
        return database

    with filled(tmp_path / "data", 3) as writer, monkeypatch.context() as patched:
        patched.setattr(backup, "open_for_reading", open_and_seal)
        back_up(tmp_path / "data", tmp_path / "copy")
    assert restore(tmp_path / "copy", tmp_path / "again") == 1
    assert len(Store(tmp_path / "again").read()) == 9
    assert [path.exists() for path in opened] == [False]
