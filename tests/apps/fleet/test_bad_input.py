"""A fleet on a real NATS server that refuses: it says why, owns nothing, and goes on when it may again."""

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, parsed
from foreign_servers import ForeignServer, nats_server
from waiting import until

from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.control_entries import read_entries
from busway.apps.fleet.coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, CoordinatorDown
from busway.apps.fleet.coordinators.nats import NatsCoordinator, open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator, until_up
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_status import zone_status
from busway.apps.fleet.streams import NatsStream, StreamOptions, StreamSink, make_stream
from busway.errors import ConfigError

pytest.importorskip("nats")
pytest.importorskip("msgpack")
pytestmark = pytest.mark.real_time

OPTIONS = CoordinatorOptions(answer=0.8)
USER = replace(OPTIONS, user="west", password="secret")


class NoSink:
    """Takes nothing."""

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        raise AssertionError(samples)

    async def close(self) -> None:
        pass


def accounts(folder: Path, user: str, *permissions: str) -> str:
    """Lines of a server's configuration; JetStream is in it because a reload forgets what the command line says."""
    stores = f'jetstream {{ store_dir: "{folder / "nats"}" }}\n'
    return f'{stores}authorization {{ users = [{{ user: {user}, password: "secret" {"".join(permissions)} }}] }}\n'


@contextlib.asynccontextmanager
async def connected(server: ForeignServer, options: CoordinatorOptions = OPTIONS) -> AsyncIterator[NatsCoordinator]:
    coordinator = await until_up(
        lambda: open_nats(f"nats://127.0.0.1:{server.port}", "hall", options), CoordinatorDown, 30
    )
    try:
        yield coordinator
    finally:
        await coordinator.close()


def member(
    tmp_path: Path,
    name: str,
    devices: list[FleetDevice],
    coordinator: NatsCoordinator,
    stream: NatsStream | None = None,
) -> FleetCollector:
    configuration = parsed(tmp_path, name, devices)
    return FleetCollector(configuration, coordinator, name, host=name, shards=8, times=TIMES, stream=stream)


