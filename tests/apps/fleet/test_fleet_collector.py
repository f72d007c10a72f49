"""Collectors of a fleet against devices that write down who asks them."""

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fleet_devices import LONG_TIMES, TIMES, FleetDevice, devices_of, parsed, plant
from waiting import until

import busway
from busway.apps.collector.collector import Collector
from busway.apps.collector.configuration import parse_collector
from busway.apps.collector.samples import Reason
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet.control_entries import CONFIGURATION
from busway.apps.fleet.coordinator import CoordinatorDown, Entry
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_driver import boot_time
from busway.apps.fleet.lease_holder import OwnedShard, OwnershipChange, ShardEvent
from busway.apps.fleet.ownership_log import OWNERSHIP, OwnershipLog
from busway.apps.fleet.table_records import LeaseRecord
from busway.errors import ConfigError, LinkDown, NoReply
from busway.pdu.read_items import ReadHoldingRegisters

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


async def test_collectors_have_equal_seconds_of_line_time_and_not_equal_numbers_of_links(tmp_path: Path) -> None:
    """One link is read seven times as often as each of the seven others: it is half of the work."""
    async with devices_of(8) as devices, contextlib.AsyncExitStack() as stack:
        both = []
        for name in ("one", "two"):
            text = plant(tmp_path / name, devices).replace("fast.period = 0.1", "fast.period = 0.1\nslow.period = 0.7")
            first, *others = text.split("[[link]]")[1:]
            slow = [each.replace('"fast"', '"slow"') for each in others]
            text = "[[link]]".join([text.split("[[link]]")[0], first, *slow])
            coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
            stack.push_async_callback(coordinator.close)
            fleet = FleetCollector(
                parse_collector(text, f"{name}.toml"), coordinator, name, host=name, shards=64, times=TIMES
            )
            both.append(await stack.enter_async_context(fleet))
        one, two = both
        costs = {link: one.member.cost(one.shard_of(link)) for link in one._configuration.links}
        assert [costs[f"link-{number}"] / costs["link-0"] for number in range(1, 8)] == pytest.approx([1 / 7] * 7)
        assert costs["link-7"] > 0.001, "it is not the least that a link costs"
        await until(lambda: sorted((len(one.links), len(two.links))) == [1, 7], 60)
        (alone,) = min(one.links, two.links, key=len)
        assert alone == "link-0"


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


async def test_a_shard_is_released_once_all_samples_of_its_links_are_committed_in_its_epoch(tmp_path: Path) -> None:
    released: list[tuple[int, int, list[int]]] = []
    async with devices_of(2) as devices:
        async with fleet(tmp_path, "one", devices) as one:
            honest = one.member.left

            def left(shard: str) -> None:
                counts = [device.reads for device in devices if one.shard_of(device.name) == shard]
                released.append((one.collector.newest_commit, *counts))
                honest(shard)

            one.member.left = left  # type: ignore[method-assign]
            await until(lambda: all(device.reads > 5 for device in devices))
            epochs = dict(one._active)
        assert len(released) == 2
        with (
            contextlib.closing(OwnershipLog(tmp_path / "one")) as log,
            StoreWriter(tmp_path / "one", now=time.time_ns()) as writer,
        ):
            found = CommitReader(tmp_path / "one", writer.manifest).read(0, 10_000)
            assert found is not None
            samples = [each for each in found.samples if each.value is not None]
            assert all(log.epoch_of(each.device, each.commit) == epochs[each.device] for each in samples)
            for newest, reads in released:
                assert reads in [each.value for each in samples if each.commit <= newest], "the last one too"


