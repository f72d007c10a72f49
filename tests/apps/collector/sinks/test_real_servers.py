"""Sinks against the servers they are for: one that is down for a while gets everything when it is back, in order."""

import asyncio
import contextlib
import gc
import json
import os
import re
import ssl
import subprocess
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from collected import METER, NOON, PUMP, at, filled, read_of
from deliveries import commit_reads, delivery_to, run_until
from foreign_servers import ForeignServer, PostgresqlServer, influxdb, mosquitto, nats_server, needed, victoria_metrics
from waiting import until

import busway
from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointDescription, PointGroup, Reason, SampleBatch
from busway.apps.collector.sinks.delivery import ASIDE, Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.mqtt import MqttSink
from busway.apps.collector.sinks.nats import NatsSink
from busway.apps.collector.sinks.postgresql import PostgresqlSink
from busway.apps.collector.store.committed_samples import CommittedAlarm, CommittedSample
from busway.apps.collector.store.writer import StoreWriter

READS = 30
WANTED = [float(number) for number in range(READS)]
QUICK = DeliveryOptions(age=0, most=20)
ALARM = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(1), 90.0, "", True, "above 80 rpm")
ACKNOWLEDGED = replace(ALARM, kind=AlarmEventKind.ACKNOWLEDGED, at=at(2), value=None, by="anna")
RETAINED = "retained"
"""The topic of a message that a subscriber hears as soon as it has subscribed."""


@contextlib.asynccontextmanager
async def heard(server: ForeignServer, folder: Path, *options: str) -> AsyncIterator[list[tuple[str, dict[str, Any]]]]:
    """What mosquitto_sub hears from now on, as topic and JSON."""
    messages: list[tuple[str, dict[str, Any]]] = []
    where = ["-h", "127.0.0.1", "-p", str(server.port), "-V", "mqttv5", "-q", "1", *options]
    retain = [needed("mosquitto_pub"), *where, "-r", "-t", RETAINED, "-m", "{}"]
    await asyncio.to_thread(subprocess.run, retain, check=True, timeout=20)
    command = [needed("mosquitto_sub"), *where, "-t", "#", "-F", "%t\t%p"]
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    async def collect() -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            topic, _, payload = line.decode().rstrip("\n").partition("\t")
            if topic == RETAINED:
                subscribed.set()
                continue
            with contextlib.suppress(ValueError):
                messages.append((topic, json.loads(payload)))

    subscribed = asyncio.Event()
    task = asyncio.create_task(collect())
    try:
        async with asyncio.timeout(60):
            await subscribed.wait()
        yield messages
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()  # a subscriber can block in its handler of SIGTERM; all that is wanted was heard before
        await process.wait()
        await task


def currents(messages: list[tuple[str, dict[str, Any]]]) -> list[float]:
    """The currents of a meter in the order in which they were heard, repetitions aside."""
    found: dict[int, float] = {}
    for _, message in messages:
        for read in message.get("reads", ()):
            found.setdefault(read["time"], read["values"]["current"])
    return list(found.values())


async def test_a_broker_that_was_down_gets_everything_in_order(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server, filled(tmp_path / "store", 10) as writer:
        sink = MqttSink("127.0.0.1", server.port, topic="plant/{device}", timeout=2.0)
        delivery = delivery_to(sink, writer, QUICK)
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: len(currents(messages)) == 10)
            assert {topic for topic, _ in messages} == {"plant/meter-7"}
        server.stop()
        commit_reads(writer, 10, 20)
        await run_until(delivery, lambda: delivery.status().error is not None)
        server.start()
        async with heard(server, tmp_path) as again:
            await run_until(delivery, lambda: len(currents(again)) == 20)
        assert currents(messages) + currents(again) == WANTED
        assert delivery.status().error is None


async def test_a_topic_for_each_point_and_discovery_by_home_assistant(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.describe_points(
            [PointDescription("meter 7/a", "power+", "kW"), PointDescription("meter 7/a", "on", "", True)]
        )
        group = PointGroup("meter 7/a", ("power+", "on", "text"))
        batch = SampleBatch(group, at(1), 5, (1.5, True, None), (0, 0, Reason.TIMEOUT))
        writer.commit([batch], [], at(1))
        sink = MqttSink(
            "127.0.0.1", server.port, topic="plant/{device}", per_point=True, discovery="homeassistant", retain=True
        )
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().sent == 3)
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: len(messages) >= 5)
    by_topic = dict(messages)
    assert by_topic["plant/meter 7_a/power_"] == {
        "time": at(1),
        "half_width": 5,
        "value": 1.5,
        "quality": "good",
        "reason": "",
    }
    assert by_topic["plant/meter 7_a/text"]["quality"] == "bad"
    entity = by_topic["homeassistant/sensor/meter_7_a/power_/config"]
    assert entity["state_topic"] == "plant/meter 7_a/power_"
    assert entity["unit_of_measurement"] == "kW"
    assert (entity["device_class"], entity["state_class"]) == ("power", "measurement")
    assert "homeassistant/binary_sensor/meter_7_a/on/config" in by_topic


