"""Collectors of a fleet against devices that write down who asks them."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, parsed, plant
from waiting import until

import busway
from busway.apps.collector.configuration import parse_collector
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.ownership import OwnershipLog
from busway.errors import ConfigError

LINKS = 8

pytestmark = pytest.mark.real_time


@contextlib.asynccontextmanager
async def fleet(tmp_path: Path, name: str, devices: list[FleetDevice]) -> AsyncIterator[FleetCollector]:
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        configuration = parsed(tmp_path, name, devices)
        async with FleetCollector(configuration, coordinator, name, host=name, shards=LINKS, times=TIMES) as collector:
            yield collector
    finally:
        await coordinator.close()


async def test_two_collectors_share_the_links_and_each_link_is_asked_by_one_at_a_time(tmp_path: Path) -> None:
    async with devices_of(LINKS) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        before = [len(device.owners()) for device in devices]
        async with fleet(tmp_path, "two", devices) as two:
            await until(lambda: two.collector.loads() and one.collector.loads(), 30)
            both = [*one.collector.loads(), *two.collector.loads()]
            assert len(both) == len(set(both)), "no link has two collectors"
            await asyncio.sleep(1)
        await until(lambda: len(one.collector.loads()) == LINKS, 30)
        reads = [device.reads for device in devices]
        await until(lambda: all(device.reads > count for device, count in zip(devices, reads, strict=True)))
        assert before == [1] * LINKS
        for device in devices:
            assert len(device.owners()) in (1, 3), "it went to the other and came back, or stayed"
            waits = [after.at - first.at for first, after in zip(device.asked, device.asked[1:], strict=False)]
            assert max(waits) < 3.0, "far below the time of a lease; the bound of a planned move is judged elsewhere"
        assert any(len(device.owners()) == 3 for device in devices)


async def test_every_sample_has_the_epoch_in_which_it_was_taken(tmp_path: Path) -> None:
    async with devices_of(2) as devices:
        async with fleet(tmp_path, "one", devices) as one:
            await until(lambda: all(device.reads > 5 for device in devices))
            epochs = {link: one._active[link] for link in one.collector.loads()}
            await one.collector.flush()
            newest = one.collector.newest_commit
        with contextlib.closing(OwnershipLog(tmp_path / "one")) as log:
            rows = log.all()
            assert {row.link: row.epoch for row in rows} == epochs
            assert all(row.end is not None and row.last_commit is not None for row in rows)
            assert all(log.epoch_of(link, newest) == epoch for link, epoch in epochs.items())
            assert all(log.epoch_of(row.link, row.after_commit) is None for row in rows)
    found = busway.Store(tmp_path / "one").read("*/count")
    assert len(found) >= 10


async def test_a_lapsed_lease_sends_nothing_more_although_the_collector_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_collector.END_LIMIT", 0.1)
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))

        async def hang(*_: object) -> int:
            await asyncio.sleep(3600)
            raise AssertionError

        monkeypatch.setattr(one._driver._coordinator, "replace", hang)
        await until(lambda: not one.member.owned, 30)
        await until(lambda: not one.collector.loads())
        reads = [device.reads for device in devices]
        await asyncio.sleep(0.5)
        assert [device.reads for device in devices] == reads, "absence is the claim: nothing is sent in half a second"


async def test_links_whose_transactions_outlast_a_lease_are_refused_by_name(tmp_path: Path) -> None:
    text = plant(tmp_path / "store", [FleetDevice("hall", 502)], "timeout = 9")
    coordinator = await open_coordinator(f"local:{tmp_path}", "hall")
    try:
        with pytest.raises(ConfigError, match=r"transaction of link hall may take 12 s.*leaves 8 s"):
            FleetCollector(parse_collector(text, "x.toml"), coordinator, "one", host="box")
    finally:
        await coordinator.close()
