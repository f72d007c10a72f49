"""Samples of a fleet through a real NATS server: at least once, whatever ends and comes back."""

import asyncio
import contextlib
import shutil
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, parsed, plant
from foreign_servers import ForeignServer, nats_server
from waiting import until

import busway
from busway.apps.collector.cancellation import end_tasks
from busway.apps.collector.configuration import parse_collector
from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.collector.store.writer import StoreWriter
from busway.apps.fleet import outbox as outbox_module
from busway.apps.fleet import streams as streams_module
from busway.apps.fleet.coordinator import CoordinatorDown, Entry
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.coordinators.nats import NatsCoordinator, open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, until_up
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.messages import Chain, SampleMessage, decode_message
from busway.apps.fleet.outbox import Outbox, SinkPlace
from busway.apps.fleet.ownership_gaps import OwnershipGap
from busway.apps.fleet.shards import shard_of
from busway.apps.fleet.streams import CursorBook, NatsStream, StreamSink, make_stream
from busway.apps.fleet.table_records import LeaseRecord
from busway.errors import ConfigError

pytest.importorskip("nats")
pytest.importorskip("msgpack")
pytestmark = pytest.mark.real_time

NOW = 1_800_000_000 * 10**9


class KeepingSink:
    """Keeps samples by device, point and time, and counts how often each came."""

    def __init__(self) -> None:
        self.kept: dict[tuple[str, str, int], int] = {}
        self.revisions: set[int] = set()
        self.is_up = True

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        if not self.is_up:
            raise SinkDown("it is away")
        self.revisions |= {each.revision for each in samples}
        for each in samples:
            key = (each.device, each.point, each.time)
            self.kept[key] = self.kept.get(key, 0) + 1

    async def close(self) -> None:
        pass


class NoRights(LocalCoordinator):
    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        raise ConfigError("the credentials do not permit to read the zone hall", key="coordinator")
        yield


async def test_a_sink_that_may_not_read_the_table_ends_by_that_error(tmp_path: Path) -> None:
    table = await asyncio.to_thread(NoRights, tmp_path, "hall")
    try:
        async with asyncio.timeout(60):
            with pytest.raises(ConfigError, match="do not permit to read the zone hall"):
                await StreamSink(None, table, "hall", "history", KeepingSink()).run()
    finally:
        await table.close()


@contextlib.asynccontextmanager
async def connected(server: ForeignServer) -> AsyncIterator[NatsCoordinator]:
    coordinator = await until_up(
        lambda: open_nats(f"nats://127.0.0.1:{server.port}", "hall", CoordinatorOptions(answer=0.8)),
        CoordinatorDown,
        30,
    )
    try:
        yield coordinator
    finally:
        await coordinator.close()


@contextlib.asynccontextmanager
async def sending(
    tmp_path: Path, server: ForeignServer, name: str, devices: list[FleetDevice]
) -> AsyncIterator[FleetCollector]:
    async with connected(server) as coordinator:
        await make_stream(coordinator.client, "hall")
        stream = NatsStream(coordinator.client, "hall", timeout=1.0)
        watch = asyncio.create_task(stream.watch_cursors(coordinator))
        try:
            async with FleetCollector(
                parsed(tmp_path, name, devices), coordinator, name, host=name, shards=8, times=TIMES, stream=stream
            ) as collector:
                yield collector
        finally:
            await end_tasks([watch])


@contextlib.asynccontextmanager
async def handing_on(server: ForeignServer, sink: KeepingSink) -> AsyncIterator[StreamSink]:
    async with connected(server) as coordinator:
        handed = StreamSink(coordinator.client, coordinator, "hall", "keeping", sink)
        task = asyncio.create_task(handed.run())
        try:
            yield handed
        finally:
            await end_tasks([task])


def has_commits(one: FleetCollector, newest: int) -> bool:
    return one.collector.newest_commit >= newest


def sinks_have(one: FleetCollector, commit: int) -> bool:
    assert one.outbox is not None
    return one.outbox.status().kept >= commit


def stored(tmp_path: Path, *names: str, only_values: bool = False) -> set[tuple[str, str, int]]:
    found: set[tuple[str, str, int]] = set()
    for name in names:
        for each in busway.Store(tmp_path / name).read("*/*"):
            if each.value is not None or not only_values:
                found.add((each.device, each.point, each.time))
    return found


