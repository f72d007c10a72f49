"""The edge node of a collector as a host application sees it that is not ours: pysparkplug, over mosquitto."""

import asyncio
import json
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from collected import NOON, at, read_of
from commanded_plant import RecordedDevice, commanded_plant
from deliveries import delivery_to, run_until
from foreign import PEER_PYTHON, PEERS, missing
from foreign_servers import ForeignServer, mosquitto
from waiting import until

import busway
from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointDescription, PointGroup, Reason
from busway.apps.collector.sinks.delivery import DeliveryOptions
from busway.apps.collector.store.writer import StoreWriter

pytestmark = pytest.mark.interop
pytest.importorskip("aiomqtt")
pytest.importorskip("google.protobuf")
HOST = PEERS / "sparkplug_host.py"
METER = PointGroup("meter-7", ("voltage", "count", "on", "name"))
QUICK = DeliveryOptions(age=0, most=20)


@asynccontextmanager
async def host(server: ForeignServer, *options: str) -> AsyncIterator[tuple[list[dict[str, Any]], Any]]:
    """What the host application hears, one message each, and the program."""
    if not PEER_PYTHON.exists():
        missing("no .peers: run make peers")
    heard: list[dict[str, Any]] = []
    process = await asyncio.create_subprocess_exec(
        PEER_PYTHON, HOST, str(server.port), *options, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )

    async def collect() -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            heard.append(json.loads(line))

    task = asyncio.create_task(collect())
    try:
        await until(lambda: bool(heard))  # it says that it has subscribed
        yield heard, process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        await asyncio.wait_for(process.wait(), 60)
        await task


def of_kind(heard: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [message for message in heard if message["kind"] == kind]


def values(message: dict[str, Any]) -> dict[str, Any]:
    return {metric["name"]: metric["value"] for metric in message["metrics"]}


async def test_births_data_and_deaths_are_what_a_foreign_host_understands(tmp_path: Path) -> None:
    from busway.apps.collector.sinks.sparkplug import SparkplugSink

    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.describe_points([PointDescription("meter-7", "voltage", "V")])
        writer.commit([read_of(METER, 1, 230.5, -3, True, "ä")], [], at(1))
        sink = SparkplugSink("127.0.0.1", server.port, group="plant", edge_node="hall", now=lambda: at(2))
        delivery = delivery_to(sink, writer, QUICK)
        async with host(server) as (heard, _):
            await run_until(delivery, lambda: len(of_kind(heard, "DDATA")) == 1)
            writer.commit([read_of(METER, 3, None, 2**63, False, "b", reasons=(Reason.TIMEOUT, 0, 0, 0))], [], at(3))
            writer.commit([read_of(METER, 4, *[None] * 4, reasons=(Reason.SUSPENDED,) * 4)], [], at(4))
            await run_until(delivery, lambda: len(of_kind(heard, "DDEATH")) == 1)
            await until(lambda: len(of_kind(heard, "NDEATH")) == 2)
    kinds = [message["kind"] for message in heard[1:]]
    assert kinds == [
        *("NBIRTH", "DBIRTH", "DDATA", "NDEATH"),
        *("NBIRTH", "DBIRTH", "DBIRTH", "DDATA", "DDEATH", "NDEATH"),
    ]
    assert [message["seq"] for message in heard[1:]] == [0, 1, 2, None, 0, 1, 2, 3, 4, None]
    births, deaths = of_kind(heard, "NBIRTH"), of_kind(heard, "NDEATH")
    assert [values(message)["bdSeq"] for message in births] == [values(message)["bdSeq"] for message in deaths]
    assert [values(message)["bdSeq"] for message in births] == [1, 2]
    first, late = of_kind(heard, "DDATA")
    assert values(first) == {"voltage": 230.5, "count": -3, "on": True, "name": "ä"}
    assert [metric["historical"] for metric in first["metrics"]] == [True] * 4, "older than the birth at 2 s"
    assert values(late) == {"voltage": None, "count": 2**63, "on": False, "name": "b"}
    assert [metric["historical"] for metric in late["metrics"]] == [False] * 4
    assert {metric["name"]: metric["type"] for metric in late["metrics"]} == {
        "voltage": "DOUBLE",
        "count": "UINT64",
        "on": "BOOLEAN",
        "name": "STRING",
    }


async def test_events_of_alarms_are_a_metric_of_the_node_and_what_is_too_large_is_set_aside(tmp_path: Path) -> None:
    from busway.apps.collector.sinks.sparkplug import ALARM_METRIC, SparkplugSink

    lines = ("allow_anonymous true", "max_packet_size 3000")
    with mosquitto(tmp_path, *lines) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, at(1), 250.0, "", True, "above 240 V")
        writer.commit([read_of(METER, 1, 250.0, 3, True, "a")], [], at(1), [raised, replace(raised, text="?" * 5000)])
        writer.commit([read_of(PointGroup("other", ("large", "small")), 2, "z" * 5000, 1)], [], at(2))
        sink = SparkplugSink("127.0.0.1", server.port, group="plant", edge_node="hall", now=lambda: at(2))
        delivery = delivery_to(sink, writer, QUICK)
        async with host(server) as (heard, _):
            await run_until(delivery, lambda: delivery.status().cursor >= 3)
            await until(lambda: bool(of_kind(heard, "NDEATH")))
        assert (delivery.status().sent, delivery.status().set_aside) == (5, 2)
    assert values(of_kind(heard, "NBIRTH")[0])[ALARM_METRIC] is None
    (metric,) = of_kind(heard, "NDATA")[0]["metrics"]
    assert (metric["name"], metric["historical"]) == (ALARM_METRIC, True)
    assert json.loads(metric["value"])["text"] == "above 240 V"
    assert {metric["name"]: metric["value"] for metric in of_kind(heard, "DDATA")[-1]["metrics"]} == {"small": 1}
    assert [message["seq"] for message in heard[1:-1]] == list(range(len(heard) - 2)), "none was lost"


