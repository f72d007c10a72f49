"""A device in maintenance is left alone, whatever happens to the lease of its link; what has ended stays ended."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, parsed
from waiting import until

import busway
from busway.apps.collector.configuration import CollectorConfiguration
from busway.apps.collector.samples import Reason
from busway.apps.collector.store.manifest import MaintenanceRow
from busway.apps.fleet.control_entries import read_entries
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_holder import OwnershipChange, ShardEvent
from busway.apps.fleet.shards import shard_of
from busway.apps.fleet.table_records import LeaseRecord, MaintainedDevice, decode_lease
from busway.errors import ConfigError

LINKS = 8

pytestmark = pytest.mark.real_time


class FailingTable(LocalCoordinator):
    """A table that takes no changes while ``is_down``."""

    is_down: bool = False

    async def create(self, key: str, value: bytes) -> int:
        self._check()
        return await super().create(key, value)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        self._check()
        return await super().replace(key, value, revision)

    def _check(self) -> None:
        if self.is_down:
            raise CoordinatorDown("no server answers")


@contextlib.asynccontextmanager
async def fleet(
    tmp_path: Path, devices: list[FleetDevice], name: str = "one"
) -> AsyncIterator[tuple[FailingTable, FleetCollector]]:
    table = await asyncio.to_thread(FailingTable, tmp_path / "zone", "hall")
    try:
        configuration = parsed(tmp_path, name, devices)
        async with FleetCollector(configuration, table, name, host="box", shards=LINKS, times=TIMES) as collector:
            yield table, collector
    finally:
        await table.close()


async def lease_of(table: LocalCoordinator, shard: str) -> tuple[LeaseRecord, int]:
    entry = (await read_entries(table, f"lease.{shard}"))[f"lease.{shard}"]
    lease = decode_lease(entry.value)
    assert lease is not None
    return lease, entry.revision


async def until_it_says(table: LocalCoordinator, shard: str, *expected: str) -> None:
    """Wait until the lease of a shard says that these devices are in maintenance."""
    async with asyncio.timeout(60), contextlib.aclosing(table.watch(f"lease.{shard}")) as entries:
        async for entry in entries:
            lease = decode_lease(entry.value)
            if lease is not None and [each.device for each in lease.maintenance or ()] == list(expected):
                return


async def taken_and_released_by_another(
    table: FailingTable,
    one: FleetCollector,
    shard: str,
    maintenance: Sequence[MaintainedDevice],
    *,
    is_later: bool = True,
) -> None:
    """Another collector has had the shard while this one was cut off, and gives it back."""
    epoch = one.member.owned[shard].epoch
    table.is_down = True
    await until(lambda: shard not in one.member.owned, 60)
    _, revision = await lease_of(table, shard)
    theirs = Epoch(epoch.generation, revision + 1) if is_later else Epoch(epoch.generation, epoch.revision - 1)
    lease = LeaseRecord("two", "run", False, 9, 0.01, theirs, at=time.time(), maintenance=tuple(maintenance))
    await LocalCoordinator.replace(table, f"lease.{shard}", lease.encode(), revision)
    table.is_down = False
    await until_owned_again(one, shard)


async def until_owned_again(one: FleetCollector, shard: str) -> None:
    def is_polled() -> bool:
        owned = one.member.owned.get(shard)
        return owned is not None and one._begun.get(shard) == owned.epoch and "link-0" in one.links

    await until(is_polled, 60)


async def configured(one: FleetCollector, configuration: CollectorConfiguration, revision: int) -> None:
    """Give the collector a newer configuration, and wait until it is in force."""
    one._newer = configuration, revision
    one._wake.set()
    await until(lambda: one.revision == revision, 60)


@contextlib.contextmanager
def sample_time_stands(one: FleetCollector, at: int) -> Iterator[None]:
    """The clock of the collector's samples shows this time, in nanoseconds since 1970 UTC."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(one.collector._clock, "time_ns", lambda now: at)
        yield


async def is_left_alone(device: FleetDevice, other: FleetDevice) -> None:
    """The other device is read on."""
    before, reads = device.reads, other.reads
    await until(lambda: other.reads > reads + 5, 60)
    assert device.reads == before