class HangingDisk:
    """Lets no flush of a collector succeed until `ends`, and counts those that were tried."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("busway.apps.fleet.fleet_collector.RECORD_AGAIN", 0.02)
        monkeypatch.setattr(Committer, "flush", self._flush)
        self.hangs, self.tried = False, 0

    def _flush(self, *_: float) -> bool:
        self.tried += 1
        return not self.hangs

    async def was_tried(self) -> None:
        """Wait for two flushes that fail: what follows the first one has been done."""
        self.hangs = True
        before = self.tried
        await until(lambda: self.tried > before + 1)


async def test_a_shard_whose_samples_wait_for_a_hanging_disk_is_not_released_and_does_not_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    disk = HangingDisk(monkeypatch)
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        disk.hangs = True
        one.member.end()
        one._driver.wake()
        await disk.was_tried()
        assert not one.links, "nothing is polled any more"
        assert [each.leaving for each in one.member.owned.values()] == ["", ""]
        assert not any(each.has_left for each in one.member.owned.values())
        assert [row.end for row in one.ownership.all()] == [None, None]
        assert "what is owned does not change: samples that were taken before are not on disk yet" in caplog.text
        disk.hangs = False
        await until(lambda: one.member.has_ended)
        assert None not in [row.end for row in one.ownership.all()]


async def test_a_shard_is_not_begun_while_samples_wait_for_a_hanging_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = HangingDisk(monkeypatch)
    disk.hangs = True
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: one.member.owned)
        await disk.was_tried()
        assert not one.ownership.all()
        assert not devices[0].reads
        disk.hangs = False
        await until(lambda: devices[0].reads > 3)
        (row,) = one.ownership.all()
        assert row.epoch == one._active["link-0"]


async def test_a_configuration_waits_for_samples_that_wait_for_a_hanging_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = HangingDisk(monkeypatch)
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        disk.hangs = True
        one._newer = parsed(tmp_path, "one", devices[1:]), 7
        one._wake.set()
        await disk.was_tried()
        assert one.revision == 0
        assert one.refused is not None
        assert one.refused.startswith("revision 7 waits: ")
        assert [row.end for row in one.ownership.all()] == [None, None]
        disk.hangs = False
        await until(lambda: one.refused is None)
        assert one.revision == 7
        assert [row.link for row in one.ownership.all() if row.end is not None] == ["link-0"]


async def test_a_refused_revision_is_reported_also_while_an_older_one_waits_for_the_disk_and_after_it_was_applied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = HangingDisk(monkeypatch)
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        disk.hangs = True
        one._newer = parsed(tmp_path, "one", devices[1:]), 5
        one._wake.set()
        await disk.was_tried()
        await one._check(Entry(CONFIGURATION, b"damaged", 6))
        assert (one.refused or "").startswith("revision 6 is refused, revision 0 holds: ")
        one._wake.set()
        await disk.was_tried()
        assert (one.refused or "").startswith("revision 6 is refused, revision 0 holds: ")
        disk.hangs = False
        await until(lambda: one.revision == 5)
        await until(lambda: one._newer is None)
        assert (one.refused or "").startswith("revision 6 is refused, revision 5 holds: ")


async def test_a_collector_of_which_a_part_has_ended_says_so_and_another_takes_its_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_collector.END_LIMIT", 0.1)
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        broken = asyncio.create_task(_breaks(), name="busway fleet links")
        broken.add_done_callback(one._part_ended)
        await asyncio.wait([broken])
        await until(lambda: bool(one.problem))
        assert "busway fleet links has ended: it cannot be; start this collector again" in one.problem
        assert "collector one owns nothing" in caplog.text
        async with fleet(tmp_path, "two", devices) as two:
            await until(lambda: len(two.collector.loads()) == 2, 30)
            assert all(each.done() for each in one._tasks)


async def _breaks() -> None:
    raise RuntimeError("it cannot be")


class NoRights(LocalCoordinator):
    """A table that this collector may never read as a whole."""

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        if not prefix:
            raise ConfigError("the credentials do not permit to read the zone hall", key="coordinator")
        async for entry in super().watch(prefix):
            yield entry


async def test_a_collector_that_may_not_read_the_table_says_so_in_the_words_of_that_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    coordinator = await asyncio.to_thread(NoRights, tmp_path / "zone", "hall")
    try:
        async with devices_of(1) as devices:
            configuration = parsed(tmp_path, "one", devices)
            async with FleetCollector(configuration, coordinator, "one", host="one", shards=8, times=TIMES) as one:
                await until(lambda: bool(one.problem))
                assert "busway fleet member has ended: coordinator: the credentials do not permit" in one.problem
        (line,) = [each for each in caplog.messages if "collector one owns nothing" in each]
        assert "the credentials do not permit to read the zone hall" in line
        assert "TaskGroup" not in line
    finally:
        await coordinator.close()


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


async def test_the_connection_of_a_link_that_is_lost_ends_before_anything_else_is_sent_to_its_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        honest = one._driver._coordinator.replace

        async def away(*_: object) -> int:
            raise CoordinatorDown("it is away")

        monkeypatch.setattr(one._driver._coordinator, "replace", away)
        await until(lambda: not one.member.owned, 30)
        await until(lambda: all(device.ended for device in devices), 30)
        ends = max(at for device in devices for at, _ in device.ended)
        monkeypatch.setattr(one._driver._coordinator, "replace", honest)
        await until(lambda: all(len(device.owners()) > 1 for device in devices), 30)
        for device in devices:
            first, second = device.owners()
            assert device.ended == [(device.ended[0][0], first)]
            assert max(each.at for each in device.asked if each.peer == first) <= device.ended[0][0]
            assert min(each.at for each in device.asked if each.peer == second) > ends


async def test_a_frame_that_a_line_keeps_back_does_not_leave_after_the_lease_has_lapsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames: list[float] = []

    async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while await reader.read(300):
                frames.append(boot_time())
        writer.close()

    server = await asyncio.start_server(silent, "127.0.0.1", 0)
    line = FleetDevice("line", server.sockets[0].getsockname()[1])
    text = plant(tmp_path / "one", [line]).replace("tcp://", "rtu+tcp://")
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        configuration = parse_collector(text, "one.toml")
        async with FleetCollector(configuration, coordinator, "one", host="box", shards=1, times=TIMES) as one:
            await until(lambda: one.links and one.collector._links)
            link = one.collector._links["line"].poller.link

            async def asked() -> object:
                (outcome,) = await link.run(1, [ReadHoldingRegisters(0, 1)], {"timeout": 0.5, "retries": 0})
                return outcome

            assert isinstance(await asked(), NoReply)
            waiting = asyncio.create_task(asked())  # the unit owes a reply: what was permitted waits on the line
            await asyncio.sleep(0.05)
            assert one._permitted["line"] > frames[-1]
            monkeypatch.setattr(one.member, "permits", lambda *_: False)
            sent = len(frames)
            assert isinstance(await waiting, LinkDown)
            await asyncio.sleep(1.0)
            assert len(frames) == sent, "absence is the claim: what was kept back is not sent"
    finally:
        server.close()
        await coordinator.close()


async def test_links_whose_epoch_cannot_be_recorded_are_polled_when_it_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_collector.RECORD_AGAIN", 0.05)
    honest, fails = OwnershipLog.begin, [True]

    def begin(log: OwnershipLog, *wanted: Any) -> None:
        if fails:
            raise sqlite3.OperationalError("database or disk is full")
        honest(log, *wanted)

    monkeypatch.setattr(OwnershipLog, "begin", begin)
    async with devices_of(3) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: len(one.member.owned) > 0 and "epochs cannot be recorded" in caplog.text, 60)
        assert not any(device.reads for device in devices)
        fails.clear()
        await until(lambda: all(device.reads > 1 for device in devices), 60)


async def test_a_shard_that_is_lost_while_its_epoch_is_recorded_is_not_polled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        honest, recorded = one.ownership.begin, threading.Event()

        def begin(*wanted: Any) -> None:
            honest(*wanted)
            one.member.owned.clear()
            recorded.set()

        monkeypatch.setattr(one.ownership, "begin", begin)
        await until(recorded.is_set, 60)
        for _ in range(20):
            await asyncio.sleep(0.01)
            assert not one.links or one.member.owned, "a link is active only while its shard is owned"


async def test_who_takes_links_from_a_silent_owner_records_the_gap_since_its_last_renewal(tmp_path: Path) -> None:
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    renewed = time.time() - 100.0
    for shard in range(LINKS):
        lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=renewed)
        await coordinator.create(f"lease.{shard:04d}", lease.encode())
    await coordinator.close()
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
        gaps = {each.device: each for each in found.intervals if each.reason == Reason.OWNERSHIP}
        assert set(gaps) == {"link-0", "link-1"}
        first = {
            device: min(t for d, t in zip(found.device, found.time, strict=True) if d == device) for device in gaps
        }
        for device, gap in gaps.items():
            assert gap.begin == pytest.approx(renewed * 1e9, abs=2e6)
            assert gap.end is not None
            assert first[device] == gap.begin, "a query shows the gap as a sample without a value"
        recorded = one.ownership.gaps(0, one.collector.newest_commit)
        assert {(each.link, each.epoch) for each in recorded} == set(one._active.items())
        assert {device for each in recorded for device in each.devices} == set(gaps)
        for each in recorded:
            (device,) = each.devices
            assert each.begin == gaps[device].begin
            assert each.end <= (gaps[device].end or 0)
            assert each.end < min(
                at
                for at, name, value in zip(found.time, found.device, found.value, strict=True)
                if name == device and value is not None
            )


async def test_a_shard_that_is_gained_while_a_configuration_comes_is_polled_after_its_gap_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=time.time() - 100.0)
    for shard in range(LINKS):
        await coordinator.create(f"lease.{shard:04d}", lease.encode())
    await coordinator.close()
    honest = FleetCollector._apply

    async def apply(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        is_gained = any(event.change is OwnershipChange.GAINED for event in events)
        if one.revision == 0 and is_gained:  # it comes in this moment
            one._newer = one._configuration, 7
            one._waiting[:0] = events
            one._wake.set()
            events = ()
        await honest(one, events)

    monkeypatch.setattr(FleetCollector, "_apply", apply)
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3, 60)
        assert one.revision == 7
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
        (gap,) = one.ownership.gaps(0, one.collector.newest_commit)
        assert gap.end < min(at for at, value in zip(found.time, found.value, strict=True) if value is not None)


@pytest.mark.parametrize("step", [OwnershipChange.LEAVE, OwnershipChange.LOST])
async def test_a_shard_that_is_gone_again_before_it_was_polled_leaves_the_gap_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: OwnershipChange
) -> None:
    """The next owner takes it from one that was not silent, so only this one can tell of the gap."""
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    renewed = time.time() - 100.0
    for shard in range(LINKS):
        lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=renewed)
        await coordinator.create(f"lease.{shard:04d}", lease.encode())
    await coordinator.close()
    honest = FleetCollector._apply
    brief: list[ShardEvent] = []

    async def apply(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        if not brief:
            brief.extend(event for event in events if event.change is OwnershipChange.GAINED)
            for event in brief:
                if step is OwnershipChange.LEAVE:
                    one.member.owned[event.shard].leaving = ""
                else:
                    del one.member.owned[event.shard]
            events = [*events, *(ShardEvent(event.shard, step, event.epoch) for event in brief)]
        await honest(one, events)

    monkeypatch.setattr(FleetCollector, "_apply", apply)
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3, 60)
        await one.collector.flush()
        found = one.ownership.gaps(0, one.collector.newest_commit)
        assert found[0].epoch == brief[0].epoch
        assert found[0].begin == pytest.approx(renewed * 1e9, abs=2e6)
        first, second = one.ownership.all()
        assert (first.epoch, second.epoch) == (brief[0].epoch, one._active["link-0"])
        assert first.end is not None
        assert second.end is None


async def test_a_shard_that_is_gone_again_while_another_one_ends_leaves_the_gap_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its end comes with later events, when its begin was not looked at yet."""
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    renewed = time.time() - 100.0
    for shard in range(LINKS):
        lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=renewed)
        await coordinator.create(f"lease.{shard:04d}", lease.encode())
    await coordinator.close()
    honest = FleetCollector._apply, FleetCollector._record_ends
    brief: list[ShardEvent] = []

    async def apply(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        if not brief:
            brief.extend(event for event in events if event.change is OwnershipChange.GAINED)
            events = [ShardEvent("other", OwnershipChange.LOST, Epoch(1, 1)), *events] if brief else events
        await honest[0](one, events)

    async def record_ends(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        await honest[1](one, events)
        for event in brief:
            if event.shard in one.member.owned and events[0].shard == "other":
                one.member._lose(event.shard, "it could not be renewed in time")
        for event in one.member.events():
            one._told(event)

    monkeypatch.setattr(FleetCollector, "_apply", apply)
    monkeypatch.setattr(FleetCollector, "_record_ends", record_ends)
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3, 60)
        await one.collector.flush()
        found = one.ownership.gaps(0, one.collector.newest_commit)
        assert found[0].epoch == brief[0].epoch
        assert found[0].begin == pytest.approx(renewed * 1e9, abs=2e6)
        first, second = one.ownership.all()
        assert (first.epoch, second.epoch) == (brief[0].epoch, one._active["link-0"])
        assert first.end is not None
        assert second.end is None


async def test_the_time_in_which_a_link_was_not_owned_is_an_interval_of_its_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3)
        honest = one._driver._coordinator.replace

        async def away(*_: object) -> int:
            raise CoordinatorDown("it is away")

        monkeypatch.setattr(one._driver._coordinator, "replace", away)
        await until(lambda: not one.collector.loads(), 30)
        monkeypatch.setattr(one._driver._coordinator, "replace", honest)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads + 3, 30)
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
        (gap,) = [each for each in found.intervals if each.reason == Reason.OWNERSHIP]
        assert gap.end is not None
        good = [at for at, reason in zip(found.time, found.reason, strict=True) if not reason]
        assert not [at for at in good if gap.begin < at < gap.end]
        assert any(at < gap.begin for at in good)
        assert any(at > gap.end for at in good)
        (recorded,) = one.ownership.gaps(0, one.collector.newest_commit)
        assert recorded.begin == gap.begin, "no other has polled it, and all its samples are older"
        assert one.unowned_seconds == pytest.approx((gap.end - gap.begin) / 1e9, abs=0.2)


