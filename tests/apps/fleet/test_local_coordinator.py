"""The file of collectors on one machine while it is damaged, away or replaced, and after it has come back.

The rules that all coordinators keep are tested in `test_coordinators`.
"""

import asyncio
import contextlib
import sqlite3
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest
from waiting import until

from busway.apps.collector.commands.claims import KeysUnavailable
from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.apps.fleet.coordinator import (
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    CoordinatorDown,
    OutcomeUnknown,
    RevisionConflict,
)
from busway.apps.fleet.coordinators.local import LocalCoordinator, open_local
from busway.apps.fleet.key_table import KeyTable
from busway.apps.fleet.table_records import MemberRecord
from busway.apps.fleet.zone_watch import ZoneWatch


@contextlib.contextmanager
def directory(file: Path) -> Iterator[None]:
    """A folder has the name of the file meanwhile, as after a mistake with a mount."""
    file.rename(file.with_suffix(".aside"))
    file.mkdir()
    yield
    file.rmdir()
    file.with_suffix(".aside").rename(file)


@contextlib.contextmanager
def away(file: Path) -> Iterator[None]:
    file.rename(file.with_suffix(".aside"))
    yield
    file.with_suffix(".aside").rename(file)


@contextlib.contextmanager
def replaced_by_garbage(file: Path) -> Iterator[None]:
    file.rename(file.with_suffix(".aside"))
    file.write_bytes(b"no table at all " * 1024)
    yield
    file.with_suffix(".aside").rename(file)


@contextlib.contextmanager
def overwritten(file: Path) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(file, timeout=60.0)) as other:
        other.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    good = file.read_bytes()
    with file.open("r+b") as opened:
        opened.write(b"\xa5" * len(good))
    yield
    with file.open("r+b") as opened:
        opened.write(good)


@contextlib.contextmanager
def without_its_table(file: Path) -> Iterator[None]:
    with contextlib.closing(sqlite3.connect(file, timeout=60.0)) as other:
        other.execute("ALTER TABLE entries RENAME TO taken_away")
        yield
        other.execute("ALTER TABLE taken_away RENAME TO entries")


Outage = Callable[[Path], contextlib.AbstractContextManager[None]]
OUTAGES: list[Outage] = [directory, away, replaced_by_garbage, overwritten, without_its_table]


def opened(key: str) -> CommandResult:
    command = PointCommand(key, "boiler", "setpoint", 7, "anna", "api", 1030.0)
    return CommandResult(command, CommandState.OPEN, 1000.0)


@contextlib.asynccontextmanager
async def table(tmp_path: Path) -> AsyncIterator[LocalCoordinator]:
    coordinator = await open_local(str(tmp_path), "hall")
    try:
        yield coordinator
    finally:
        await coordinator.close()


@pytest.mark.parametrize("outage", OUTAGES, ids=lambda each: each.__name__)
async def test_a_file_that_cannot_be_used_for_a_while_is_told_nothing_counts_as_known_and_all_goes_on(
    tmp_path: Path, outage: Outage, caplog: pytest.LogCaptureFixture
) -> None:
    async with table(tmp_path) as one, table(tmp_path) as other, KeyTable(one, "west") as keys, ZoneWatch(one) as zone:
        revision = await other.create("member.east", MemberRecord("east", "run", "box", 1).encode())
        assert await keys.claim(opened("k1")) is None
        await until(lambda: zone.is_complete and "east" in zone.status().members and bool(keys._seen))
        with outage(one.path):
            await until(lambda: not zone.is_complete)
            await until(lambda: "the table of the zone cannot be followed" in caplog.text)
            with pytest.raises((CoordinatorDown, OutcomeUnknown), match=r"hall\.fleet"):
                await one.replace("member.east", b"", revision)
            with pytest.raises(KeysUnavailable):
                await keys.claim(opened("k2"))
        await until(lambda: zone.is_complete)
        later = await other.replace("member.east", MemberRecord("east", "run", "box", 2).encode(), revision)
        assert later > revision
        await until(lambda: zone.status().members["east"].record.count == 2)
        assert await keys.claim(opened("k2")) is None
        found = await keys.claim(opened("k1"))
        assert found is not None, "what was confirmed before is still known"
    assert caplog.text.count("the table of the zone cannot be followed") == 1
    assert caplog.text.count("the table of the zone is followed again") == 1


async def test_a_file_that_was_removed_is_not_made_anew_by_who_has_had_it(tmp_path: Path) -> None:
    async with table(tmp_path) as one:
        revision = await one.create("lease.0001", b"a")
        one.path.unlink()
        for _ in range(2):
            with pytest.raises(CoordinatorDown, match=r"hall\.fleet"):
                await one.replace("lease.0001", b"b", revision)
        assert not one.path.exists()


async def test_a_copy_from_a_backup_is_not_taken_before_the_next_start(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with table(tmp_path) as one:
        first = await one.create("lease.0001", b"a")
        with contextlib.closing(sqlite3.connect(one.path)) as source:
            source.execute("VACUUM INTO ?", (str(tmp_path / "backup"),))
        second = await one.replace("lease.0001", b"b", first)
        (tmp_path / "backup").replace(one.path)
        with pytest.raises(CoordinatorDown, match="another file has its place; put the first one back, or start"):
            await one.replace("lease.0001", b"c", second)
        async with contextlib.aclosing(one.watch()) as entries:
            assert await anext(entries) is SNAPSHOT_BEGINS, "nothing of the other file is shown"
        assert "another file has its place" in caplog.text
    for ending in ("-wal", "-shm"):  # they belong to the first file
        one.path.with_name(one.path.name + ending).unlink(missing_ok=True)
    async with table(tmp_path) as again:
        with pytest.raises(RevisionConflict):
            await again.replace("lease.0001", b"c", second)
        assert await again.replace("lease.0001", b"c", first) > first


async def test_a_table_that_another_program_has_locked_changes_nothing_and_can_be_changed_when_it_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.fleet.coordinators.local.LOCKED_SECONDS", 0.01)
    async with table(tmp_path) as one:
        revision = await one.create("lease.0001", b"a")
        with contextlib.closing(sqlite3.connect(one.path, isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(CoordinatorDown, match="database is locked"):
                await one.replace("lease.0001", b"b", revision)
            other.execute("COMMIT")
        assert await one.replace("lease.0001", b"b", revision) == revision + 1


async def test_watches_that_are_closed_during_an_outage_leave_nothing_behind(tmp_path: Path) -> None:
    async with table(tmp_path) as one:
        entries = one.watch()
        assert await anext(entries) is SNAPSHOT_ENDS
        with away(one.path):
            assert await anext(entries) is SNAPSHOT_BEGINS
            waiting = asyncio.create_task(anext(entries))  # type: ignore[arg-type]
            await asyncio.sleep(0)
            waiting.cancel()
            await asyncio.wait([waiting])
            await entries.aclose()