HOUSE = """\
[[unit]]
unit = 1
point = [
    { name = "energy", address = "4x1", type = "uint32", scale = 0.01, unit_of_measure = "kWh" },
    { name = "net", address = "4x1", type = "uint32", unit_of_measure = "Wh", overlaps = true, META },
    { name = "starts", address = "4x3", rollover = true },
    { name = "mode", address = "4x4", enumeration = { off = 0, auto = 1 } },
    { name = "serial", address = "4x5", type = "string:4" },
    { name = "fault", address = "4x90.0" },
]
"""


async def test_home_assistant_is_told_what_the_file_says_of_a_point_also_when_it_is_read_again(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    profile, file = tmp_path / "house.toml", tmp_path / "plant.toml"
    profile.write_text(HOUSE.replace("META", 'meta = { state_class = "total" }'))
    device = busway.Device(holding_registers=20)
    device.write("4x1", 12345, "uint32")
    with mosquitto(tmp_path) as server:
        async with busway.serve("tcp://127.0.0.1:0", units={1: device}) as plant:
            file.write_text(
                f'[collector]\nstore = "data"\npage = "off"\n[poll_class]\nall.period = 0.1\n'
                f'[[link]]\nname = "a"\nurl = "{plant.endpoints[0]}"\n'
                f'[[device]]\nname = "house"\nlink = "a"\nunit = 1\nprofile = "house.toml"\n'
                f'[[sink]]\nname = "home"\nurl = "mqtt://127.0.0.1:{server.port}"\nage = 0.1\n'
                f'per_point = true\ndiscovery = "homeassistant"\n'
            )
            async with busway.collect(file) as collector:
                async with heard(server, tmp_path) as messages:
                    await until(lambda: len(announced(messages)) == 6)
                profile.write_text(HOUSE.replace("META", 'meta = { device_class = "energy_storage" }'))
                await collector.read_again()
                async with heard(server, tmp_path) as again:
                    await until(lambda: announced(again).get("sensor/net", {}).get("device_class") == "energy_storage")
    found = announced(messages)
    classes = {name: (each.get("device_class"), each.get("state_class")) for name, each in found.items()}
    assert classes == {
        "sensor/energy": ("energy", "total_increasing"),
        "sensor/net": ("energy", "total"),
        "sensor/starts": (None, "total_increasing"),
        "sensor/mode": (None, None),
        "sensor/serial": (None, None),
        "binary_sensor/fault": (None, None),  # although the device refuses it: its first sample has no value
    }
    assert found["sensor/energy"]["unit_of_measurement"] == "kWh"
    assert "unit_of_measurement" not in found["sensor/serial"]
    assert announced(again)["sensor/net"]["state_class"] == "measurement"


def announced(messages: list[tuple[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """The entities of the house that Home Assistant was told of last, by component and point."""
    names = {re.fullmatch("homeassistant/(.+)/house/(.+)/config", topic): each for topic, each in messages}
    return {f"{name[1]}/{name[2]}": each for name, each in names.items() if name is not None}


async def test_a_point_that_nothing_describes_is_announced_with_its_first_value(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.describe_points([PointDescription("house", "on", "", True)])
        group = PointGroup("house", ("on",))
        writer.commit([SampleBatch(group, at(1), 5, (None,), Reason.TIMEOUT)], [], at(1))
        sink = MqttSink("127.0.0.1", server.port, per_point=True, discovery="homeassistant")
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().sent == 1)
        writer.commit([SampleBatch(group, at(2), 5, (True,))], [], at(2))
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: delivery.status().sent == 2)
            await until(lambda: len(announced(messages)) > 0)
    assert announced(messages).keys() == {"binary_sensor/on"}


def make_certificates(folder: Path, hosts: list[str]) -> None:
    """Make ``ca.pem`` of an authority, and ``server.pem`` and ``server.key`` of a server of some hosts."""
    from busway.transport.tls.certificates.authority import Authority

    authority = Authority.create(days=2)
    server_files = authority.server(hosts, days=2)
    for name, content in (
        ("ca.pem", authority.issued.certificate_pem()),
        ("server.pem", server_files.certificate_pem()),
        ("server.key", server_files.key_pem()),
    ):
        (folder / name).write_bytes(content)
        (folder / name).chmod(0o644)


def tls_lines(folder: Path) -> list[str]:
    """Lines of a broker's configuration for TLS and one user, and the files that they name."""
    make_certificates(folder, ["127.0.0.1", "localhost"])
    passwords = folder / "passwords"
    subprocess.run(
        [needed("mosquitto_passwd"), "-b", "-c", str(passwords), "collector", "geheim"], check=True, timeout=10
    )
    passwords.chmod(0o644)
    lines = [f"cafile {folder}/ca.pem", f"certfile {folder}/server.pem", f"keyfile {folder}/server.key"]
    lines += [f"password_file {passwords}", "allow_anonymous false", "user root"]
    return lines


LONG = SampleBatch(METER, at(5), 5, ("x" * 900, "y" * 900, "z" * 5000))
"""A read whose third sample is larger than brokers and streams of these tests take, alone too."""


@pytest.mark.parametrize("limit", ["max_packet_size 2500", "message_size_limit 2500"])
async def test_a_broker_gets_what_is_not_too_large_whether_it_has_told_its_limit_or_not(
    tmp_path: Path, limit: str
) -> None:
    pytest.importorskip("aiomqtt")
    with (
        mosquitto(tmp_path, "allow_anonymous true", limit) as server,
        filled(tmp_path / "store", 3) as writer,
    ):
        writer.commit([LONG], [], at(5), [ALARM, replace(ALARM, text="?" * 5000), ACKNOWLEDGED])
        delivery = delivery_to(MqttSink("127.0.0.1", server.port, topic="plant/{device}", timeout=10.0), writer)
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: delivery.status().cursor >= 5)
            await until(lambda: len(alarm_events(messages)) >= 2)
        assert (delivery.status().sent, delivery.status().set_aside) == (11, 2)
    assert alarm_events(messages) == ["raised", "acknowledged"]
    points = {point for _, message in messages for read in message.get("reads", ()) for point in read["values"]}
    assert points == {"voltage", "current", "state"}
    assert "zz" not in str(messages)
    aside = [json.loads(line) for line in (tmp_path / "store" / ASIDE / "sink.jsonl").read_text().splitlines()]
    assert [line.get("point") for line in aside] == ["state", "speed"]


def alarm_events(messages: list[tuple[str, dict[str, Any]]]) -> list[str]:
    """What was heard of alarms, repetitions aside."""
    found = {message["key"]: message["event"] for topic, message in messages if topic.endswith("/alarms")}
    return list(found.values())


async def test_a_broker_that_takes_a_message_and_throws_it_away_is_down_until_it_permits_it(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    rights = tmp_path / "rights"
    rights.write_text("topic read #\ntopic write retained\n")
    rights.chmod(0o644)
    lines = ("allow_anonymous true", f"acl_file {rights}", "user root")
    with mosquitto(tmp_path, *lines) as server, filled(tmp_path / "store", 3) as writer:
        delivery = delivery_to(MqttSink("127.0.0.1", server.port, topic="plant/{device}", timeout=10.0), writer)
        await run_until(delivery, lambda: delivery.status().error is not None)
        assert "Not authorized" in (delivery.status().error or "")
        assert (delivery.status().sent, delivery.status().set_aside) == (0, 0)
        server.stop()
        rights.write_text("topic readwrite #\n")
        server.start()
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: len(currents(messages)) == 3)
        assert delivery.status().sent == 9


# paho-mqtt leaves the socket of a handshake that fails to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore:unclosed:ResourceWarning")
async def test_a_broker_over_tls_with_a_password(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    from busway.apps.collector.sinks.options import tls_context

    lines = tls_lines(tmp_path)
    with (
        mosquitto(tmp_path, *lines) as server,
        filled(tmp_path / "store", 3) as writer,
    ):
        tls = tls_context(authority=str(tmp_path / "ca.pem"))
        wrong = MqttSink("127.0.0.1", server.port, user="collector", password="falsch", tls=tls, timeout=5.0)
        with pytest.raises(SinkDown, match="cannot be reached") as refused:
            await wrong.open()
        assert "falsch" not in str(refused.value)
        with pytest.raises(SinkDown):
            await MqttSink(
                "127.0.0.1", server.port, user="collector", password="geheim", tls=tls_context(), timeout=5.0
            ).open()
        assert [each for each in gc.get_objects() if isinstance(each, ssl.SSLSocket) and each.fileno() >= 0] == []
        sink = MqttSink("127.0.0.1", server.port, user="collector", password="geheim", tls=tls, timeout=5.0)
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().sent == 9)


def made(folder: Path, url: str, **keys: str) -> Any:
    """The sink of a table as a collector file has it, with the authority of `make_certificates`."""
    from busway.apps.collector.sinks.options import make_sink
    from busway.config.files.sinks import SentSection, sink_section

    section = sink_section({"name": "sink", "url": url, "authority": str(folder / "ca.pem"), **keys})
    assert isinstance(section, SentSection)
    return make_sink(section)[0]


def kept_secret(folder: Path, secret: str) -> str:
    """The path of a file with a secret."""
    path = folder / "secret"
    path.write_text(secret)
    path.chmod(0o600)
    return str(path)


@pytest.mark.parametrize("mode", ["require", "verify-ca", "verify-full"])
async def test_a_database_over_tls_is_one_with_a_certificate_for_its_host_by_the_authority(
    tmp_path: Path, mode: str
) -> None:
    pytest.importorskip("asyncpg")
    make_certificates(tmp_path, ["127.0.0.1"])
    files = (tmp_path / "server.pem", tmp_path / "server.key")
    password = kept_secret(tmp_path, PostgresqlServer.PASSWORD)
    asked = "SELECT ssl FROM pg_stat_ssl JOIN pg_stat_activity USING (pid) WHERE pid <> pg_backend_pid()"
    with PostgresqlServer(tls=files) as server, filled(tmp_path / "store", 3) as writer:
        url = f"{server.url}?sslmode={mode}"
        delivery = delivery_to(made(tmp_path, url, password_file=password), writer)
        await run_until(delivery, lambda: delivery.status().sent == 9)
        sink = made(tmp_path, url, password_file=password)
        await sink.open()
        assert await rows_of(server, f"{asked} AND client_port IS NOT NULL") == [(True,)]
        await sink.close()
        with pytest.raises(SinkDown, match="certificate"):
            await made(tmp_path, url.replace("127.0.0.1", "localhost"), password_file=password).open()
        make_certificates(tmp_path, ["127.0.0.1"])  # of another authority
        with pytest.raises(SinkDown, match="certificate"):
            await made(tmp_path, url, password_file=password).open()


async def test_a_database_that_offers_no_tls_gets_nothing_where_the_url_asks_for_it(
    database: PostgresqlServer, tmp_path: Path
) -> None:
    make_certificates(tmp_path, ["127.0.0.1"])
    password = kept_secret(tmp_path, database.PASSWORD)
    for url in (f"{database.url}?sslmode=require", f"{database.url}?sslmode=prefer", database.url):
        with pytest.raises(SinkDown, match="SSL"):
            await made(tmp_path, url, password_file=password).open()


async def test_a_stream_over_tls_with_a_password(tmp_path: Path) -> None:
    pytest.importorskip("nats")
    make_certificates(tmp_path, ["127.0.0.1"])
    lines = [
        f'tls {{ cert_file: "{tmp_path}/server.pem", key_file: "{tmp_path}/server.key" }}',
        'authorization { user: "collector", password: "geheim" }',
    ]
    password = kept_secret(tmp_path, "geheim")
    with nats_server(tmp_path, *lines) as server, filled(tmp_path / "store", 3) as writer:
        url = f"tls://collector@127.0.0.1:{server.port}"
        sink = made(tmp_path, url, password_file=password, stream="PLANT", subject="plant.{device}")
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().sent == 9)
        assert delivery.status().error is None
        for wrong in (url.replace("127.0.0.1", "localhost"), url):
            with pytest.raises(SinkDown, match="certificate"):
                await made(tmp_path, wrong, password_file=password).open()
            make_certificates(tmp_path, ["127.0.0.1"])  # of another authority


async def test_an_influxdb_over_tls(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    make_certificates(tmp_path, ["127.0.0.1"])
    lines = [
        "https-enabled = true",
        f'https-certificate = "{tmp_path}/server.pem"',
        f'https-private-key = "{tmp_path}/server.key"',
    ]
    with influxdb(tmp_path, *lines) as server, filled(tmp_path / "store", 3) as writer:
        url = f"https://127.0.0.1:{server.port}"
        trusted = ssl.create_default_context(cafile=str(tmp_path / "ca.pem"))
        async with httpx.AsyncClient(trust_env=False, verify=trusted) as client:
            await client.post(f"{url}/query", params={"q": "CREATE DATABASE plant"})
        delivery = delivery_to(made(tmp_path, f"influxdb+{url}/write?db=plant"), writer)
        await run_until(delivery, lambda: delivery.status().sent == 9)
        make_certificates(tmp_path, ["127.0.0.1"])  # of another authority
        commit_reads(writer, 3, 1)
        refusing = delivery_to(made(tmp_path, f"influxdb+{url}/write?db=plant"), writer, name="refusing")
        await run_until(refusing, lambda: refusing.status().error is not None)
        assert "certificate" in (refusing.status().error or "").lower()
        assert refusing.status().sent == 0


@pytest.fixture(scope="module")
def database() -> Iterator[PostgresqlServer]:
    pytest.importorskip("asyncpg")
    with PostgresqlServer() as server:
        yield server


async def executed(server: PostgresqlServer, statement: str) -> None:
    import asyncpg

    connection = await asyncpg.connect(server.url, password=server.PASSWORD)
    try:
        await connection.execute(statement)
    finally:
        await connection.close()


async def rows_of(server: PostgresqlServer, query: str) -> list[Any]:
    import asyncpg

    connection = await asyncpg.connect(server.url, password=server.PASSWORD)
    try:
        return [tuple(row) for row in await connection.fetch(query)]
    finally:
        await connection.close()


async def test_a_database_that_was_down_has_everything_once(database: PostgresqlServer, tmp_path: Path) -> None:
    with filled(tmp_path, 10) as writer:
        sink = PostgresqlSink(database.url, password=database.PASSWORD, table="outage", timeout=5.0)
        delivery = delivery_to(sink, writer, QUICK)
        await run_until(delivery, lambda: delivery.status().sent == 30)
        database.stop()
        commit_reads(writer, 10, 20)
        await run_until(delivery, lambda: delivery.status().error is not None)
        database.start()
        await run_until(delivery, lambda: delivery.status().sent >= 90, 60)
        writer.manifest.set_cursor("sink", 0, 0)
        again = delivery_to(PostgresqlSink(database.url, password=database.PASSWORD, table="outage"), writer)
        await run_until(again, lambda: again.status().sent == 90)
    rows = await rows_of(database, "SELECT value FROM outage WHERE point = 'current' ORDER BY time")
    assert [row[0] for row in rows] == WANTED
    assert await rows_of(database, "SELECT count(*) FROM outage") == [(90,)]


async def test_a_database_gets_every_kind_of_value_and_poison_is_set_aside(
    database: PostgresqlServer, tmp_path: Path
) -> None:
    group = PointGroup("d", ("float", "int", "large", "text", "bool", "bad", "zero byte"))
    values = (1.5, 7, 2**64 - 1, "ä", True, None, "a\x00b")
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([SampleBatch(group, at(1) + 7, 5, values, (0, 0, 0, 0, 0, 256 + 2, 0))], [], at(1))
        delivery = delivery_to(PostgresqlSink(database.url, password=database.PASSWORD, table="kinds"), writer)
        await run_until(delivery, lambda: delivery.status().sent + delivery.status().set_aside == 7)
        assert delivery.status().set_aside == 1
    rows = {
        row[0]: row[1:] for row in await rows_of(database, "SELECT point, value, text, reason, nanoseconds FROM kinds")
    }
    assert rows == {
        "float": (1.5, None, 0, 7),
        "int": (7.0, None, 0, 7),
        "large": (float(2**64 - 1), str(2**64 - 1), 0, 7),
        "text": (None, "ä", 0, 7),
        "bool": (1.0, None, 0, 7),
        "bad": (None, None, 258, 7),
    }


async def test_of_samples_of_one_time_in_one_batch_a_database_has_the_one_that_was_committed_last(
    database: PostgresqlServer,
) -> None:
    def sample(commit: int, point: str, time: int, value: int) -> CommittedSample:
        return CommittedSample(commit, "d", point, time, 5, value, 0)

    points = [f"p{number}" for number in range(40)]
    batch = [sample(commit, point, at(1), 10 * commit) for commit in (1, 2, 3, 4) for point in points]
    batch += [sample(5, "finer", at(1) + 7, 1), sample(6, "finer", at(1) + 3, 2)]
    sink = PostgresqlSink(database.url, password=database.PASSWORD, table="equal_times")
    await sink.open()
    try:
        await sink.send(batch)
    finally:
        await sink.close()
    rows = await rows_of(database, "SELECT point, value FROM equal_times")
    assert dict(rows) == {**dict.fromkeys(points, 40.0), "finer": 1.0}


async def test_a_database_refuses_values_by_type_range_constraint_and_trigger_and_waits_for_a_column(
    database: PostgresqlServer, tmp_path: Path
) -> None:
    group = PointGroup("d", ("ok", "wide", "odd", "forbidden", "null"))
    made = """
        CREATE TABLE strict (
            time timestamptz, device text, point text, value real, text varchar(3), reason smallint, half_width bigint,
            PRIMARY KEY (device, point, time), CHECK (value <> 13)
        );
        CREATE FUNCTION judge() RETURNS trigger LANGUAGE plpgsql AS
            'BEGIN IF new.text = ''no'' THEN RAISE EXCEPTION ''not that''; END IF; RETURN new; END';
        CREATE TRIGGER judge BEFORE INSERT ON strict FOR EACH ROW EXECUTE FUNCTION judge();
    """
    await executed(database, made)
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([SampleBatch(group, at(1), 5, (1.5, "text", 1e300, "no", None), (0, 0, 0, 0, 16))], [], at(1))
        writer.commit([SampleBatch(group, at(2), 5, (2.5, "abc", 13.0, "yes", None), (0, 0, 0, 0, 16))], [], at(2))
        sink = PostgresqlSink(database.url, password=database.PASSWORD, table="strict")
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().error is not None)
        assert 'column "nanoseconds" of relation "strict" does not exist' in (delivery.status().error or "")
        assert delivery.status().set_aside == 0
        await executed(database, "ALTER TABLE strict ADD COLUMN nanoseconds smallint")
        await run_until(delivery, lambda: delivery.status().cursor >= 3)
        aside = [json.loads(line) for line in (tmp_path / ASIDE / "sink.jsonl").read_text().splitlines()]
        assert (delivery.status().sent, delivery.status().set_aside) == (6, 4)
    assert [(line["point"], line["value"]) for line in aside] == [
        *(("wide", "text"), ("odd", 1e300), ("forbidden", "no"), ("odd", 13.0)),
    ]
    found = await rows_of(database, "SELECT point, value, text FROM strict WHERE reason = 0 ORDER BY time, point")
    assert found == [("ok", 1.5, None), ("forbidden", None, "yes"), ("ok", 2.5, None), ("wide", None, "abc")]


async def test_a_database_has_each_event_of_an_alarm_once_in_a_table_of_its_own(
    database: PostgresqlServer, tmp_path: Path
) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 90.0)], [], at(1), [ALARM, replace(ALARM, limit="HH")])
        writer.commit([], [], at(2), [ACKNOWLEDGED])
        for _ in range(2):
            sink = PostgresqlSink(database.url, password=database.PASSWORD, table="with_alarms", alarm_table="events")
            delivery = delivery_to(sink, writer)
            await run_until(delivery, lambda delivery=delivery: delivery.status().cursor >= 3)  # type: ignore[misc]
            assert (delivery.status().sent, delivery.status().error) == (1, None)
            writer.manifest.set_cursor("sink", 0, 0)
    asked = "SELECT kind, event, value, text, by, commit_number, place FROM events ORDER BY commit_number, place"
    assert await rows_of(database, asked) == [
        ("H", "raised", 90.0, "above 80 rpm", "", 2, 0),
        ("HH", "raised", 90.0, "above 80 rpm", "", 2, 1),
        ("H", "acknowledged", None, "above 80 rpm", "anna", 3, 0),
    ]