async def test_times_without_an_owner_are_by_the_clock_of_the_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wall clock is set forward before a shard is taken, and back while it is polled: samples follow it slowly."""
    state, nanoseconds = SimpleNamespace(ahead=0.0), time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: nanoseconds() + int(state.ahead * 1e9))
    monkeypatch.setattr("busway.apps.collector.collector.CLOCK_EVERY", 60.0)
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=time.time() - 100.0)
    for shard in range(LINKS):
        await coordinator.create(f"lease.{shard:04d}", lease.encode())
    await coordinator.close()
    honest = FleetCollector._begin

    async def begin(one: FleetCollector, events: Sequence[ShardEvent]) -> None:
        state.ahead = 2.0
        await honest(one, events)

    monkeypatch.setattr(FleetCollector, "_begin", begin)
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3, 60)
        await one.collector.flush()
        state.ahead = -30.0
        (recorded,) = one.ownership.gaps(0, one.collector.newest_commit)
    found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
    times = [at for at, value in zip(found.time, found.value, strict=True) if value is not None]
    before, after = [each for each in found.intervals if each.reason == Reason.OWNERSHIP]
    assert recorded.end <= (before.end or 0) < min(times)
    assert max(times) <= after.begin


async def test_the_time_without_an_owner_is_as_long_as_it_was_where_the_clock_was_set_in_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The machine began with the time at which it ended last; a time service sets its clock an hour forward."""
    hour, state = 3600.0, SimpleNamespace(ahead=0.0, known=False)
    seconds, nanoseconds = time.time, time.time_ns
    monkeypatch.setattr(time, "time", lambda: seconds() + state.ahead)
    monkeypatch.setattr(time, "time_ns", lambda: nanoseconds() + int(state.ahead * 1e9))
    monkeypatch.setattr(Collector, "_clock_is_known", lambda _: state.known)
    monkeypatch.setattr("busway.apps.collector.collector.CLOCK_EVERY", 0.1)
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3)
        honest = one._driver._coordinator.replace

        async def away(*_: object) -> int:
            raise CoordinatorDown("it is away")

        monkeypatch.setattr(one._driver._coordinator, "replace", away)
        await until(lambda: not one.collector.loads() and one._unowned_since, 30)
        stopped = time.monotonic()
        await one.collector.flush()
        state.ahead, state.known = hour, True
        await until(lambda: one.collector._clock.is_right)
        monkeypatch.setattr(one._driver._coordinator, "replace", honest)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads + 3, 30)
        paused = time.monotonic() - stopped
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
        (gap,) = [each for each in found.intervals if each.reason == Reason.OWNERSHIP]
        assert gap.end is not None
        assert 0 < gap.end - gap.begin < (paused + 10) * 1e9
        good = [at for at, reason in zip(found.time, found.reason, strict=True) if not reason]
        assert max(at for at in good if at < gap.end) <= gap.begin < max(good)
        (recorded,) = one.ownership.gaps(0, one.collector.newest_commit)
        assert recorded.begin == gap.begin
        assert one.unowned_seconds == pytest.approx((gap.end - gap.begin) / 1e9, abs=0.2)


