"""Lines on which three of ten devices are dead: through the real poller and the store, in virtual time.

`test_schedule` and `test_silent_devices` have the same for the schedule alone.
"""

import random
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import pytest
from virtual_plant import NANOSECONDS, VirtualDevice, VirtualPlant, run_virtually

import busway
from busway.apps.collector.samples import Quality, Reason, quality_of
from busway.apps.collector.schedule import lateness_bound
from busway.apps.collector.silent_devices import DEAD_SHARE

DEVICES_A_LINE = 50
DEAD_A_LINE = 15
PERIOD = 5.0
READ = 0.04
"""Seconds of a read, about those of ten registers at 19 200 baud."""
TIMEOUT = 0.5
PROFILE = """\
[[unit]]
unit = 1
point = [
    { name = "power", address = "4x1", type = "int32", access = "read" },
    { name = "energy", address = "4x9", type = "uint32", access = "read" },
]
"""


def plant_of(lines: int) -> str:
    """A collector file with so many lines, and their devices."""
    tables = [f'[collector]\nstore = "data"\n[poll_class]\nall.period = {PERIOD}\n']
    for line in range(lines):
        url = f"rtu:///dev/line{line}?baud=19200&timeout={TIMEOUT}"
        tables.append(f'[[link]]\nname = "line{line}"\nurl = "{url}"\n')
        for unit in range(1, DEVICES_A_LINE + 1):
            tables.append(
                f'[[device]]\nname = "d{line}-{unit}"\nlink = "line{line}"\nunit = {unit}\nprofile = "profile.toml"\n'
            )
    return "".join(tables)


def lived(lines: int, seconds: float, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Collect for a while, and judge by what is in the store."""
    chance = random.Random(lines)
    names = [f"d{line}-{unit}" for line in range(lines) for unit in range(1, DEVICES_A_LINE + 1)]
    dead = {
        f"d{line}-{unit}" for line in range(lines) for unit in chance.sample(range(1, DEVICES_A_LINE + 1), DEAD_A_LINE)
    }
    devices: dict[str, VirtualDevice] = {}

    async def collect(plant: VirtualPlant) -> None:
        path = plant.write(profile=PROFILE, plant=plant_of(lines))
        for name in names:
            line, unit = name[1:].split("-")
            device = devices[name] = plant.device(f"rtu:///dev/line{line}", int(unit))
            device.mode, device.takes = ("silent", TIMEOUT) if name in dead else ("answers", READ)
        async with plant.collecting() as collector:
            await plant.loop.advance(seconds)
            await plant.committed(collector)
        store.append(busway.Store(path.parent / "data"))

    store: list[busway.Store] = []
    run_virtually(collect, folder, monkeypatch)
    table = store[0].read()

    good: dict[str, list[float]] = defaultdict(list)
    bad: dict[str, int] = defaultdict(int)
    for sample in table:
        if sample.point == "power":
            if sample.value is not None:
                good[sample.device].append(sample.time / NANOSECONDS)
            elif quality_of(sample.reason) is Quality.BAD:
                bad[sample.device] += 1
    assert set(good) == set(names) - dead

    bound = lateness_bound(PERIOD, TIMEOUT + READ)
    for name, times in good.items():
        assert max(after - before for before, after in pairwise(times)) <= PERIOD + bound + 1e-6, name
        assert len(times) >= seconds / PERIOD * 0.8, "from its first contact on: that of dead ones takes a timeout each"
        assert bad[name] <= 1, "the end of the collector"
    assert not {each.device for each in table.intervals if each.reason == Reason.SKIPPED}

    suspended = {each.device for each in table.intervals if each.reason == Reason.SUSPENDED}
    assert suspended == dead
    assert max(bad[name] for name in dead) <= 3, "a dead device does not fill the store"

    for line in range(lines):
        waited = TIMEOUT * sum(len(devices[name].asked) for name in dead if name.startswith(f"d{line}-"))
        assert 0.8 * DEAD_SHARE * seconds <= waited <= DEAD_SHARE * seconds + TIMEOUT, "the first contacts count too"


def test_beside_dead_devices_every_other_keeps_its_period(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lived(2, 300.0, tmp_path, monkeypatch)


@pytest.mark.soak
def test_of_a_thousand_devices_of_which_three_hundred_are_dead_every_other_keeps_its_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lived(20, 600.0, tmp_path, monkeypatch)