@pytest.mark.soak
async def test_a_hypertable_of_timescaledb_has_every_sample_and_event_once(tmp_path: Path) -> None:
    if "BUSWAY_POSTGRESQL" not in os.environ:
        pytest.skip("BUSWAY_POSTGRESQL names no programs of a PostgreSQL with TimescaleDB")
    week = 7 * 86_400
    with PostgresqlServer(library="timescaledb") as server, filled(tmp_path, 10) as writer:
        await executed(server, "CREATE EXTENSION timescaledb")
        writer.commit([read_of(METER, 2 * week, 1, 2, 3)], [], at(2 * week), [ALARM, ACKNOWLEDGED])
        for start in range(2):  # the second finds the tables, and sends everything again
            sink = PostgresqlSink(server.url, password=server.PASSWORD, timescale=True)
            delivery = delivery_to(sink, writer, DeliveryOptions(age=0, most=20, keep=1e9))
            await run_until(delivery, lambda d=delivery: d.status().sent == 33 and d.status().cursor)  # type: ignore[misc]
            assert (delivery.status().set_aside, delivery.status().error) == (0, None), start
            writer.manifest.set_cursor("sink", 0, 0)
        assert await rows_of(server, "SELECT count(*) FROM samples") == [(33,)]
        assert await rows_of(server, "SELECT count(*) FROM alarms") == [(2,)]
        asked = "SELECT hypertable_name, num_chunks FROM timescaledb_information.hypertables ORDER BY 1"
        assert await rows_of(server, asked) == [("alarms", 1), ("samples", 2)]


