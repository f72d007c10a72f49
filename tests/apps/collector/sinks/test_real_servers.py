"""Sinks against the servers they are for: one that is down for a while gets everything when it is back, in order."""

import asyncio
import contextlib
import json
import subprocess
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from collected import NOON, PUMP, at, filled, read_of
from deliveries import commit_reads, delivery_to, run_until
from foreign_servers import ForeignServer, PostgresqlServer, influxdb, mosquitto, nats_server, needed, victoria_metrics

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointDescription, PointGroup, Reason, SampleBatch
from busway.apps.collector.sinks.delivery import Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown
from busway.apps.collector.sinks.mqtt import MqttSink
from busway.apps.collector.sinks.nats import NatsSink
from busway.apps.collector.sinks.postgresql import PostgresqlSink
from busway.apps.collector.store.writer import StoreWriter

READS = 30
WANTED = [float(number) for number in range(READS)]
QUICK = DeliveryOptions(age=0, most=20)
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
        async with asyncio.timeout(20):
            await subscribed.wait()
        yield messages
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
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
            await run_until(delivery, lambda: len(messages) >= 6)
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
    assert "homeassistant/binary_sensor/meter_7_a/on/config" in by_topic


def tls_lines(folder: Path) -> list[str]:
    """Lines of a broker's configuration for TLS and one user, and the files that they name."""
    from busway.transport.tls.certificates.authority import Authority

    authority = Authority.create(days=2)
    server_files = authority.server(["127.0.0.1", "localhost"], days=2)
    for name, content in (
        ("ca.pem", authority.issued.certificate_pem()),
        ("server.pem", server_files.certificate_pem()),
        ("server.key", server_files.key_pem()),
    ):
        (folder / name).write_bytes(content)
        (folder / name).chmod(0o644)
    passwords = folder / "passwords"
    subprocess.run(
        [needed("mosquitto_passwd"), "-b", "-c", str(passwords), "collector", "geheim"], check=True, timeout=10
    )
    passwords.chmod(0o644)
    lines = [f"cafile {folder}/ca.pem", f"certfile {folder}/server.pem", f"keyfile {folder}/server.key"]
    lines += [f"password_file {passwords}", "allow_anonymous false", "user root"]
    return lines


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
        sink = MqttSink("127.0.0.1", server.port, user="collector", password="geheim", tls=tls, timeout=5.0)
        delivery = delivery_to(sink, writer)
        await run_until(delivery, lambda: delivery.status().sent == 9)


@pytest.fixture(scope="module")
def database() -> Iterator[PostgresqlServer]:
    pytest.importorskip("asyncpg")
    with PostgresqlServer() as server:
        yield server


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
        writer.commit([read_of(odd, 31, None, None, reasons=Reason.TIMEOUT)], [], at(31))
        await run_until(delivery, lambda: delivery.status().error is not None)
        server.start()
        await run_until(delivery, lambda: delivery.status().sent >= 94, 60)
        writer.manifest.set_cursor("sink", 0, 0)  # as if the cursor had not been written
        again = delivery_to(InfluxSink(f"{url}/write?db=plant", timeout=2.0), writer, QUICK)
        await run_until(again, lambda: again.status().sent == 94)
        currents_there = await asked("SELECT value FROM samples WHERE device = 'meter-7' AND point = 'current'")
        odd_there = await asked("SELECT device, point, text, value, reason FROM samples WHERE device = 'm,e=t er'")
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


async def test_victoriametrics_takes_the_same_lines(tmp_path: Path) -> None:
    httpx = pytest.importorskip("httpx")
    from busway.apps.collector.sinks.influxdb import InfluxSink

    today = (time.time_ns() - NOON) // 10**9  # it takes no samples of the future, where those of the tests are
    with victoria_metrics(tmp_path) as server, StoreWriter(tmp_path / "store", now=at(today)) as writer:
        commit_reads(writer, today - 10, 10)
        url = f"http://127.0.0.1:{server.port}"
        delivery = Delivery("sink", InfluxSink(f"{url}/write", timeout=5.0), writer.folder, writer.manifest, QUICK)
        await run_until(delivery, lambda: delivery.status().sent == 30)
        async with httpx.AsyncClient(trust_env=False, base_url=url) as client:
            await client.get("/internal/force_flush")
            asked = {"match[]": 'samples_value{device="meter-7",point="current"}'}
            (series,) = map(json.loads, (await client.get("/api/v1/export", params=asked)).text.splitlines())
    assert series["values"] == [today - 10 + number for number in range(10)]
    assert series["timestamps"] == [at(today - 10 + number) // 1_000_000 for number in range(10)]


def test_the_pump_is_another_device() -> None:
    assert read_of(PUMP, 0, 1).device == "pump-1"


ALARM = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(1), 90.0, "", True, "above 80 rpm")


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
