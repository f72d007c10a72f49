"""The generated configuration on the real nats-server: each role can do its work, and is refused what is not its own.

Each refused operation has its equal: the same one by the role whose it is.
"""

import asyncio
import contextlib
import json
import re
import shutil
import subprocess
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from fleet_devices import METER, TIMES, FleetDevice, devices_of, plant
from foreign_servers import ForeignServer, free_port, needed
from program import Busway
from waiting import until

from busway.apps.collector.cancellation import end_tasks
from busway.apps.collector.configuration import load_collector
from busway.apps.fleet.control_entries import (
    apply_configuration,
    drain_collector,
    record_times,
    recorded_times,
)
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import NatsCoordinator, find_bucket, open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, open_coordinator, until_up
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_commands import FleetCommands, send_command
from busway.apps.fleet.fleet_status import zone_status
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.live_subjects import LiveSubjects
from busway.apps.fleet.streams import NatsStream, StreamSink, make_audit_stream, make_stream, sink_lags
from busway.cli.fleet_servers import write_server_files
from busway.errors import ConfigError
from busway.transport.tls.certificates.authority import Authority

pytest.importorskip("nats")
pytest.importorskip("nkeys")
pytest.importorskip("msgpack")
pytestmark = pytest.mark.real_time

ROLES: Final = ("collector", "sink", "operator")
STREAMS: Final = ("KV_busway-hall", "KV_busway-hall-commands", "busway-samples-hall", "busway-audit-hall")
OWN: Final = {
    "$KV.busway-hall.control.configuration": "operator",
    "$KV.busway-hall.control.drain.west": "operator",
    "$KV.busway-hall.generation": "operator",
    "$KV.busway-hall.lease.0001": "collector",
    "$KV.busway-hall.lease.pin.host": "collector",
    "$KV.busway-hall.member.west": "collector",
    "$KV.busway-hall.zone": "collector",
    "$KV.busway-hall-commands.keys.001": "collector",
    "$KV.busway-hall.cursor.broker": "sink",
    "busway.hall.samples.0001": "collector",
    "busway.hall.samples.pin.west": "collector",
    "busway.hall.audit": "collector",
}
"""Subjects of streams, and the one role that may publish to each."""
PLAIN: Final = {"busway.hall.live.meter": "collector", "busway.hall.command.link": "operator"}
"""Subjects that no stream has."""
ALSO: Final = {("collector", "busway.hall.command.link"), ("operator", "$KV.busway-hall.zone")}
"""Roles that may publish to a subject beside its own: collectors pass on commands that reach them as messages, and the
operator sets how long leases hold.
"""


class Site:
    """Generated files, and the server that runs by them, with TLS."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = free_port()
        authority = Authority.create()
        authority.issued.write(folder / "ca.pem", folder / "ca.key")
        authority.server(["127.0.0.1"]).write(folder / "n1.pem", folder / "n1.key")
        self.url = f"tls://127.0.0.1:{self.port}"
        self.generate()
        self.server = ForeignServer([needed("nats-server"), "-c", str(folder / "n1.conf")], self.port)

    def generate(self) -> None:
        servers = f"127.0.0.1:{self.port}"
        write_server_files(
            "hall,yard", str(self.folder), servers, "2.9", str(self.folder / "js"), str(self.folder), force=True
        )

    def options(self, role: str, zone: str = "hall", **more: Any) -> CoordinatorOptions:
        seed, ca = self.folder / f"{zone}-{role}.nk", str(self.folder / "ca.pem")
        there = self.folder / "there" / seed.name  # on the machine of the program
        if not there.exists():
            there.parent.mkdir(exist_ok=True)
            shutil.copy(seed, there)
        return CoordinatorOptions(credentials=str(there), ca=ca, answer=TIMES.answer, **more)

    @contextlib.asynccontextmanager
    async def table(self, role: str, zone: str = "hall") -> AsyncIterator[NatsCoordinator]:
        found = await until_up(
            lambda: open_nats(self.url, zone, self.options(role, zone.removesuffix("-commands"))), CoordinatorDown, 30
        )
        try:
            yield found
        finally:
            await found.close()

    @contextlib.asynccontextmanager
    async def made(self) -> AsyncIterator[NatsCoordinator]:
        """The zone as an operator makes it."""
        async with self.table("operator") as operator:
            await find_bucket(operator.client, "busway-hall-commands", self.options("operator"))
            await make_stream(operator.client, "hall")
            await make_audit_stream(operator.client, "hall", 1)
            yield operator


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    found = Site(tmp_path)
    with found.server:
        yield found


async def settled(client: Any) -> None:
    """Wait until the server has answered what was sent; twice, because the library's first ping may overtake it."""
    for _ in range(2):
        await client.flush(timeout=10)


