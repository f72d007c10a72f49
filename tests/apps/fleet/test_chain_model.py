"""What sinks say that they keep, against a model: collectors, a stream that loses, repeats and reorders, and sinks.

The model knows which samples each sink has, and after each message compares that with what the sink says. At last the
stream loses nothing more, and every sink must come to keep the last commit.
"""

import secrets
import shutil
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from random import Random

import pytest

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet import outbox as outbox_module
from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import MOST_BYTES, SampleMessage, decode_message
from busway.apps.fleet.outbox import AGAIN_AFTER, AGAIN_LIMIT, Outbox, SinkPlace, StreamDown
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.apps.fleet.streams import CURSORS, CursorBook, SinkCursors, SinkProgress

NOW = 1_800_000_000 * 10**9
DEVICES = ("meter", "pump", "fan", "orphan")
ROUNDS = int(4 * AGAIN_LIMIT / AGAIN_AFTER)
SEEDS = 60


class LossyStream:
    """Keeps messages under numbers; takes, refuses, loses, repeats and reorders as chance says."""

    def __init__(self, chance: Random) -> None:
        self.chance = chance
        self.messages: dict[int, SampleMessage | None] = {}
        self.newest = 0
        self.names: dict[str, int] = {}
        self.late: list[SampleMessage] = []
        self.faults: tuple[str, ...] = ()
        self.published = 0

    def publish(self, message: SampleMessage) -> None:
        self.published += 1
        assert decode_message(message.encode()) == message
        fault = self.chance.choice(self.faults) if self.faults and self.chance.random() < 0.3 else ""
        if fault == "refused":
            raise StreamDown(fault)
        if fault == "late":
            self.late.append(message)
            raise StreamDown(fault)
        if fault == "lost":  # acknowledged, and lost; the number is used again, or not
            self.newest += self.chance.randrange(2)
            if self.chance.randrange(2):
                self.names[message.name] = self.newest
            return
        self.store(message, is_readable=fault != "unreadable")
        if fault == "not acknowledged":
            raise StreamDown(fault)

    def store(self, message: SampleMessage, *, is_readable: bool = True) -> None:
        if message.name not in self.names:
            self.newest += 1
            self.messages[self.newest] = message if is_readable else None
            self.names[message.name] = self.newest

    def lose_tail(self, count: int) -> None:
        for _ in range(min(count, self.newest)):
            lost = self.messages.pop(self.newest, None)
            if lost is not None and self.chance.randrange(2):
                self.names.pop(lost.name, None)
            self.newest -= 1

    def drop_head(self, count: int) -> None:
        for sequence in sorted(self.messages)[:count]:
            del self.messages[sequence]

    def drop_one(self) -> None:
        if self.messages:
            del self.messages[self.chance.choice(sorted(self.messages))]

    def repeat(self) -> None:
        if self.messages:
            message = self.messages[self.chance.choice(sorted(self.messages))]
            self.newest += 1
            self.messages[self.newest] = message

    def swap(self) -> None:
        if len(self.messages) > 1:
            one, two = self.chance.sample(sorted(self.messages), 2)
            self.messages[one], self.messages[two] = self.messages[two], self.messages[one]

    def take_late(self) -> None:
        if self.late:
            self.store(self.late.pop(self.chance.randrange(len(self.late))))

    def forget_names(self) -> None:
        self.names = {name: number for name, number in self.names.items() if self.chance.randrange(2)}