async def test_a_collector_that_was_killed_tells_at_its_next_start_alone_when_its_ownership_ended(
    tmp_path: Path,
) -> None:
    ends = []
    async with devices_of(1) as devices:
        for _ in range(3):
            async with fleet(tmp_path, "one", devices) as one:
                ends.append(one.collector.manifest.fact("alive"))
                reads = devices[0].reads
                await until(partial(has_reads, devices[0], reads + 3), 30)
            if len(ends) == 1:  # as a process that is killed leaves it
                with contextlib.closing(sqlite3.connect(tmp_path / "one" / OWNERSHIP)) as log:
                    log.execute('UPDATE ownership SET last_commit = NULL, "end" = NULL')
                    log.commit()
    with contextlib.closing(OwnershipLog(tmp_path / "one")) as record:
        assert next(row.end for row in record.all()) == ends[1]
        assert not record.unended()
    with StoreWriter(tmp_path / "one", now=time.time_ns()) as writer:
        found = CommitReader(tmp_path / "one", writer.manifest)
        marks: list[int] = []
        after = 0
        while (some := found.read(after, 10_000)) is not None:
            after = some.last
            marks += [each.time for each in some.samples if each.reason == Reason.OWNERSHIP and each.point == "count"]
    assert len(marks) == 4, "one for each end in order, and one for that of the killed process"
    assert ends[1] in marks


