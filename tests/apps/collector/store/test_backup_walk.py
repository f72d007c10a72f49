"""Backups and restores, with something else done at each of their steps: what both stores hold then."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

import pytest
from collected import PUMP, at, read_of, sealed_here

from busway.apps.collector.samples import PointGroup, Reason
from busway.apps.collector.store import manifest, sealing
from busway.apps.collector.store.backup import back_up, restore
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.folder import StoreLock
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter
from busway.errors import ConfigError

pytest.importorskip("pyarrow")

SEEDS = [int(each) for each in os.environ.get("BUSWAY_BACKUP_SEEDS", "1").split()]
EVERY = int(os.environ.get("BUSWAY_BACKUP_EVERY", "150"))
"""Of so many moments of a backup or restore one is tried, another with each seed; 1 for all."""
WATCHED = ("backup.py", "folder.py", "manifest.py", "shutil.py")
"""Files in which each call is a moment at which another process may do something."""


@contextmanager
def at_call(number: int, act: Callable[[], None]) -> Iterator[list[int]]:
    """Do something before one of the calls that are made in the block; gives the number of calls in the end."""
    calls = [0]

    def watch(frame: FrameType, event: str, _: object) -> None:
        if event in ("call", "c_call"):
            code = (frame if event == "c_call" else frame.f_back or frame).f_code
            if code.co_filename.endswith(WATCHED):
                calls[0] += 1
                if calls[0] == number:
                    sys.setprofile(None)
                    act()
                    sys.setprofile(watch)

    sys.setprofile(watch)
    try:
        yield calls
    finally:
        sys.setprofile(None)


@pytest.fixture(autouse=True)
def few_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifest, "RESERVED_NUMBERS", 3)
    monkeypatch.setattr(sealing, "_written", sealed_here)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # the machine goes on in this test


class Plant:
    """A store with a sealed part, a closed and an open segment, and what is in it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.second, self.rows = folder, 0, dict[tuple[str, int], tuple[int, Any]]()
        self.writer = StoreWriter(folder, now=at(0))
        self.commit()
        self.roll()
        self.writer.seal_closed()
        self.commit()
        self.roll()
        self.commit()
        self.take()

    def commit(self, points: tuple[str, ...] = ("speed",)) -> None:
        """Commit two reads that are equal in everything, and one of a second later."""
        self.second += 2
        group = PointGroup("pump-1", points)
        reads = [read_of(group, self.second + more, *(1.0 for _ in points)) for more in (0, 0, 1)]
        made = self.writer.commit(reads, [], at(self.second))
        self.rows |= {(point, read.time): (made.number, 1.0) for read in reads for point in points}

    def commit_many(self) -> None:
        for _ in range(7):
            self.commit()

    def commit_a_new_point(self) -> None:
        self.commit(("speed", f"new{self.second}"))

    def nothing(self) -> None:
        pass

    def empty(self) -> None:
        self.writer.commit([], [], at(self.second))

    def take(self) -> None:
        """A sink has everything up to the newest commit."""
        self.writer.manifest.set_cursor("sink", self.writer.newest_commit, 0)

    def commit_and_take(self) -> None:
        self.commit_many()
        self.take()

    def roll(self) -> None:
        self.writer.roll()

    def roll_and_commit(self) -> None:
        self.roll()
        self.commit()

    def seal(self) -> None:
        self.roll()
        self.writer.seal_closed()

    def crash(self) -> None:
        """End without closing, and begin anew."""
        self.writer.__exit__()
        self.writer = StoreWriter(self.folder, now=at(self.second))

    def close_and_open(self) -> None:
        self.writer.close(at(self.second))
        self.writer = StoreWriter(self.folder, now=at(self.second))


ACTS = (
    "nothing",
    "empty",
    "commit",
    "commit_many",
    "commit_a_new_point",
    "commit_and_take",
    "roll",
    "roll_and_commit",
    "seal",
    "crash",
    "close_and_open",
)


def samples_of(folder: Path) -> dict[tuple[str, int], Any]:
    table = Store(folder).read()
    rows = [
        (point, time, value)
        for point, time, value, reason in zip(table.point, table.time, table.value, table.reason, strict=True)
        if reason not in (Reason.KILLED, Reason.STOPPED)
    ]
    found = {(point, time): value for point, time, value in rows}
    assert len(found) == len(rows), "each once"
    return found


def check_restored(copy: Path, folder: Path, plant: Plant, before: dict[tuple[str, int], Any], newest: int) -> None:
    """A restored store has what was committed before the backup, and gives no number twice."""
    assert check_store_files(copy) == []
    restore(copy, folder)
    assert check_store_files(folder) == []
    found = samples_of(folder)
    assert before.keys() <= found.keys() <= plant.rows.keys()
    copied = max(plant.rows[key][0] for key in found)
    assert {key for key, (number, _) in plant.rows.items() if number <= copied} == found.keys(), "whole commits"
    with StoreWriter(folder, now=at(plant.second + 100)) as again:
        cursor = again.manifest.cursors()["sink"][0]
        reader = CommitReader(folder, again.manifest)
        made = again.commit([read_of(PUMP, plant.second + 101, 5.0)], [], at(plant.second + 101))
        assert made.number > max(copied, cursor, newest)
        numbers = dict[int, set[tuple[str, int]]]()
        after = 0
        while (part := reader.read(after, 1)) is not None:
            for sample in part.samples:
                numbers.setdefault(sample.commit, set()).add((sample.point, sample.time))
            after = part.last
        for key in found:
            assert key in numbers[plant.rows[key][0]]
        assert numbers[made.number] == {("speed", at(plant.second + 101))}
    assert check_store_files(folder) == []