async def refusal(client: Any, subject: str, data: bytes = b"", headers: Any = None, *, asks: bool = False) -> str:
    """What the server says to a message: empty where it is taken."""
    client.cause = ""
    if asks:
        with contextlib.suppress(Exception):  # whatever it answers, it was permitted
            await client.request(subject, data, timeout=0.3, headers=headers)
    else:
        await client.publish(subject, data, headers=headers)
    await settled(client)
    return str(client.cause)


async def test_the_operator_sets_how_long_leases_hold_and_collectors_have_that_time(site: Site) -> None:
    async with site.made() as operator, site.table("collector") as collector:
        assert await recorded_times(collector) == LeaseTimes()
        await record_times(operator, LeaseTimes.lasting(60.0), 8)
        assert await recorded_times(collector) == LeaseTimes.lasting(60.0)


async def test_each_subject_is_for_the_role_whose_it_is_and_for_no_other(site: Site) -> None:
    async with site.made() as operator, site.table("collector") as collector, site.table("sink") as sink:
        clients = {"operator": operator.client, "collector": collector.client, "sink": sink.client}
        for subject, owner in {**OWN, **PLAIN}.items():
            if subject in OWN:
                await clients[owner].jetstream(timeout=10).publish(subject, b"own")
            else:
                assert not await refusal(clients[owner], subject, b"own"), subject
            for role in ROLES:
                if role != owner and (role, subject) not in ALSO:
                    said = await refusal(clients[role], subject, b"attack")
                    assert "permissions violation for publish" in said.lower(), (role, subject)
        for role, client in clients.items():
            for stream in STREAMS:
                for call in ("DELETE", "PURGE", "UPDATE", "MSG.DELETE", "SNAPSHOT", "RESTORE"):
                    said = await refusal(client, f"$JS.API.STREAM.{call}.{stream}", b"{}")
                    assert "permissions violation" in said.lower(), (role, call, stream)
                said = await refusal(client, f"$JS.API.STREAM.CREATE.{stream}", b"{}")
                assert ("permissions violation" in said.lower()) == (role != "operator"), (role, stream)
                for call in (f"DIRECT.GET.{stream}", f"DIRECT.GET.{stream}.$KV.busway-hall.lease.0001"):
                    assert "permissions violation" in (await refusal(client, f"$JS.API.{call}")).lower(), (role, call)
                said = await refusal(client, f"$JS.API.CONSUMER.DELETE.{stream}.sink-broker")
                assert "permissions violation" in said.lower(), (role, stream)
            for subject in ("$KV.busway-yard.control.configuration", "_INBOX.of.others", "$JS.API.STREAM.NAMES", "x"):
                assert "permissions violation" in (await refusal(client, subject)).lower(), (role, subject)
            for subject in (">", "busway.hall.samples.>", "$KV.>", "busway.hall.command.*"):
                client.cause = ""
                await client.subscribe(subject)
                await settled(client)
                is_own = (role, subject) == ("collector", "busway.hall.command.*")
                assert ("permissions violation for subscription" in client.cause.lower()) != is_own, (role, subject)
        for stream, count in zip(STREAMS, (8, 1, 2, 1), strict=True):
            kept = (await operator.client.jetstream(timeout=10).stream_info(stream)).state
            assert kept.messages == count, f"{stream} has what was permitted, and nothing else"