async def test_a_device_stays_in_maintenance_over_a_restart_and_where_its_link_goes_until_it_is_ended(
    tmp_path: Path,
) -> None:
    async with devices_of(2) as devices:
        async with fleet(tmp_path, "one", devices) as one:
            await until(lambda: all(device.reads > 3 for device in devices))
            one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
            row = one.collector.in_maintenance()["link-0"]
            others = devices[1].reads
            await until(lambda: devices[1].reads > others + 3)  # a read of the first one that was sent has ended
            before, others = devices[0].reads, devices[1].reads
        async with fleet(tmp_path, "one", devices) as one:
            await until(lambda: devices[1].reads > others + 3 and len(one.links) == 2)
            assert one.collector.in_maintenance() == {"link-0": row}
            assert devices[0].reads == before
        others = devices[1].reads
        async with fleet(tmp_path, "two", devices) as two:
            await until(lambda: devices[1].reads > others + 3 and len(two.links) == 2)
            assert two.collector.in_maintenance() == {"link-0": row}
            assert devices[0].reads == before
            refused = await two.collector.write("link-0", "count", 1, by="ben")
            assert "in maintenance" in refused.reason
            two.collector.maintenance("link-0", begins=False, by="anna", why="done")
            await until(lambda: devices[0].reads > before + 3)
        before = devices[0].reads
        async with fleet(tmp_path, "one", devices) as one:
            await until(lambda: devices[0].reads > before + 3)
            assert one.collector.in_maintenance() == {}


