"""Sinks whose store, cursor, file of what was set aside and receiver fail in turn, and ends at each moment.

Each sample is taken or set aside, in order, and counted once. What a sink took comes again only where its answer was
lost, or after an end before its cursor could be saved.
"""

import asyncio
import os
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest
from collected import PUMP, at, read_of

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointGroup
from busway.apps.collector.sinks.delivery import ASIDE, Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown, SinkRefused
from busway.apps.collector.store.committed_samples import CommitReader, CommittedAlarm, CommittedSample
from busway.apps.collector.store.manifest import Manifest
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

SEEDS = [int(each) for each in os.environ.get("BUSWAY_DELIVERY_SEEDS", "1 2 3").split()]
STEPS = int(os.environ.get("BUSWAY_DELIVERY_STEPS", "150"))
PAIR = PointGroup("pair", ("a", "b"))
REFUSED = 13
"""A sample that is refused has a time of this many seconds, modulo 17."""

Key = tuple[int, str, str, int]


def key_of(sample: CommittedSample) -> Key:
    return sample.commit, sample.device, sample.point, sample.time


def is_refused(device: str, point: str, time: int) -> bool:
    """Whether a sample is refused: by its time alone, so that an equal one of another time is accepted."""
    return point in ("a", "speed") and (time - at(0)) // 1_000_000_000 % 17 == REFUSED


class WalkedSink:
    """Takes samples and events of alarms, and notes what it is sent again without a reason."""

    def __init__(self) -> None:
        self.mode = "takes"
        self.left = 0
        self.taken: list[CommittedSample] = []
        self.accepted: set[Key | tuple[int, int]] = set()
        self.again: list[Key | tuple[int, int]] = []
        self.refused: list[Key | tuple[int, int]] = []
        self.alarms: dict[tuple[int, int], str] = {}
        self.is_open = False
        self.has_failed = False
        """Whether it has been down since its cursor moved."""

    async def open(self) -> None:
        assert not self.is_open
        self.is_open = True
        if self.mode == "no connection":
            raise self.down()

    async def close(self) -> None:
        self.is_open = False

    def fails(self, mode: str) -> bool:
        """Whether it fails now in this way; it may take some calls before it does."""
        if self.mode != mode:
            return False
        self.left -= 1
        return self.left < 0

    def down(self) -> SinkDown:
        self.has_failed = True
        return SinkDown("no answer")

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        refused = [each for each in samples if is_refused(each.device, each.point, each.time)]
        await self.take([key_of(each) for each in samples], is_refused=bool(refused))
        self.taken += samples
        if self.fails("answer lost"):
            raise self.down()
        self.accepted.update(map(key_of, samples))

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        places = [(each.commit, each.place) for each in alarms]
        await self.take(places, is_refused=any(each.event.limit == "refused" for each in alarms))
        self.alarms.update(zip(places, (each.event.limit for each in alarms), strict=True))
        if self.fails("answer lost"):
            raise self.down()
        self.accepted.update(places)

    async def take(self, keys: Sequence[Key | tuple[int, int]], *, is_refused: bool) -> None:
        """Note what is sent again, or raise an error."""
        assert self.is_open
        assert keys
        await asyncio.sleep(0)
        if self.mode == "no connection" or self.fails("is away"):
            raise self.down()
        self.again += [key for key in keys if key in self.accepted]
        if is_refused:
            if len(keys) == 1:
                self.accepted.update(keys)
                self.refused += keys
            raise SinkRefused("refused")


@dataclass
class Paced:
    """A delivery that goes on only when it is told to."""

    delivery: Delivery
    sink: WalkedSink
    paused: asyncio.Event
    go: asyncio.Event
    task: "asyncio.Task[None]"

    async def turn(self) -> None:
        """Let it go on until it pauses again."""
        self.paused.clear()
        self.go.set()
        waiting = asyncio.create_task(self.paused.wait())
        await asyncio.wait([self.task, waiting], return_when="FIRST_COMPLETED", timeout=10)
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        assert not self.task.done(), self.task
        assert self.paused.is_set()


