"""Alarms of a whole collector against a model written from their documentation: seeded walks in virtual time.

1. Devices say values at their limits, a step beside them, and at the end of the hysteresis; delays end with a sample.
2. Meanwhile devices refuse, fall silent and are maintained; the clock is set; people acknowledge, also while a read is
   under way and right after its sample; files are read again with other limits and names; collectors end and are
   killed.
3. The model gets the samples as the store told them, and the deeds between them. After each step what is active, and in
   the end the whole journal, is what the model says.
"""

import asyncio
import itertools
import os
import random
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
from alarm_oracle import NUMERIC, AlarmOracle, Key, Limit, Told
from virtual_plant import VirtualDevice, VirtualPlant, run_virtually

import busway
from busway.apps.collector.alarms.events import AlarmEvent
from busway.apps.collector.configuration import load_collector
from busway.apps.collector.samples import Quality
from busway.apps.collector.store.writer import Commit
from busway.errors import InvalidRequest

SEEDS = [int(each) for each in os.environ.get("BUSWAY_ALARM_SEEDS", "2 3 4 26").split()]
STEPS = int(os.environ.get("BUSWAY_ALARM_STEPS", "150"))
PERIOD = Decimal("0.5")
NS = 1_000_000_000
TENTH = Decimal("0.1")

Identity = tuple[str, int]
"""A device, and the number of a point in `FORMS`."""


@dataclass(frozen=True, slots=True)
class Form:
    """What a point is, and how its device is made to say a value."""

    name: str
    text: str
    numeric: bool = True
    states: dict[str, int] = field(default_factory=dict)
    bits: bool = False
    is_bit: bool = False


FORMS = (
    Form("tenths", 'address = "4x1", type = "int16", scale = 0.1, valid = [-9.0, 9.0], invalid = [0x8000]'),
    Form("float", 'address = "4x3", type = "float32"'),
    Form("long", 'address = "4x5", type = "int64", scale = 0.1'),
    Form("mode", 'address = "4x9", enumeration = { off = 0, runs = 1, fault = 2 }', False, {"off": 0, "fault": 2}),
    Form("flags", 'address = "4x10", flags = { overload = 0, door = 5 }', False, {"overload": 0, "door": 5}, True),
    Form("bit", 'address = "4x11.3"', False, is_bit=True),
    Form("coil", 'address = "1x7"', False, is_bit=True),
    Form("twice", "formula = 'FLOAT * 2'"),
)


DEVICES = {"one": ("tcp://127.0.0.1:1", 1), "two": ("tcp://127.0.0.1:1", 2), "three": ("tcp://127.0.0.1:2", 1)}
"""Where each device is: the endpoint of its link, and its unit."""


@dataclass(slots=True)
class Point:
    """A point as the file of the moment has it."""

    name: str
    was: str = ""
    limits: tuple[Limit, ...] = ()
    is_there: bool = True


def nothing(device: VirtualDevice) -> None:
    """A device that answers as usual."""