@pytest.mark.parametrize("step", [OwnershipChange.LEAVE, OwnershipChange.LOST, None])
async def test_maintenance_stays_in_the_lease_of_a_shard_that_is_gone_again_before_it_was_polled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: OwnershipChange | None
) -> None:
    """Without a step the shard is to be given away when its begin is recorded, and the event of that comes later."""
    row = MaintainedDevice("link-0", time.time_ns(), "anna", "new sensor")
    table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    lease = LeaseRecord("dead", "run", False, 7, 0.01, Epoch(1, 1), at=time.time() - 1.0, maintenance=(row,))
    for number in range(LINKS):
        await table.create(f"lease.{number:04d}", lease.encode())
    await table.close()
    shard = shard_of("link-0", LINKS)
    honest = FleetCollector._apply
    brief: list[ShardEvent] = []

    async def apply(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        if not brief:
            brief.extend(event for event in events if event.shard == shard and event.change is OwnershipChange.GAINED)
            for event in brief:
                if step is OwnershipChange.LOST:
                    del one.member.owned[event.shard]
                else:
                    one.member.owned[event.shard].leaving = ""
            ended = [ShardEvent(each.shard, step or OwnershipChange.LEAVE, each.epoch) for each in brief]
            if step is None:
                one._waiting += ended
                one._wake.set()
            else:
                events = [*events, *ended]
        await honest(one, events)

    monkeypatch.setattr(FleetCollector, "_apply", apply)
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (_, one):
        await until_owned_again(one, shard)
        await is_left_alone(*devices)
        assert one.member.owned[shard].epoch > brief[0].epoch
        assert dict(one.collector.in_maintenance()) == {
            "link-0": MaintenanceRow("link-0", row.begin, "anna", "new sensor")
        }
        assert devices[0].reads == 0
        refused = await one.collector.write("link-0", "count", 1, by="ben")
        assert "in maintenance" in refused.reason


async def test_a_maintenance_that_no_lease_has_said_is_not_ended_by_an_owner_that_did_not_know_it(
    tmp_path: Path,
) -> None:
    """It began when the coordinator was not reached."""
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        table.is_down = True
        await until(lambda: not one.is_confirmed, 60)
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        row = one.collector.in_maintenance()["link-0"]
        shard = one.shard_of("link-0")
        await taken_and_released_by_another(table, one, shard, ())
        await until_it_says(table, shard, "link-0")
        await is_left_alone(*devices)
        assert one.collector.in_maintenance() == {"link-0": row}


async def test_a_maintenance_that_another_owner_has_ended_ends_here_but_not_by_an_older_table(tmp_path: Path) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        shard = one.shard_of("link-0")
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        row = one.collector.in_maintenance()["link-0"]
        await until_it_says(table, shard, "link-0")
        await taken_and_released_by_another(table, one, shard, (), is_later=False)
        await until_it_says(table, shard, "link-0")
        await is_left_alone(*devices)
        assert one.collector.in_maintenance() == {"link-0": row}
        reads = devices[0].reads
        await taken_and_released_by_another(table, one, shard, ())
        await until(lambda: devices[0].reads > reads + 3, 60)
        assert one.collector.in_maintenance() == {}


@pytest.mark.parametrize("begins_again", [False, True])
async def test_a_maintenance_that_ended_while_no_lease_could_say_so_does_not_come_back_by_that_lease(
    tmp_path: Path, begins_again: bool
) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        shard = one.shard_of("link-0")
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        begin = one.collector.in_maintenance()["link-0"].begin
        await until_it_says(table, shard, "link-0")
        table.is_down = True
        one.collector.maintenance("link-0", begins=False, by="anna", why="done")
        reads, epoch = devices[0].reads, one.member.owned[shard].epoch
        if begins_again:  # at the same time, as far as clocks can tell
            with sample_time_stands(one, begin):
                one.collector.maintenance("link-0", begins=True, by="anna", why="once more")
        await until(lambda: shard not in one.member.owned, 60)
        table.is_down = False
        await until_owned_again(one, shard)
        assert one.member.owned[shard].epoch > epoch
        if begins_again:
            await is_left_alone(*devices)
            assert one.collector.in_maintenance()["link-0"].why == "once more"
        else:
            await until(lambda: devices[0].reads > reads + 3, 60)
            assert one.collector.in_maintenance() == {}
            await until_it_says(table, shard)


async def test_no_maintenance_begins_or_ends_at_a_collector_that_has_lost_the_link(tmp_path: Path) -> None:
    """It would count here, where the device is not polled any more, and no lease would say it."""
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (_, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        shard = one.shard_of("link-0")
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        one.member._lose(shard, "two has it")
        for event in one.member.events():
            one._told(event)
        for begins in (True, False):
            with pytest.raises(ConfigError, match="the link of link-0 is not owned by this collector now"):
                one.collector.maintenance("link-0", begins=begins, by="ben")
        assert one.collector.in_maintenance()["link-0"].by == "anna"


async def test_a_lease_says_the_maintenance_of_a_device_that_the_configuration_has_lost_and_gets_again(
    tmp_path: Path,
) -> None:
    """The owner in between has the newest configuration already."""
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        shard = one.shard_of("link-0")
        whole = one._configuration
        kept = {name: each for name, each in whole.devices.items() if name != "link-0"}
        await configured(one, replace(whole, devices=kept), 7)
        row = MaintainedDevice("link-0", time.time_ns(), "anna", "new sensor")
        await taken_and_released_by_another(table, one, shard, (row,))
        await until_it_says(table, shard, "link-0")
        reads = devices[0].reads
        await configured(one, whole, 8)
        await is_left_alone(*devices)
        assert devices[0].reads == reads
        assert one.collector.in_maintenance()["link-0"].begin == row.begin


async def test_a_device_that_the_configuration_has_lost_is_in_maintenance_no_longer_when_it_comes_again(
    tmp_path: Path,
) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        shard, whole = one.shard_of("link-0"), one._configuration
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        await until_it_says(table, shard, "link-0")
        kept = {name: each for name, each in whole.devices.items() if name != "link-0"}
        for revision, configuration in ((7, replace(whole, devices=kept)), (8, whole)):
            await configured(one, configuration, revision)
            await until_it_says(table, shard)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads + 3, 60)
        assert one.collector.in_maintenance() == {}


async def test_a_maintenance_that_begins_ends_and_begins_in_one_moment_goes_on(tmp_path: Path) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 3 for device in devices), 60)
        at = one.collector.sample_time()
        with sample_time_stands(one, at):
            for begins in (True, False, True):
                one.collector.maintenance("link-0", begins=begins, by="anna", why=f"begins {begins}")
        shard = one.shard_of("link-0")
        await until_it_says(table, shard, "link-0")
        _, revision = await lease_of(table, shard)
        await until(lambda: one.member.owned[shard].revision > revision, 60)  # what was sent before is answered
        await until_it_says(table, shard, "link-0")
        await is_left_alone(*devices)
        assert one.collector.in_maintenance()["link-0"].begin == at
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "link-0/count")
        (interval,) = [each for each in found.intervals if each.reason == Reason.MAINTENANCE and each.end != each.begin]
        assert (interval.begin, interval.end) == (at, None)