async def test_a_host_asks_for_the_births_again_and_gets_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from busway.apps.collector.sinks import sparkplug

    monkeypatch.setattr(sparkplug, "REBIRTH_PAUSE", 0.2)
    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.commit([read_of(METER, 1, 230.5, 3, True, "a")], [], at(1))
        sink = sparkplug.SparkplugSink("127.0.0.1", server.port, group="plant", edge_node="hall")
        delivery = delivery_to(sink, writer, QUICK)
        async with host(server) as (heard, process):
            asked = False

            def done() -> bool:
                nonlocal asked
                if not asked and of_kind(heard, "DDATA"):
                    asked = True
                    process.stdin.write(b"rebirth\n" * 5)
                return len(of_kind(heard, "NBIRTH")) >= 2 and len(of_kind(heard, "DBIRTH")) >= 2

            await run_until(delivery, done)
    kinds = [message["kind"] for message in heard[1:]]
    assert kinds[:5] == ["NBIRTH", "DBIRTH", "DDATA", "NBIRTH", "DBIRTH"]
    again = of_kind(heard, "NBIRTH")[1]
    assert (again["seq"], values(again)["bdSeq"]) == (0, 1), "the same connection"
    assert len(of_kind(heard, "NBIRTH")) == 2, "five requests at once are one rebirth"


COMMANDED = """
[[sink]]
name = "scada"
url = "sparkplug+mqtt://127.0.0.1:{port}"
group = "plant"
edge_node = "hall"
age = 0.05
{commands}
"""


