"""No value is good where it was not read again when it was due: random periods, slow and silent devices, late commits.

The truth is when each answer came. A good value is no older than its limit: twice its period, and at least two seconds
more than that. At exactly the limit it may be either.
"""

import os
import random
import urllib.request
from collections import defaultdict
from pathlib import Path

import pytest
from virtual_plant import NANOSECONDS, VirtualPlant, run_virtually

import busway
from busway.apps.collector import held_values
from busway.apps.collector.samples import Quality, Reason, quality_of
from busway.apps.collector.sinks import prometheus
from busway.apps.web.collector_stream import CollectorStream

SEEDS = [int(each) for each in os.environ.get("BUSWAY_HELD_SEEDS", "1 2").split()]
EDGE = 1e-6
PROFILE = """\
[[unit]]
unit = 1
point = [
    { name = "exponent", address = "4x1", type = "int16", poll_class = "FACTOR" },
    { name = "count", address = "4x2", type = "uint32", poll_class = "COUNT" },
    { name = "scaled", address = "4x101", type = "uint16", scale_from = "exponent", poll_class = "SCALED" },
    { name = "slow", address = "4x201", type = "uint16", poll_class = "SLOW" },
    { name = "sum", formula = "count + slow" },
    { name = "of_sum", formula = "sum + scaled" },
]
"""
"""Every point but the computed ones is a read of its own, so that each can be late alone."""
POINTS = {"exponent": 0, "count": 1, "scaled": 100, "slow": 200}
CLASSES = ("a", "b", "c", "d")


def limit_of(period: float) -> float:
    """What the documentation says."""
    return max(2 * period, period + 2)