async def test_a_wrong_password_is_told_without_the_password(database: PostgresqlServer) -> None:
    sink = PostgresqlSink(database.url, password="falsches-wort")
    with pytest.raises(SinkDown, match="password authentication failed") as refused:
        await sink.open()
    assert "falsches-wort" not in str(refused.value)


async def test_a_stream_that_was_down_has_everything_once_and_in_order(tmp_path: Path) -> None:
    nats = pytest.importorskip("nats")
    with nats_server(tmp_path) as server, filled(tmp_path / "store", 10) as writer:
        url = f"nats://127.0.0.1:{server.port}"
        delivery = delivery_to(NatsSink(url, subject="plant.{device}", stream="PLANT", timeout=2.0), writer, QUICK)
        await run_until(delivery, lambda: delivery.status().sent == 30)
        server.stop()
        commit_reads(writer, 10, 20)
        await run_until(delivery, lambda: delivery.status().error is not None)
        server.start()
        await run_until(delivery, lambda: delivery.status().sent >= 90, 60)
        writer.manifest.set_cursor("sink", 0, 0)  # as if the cursor had not been written: the server knows them
        again = delivery_to(NatsSink(url, subject="plant.{device}", timeout=2.0), writer, QUICK)
        await run_until(again, lambda: again.status().sent == 90)
        client = await nats.connect(url)
        subscription = await client.jetstream().pull_subscribe("plant.>", "checker")
        found = defaultdict(list)
        for message in await subscription.fetch(READS, timeout=10):
            for read in json.loads(message.data)["reads"]:
                found[message.subject].append(read["values"]["current"])
        state = (await client.jetstream().stream_info("PLANT")).state
        await client.close()
    assert found == {"plant.meter-7": WANTED}
    assert state.messages == READS