async def test_a_collector_with_a_wrong_clock_says_so_and_owns_nothing_until_it_is_set(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with nats_server(tmp_path) as server:
        async with devices_of(2) as devices, connected(server) as first, connected(server) as second:
            wrong = member(tmp_path, "wrong", devices, first)
            ahead = [3600.0]

            def shifted() -> None:
                wrong.member.wall_ahead = time.time() + ahead[0] - wrong._now()

            wrong._driver._set_wall_clock = shifted  # type: ignore[method-assign]
            async with wrong:
                await until(lambda: wrong.problem, 60)
                async with member(tmp_path, "right", devices, second) as right:
                    await until(lambda: all(device.reads > 3 for device in devices), 60)
                    assert not wrong.member.owned
                    assert wrong.problem == "its clock is 3600 s ahead of the coordinator's"
                    assert "collector wrong owns nothing: its clock is 3600 s ahead" in caplog.text
                    shown = await zone_status(second, 60)
                    assert (shown.members["wrong"].state, shown.members["right"].state) == ("refuses", "polls")
                    ahead[0] = 0.0
                    await until(lambda: wrong.member.owned and right.member.owned, 60)
                    ahead[0] = -3600.0
                    await until(lambda: len(right.member.owned) == 2, 60)
                    assert wrong.problem == "its clock is 3600 s behind the coordinator's"


async def test_a_collector_whose_credentials_are_revoked_says_so_owns_nothing_and_goes_on_when_they_are_granted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with nats_server(tmp_path, accounts(tmp_path, "west"), jetstream=False) as server:
        config = tmp_path / "nats.conf"
        async with (
            devices_of(2) as devices,
            connected(server, USER) as coordinator,
            member(tmp_path, "one", devices, coordinator) as one,
        ):
            await until(lambda: all(device.reads > 3 for device in devices), 60)
            config.write_text(accounts(tmp_path, "east"))
            server.reload()
            await until(lambda: not one.member.owned and not one.collector.loads(), 60)
            await until(lambda: "the server refuses the credentials" in one.problem, 60)
            assert "the server refuses the credentials" in caplog.text
            with pytest.raises(ConfigError, match="refuses the credentials"):
                await open_nats(f"nats://127.0.0.1:{server.port}", "hall", USER)
            reads = [device.reads for device in devices]
            config.write_text(accounts(tmp_path, "west"))
            server.reload()
            await until(lambda: all(d.reads > count for d, count in zip(devices, reads, strict=True)), 60)
            await until(lambda: not one.problem, 60)


async def test_credentials_of_another_zone_are_refused_by_name(tmp_path: Path) -> None:
    of_hall = ', permissions: { publish: ["$KV.busway-hall.>", "$JS.API.*.*.KV_busway-hall"], subscribe: "_INBOX.>" }'
    with nats_server(tmp_path, accounts(tmp_path, "west", of_hall), jetstream=False) as server:
        async with connected(server, USER) as coordinator:
            assert await coordinator.create("member.west", b"x")
        with pytest.raises(ConfigError, match=r"the credentials do not permit the zone yard: .*kv_busway-yard"):
            await open_coordinator(f"nats://127.0.0.1:{server.port}", "yard", USER)


async def test_credentials_that_do_not_permit_to_read_the_table_are_refused_by_name_and_not_waited_for(
    tmp_path: Path,
) -> None:
    of_hall = (
        ', permissions: { publish: ["$KV.busway-hall.>", "$JS.API.STREAM.*.KV_busway-hall"], subscribe: "_INBOX.>" }'
    )
    with nats_server(tmp_path, accounts(tmp_path, "west", of_hall), jetstream=False) as server:
        async with connected(server, USER) as coordinator:
            with pytest.raises(ConfigError, match=r"do not permit to read the table busway-hall: .*consumer\.create"):
                await read_entries(coordinator, "")
            with pytest.raises(ConfigError, match="do not permit to read the table busway-hall"):
                await zone_status(coordinator, 60)


async def test_a_watch_that_has_shown_all_goes_on_when_rights_that_were_revoked_are_granted_again(
    tmp_path: Path,
) -> None:
    with nats_server(tmp_path, accounts(tmp_path, "west"), jetstream=False) as server:
        config = tmp_path / "nats.conf"
        async with connected(server, USER) as coordinator:
            await coordinator.create("member.west", b"x")
            async with contextlib.aclosing(coordinator.watch()) as entries:
                assert [await anext(entries), await anext(entries)][1] is SNAPSHOT_ENDS
                following = asyncio.ensure_future(anext(entries))
                server.stop()
                config.write_text(accounts(tmp_path, "west", ', permissions: { publish: "$JS.API.STREAM.>" }'))
                server.start()
                assert await following is SNAPSHOT_BEGINS
                following = asyncio.ensure_future(anext(entries))
                await until(lambda: "consumer.create" in coordinator.client.cause, 60)
                config.write_text(accounts(tmp_path, "west"))
                server.reload()
                while await following is not SNAPSHOT_ENDS:
                    following = asyncio.ensure_future(anext(entries))


async def test_a_stream_that_is_full_stops_no_polling_is_told_and_takes_what_waited_when_there_is_room(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    from nats.js.api import DiscardPolicy, StreamConfig

    with nats_server(tmp_path) as server:
        async with devices_of(2) as devices, connected(server) as coordinator:
            jetstream = coordinator.client.jetstream()
            full = StreamConfig(
                "busway-samples-hall", subjects=["busway.hall.samples.>"], max_bytes=1500, discard=DiscardPolicy.NEW
            )
            await jetstream.add_stream(full)
            await make_stream(coordinator.client, "hall")
            stream = NatsStream(coordinator.client, "hall", timeout=1.0)
            async with member(tmp_path, "one", devices, coordinator, stream) as one:
                outbox = one.outbox
                assert outbox is not None
                await until(lambda: outbox.status().error, 60)
                assert "maximum bytes exceeded" in str(outbox.status().error)
                assert "samples wait in the store: " in caplog.text
                reads = [device.reads for device in devices]
                await until(lambda: all(d.reads > count + 5 for d, count in zip(devices, reads, strict=True)), 60)
                samples = one.collector.store_status().samples
                await until(lambda: one.collector.store_status().samples > samples, 60)
                await jetstream.update_stream(full.evolve(max_bytes=10_000_000))
                newest = one.collector.newest_commit
                await until(lambda: outbox.status().sent >= newest and not outbox.status().error, 60)


async def test_a_stream_that_drops_what_no_sink_has_taken_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:

    with nats_server(tmp_path) as server:
        async with connected(server) as coordinator:
            await make_stream(coordinator.client, "hall", StreamOptions(max_bytes=1500))
            for _ in range(50):
                await coordinator.client.jetstream().publish("busway.hall.samples.0000", b"no message")
            sink = StreamSink(coordinator.client, coordinator, "hall", "keeping", NoSink())
            task = asyncio.create_task(sink.run())
            try:
                await until(lambda: sink.unreadable and sink.dropped, 60)
            finally:
                task.cancel()
                await asyncio.wait([task])
            assert sink.dropped + sink.unreadable == 50
            assert f"the stream was full and has dropped {sink.dropped} messages" in caplog.text
