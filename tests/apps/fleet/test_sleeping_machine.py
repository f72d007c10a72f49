"""A collector whose machine sleeps: the clock of its leases goes on, and it sends nothing when it wakes too late."""

import asyncio
import contextlib
import os
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fleet_devices import FleetDevice, devices_of, plant
from missing_peers import missing, preloadable
from shifted_clock import set_shift
from waiting import until

from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_driver import LeaseDriver, boot_time
from busway.apps.fleet.zone_watch import ZoneWatch

SOURCE = Path(__file__).parents[2] / "support" / "slept_clock.c"
NIGHT = 60
"""Seconds for which the machine sleeps: four times a lease."""

pytestmark = pytest.mark.real_time


@pytest.fixture(autouse=True)
def clock() -> None:
    """The clock of the system that counts while the machine sleeps."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        missing("this system has no clock that counts in its sleep")


def test_the_clock_of_leases_counts_while_the_machine_sleeps(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def clock_gettime(clock: int) -> float:
        asked.append(clock)
        return 7.0

    def monotonic() -> float:
        raise AssertionError("it stands still while the machine sleeps")

    monkeypatch.setattr(time, "clock_gettime", clock_gettime)
    monkeypatch.setattr(time, "monotonic", monotonic)
    assert (boot_time(), asked) == (7.0, [time.CLOCK_BOOTTIME])


@pytest.mark.parametrize("part", [FleetCollector, LeaseDriver, ZoneWatch])
def test_all_parts_have_that_clock_if_none_is_given(part: type) -> None:
    assert part.__init__.__kwdefaults__["now"] is boot_time


@pytest.fixture
def library(tmp_path: Path) -> Path:
    """`SOURCE`, compiled."""
    return preloadable(SOURCE, tmp_path)


@contextlib.contextmanager
def collecting(tmp_path: Path, library: Path, slept: Path) -> Iterator[subprocess.Popen[bytes]]:
    """``busway fleet run`` on a machine that has slept for as long as a file says."""
    words = ["run", "--coordinator", f"local:{tmp_path}/zone", "--name", "west", "--store", str(tmp_path / "west")]
    environment = {**os.environ, "LD_PRELOAD": str(library), "BUSWAY_SLEPT": str(slept)}
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "busway", "fleet", *words], env=environment, stdout=log, stderr=log
        )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextlib.contextmanager
def locked(table: Path) -> Iterator[None]:
    """A time in which no lease can be renewed."""
    with contextlib.closing(sqlite3.connect(table, isolation_level=None, timeout=30.0)) as opened:
        opened.execute("BEGIN IMMEDIATE")
        yield
        opened.execute("ROLLBACK")


async def apply(tmp_path: Path, devices: list[FleetDevice]) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(plant(tmp_path / "west", devices).replace("[collector]\n", '[collector]\npage = "off"\n'))
    words = ["apply", str(file), "--coordinator", f"local:{tmp_path}/zone"]
    await asyncio.to_thread(
        subprocess.run, [sys.executable, "-m", "busway", "fleet", *words], check=True, capture_output=True, timeout=60
    )


async def test_an_owner_that_wakes_after_its_lease_begins_no_transaction(tmp_path: Path, library: Path) -> None:
    slept, log = tmp_path / "slept", tmp_path / "log"
    set_shift(slept, 0)
    async with devices_of(1) as devices:
        (device,) = devices
        await apply(tmp_path, devices)
        with collecting(tmp_path, library, slept) as west:
            await until(lambda: device.reads > 5 or west.poll() is not None, 60)
            with locked(tmp_path / "zone" / "plant.fleet"):
                before = device.reads
                await until(lambda: device.reads > before + 5, 60)
                set_shift(slept, NIGHT * 1_000_000_000)
                reads = device.reads
                await until(lambda: "could not be renewed in time" in log.read_text(), 60)
                assert device.reads <= reads + 1, "one was on its way; by the other clock more follow until it is noted"
            await until(lambda: device.reads > reads + 5, 60)
            assert west.poll() is None, "it takes the link again, with a new epoch, and goes on"