class AlarmWalk:
    """One walk: the plant, its files, the model, and what was told."""

    def __init__(self, plant: VirtualPlant, seed: int) -> None:
        self.plant, self.chance = plant, random.Random(seed)
        self.oracle = AlarmOracle()
        self.points: dict[str, list[Point]] = {device: [Point(form.name) for form in FORMS] for device in DEVICES}
        self.there = dict.fromkeys(DEVICES, True)
        self.devices: dict[str, VirtualDevice] = {name: plant.device(*place) for name, place in DEVICES.items()}
        for device in self.devices.values():
            device.takes = self.chance.choice((0.0, 0.125))
        for name in DEVICES:
            for number, form in enumerate(FORMS):
                self.points[name][number].limits = self._some_limits(form)
        self.version = 0
        self.collector: busway.Collector
        self.commits: list[Commit] = []
        self.deeds: list[tuple[int, Callable[[], object]]] = []
        self.names = {device: {form.name: n for n, form in enumerate(FORMS)} for device in DEVICES}
        self.monotonic: dict[int, int] = {}
        plant.transaction = self._transaction
        self.done: list[str] = []
        self.answers: list[tuple[Key, list[bool]]] = []
        self._seen = 0
        self._tasks: list[asyncio.Task[Any]] = []

    # Files.

    def _some_limits(self, form: Form) -> tuple[Limit, ...]:
        delay = self.chance.choice((0, 0, PERIOD, 2 * PERIOD, Decimal("0.7")))
        must = self.chance.random() < 0.6
        if not form.numeric:
            states = (1,) if form.is_bit else tuple(form.states.values())[: self.chance.choice((1, 2))]
            limit = Limit("state", delay=Decimal(delay), acknowledge=must, states=states, bits=form.bits)
            return (limit,) if self.chance.random() < 0.8 else ()
        limits = []
        for kind in NUMERIC:
            if self.chance.random() < 0.6:
                side = 1 if kind[0] == "H" else -1
                at = side * TENTH * self.chance.randrange(1, 60)
                back = TENTH * self.chance.choice((0, 0, 1, 2, 3, 10))
                limits.append(
                    Limit(kind, at, Decimal(self.chance.choice((delay, 0))), back, self.chance.random() < 0.6)
                )
        return tuple(limits)

    def _alarm_text(self, form: Form, limit: Limit) -> str:
        words = [f'kind = "{limit.kind}"', f"delay = {limit.delay}", f"acknowledge = {str(limit.acknowledge).lower()}"]
        if limit.kind == "state":
            names = {number: f'"{name}"' for name, number in form.states.items()} or {1: "true"}
            words.append(f"states = [{', '.join(names[each] for each in limit.states)}]")
        else:
            words += [f"limit = {limit.limit}", f"hysteresis = {limit.hysteresis}"]
        return "{ " + ", ".join(words) + " }"

    def write(self) -> None:
        """The files as they are wanted now."""
        files, devices = {}, ""
        for device, points in self.points.items():
            lines = []
            for form, point in zip(FORMS, points, strict=True):
                if point.is_there:
                    alarms = ", ".join(self._alarm_text(form, limit) for limit in point.limits)
                    was = f', was = "{point.was}"' if point.was else ""
                    text = form.text.replace("FLOAT", points[1].name)
                    lines.append(f'{{ name = "{point.name}", {text}{was}, alarm = [{alarms}] }}')
            body = ",\n    ".join(lines)
            files[device] = f"[[unit]]\nunit = 1\nread = {{ bridge = true }}\npoint = [\n    {body}\n]\n"
            url, unit = DEVICES[device]
            if self.there[device]:
                devices += (
                    f'[[device]]\nname = "{device}"\nlink = "{url[-1]}"\nunit = {unit}\nprofile = "{device}.toml"\n'
                )
        links = "".join(f'[[link]]\nname = "{n}"\nurl = "tcp://127.0.0.1:{n}"\n' for n in (1, 2))
        head = f'[collector]\nstore = "data"\n[poll_class]\nall.period = {PERIOD}\n'
        self.plant.write(**files, plant=head + links + devices)

    def limits(self) -> dict[object, tuple[Limit, ...]]:
        """What the files say, by identity."""
        return {
            (device, number): point.limits
            for device, points in self.points.items()
            if self.there[device]
            for number, point in enumerate(points)
            if point.is_there
        }

    def change_file(self) -> None:
        """Change one thing of the files."""
        device = self.chance.choice(list(DEVICES))
        points = self.points[device]
        for each in points:
            each.was = "" if self.chance.random() < 0.3 else each.was
        number = self.chance.randrange(len(FORMS))
        other: Point | None = None
        change = self.chance.choice(("limits", "limits", "limits", "rename", "swap", "point", "device"))
        self.done.append(f"file: {change} {device} {number}")
        gone = {points[number].name} if change in ("rename", "swap") else set()
        if change == "limits":
            points[number].limits = self._some_limits(FORMS[number])
        elif not self.there[device] or not points[number].is_there:
            self.there[device] = points[number].is_there = True
        elif change == "rename":
            self.version += 1
            points[number].was, points[number].name = points[number].name, f"{FORMS[number].name}{self.version}"
        elif change == "swap":
            one, two = points[number], points[self.chance.choice([n for n in range(len(FORMS)) if n != number])]
            other = two
            if one.is_there and two.is_there:
                one.name, two.name = two.name, one.name
                one.was, two.was = two.name, one.name
            gone |= {one.name, two.name}
        elif change == "point" and number != 1:
            points[number].is_there = not points[number].is_there
        elif change == "device":
            self.there[device] = not self.there[device] or sum(self.there.values()) < 2
        for each in points:  # no other point goes on with a history that has another name now
            if each.was in gone and each not in (points[number], other):
                each.was = ""

    # What happens.

    def _transaction(self, began: float, ended: float) -> None:
        """Note at which time of the monotonic clock the samples are made that will have a time of the wall clock."""
        middle = (began + ended) / 2
        self.monotonic[self.collector._clock.time_ns(middle)] = round(middle * NS)

    def _note(self, commit: Commit) -> None:
        self.commits.append(commit)

    def taken(self) -> int:
        status = self.collector.store_status()
        return status.samples + status.waiting

    def deed(self, what: Callable[[], object]) -> None:
        """Have the model do something where the samples are now."""
        self.deeds.append((self.taken(), what))

    def values(self) -> None:
        """Some points get other values, most of them at a limit."""
        for name, device in self.devices.items():
            for number, form in enumerate(FORMS):
                if self.chance.random() < 0.5 and not form.text.startswith("formula"):
                    self._set(device, number, form, self.points[name][number].limits)

    def _set(self, device: VirtualDevice, number: int, form: Form, limits: tuple[Limit, ...]) -> None:
        if form.is_bit:
            on = self.chance.random() < 0.5
            device.bits[6] = on if form.name == "coil" else device.bits.get(6, False)
            device.words[10] = 8 * on if form.name == "bit" else device.words.get(10, 0)
        elif form.name == "mode":
            device.words[8] = self.chance.choice((0, 1, 2, 7))
        elif form.name == "flags":
            device.words[9] = self.chance.choice((0, 1, 32, 33, 2, 0x8000))
        else:
            at = self._near(limits)
            if form.name == "float":
                special = self.chance.random()
                value = float("nan") if special < 0.1 else float("inf") if special < 0.15 else float(at)
                device.set_float(2, value)
            elif form.name == "tenths":
                device.words[0] = 0x8000 if self.chance.random() < 0.1 else int(at * 10) & 0xFFFF
            else:
                device.set_number(4, int(at * 10), 4)

    def _near(self, limits: tuple[Limit, ...]) -> Decimal:
        if not limits:
            return Decimal(0)
        limit = self.chance.choice(limits)
        side = -1 if limit.kind in ("H", "HH") else 1
        back = limit.limit + side * limit.hysteresis
        return self.chance.choice((limit.limit, limit.limit, back, back, Decimal(0))) + TENTH * self.chance.choice(
            (0, 0, 0, 1, -1)
        )

    async def pass_time(self) -> None:
        await self.plant.loop.advance(float(PERIOD * self.chance.choice((1, 1, 1, 2, 3, 5))))

    async def part_of_a_period(self) -> None:
        await self.plant.loop.advance(self.chance.choice((0.0625, 0.125, 0.25, 0.4)))

    async def trouble(self) -> None:
        device = self.chance.choice(list(self.devices.values()))
        device.mode = self.chance.choice(("answers", "silent", "down", 4, 11))
        await self.pass_time()
        if self.chance.random() < 0.7:
            device.mode = "answers"

    async def end_trouble(self) -> None:
        for device in self.devices.values():
            device.mode = "answers"
        await self.plant.loop.advance(30.0)

    async def set_clock(self) -> None:
        self.plant.step_clock(self.chance.choice((3600.0, -3600.0, 0.3, -0.3)))

    async def maintain(self) -> None:
        device = self.chance.choice([name for name, there in self.there.items() if there])
        begins = device not in self.collector.in_maintenance()
        self.collector.maintenance(device, begins=begins, by="otto", why="a walk")

    def _a_key(self) -> tuple[str, str, str]:
        active = self.collector.alarms.active()
        if active and self.chance.random() < 0.9:
            each = self.chance.choice(active)
            return each.device, each.point, each.limit
        device = self.chance.choice(list(DEVICES))
        return device, self.chance.choice(self.points[device]).name, self.chance.choice((*NUMERIC, "state"))

    async def acknowledge(self) -> None:
        """Acknowledge something, now."""
        device, point, limit = self._a_key()
        identity = self.identity(device, point)
        answer: list[bool] = []
        self.deed(lambda: answer.append(self.oracle.acknowledge((identity, limit), "anna")))
        try:
            event = await self.collector.alarms.acknowledge(device, point, limit, "anna")
        except InvalidRequest:
            taken = False
        else:
            taken = True
            assert (event.device, event.point, event.limit, event.kind) == (device, point, limit, "acknowledged")
            assert self.store_has(event), "an acknowledgement that returned is not in the journal"
        await self.check()
        assert answer == [taken], (device, point, limit)

    async def acknowledge_in_a_read(self) -> None:
        """Acknowledge while a read is under way."""
        busy = self.chance.choice(list(self.devices.values()))
        until = self.plant.loop.now + 1.0
        count = len(busy.asked)
        while len(busy.asked) == count and self.plant.loop.now < until:
            await self.plant.loop.advance(1 / 64)
        await self.acknowledge()

    async def acknowledge_at_a_sample(self) -> None:
        """Acknowledge in the same turn of the loop as a sample."""
        device = self.chance.choice(list(self.devices.values()))

        def at_once(device: VirtualDevice) -> None:
            device.before = nothing
            self._tasks.append(self.plant.loop.create_task(self.acknowledge_later()))

        device.before = at_once
        await self.plant.loop.advance(float(PERIOD))
        device.before = nothing
        for task in self._tasks:
            await task
        self._tasks.clear()

    async def acknowledge_later(self) -> None:
        device, point, limit = self._a_key()
        identity = self.identity(device, point)
        answer: list[bool] = []
        self.answers.append(((identity, limit), answer))
        self.deed(lambda: answer.append(self.oracle.acknowledge((identity, limit), "anna")))
        try:
            await self.collector.alarms.acknowledge(device, point, limit, "anna")
            answer.append(True)
        except InvalidRequest:
            answer.append(False)

    async def reload(self) -> None:
        for _ in range(self.chance.choice((0, 1, 1, 2))):
            self.change_file()
            self.write()
            await self._read_again(self.configured(self.limits()))

    async def _read_again(self, deed: Callable[[], object]) -> None:
        """Read the files again; a read that is under way comes to its end meanwhile, under the limits of before."""
        alarms = self.collector.alarms
        configure = alarms.configure

        def configure_both(*arguments: Any, **named: Any) -> None:
            self.deed(deed)
            configure(*arguments, **named)

        alarms.configure = configure_both  # type: ignore[method-assign]
        again = self.plant.loop.create_task(self.collector.reload(load_collector(self.plant.folder / "plant.toml")))
        while not again.done():
            await self.plant.loop.advance(1 / 64)
            await asyncio.wait([again], timeout=0)
        await again
        alarms.configure = configure  # type: ignore[method-assign]

    def store_has(self, event: object) -> bool:
        return event in busway.Store(self.plant.folder / "data").alarms()

    def identity(self, device: str, name: str) -> Identity:
        return device, self.names[device][name]

    def configured(self, limits: dict[object, tuple[Limit, ...]]) -> Callable[[], object]:
        """The deed of a file that holds from now on: its limits and its names."""
        names = {device: {point.name: n for n, point in enumerate(points)} for device, points in self.points.items()}

        def deed() -> None:
            self.names = names
            self.oracle.configure(limits)

        return deed

    # What must hold.

    async def check(self) -> None:
        """What is active is what the model says."""
        await self.plant.committed(self.collector)
        self._fold()
        found = {}
        for each in self.collector.alarms.active():
            key: Key = (self.identity(each.device, each.point), each.limit)
            assert key not in found, f"{key} is active twice"
            text = str(each.state)
            found[key] = (text.startswith("active"), text.endswith("not acknowledged"))
        for key, answer in self.answers:
            assert answer in ([True, True], [False, False]), f"{key}: {answer} after {self.done[-8:]}"
        self.answers.clear()
        wanted = self.oracle.active()
        assert found == wanted, (
            f"too many: {found.items() - wanted.items()}, missing: {wanted.items() - found.items()}, "
            f"after {self.done[-8:]}"
        )
        raised, waiting = self.collector.alarms.counts()
        assert (raised, waiting) == (sum(a for a, _ in found.values()), sum(w for _, w in found.values()))

    def _fold(self) -> None:
        """Give the model what was told since the last time."""
        commits, self.commits = self.commits, []
        for commit in commits:
            caused: list[Told] = []
            for batch in commit.batches:
                self._do_deeds()
                for sample in batch:
                    self._seen += 1
                    caused += self.oracle.sample(
                        self.identity(sample.device, sample.point),
                        sample.value,
                        is_bad=sample.quality is Quality.BAD,
                        at=sample.time,
                        monotonic=self.monotonic[sample.time],
                    )
            told = [self.as_told(each) for each in commit.alarms if each.kind in ("raised", "cleared")]
            assert set(told) == set(caused), (
                f"too many: {set(told) - set(caused)}, missing: {set(caused) - set(told)}, after {self.done[-8:]}"
            )
            assert told == caused
        self._do_deeds()
        assert not self.deeds

    def _do_deeds(self) -> None:
        while self.deeds and self.deeds[0][0] <= self._seen:
            self.deeds.pop(0)[1]()

    def as_told(self, event: AlarmEvent) -> Told:
        """An event of the journal as the model has it."""
        key = self.identity(event.device, event.point), event.limit
        if event.kind in ("raised", "cleared"):
            return Told(key, str(event.kind), event.at, event.value)
        return Told(key, str(event.kind), None, by=event.by if event.kind == "acknowledged" else "")

    def check_journal(self) -> None:
        """The journal of the store is that of the model, each event once and in order."""
        found = [self.as_told(each) for each in busway.Store(self.plant.folder / "data").alarms()]
        assert in_order(found) == in_order(self.oracle.journal)

    # The walk.

    async def run(self, steps: int) -> None:
        self.write()
        self.oracle.configure(self.limits())
        while steps > 0:
            async with self.plant.collecting() as collector:
                self.collector = collector
                self._seen = 0
                collector.subscribe(self._note)
                await self.check()
                while steps > 0:
                    steps -= 1
                    if not await self.step():
                        break
                await self.check()
                kills = self.chance.random() < 0.5
                if kills:
                    self.plant.kill()
            self.done.append("killed" if kills else "ended")
            if not kills:
                self._fold()
            self.commits.clear()
            self.oracle.restart()
            self.check_journal()
            if self.chance.random() < 0.4:
                self.change_file()
                self.write()
                self.configured(self.limits())()
            await self.plant.loop.advance(self.chance.choice((0.0, 100.0)))

    async def step(self) -> bool:
        """Do something; False to end the collector."""
        roll = self.chance.random()
        if roll < 0.03:
            return False
        if roll < 0.6:
            self.values()
            deed: Callable[[], Coroutine[Any, Any, None]] = self.pass_time
        else:
            deed = self.chance.choice(
                (
                    self.part_of_a_period,
                    self.trouble,
                    self.end_trouble,
                    self.set_clock,
                    self.maintain,
                    self.acknowledge,
                    self.acknowledge,
                    self.acknowledge_in_a_read,
                    self.acknowledge_at_a_sample,
                    self.reload,
                )
            )
        self.done.append(deed.__name__)
        await deed()
        await self.check()
        return True


def in_order(journal: list[Told]) -> list[Told | set[Told]]:
    """A journal in which the events that one file caused have no order among themselves."""
    found: list[Told | set[Told]] = []
    for is_removed, group in itertools.groupby(journal, lambda each: each.kind == "removed"):
        events = list(group)
        found += [set(events)] if is_removed else events
    return found


@pytest.mark.parametrize("seed", SEEDS)
def test_alarms_are_what_their_documentation_says(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def main(plant: VirtualPlant) -> None:
        walk = AlarmWalk(plant, seed)
        try:
            await walk.run(STEPS)
        finally:
            print(walk.done)  # shown where the test fails

    run_virtually(main, tmp_path, monkeypatch)