async def test_no_header_and_no_consumer_of_a_collector_reaches_the_configuration(site: Site) -> None:
    from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy
    from nats.js.errors import APIError

    async with site.made() as operator, site.table("collector") as collector:
        configuration = "$KV.busway-hall.control.configuration"
        await operator.create("control.configuration", b"good")
        ours = collector.client.jetstream(timeout=10)
        for header in ({"Nats-Rollup": "all"}, {"Nats-Rollup": "sub"}):
            with pytest.raises(APIError, match="rollup"):
                await ours.publish("$KV.busway-hall.member.west", b"x", headers=header)
        await ours.publish("$KV.busway-hall-commands.keys.001", b"bad")
        for deliver in (configuration, "$JS.API.STREAM.PURGE.KV_busway-hall", "$JS.API.STREAM.DELETE.KV_busway-hall"):
            config = ConsumerConfig(
                deliver_subject=deliver, ack_policy=AckPolicy.NONE, deliver_policy=DeliverPolicy.ALL
            )
            await ours.add_consumer("KV_busway-hall-commands", config)
        with pytest.raises(APIError, match="cycle"):
            await ours.add_consumer("KV_busway-hall", config.evolve(deliver_subject=configuration))
        await asyncio.sleep(0.3)
        async with contextlib.aclosing(operator.watch("control.")) as entries:
            first = await anext(entries)
        assert (first.key, first.value) == ("control.configuration", b"good")


class KeepingSink:
    """Counts the samples that it gets."""

    def __init__(self) -> None:
        self.taken = 0

    async def open(self) -> None:
        pass

    async def send(self, samples: Any) -> None:
        self.taken += len(samples)

    async def close(self) -> None:
        pass


def file_of(folder: Path, name: str, devices: list[FleetDevice]) -> str:
    text = plant(folder / name, devices)
    (folder / "meter.toml").write_text(
        f'{METER}\n[[unit.point]]\nname = "setpoint"\naddress = "4x11"\ntype = "uint16"\nmaximum = 1000\nwrite = {{}}\n'
    )
    (folder / f"{name}.toml").write_text(text)
    return str(folder / f"{name}.toml")


@contextlib.asynccontextmanager
async def collecting(site: Site, name: str, devices: list[FleetDevice], revision: int) -> AsyncIterator[FleetCollector]:
    async with contextlib.AsyncExitStack() as stack:
        table = await stack.enter_async_context(site.table("collector"))
        keys = await stack.enter_async_context(site.table("collector", "hall-commands"))
        await make_stream(table.client, "hall")
        stream = NatsStream(table.client, "hall", timeout=1.0)
        watch = asyncio.create_task(stream.watch_cursors(table))
        stack.push_async_callback(end_tasks, [watch])
        fleet = FleetCollector(
            load_collector(file_of(site.folder, name, devices)),
            table, name, host=name, shards=8, times=TIMES, stream=stream, revision=revision, keys=keys,
        )  # fmt: skip
        await stack.enter_async_context(fleet)
        await stack.enter_async_context(FleetCommands(fleet, table.client, "hall"))
        await stack.enter_async_context(LiveSubjects(fleet.collector, table.client, "hall"))
        yield fleet