async def test_a_maintenance_goes_on_where_the_lease_of_its_link_has_lapsed_and_is_taken_again(tmp_path: Path) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        one.collector.maintenance("link-0", begins=True, by="anna", why="new sensor")
        row = one.collector.in_maintenance()["link-0"]
        shard = one.shard_of("link-0")
        others = devices[1].reads
        await until(lambda: devices[1].reads > others + 3)  # a read of the first one that was sent has ended
        before, epoch = devices[0].reads, one.member.owned[shard].epoch
        one.member._lose(shard, "it could not be renewed in time")
        one._driver.wake()
        await until(lambda: "link-0" not in one.links)
        await until(lambda: "link-0" in one.links and one.member.owned[shard].epoch > epoch, 60)
        others = devices[1].reads
        await until(lambda: devices[1].reads > others + 5)
        assert one.collector.in_maintenance() == {"link-0": row}
        assert devices[0].reads == before


def has_reads(device: FleetDevice, count: int) -> bool:
    return device.reads >= count


async def test_a_process_that_stood_still_for_longer_than_its_leases_records_the_gap_from_its_last_transaction(
    tmp_path: Path,
) -> None:
    async with devices_of(1) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: devices[0].reads > 3)
        stopped = time.time_ns()
        time.sleep(TIMES.ttl + 0.5)  # noqa: ASYNC251 - nothing of this process runs meanwhile
        await until(lambda: one.member.counts.lapsed > 0, 30)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads + 3, 30)
        await one.collector.flush()
        found = await asyncio.to_thread(busway.Store(tmp_path / "one").read, "*/count")
        gap = min((each for each in found.intervals if each.reason == Reason.OWNERSHIP), key=lambda each: each.begin)
        assert gap.begin < stopped + 1.5e9, "the last transaction may have taken a second"
        assert gap.end is not None
        assert gap.end > stopped + TIMES.ttl * 1e9


