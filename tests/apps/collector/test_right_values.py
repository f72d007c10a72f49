"""A sample is the value of that point of that device at that time, or it is not good, also where devices lie.

1. The devices are sockets of our own; every register says whose it is and which answer it comes from.
2. One random walk changes the configuration under way: devices change places, points change names, classes change.
"""

import asyncio
import os
import random
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from lying_devices import Field, Lies, LyingDevice
from program import Busway
from right_values import Checker, Laid, Source, Truth, group_points, layout, profile
from waiting import until

import busway
from busway.apps.collector.configuration import load_collector

LYING = {"late": 0.03, "silent": 0.01, "twice": 0.04, "foreign": 0.03, "short": 0.02, "long": 0.02, "exception": 0.03}
SEED = int(os.environ.get("BUSWAY_WALK_SEED", "20261122"))
ANSWERS = 300
"""Of the devices together between two changes, at most."""


@dataclass
class Place:
    """A unit behind a link."""

    link: str
    unit: int
    device: LyingDevice


@dataclass
class Asked:
    """A device of the configuration."""

    name: str
    place: Place
    base: int = 0
    poll_class: str = "fast"
    names: dict[str, str] = field(default_factory=dict)
    was: dict[str, str] = field(default_factory=dict)


class Plant:
    """A configuration that a test changes, and the truth about it."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.chance = random.Random(seed)
        self.points = layout()
        self.links: dict[str, str] = {}
        self.places: list[Place] = []
        self.devices: dict[str, Asked] = {}
        self.truth = Truth()
        self.collector = ""
        self._renamed = 0

    def link(self, field_: Field, name: str, kind: str, units: list[int], lies: Lies, options: str = "") -> None:
        url, devices = field_.endpoint(kind, units, lies)
        self.links[name] = f'url = "{url}"\n{options}'
        self.places += [Place(name, unit, device) for unit, device in devices.items()]

    def same_url(self, name: str, of: str, options: str = "") -> None:
        """Another link to the URL of one that there is."""
        self.links[name] = self.links[of] + options
        self.places += [Place(name, each.unit, each.device) for each in self.places if each.link == of]

    def declare(self) -> None:
        for place in self.chance.sample(self.places, len(self.places) * 3 // 4):
            name = f"d{len(self.devices)}"
            poll_class = self.chance.choice(("fast", "slow"))
            self.devices[name] = Asked(name, place, self.chance.choice((0, 400)), poll_class)

    def change(self) -> str:
        """Change something, and say what."""
        return self.chance.choice(
            (self._swap, self._move, self._exchange_names, self._rename, self._class, self._base)
        )()

    def _two(self) -> tuple[Asked, Asked]:
        one, other = self.chance.sample(list(self.devices.values()), 2)
        return one, other

    def _swap(self) -> str:
        one, other = self._two()
        one.place, other.place = other.place, one.place
        return f"{one.name} and {other.name} change places"

    def _move(self) -> str:
        one, _ = self._two()
        free = [place for place in self.places if all(each.place is not place for each in self.devices.values())]
        one.place = self.chance.choice(free)
        return f"{one.name} is unit {one.place.unit} of {one.place.link}"

    def _exchange_names(self) -> str:
        one, _ = self._two()
        first, second = self.chance.sample([point.key for point in self.points if point.key.startswith("code")], 2)
        one.names[first], one.names[second] = one.names.get(second, second), one.names.get(first, first)
        one.was.pop(first, None)
        one.was.pop(second, None)
        return f"{one.names[first]} and {one.names[second]} of {one.name} exchange their names"

    def _rename(self) -> str:
        one, _ = self._two()
        key = self.chance.choice(
            [point.key for point in self.points if point.key[:4] not in ("dev0", "dev6", "expo", "plac")]
        )
        self._renamed += 1
        one.was[key] = one.names.get(key, key)
        one.names[key] = f"new{self._renamed}"
        return f"{one.was[key]} of {one.name} is {one.names[key]}"

    def _class(self) -> str:
        one, _ = self._two()
        one.poll_class = "slow" if one.poll_class == "fast" else "fast"
        return f"{one.name} is {one.poll_class}"

    def _base(self) -> str:
        one, _ = self._two()
        one.base = 400 - one.base
        return f"{one.name} has base {one.base}"

    def write(self) -> Path:
        """The file, and its profiles."""
        text = f'[collector]\nstore = "data"\npage = "off"\n{self.collector}'
        text += "[poll_class]\nfast.period = 0.1\nslow.period = 0.4\n"
        for name, link in self.links.items():
            text += f'[[link]]\nname = "{name}"\n{link}\n'
        for each in self.devices.values():
            (self.folder / f"{each.name}.toml").write_text(profile(self.points, each.names, each.was))
            text += f'[[device]]\nname = "{each.name}"\nlink = "{each.place.link}"\nunit = {each.place.unit}\n'
            text += f'profile = "{each.name}.toml"\nwith = {{ base = {each.base} }}\npoll_class = "{each.poll_class}"\n'
        file = self.folder / "plant.toml"
        file.write_text(text)
        return file

    def tell(self, earliest: int, latest: int) -> None:
        """Have the truth know what is in force from between these times on."""
        points = {}
        was = {}
        for each in self.devices.values():
            for laid in self._of(each):
                name = each.names.get(laid.key, laid.key)
                points[each.name, name] = Source(each.place.device.number, laid, each.base)
                if laid.key in each.was:
                    was[each.name, name] = each.was[laid.key]
        self.truth.configure(points, was, earliest, latest)

    def _of(self, each: Asked) -> Iterator[Laid]:
        yield from self.points
        yield from group_points()


def plant_of_all_kinds(world: Field, folder: Path, seed: int) -> Plant:
    """Equal layouts and unit numbers on two devices, a gateway, a second way to one of them, and two lines."""
    plant = Plant(folder, seed)
    lies = Lies(LYING)
    plant.link(world, "left", "tcp", [1, 2, 3], lies, "timeout = 0.15\nmax_transactions = 4")
    plant.link(world, "right", "tcp", [1, 2, 3], Lies({**LYING, "reset": 0.02}), "timeout = 0.15")
    gateway = Lies(LYING, most=20, holes=[range(12, 14), range(500, 504)])
    plant.link(world, "gateway", "tcp", list(range(1, 9)), gateway, "timeout = 0.15\nmax_transactions = 8")
    plant.same_url("again", "left")
    line = Lies({"late": 0.03, "silent": 0.01, "foreign": 0.03, "short": 0.02, "long": 0.02, "exception": 0.03})
    plant.link(world, "converter", "rtu+tcp", [1, 2, 3], line, "timeout = 0.15")
    plant.link(world, "line", "rtu", [1, 2, 3], line, "timeout = 0.15")
    plant.declare()
    return plant


async def test_what_was_learnt_of_a_unit_is_not_held_against_another_under_its_name(tmp_path: Path) -> None:
    profile_text = "[[unit]]\nunit = 1\npoint = [\n"
    for start in (0, 100):
        profile_text += f'{{ name = "code{start}", address = "holding:{start}", type = "uint64" }},\n'
    (tmp_path / "profile.toml").write_text(profile_text + "]\n")

    def file_for(url: str, unit: int) -> Path:
        file = tmp_path / "plant.toml"
        file.write_text(
            '[collector]\npage = "off"\n[poll_class]\nall.period = 0.03\n'
            f'[[link]]\nname = "a"\nurl = "{url}"\n'
            f'[[device]]\nname = "d"\nlink = "a"\nunit = {unit}\nprofile = "profile.toml"\n'
        )
        return file

    with Field() as world:
        url, devices = world.endpoint("tcp", [1, 2])
        devices[1].lies = Lies(holes=[range(100, 104)])
        async with busway.collect(file_for(url, 1)) as collector:
            await until(lambda: any("exception 02" in line for line in collector.status()[0].learnt))
            await collector.reload(load_collector(file_for(url, 2)))
            async with asyncio.timeout(60):
                async for batch in collector.samples():
                    if "code100" in batch.points and batch.values[batch.points.index("code100")] is not None:
                        break


def check_a_walk(folder: Path, seed: int, turns: int) -> None:
    """Change the configuration so many times, and fail with samples that are not what was there."""
    print(f"seed {seed}, {turns} turns")
    with Field(seed) as world:
        plant = plant_of_all_kinds(world, folder, seed)
        file = plant.write()
        plant.tell(0, time.time_ns())
        with Busway("collect", os.fspath(file)) as collector:
            collector.wait_for("collects into")
            for _ in range(turns):
                world.wait_for_answers(plant.chance.randrange(ANSWERS))
                for _ in range(plant.chance.randrange(1, 4)):
                    print(plant.change())
                earliest = time.time_ns()
                plant.write()
                collector.process.send_signal(signal.SIGHUP)
                print(collector.wait_for("read again:").strip())
                plant.tell(earliest, time.time_ns())
            world.wait_for_answers(ANSWERS)
            collector.stop(signal.SIGTERM)
            assert collector.process.returncode == 0
    checker = Checker(plant.truth, world.answers)
    checker.check(sample for table in busway.Store(folder / "data").pieces() for sample in table)
    print(f"{checker.checked} samples, {checker.good} good, {sum(map(len, world.answers.values()))} answers")
    assert checker.wrong[:20] == []
    assert checker.good > 50 * turns


@pytest.mark.real_time
def test_every_good_sample_is_what_its_device_held_then(tmp_path: Path) -> None:
    check_a_walk(tmp_path, SEED, 6)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(SEED, SEED + 5))
def test_the_same_over_long_walks(tmp_path: Path, seed: int) -> None:
    check_a_walk(tmp_path, seed, 120)
