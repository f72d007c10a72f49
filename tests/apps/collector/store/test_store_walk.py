"""A walk through all that is done to a store, in any order, and what every answer must be after each step.

Commits of late, replacing and renamed samples; ends of segments, sealing, retention, a backup that takes the place of
the store, a process that ends without closing; beside them a sink that reads in small steps.
"""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest
from collected import SECOND, at, read_of, sealed_here

from busway.apps.collector.samples import PointDescription, PointGroup, Reason, StateInterval
from busway.apps.collector.store import manifest, sealing
from busway.apps.collector.store.backup import back_up, restore
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.committed_samples import CommitReader, CommittedSample
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter

pytest.importorskip("pyarrow")

KEPT = 1200
STEPS = 80
VALUES = (1.5, -2.0, 0, 7, 2**63, float("inf"), float("-inf"), "", "a\x00b", -0.0, 1e300, None)


@dataclass
class Walk:
    """A store with what it must hold: the true value of each point and time, and the commit that it came with."""

    folder: Path
    chance: Random
    writer: StoreWriter
    now: int = 0
    names: dict[int, str] = field(default_factory=lambda: {0: "a", 1: "b"})
    rows: dict[tuple[int, int], tuple[Any, int, str]] = field(default_factory=dict)
    borders: list[int] = field(default_factory=list)
    limit: int = 0
    cursor: int = 0
    taken: list[CommittedSample] = field(default_factory=list)
    dropped_after: int = 0
    pause: int | None = None
    folders: int = 0

    def commit(self) -> None:
        self.now += self.chance.choice((0, 1, 60, 240, 400))
        back = self.chance.choice((0, 0, 0, 1, 60, 700, 1300))
        time = max(1, self.now - back)
        if self.rows and self.chance.random() < 0.2:  # the same key again, or a border
            time = (self.chance.choice(list(self.rows))[1] - at(0)) // SECOND
        elif self.chance.random() < 0.2:
            time = max(1, time // 600 * 600)
        if at(time) < self.limit + 700 * SECOND:
            time = self.now
        points = self.chance.choice(((0,), (1,), (0, 1)))
        values = [self.chance.choice(VALUES) for _ in points]
        reasons = [int(Reason.TIMEOUT) if value is None else 0 for value in values]
        group = PointGroup("d", tuple(self.names[point] for point in points))
        made = self.writer.commit([read_of(group, time, *values, reasons=reasons)], [], at(self.now))
        for point, value in zip(points, values, strict=True):
            self.rows[point, at(time)] = value, made.number, self.names[point]

    def interval(self) -> None:
        if self.pause is None:
            self.pause = at(self.now)
            self.writer.commit([], [StateInterval("e", self.pause, None, Reason.SUSPENDED)], at(self.now))
        else:
            ended = StateInterval("e", self.pause, at(self.now), Reason.SUSPENDED)
            self.pause = None
            self.writer.commit([], [ended], at(self.now))

    def rename(self) -> None:
        point = self.chance.choice((0, 1))
        new = f"{'ab'[point]}{self.chance.randrange(4)}"
        if new == self.names[point]:
            return
        was, self.names[point] = self.names[point], new
        self.writer.describe_points([PointDescription("d", new, was=was)])
        self.names[point] = [each.point for each in self.writer.manifest.points() if each.device == "d"][point]

    def end_segment(self) -> None:
        self.writer.roll()

    def seal(self) -> None:
        self.writer.seal_closed(most=self.chance.choice((1, None)))

    def retain(self) -> None:
        self.limit = max(self.limit, at(self.now - KEPT))
        self.writer.apply_retention(at(self.now))

    def crash(self) -> None:
        self.writer.__exit__()
        self.pause = None
        self.writer = self.opened(self.folder)

    def replace(self) -> None:
        self.folders += 1
        copy, again = (self.folder.with_name(f"{name}{self.folders}") for name in ("copy", "again"))
        back_up(self.folder, copy)
        self.writer.__exit__()
        restore(copy, again)
        assert check_store_files(again) == []
        self.folder, self.pause = again, None
        self.writer = self.opened(again)

    def opened(self, folder: Path) -> StoreWriter:
        writer = StoreWriter(folder, now=at(self.now))
        writer.keep(Retention(age=KEPT))
        return writer

    def deliver(self) -> None:
        reader = CommitReader(self.folder, self.writer.manifest)
        for _ in range(self.chance.choice((1, 3, 1000))):
            found = reader.read(self.cursor, self.chance.choice((1, 5, 50)))
            if found is None:
                break
            assert found.last > self.cursor
            assert all(self.cursor < each.commit <= found.last for each in found.samples)
            self.taken += [each for each in found.samples if each.device == "d"]
            self.cursor = found.last

    def check(self) -> None:
        store = Store(self.folder)
        ids = {name: point for point, name in self.names.items()}
        whole = store.read()
        begin = self.chance.choice([0, *(time + more for _, time in self.rows for more in (0, 1))])
        for low, high, table in ((0, 2**63 - 1, whole), (begin, begin + 900 * SECOND, None)):
            table = table or store.read(since=low, until=high)
            found: dict[tuple[int, int], Any] = {}
            for device, name, time, value, reason in zip(
                table.device, table.point, table.time, table.value, table.reason, strict=True
            ):
                if device == "d" and reason not in (Reason.KILLED, Reason.STOPPED):
                    assert (ids[name], time) not in found, "a sample is there once"
                    found[ids[name], time] = value
            wanted = {key: row[0] for key, row in self.rows.items() if low <= key[1] < high}
            assert {key for key in wanted if key[1] >= self.limit} <= found.keys() <= wanted.keys()
            for key, value in found.items():
                assert repr(value) == repr(wanted[key]), key
            self.check_buckets(store, (low, high), found)
            spans = [each for each in table.intervals if each.device == "e" and each.end is None]
            assert len(spans) == (self.pause is not None and self.pause < high and low < high), "none without end"
        for key in [key for key in self.rows if key[1] < self.limit and key not in self.seen(whole, ids)]:
            del self.rows[key]

    def seen(self, table: Any, ids: dict[str, int]) -> set[tuple[int, int]]:
        return {
            (ids[name], time)
            for device, name, time in zip(table.device, table.point, table.time, strict=True)
            if device == "d"
        }

    def check_buckets(self, store: Store, period: tuple[int, int], found: dict[tuple[int, int], Any]) -> None:
        numbers: dict[tuple[int, int], list[float]] = defaultdict(list)
        for (point, time), value in found.items():
            if isinstance(value, int | float):
                numbers[point, time // (100 * SECOND)].append(float(value))
        ids = {name: point for point, name in self.names.items()}
        table = store.read("d", since=period[0], until=period[1], bucket=100)
        told = {
            (ids[name], time // (100 * SECOND)): (low, high, count)
            for name, time, low, high, count in zip(
                table.point, table.time, table.minimum, table.maximum, table.count, strict=True
            )
            if count
        }
        assert told == {key: (min(values), max(values), len(values)) for key, values in numbers.items()}

    def check_sink(self) -> None:
        order = [each.commit for each in self.taken]
        assert order == sorted(order), "in order"
        keys = [(each.commit, each.point, each.time) for each in self.taken]
        assert len(keys) == len(set(keys)), "once"
        by_key = {(each.commit, each.point, each.time): each.value for each in self.taken}
        for (_, time), (value, commit, name) in self.rows.items():
            if time >= self.limit:
                assert repr(by_key[commit, name, time]) == repr(value)


@pytest.mark.parametrize("seed", [2, 7, 27])
def test_every_answer_is_true_whatever_is_done_to_a_store(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifest, "RESERVED_NUMBERS", 7)
    monkeypatch.setattr(sealing, "_written", sealed_here)
    chance = Random(seed)
    walk = Walk(tmp_path / "store", chance, StoreWriter(tmp_path / "store", now=at(0)))
    walk.writer.keep(Retention(age=KEPT))
    walk.writer.commit([read_of(PointGroup("d", ("a", "b")), 1, 1, 2)], [], at(1))
    walk.writer.commit([read_of(PointGroup("e", ("c",)), 1, 1)], [], at(1))
    walk.rows = {
        (0, at(1)): (1, walk.writer.newest_commit - 1, "a"),
        (1, at(1)): (2, walk.writer.newest_commit - 1, "b"),
    }
    steps = [walk.commit] * 16 + [walk.deliver] * 3 + [walk.end_segment, walk.seal] * 2
    steps += [walk.retain, walk.interval] * 2 + [walk.rename, walk.crash]
    try:
        for number in range(STEPS):
            chance.choice(steps)()
            if number % 40 == 30:
                walk.replace()
            if number % 6 == 0:
                walk.check()
        walk.check()
        walk.chance = Random(1)
        for _ in range(20):
            walk.deliver()
        walk.check_sink()
    finally:
        walk.writer.__exit__()
