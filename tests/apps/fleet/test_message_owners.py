"""Commands by MQTT and NATS to a fleet: one collector answers each, and its value is written once."""

import asyncio
import contextlib
import json
import uuid
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from fleet_devices import METER, FleetDevice, devices_of, plant
from foreign_servers import mosquitto, nats_server
from waiting import until

from busway.apps.collector.configuration import parse_collector
from busway.apps.fleet.coordinator import Coordinator, CoordinatorDown
from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.nats import open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, until_up
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_commands import FleetCommands
from busway.apps.fleet.lease_times import LeaseTimes

pytest.importorskip("nats")
pytest.importorskip("aiomqtt")
pytestmark = pytest.mark.real_time

TIMES = LeaseTimes(ttl=100.0, renew=0.4, guard=1.0, answer=20.0)
"""No lease lapses here, however busy the machine is."""
SETPOINT = """
[[unit.point]]
name = "setpoint"
address = "4x11"
type = "uint16"
maximum = 1000
write = {}
"""
BROKER = """
[[sink]]
name = "broker"
url = "mqtt://127.0.0.1:{port}"
client_id = "hall"
topic = "samples/{{device}}"
commands = {{ points = ["*/*"], topic = "plant/{{device}}/{{point}}/set" }}
"""
STREAM = """
[[sink]]
name = "stream"
url = "nats://127.0.0.1:{port}"
subject = "samples.{{device}}"
stream = "SAMPLES"
commands = {{ points = ["*/*"], subject = "plant.{{device}}.{{point}}.set" }}
"""
ELSEWHERE = {"link-2": ["elsewhere"]}
"""The host of a link that no collector of these tests can own."""


@contextlib.asynccontextmanager
async def collectors(
    folder: Path, tables: list[Coordinator], devices: list[FleetDevice], sinks: str
) -> AsyncIterator[list[FleetCollector]]:
    """Yield one collector for each connection to the coordinator, when each owns a link and hears commands."""
    async with contextlib.AsyncExitStack() as stack:
        found = []
        for number, table in enumerate(tables):
            name = f"box-{number}"
            text = plant(folder / name, devices, "timeout = 10\nconnect_timeout = 10") + sinks
            (folder / "meter.toml").write_text(METER + SETPOINT)
            client = getattr(table, "client", None)
            fleet = FleetCollector(
                parse_collector(text, str(folder / f"{name}.toml")),
                table,
                name,
                host=name,
                shards=8,
                hosts={"link-0": ["box-0"], "link-1": ["box-1"], **ELSEWHERE},
                times=TIMES,
                zone="" if client is None else "hall",
            )
            found.append(await stack.enter_async_context(fleet))
            if client is not None:
                await stack.enter_async_context(FleetCommands(fleet, client, "hall"))
        await until(lambda: [each.links for each in found] == [{"link-0"}, {"link-1"}], 60)
        await until(lambda: all(not status.error for each in found for status in each.collector.input_statuses()), 60)
        owners = {f"pin.box-{number}": f"box-{number}" for number in range(2)}
        await until(lambda: all(owners == held_by(each) for each in found), 60)
        await until(lambda: all(len(each.member.members(each._now())) == 2 for each in found), 60)
        yield found


def held_by(fleet: FleetCollector) -> dict[str, str]:
    """The owner of each shard, as the table has shown it to a collector."""
    return {shard: each.owner for shard, each in fleet.member.leases().items() if each.held}


class MqttUser:
    """A client of the broker: what it sends, and all answers that come."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._answers: asyncio.Queue[tuple[bytes, dict[str, Any]]] = asyncio.Queue()

    async def listen(self) -> None:
        async for message in self._client.messages:
            await self._answers.put((message.properties.CorrelationData, json.loads(message.payload)))

    async def ask(self, device: str, payload: str) -> dict[str, Any]:
        """Return the answer to a command; it must be the next that comes."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        made = Properties(PacketTypes.PUBLISH)
        made.ResponseTopic, made.CorrelationData = "answers/me", uuid.uuid4().bytes
        await self._client.publish(f"plant/{device}/setpoint/set", payload, qos=1, properties=made)
        found, answer = await asyncio.wait_for(self._answers.get(), 60)
        assert found == made.CorrelationData
        return answer