async def test_every_sample_of_two_collectors_reaches_a_sink_that_was_away_and_a_server_that_was_restarted(
    tmp_path: Path,
) -> None:
    sink = KeepingSink()
    with nats_server(tmp_path) as server:
        async with contextlib.AsyncExitStack() as stack:
            devices = await stack.enter_async_context(devices_of(4))
            handed = await stack.enter_async_context(handing_on(server, sink))
            async with (
                sending(tmp_path, server, "one", devices) as one,
                sending(tmp_path, server, "two", devices) as two,
            ):
                await until(lambda: handed.taken > 40 and one.collector.loads() and two.collector.loads(), 90)
                sink.is_up = False
                await asyncio.sleep(0.5)  # samples wait in the stream meanwhile
                sink.is_up = True
                server.stop()
                await until(lambda: all(each.outbox and each.outbox.status().error for each in (one, two)), 90)
                server.start()
                taken = handed.taken
                await until(lambda: handed.taken > taken + 40, 60)
                for each in (one, two):
                    await each.collector.flush()
                # Of an interval without reads a sink gets the begin, if the collector saw it: not one that was over.
                kept = await asyncio.to_thread(stored, tmp_path, "one", "two", only_values=True)
                newest = {each: each.collector.newest_commit for each in (one, two)}  # of all that was read before
                for each in (one, two):
                    await until(partial(sinks_have, each, newest[each]), 60)
                has = set(sink.kept)
                assert kept <= has, "what all sinks are said to keep, the sink has"
        assert has <= stored(tmp_path, "one", "two"), "nothing comes that no store has"
        assert handed.error is None


async def test_the_subject_of_a_message_has_the_shard_whose_lease_is_that_of_the_link(tmp_path: Path) -> None:
    """Also of a link that one host alone reaches, and of two links to one endpoint."""
    found: dict[str, set[str]] = {}

    async def came(message: Any) -> None:
        if link := decode_message(message.data).link:
            found.setdefault(link, set()).add(message.subject.removeprefix("busway.hall.samples."))

    async with contextlib.AsyncExitStack() as stack:
        server = stack.enter_context(nats_server(tmp_path))
        one, two = await stack.enter_async_context(devices_of(2))
        links = {"other": one.port, "first": one.port, "pinned": two.port}
        text = plant(tmp_path / "one", [FleetDevice(name, port) for name, port in links.items()])
        text = text.replace('name = "pinned"', 'name = "pinned"\nhosts = ["box"]', 1)
        coordinator = await stack.enter_async_context(connected(server))
        await make_stream(coordinator.client, "hall")
        await coordinator.client.subscribe("busway.hall.samples.>", cb=came)
        collector = await stack.enter_async_context(
            FleetCollector(
                parse_collector(text, "one.toml"),
                coordinator,
                "one",
                host="box",
                shards=8,
                times=TIMES,
                stream=NatsStream(coordinator.client, "hall"),
            )
        )
        await until(lambda: len(found) == 3, 60)
        assert shard_of("first", 8) != shard_of("other", 8), "else this shows nothing"
        assert found == {"first": {shard_of("first", 8)}, "other": {shard_of("first", 8)}, "pinned": {"pin.box"}}
        assert set(collector.member.owned) == {shard_of("first", 8), "pin.box"}


async def test_texts_longer_than_a_server_takes_are_set_aside_and_all_else_is_sent(tmp_path: Path) -> None:
    texts = ["x" * length for length in (10, 6000, 4000, 2000, 2000, 2000, 2000, 5)]
    with nats_server(tmp_path, "max_payload: 6000") as server, StoreWriter(tmp_path / "store", now=NOW) as writer:
        async with connected(server) as coordinator:
            await make_stream(coordinator.client, "hall")
            batches = [
                SampleBatch(PointGroup("meter", ("name",)), NOW + number, 5, (text,))
                for number, text in enumerate(texts)
            ]
            writer.commit(batches, [], NOW)
            outbox = opened(tmp_path / "store", writer, NatsStream(coordinator.client, "hall"))
            assert not await outbox.step()
            jetstream = coordinator.client.jetstream()
            newest = (await jetstream.stream_info("busway-samples-hall")).state.last_seq
            sent = [await jetstream.get_msg("busway-samples-hall", number) for number in range(1, newest + 1)]
            found = [sample.value for each in sent for sample in decode_message(each.data or b"").samples]
            assert found == [text for text in texts if len(text) != 6000]
            assert outbox.status().set_aside == 1


class GapKeepingSink(KeepingSink):
    """Takes gaps too, and remembers how many samples it had then."""

    def __init__(self) -> None:
        super().__init__()
        self.gaps: list[tuple[OwnershipGap, int]] = []

    async def send_gap(self, gap: OwnershipGap) -> list[CommittedSample]:
        if not self.is_up:
            raise SinkDown("it is away")
        self.gaps.append((gap, len(self.kept)))
        return [CommittedSample(gap.commit, device, "name", gap.begin, 0, None, 22) for device in gap.devices]


