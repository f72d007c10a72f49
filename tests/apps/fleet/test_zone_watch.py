"""A watch of a zone: who lives by this process's clock, and the times in which shards had no owner."""

import asyncio
from collections.abc import AsyncGenerator
from pathlib import Path

import pytest
from fleet_devices import TIMES, devices_of, parsed
from waiting import until

from busway.apps.fleet.coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, CoordinatorDown, Entry
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_metrics import fleet_families
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.streams import SinkCursors
from busway.apps.fleet.table_records import LeaseHole, LeaseRecord, MemberRecord
from busway.apps.fleet.zone_watch import OwnershipHole, ZoneWatch
from busway.errors import ConfigError


class Zone:
    """A watch that is fed by hand."""

    def __init__(self) -> None:
        self.now, self.revision = 0.0, 0
        self.watch = ZoneWatch(None, LeaseTimes(), now=lambda: self.now)  # type: ignore[arg-type]

    def change(self, key: str, value: bytes) -> None:
        self.revision += 1
        self.watch.take(Entry(key, value, self.revision))

    def lease(
        self, owner: str, *, held: bool = True, count: int = 0, at: float = 0.0, hole: LeaseHole | None = None
    ) -> None:
        self.change("lease.0001", LeaseRecord(owner, owner, held, count, 0.25, None, at=at, hole=hole).encode())


def test_a_takeover_is_a_hole_since_the_last_renewal_and_a_move_since_the_release() -> None:
    zone = Zone()
    zone.lease("west", at=100.0)
    zone.lease("west", count=1, at=103.0)
    assert zone.watch.holes() == []
    silent = LeaseHole("west", True, 103.0, 119.0)
    zone.lease("east", at=119.0, hole=silent)
    zone.lease("east", count=1, at=122.0, hole=silent)
    zone.lease("east", held=False, count=2, at=123.0, hole=silent)
    assert zone.watch.status().leases["0001"].held is False
    zone.lease("west", at=123.2, hole=LeaseHole("east", False, 123.0, 123.2))
    assert zone.watch.holes() == [
        OwnershipHole("0001", "east", "west", False, 123.0, 123.2, Epoch(1, 6)),
        OwnershipHole("0001", "west", "east", True, 103.0, 119.0, Epoch(1, 3)),
    ]
    assert zone.watch.status().leases["0001"].epoch == Epoch(1, 6)


def test_a_collector_lives_while_its_entry_changes_within_a_lease() -> None:
    zone = Zone()
    zone.change("member.west", MemberRecord("west", "r", "box", 1, behind=7).encode())
    zone.now = 15.0
    assert zone.watch.status().members["west"].state == "polls"
    assert zone.watch.status().members["west"].record.behind == 7
    zone.now = 16.5
    assert zone.watch.status().members["west"].state == "silent"
    zone.change("member.west", MemberRecord("west", "r", "box", 2, problem="its clock is wrong").encode())
    assert zone.watch.status().members["west"].state == "refuses"


def test_marks_old_entries_and_unreadable_ones_change_nothing() -> None:
    zone = Zone()
    zone.lease("west", at=100.0)
    zone.watch.take(SNAPSHOT_BEGINS)
    assert not zone.watch.is_complete
    zone.watch.take(Entry("lease.0001", LeaseRecord("old", "old", True, 0, 0.1, None, at=1.0).encode(), 1))
    zone.watch.take(SNAPSHOT_ENDS)
    assert zone.watch.is_complete
    assert zone.watch.status().leases["0001"].owner == "west"
    zone.change("cursor.history", SinkCursors(42, {}).encode())
    zone.change("cursor.newer", b"{}")
    zone.change("cursor.infinite", b"[1e999,{},{}]")
    zone.change("lease.0002", b"not a lease")
    assert zone.watch.sinks() == {"history": 42}
    assert list(zone.watch.status().leases) == ["0001"]
    assert zone.watch.holes() == []