@dataclass
class Walk:
    """A store with sinks, what was committed, and which operations fail now."""

    folder: Path
    chance: Random
    writer: StoreWriter
    sinks: dict[str, WalkedSink]
    failing: set[str]
    paced: dict[str, Paced] = field(default_factory=dict)
    now: int = 0
    rows: dict[tuple[str, str, int], tuple[int, Any]] = field(default_factory=dict)
    events: dict[tuple[int, int], str] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)

    def begin(self) -> None:
        for name, sink in self.sinks.items():
            paused, go = asyncio.Event(), asyncio.Event()

            async def pause(seconds: float, paused: asyncio.Event = paused, go: asyncio.Event = go) -> None:
                paused.set()
                await go.wait()
                go.clear()

            points = ("pair/a", "pump-1/*") if name == "some" else ("*",)
            options = DeliveryOptions(age=0, most=self.chance.choice((1, 3, 1000)), points=points)
            delivery = Delivery(
                name,
                sink,
                self.folder,
                self.writer.manifest,
                options,
                now=lambda: at(self.now),
                pause=pause,
            )
            self.paced[name] = Paced(delivery, sink, paused, go, asyncio.create_task(delivery.run()))

    def commit(self) -> None:
        self.now += self.chance.choice((0, 1, 1, 2))
        batches = []
        for _ in range(self.chance.choice((1, 1, 2, 6))):
            time = self.now - self.chance.choice((0, 0, 0, 1, 3))
            value = self.chance.choice((1.0, 1.0, 2.0))
            batches.append(read_of(PAIR, time, value, value))
            if self.chance.random() < 0.3:
                batches.append(read_of(PUMP, time, value))
            if self.chance.random() < 0.2:
                batches.append(batches[-1])  # equal in everything
        alarms = []
        for _ in range(self.chance.choice((0, 0, 1, 2))):
            limit = self.chance.choice(("H", "refused"))
            alarms.append(AlarmEvent("pair", "a", limit, AlarmEventKind.RAISED, at(self.now), 1.0))
        made = self.writer.commit(batches, [], at(self.now), alarms)
        self.events |= {(made.number, place): alarm.limit for place, alarm in enumerate(alarms)}
        for batch in batches:
            for point, value in zip(batch.group.points, batch.values, strict=True):
                self.rows[batch.group.device, point, batch.time] = made.number, value

    def empty(self) -> None:
        self.writer.commit([], [], at(self.now))

    def roll(self) -> None:
        self.writer.roll()

    def fail(self) -> None:
        self.failing.symmetric_difference_update([self.chance.choice(("read", "cursor", "aside"))])
        path = self.folder / ASIDE
        if "aside" in self.failing and path.is_dir():
            path.rename(path.with_name("kept"))
            path.write_text("in the way")
        elif "aside" in self.failing and not path.exists():
            path.write_text("in the way")
        elif "aside" not in self.failing and path.is_file():
            path.unlink()
            if path.with_name("kept").exists():
                path.with_name("kept").rename(path)

    def change_sink(self) -> None:
        sink = self.chance.choice(list(self.sinks.values()))
        sink.mode = self.chance.choice(("takes", "takes", "is away", "answer lost", "no connection"))
        sink.left = self.chance.randrange(4)

    async def turn(self) -> None:
        await self.chance.choice(list(self.paced.values())).turn()

    async def end(self) -> None:
        """End the process in order, or at once, at whatever moment; and begin anew."""
        in_order = self.chance.random() < 0.5
        for paced in self.paced.values():
            if self.chance.random() < 0.5:
                paced.go.set()
                for _ in range(self.chance.randrange(6)):
                    await asyncio.sleep(0)
            if in_order:
                await paced.delivery.finish(60.0)
            paced.task.cancel()
        await asyncio.gather(*(each.task for each in self.paced.values()), return_exceptions=True)
        for name, paced in self.paced.items():
            self.counted[name] = self.counted.get(name, 0) + paced.delivery.status().set_aside
            assert not paced.sink.is_open
            saved = self.writer.manifest.cursors()[name][0]
            if not in_order or "cursor" in self.failing or paced.sink.has_failed:
                paced.sink.accepted = {key for key in paced.sink.accepted if key[0] <= saved}
        if in_order:
            self.writer.close(at(self.now))
        else:
            self.writer.__exit__()
        self.writer = StoreWriter(self.folder, StoreOptions(seals=False), now=at(self.now))
        self.begin()

    def check(self) -> None:
        for name, paced in self.paced.items():
            assert paced.sink.again == [], name
            status = paced.delivery.status()
            assert status.lost == 0
            assert self.counted.get(name, 0) + status.set_aside == len(paced.sink.refused)


