"""What operators tell a running collector: another configuration, a broken one, and that it hands everything on."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, plant
from waiting import until

from busway.apps.fleet.control_entries import (
    CONFIGURATION,
    apply_configuration,
    drain_collector,
    read_configuration,
    read_entries,
    record_times,
    recorded_times,
    refuse_other_figures,
)
from busway.apps.fleet.coordinator import Coordinator
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.shards import shard_of
from busway.apps.fleet.table_records import ZONE, LeaseRecord, MaintainedDevice, ZoneRecord, decode_lease
from busway.errors import ConfigError

pytestmark = pytest.mark.real_time


async def applied(table: Coordinator, tmp_path: Path, devices: list[FleetDevice]) -> int:
    file = tmp_path / "plant.toml"
    file.write_text(plant(tmp_path / "one", devices))
    return await apply_configuration(table, str(file))


@contextlib.asynccontextmanager
async def running(tmp_path: Path, devices: list[FleetDevice]) -> AsyncIterator[tuple[Coordinator, FleetCollector]]:
    table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        await applied(table, tmp_path, devices)
        shared = await read_configuration(table)
        assert shared is not None
        async with FleetCollector(
            shared.parsed(TIMES), table, "one", host="box", shards=2, times=TIMES, revision=shared.revision
        ) as collector:
            yield table, collector
    finally:
        await table.close()


async def test_what_polling_a_shard_costs_is_the_sum_of_its_links_by_the_configuration_that_holds(
    tmp_path: Path,
) -> None:
    async with devices_of(4) as devices, running(tmp_path, devices) as (table, one):
        assert {shard: len(links) for shard, links in one._links_of.items()} == {"0000": 1, "0001": 3}
        before = {shard: one.member.cost(shard) for shard in ("0000", "0001")}
        assert before["0001"] == pytest.approx(3 * before["0000"])
        slower = plant(tmp_path / "one", devices).replace("fast.period = 0.1", "fast.period = 0.4")
        (tmp_path / "plant.toml").write_text(slower)
        revision = await apply_configuration(table, str(tmp_path / "plant.toml"))
        await until(lambda: one.revision == revision and one.member.cost("0000") < before["0000"], 60)
        after = {shard: one.member.cost(shard) for shard in before}
        assert after == pytest.approx({shard: cost / 4 for shard, cost in before.items()})


async def test_a_running_collector_takes_links_that_come_and_leaves_links_that_go(tmp_path: Path) -> None:
    async with devices_of(4) as devices, running(tmp_path, devices[:3]) as (table, one):
        await until(lambda: all(device.reads > 1 for device in devices[:3]), 60)
        stays, goes = devices[0], devices[1]
        revision = await applied(table, tmp_path, [stays, *devices[2:]])
        await until(lambda: one.revision == revision and devices[3].reads > 1, 60)
        await until(lambda: set(one.collector.loads()) == {stays.name, devices[2].name, devices[3].name}, 60)
        reads = goes.reads
        commit = one.collector.newest_commit
        assert one.ownership.revision_of(commit + 1) == revision
        again = await applied(table, tmp_path, devices)
        await until(lambda: one.revision == again and goes.reads > reads, 60)


async def test_no_sample_of_the_configuration_before_has_the_newer_revision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with devices_of(2) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 1 for device in devices), 60)
        honest, recording, recorded = one.ownership.set_configuration, threading.Event(), threading.Event()

        def set_configuration(revision: int, commit: int) -> None:
            recording.set()
            recorded.wait(60)
            honest(revision, commit)

        monkeypatch.setattr(one.ownership, "set_configuration", set_configuration)
        file = tmp_path / "plant.toml"
        file.write_text(plant(tmp_path / "one", devices).replace("timeout = 0.5", "timeout = 0.4", 1))
        revision = await apply_configuration(table, str(file))
        await until(recording.is_set, 60)
        changed, other = (device.reads for device in devices)
        await until(lambda: devices[1].reads > other + 3, 60)  # it stays as it is, and is polled meanwhile
        reads = devices[0].reads
        recorded.set()
        assert reads == changed, "it was read between the last commit of the old revision and the new one"
        await until(lambda: one.revision == revision and devices[0].reads > changed, 60)


async def test_what_is_refused_changes_nothing_and_is_told(tmp_path: Path) -> None:
    async with devices_of(1) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: devices[0].reads > 1, 60)
        before = one.revision
        seen = (await read_entries(table, CONFIGURATION))[CONFIGURATION]
        await table.replace(CONFIGURATION, b"no configuration", seen.revision)
        await until(lambda: one.refused is not None, 60)
        assert f"revision {before} holds" in str(one.refused)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads, 60)
        revision = await applied(table, tmp_path, devices)
        await until(lambda: one.revision == revision, 60)
        assert one.refused is None


async def test_a_drained_collector_takes_nothing_until_it_may_take_part_again(tmp_path: Path) -> None:
    async with devices_of(1) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: bool(one.collector.loads()), 60)
        await drain_collector(table, "one")
        await until(lambda: one.member.members(0.0)[0].draining, 60)
        await drain_collector(table, "one", draining=False)
        await until(lambda: not one.member.members(0.0)[0].draining, 60)
        await until(lambda: bool(one.collector.loads()), 60)


async def test_a_name_that_no_collector_has_had_is_not_drained(tmp_path: Path) -> None:
    async with devices_of(1) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: bool(one.collector.loads()), 60)
        with pytest.raises(ConfigError, match="no collector has the name west; there are one"):
            await drain_collector(table, "west")


async def test_a_configuration_waits_while_what_is_owned_cannot_be_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with devices_of(3) as devices, running(tmp_path, devices[:2]) as (table, one):
        await until(lambda: all(device.reads > 1 for device in devices[:2]), 60)
        monkeypatch.setattr("busway.apps.fleet.fleet_collector.RECORD_AGAIN", 0.05)
        honest = one.ownership.end
        fails = True

        def end(*wanted: object) -> None:
            if fails:
                raise sqlite3.OperationalError("disk I/O error")
            honest(*wanted)  # type: ignore[arg-type]

        monkeypatch.setattr(one.ownership, "end", end)
        revision = await applied(table, tmp_path, [devices[0], devices[2]])
        await until(lambda: one.refused is not None, 60)
        assert one.refused == f"revision {revision} waits: what is owned cannot be recorded: disk I/O error"
        fails = False
        await until(lambda: one.revision == revision and devices[2].reads > 1, 60)
        assert one.refused is None
        gone = [each for each in one.ownership.all() if each.link == devices[1].name]
        assert gone[-1].end is not None, "the end of its ownership was recorded in the end"


async def test_a_collector_with_another_number_of_shards_than_its_zone_is_refused_at_its_start(tmp_path: Path) -> None:
    async with devices_of(1) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: bool(one.collector.loads()), 60)
        shared = await read_configuration(table)
        assert shared is not None
        other = FleetCollector(shared.parsed(TIMES), table, "two", host="box", shards=4, times=TIMES)
        with pytest.raises(ConfigError, match="the zone has 2 shards and not 4"):
            async with other:
                raise AssertionError("it must not start")
        assert ZoneRecord(2, TIMES.ttl, TIMES.guard).encode() == (await read_entries(table, "zone"))["zone"].value


async def test_a_file_is_checked_against_the_leases_that_the_zone_has(tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(plant(tmp_path / "one", [FleetDevice("link-0", 502)], "timeout = 2\nconnect_timeout = 2"))
    table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        first = await apply_configuration(table, str(file))
        await table.create(ZONE, ZoneRecord(8, 5.0, 0.5).encode())
        with pytest.raises(ConfigError, match=r"a lease of 5 s leaves 2\.5 s"):
            await apply_configuration(table, str(file))
        shared = await read_configuration(table)
        assert shared is not None
        assert shared.revision == first
    finally:
        await table.close()


async def test_how_long_leases_hold_is_recorded_for_collectors_that_start_later(tmp_path: Path) -> None:
    table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        assert await recorded_times(table) == LeaseTimes()
        longer = LeaseTimes.lasting(60.0)
        await record_times(table, longer, 8)
        assert await recorded_times(table) == longer
        await record_times(table, LeaseTimes.lasting(30.0), 256)
        assert (await read_entries(table, ZONE))[ZONE].value == ZoneRecord(8, 30.0, 2.0).encode(), "it has 8 shards"
        await refuse_other_figures(table, 8, LeaseTimes.lasting(30.0))
        with pytest.raises(
            ConfigError, match="the zone has leases of 30 s and not 15, a guard of 2 s and not 1"
        ) as told:
            await refuse_other_figures(table, 8, LeaseTimes())
        assert told.value.key == "times"
    finally:
        await table.close()


class Elsewhere:
    """A table that collectors of several machines share, as far as it says."""

    def __init__(self, inner: Coordinator) -> None:
        self.create, self.replace, self.watch, self.close = inner.create, inner.replace, inner.watch, inner.close


async def test_a_serial_port_without_its_host_is_refused_unless_all_collectors_are_on_one_machine(
    tmp_path: Path,
) -> None:
    file = tmp_path / "plant.toml"
    text = plant(tmp_path / "one", [FleetDevice("link-0", 502)], "timeout = 1")
    text = text.replace("tcp://127.0.0.1:502", "rtu:///dev/ttyUSB0")
    file.write_text(text)
    table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        with pytest.raises(ConfigError, match="is a port of one machine"):
            await apply_configuration(Elsewhere(table), str(file))
        assert await read_configuration(table) is None
        await apply_configuration(table, str(file))
        shared = await read_configuration(table)
        assert shared is not None
        with pytest.raises(ConfigError, match="is a port of one machine"):
            FleetCollector(shared.parsed(TIMES), Elsewhere(table), "one", host="box", shards=2, times=TIMES)
        file.write_text(text.replace("[[device]]", 'hosts = ["box"]\n[[device]]'))
        await apply_configuration(Elsewhere(table), str(file))
    finally:
        await table.close()


async def test_a_link_that_is_renamed_while_a_collector_lives_is_refused_in_one_step_and_taken_in_two(
    tmp_path: Path,
) -> None:
    async with devices_of(2) as devices:
        renamed = FleetDevice("renamed", devices[1].port)
        async with running(tmp_path, devices) as (table, one):
            await until(lambda: all(device.reads > 1 for device in devices), 60)
            with pytest.raises(ConfigError, match=r"is that of link link-1, and would be that of link renamed"):
                await applied(table, tmp_path, [devices[0], renamed])
            shared = await read_configuration(table)
            assert shared is not None
            assert shared.revision == one.revision
            without = await applied(table, tmp_path, devices[:1])
            await until(lambda: one.revision == without, 60)
            again = await applied(table, tmp_path, [devices[0], renamed])
            await until(lambda: one.revision == again and "renamed" in one.links, 60)
            await one._driver.end(30)
            await applied(table, tmp_path, devices)  # no collector lives


async def maintenance_is_told(table: Coordinator, shard: str, expected: bool) -> None:
    async with asyncio.timeout(60):
        async for entry in table.watch(f"lease.{shard}"):
            lease = decode_lease(entry.value)
            if lease is not None and bool(lease.maintenance) is expected:
                return


@pytest.mark.parametrize("is_running", [True, False])
async def test_a_device_in_maintenance_does_not_go_to_a_link_of_another_shard(tmp_path: Path, is_running: bool) -> None:
    async with devices_of(2) as devices, running(tmp_path, devices) as (table, one):
        await until(lambda: all(device.reads > 1 for device in devices), 60)
        moved = tmp_path / "moved.toml"
        text = plant(tmp_path / "one", devices)
        moved.write_text(text.replace('name = "link-0"\nlink = "link-0"', 'name = "link-0"\nlink = "link-1"\n', 1))
        assert one.shard_of("link-0") != one.shard_of("link-1")
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        await maintenance_is_told(table, one.shard_of("link-0"), True)
        if not is_running:
            await one._driver.end(30)
        with pytest.raises(ConfigError, match=r"link-0 is in maintenance, .* from link link-0 to link link-1"):
            await apply_configuration(table, str(moved))
        if is_running:
            one.collector.maintenance("link-0", begins=False, by="anna", why="done")
            await maintenance_is_told(table, one.shard_of("link-0"), False)
            newer = await apply_configuration(table, str(moved))
            await until(lambda: one.revision == newer, 60)


async def test_a_collector_leaves_a_device_alone_whose_maintenance_is_older_than_its_configuration_of_it(
    tmp_path: Path,
) -> None:
    """The owner before had a newer configuration, with that device."""
    row = MaintainedDevice("link-2", time.time_ns(), "anna", "new sensor")
    lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=time.time() - 100.0, maintenance=(row,))
    async with devices_of(3) as devices:
        shard = shard_of("link-2", 2)
        assert shard == shard_of("link-0", 2)
        table = await open_coordinator(f"local:{tmp_path}/zone", "hall")
        await table.create(f"lease.{shard}", lease.encode())
        await table.close()
        older = [device for device in devices if device.name != "link-2"]
        async with running(tmp_path, older) as (table, one):
            await until(lambda: all(device.reads > 1 for device in older), 60)
            assert one.collector.in_maintenance() == {}
            await maintenance_is_told(table, shard, True)
            assert one.member.owned[shard].maintenance == (row,)
            revision = await applied(table, tmp_path, devices)
            await until(lambda: one.revision == revision and "link-2" in one.links, 60)
            reads = devices[0].reads
            await until(lambda: devices[0].reads > reads + 5, 60)
            assert devices[2].reads == 0
            assert one.collector.in_maintenance()["link-2"].begin == row.begin
            one.collector.maintenance("link-2", begins=False, by="anna", why="done")
            await until(lambda: devices[2].reads > 0, 60)
            await maintenance_is_told(table, shard, False)