async def test_a_gap_of_ownership_reaches_a_sink_of_the_stream_between_the_samples_around_it(tmp_path: Path) -> None:
    sink = GapKeepingSink()
    sink.is_up = False
    gap = OwnershipGap("hall", Epoch(1, 7), 4, ("meter",), NOW, NOW + 5)
    with nats_server(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOW) as writer:
        async with connected(server) as coordinator, handing_on(server, sink) as handed:
            await make_stream(coordinator.client, "hall")
            stream = NatsStream(coordinator.client, "hall")
            outbox = opened(tmp_path / "store", writer, stream, [gap])
            for number in range(4):
                batch = SampleBatch(PointGroup("meter", ("name",)), NOW + number, 5, (number,))
                writer.commit([batch], [], NOW + number)
            assert not await outbox.step()
            await until(lambda: handed.error is not None, 60)
            sink.is_up = True
            await until(lambda: handed.taken >= 5, 60)
            assert sink.gaps == [(gap, 2)]
            assert sink.revisions == {33, 44}
            assert sum(sink.kept.values()) == 5, "four, and what was returned for the gap"


async def test_a_sink_of_the_stream_gets_the_gap_before_the_samples_of_a_collector_that_took_over(
    tmp_path: Path,
) -> None:
    sink = GapKeepingSink()
    renewed = time.time() - 100.0
    with nats_server(tmp_path) as server:
        async with connected(server) as coordinator:
            for shard in range(8):
                lease = LeaseRecord("dead", "run", True, 7, 0.01, Epoch(1, 1), at=renewed)
                await coordinator.create(f"lease.{shard:04d}", lease.encode())
        async with devices_of(3) as devices, handing_on(server, sink), sending(tmp_path, server, "one", devices) as one:
            await until(lambda: len(sink.gaps) >= 3 and len(sink.kept) > 20, 90)
            gaps = {gap.link: gap for gap, _ in sink.gaps}
            assert {link: gap.epoch for link, gap in gaps.items()} == one._active
            for gap in gaps.values():
                assert gap.begin == pytest.approx(renewed * 1e9, abs=2e6)
                (device,) = gap.devices
                times = [at for name, _, at in sink.kept if name == device and at != gap.begin]
                assert times
                assert min(times) > gap.end


async def test_samples_follow_at_once_when_a_server_that_was_away_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox_module, "PAUSE", 1000.0)
    monkeypatch.setattr(outbox_module, "PAUSE_LIMIT", 1000.0)
    with nats_server(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOW) as writer:
        async with connected(server) as coordinator:
            await make_stream(coordinator.client, "hall")
            stream = NatsStream(coordinator.client, "hall", timeout=1.0)
            outbox = opened(tmp_path / "store", writer, stream)
            task = asyncio.create_task(outbox.run())
            try:
                await until(lambda: outbox.status().sent == writer.newest_commit, 60)
                for number in range(2):
                    server.stop()
                    batch = SampleBatch(PointGroup("meter", ("name",)), NOW + number, 5, (number,))
                    newest = writer.commit([batch], [], NOW + number).number
                    await until(lambda: outbox.status().error is not None, 60)
                    server.start()
                    await until(partial(has_sent, outbox, newest), 60)
            finally:
                await end_tasks([task])


def has_sent(outbox: Outbox, commit: int) -> bool:
    return outbox.status().sent >= commit


def opened(
    folder: Path,
    writer: StoreWriter,
    stream: NatsStream,
    gaps: Sequence[OwnershipGap] = (),
    now: Callable[[], float] = lambda: 0.0,
) -> Outbox:
    return Outbox(
        folder,
        writer.manifest,
        stream,
        collector="one",
        store="s",
        link_of=lambda: {"meter": "hall"},
        shard_of=lambda link: "0000",
        epoch_of=lambda link, commit: Epoch(1, 6 if commit < 4 else 7),
        revision_of=lambda commit: 33 if commit < 4 else 44,
        gaps_of=lambda after, last: [each for each in gaps if after < each.commit <= last],
        now=now,
    )


async def test_samples_of_a_store_that_was_set_back_reach_a_sink_that_has_later_ones_of_it(tmp_path: Path) -> None:
    sink = KeepingSink()
    folder, copy = tmp_path / "one", tmp_path / "copy"
    with nats_server(tmp_path) as server:
        async with devices_of(1) as devices, handing_on(server, sink):
            for start in range(3):
                async with sending(tmp_path, server, "one", devices) as one:
                    before = one.collector.newest_commit
                    await until(partial(has_commits, one, before + 6), 60)
                    await one.collector.flush()
                    kept = await asyncio.to_thread(stored, tmp_path, "one", only_values=True)
                    await until(partial(sinks_have, one, one.collector.newest_commit), 60)
                    assert kept <= set(sink.kept)
                if start == 0:
                    shutil.copytree(folder, copy)
                if start == 1:
                    shutil.rmtree(folder)
                    copy.rename(folder)