@pytest.mark.parametrize("seed", SEEDS)
async def test_no_sample_is_lost_or_sent_again_whatever_fails_in_turn(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing: set[str] = set()
    sinks = {"one": WalkedSink(), "two": WalkedSink(), "some": WalkedSink()}
    read, set_cursor = CommitReader.read, Manifest.set_cursor

    def read_or_fail(reader: CommitReader, after: int, most: int) -> Any:
        if "read" in failing:
            raise sqlite3.OperationalError("disk I/O error")
        return read(reader, after, most)

    def set_or_fail(manifest: Manifest, sink: str, *arguments: Any, **named: Any) -> None:
        if "cursor" in failing:
            raise sqlite3.OperationalError("database or disk is full")
        sinks[sink].has_failed = False
        set_cursor(manifest, sink, *arguments, **named)

    monkeypatch.setattr(CommitReader, "read", read_or_fail)
    monkeypatch.setattr(Manifest, "set_cursor", set_or_fail)
    chance = Random(seed)
    writer = StoreWriter(tmp_path, StoreOptions(seals=False), now=at(0))
    walk = Walk(tmp_path, chance, writer, sinks, failing)
    walk.begin()
    steps: list[Callable[[], Any]] = [walk.commit, walk.turn, walk.turn] * 4
    steps += [walk.fail, walk.change_sink] * 2 + [walk.empty, walk.roll, walk.end]
    try:
        for _ in range(STEPS):
            step = chance.choice(steps)
            if step == walk.end and "cursor" in failing:
                failing.discard("cursor")  # a new sink's first cursor must be written
            made = step()
            if made is not None:
                await made
            walk.check()
        while failing:
            walk.fail()
        for sink in sinks.values():
            sink.mode = "takes"
        for name, paced in walk.paced.items():
            for _ in range(1000):
                await paced.turn()
                if paced.delivery.status().cursor == walk.writer.newest_commit:
                    break
            assert walk.writer.manifest.cursors()[name] == (walk.writer.newest_commit, 0)
        walk.check()
        for name, sink in sinks.items():
            check_arrived(walk, name, sink)
    finally:
        for paced in walk.paced.values():
            paced.task.cancel()
        await asyncio.gather(*(each.task for each in walk.paced.values()), return_exceptions=True)
        walk.writer.__exit__()


def check_arrived(walk: Walk, name: str, sink: WalkedSink) -> None:
    """Everything that was not replaced before it was sent is taken with its last value, in order, or is refused."""
    first: dict[tuple[str, str], list[tuple[int, int]]] = {}
    seen: set[Key] = set()
    for sample in sink.taken:
        if key_of(sample) not in seen:
            seen.add(key_of(sample))
            first.setdefault((sample.device, sample.point), []).append((sample.commit, sample.time))
    for places in first.values():
        assert places == sorted(places), name
    values = {key_of(sample): sample.value for sample in sink.taken}
    for (device, point, time), (commit, value) in walk.rows.items():
        wanted = name != "some" or (device, point) in (("pair", "a"), ("pump-1", "speed"))
        key = commit, device, point, time
        assert (key in values) == (wanted and not is_refused(device, point, time)), (name, key)
        assert values.get(key, value) == value
        assert (key in sink.refused) == (wanted and is_refused(device, point, time)), (name, key)
    assert sink.alarms == {place: limit for place, limit in walk.events.items() if limit != "refused"}
    assert {place for place, limit in walk.events.items() if limit == "refused"} <= set(sink.refused)
