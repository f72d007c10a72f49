"""The rules of `busway.apps.fleet.coordinator`, the same tests for every backend, each with its real server."""

import asyncio
import contextlib
import time
from collections.abc import AsyncGenerator, AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fleet_devices import TIMES, FleetDevice, devices_of, plant
from foreign_servers import ForeignServer, PostgresqlServer, nats_cluster, nats_server
from waiting import until

from busway.apps.fleet.control_entries import (
    CONFIGURATION,
    SharedConfiguration,
    apply_configuration,
    drain_collector,
    read_configuration,
    read_entries,
    refuse_other_figures,
)
from busway.apps.fleet.coordinator import (
    LONGEST_VALUE,
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    Coordinator,
    CoordinatorDown,
    Entry,
    OutcomeUnknown,
    RevisionConflict,
)
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.nats import NatsCoordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_status import zone_status
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.streams import StreamOptions, make_audit_stream, make_stream
from busway.apps.fleet.table_records import LeaseRecord, MemberRecord, ZoneRecord
from busway.errors import ConfigError

SERVED = ["nats", "postgresql"]


class Backend:
    """A backend with its server, and a zone of its own for each test."""

    def __init__(self, url: str, server: ForeignServer | None, options: CoordinatorOptions) -> None:
        self.url, self.server, self.options = url, server, options
        self.zone = "hall"

    def stop(self) -> None:
        """Make the table unusable until `start`; what was confirmed stays."""
        if self.server is not None:
            self.server.stop()
        else:
            file = Path(self.url.removeprefix("local:")) / f"{self.zone}.fleet"
            file.rename(file.with_suffix(".aside"))
            file.mkdir()

    def start(self) -> None:
        if self.server is not None:
            self.server.start()
        else:
            file = Path(self.url.removeprefix("local:")) / f"{self.zone}.fleet"
            file.rmdir()
            file.with_suffix(".aside").rename(file)

    @contextlib.asynccontextmanager
    async def opened(self, zone: str | None = None) -> AsyncIterator[Coordinator]:
        coordinator = await open_coordinator(self.url, zone or self.zone, self.options)
        try:
            yield coordinator
        finally:
            await coordinator.close()


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Backend]]:
    started: dict[str, Backend] = {}
    with contextlib.ExitStack() as stack:

        class Started(dict[str, Backend]):
            def __missing__(self, kind: str) -> Backend:
                folder = tmp_path_factory.mktemp(kind)
                if kind == "local":
                    self[kind] = Backend(f"local:{folder}", None, CoordinatorOptions())
                elif kind == "nats":
                    pytest.importorskip("nats")
                    server = stack.enter_context(nats_server(folder))
                    self[kind] = Backend(f"nats://127.0.0.1:{server.port}", server, CoordinatorOptions(answer=1.0))
                else:
                    pytest.importorskip("asyncpg")
                    database = stack.enter_context(PostgresqlServer(syncs=True))
                    options = CoordinatorOptions(password=database.PASSWORD, answer=1.0)
                    self[kind] = Backend(database.url, database, options)
                return self[kind]

        started = Started()
        yield started


@pytest.fixture(params=["local", *SERVED])
def backend(request: pytest.FixtureRequest, servers: dict[str, Backend]) -> Backend:
    found = servers[request.param]
    found.zone = f"zone-{abs(hash(request.node.name)) % 10**9}"
    return found


@pytest.fixture(params=SERVED)
def served(request: pytest.FixtureRequest, servers: dict[str, Backend]) -> Backend:
    found = servers[request.param]
    found.zone = f"zone-{abs(hash(request.node.name)) % 10**9}"
    return found


async def snapshot(coordinator: Coordinator, prefix: str = "") -> list[Entry]:
    found = []
    async with contextlib.aclosing(coordinator.watch(prefix)) as entries:
        async for entry in entries:
            if entry is SNAPSHOT_ENDS:
                return found
            found.append(entry)
    raise AssertionError("the watch has ended")


async def test_an_entry_is_created_once_and_replaced_only_at_its_revision(backend: Backend) -> None:
    async with backend.opened() as one, backend.opened() as other:
        first = await one.create("lease.0001", b"a")
        with pytest.raises(RevisionConflict):
            await other.create("lease.0001", b"b")
        second = await other.replace("lease.0001", b"c", first)
        assert second > first
        with pytest.raises(RevisionConflict):
            await one.replace("lease.0001", b"d", first)
        with pytest.raises(RevisionConflict):
            await one.replace("lease.0002", b"d", first)
        assert await snapshot(one) == [Entry("lease.0001", b"c", second)]


