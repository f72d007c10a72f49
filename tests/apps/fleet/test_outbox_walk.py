"""Every stored sample reaches each sink as it was stored, wherever the store, the stream or a sink fails, or all end.

The model is what was committed. It is compared with what sinks get, which is decoded from the bytes of messages. Names
of devices, points, links and units of measure are the same texts, values are equal and of other types, and times are
equal.

`BUSWAY_OUTBOX_SEEDS` has other seeds of the walk; `BUSWAY_OUTBOX_EVERY=1` fails every operation, not one of each kind.
"""

import os
import secrets
import sqlite3
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import TypeVar

import pytest

from busway.apps.collector.samples import PointDescription, PointGroup, Reason, SampleBatch, SampleValue, StateInterval
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.store import committed_samples
from busway.apps.collector.store.committed_samples import CommitReader, CommittedSample
from busway.apps.collector.store.manifest import Manifest
from busway.apps.collector.store.sealing import can_seal
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet import outbox as outbox_module
from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import MOST_BYTES, SampleMessage, decode_message, longest_head, longest_row
from busway.apps.fleet.outbox import AGAIN_AFTER, AGAIN_LIMIT, OUTBOX, Outbox, SinkPlace, StreamDown
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.apps.fleet.streams import CURSORS, CursorBook, SinkProgress, StreamSink

pytest.importorskip("msgpack")

SEEDS = [int(each) for each in os.environ.get("BUSWAY_OUTBOX_SEEDS", "1 2 5").split()]
EVERY = os.environ.get("BUSWAY_OUTBOX_EVERY") == "1"

NOW = 1_800_000_000 * 10**9
LINKS = {"V": "hall", "W": "V", "hall": "hall"}
"""The device `1` has no link."""
UNITS = {
    ("V", "V"): "V", ("V", "W"): "", ("V", "on"): "V", ("W", "V"): "W", ("W", "W"): "V",
    ("hall", "V"): "", ("hall", "on"): "on", ("1", "V"): "1", ("1", "1"): "1",
}  # fmt: skip
NUMBERS: list[SampleValue] = [
    1,
    1.0,
    "1",
    0,
    0.0,
    -0.0,
    "",
    "True",
    2**53,
    float(2**53),
    2**63,
    2**64 - 1,
    float(2**63),
]
VALUES = [*NUMBERS, "V", "hall", str(2**64 - 1), -1, -1.0, "a\u20ac" * 20, float("inf"), -(2**63)]
TOO_LONG = "x" * 3000

STORE = [
    *((CommitReader, each) for each in ("read", "count", "last_before")),
    *((Manifest, each) for each in ("cursors", "set_cursor", "fact", "set_fact", "parts", "points", "renames")),
    *((Manifest, each) for each in ("intervals", "alarms")),
]
PROBLEMS: list[Exception] = [
    sqlite3.OperationalError("database is locked"),
    sqlite3.DatabaseError("database disk image is malformed"),
    OSError(28, "No space left on device"),
    FileNotFoundError("no such segment"),
]
Result = TypeVar("Result")


class Failures:
    """Counts the operations of an outbox, and fails some: before they do anything, or when they have done it."""

    def __init__(self) -> None:
        self.fails: Callable[[int, str], bool] = lambda number, name: False
        self.is_late: Callable[[int], bool] = lambda number: False
        self.number = 0
        self.is_watching = False
        self.names: list[str] = []
        self.log: list[str] = []

    def patch(self, patch: pytest.MonkeyPatch) -> None:
        for owner, name in STORE:
            patch.setattr(owner, name, self.failing(name, getattr(owner, name)))
        opening = committed_samples.open_for_reading
        patch.setattr(committed_samples, "open_for_reading", self.failing("open", opening))

    def failing(self, name: str, original: Callable[..., Result]) -> Callable[..., Result]:
        def call(*arguments: object, **named: object) -> Result:
            problem = self.next(name)
            if problem is not None and not self.is_late(self.number):
                raise problem
            found = original(*arguments, **named)
            if problem is not None:
                raise problem
            return found

        return call

    def next(self, name: str) -> Exception | None:
        if not self.is_watching:
            return None
        self.number += 1
        self.names.append(name)
        if not self.fails(self.number, name):
            return None
        self.log.append(f"{name} fails{' late' if self.is_late(self.number) else ''}")
        return StreamDown("away") if name == "publish" else PROBLEMS[self.number % len(PROBLEMS)]