def test_what_was_shown_with_a_revision_that_was_too_high_is_replaced_when_the_table_is_read_anew() -> None:
    zone = Zone()
    east, west = (LeaseRecord(name, "run", True, 1, 0.1, None, at=1.0).encode() for name in ("east", "west"))
    zone.watch.take(Entry("lease.0001", east, 65))
    zone.watch.take(SNAPSHOT_BEGINS)
    zone.watch.take(Entry("lease.0001", west, 51))
    assert zone.watch.status().leases["0001"].owner == "west"
    zone.watch.take(Entry("lease.0001", east, 50))
    assert zone.watch.status().leases["0001"].owner == "west"


async def test_a_configuration_that_cannot_be_read_does_not_end_the_watch_of_owners(tmp_path: Path) -> None:
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        async with ZoneWatch(coordinator) as watch:
            await coordinator.create("control.configuration", b"not one")
            first = await coordinator.create("lease.0001", LeaseRecord("west", "run", True, 0, 0.1, None).encode())
            await until(lambda: "lease.0001" in watch._entries)
            hole = LeaseHole("west", True, 103.0, 119.0)
            taken = LeaseRecord("east", "run", True, 0, 0.1, None, hole=hole).encode()
            second = await coordinator.replace("lease.0001", taken, first)
            await until(watch.holes)
            assert [(each.after, each.epoch) for each in watch.holes()] == [("east", Epoch(1, second))]
            with pytest.raises(ConfigError, match="cannot be read"):
                watch.status()
    finally:
        await coordinator.close()


class Breaking(LocalCoordinator):
    """A table whose first watch ends by an error after it has shown all."""

    error: Exception | None = None

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        async for entry in super().watch(prefix):
            yield entry
            if entry is SNAPSHOT_ENDS and self.error is not None:
                error, self.error = self.error, None
                raise error


@pytest.mark.parametrize("error", [RuntimeError("it cannot be"), CoordinatorDown("it is away")], ids=repr)
async def test_a_watch_that_ends_by_an_error_is_logged_and_begun_again(
    tmp_path: Path, error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    coordinator = await asyncio.to_thread(Breaking, tmp_path, "hall")
    coordinator.error = error
    try:
        async with ZoneWatch(coordinator) as watch:
            await until(lambda: coordinator.error is None and not watch.is_complete)
            await until(lambda: watch.is_complete)
            await coordinator.create("member.west", MemberRecord("west", "r", "box", 1).encode())
            await until(lambda: "west" in watch.status().members)
        assert "the table of the zone cannot be followed; it is read anew" in caplog.text
    finally:
        await coordinator.close()


async def test_a_table_that_can_never_be_read_is_told_and_nothing_of_it_counts_as_known(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    coordinator = await asyncio.to_thread(Breaking, tmp_path, "hall")
    coordinator.error = ConfigError("the credentials do not permit it", key="coordinator")
    try:
        async with ZoneWatch(coordinator) as watch:
            await until(lambda: "the status of the zone is not known: its table cannot be followed" in caplog.text)
            assert not watch.is_complete
    finally:
        await coordinator.close()


@pytest.mark.real_time
async def test_a_collector_of_a_fleet_shows_its_metrics_to_prometheus(tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client")
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        async with devices_of(2) as devices:
            made = parsed(tmp_path, "one", devices)
            async with FleetCollector(made, coordinator, "one", host="one", shards=8, times=TIMES) as one:
                await until(lambda: len(one.collector.loads()) == 2, 60)
                families = {family.name: family for family in fleet_families(one)}
        values = {name: family.samples[0].value for name, family in families.items()}
        assert (values["busway_fleet_shards"], values["busway_fleet_may_own"]) == (2, 1)
        assert values["busway_fleet_load"] > 0
        assert {sample.labels["event"]: sample.value for sample in families["busway_fleet_leases"].samples}[
            "taken"
        ] == 2
    finally:
        await coordinator.close()