async def test_a_host_writes_points_that_the_file_names_and_sees_what_the_device_shows(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    commands = 'commands = { points = ["boiler/setpoint", "boiler/mode", "boiler/level"], seconds = 30 }'
    with mosquitto(tmp_path) as server:
        more = COMMANDED.format(port=server.port, commands=commands)
        async with (
            boiler.server() as device,
            host(server) as (heard, process),
            busway.collect(commanded_plant(tmp_path, device.endpoints[0], more=more)) as collector,
        ):

            def write(metric: str, kind: str, value: object, **more: object) -> None:
                asked = {"device": "boiler", "metric": metric, "type": kind, "value": value, **more}
                process.stdin.write(json.dumps(asked).encode() + b"\n")

            def shown(metric: str) -> list[object]:
                data = [values(message) for message in of_kind(heard, "DDATA")]
                return [each[metric] for each in data if metric in each]

            await until(lambda: bool(shown("setpoint")) and collector.input_statuses()[0].error is None, 30)
            write("setpoint", "DOUBLE", 21.5)
            await until(lambda: shown("setpoint")[-1] == 21.5, 30)
            write("setpoint", "FLOAT", 22.0, bare=True)
            await until(lambda: shown("setpoint")[-1] == 22.0, 30)
            write("mode", "STRING", "hand")
            await until(lambda: len(boiler.writes) == 3, 30)
            write("mode", "INT64", 1, bare=True)
            await until(lambda: len(boiler.writes) == 4, 30)
            for refused in (
                {"metric": "setpoint", "kind": "DOUBLE", "value": 101.0},
                {"metric": "setpoint", "kind": "DOUBLE", "value": 1.0, "age": 60},
                {"metric": "setpoint", "kind": "DOUBLE", "value": 2.0, "retain": True},
                {"metric": "level", "kind": "INT64", "value": 3},
                {"metric": "pump", "kind": "BOOLEAN", "value": True},
                {"metric": "setpoint", "kind": "DOUBLE", "value": 4.0, "device": "other"},
            ):
                write(**refused)  # type: ignore[arg-type]
            write("setpoint", "DOUBLE", 30.0)
            await until(lambda: shown("setpoint")[-1] == 30.0, 30)
            assert [items for _, _, items in boiler.writes] == [[215], [220], [2], [1], [300]]
            recorded = await collector.commands.newest(20)
            assert {each.command.origin for each in recorded} == {"sparkplug"}
            assert sorted(each.state.value for each in recorded) == ["done"] * 5 + ["expired", "refused"]
            (status,) = collector.input_statuses()
            assert (status.name, status.taken, status.refused) == ("scada", 10, 3)


async def test_a_host_writes_nothing_where_the_file_permits_nothing(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    with mosquitto(tmp_path) as server:
        more = COMMANDED.format(port=server.port, commands="")
        async with (
            boiler.server() as device,
            host(server) as (heard, process),
            busway.collect(commanded_plant(tmp_path, device.endpoints[0], more=more)) as collector,
        ):
            await until(lambda: bool(of_kind(heard, "DDATA")), 30)
            asked = {"device": "boiler", "metric": "setpoint", "type": "DOUBLE", "value": 21.5}
            process.stdin.write(json.dumps(asked).encode() + b"\nrebirth\n")
            await until(lambda: len(of_kind(heard, "NBIRTH")) == 2, 30)  # it has come behind the command
            assert (boiler.writes, await collector.commands.newest(9)) == ([], [])


async def test_without_its_primary_host_samples_wait_and_arrive_when_it_is_there(tmp_path: Path) -> None:
    from busway.apps.collector.sinks.sparkplug import SparkplugSink

    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.commit([read_of(METER, 1, 230.5, 3, True, "a")], [], at(1))
        options = {"group": "plant", "edge_node": "hall", "primary_host": "scada"}
        sink = SparkplugSink("127.0.0.1", server.port, **options, timeout=0.3)
        delivery = delivery_to(sink, writer, QUICK)
        async with host(server) as (heard, _):
            await run_until(delivery, lambda: "scada is not online" in (delivery.status().error or ""))
            assert [message["kind"] for message in heard[1:]] == [], "nothing was born"
            async with host(server, "scada"):
                await run_until(delivery, lambda: len(of_kind(heard, "DDATA")) == 1)
                assert delivery.status().cursor > 0
                writer.commit([read_of(METER, 5, 1.0, 3, True, "a")], [], at(5))
            await run_until(delivery, lambda: "scada" in (delivery.status().error or ""))
            assert len(of_kind(heard, "DDATA")) == 1
            async with host(server, "scada"):
                await run_until(delivery, lambda: len(of_kind(heard, "DDATA")) == 2)


async def test_a_broker_that_was_down_gets_everything_and_connections_are_numbered_on(tmp_path: Path) -> None:
    from busway.apps.collector.sinks.sparkplug import SparkplugSink

    numbers = tmp_path / "numbers.json"
    numbers.write_text('{"bdSeq": 254}')
    with mosquitto(tmp_path) as server, StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.commit([read_of(METER, 1, 1.0, 1, True, "a")], [], at(1))
        options = {"group": "plant", "edge_node": "hall", "number_file": numbers, "timeout": 2.0}
        delivery = delivery_to(SparkplugSink("127.0.0.1", server.port, **options), writer, QUICK)
        async with host(server) as (heard, _):
            await run_until(delivery, lambda: len(of_kind(heard, "DDATA")) == 1)
        server.stop()
        for number in range(2, 8):
            writer.commit([read_of(METER, number, float(number), number, True, "a")], [], at(number))
        await run_until(delivery, lambda: delivery.status().error is not None)
        server.start()
        delivery = delivery_to(SparkplugSink("127.0.0.1", server.port, **options), writer, QUICK)
        async with host(server) as (again, _):
            found: list[int] = []

            def done() -> bool:
                found[:] = [
                    metric["value"]
                    for message in of_kind(again, "DDATA")
                    for metric in message["metrics"]
                    if metric["name"] == "count"
                ]
                return len(found) >= 6

            await run_until(delivery, done)
    assert found == [2, 3, 4, 5, 6, 7]
    assert [values(message)["bdSeq"] for message in of_kind(heard, "NBIRTH")] == [255]
    assert json.loads(numbers.read_text())["bdSeq"] < 10, "numbers begin again behind 255"
