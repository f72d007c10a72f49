"""SQLite connections of a store: each is closed, also where it or what it belongs to cannot be opened."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from collected import NOON, at, filled, meter_read

from busway.apps.collector.store import segment as segment_module
from busway.apps.collector.store import writer as writer_module
from busway.apps.collector.store.backup import back_up
from busway.apps.collector.store.database import open_database
from busway.apps.collector.store.folder import MANIFEST, SEGMENTS
from busway.apps.collector.store.segment import Segment
from busway.apps.collector.store.writer import StoreWriter
from busway.errors import ConfigError


def is_open(database: sqlite3.Connection) -> bool:
    try:
        database.execute("PRAGMA user_version")
    except sqlite3.ProgrammingError:  # that is what a closed one raises
        return False
    except sqlite3.Error:
        return True
    return True


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[sqlite3.Connection]]:
    """Every connection that is opened during the test; none may be open at its end."""
    made: list[sqlite3.Connection] = []
    connect = sqlite3.connect

    def noted(*arguments: Any, **options: Any) -> sqlite3.Connection:  # Any: as sqlite3.connect has them
        database = connect(*arguments, **options)
        made.append(database)
        return database

    monkeypatch.setattr(sqlite3, "connect", noted)
    yield made
    assert made, "the test opened nothing"
    assert not any(is_open(database) for database in made)


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    path = tmp_path / "damaged.sqlite"
    path.write_bytes(b"this is no database, and long enough to be taken for a damaged one" * 20)
    return path


@pytest.mark.usefixtures("connections")
def test_a_connection_is_closed_where_a_statement_fails(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError):
        open_database(tmp_path / "new.sqlite", "PRAGMA user_version", "SELECT nothing")


@pytest.mark.usefixtures("connections")
def test_a_connection_is_closed_where_its_script_fails(tmp_path: Path) -> None:
    with pytest.raises(sqlite3.OperationalError):
        open_database(tmp_path / "new.sqlite", script="CREATE TABLE a (b); CREATE TABLE a (b);")


@pytest.mark.usefixtures("connections")
def test_a_file_is_made_only_where_that_is_wanted(tmp_path: Path) -> None:
    open_database(tmp_path / "new file?.sqlite", "PRAGMA user_version=1").close()
    open_database(tmp_path / "new file?.sqlite", makes=False).close()
    with pytest.raises(sqlite3.OperationalError):
        open_database(tmp_path / "none.sqlite", makes=False)
    assert [path.name for path in tmp_path.iterdir()] == ["new file?.sqlite"]


@pytest.mark.usefixtures("connections")
def test_a_segment_that_cannot_be_opened_is_closed(damaged: Path) -> None:
    with pytest.raises(sqlite3.DatabaseError):
        Segment(damaged, every_commit_durable=False)


@pytest.mark.usefixtures("connections")
def test_a_store_that_cannot_be_opened_has_no_open_file_and_no_lock(tmp_path: Path) -> None:
    with filled(tmp_path, 2) as writer:
        (part,) = writer.manifest.parts()
    path = tmp_path / SEGMENTS / part.file
    content = path.read_bytes()
    path.write_bytes(b"damaged" * 1000)
    with pytest.raises(ConfigError, match=f"the store cannot be written: {part.file} is damaged: file is not a data"):
        StoreWriter(tmp_path, now=at(10))
    path.write_bytes(content)
    StoreWriter(tmp_path, now=at(10)).close(at(11))


@pytest.mark.usefixtures("connections")
def test_a_store_whose_first_commit_is_cut_short_has_no_open_file_and_no_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> None:
        raise OSError(5, "input/output error")

    with monkeypatch.context() as broken:
        broken.setattr(writer_module, "sync_folder", fail)
        with pytest.raises(ConfigError, match="input/output error"):
            StoreWriter(tmp_path, now=NOON)
    StoreWriter(tmp_path, now=NOON).close(NOON)


@pytest.mark.usefixtures("connections")
def test_a_store_that_cannot_be_made_durable_is_closed_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path) -> None:
        raise OSError(5, "input/output error")

    writer = filled(tmp_path, 2)
    with monkeypatch.context() as broken:
        broken.setattr(segment_module, "sync_file", fail)
        with pytest.raises(OSError, match="input/output error"):
            writer.close(at(3))
    with StoreWriter(tmp_path, now=at(10)) as again:
        again.commit([meter_read(11)], [], at(11))


@pytest.mark.usefixtures("connections")
def test_a_backup_of_a_store_of_a_later_format_leaves_no_file_open(tmp_path: Path) -> None:
    with filled(tmp_path / "store", 1) as writer:
        writer.manifest.set_fact("format", 99)
    assert (tmp_path / "store" / MANIFEST).exists()
    with pytest.raises(ConfigError, match="format 99"):
        back_up(tmp_path / "store", tmp_path / "backup")
