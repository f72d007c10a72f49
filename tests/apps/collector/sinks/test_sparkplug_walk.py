"""A Sparkplug sink against a host application that is a model of the standard: seeded walks over everything it meets.

1. Devices are read, fail, are suspended and come back; points change type and names; devices are added, they and points
   removed; alarms come.
2. Meanwhile the broker goes away, or loses what was on its way; the primary host leaves, comes back, does both at
   once; hosts ask for births; the collector starts again; the clock stands still (a sample as old as a birth).
3. The model refuses what breaks a rule at once. Whenever everything is delivered, it has each sample in order, none
   twice by one connection, and shows each device and metric as the store has it, and none that was removed.
"""

import asyncio
import json
import os
import random
from collections import defaultdict
from pathlib import Path

import pytest
from sparkplug_broker import SparkplugBroker
from sparkplug_host import SparkplugHost, Told

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import (
    PointDescription,
    PointGroup,
    Quality,
    Reason,
    SampleBatch,
    SampleValue,
    StateInterval,
    reason_text,
)
from busway.apps.collector.sinks import sparkplug
from busway.apps.collector.sinks.delivery import Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.sparkplug_payload import DataType, Metric, encode_payload
from busway.apps.collector.store.committed_samples import CommitReader, CommittedSample
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule

pytest.importorskip("aiomqtt")
pytest.importorskip("google.protobuf")
SEEDS = [int(each) for each in os.environ.get("BUSWAY_SPARKPLUG_SEEDS", "1 2 3 4").split()]
STEPS = int(os.environ.get("BUSWAY_SPARKPLUG_STEPS", "120"))
MS = 1_000_000
NOON = 1_800_000_000_000 * MS
NEW = ("new0", "new1", "new2")
RULES = {(name, "slow"): ReportRule("change") for name in ("one", "two", *NEW)}
POINTS = ("count", "level", "run", "mode", "slow")
GONE = (Reason.SUSPENDED, Reason.MAINTENANCE)
QUALITIES = {Quality.GOOD: 192, Quality.UNCERTAIN: 500, Quality.BAD: 0}
STATE = "spBv1.0/STATE/scada"