@contextlib.asynccontextmanager
async def user_of(port: int) -> AsyncIterator[MqttUser]:
    import aiomqtt

    async with aiomqtt.Client("127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe("answers/me", qos=1)
        user = MqttUser(client)
        listening = asyncio.create_task(user.listen())
        try:
            yield user
        finally:
            listening.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listening


@contextlib.asynccontextmanager
async def nats_tables(port: int, count: int) -> AsyncIterator[list[Coordinator]]:
    async with contextlib.AsyncExitStack() as stack:
        tables: list[Coordinator] = []
        for _ in range(count):
            table = await until_up(
                lambda: open_nats(f"nats://127.0.0.1:{port}", "hall", CoordinatorOptions(answer=TIMES.answer)),
                CoordinatorDown,
                30,
            )
            stack.push_async_callback(table.close)
            tables.append(table)
        yield tables


@pytest.mark.parametrize("kind", ["nats", "local"])
async def test_one_collector_answers_each_message_and_a_link_without_owner_has_one_error(
    tmp_path: Path, kind: str
) -> None:
    async with contextlib.AsyncExitStack() as stack:
        broker = stack.enter_context(mosquitto(tmp_path))
        devices = await stack.enter_async_context(devices_of(3))
        if kind == "nats":
            server = stack.enter_context(nats_server(tmp_path))
            tables = await stack.enter_async_context(nats_tables(server.port, 2))
        else:
            tables = [await open_coordinator(f"local:{tmp_path}/zone", "hall") for _ in range(2)]
            for table in tables:
                stack.push_async_callback(table.close)
        await stack.enter_async_context(collectors(tmp_path, tables, devices, BROKER.format(port=broker.port)))
        user = await stack.enter_async_context(user_of(broker.port))
        if kind == "local":  # the message goes to all: an owner before this one may have executed it
            answer = await user.ask("link-0", "9")
            assert (answer["state"], devices[0].written) == ("refused", [])
            assert "send it with a key" in answer["reason"]
        for value in (1, 2, 3):
            for device in ("link-0", "link-1"):
                assert (await user.ask(device, command(value, kind)))["state"] == "done"
        assert [device.written for device in devices] == [[(10, 1), (10, 2), (10, 3)]] * 2 + [[]]
        for device, payload, sentence in (
            ("link-2", "7", "link-2"),
            ("link-1", "[", "neither JSON"),
            ("link-1", command(5000, kind), "must be at most 1000"),
            ("nothing", "1", "is no point that may be written from here"),
        ):
            answer = await user.ask(device, payload)
            assert answer["state"] == "refused"
            assert sentence in answer["reason"]
        for device in ("link-0", "link-1"):  # behind an answer too many this one would not be the next
            assert (await user.ask(device, command(0, kind)))["state"] == "done"
        assert not devices[2].written


def command(value: int, kind: str) -> str:
    """A value alone, or with a key of its own where messages go to all collectors."""
    return str(value) if kind == "nats" else json.dumps({"value": value, "key": f"order-{uuid.uuid4().hex}"})


async def test_one_key_that_comes_by_mqtt_and_nats_at_once_is_written_once(tmp_path: Path) -> None:
    async with contextlib.AsyncExitStack() as stack:
        broker = stack.enter_context(mosquitto(tmp_path))
        server = stack.enter_context(nats_server(tmp_path))
        devices = await stack.enter_async_context(devices_of(3))
        tables = await stack.enter_async_context(nats_tables(server.port, 3))
        sinks = BROKER.format(port=broker.port) + STREAM.format(port=server.port)
        await stack.enter_async_context(collectors(tmp_path, tables[:2], devices, sinks))
        one = await stack.enter_async_context(user_of(broker.port))
        for number in range(5):
            command = json.dumps({"value": number, "key": f"order-{number}"})
            *by_nats, by_mqtt = await asyncio.gather(
                tables[2].client.request("plant.link-0.setpoint.set", command.encode(), timeout=60),  # type: ignore[attr-defined]
                tables[2].client.request("plant.link-0.setpoint.set", command.encode(), timeout=60),  # type: ignore[attr-defined]
                one.ask("link-0", command),
            )
            answers = [by_mqtt, *(json.loads(each.data) for each in by_nats)]
            assert {each["state"] for each in answers} == {"done"}
        assert devices[0].written == [(10, number) for number in range(5)]