async def test_each_role_can_do_its_whole_work_and_a_collector_whose_rights_are_revoked_says_so_and_holds_nothing(
    site: Site, caplog: pytest.LogCaptureFixture
) -> None:
    sink = KeepingSink()
    async with contextlib.AsyncExitStack() as stack:
        devices = await stack.enter_async_context(devices_of(2))
        operator = await stack.enter_async_context(site.made())
        revision = await apply_configuration(operator, file_of(site.folder, "applied", devices), TIMES)
        reading = await stack.enter_async_context(site.table("sink"))
        handed = StreamSink(reading.client, reading, "hall", "broker", sink)
        task = asyncio.create_task(handed.run())
        stack.push_async_callback(end_tasks, [task])
        live: list[Any] = []

        async def came(message: Any) -> None:
            live.append(json.loads(message.data))

        await operator.client.subscribe("busway.hall.live.*", cb=came)
        west = await stack.enter_async_context(collecting(site, "west", devices, revision))
        east = await stack.enter_async_context(collecting(site, "east", devices, revision))
        await until(lambda: west.links and east.links and sink.taken > 10 and live, 90)
        for fleet in (west, east):
            assert fleet.outbox is not None
            newest = fleet.collector.newest_commit
            await until(lambda fleet=fleet, newest=newest: fleet.outbox.status().kept >= newest, 60)  # type: ignore[misc]
        link = min(west.links)
        content = {"key": "k1", "device": link, "point": "setpoint", "value": 7, "by": "operator"}
        assert (await send_command(operator.client, "hall", link, content, 30))["state"] == "done"
        lines = await operator.client.jetstream(timeout=10).subscribe("busway.hall.audit", stream="busway-audit-hall")
        assert json.loads((await lines.next_msg(30)).data)["by"] == "operator"
        assert "broker" in await sink_lags(operator.client, operator, "hall")
        newer = await apply_configuration(operator, file_of(site.folder, "applied", devices), TIMES)
        await until(lambda: west.revision == east.revision == newer, 60)
        await drain_collector(operator, "west")
        await until(lambda: not west.member.owned and len(east.links) == 2, 60)
        assert (await zone_status(operator, 4)).members["west"].state == "drains"
        for client, role in ((west._coordinator.client, "collector"), (reading.client, "sink")):  # type: ignore[attr-defined]
            assert not client.cause, f"nothing was refused to the {role}"
        seed = site.folder / "hall-collector.nk"
        seed.unlink()
        site.generate()  # with a new seed for collectors
        site.server.reload()
        await until(lambda: not east.member.owned and not east.links, 60)
        await until(lambda: "the server refuses the credentials" in east.problem, 60)
        assert "the server refuses the credentials" in caplog.text
        reads = [device.reads for device in devices]
        await asyncio.sleep(0.3)
        assert [device.reads for device in devices] == reads
        assert (await zone_status(operator, 0.5)).members["east"].state == "silent", "the operator's rights still hold"
        (site.folder / "there" / seed.name).write_text("SUhalf")
        await until(lambda: "holds no seed of a user" in east.problem, 60)
        shutil.copy(seed, site.folder / "there" / seed.name)
        await until(lambda: all(d.reads > count for d, count in zip(devices, reads, strict=True)), 60)


async def test_what_a_consumer_of_a_sink_delivers_on_the_subject_of_a_link_is_no_command(site: Site) -> None:
    """The server checks no right for the subject of a delivery, but the message keeps the subject of its stream."""
    from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy

    arrived: list[Any] = []

    async def came(message: Any) -> None:
        arrived.append(message)

    async with contextlib.AsyncExitStack() as stack:
        devices = await stack.enter_async_context(devices_of(1))
        operator = await stack.enter_async_context(site.made())
        revision = await apply_configuration(operator, file_of(site.folder, "applied", devices), TIMES)
        west = await stack.enter_async_context(collecting(site, "west", devices, revision))
        await until(lambda: bool(west.links), 90)
        link = min(west.links)
        sink = await stack.enter_async_context(site.table("sink"))
        await west._coordinator.client.subscribe(f"busway.hall.command.{link}", cb=came)  # type: ignore[attr-defined]
        await settled(west._coordinator.client)  # type: ignore[attr-defined]
        command = {"device": link, "point": "setpoint", "value": 66}
        ours = sink.client.jetstream(timeout=10)
        await ours.publish("$KV.busway-hall.cursor.broker", json.dumps({**command, "key": "theirs"}).encode())
        config = ConsumerConfig(
            deliver_subject=f"busway.hall.command.{link}", ack_policy=AckPolicy.NONE, deliver_policy=DeliverPolicy.ALL
        )
        await ours.add_consumer("KV_busway-hall", config)
        await until(lambda: any(b"theirs" in message.data for message in arrived), 30)
        allowed = {**command, "value": 7, "key": "ours"}
        assert (await send_command(operator.client, "hall", link, allowed, 30))["state"] == "done"
        assert [value for _, value in devices[0].written] == [7]


