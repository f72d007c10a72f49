"""Random configurations one after the other, with sinks that come, change and go, over a collector that runs on.

1. Devices count their answers, so that each sample is one of a kind. One link is the same in all configurations.
2. In the end each answer is in the store once, and in the file of each sink that is there once; a link that stays the
   same misses no round. After a process was killed a sink may have samples again, with the same commit.
"""

import asyncio
import json
import os
import random
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from virtual_plant import VirtualDevice, VirtualPlant, run_virtually

import busway
from busway.apps.collector.store.writer import Commit
from busway.errors import ConfigError

SEEDS = [int(each) for each in os.environ.get("BUSWAY_RELOAD_SEEDS", "1 2").split()]
PROFILE = '[[unit]]\nunit = 1\npoint = [{ name = "count", address = "4x1", type = "uint32" }]\n'
PATTERNS = {"all": "*", "stays": "stays", "other": "moves*", "twice": "*/count"}


class ReloadWalk:
    """A plant and its configurations."""

    def __init__(self, plant: VirtualPlant, seed: int) -> None:
        self.plant, self.chance = plant, random.Random(seed)
        self.sinks: dict[str, int] = {"all": 100}
        self.devices: dict[str, int] = {"moves1": 1}
        self.keep = ""
        self.answers: dict[str, list[float]] = {}
        self.newest = 0
        self.killed = False
        self.done: list[str] = []
        plant.write(profile=PROFILE)
        self.device("tcp://127.0.0.1:1", 1, "stays")
        self.device("tcp://127.0.0.1:2", 1, "moves1")
        self.write()

    def device(self, url: str, unit: int, name: str) -> None:
        device = self.plant.device(url, unit)
        device.takes = 0.05
        self.answers.setdefault(name, [])

        def before(device: VirtualDevice) -> None:
            device.set_number(0, len(self.answers[name]), 2)
            self.answers[name].append(self.plant.loop.now)

        device.before = before

    def text(self) -> str:
        text = f'[collector]\nstore = "data"\npage = "off"\n{self.keep}\n[poll_class]\nall.period = 1.0\n'
        for link, devices in ((1, {"stays": 1}), (2, self.devices)):
            text += f'[[link]]\nname = "l{link}"\nurl = "tcp://127.0.0.1:{link}"\n'
            for name, unit in devices.items():
                text += f'[[device]]\nname = "{name}"\nlink = "l{link}"\nunit = {unit}\nprofile = "profile.toml"\n'
        for name, most in self.sinks.items():
            text += f'[[sink]]\nname = "{name}"\nurl = "file://{self.out(name)}"\nage = 0\nmost = {most}\n'
            text += f'points = ["{PATTERNS[name]}"]\n'
        return text

    def out(self, name: str) -> Path:
        return self.plant.folder.parent / f"{name}.jsonl"

    def write(self) -> None:
        self.plant.write(plant=self.text())

    def change(self) -> None:
        deed = self.chance.choice(("sink", "sink", "sink", "device", "keep"))
        if deed == "sink":
            name = self.chance.choice(list(PATTERNS))
            if name in self.sinks and self.chance.random() < 0.5:
                del self.sinks[name]
            else:
                self.sinks[name] = self.chance.randrange(1, 1000)
        elif deed == "device":
            number = self.chance.randrange(1, 4)
            if self.devices.pop(f"moves{number}", None) is None:
                self.device("tcp://127.0.0.1:2", number, f"moves{number}")
                self.devices[f"moves{number}"] = number
        else:
            self.keep = self.chance.choice(("", "keep_days = 3", "keep_bytes = 500000000"))
        self.done.append(deed)

    async def reload(self, collector: busway.Collector) -> None:
        """Change the file once or more at the same time; a file that is wrong changes nothing."""
        texts = []
        for _ in range(self.chance.choice((1, 1, 2, 3))):
            self.change()
            texts.append(self.text())
        wrong = self.text().replace("unit = 1", "unit = 999")
        changes: list[Any] = [collector.replace_configuration(text, by="anna") for text in texts]
        if self.chance.random() < 0.3:
            with pytest.raises(ConfigError):
                await self.moving(collector.replace_configuration(wrong, by="anna"))
        done = asyncio.gather(*changes)
        await self.moving(done)

    async def moving(self, change: Any) -> None:
        """Await a change while time passes: links end with their last transaction."""
        task = asyncio.ensure_future(change)
        while not task.done():
            await self.plant.loop.advance(0.02)
            await asyncio.to_thread(time.sleep, 0.001)  # for the threads of store and sinks
        await task

    async def run(self) -> None:
        for life in range(2):
            async with self.plant.collecting() as collector:
                collector.subscribe(self.note)
                for _ in range(8):
                    await self.plant.loop.advance(self.chance.uniform(0.3, 6.0))
                    await self.reload(collector)
                await self.plant.loop.advance(3.0)
                await self.plant.committed(collector)
                if life == 0 and self.chance.random() < 0.5:
                    self.plant.kill()
                    self.killed = True
                elif life:
                    await self.delivered(collector)
            self.write()
            await self.plant.loop.advance(10.0)

    def note(self, commit: Commit) -> None:
        self.newest = commit.number

    async def delivered(self, collector: busway.Collector) -> None:
        for _ in range(2000):
            if all(each.cursor >= self.newest for each in collector.sink_statuses()):
                return
            await asyncio.to_thread(time.sleep, 0.01)  # for the threads of the sinks
        raise AssertionError(collector.sink_statuses())

    def check(self) -> None:
        store = busway.Store(self.plant.folder / "data")
        stored: set[tuple[str, int]] = set()
        for name, answers in self.answers.items():
            if not answers:
                continue
            table = store.read(f"{name}/count")
            found = Counter(int(value) for value in table.value if value is not None)
            assert found == dict.fromkeys(range(len(answers)), 1), (name, self.done)
            stored |= {(name, number) for number in found}
        for name in self.sinks:
            lines = [json.loads(line) for line in self.out(name).read_text().splitlines()]
            got = Counter((each["device"], each["value"]) for each in lines if each["value"] is not None)
            devices = {"all": "", "stays": "stays", "other": "moves", "twice": ""}[name]
            wanted = {key for key in stored if key[0].startswith(devices)}
            assert got.keys() == wanted, (name, sorted(wanted ^ got.keys())[:5], self.done)
            if not self.killed:
                assert set(got.values()) == {1}, (name, [key for key, n in got.items() if n > 1][:5], self.done)
            in_order: dict[str, list[int]] = {}
            for each in lines:
                if each["value"] is not None:
                    in_order.setdefault(each["device"], []).append(each["value"])
            for values in in_order.values():
                assert self.killed or values == sorted(values)
        rounds = [later - earlier for earlier, later in pairwise(self.answers["stays"])]
        assert sum(each > 1.5 for each in rounds) <= 1, rounds  # between the two processes


@pytest.mark.parametrize("seed", SEEDS)
def test_each_sink_that_is_there_has_each_sample_once_and_untouched_links_miss_no_round(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main(plant: VirtualPlant) -> None:
        walk = ReloadWalk(plant, seed)
        await walk.run()
        walk.check()

    run_virtually(main, tmp_path, monkeypatch)