@pytest.mark.parametrize("limits", [("max_payload: 2500", None), ("max_payload: 1000000", 2500)])
async def test_a_stream_gets_what_is_not_too_large_for_the_server_or_for_it(
    tmp_path: Path, limits: tuple[str, int | None]
) -> None:
    nats = pytest.importorskip("nats")
    of_server, of_stream = limits
    with nats_server(tmp_path, of_server) as server, filled(tmp_path / "store", 3) as writer:
        url = f"nats://127.0.0.1:{server.port}"
        client = await nats.connect(url)
        await client.jetstream().add_stream(name="PLANT", subjects=["plant.*"], max_msg_size=of_stream)
        writer.commit([LONG], [], at(5), [ALARM, replace(ALARM, text="?" * 5000), ACKNOWLEDGED])
        delivery = delivery_to(NatsSink(url, subject="plant.{device}", timeout=10.0), writer)
        await run_until(delivery, lambda: delivery.status().cursor >= 5)
        assert (delivery.status().sent, delivery.status().set_aside) == (11, 2)
        subscription = await client.jetstream().pull_subscribe("plant.meter-7", "checker")
        found: set[int] = set()
        while len(found) < 11:
            for message in await subscription.fetch(1, timeout=10):
                reads = json.loads(message.data)["reads"]
                found |= {hash((read["time"], point)) for read in reads for point in read["values"]}
        assert (await client.jetstream().get_last_msg("PLANT", "plant.alarms")).data.count(b"acknowledged") == 1
        await client.close()