@pytest.mark.parametrize("act", ACTS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_backup_has_what_was_committed_before_whatever_is_done_at_any_of_its_steps(
    seed: int, act: str, tmp_path: Path
) -> None:
    number = 1 + Random(f"{seed} {act}").randrange(EVERY)
    calls = [number]
    while number <= calls[0]:
        plant = Plant(tmp_path / f"data{number}")
        before, newest = {key: value for key, (_, value) in plant.rows.items()}, plant.writer.newest_commit
        copy, again = tmp_path / f"copy{number}", tmp_path / f"again{number}"
        with at_call(number, getattr(plant, act)) as calls:
            back_up(plant.folder, copy)
        check_restored(copy, again, plant, before, newest)
        plant.writer.__exit__()
        number += EVERY


@pytest.mark.parametrize("there", ["no folder", "an empty folder", "a lock that is free"])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("ends", [False, True])
def test_a_restore_touches_no_store_that_a_process_begins_at_any_of_its_steps(
    seed: int, there: str, ends: bool, tmp_path: Path
) -> None:
    plant = Plant(tmp_path / "data")
    copy = tmp_path / "copy"
    back_up(plant.folder, copy)
    plant.writer.__exit__()
    number = 1 + Random(f"{seed} {there} {ends}").randrange(EVERY)
    calls = [number]
    while number <= calls[0]:
        folder = tmp_path / f"again{number}"
        if there != "no folder":
            folder.mkdir()
        if there == "a lock that is free":
            StoreLock(folder).release()
        begun: list[StoreWriter] = []

        def begin(folder: Path = folder, begun: list[StoreWriter] = begun) -> None:
            try:
                begun.append(StoreWriter(folder, now=at(1000)))
            except ConfigError:
                return
            begun[0].commit([read_of(PUMP, 1001, 7.0)], [], at(1001))
            if ends:
                begun[0].close(at(1001))

        is_restored = True
        with at_call(number, begin) as calls:
            try:
                restore(copy, folder)
            except ConfigError:
                is_restored = False
        if begun:
            assert samples_of(folder)["speed", at(1001)] == 7.0
            if not ends:
                begun[0].commit([read_of(PUMP, 1002, 8.0)], [], at(1002))
                with pytest.raises(ConfigError, match="collects into this store"):
                    StoreLock(folder)
                begun[0].__exit__()
            assert samples_of(folder)["speed", at(1001)] == 7.0
        if is_restored:
            assert plant.rows.keys() <= samples_of(folder).keys()
        number += EVERY


def test_a_backup_has_what_was_committed_before_at_each_step_of_the_writer(tmp_path: Path) -> None:
    steps: list[str] = []
    plant = Plant(tmp_path / "data")
    promised: list[tuple[str, dict[tuple[str, int], Any], int]] = []

    def back_up_now(step: str) -> None:
        if step in steps and EVERY > 1:
            return
        steps.append(step)
        back_up(plant.folder, tmp_path / f"copy{len(steps)}")
        promised.append((step, {key: value for key, (_, value) in plant.rows.items()}, newest_of(plant)))

    plant.writer.close(at(plant.second))
    plant.writer = StoreWriter(plant.folder, now=at(plant.second), step=back_up_now)
    plant.commit()
    plant.roll_and_commit()
    plant.seal()
    plant.empty()
    plant.writer.keep(Retention(age=1))
    assert plant.writer.apply_retention(at(plant.second + 10_000))
    for number, (step, before, newest) in enumerate(promised, 1):
        if "drop" in step or "retention" in step:
            before = {}
        copy = tmp_path / f"copy{number}"
        assert check_store_files(copy) == [], step
        restore(copy, tmp_path / f"again{number}")
        assert before.keys() <= samples_of(tmp_path / f"again{number}").keys(), step
        with StoreWriter(tmp_path / f"again{number}", now=at(1000)) as again:
            assert again.commit([read_of(PUMP, 1001, 5.0)], [], at(1001)).number > newest
    plant.writer.__exit__()
    assert {"segment-listed", "segment-closed"} <= set(steps)


def newest_of(plant: Plant) -> int:
    return max(number for number, _ in plant.rows.values())


def test_a_backup_is_restored_into_the_place_of_its_own_store_and_not_while_that_is_held(tmp_path: Path) -> None:
    plant = Plant(tmp_path / "data")
    back_up(plant.folder, tmp_path / "copy")
    before, newest = {key: value for key, (_, value) in plant.rows.items()}, plant.writer.newest_commit
    plant.commit_and_take()
    rows = samples_of(plant.folder)
    with pytest.raises(ConfigError, match="is not empty"):
        restore(tmp_path / "copy", plant.folder)
    plant.commit()
    plant.writer.__exit__()
    with pytest.raises(ConfigError, match="is not empty"):
        restore(tmp_path / "copy", plant.folder)
    assert rows.keys() < samples_of(plant.folder).keys()
    plant.folder.rename(tmp_path / "old")
    check_restored(tmp_path / "copy", plant.folder, plant, before, newest)
    with pytest.raises(ConfigError, match="is not empty"):
        restore(tmp_path / "copy", tmp_path / "copy")