class HeldWalk:
    """One link with devices that are slow at random, and when each point was read last."""

    def __init__(self, plant: VirtualPlant, seed: int) -> None:
        self.plant, self.chance = plant, random.Random(seed)
        self.periods = {name: self.chance.choice((0.5, 1.0, 2.0, 2.5, 7.0, 20.0)) for name in CLASSES}
        self.classes = {name: self.chance.choice(CLASSES) for name in POINTS}
        self.devices = ("one", "two")
        self.ended: dict[tuple[str, str], list[float]] = defaultdict(list)
        self.good = self.held = 0
        profile = PROFILE
        for word, name in (("FACTOR", "exponent"), ("COUNT", "count"), ("SCALED", "scaled"), ("SLOW", "slow")):
            profile = profile.replace(f'"{word}"', f'"{self.classes[name]}"')
        text = '[collector]\nstore = "data"\npage = "off"\nlearn = false\n[poll_class]\n'
        text += "".join(f"{name}.period = {period}\n" for name, period in self.periods.items())
        text += '[[link]]\nname = "l"\nurl = "tcp://127.0.0.1:1"\n'
        for unit, name in enumerate(self.devices, 1):
            text += (
                f'[[device]]\nname = "{name}"\nlink = "l"\nunit = {unit}\nprofile = "profile.toml"\npoll_class = "a"\n'
            )
            device = plant.device("tcp://127.0.0.1:1", unit)
            device.takes = 0.05
        plant.write(profile=profile, plant=text)

    def limit(self, point: str) -> float:
        if point == "sum":
            return min(self.limit("count"), self.limit("slow"))
        if point == "of_sum":
            return min(self.limit("sum"), self.limit("scaled"))
        return limit_of(self.periods[self.classes[point]])

    def something(self) -> None:
        for unit in (1, 2):
            device = self.plant.device("tcp://127.0.0.1:1", unit)
            device.takes = self.chance.choice((0.0, 0.05, 0.05, 0.05, 1.0, 3.0, 9.0))
            if self.chance.random() < 0.2:
                device.takes = self.chance.uniform(0.0, 5.0)

    def look(self, collector: busway.Collector, stream: CollectorStream, page: str) -> None:
        """Compare all that shows values with the last samples of the store, whose end is the end of a read."""
        wall = self.plant.time_ns()
        store = busway.Store(self.plant.folder / "data")
        live = stream.refresh()
        _, reasons, times = live.columns()
        shown = {key: (reasons[place], times[place]) for place, key in enumerate(stream.points)}
        last = {(d, p): (reason, at) for d, p, _, reason, at in collector.values.samples()}
        target = collector.commands._targets.last
        text = urllib.request.urlopen(page, timeout=60).read().decode() if page else ""
        table = store.read("*")
        newest: dict[tuple[str, str], tuple[int, int]] = {}
        for device, point, time, width, value in zip(
            table.device, table.point, table.time, table.half_width, table.value, strict=True
        ):
            if value is not None:
                newest[device, point] = (time, width)
        for key, (time, width) in newest.items():
            age = (wall - time - width) / NANOSECONDS
            is_old = age > self.limit(key[1]) + EDGE
            is_new = age < self.limit(key[1]) - EDGE
            for where, reason in (("page", shown[key][0]), ("values", last[key][0])):
                self.good += reason == 0
                self.held += reason == Reason.HELD
                assert not (is_old and reason == 0), f"{key} of {age} s is good ({where}), limit {self.limit(key[1])}"
                if is_new and key[1] in ("exponent", "count", "slow"):
                    assert reason != Reason.HELD, f"{key} of {age} s is held ({where}), limit {self.limit(key[1])}"
            found = target(*key)
            assert found is None or not is_old or found.quality != "good", key
            if page and is_old:
                device, point = key
                name = f'{{device="{device}",point="{point}"}}'
                assert f"busway_point_value{name}" not in text or f"busway_point_uncertain{name} 1.0" in text, key

    def check_store(self) -> None:
        """A sample of a computed or scaled point is good only where what it is made of was read in time."""
        store = busway.Store(self.plant.folder / "data")
        for device in self.devices:
            reads = {}
            for point in POINTS:
                table = store.read(f"{device}/{point}")
                reads[point] = [
                    time + width
                    for time, width, reason in zip(table.time, table.half_width, table.reason, strict=True)
                    if reason in (0, Reason.HELD)
                ]
            for point, inputs in (("sum", ("count", "slow")), ("scaled", ("exponent",)), ("of_sum", ("count", "slow"))):
                table = store.read(f"{device}/{point}")
                for time, width, reason in zip(table.time, table.half_width, table.reason, strict=True):
                    if quality_of(reason) is not Quality.GOOD:
                        continue
                    for each in inputs:
                        before = max((at for at in reads[each] if at <= time + width + 1000), default=0)
                        age = (time + width - before) / NANOSECONDS
                        assert age <= self.limit(each) + EDGE, f"good {device}/{point} from {each} of {age} s"


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_older_than_its_limit_is_good(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("prometheus_client")

    async def main(plant: VirtualPlant) -> None:
        walk = HeldWalk(plant, seed)
        async with plant.collecting() as collector:
            assert collector._committer is not None
            collector._committer._clock = plant.moment
            collector.values._moment = lambda: plant.loop.now
            stream = CollectorStream(collector)
            stream.values._moment = lambda: plant.loop.now
            stream.values._look_at = 0.0
            page = prometheus.PrometheusPage("127.0.0.1:0", ["*"], collector.values, now=plant.time_ns, stale=1e6)
            try:
                for _ in range(25):
                    walk.something()
                    for _ in range(walk.chance.randrange(1, 4)):
                        await plant.loop.advance(walk.chance.choice((0.25, 1.0, 2.0, 3.5, 11.0)))
                        await plant.committed(collector)
                        walk.look(collector, stream, page.url if walk.chance.random() < 0.3 else "")
            finally:
                page.close()
        walk.check_store()
        assert walk.good > 50
        assert walk.held > 5

    run_virtually(main, tmp_path, monkeypatch)


def test_the_limit_is_the_documented_one() -> None:
    for period in (0.001, 1.0, 2.0, 2.5, 60.0):
        assert held_values.held_after(period) == limit_of(period)