class Sender:
    """A collector with a store and an outbox, which sees the cursors of sinks some time later."""

    longest = MOST_BYTES

    def __init__(self, world: "World", folder: Path, name: str) -> None:
        self.world, self.folder, self.name, self.word = world, folder, name, "s" + name
        self.book = CursorBook()
        self.samples: dict[tuple[str, int], int] = {}
        self.links = {"meter": "hall", "pump": "roof", "fan": "roof"}
        self.epochs: dict[str, list[tuple[int, int]]] = {}
        self.revisions: list[int] = []
        self.gaps: list[OwnershipGap] = []
        self.backup: tuple[Path, dict[tuple[str, int], int], list[OwnershipGap]] | None = None
        self.rows = 0
        self.samples_of: dict[int, dict[tuple[str, int], int]] = {}
        """By start, the samples of that life of the store: after a restore commits are not the same."""
        self.writer = StoreWriter(folder, now=NOW)
        self.outbox = self.opened()

    @property
    def key(self) -> str:
        return f"{self.name}/{self.word}"

    @property
    def newest(self) -> int:
        return max((commit for _, commit in self.samples), default=0)

    def opened(self) -> Outbox:
        return Outbox(
            self.writer.folder,
            self.writer.manifest,
            self,
            collector=self.name,
            store=self.word,
            link_of=lambda: self.links,
            shard_of=lambda link: "0000",
            epoch_of=self.epoch_of,
            revision_of=lambda commit: sum(each <= commit for each in self.revisions),
            gaps_of=lambda after, last: [each for each in self.gaps if after < each.commit <= last],
            now=lambda: self.world.time,
        )

    def epoch_of(self, link: str, commit: int) -> Epoch | None:
        found = [epoch for first, epoch in self.epochs.get(link, []) if first <= commit]
        return Epoch(1, found[-1]) if found else None

    async def connected_again(self) -> None:
        pass

    def most_bytes(self) -> int:
        return self.longest

    async def publish(self, message: SampleMessage, shard: str) -> None:
        assert len(message.encode()) <= self.longest
        self.samples_of[message.chain.start] = self.samples
        self.world.stream.publish(message)

    def places(self, collector: str, store: str) -> Mapping[str, SinkPlace]:
        return self.book.places(collector, store)

    def commit(self, chance: Random) -> None:
        self.rows += 1
        now = NOW + self.rows * 10**9
        devices = [each for each in DEVICES if chance.randrange(2)]
        batches = [SampleBatch(PointGroup(each, ("power",)), now, 5, (float(self.rows),)) for each in devices]
        number = self.writer.commit(batches, [], now).number
        self.samples |= {(each, number): now for each in devices}

    def change_epoch(self, chance: Random) -> None:
        link = chance.choice(("hall", "roof", ""))
        epoch = self.world.next_epoch()
        first = self.writer.newest_commit + 1
        self.epochs.setdefault(link, []).append((first, epoch))
        if link and chance.randrange(2):
            devices = DEVICES[: chance.randrange(1, 4)]
            self.gaps.append(OwnershipGap(link, Epoch(1, epoch), first, devices, NOW, NOW + epoch))

    async def step(self) -> bool:
        try:
            return await self.outbox.step()
        except StreamDown:
            return False

    def reopen(self) -> None:
        self.rows += 1
        self.writer.close(NOW + self.rows * 10**9)
        self.writer = StoreWriter(self.folder, now=NOW + self.rows * 10**9)
        self.outbox = self.opened()

    def back_up(self) -> None:
        self.rows += 1
        self.writer.close(NOW + self.rows * 10**9)
        copy = self.folder.with_name(f"{self.folder.name}-{self.rows}")
        shutil.copytree(self.folder, copy)
        self.backup = copy, dict(self.samples), list(self.gaps)
        self.writer = StoreWriter(self.folder, now=NOW + self.rows * 10**9)
        self.outbox = self.opened()

    def restore(self) -> None:
        if self.backup is not None:
            self.rows += 1
            self.writer.close(NOW + self.rows * 10**9)
            shutil.rmtree(self.folder)
            shutil.copytree(self.backup[0], self.folder)
            self.samples, self.gaps = dict(self.backup[1]), list(self.backup[2])
            self.writer = StoreWriter(self.folder, now=NOW + self.rows * 10**9)
            self.outbox = self.opened()
            self.world.show(self)  # the table is read before the first commit