class CountingTable(LocalCoordinator):
    """Counts its changes."""

    changes: int = 0

    async def create(self, key: str, value: bytes) -> int:
        self.changes += 1
        return await super().create(key, value)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        self.changes += 1
        return await super().replace(key, value, revision)


async def changes_per_renewal(folder: Path, links: int, shards: int) -> float:
    """The changes of the table for each renewal of the entry of its only collector, the mean of ten."""
    absent = [FleetDevice(f"link-{number}", 1 + number) for number in range(links)]
    text = plant(folder / f"{links}-{shards}", absent).replace("fast.period = 0.1", "fast.period = 600")
    table = await asyncio.to_thread(CountingTable, folder / f"{links}-{shards}.zone", "hall")
    try:
        configuration = parse_collector(text, "x.toml")
        async with FleetCollector(configuration, table, "one", host="one", shards=shards, times=LONG_TIMES) as one:
            await until(lambda: len(one.member.owned) == shards)
            count, changes = one.member._me.count, table.changes
            await until(lambda: one.member._me.count >= count + 10)
            return (table.changes - changes) / (one.member._me.count - count)
    finally:
        await table.close()


async def test_what_leases_cost_the_table_grows_with_shards_and_not_with_links(tmp_path: Path) -> None:
    few, many, more_shards = await asyncio.gather(
        changes_per_renewal(tmp_path, 20, 4),
        changes_per_renewal(tmp_path, 200, 4),
        changes_per_renewal(tmp_path, 200, 16),
    )
    # Its entry and each lease, once each. On a busy machine leases are renewed less often, but far before they lapse.
    assert many == pytest.approx(few, rel=0.3)
    assert 0.7 * (1 + 4) < few < 1.2 * (1 + 4)
    assert 0.6 * (1 + 16) < more_shards < 1.2 * (1 + 16)


async def test_links_whose_transactions_outlast_a_lease_are_refused_by_name(tmp_path: Path) -> None:
    text = plant(tmp_path / "store", [FleetDevice("hall", 502)], "timeout = 9")
    coordinator = await open_coordinator(f"local:{tmp_path}", "hall")
    try:
        with pytest.raises(ConfigError, match=r"transaction of link hall may take 12 s.*leaves 8 s"):
            FleetCollector(parse_collector(text, "x.toml"), coordinator, "one", host="box")
    finally:
        await coordinator.close()


async def test_a_link_is_polled_by_its_hosts_alone_and_by_the_second_where_the_first_has_ended(tmp_path: Path) -> None:
    async def started(stack: contextlib.AsyncExitStack, host: str) -> FleetCollector:
        coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
        stack.push_async_callback(coordinator.close)
        options = 'timeout = 0.5\nconnect_timeout = 0.5\nhosts = ["first", "second"]'
        configuration = parse_collector(plant(tmp_path / host, devices, options), f"{host}.toml")
        return await stack.enter_async_context(
            FleetCollector(configuration, coordinator, host, host=host, shards=LINKS, times=TIMES)
        )

    async with devices_of(1) as devices, contextlib.AsyncExitStack() as stack:
        other = await started(stack, "other")
        async with contextlib.AsyncExitStack() as first_only:
            first = await started(first_only, "first")
            second = await started(stack, "second")
            await until(lambda: devices[0].reads > 3 and first.links == {"link-0"}, 60)
            assert not second.links
        await until(lambda: second.links == {"link-0"}, 60)
        reads = devices[0].reads
        await until(lambda: devices[0].reads > reads, 60)
        assert not other.links
        assert not other.member.owned