async def test_a_sink_that_is_slower_than_the_stream_waits_for_it_gets_each_message_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams_module, "ACK_SECONDS", 0.5)

    class SlowSink(KeepingSink):
        async def send(self, samples: Sequence[CommittedSample]) -> None:
            await asyncio.sleep(0.8)
            await super().send(samples)

    sink = SlowSink()
    with nats_server(tmp_path) as server:
        async with connected(server) as coordinator:
            await make_stream(coordinator.client, "hall")
            stream = NatsStream(coordinator.client, "hall")
            for number in range(1, 131):
                samples = [CommittedSample(number, "meter", "name", NOW + number, 0, number, 0)]
                chain = Chain(7, number, number - 1)
                await stream.publish(SampleMessage("one", "s", "hall", None, 0, number - 1, 0, samples, chain), "0000")
        async with handing_on(server, sink):
            await until(lambda: len(sink.kept) == 130, 60)
    assert set(sink.kept.values()) == {1}


async def test_a_sink_that_runs_while_the_servers_lose_their_disks_goes_over_to_the_new_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams_module, "LOOK_EVERY", 0.1)
    sink = KeepingSink()

    async def send(first: int, last: int, start: int, coordinator: NatsCoordinator) -> None:
        await make_stream(coordinator.client, "hall")
        stream = NatsStream(coordinator.client, "hall")
        for commit in range(first, last + 1):
            samples = [CommittedSample(commit, "meter", "name", NOW + commit, 0, commit, 0)]
            chain = Chain(start, commit - first + 1, commit - first)
            message = SampleMessage("one", "s", "hall", None, 0, commit - 1, first - 1, samples, chain)
            await stream.publish(message, "0000")

    with nats_server(tmp_path) as server:
        async with connected(server) as coordinator:
            await send(1, 50, 7, coordinator)
        async with handing_on(server, sink) as handed:
            await until(lambda: len(sink.kept) == 50, 60)
            server.stop()
            shutil.rmtree(tmp_path / "nats")
            server.start()
            async with connected(server) as coordinator:
                await send(51, 60, 8, coordinator)
                await until(lambda: len(sink.kept) == 60, 60)
                book = CursorBook()
                watch = asyncio.create_task(book.watch(coordinator))
                wanted = {"keeping": SinkPlace(59, 10, 8)}  # collectors know it again
                await until(lambda: book.places("one", "s") == wanted and handed.error is None, 60)
                await end_tasks([watch])


async def test_a_sink_gets_what_was_in_a_stream_that_was_deleted_although_the_new_one_counts_from_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an operator does who wants other limits; the collector goes on to send, so it is never idle."""
    monkeypatch.setattr(outbox_module, "PAUSE_LIMIT", 0.5)
    sink = KeepingSink()
    with nats_server(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOW) as writer:
        async with connected(server) as coordinator, handing_on(server, sink) as handed:
            await make_stream(coordinator.client, "hall")
            jetstream = coordinator.client.jetstream()
            for _ in range(1000):
                await jetstream.publish("busway.hall.samples.none", b"no message of samples")
            await until(lambda: handed.unreadable == 1000, 60)
            stream = NatsStream(coordinator.client, "hall", timeout=1.0)
            outbox = opened(tmp_path / "store", writer, stream, now=lambda: 20 * time.monotonic())
            tasks = [asyncio.create_task(each) for each in (outbox.run(), stream.watch_cursors(coordinator))]

            def commit() -> int:
                now = NOW + writer.newest_commit + 1
                return writer.commit([SampleBatch(PointGroup("meter", ("name",)), now, 5, (now,))], [], now).number

            try:
                await until(partial(has_kept, outbox, commit()), 60)
                sink.is_up = False
                lost = commit()
                await until(lambda: handed.error is not None, 60)
                await until(partial(has_sent, outbox, lost), 60)
                await jetstream.delete_stream("busway-samples-hall")
                sink.is_up = True
                async with asyncio.timeout(60):
                    while not has_kept(outbox, lost):
                        commit()
                        await asyncio.sleep(0.1)
                assert ("meter", "name", NOW + lost) in sink.kept
            finally:
                await end_tasks(tasks)


def has_kept(outbox: Outbox, commit: int) -> bool:
    return outbox.status().kept >= commit