class ModelSink:
    """A durable consumer: its samples, its progress, and what the stream knows of it."""

    def __init__(self, world: "World", name: str) -> None:
        self.world, self.name = world, name
        self.has: set[tuple[str, str, int, int]] = set()
        self.gaps: set[tuple[str, Epoch, str]] = set()
        self.committed = set(self.has), set(self.gaps)
        self.progress = SinkProgress(None)
        self.floor = 0
        self.since: dict[str, int] = {}
        """By sender, the commit that all sinks had when it first saw this one: this one gets what comes after it."""
        self.again: set[int] = set()
        self.revision = 0
        self.write_cursors()

    def take(self, count: int, *, skips: bool) -> None:
        chance, stream = self.world.chance, self.world.stream
        waiting = sorted(each for each in stream.messages if each > self.floor or each in self.again)[:count]
        for sequence in waiting:
            self.again.discard(sequence)
            if skips and chance.random() < 0.1:  # the stream does not give it now
                self.again.add(sequence)
            else:
                self.take_one(sequence, stream.messages[sequence])
            self.floor = max(self.floor, sequence)

    def take_one(self, sequence: int, message: SampleMessage | None) -> None:
        if message is not None and message.gap is not None:
            self.gaps |= {(message.collector, message.gap.epoch, each) for each in message.gap.devices}
        if message is not None:
            self.has |= {(message.collector, each.device, each.commit, each.time) for each in message.samples}
        self.progress.take(sequence, message)
        self.check()

    def check(self) -> None:
        for sender in self.world.senders:
            for place, commit in self.progress.cursors.commits.items():
                if place.startswith(sender.name + "/"):
                    start, _ = self.progress.cursors.proved[place]
                    lacks = self.lacks(sender, sender.samples_of[start], commit)
                    lacks += self.lacks_gaps(sender, commit)
                    assert not lacks, f"{self.name} says {commit} of {place} and lacks {lacks}"
            lacks = self.lacks(sender, sender.samples, sender.outbox.status().kept)
            lacks += self.lacks_gaps(sender, sender.outbox.status().kept)
            assert not lacks, f"{sender.name} believes that {self.name} has {lacks}"

    def lacks(self, sender: Sender, samples: dict[tuple[str, int], int], kept: int) -> list[tuple[str, int]]:
        since = self.since.get(sender.name, sender.outbox.status().kept)
        return [
            (device, commit)
            for (device, commit), time in samples.items()
            if since < commit <= kept and (sender.name, device, commit, time) not in self.has
        ]

    def lacks_gaps(self, sender: Sender, kept: int) -> list[tuple[str, int]]:
        since = self.since.get(sender.name, sender.outbox.status().kept)
        return [
            (device, gap.commit)
            for gap in sender.gaps
            if since < gap.commit <= kept
            for device in gap.devices
            if (sender.name, gap.epoch, device) not in self.gaps
        ]

    def write_cursors(self) -> None:
        self.committed = set(self.has), set(self.gaps)
        self.world.write(CURSORS + self.name, self.progress.cursors)

    def restart(self) -> None:
        """Go on from the cursors in the table; what was taken after them is lost, and comes again if it is there."""
        book = CursorBook()
        for entry in self.world.table.values():
            book.take(entry)
        cursors, _ = book.of(self.name)
        assert cursors is not None
        self.has, self.gaps = set(self.committed[0]), set(self.committed[1])
        self.progress = SinkProgress(cursors)
        self.floor = min(self.floor, cursors.sequence)