async def test_an_influxdb_that_was_down_has_everything_once_with_awkward_names_and_texts(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    from busway.apps.collector.sinks.influxdb import InfluxSink

    async def asked(statement: str) -> list[list[Any]]:
        async with httpx.AsyncClient(trust_env=False) as client:
            query = {"db": "plant", "q": statement, "epoch": "ns"}
            (found,) = (await client.post(f"{url}/query", params=query)).json()["results"]
        return [row for series in found.get("series", ()) for row in series["values"]]

    odd = PointGroup("m,e=t er", ('p"o,i=n t', "text"))
    with influxdb(tmp_path) as server, filled(tmp_path / "store", 10) as writer:
        url = f"http://127.0.0.1:{server.port}"
        await asked("CREATE DATABASE plant")
        delivery = delivery_to(InfluxSink(f"{url}/write?db=plant", timeout=2.0), writer, QUICK)
        await run_until(delivery, lambda: delivery.status().sent == 30)
        server.stop()
        commit_reads(writer, 10, 20)
        writer.commit([read_of(odd, 30, float("nan"), 'a "b" \\\n, c=ä', reasons=(0, 0))], [], at(30))
        writer.commit([read_of(odd, 31, None, None, reasons=Reason.TIMEOUT)], [], at(31), [ALARM, ACKNOWLEDGED])
        await run_until(delivery, lambda: delivery.status().error is not None)
        server.start()
        await run_until(delivery, lambda: delivery.status().sent >= 94, 60)
        writer.manifest.set_cursor("sink", 0, 0)  # as if the cursor had not been written
        again = delivery_to(InfluxSink(f"{url}/write?db=plant", timeout=2.0), writer, QUICK)
        await run_until(again, lambda: again.status().sent == 94)
        currents_there = await asked("SELECT value FROM samples WHERE device = 'meter-7' AND point = 'current'")
        events = await asked('SELECT event, "limit", value, text, "by", "commit", place FROM alarms')
        odd_there = await asked("SELECT device, point, text, value, reason FROM samples WHERE device = 'm,e=t er'")
    assert events == [
        [at(1), "raised", "H", 90, "above 80 rpm", "", 33, 0],
        [at(2), "acknowledged", "H", None, "above 80 rpm", "anna", 33, 1],
    ]
    assert [value for _, value in currents_there] == WANTED
    assert [time for time, _ in currents_there] == [at(number) for number in range(READS)]
    assert sorted(odd_there, key=str) == sorted(
        [
            [at(30), "m,e=t er", 'p"o,i=n t', None, None, 0],
            [at(30), "m,e=t er", "text", 'a "b" \\\\n, c=ä', None, 0],  # a line break as \\n
            [at(31), "m,e=t er", 'p"o,i=n t', None, None, Reason.TIMEOUT],
            [at(31), "m,e=t er", "text", None, None, Reason.TIMEOUT],
        ],
        key=str,
    )


async def test_an_influxdb_whose_field_has_another_type_refuses_those_samples_alone(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    from busway.apps.collector.sinks.influxdb import InfluxSink

    with influxdb(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        url = f"http://127.0.0.1:{server.port}"
        async with httpx.AsyncClient(trust_env=False, base_url=url) as client:
            await client.post("/query", params={"q": "CREATE DATABASE plant"})
            line = f"samples,device=x,point=y text=5i {at(0)}"
            assert (await client.post("/write", params={"db": "plant"}, content=line)).status_code == 204
        writer.commit([read_of(METER, 1, 230.0, 1, "on"), read_of(PUMP, 1, 3)], [], at(1))
        writer.commit([read_of(METER, 2, 231.0, 2, "off"), read_of(PUMP, 2, 4)], [], at(2))
        delivery = delivery_to(InfluxSink(f"{url}/write?db=plant", timeout=5.0), writer)
        await run_until(delivery, lambda: delivery.status().cursor >= 3)
        assert (delivery.status().sent, delivery.status().set_aside) == (6, 2)
        assert "field type conflict" in (delivery.status().error or "")


async def test_victoriametrics_takes_the_same_lines(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    from busway.apps.collector.sinks.influxdb import InfluxSink

    today = (time.time_ns() - NOON) // 10**9  # it takes no samples of the future, where those of the tests are
    with victoria_metrics(tmp_path) as server, StoreWriter(tmp_path / "store", now=at(today)) as writer:
        commit_reads(writer, today - 10, 10)
        url = f"http://127.0.0.1:{server.port}"
        delivery = Delivery("sink", InfluxSink(f"{url}/write", timeout=5.0), writer.folder, writer.manifest, QUICK)
        await run_until(delivery, lambda: delivery.status().sent == 30)
        event = CommittedAlarm(7, 3, replace(ALARM, at=at(today - 5)))
        sink = InfluxSink(f"{url}/write", timeout=5.0)
        await sink.open()
        await sink.send_alarms([event])
        await sink.close()
        async with httpx.AsyncClient(trust_env=False, base_url=url) as client:
            await client.get("/internal/force_flush")
            alarms = {"match[]": 'alarms_commit{device="pump-1",point="speed",limit="H",event="raised"}'}
            (commits,) = map(json.loads, (await client.get("/api/v1/export", params=alarms)).text.splitlines())
            asked = {"match[]": 'samples_value{device="meter-7",point="current"}'}
            (series,) = map(json.loads, (await client.get("/api/v1/export", params=asked)).text.splitlines())
    assert (commits["values"], commits["timestamps"]) == ([7], [at(today - 5) // 1_000_000])
    assert series["values"] == [today - 10 + number for number in range(10)]
    assert series["timestamps"] == [at(today - 10 + number) // 1_000_000 for number in range(10)]


def test_the_pump_is_another_device() -> None:
    assert read_of(PUMP, 0, 1).device == "pump-1"


async def test_events_of_alarms_go_to_a_topic_of_their_own(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 90.0)], [], at(1), [ALARM])
        delivery = delivery_to(MqttSink("127.0.0.1", server.port, topic="plant/{device}", timeout=2.0), writer)
        async with heard(server, tmp_path) as messages:
            await run_until(delivery, lambda: len(messages) >= 2)
    assert [topic for topic, _ in messages] == ["plant/pump-1", "plant/alarms"]
    assert (messages[1][1]["event"], messages[1][1]["limit"], messages[1][1]["value"]) == ("raised", "H", 90.0)


@pytest.mark.parametrize("subject", ["busway.{device}", "plant.{device}.samples"])
async def test_events_of_alarms_go_to_a_subject_that_the_stream_has(tmp_path: Path, subject: str) -> None:
    nats = pytest.importorskip("nats")
    with nats_server(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 90.0)], [], at(1), [ALARM])
        url = f"nats://127.0.0.1:{server.port}"
        delivery = delivery_to(NatsSink(url, subject=subject, stream="plant"), writer)
        await run_until(delivery, lambda: delivery.status().cursor >= 2)
        assert delivery.status().set_aside == 0
        client = await nats.connect(url)
        stream = await client.jetstream().stream_info("plant")
        assert stream.state.messages == 2
        message = await client.jetstream().get_last_msg("plant", f"{subject.partition('.')[0]}.alarms")
        assert json.loads(message.data)["text"] == "above 80 rpm"
        await client.close()