class Stored:
    """A store and the model of it: of each device, point and time the sample that was committed last."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.second = 0
        self.names = {key: key[1] for key in UNITS}
        self.rows: dict[tuple[str, str, int], CommittedSample] = {}
        self.ever: dict[str, str] = {}
        """Each sample that was ever committed, as text, because `1` and `True` are equal; and its device."""
        self.aside: set[tuple[str, str, int]] = set()
        self.newest = 0
        self.commits: list[int] = []
        self.changed: set[tuple[str, int]] = set()
        """Links and commits that have lost a sample to a later one."""
        self.writer = StoreWriter(folder, now=NOW)
        self.writer.describe_points(
            [PointDescription(device, point, unit, point == "on") for (device, point), unit in UNITS.items()]
        )

    @property
    def now(self) -> int:
        self.second += 1
        return NOW + self.second * 10**9

    def commit(self, reads: Sequence[tuple[str, dict[str, SampleValue], int]]) -> None:
        """Commit reads: device, values by first name of the point, and time."""
        batches = [
            SampleBatch(
                PointGroup(device, tuple(self.names[device, point] for point in values)),
                time,
                time % 7,
                tuple(values.values()),
                tuple(time % 3 + place for place in range(len(values))),
            )
            for device, values, time in reads
        ]
        number = self.newest = self.writer.commit(batches, [], self.now).number
        for batch, (device, values, time) in zip(batches, reads, strict=True):
            for point, value, reason in zip(values, batch.values, batch.reason_column(), strict=True):
                name, unit = self.names[device, point], UNITS[device, point]
                self.add(
                    (device, point, time), CommittedSample(number, device, name, time, time % 7, value, reason, unit)
                )

    def suspend(self, device: str) -> None:
        begin = self.now + 1
        self.newest = self.writer.commit([], [StateInterval(device, begin, None, Reason.SUSPENDED)], self.now).number
        for (owner, point), unit in UNITS.items():
            if owner == device:
                name = self.names[device, point]
                mark = CommittedSample(self.newest, device, name, begin, 0, None, int(Reason.SUSPENDED), unit)
                self.add((device, point, begin), mark)

    def add(self, key: tuple[str, str, int], sample: CommittedSample) -> None:
        if self.commits[-1:] != [sample.commit]:
            self.commits.append(sample.commit)
        if key in self.rows:
            self.changed.add((LINKS.get(sample.device, ""), self.rows[key].commit))
        self.rows[key] = sample
        self.ever[repr(sample)] = sample.device
        self.aside.discard(key)
        if sample.value == TOO_LONG:
            self.aside.add(key)

    def rename(self, device: str, point: str) -> None:
        was, new = self.names[device, point], f"{point}{self.second}"
        unit = UNITS[device, point]
        self.writer.describe_points([PointDescription(device, new, unit, point == "on", was)])
        self.names[device, point] = new

    def reopen(self) -> None:
        self.writer.close(self.now)
        self.writer = StoreWriter(self.folder, now=self.now)
        self.newest = self.writer.newest_commit


class Receiver:
    """A sink of the stream, the progress that it writes, and what it has: by device, point and time the last one."""

    def __init__(self, stream: "Stream", name: str) -> None:
        self.stream, self.name = stream, name
        self.place = 0
        self.has: dict[str, None] = {}
        self.gaps: dict[tuple[str, Epoch, str], None] = {}
        self.last: dict[tuple[str, str, int], str] = {}
        self.progress = SinkProgress(None)
        self.sink = StreamSink(None, None, "zone", name, self)  # type: ignore[arg-type]
        self.is_down = False

    async def open(self) -> None:
        pass

    async def close(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        world = self.stream.world
        for each in samples:
            assert each.revision == world.revision_of(each.commit)
            bare = each._replace(revision=0)
            text = repr(bare)
            assert text in world.stored.ever, f"{self.name} got {text}, which was never stored"
            if text not in self.has:
                self.check_order(bare)
            self.has[text] = None
            self.last[each.device, each.point, each.time] = text
        if self.is_down:
            raise SinkDown("no answer")

    def check_order(self, sample: CommittedSample) -> None:
        lacks = [
            each
            for key, each in self.stream.world.stored.rows.items()
            if each.device == sample.device
            and each.commit < sample.commit
            and key not in self.stream.world.stored.aside
            and repr(each) not in self.has
        ]
        assert not lacks, f"{self.name} got {sample} before {lacks}"

    async def take(self, most: int, *, fails: bool = False) -> None:
        found = self.stream.messages[self.place : self.place + most]
        messages = [decode_message(each) for each in found]
        self.is_down = fails
        try:
            await self.sink._send_all(messages)
        except SinkDown:
            return
        for message in messages:
            self.place += 1
            self.progress.take(self.place, message)

    async def send_gap(self, gap: OwnershipGap) -> list[CommittedSample]:
        assert any(
            (each.link, each.epoch, each.commit, each.begin, each.end)
            == (gap.link, gap.epoch, gap.commit, gap.begin, gap.end)
            for each in self.stream.world.gaps()
        )
        self.gaps |= dict.fromkeys((gap.link, gap.epoch, device) for device in gap.devices)
        return []

    def lacks(self, kept: int) -> list[str]:
        stored = self.stream.world.stored
        return [
            repr(each)
            for key, each in stored.rows.items()
            if each.commit <= kept and key not in stored.aside and repr(each) not in self.has
        ]


class Stream:
    """Keeps the bytes of every message that it gets."""

    def __init__(self, world: "World") -> None:
        self.world = world
        self.messages: list[bytes] = []
        self.names: set[str] = set()
        self.pieces: dict[str, tuple[str, ...]] = {}
        self.acknowledged: set[str] = set()

    async def connected_again(self) -> None:
        pass

    def most_bytes(self) -> int:
        return self.world.longest

    def places(self, collector: str, store: str) -> Mapping[str, SinkPlace]:
        return self.world.book.places(collector, store)

    async def publish(self, message: SampleMessage, shard: str) -> None:
        world = self.world
        assert shard == world.shard_of(message.link)
        assert message.name not in self.names
        self.names.add(message.name)
        assert message.kept <= world.saved(), "what was not saved counts"
        lacks = {
            repr(each)
            for key, each in world.stored.rows.items()
            if world.saved() < each.commit <= message.complete and key not in world.stored.aside
        } - self.acknowledged
        assert not lacks, f"said to be complete up to {message.complete}, without {lacks}"
        problem = world.failures.next("publish")
        if problem is not None and not world.failures.is_late(world.failures.number):
            raise problem
        data = message.encode()
        known = set[str]()
        devices = () if message.gap is None else message.gap.devices
        bound = longest_head("hall", "V", message.link, *devices)
        bound += sum(longest_row(each, known) for each in message.samples)
        assert len(data) <= bound <= world.longest
        self.check(message, decode_message(data))
        self.messages.append(data)
        if problem is not None:
            raise problem
        self.acknowledged |= {repr(each) for each in message.samples}

    def check(self, message: SampleMessage, found: SampleMessage) -> None:
        assert repr(found) == repr(message)
        assert {LINKS.get(each.device, "") for each in found.samples} <= {found.link}
        for each in found.samples:
            assert found.epoch == self.world.epoch_of(found.link, each.commit)
            assert found.revision == self.world.revision_of(each.commit)
        for commit in {each.commit for each in found.samples}:
            piece = tuple(repr(each) for each in found.samples if each.commit == commit)
            if (found.link, commit) not in self.world.stored.changed:
                for text in piece:
                    assert self.pieces.setdefault(text, piece) == piece, "the commit is cut at another place"


class World:
    """A store, its outbox, a stream and two sinks, on one clock."""

    def __init__(self, stored: Stored, failures: Failures, longest: int) -> None:
        self.stored, self.failures, self.longest = stored, failures, longest
        self.time = 0.0
        self.revision = 0
        self.book = CursorBook()
        self.stream = Stream(self)
        self.receivers = [Receiver(self.stream, name) for name in ("V", "hall")]
        self.outbox: Outbox | None = None
        self.log = failures.log
        self.show()

    def shard_of(self, link: str) -> str:
        return f"shard of {link}" if link else "none"

    def epoch_of(self, link: str, commit: int) -> Epoch | None:
        return Epoch(1, commit // 4 + len(link)) if link else None

    def revision_of(self, commit: int) -> int:
        return commit // 3

    def gaps(self) -> list[OwnershipGap]:
        return [
            OwnershipGap(link, Epoch(1, commit // 4 + len(link)), commit, (link, *LINKS, "a name" * 9), commit, NOW)
            for commit in self.stored.commits
            if commit % 8 == 0
            for link in ("V", "hall")
        ]

    def saved(self) -> int:
        was, self.failures.is_watching = self.failures.is_watching, False
        found = self.stored.writer.manifest.cursors().get(OUTBOX, (0, 0))[0]
        self.failures.is_watching = was
        return found

    async def step(self) -> bool:
        """Begin if there is no outbox, and send a batch; False if that failed, or there is no more."""
        self.failures.is_watching = True
        try:
            if self.outbox is None:
                self.outbox = self.opened()
            return await self.outbox.step()
        except StreamDown:
            return False
        except (sqlite3.Error, OSError) as error:
            if error not in PROBLEMS:
                raise
            return False
        finally:
            self.failures.is_watching = False
            self.check()

    def opened(self) -> Outbox:
        return Outbox(
            self.stored.writer.folder,
            self.stored.writer.manifest,
            self.stream,
            collector="hall",
            store="V",
            link_of=lambda: LINKS,
            shard_of=self.shard_of,
            epoch_of=self.epoch_of,
            revision_of=self.revision_of,
            gaps_of=lambda after, last: [each for each in self.gaps() if after < each.commit <= last],
            now=lambda: self.time,
        )

    def show(self) -> None:
        self.revision += 1
        for each in self.receivers:
            self.book.take(Entry(CURSORS + each.name, each.progress.cursors.encode(), self.revision))
        self.book.end_snapshot()

    def check(self) -> None:
        saved = self.saved()
        kept = 0 if self.outbox is None else self.outbox.status().kept
        assert kept <= saved, "the cursor was moved before it was saved"
        for each in self.receivers:
            assert not each.lacks(saved), f"the cursor is at {saved}, and {each.name} lacks {each.lacks(saved)}"
            for place, commit in each.progress.cursors.commits.items():
                assert place == "hall/V"
                assert not each.lacks(commit), f"{each.name} says that it has {commit}, and lacks {each.lacks(commit)}"

    async def settle(self) -> None:
        """With nothing failing any more, all sinks come to have everything, and the cursor to be there."""
        self.failures.fails = lambda number, name: False
        for _ in range(int(4 * AGAIN_LIMIT / AGAIN_AFTER)):
            while await self.step():
                pass
            for each in self.receivers:
                await each.take(10**6)
            self.show()
            self.time += AGAIN_AFTER
            if self.saved() >= self.stored.newest:
                break
        else:
            raise AssertionError(f"never: {self.saved()} of {self.stored.newest}")
        await self.step()
        wanted = {(each.device, each.point, each.time): repr(each) for each in self.latest()}
        for receiver in self.receivers:
            assert {key: receiver.last[key] for key in wanted} == wanted
            for gap in self.gaps():
                assert all((gap.link, gap.epoch, each) in receiver.gaps for each in gap.devices)
        assert self.outbox is not None
        assert self.outbox.status().kept == self.saved()

    def latest(self) -> list[CommittedSample]:
        return [each for key, each in self.stored.rows.items() if key not in self.stored.aside]


def values_for(chance: Random, device: str) -> dict[str, SampleValue]:
    points = [point for owner, point in UNITS if owner == device]
    chosen = chance.sample(points, chance.randrange(1, len(points) + 1))
    return {each: chance.choice((True, False)) if each == "on" else chance.choice(VALUES) for each in chosen}


def filled(folder: Path) -> Stored:
    """A store with a sealed, a closed and an open segment, and all the cases of the model."""
    stored, chance = Stored(folder), Random(1)
    for number in range(12):
        time = stored.now
        reads = [(device, values_for(chance, device), time - number % 2 * 10**9) for device in ("V", "W", "hall", "1")]
        if number == 3:
            reads += reads[:1]  # equal in everything
        if number == 5:
            reads += [("V", {"V": value}, time + 1 + place) for place, value in enumerate(VALUES)]
        if number == 7:
            reads += [("V", {"W": TOO_LONG}, time + 1), ("V", {"W": "short"}, time + 2)]
        stored.commit(reads)
        if number == 4:
            stored.suspend("V")
            stored.writer.roll()
            if can_seal():
                stored.writer.seal_closed()
        if number == 8:
            stored.writer.roll()
    return stored


WAYS = [(is_late, restarts) for is_late in (False, True) for restarts in (False, True)]


async def test_whatever_operation_fails_all_samples_reach_all_sinks_as_they_were_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Once or several times, done or not done; then the outbox goes on, or another one begins."""
    monkeypatch.setattr(outbox_module, "MOST", 30)
    failures = Failures()
    failures.patch(monkeypatch)
    stored = filled(tmp_path)
    try:
        await fail(stored, failures, range(0), is_late=False, restarts=False)
        places: dict[str, list[int]] = {}
        for number, name in enumerate(failures.names, 1):
            places.setdefault(name, []).append(number)
        for name, numbers in places.items():
            for number in numbers if EVERY else numbers[len(numbers) // 2 :][:1]:
                for is_late, restarts in WAYS if EVERY or name == "set_cursor" else [WAYS[number % len(WAYS)]]:
                    failing = range(number, number + (1, 3, 40)[number % 3])
                    await fail(stored, failures, failing, is_late=is_late, restarts=restarts)
    finally:
        stored.writer.close(stored.now)


async def fail(stored: Stored, failures: Failures, failing: range, *, is_late: bool, restarts: bool) -> None:
    """Send the whole store anew, while the operations with these numbers fail."""
    stored.writer.manifest.set_cursor(OUTBOX, 0, 0)
    failures.number = 0
    failures.names.clear()
    failures.log.clear()
    failures.fails = lambda number, name: number in failing
    failures.is_late = lambda number: is_late
    world = World(stored, failures, 1100)
    try:
        for _ in range(50):
            more = True
            while more:
                failed = len(failures.log)
                more = await world.step()
                if restarts and len(failures.log) > failed:
                    world.outbox = None
            for each in world.receivers:
                await each.take(10**6)
            world.show()
            if world.saved() >= stored.newest:
                break
        await world.settle()
    except AssertionError as error:
        raise AssertionError(f"{error}\n{failing}, {is_late=}, {restarts=}: {', '.join(failures.log)}") from error


class Walk:
    """Commits, failures and restarts in an order that chance says."""

    def __init__(self, folder: Path, seed: int, failures: Failures) -> None:
        self.chance = Random(seed)
        self.failures = failures
        self.world = World(Stored(folder), failures, self.chance.choice((900, 1300, 2500, MOST_BYTES - 1)))
        self.stored = self.world.stored
        if self.world.longest > 2500:
            self.stored.aside = NeverAside()
        self.rate = self.chance.choice((0.0, 0.02, 0.1, 0.3))
        failures.fails = lambda number, name: self.chance.random() < self.rate
        failures.is_late = lambda number: bool(number * 2654435761 >> 7 & 1)

    def commit(self) -> None:
        chance, now = self.chance, self.stored.now
        reads = []
        for _ in range(chance.randrange(1, 5)):
            device = chance.choice(("V", "W", "hall", "1"))
            values = values_for(chance, device)
            if "W" in values and chance.random() < 0.1:
                values["W"] = TOO_LONG
            reads.append((device, values, now - chance.choice((0, 0, 1, 10**9, 2 * 10**9))))
        self.stored.commit(reads)

    def commit_fails(self) -> None:
        self.commit()
        self.stored.writer.limit_pages(1)
        batch = SampleBatch(PointGroup("1", (self.stored.names["1", "1"],)), self.stored.now, 0, ("y" * 10**6,))
        with pytest.raises(sqlite3.OperationalError, match="full"):
            self.stored.writer.commit([batch], [], self.stored.now)
        self.stored.writer.limit_pages(10**6)

    async def step(self) -> None:
        await self.world.step()

    async def take(self) -> None:
        chance = self.chance
        receiver = chance.choice(self.world.receivers)
        await receiver.take(chance.choice((1, 3, 100)), fails=chance.random() < 0.3)

    def end(self) -> None:
        self.world.outbox = None

    def roll(self) -> None:
        self.stored.writer.roll()

    def seal(self) -> None:
        if can_seal():
            self.stored.writer.seal_closed()

    def rename(self) -> None:
        self.stored.rename(*self.chance.choice(sorted(UNITS)))

    def suspend(self) -> None:
        self.stored.suspend(self.chance.choice(("V", "W", "hall", "1")))

    def reopen(self) -> None:
        self.world.outbox = None
        self.stored.reopen()

    def wait(self) -> None:
        self.world.time += self.chance.choice((1.0, AGAIN_AFTER, AGAIN_LIMIT))

    async def run(self, steps: int) -> None:
        often = (self.commit, self.step, self.step, self.take, self.take, self.world.show)
        seldom = (self.end, self.roll, self.seal, self.rename, self.suspend, self.reopen, self.wait, self.commit_fails)
        for _ in range(steps):
            action: Callable[[], object] = self.chance.choice(seldom if self.chance.random() < 0.15 else often)
            self.failures.log.append(action.__name__)
            found = action()
            if isinstance(found, Awaitable):
                await found
            self.world.check()
        self.commit()
        await self.world.settle()


class NeverAside(set[tuple[str, str, int]]):
    """Stays empty: no sample is too long."""

    def add(self, key: tuple[str, str, int]) -> None:
        pass


@pytest.mark.parametrize("seed", SEEDS)
async def test_all_samples_reach_all_sinks_as_they_were_stored_in_a_walk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.setattr(outbox_module, "MOST", Random(seed).choice((2, 10, 20_000)))
    starts = iter(range(1000, 10**9))
    monkeypatch.setattr(secrets, "randbits", lambda bits: next(starts))
    failures = Failures()
    failures.patch(monkeypatch)
    walk = Walk(tmp_path, seed, failures)
    try:
        await walk.run(80)
    except AssertionError as error:
        raise AssertionError(f"{error}\n{', '.join(failures.log)}") from error
    finally:
        walk.stored.writer.close(walk.stored.now)