class SparkplugWalk:
    """One walk: the store, the sink, the broker, and the host that judges."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.chance = folder, random.Random(seed)
        self.clock = NOON
        self.host = SparkplugHost()
        self.broker = SparkplugBroker(self.host.take)
        self.writer = StoreWriter(folder / "store", now=self.clock)
        self.names = {device: list(POINTS) for device in ("one", "two")}
        self.suspended: dict[str, StateInterval] = {}
        self.has_primary = self.chance.random() < 0.5
        self.events: list[str] = []
        self.done: list[str] = []
        self.began = 0
        self.added: dict[str, int] = {}
        self.is_disturbed = False
        self.describe()
        self.connect()
        if self.has_primary:
            self.say_state(online=True)

    def connect(self) -> None:
        """A sink of a collector that begins."""
        self.sink = sparkplug.SparkplugSink(
            "broker",
            group="plant",
            edge_node="hall",
            primary_host="scada" if self.has_primary else None,
            number_file=self.folder / "number.json",
            timeout=0.05 if self.has_primary else 10.0,
            now=lambda: self.clock,
        )
        self.delivery = Delivery(
            "scada",
            self.sink,
            self.writer.folder,
            self.writer.manifest,
            DeliveryOptions(age=0, most=self.chance.choice((3, 20))),
            point_rules=RULES,
            points=self.keys(),
            now=lambda: self.clock,
        )

    def keys(self) -> set[tuple[str, str]]:
        """The points of the configuration."""
        return {(device, name) for device, names in self.names.items() for name in names}

    def describe(self, moved: dict[tuple[str, str], str] | None = None) -> None:
        was = moved or {}
        self.writer.describe_points(
            PointDescription(device, name, "V", was=was.get((device, name)))
            for device, names in self.names.items()
            for name in names
        )
        if hasattr(self, "delivery"):
            self.delivery.set_points(self.keys(), RULES)

    # Deeds.

    def value(self, point: str) -> SampleValue:
        choices: dict[str, tuple[SampleValue, ...]] = {
            "count": (1, -7, 2**60 + 1, 2**63 + 5, 0),
            "level": (230.5, -0.1, 7),
            "run": (True, False),
            "mode": ("runs", "off", 17),
            "slow": (1, 2),
        }
        return self.chance.choice(choices.get(point, (1, 2, 2.5)))

    async def read(self, device: str | None = None, *, whole: bool = False) -> None:
        """A read of a device, with values that are not good among them; also of a part of its points."""
        self.clock += self.chance.choice((1, 250, 1000)) * MS
        name = device or self.chance.choice(list(self.names))
        intervals = []
        if name in self.suspended:
            begun = self.suspended.pop(name)
            intervals.append(StateInterval(name, begun.begin, self.clock, begun.reason))
        points = [each for each in self.names[name] if whole or self.chance.random() < 0.8] or self.names[name][:1]
        reasons = [self.chance.choice((0, 0, 0, int(Reason.TIMEOUT), int(Reason.OUT_OF_RANGE))) for _ in points]
        values = [
            None if reason == Reason.TIMEOUT else self.value(point)
            for point, reason in zip(points, reasons, strict=True)
        ]
        batch = SampleBatch(PointGroup(name, tuple(points)), self.clock, 0, tuple(values), tuple(reasons))
        self.writer.commit([batch], intervals, self.clock)

    async def reads(self) -> None:
        for _ in range(self.chance.randrange(2, 9)):
            await self.read()

    async def suspend(self) -> None:
        self.clock += 5 * MS
        name = self.chance.choice(list(self.names))
        if name not in self.suspended:
            self.suspended[name] = StateInterval(name, self.clock, None, self.chance.choice(GONE))
            self.writer.commit([], [self.suspended[name]], self.clock)

    async def alarm(self) -> None:
        self.clock += 5 * MS
        text = f"event {len(self.events)}"
        self.events.append(text)
        event = AlarmEvent("one", self.names["one"][1], "H", AlarmEventKind.RAISED, self.clock, 250.0, "", True, text)
        self.writer.commit([], [], self.clock, [event])

    async def exchange(self) -> None:
        """Two points of a device exchange their names, and so what they say has another type."""
        name = self.chance.choice(list(self.names))
        names = self.names[name]
        one, other = self.chance.sample(range(len(names)), 2)
        names[one], names[other] = names[other], names[one]
        self.describe({(name, names[one]): names[other], (name, names[other]): names[one]})
        await self.read(name)

    async def add(self) -> None:
        name = next((each for each in NEW if each not in self.names), None)
        if name is not None:
            self.names[name] = list(POINTS)
            self.added[name] = self.clock
            self.describe()
            await self.read(name)

    async def remove(self) -> None:
        """A file that is read again has a device less, or a point less of a device."""
        name = self.chance.choice(list(self.names))
        begun = self.suspended.pop(name, None)
        if begun is not None:
            self.clock += MS
            self.writer.commit([], [StateInterval(name, begun.begin, self.clock, begun.reason)], self.clock)
        if name in NEW and self.chance.random() < 0.5:
            del self.names[name]
        elif len(self.names[name]) > 3:
            del self.names[name][self.chance.randrange(2, len(self.names[name]))]
        self.describe()

    async def go_away(self) -> None:
        self.broker.is_down = True
        self.broker.lose()

    async def come_back(self) -> None:
        self.broker.is_down = False

    async def lose(self) -> None:
        self.broker.lose()

    async def lose_soon(self) -> None:
        self.broker.loses_after = self.chance.randrange(0, 12)

    def say_state(self, *, online: bool) -> None:
        self.clock += self.chance.choice((0, 1)) * MS
        content = json.dumps({"online": online, "timestamp": self.clock // MS}).encode()
        self.broker.say(STATE, content, retain=True)

    async def host_leaves(self) -> None:
        if self.has_primary:
            self.say_state(online=False)
            await turns()
            self.host.may_speak = False

    async def host_returns(self) -> None:
        if self.has_primary:
            self.host.may_speak = True
            self.say_state(online=True)
            await turns()

    async def host_blinks(self) -> None:
        """The host is restarted between two messages: it knows nothing of before."""
        if self.has_primary and self.host.may_speak:
            await self.host_leaves()
            births = self.host.births
            await self.host_returns()
            await self.read()
            await self.settle()
            if self.is_well:
                assert self.host.births > births, "the host has nothing from before it left"

    async def ask(self) -> None:
        """A host asks for the births: it gets them within a turn, if the node is there."""
        births = self.host.births
        was_born = self.host.is_online and self.host.may_speak
        wanted = [Metric("Node Control/Rebirth", self.clock, DataType.BOOLEAN, True)]
        for _ in range(self.chance.choice((1, 3))):
            self.broker.say("spBv1.0/plant/NCMD/hall", encode_payload(wanted, self.clock, None))
        await turns()
        if was_born and self.host.is_online:
            assert self.host.births > births

    async def restart(self) -> None:
        """A collector that begins reads all points; the sink knows those that are handed on when they change then."""
        await self.sink.close()
        self.connect()
        self.began = self.clock
        for device in self.names:
            if device not in self.suspended:
                await self.read(device, whole=True)

    async def deliver(self) -> None:
        await self.settle()

    # What is so.

    @property
    def is_well(self) -> bool:
        return self.host.may_speak and not self.broker.is_down and self.broker.loses_after is None

    async def settle(self) -> None:
        """Deliver until all is delivered, or nothing goes."""
        for _ in range(1000):
            try:
                if not await self.delivery.step():
                    break
            except SinkDown as error:
                if not self.is_disturbed:
                    raise
                await self.delivery._down(error)
                if self.broker.is_down or not self.host.may_speak:
                    break
        await turns()
        if self.is_well and self.host.is_online:
            self.is_disturbed = False

    def stored(self) -> list[CommittedSample]:
        found = CommitReader(self.writer.folder, self.writer.manifest).read(0, 10**9)
        return [] if found is None else found.samples

    def check(self) -> None:
        """Compare what the host has with what the store has."""
        wanted: dict[tuple[str, str], list[CommittedSample]] = defaultdict(list)
        lives: dict[str, bool] = {}
        for sample in self.stored():
            wanted[sample.device, sample.point].append(sample)
            lives[sample.device] = sample.reason not in GONE
        told: dict[tuple[str, str], list[tuple[int, Told]]] = defaultdict(list)
        for connection, device, metric in self.host.data:
            told[device, metric.name].append((connection, metric))
        for key, samples in wanted.items():
            self.check_data(samples, told[key], is_whole="slow" not in key[1])
        keys = self.keys()
        shown_devices = {device for device, is_there in lives.items() if is_there and device in self.names}
        assert set(self.host.current) == shown_devices
        assert {(device, point) for device, points in self.host.current.items() for point in points} <= keys
        for (device, point), samples in wanted.items():
            if lives[device] and (device, point) in keys:
                shown = self.host.current[device].get(point)
                if shown is None and samples[-1].time <= self.added.get(device, 0):
                    continue  # of an earlier device of this name
                if shown is None and self.began and samples[-1].time <= self.began and point != "slow":
                    continue  # no sample of it was handed on since the collector began
                assert shown is not None, f"{device}/{point} is not shown"
                assert_shows(shown, samples[-1])
                assert shown.unit == "V" or shown in [each for _, each in told[device, point]]
        events = [(connection, json.loads(str(each.value))["text"]) for connection, each in self.host.events]
        assert len(set(events)) == len(events), "an event came twice by one connection"
        assert list(dict.fromkeys(text for _, text in events)) == self.events

    def check_data(self, samples: list[CommittedSample], told: list[tuple[int, Told]], *, is_whole: bool) -> None:
        by_time = {sample.time // MS: sample for sample in samples if sample.reason not in GONE}
        for connection, metric in told:
            sample = by_time[metric.time]
            assert_shows(metric, sample)
            assert metric.is_historical is (sample.time // MS < self.host.began[connection - 1])
        keys = [(connection, metric.time) for connection, metric in told]
        assert len(set(keys)) == len(keys), "a sample came twice by one connection"
        times = list(dict.fromkeys(time for _, time in keys))
        assert times == sorted(times)
        if is_whole:
            assert times == list(by_time), "a sample is lost"

    async def run(self) -> None:
        deeds = [self.read, self.reads, self.reads, self.suspend, self.alarm, self.exchange, self.add, self.go_away]
        deeds += [self.remove]
        deeds += [self.come_back] * 3 + [self.lose, self.lose_soon, self.host_leaves, self.host_blinks, self.ask]
        deeds += [self.host_returns] * 2 + [self.restart] + [self.deliver] * 8
        for _ in range(STEPS):
            deed = self.chance.choice(deeds)
            self.done.append(deed.__name__)
            if deed.__name__ in ("go_away", "lose", "lose_soon", "host_leaves", "host_blinks"):
                self.is_disturbed = True
            await deed()
            if deed == self.deliver and self.is_well:
                self.check()
        await self.come_back()
        await self.host_returns()
        self.broker.loses_after = None
        await self.read()
        await self.settle()
        self.check()


def assert_shows(metric: Told, sample: CommittedSample) -> None:
    assert (metric.value, metric.quality) == (sample.value, QUALITIES[sample.quality]), (metric, sample)
    assert metric.reason == reason_text(sample.reason)
    if sample.value is not None:
        assert isinstance(sample.value, bool) is (metric.kind is DataType.BOOLEAN)
        assert isinstance(sample.value, str) is (metric.kind is DataType.STRING)


async def turns() -> None:
    """Run all tasks until each of them waits."""
    for _ in range(100):
        await asyncio.sleep(0)


@pytest.mark.parametrize("seed", SEEDS)
async def test_a_host_has_what_the_store_has_whatever_happens(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sparkplug, "REBIRTH_PAUSE", 0.0)
    walk = SparkplugWalk(tmp_path, seed)
    monkeypatch.setattr("aiomqtt.Client", walk.broker.client)
    try:
        await walk.run()
    finally:
        print(walk.done)  # shown where the test fails
        await walk.sink.close()
        walk.writer.close(walk.clock)