class World:
    """Senders, a stream, sinks and the table of cursors, on one clock."""

    def __init__(self, folder: Path, seed: int, steps: int, features: frozenset[str]) -> None:
        self.chance = Random(seed)
        self.folder, self.steps, self.features = folder, steps, features
        self.time = 0.0
        self.epoch = 0
        self.revision = 0
        self.table: dict[str, Entry] = {}
        self.stream = LossyStream(self.chance)
        self.log: list[str] = []
        self.senders: list[Sender] = []
        self.sinks: list[ModelSink] = []

    def next_epoch(self) -> int:
        self.epoch += 1
        return self.epoch

    def write(self, key: str, cursors: SinkCursors) -> None:
        self.revision += 1
        self.table[key] = Entry(key, cursors.encode(), self.revision)

    def show(self, sender: Sender) -> None:
        for sink in self.sinks:
            sink.since.setdefault(sender.name, sender.outbox.status().kept)
        for entry in self.table.values():
            sender.book.take(entry)
        sender.book.end_snapshot()

    async def run(self) -> None:
        chance = self.chance
        try:
            self.senders.extend(
                Sender(self, self.folder / name, name) for name in ("one", "two")[: chance.choice((1, 1, 2))]
            )
            self.sinks.extend(ModelSink(self, name) for name in ("broker", "archive")[: chance.choice((0, 1, 1, 2))])
            if chance.randrange(2):
                await self.go_well()
            kinds = ("refused", "late", "lost", "unreadable", "not acknowledged")
            self.stream.faults = tuple(chance.sample(kinds, chance.randrange(len(kinds) + 1)))
            faults = self.faults()
            chosen = chance.sample(sorted(faults), chance.randrange(1, len(faults) + 1))
            for _ in range(self.steps):
                name = chance.choice(chosen) if chance.random() < 0.25 else ""
                await self.do(name, faults[name] if name else self.usual)
            self.stream.faults = ()
            await self.settle()
        finally:
            for sender in self.senders:
                sender.writer.close(NOW + 10**13)

    async def do(self, name: str, action: Callable[[], object]) -> None:
        self.log.append(name)
        found = action()
        if isinstance(found, Awaitable):
            await found
        for sink in self.sinks:
            sink.check()

    async def usual(self) -> None:
        chance = self.chance
        sender = chance.choice(self.senders)
        kind = chance.randrange(7)
        self.log[-1] = ("commit", "step", "step", "take", "write", "show", "time")[kind] + " " + sender.name
        if kind == 0:
            sender.commit(chance)
        elif kind in (1, 2):
            await sender.step()
        elif kind == 3 and self.sinks:
            chance.choice(self.sinks).take(chance.choice((1, 3, 100)), skips="skips" in self.features)
        elif kind == 4 and self.sinks:
            chance.choice(self.sinks).write_cursors()
        elif kind == 5:
            self.show(sender)
        elif kind == 6:
            self.time += chance.choice((1.0, AGAIN_AFTER, 100.0))

    def faults(self) -> dict[str, Callable[[], object]]:
        chance, stream = self.chance, self.stream

        def lose_tail() -> None:
            stream.lose_tail(chance.choice((1, 2, 5)))
            for sink in self.sinks:
                if chance.randrange(2):
                    sink.floor = min(sink.floor, stream.newest)

        def new_outbox() -> None:
            sender = chance.choice(self.senders)
            sender.outbox = sender.opened()

        def restart_sink() -> None:
            if self.sinks:
                chance.choice(self.sinks).restart()

        def redeliver() -> None:
            if self.sinks and stream.messages:
                chance.choice(self.sinks).again.add(chance.choice(sorted(stream.messages)))

        def new_sink() -> None:
            if len(self.sinks) < 3:
                self.sinks.append(ModelSink(self, f"sink-{len(self.sinks)}"))

        def move_device() -> None:
            chance.choice(self.senders).links[chance.choice(DEVICES[:3])] = chance.choice(("hall", "roof", "shed"))

        def change_revision() -> None:
            sender = chance.choice(self.senders)
            sender.revisions.append(sender.newest + 1)

        found: dict[str, Callable[[], object]] = {
            "lose tail": lose_tail,
            "drop head": lambda: stream.drop_head(chance.choice((1, 3, 100))),
            "drop one": stream.drop_one,
            "take late": stream.take_late,
            "forget names": stream.forget_names,
            "new outbox": new_outbox,
            "restart sink": restart_sink,
            "redeliver": redeliver,
            "new sink": new_sink,
            "move device": move_device,
            "revision": change_revision,
            "epoch": lambda: chance.choice(self.senders).change_epoch(chance),
            "reopen": lambda: chance.choice(self.senders).reopen(),
        }
        if "repeat" in self.features:
            found |= {"repeat": stream.repeat}
        if "swap" in self.features:
            found |= {"swap": stream.swap}
        if "restore" in self.features:
            found |= {
                "back up": lambda: chance.choice(self.senders).back_up(),
                "restore": lambda: chance.choice(self.senders).restore(),
            }
        return found

    async def go_well(self) -> None:
        """Have all sinks keep some commits, as in the life of a zone before the first fault."""
        for _ in range(3):
            for sender in self.senders:
                sender.commit(self.chance)
            await self.round()

    async def settle(self) -> None:
        """Lose nothing more: every sink must keep the last commit after some time, and nothing is sent after that."""
        self.log.append("settle")
        for sender in self.senders:
            sender.commit(self.chance)
        if not self.sinks:
            self.sinks.append(ModelSink(self, "new"))
        for number in range(ROUNDS):
            await self.round()
            if number < 5 and self.chance.randrange(2):
                self.chance.choice(self.senders).commit(self.chance)
            if number >= 5 and self.is_settled():
                break
        else:
            raise AssertionError(
                f"never: {[sink.progress.cursors for sink in self.sinks]} {[each.newest for each in self.senders]}"
            )
        await self.round()
        published = self.stream.published
        for _ in range(3):
            self.time += AGAIN_LIMIT
            await self.round()
        assert self.stream.published == published, "everything is kept, and is sent again"

    def is_settled(self) -> bool:
        return all(
            sink.progress.cursors.commits.get(sender.key, 0) >= sender.newest
            for sink in self.sinks
            for sender in self.senders
        )

    async def round(self) -> None:
        self.time += AGAIN_AFTER
        for sender in self.senders:
            self.show(sender)
            for _ in range(200):
                published = self.stream.published
                if not await sender.step() and self.stream.published == published:
                    break
            else:
                raise AssertionError("it is never through")
        for sink in self.sinks:
            sink.take(10**6, skips=False)
            sink.write_cursors()


FEATURES = ("skips", "repeat", "swap", "restore")


async def run_world(
    folder: Path, seed: int, patch: pytest.MonkeyPatch, features: frozenset[str], steps: int = 60
) -> None:
    chance = Random(f"options {seed}")
    patch.setattr(outbox_module, "MOST", chance.choice((2, 5, 20000)))
    patch.setattr(Sender, "longest", chance.choice((400, 500, MOST_BYTES)))
    rounds = iter(range(10**9))
    patch.setattr(secrets, "randbits", lambda bits: 1000 + next(rounds))
    world = World(folder, seed, steps, features)
    try:
        await world.run()
    except AssertionError as error:
        raise AssertionError(f"{error}\n{', '.join(world.log)}") from error


@pytest.mark.parametrize("seed", range(SEEDS))
async def test_a_sink_keeps_what_it_says_and_comes_to_keep_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    await run_world(tmp_path, seed, monkeypatch, frozenset(FEATURES[: seed % 5]))