async def test_what_a_collector_misses_is_said_by_name(site: Site) -> None:
    async with site.table("operator") as operator:
        with pytest.raises(ConfigError, match=r"bucket busway-hall-commands is not there yet.* busway fleet apply"):
            async with site.table("collector", "hall-commands"):
                pass
        async with site.table("collector") as collector:
            with pytest.raises(ConfigError, match=r"stream busway-audit-hall is not there yet.* busway fleet apply"):
                await make_audit_stream(collector.client, "hall", 1)
            with pytest.raises(CoordinatorDown, match=r"do not permit to change control.configuration: .*permissions"):
                await collector.create("control.configuration", b"x")
        with pytest.raises(ConfigError, match="the credentials do not permit commands"):
            async with site.table("sink") as sink:
                await send_command(sink.client, "hall", "link", {"key": "k"}, 1.0)
        async with devices_of(1) as devices:
            await apply_configuration(operator, file_of(site.folder, "applied", devices))
        await find_bucket(operator.client, "busway-hall-commands", site.options("operator"))
        accounts = site.folder / "accounts.conf"
        accounts.write_text(re.sub(r'"[^"]*busway-hall-commands[^"]*", ', "", accounts.read_text()))
        site.server.reload()
        words = ("--coordinator", site.url, "--zone", "hall", "--ca", str(site.folder / "ca.pem"))
        words += ("--credentials", str(site.folder / "hall-collector.nk"), "--store", str(site.folder / "west"))
        with Busway("fleet", "run", *words) as program:
            _, error = await asyncio.to_thread(program.end)
        assert program.process.returncode == 2
        assert (
            "the table of the keys of commands cannot be used: the credentials do not permit the zone hall-commands"
            in error
        )


async def test_three_servers_run_by_their_files_as_a_cluster(tmp_path: Path) -> None:
    ports = [free_port() for _ in range(3)]
    plan = ",".join(f"127.0.0.1:{port}" for port in ports)
    write_server_files("hall", str(tmp_path), plan, "2.9", str(tmp_path / "js"), None, force=False)
    program = needed("nats-server")
    options = CoordinatorOptions(credentials=str(tmp_path / "hall-operator.nk"), replicas=3, start=60.0)
    with contextlib.ExitStack() as stack:
        for number, port in enumerate(ports, 1):
            stack.enter_context(ForeignServer([program, "-c", str(tmp_path / f"n{number}.conf")], port))
        table = await open_coordinator(f"nats://{plan}", "hall", options)
        try:
            await until_up(lambda: table.create("control.drain.west", b""), CoordinatorDown, 30)
            info = await table.client.jetstream(timeout=10).stream_info("KV_busway-hall")
            assert (info.config.num_replicas, len(info.cluster.replicas)) == (3, 2)
        finally:
            await table.close()


@pytest.mark.parametrize(("version", "said"), [("2.9", "is valid"), ("2.10", 'unknown field "sync_interval"')])
def test_the_server_takes_the_files_for_its_version_with_certificates(tmp_path: Path, version: str, said: str) -> None:
    authority = Authority.create()
    authority.issued.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    authority.server(["a"]).write(tmp_path / "n1.pem", tmp_path / "n1.key")
    write_server_files("hall", str(tmp_path), "a,b,c", version, str(tmp_path), str(tmp_path), force=False)
    words = [needed("nats-server"), "-t", "-c", str(tmp_path / "n1.conf")]
    found = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert said in found.stdout + found.stderr