async def test_the_same_value_again_is_a_change_too(backend: Backend) -> None:
    async with backend.opened() as one:
        first = await one.create("member.a", b"same")
        second = await one.replace("member.a", b"same", first)
        assert second > first
        with pytest.raises(RevisionConflict):
            await one.replace("member.a", b"same", first)


async def test_of_many_that_expect_one_revision_one_is_confirmed(backend: Backend) -> None:
    async with contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(backend.opened()) for _ in range(4)]
        revision = await clients[0].create("lease.0001", b"")
        for turn in range(5):
            tries = [client.replace("lease.0001", b"%d" % turn, revision) for client in clients for _ in range(3)]
            found = await asyncio.gather(*tries, return_exceptions=True)
            confirmed = [each for each in found if isinstance(each, int)]
            assert len(confirmed) == 1
            assert all(isinstance(each, int | RevisionConflict) for each in found)
            revision = confirmed[0]


async def test_a_deleted_entry_keeps_its_revision_and_goes_on_from_there(backend: Backend) -> None:
    async with backend.opened() as one:
        first = await one.create("lease.0001", b"a")
        gone = await one.replace("lease.0001", b"", first)
        with pytest.raises(RevisionConflict):
            await one.create("lease.0001", b"b")
        assert await snapshot(one) == [Entry("lease.0001", b"", gone)]
        assert await one.replace("lease.0001", b"b", gone) > gone


async def test_a_watch_gives_what_is_there_then_the_end_then_changes_in_order(backend: Backend) -> None:
    async with backend.opened() as one, backend.opened() as other:
        revisions = [await one.create(f"lease.{number:04d}", b"%d" % number) for number in range(5)]
        found: list[Entry] = []
        async with contextlib.aclosing(other.watch("lease.")) as entries:
            async for entry in entries:
                found.append(entry)
                if entry is SNAPSHOT_ENDS:
                    for turn in range(20):
                        revisions[turn % 5] = await one.replace(f"lease.{turn % 5:04d}", b"x", revisions[turn % 5])
                    await one.create("member.a", b"not asked for")
                if entry.revision == revisions[-1] and SNAPSHOT_ENDS in found:
                    break
        assert [each.key for each in found[:5]] == [f"lease.{number:04d}" for number in range(5)]
        assert found[5] is SNAPSHOT_ENDS
        for key in {each.key for each in found[6:]}:
            seen = [each.revision for each in found if each.key == key]
            assert seen == sorted(set(seen))


async def test_a_watch_of_an_empty_zone_ends_its_snapshot_at_once(backend: Backend) -> None:
    async with backend.opened() as one:
        async with asyncio.timeout(60):
            assert await snapshot(one) == []


async def test_zones_do_not_see_each_other(backend: Backend) -> None:
    async with backend.opened() as one, backend.opened(f"{backend.zone}-b") as other:
        await one.create("lease.0001", b"a")
        await other.create("lease.0001", b"b")
        assert [each.value for each in await snapshot(other)] == [b"b"]


async def test_a_value_that_is_too_long_is_refused(backend: Backend) -> None:
    async with backend.opened() as one:
        await one.create("long", b"x" * LONGEST_VALUE)
        with pytest.raises(ConfigError, match="up to 524288 bytes"):
            await one.create("longer", b"x" * (LONGEST_VALUE + 1))