async def test_a_transaction_that_could_reach_the_device_exactly_at_the_deadline_does_not_begin(tmp_path: Path) -> None:
    text = plant(
        tmp_path / "one", [FleetDevice("line", 502)], "timeout = 0.5\nconnect_timeout = 0.25\ngateway_wait = 1"
    )
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    clock = [0.0]
    try:
        one = FleetCollector(
            parse_collector(text, "one.toml"),
            coordinator,
            "one",
            host="box",
            shards=1,
            times=TIMES,
            now=lambda: clock[0],
        )
        one.member.owned["0000"] = OwnedShard(Epoch(1, 1), 1, asked=100.0, renew_at=101.0)
        one._activate(["line"], Epoch(1, 1))
        deadline = 100.0 + TIMES.ttl - TIMES.guard
        for worst, asks in ((1.75, one._permit), (1.5, one._may_send)):
            clock[0] = deadline - worst
            assert not _may(asks), "its last byte could reach the device when the lease ends"
            clock[0] -= 1e-6
            assert _may(asks)
    finally:
        await coordinator.close()


def _may(asks: Callable[[str], bool | None]) -> bool:
    try:
        return asks("line") is not False
    except LinkDown:
        return False


async def test_a_configuration_is_confirmed_once_no_gateway_holds_a_request_of_what_it_ended(tmp_path: Path) -> None:
    """Another collector may poll the endpoint under another name after that."""
    clock = [100.0]
    text = plant(
        tmp_path / "one", [FleetDevice("line", 502)], "timeout = 0.5\nconnect_timeout = 0.25\ngateway_wait = 1"
    )
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        one = FleetCollector(
            parse_collector(text, "x.toml"), coordinator, "one", host="b", shards=1, times=TIMES, now=lambda: clock[0]
        )
        one._note_unanswered("line")
        assert one._held_for(["line", "other"]) == 1.5
        one._left_until, one.revision = clock[0] + 0.05, 7
        one._confirm_revision(7)
        assert one.member.members(0.0)[0].revision == 0
        clock[0] += 0.05
        await until(lambda: one.member.members(0.0)[0].revision == 7)
        clock[0] += 1.45
        assert one._held_for(["line"]) == 0.0
    finally:
        await coordinator.close()


async def test_a_lease_is_released_once_no_gateway_holds_a_request_of_a_link_that_a_newer_configuration_lacks(
    tmp_path: Path,
) -> None:
    """Another collector may still have the configuration before, with that link."""
    clock = [100.0]
    text = plant(tmp_path / "one", [FleetDevice("line", 502)])
    coordinator = await open_coordinator(f"local:{tmp_path}/zone", "hall")
    try:
        one = FleetCollector(
            parse_collector(text, "x.toml"), coordinator, "one", host="b", shards=1, times=TIMES, now=lambda: clock[0]
        )
        owned = one.member.owned["0000"] = OwnedShard(Epoch(1, 1), 1, asked=100.0, renew_at=101.0, leaving="two")
        one._left_until = clock[0] + 0.05
        one._release("0000", Epoch(1, 1))
        assert not owned.has_left
        clock[0] += 0.05
        await until(lambda: owned.has_left)
    finally:
        await coordinator.close()


async def test_a_configuration_is_confirmed_once_no_gateway_holds_a_request_of_a_link_that_is_being_handed_on(
    tmp_path: Path,
) -> None:
    async with devices_of(2) as devices, fleet(tmp_path, "one", devices) as one:
        await until(lambda: all(device.reads > 3 for device in devices))
        one._active.pop("link-0")
        await one._poll_active()
        until_then = one._held_until["link-0"] = one._now() + 1.0
        one._newer = parsed(tmp_path, "one", devices[1:]), 7
        await one._take_newer()
        assert one.revision == 7
        while one.member.members(0.0)[0].revision != 7:
            assert one._now() < until_then + 60.0
            await asyncio.sleep(0.01)
        assert one._now() >= until_then