async def test_a_broken_configuration_never_replaces_a_good_one(backend: Backend, tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    async with backend.opened() as one, backend.opened() as other:
        assert await read_configuration(one) is None
        file.write_text(plant(tmp_path / "store", [FleetDevice("a", 502)]))
        first = await apply_configuration(one, str(file))
        good = await read_configuration(other)
        assert good == SharedConfiguration(str(file), file.read_text(), first)
        file.write_text(file.read_text().replace("fast.period = 0.1", "fast.period = -1"))
        with pytest.raises(ConfigError, match=r"plant\.toml:4: .*period"):
            await apply_configuration(one, str(file))
        assert await read_configuration(other) == good
        file.write_text(plant(tmp_path / "store", [FleetDevice("b", 502)]))
        assert await apply_configuration(other, str(file)) > first


async def test_of_two_that_apply_at_once_one_is_told(backend: Backend, tmp_path: Path) -> None:
    file = tmp_path / "plant.toml"
    file.write_text(plant(tmp_path / "store", [FleetDevice("a", 502)]))
    async with backend.opened() as one, backend.opened() as other:
        await apply_configuration(one, str(file))
        seen = (await read_entries(one, CONFIGURATION))[CONFIGURATION]
        later = await apply_configuration(other, str(file))
        with pytest.raises(RevisionConflict):
            await one.replace(CONFIGURATION, seen.value, seen.revision)
        found = await read_configuration(one)
        assert found is not None
        assert found.revision == later


async def test_a_zone_shows_who_lives_who_is_silent_and_who_owns_what(backend: Backend) -> None:
    async with backend.opened() as one:
        alive = MemberRecord("west", "r1", "box", 1)
        revision = await one.create("member.west", alive.encode())
        await one.create("member.east", MemberRecord("east", "r2", "box", 1, revision=7).encode())
        await one.create("member.old", MemberRecord("old", "r3", "box", 1, gone=True).encode())
        await one.create("lease.0001", LeaseRecord("west", "r1", True, 1, 0.25, Epoch(1, 4)).encode())
        await drain_collector(one, "west")
        with pytest.raises(ConfigError, match="there are east, old, west"):
            await drain_collector(one, "wset")
        for seconds in (0.5, 5, 60):  # a busy machine renews late
            looking = asyncio.create_task(zone_status(one, seconds))
            while not looking.done():
                revision = await one.replace("member.west", alive.encode(), revision)
                await asyncio.sleep(0.05)
            found = await looking
            if found.members["west"].lives:
                break
        assert {name: each.state for name, each in found.members.items()} == {
            "west": "drains",
            "east": "silent",
            "old": "ended",
        }
        assert (found.members["west"].shards, found.members["west"].load) == (("0001",), 0.25)
        assert found.members["east"].record.revision == 7


async def test_who_joins_a_zone_with_other_figures_is_refused_by_name(backend: Backend) -> None:
    async with backend.opened("figures") as one:
        await refuse_other_figures(one, 16, LeaseTimes())  # no collector has joined
        await one.create("zone", ZoneRecord(8, 15.0, 1.0).encode())
        await refuse_other_figures(one, 8, LeaseTimes())
        with pytest.raises(ConfigError, match="the zone has 8 shards and not 16; all its collectors"):
            await refuse_other_figures(one, 16, LeaseTimes())
        with pytest.raises(ConfigError, match="leases of 15 s and not 30"):
            await refuse_other_figures(one, 8, LeaseTimes(ttl=30.0))


async def test_what_was_confirmed_survives_an_outage_and_the_watch_goes_on_and_tells_both(
    backend: Backend, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("WARNING")
    async with backend.opened() as one:
        revision = await one.create("lease.0001", b"a")
        async with contextlib.aclosing(one.watch()) as entries:
            assert [(await anext(entries)).value, await anext(entries)] == [b"a", SNAPSHOT_ENDS]
            backend.stop()
            with pytest.raises((CoordinatorDown, OutcomeUnknown)):
                await one.replace("lease.0001", b"b", revision)
            assert await anext(entries) is SNAPSHOT_BEGINS
            again = asyncio.create_task(_after_marks(entries))
            await until(lambda: "the table of the zone cannot be followed" in caplog.text)
            backend.start()
            async with asyncio.timeout(30):
                assert (await again).revision == revision
                assert await anext(entries) is SNAPSHOT_ENDS
                while True:
                    try:
                        changed = await one.replace("lease.0001", b"c", revision)
                        break
                    except (CoordinatorDown, OutcomeUnknown):
                        await asyncio.sleep(0.1)
                assert (await anext(entries)).revision == changed
        assert caplog.text.count("the table of the zone cannot be followed") == 1
        assert caplog.text.count("the table of the zone is followed again") == 1


async def _after_marks(entries: AsyncGenerator[Entry, None]) -> Entry:
    """The next entry of a watch that has begun again, perhaps several times."""
    async for entry in entries:
        if entry is not SNAPSHOT_BEGINS:
            return entry
    raise AssertionError("the watch has ended")


async def test_an_entry_has_the_time_of_its_change_by_the_servers_clock(served: Backend) -> None:
    async with served.opened() as one:
        before = time.time()
        revision = await one.create("member.west", b"a")
        (made,) = await snapshot(one)
        await one.replace("member.west", b"b", revision)
        (changed,) = await snapshot(one)
        after = time.time()
    assert made.time is not None
    assert changed.time is not None
    assert before - 0.01 <= made.time < changed.time <= after + 0.01


async def test_a_bucket_that_forgets_entries_is_refused_by_name(servers: dict[str, Backend]) -> None:
    backend = servers["nats"]
    async with backend.opened("forgets") as one:
        assert isinstance(one, NatsCoordinator)
        jetstream = one.client.jetstream()
        info = await jetstream.stream_info("KV_busway-forgets")
        await jetstream.update_stream(info.config.evolve(max_age=3600.0))
    with pytest.raises(ConfigError, match="the bucket busway-forgets forgets entries after 3600 s, leases too"):
        async with backend.opened("forgets"):
            pass


@pytest.mark.parametrize("permits", [False, True])
async def test_nothing_is_decided_by_what_was_got_from_a_server_also_where_any_server_may_answer(
    servers: dict[str, Backend], tmp_path: Path, permits: bool
) -> None:
    """A follower that lags answers a direct get, and the leader's answer is old when it comes."""
    backend, zone = servers["nats"], f"direct-{permits}"
    asked: list[str] = []

    async def came(message: Any) -> None:
        asked.append(message.subject)

    async with contextlib.AsyncExitStack() as stack:
        devices = await stack.enter_async_context(devices_of(2))
        table = await stack.enter_async_context(backend.opened(zone))
        assert isinstance(table, NatsCoordinator)
        jetstream = table.client.jetstream()
        config = (await jetstream.stream_info(f"KV_busway-{zone}")).config
        assert not config.allow_direct
        if permits:
            assert (await jetstream.update_stream(config.evolve(allow_direct=True))).config.allow_direct
        await table.client.subscribe("$JS.API.>", cb=came)
        (tmp_path / "plant.toml").write_text(plant(tmp_path / "store", devices))
        await apply_configuration(table, str(tmp_path / "plant.toml"))
        shared = await read_configuration(table)
        assert shared is not None
        for name in ("one", "two"):
            configuration = replace(shared.parsed(TIMES), store=str(tmp_path / name))
            other = await stack.enter_async_context(backend.opened(zone))
            await stack.enter_async_context(
                FleetCollector(
                    configuration, other, name, host=name, shards=8, times=TIMES, revision=shared.revision, keys=table
                )
            )
        await until(lambda: all(device.reads > 3 for device in devices))
        with pytest.raises(RevisionConflict):
            await table.create(CONFIGURATION, b"x")
        await drain_collector(table, "one")
        assert set((await zone_status(table, 2)).members) == {"one", "two"}
    assert any("CONSUMER.CREATE" in subject for subject in asked), "the table is watched"
    assert not [subject for subject in asked if "GET" in subject]


async def test_a_database_that_does_not_sync_is_refused_by_name() -> None:
    pytest.importorskip("asyncpg")
    with PostgresqlServer() as server, pytest.raises(ConfigError, match="fsync = off"):
        await open_coordinator(server.url, "hall", CoordinatorOptions(password=server.PASSWORD))


async def test_a_role_that_may_not_read_the_table_of_a_database_is_refused_by_name_and_not_waited_for(
    servers: dict[str, Backend],
) -> None:
    asyncpg = pytest.importorskip("asyncpg")
    backend = servers["postgresql"]
    async with backend.opened("hall"):
        owner = await asyncpg.connect(backend.url, password=backend.options.password)
        try:
            await owner.execute("CREATE ROLE reader LOGIN PASSWORD 'x'; GRANT CREATE ON SCHEMA public TO reader")
        finally:
            await owner.close()
    coordinator = await open_coordinator(backend.url, "hall", replace(backend.options, user="reader", password="x"))
    try:
        with pytest.raises(ConfigError, match="busway_fleet cannot be read: permission denied"):
            await read_entries(coordinator, "")
    finally:
        await coordinator.close()


async def test_a_nats_server_that_is_too_old_is_refused_by_name() -> None:
    pytest.importorskip("nats")

    async def old(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        info = b'{"server_id":"N","version":"2.8.4","proto":1,"headers":true,"jetstream":true,"max_payload":1048576}'
        writer.write(b"INFO " + info + b"\r\n")
        while line := await reader.readline():
            if line.startswith(b"PING"):
                writer.write(b"PONG\r\n")
        writer.close()

    server = await asyncio.start_server(old, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    try:
        with pytest.raises(ConfigError, match=rf":{port} runs nats-server 2\.8\.4; 2\.9 or newer is needed"):
            await open_coordinator(f"nats://127.0.0.1:{port}", "hall", CoordinatorOptions(answer=1.0))
    finally:
        server.close()


async def test_a_database_that_is_too_old_is_refused_by_name(
    servers: dict[str, Backend], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = servers["postgresql"]
    monkeypatch.setattr("busway.apps.fleet.coordinators.postgresql.OLDEST", 990_000)
    with pytest.raises(ConfigError, match=r"the server is PostgreSQL \d+.*; 12 or newer is needed"):
        await open_coordinator(backend.url, "hall", backend.options)


async def test_a_server_without_jetstream_is_refused_by_name(tmp_path: Path) -> None:
    pytest.importorskip("nats")
    with nats_server(tmp_path, jetstream=False) as server, pytest.raises(ConfigError, match="has no JetStream"):
        await open_coordinator(f"nats://127.0.0.1:{server.port}", "hall", CoordinatorOptions(answer=1.0))


async def test_more_replicas_than_servers_are_refused_by_name(servers: dict[str, Backend]) -> None:
    url = servers["nats"].url
    with pytest.raises(ConfigError, match="replicas"):
        await open_coordinator(url, "three", CoordinatorOptions(replicas=3))
    coordinator = await open_coordinator(url, "one", CoordinatorOptions())
    await coordinator.close()
    with pytest.raises(ConfigError, match="has 1 replicas, and 3 are asked for"):
        await open_coordinator(url, "one", CoordinatorOptions(replicas=3))


async def test_streams_of_samples_and_of_the_audit_with_too_few_replicas_are_refused_by_name(
    servers: dict[str, Backend],
) -> None:
    coordinator = await open_coordinator(servers["nats"].url, "few", CoordinatorOptions())
    try:
        client = coordinator.client  # type: ignore[attr-defined]
        await make_stream(client, "few", StreamOptions(replicas=1))
        await make_audit_stream(client, "few", 1)
        with pytest.raises(ConfigError, match="the stream busway-samples-few has 1 replicas, and 3 are asked for"):
            await make_stream(client, "few", StreamOptions(replicas=3))
        with pytest.raises(ConfigError, match="the stream busway-audit-few has 1 replicas, and 3 are asked for"):
            await make_audit_stream(client, "few", 3)
    finally:
        await coordinator.close()


@pytest.mark.parametrize("url", ["nats://127.0.0.1:1", "postgresql://x@127.0.0.1:1/x"])
async def test_a_server_that_is_not_there_is_named(url: str) -> None:
    pytest.importorskip("nats" if url.startswith("nats") else "asyncpg")
    with pytest.raises(CoordinatorDown, match=r"127\.0\.0\.1:1"):
        await open_coordinator(url, "hall", CoordinatorOptions(answer=0.3, start=0.0))


@pytest.mark.parametrize("kind", SERVED)
async def test_a_server_that_starts_after_its_collector_is_waited_for(
    kind: str, servers: dict[str, Backend], caplog: pytest.LogCaptureFixture
) -> None:
    server = servers[kind].server
    assert server is not None
    server.stop()
    opening = asyncio.create_task(
        open_coordinator(servers[kind].url, "late", replace(servers[kind].options, start=60.0))
    )
    try:
        while "it is asked again for 60 s" not in caplog.text:
            assert not opening.done()
            await asyncio.sleep(0.01)
    finally:
        server.start()
        coordinator = await opening
        await coordinator.close()


async def test_a_cluster_without_a_leader_is_waited_for_and_told(tmp_path: Path) -> None:
    pytest.importorskip("nats")
    options = CoordinatorOptions(answer=0.5, start=0.0)
    one, other = nats_cluster(tmp_path, 2)
    with one:
        with pytest.raises(CoordinatorDown, match=r"the bucket busway-hall (does not answer|cannot be used yet)"):
            await open_coordinator(f"nats://127.0.0.1:{one.port}", "hall", options)
        with other:
            coordinator = await open_coordinator(f"nats://127.0.0.1:{one.port}", "hall", replace(options, start=60.0))
            await coordinator.close()


async def test_other_urls_and_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="local:FOLDER, nats://"):
        await open_coordinator("etcd://x", "hall")
    with pytest.raises(ConfigError, match="zone 'a b' cannot be a name"):
        await open_coordinator(f"local:{tmp_path}", "a b")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be used"):
        await open_coordinator(f"local:{tmp_path}/file", "hall")


async def test_the_zone_with_the_longest_name_can_be_used(backend: Backend) -> None:
    async with backend.opened("a" * 63) as one:
        revision = await one.create("lease.0001", b"a")
        assert Entry("lease.0001", b"a", revision) in await snapshot(one)


async def test_a_wrong_password_in_the_url_is_in_no_error_and_no_log(
    servers: dict[str, Backend], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG")
    url = servers["postgresql"].url
    user = url.partition("://")[2].partition("@")[0].partition(":")[0]
    wrong = url.replace(f"{user}@", f"{user}:wr0ng-in-the-url@")
    with pytest.raises(ConfigError, match="refuses the credentials") as caught:
        await open_coordinator(wrong, "hall", CoordinatorOptions())
    assert "wr0ng" not in str(caught.value) + repr(caught.value.__dict__) + caplog.text
