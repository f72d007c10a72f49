"""Commands by MQTT and NATS: from real servers, only to points that the file names, never from retained messages."""

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commanded_plant import RecordedDevice, commanded_plant
from foreign_servers import ForeignServer, mosquitto, nats_server
from waiting import until

import busway
from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.apps.collector.commands.command_messages import (
    CommandMessageHandler,
    InputMessage,
    InputRights,
    overlap,
    parsed,
)
from busway.apps.collector.commands.input_options import make_input
from busway.apps.collector.commands.journal import CUT_OFF, CommandJournal
from busway.apps.collector.commands.mqtt import MqttCommands
from busway.apps.collector.commands.nats import NatsCommands
from busway.apps.collector.sinks.mqtt import topic_level
from busway.codes import Table
from busway.config.files.section import FileProblems
from busway.config.files.sinks import sink_section
from busway.errors import ConfigError, InvalidRequest
from busway.points import Point, WriteRule
from busway.values import value_type

EXPIRING = b'{"value": 1, "expires": 1003}'
MQTT = """
[[sink]]
name = "broker"
url = "mqtt://127.0.0.1:{port}"
topic = "samples/{{device}}"
commands = {{ points = ["boiler/setpoint", "boiler/mode", "boiler/level"], topic = "plant/{{device}}/{{point}}/set" }}
"""
NATS = """
[[sink]]
name = "stream"
url = "nats://127.0.0.1:{port}"
subject = "samples.{{device}}"
stream = "SAMPLES"
commands = {{ points = ["boiler/setpoint", "boiler/mode"], subject = "plant.{{device}}.{{point}}.set" }}
"""


@contextlib.asynccontextmanager
async def plant(folder: Path, more: str) -> AsyncIterator[tuple[busway.Collector, RecordedDevice]]:
    boiler = RecordedDevice()
    async with (
        boiler.server() as server,
        busway.collect(commanded_plant(folder, server.endpoints[0], more=more)) as collector,
    ):
        await until(lambda: collector.status()[0].state == "polled")
        await until(lambda: all(each.error is None for each in collector.input_statuses()))
        yield collector, boiler


class MqttUser:
    """A client of the broker that sends commands and hears the answers."""

    def __init__(self, server: ForeignServer) -> None:
        self.answers: asyncio.Queue[tuple[str, bytes, dict[str, Any]]] = asyncio.Queue()
        self._port = server.port

    async def __aenter__(self) -> "MqttUser":
        import aiomqtt

        self.client = aiomqtt.Client("127.0.0.1", self._port, protocol=aiomqtt.ProtocolVersion.V5)
        await self.client.__aenter__()
        await self.client.subscribe("answers/#", qos=1)
        await self.client.subscribe("plant/+/+/set/result", qos=1)
        self._task = asyncio.create_task(self._listen())
        return self

    async def __aexit__(self, *error: object) -> None:
        self._task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._task
        await self.client.__aexit__(None, None, None)

    async def _listen(self) -> None:
        async for message in self.client.messages:
            correlation = getattr(message.properties, "CorrelationData", b"")
            assert isinstance(message.payload, bytes)
            await self.answers.put((str(message.topic), correlation, json.loads(message.payload)))

    async def send(self, topic: str, payload: str, *, retain: bool = False, **properties: Any) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        made = Properties(PacketTypes.PUBLISH)
        for name, value in properties.items():
            setattr(made, name, value)
        await self.client.publish(topic, payload, qos=1, retain=retain, properties=made)

    async def ask(self, topic: str, payload: str, **properties: Any) -> dict[str, Any]:
        """Send a command with a response topic, and give its answer."""
        await self.send(topic, payload, ResponseTopic="answers/me", CorrelationData=b"7", **properties)
        where, correlation, content = await asyncio.wait_for(self.answers.get(), 60)
        assert (where, correlation) == ("answers/me", b"7")
        return content


async def test_commands_by_mqtt_are_written_and_answered_on_the_response_topic(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, MQTT.format(port=server.port)) as (collector, boiler), MqttUser(server) as user:
            answer = await user.ask("plant/boiler/setpoint/set", "21.5", UserProperty=("by", "anna"))
            assert (answer["state"], answer["read_back"], answer["by"]) == ("done", 21.5, "broker: anna")
            answer = await user.ask("plant/boiler/mode/set", "hand")
            assert (answer["state"], answer["value"]) == ("done", "hand")
            order = json.dumps({"value": 30, "key": "order-1", "expires": time.time() + 20})
            first = await user.ask("plant/boiler/setpoint/set", order)
            again = await user.ask("plant/boiler/setpoint/set", order)
            assert (first["state"], again) == ("done", first)
            assert [items for _, _, items in boiler.writes] == [[215], [2], [300]]
            await user.send("plant/boiler/setpoint/set", "40")
            where, _, content = await asyncio.wait_for(user.answers.get(), 60)
            assert (where, content["state"]) == ("plant/boiler/setpoint/set/result", "done")
            assert {each.command.origin for each in await collector.commands.newest(9)} == {"mqtt"}


async def test_messages_have_the_role_of_their_input_and_can_be_armed_and_confirmed(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, MQTT.format(port=server.port)) as (collector, boiler), MqttUser(server) as user:
            where = "plant/boiler/setpoint/set"
            profile = tmp_path / "valve.toml"
            text = profile.read_text()
            profile.write_text(text.replace("write = {", "write = { armed = true,", 1))
            assert profile.read_text() != text, "the setpoint is the first point with a rule"
            await collector.read_again()
            await until(lambda: collector.status()[0].state == "polled")
            refused = await user.ask(where, "21.5")
            assert (refused["state"], "must be armed" in refused["reason"]) == ("refused", True)
            armed = await user.ask(where, '{"value": 21.5, "arm": true, "by": "anna"}')
            assert (armed["state"], armed["confirm"].startswith("Write 21.5 ")) == ("armed", True)
            assert boiler.writes == []
            confirm = json.dumps({"confirm": armed["key"], "by": "anna"})
            other = await user.ask(where, json.dumps({"confirm": armed["key"], "by": "bert"}))
            assert (other["state"], other["reason"]) == ("refused", "broker: anna has armed it, and has to confirm it")
            elsewhere = await user.ask("plant/boiler/mode/set", confirm)
            assert (elsewhere["state"], "armed for boiler/setpoint" in elsewhere["reason"]) == ("refused", True)
            done = await user.ask(where, confirm)
            assert (done["state"], done["origin"], done["value"]) == ("done", "mqtt", 21.5)
            assert await user.ask(where, confirm) == done, "a repetition writes nothing"
            assert len(boiler.writes) == 1
            mixed = await user.ask(where, '{"value": 21.5, "arm": true, "key": "mine"}')
            assert (mixed["state"], "in two steps" in mixed["reason"]) == ("refused", True)
            profile.write_text(text.replace("write = {", 'write = { role = "configure",', 1))
            await collector.read_again()
            await until(lambda: collector.status()[0].state == "polled")
            refused = await user.ask(where, "22")
            assert "needs the role configure, and the writer has operate" in refused["reason"]
            assert len(boiler.writes) == 1


async def test_commands_of_a_sink_begin_and_end_with_a_file_that_is_read_again(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, "") as (collector, boiler), MqttUser(server) as user:
            text = collector.configuration.text
            assert await collector.replace_configuration(text + MQTT.format(port=server.port), by="anna") == [
                "sink broker began"
            ]
            await until(lambda: [each.error for each in collector.input_statuses()] == [None])
            done = await user.ask("plant/boiler/setpoint/set", "21.5")
            assert done["state"] == "done"
            configured = MQTT.format(port=server.port).replace("commands = {", 'commands = { role = "configure",')
            assert await collector.replace_configuration(text + configured, by="anna") == ["sink broker began anew"]
            await until(lambda: [each.error for each in collector.input_statuses()] == [None])
            assert (await user.ask("plant/boiler/setpoint/set", "22"))["state"] == "done"
            assert await collector.replace_configuration(text, by="anna") == ["sink broker ended"]
            assert (collector.input_statuses(), collector.sink_statuses()) == ([], [])
            await user.send("plant/boiler/setpoint/set", "23")
            await until(lambda: collector.status()[0].rounds > 3)
            assert len(boiler.writes) == 2


async def test_what_may_not_come_by_mqtt_is_refused_with_a_sentence_and_not_sent(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, MQTT.format(port=server.port)) as (collector, boiler), MqttUser(server) as user:
            for topic, payload, sentence in (
                ("plant/boiler/pump/set", "true", "is no point that may be written from here"),
                ("plant/boiler/level/set", "1", "is no point that may be written from here"),
                ("plant/other/setpoint/set", "1", "is no point that may be written from here"),
                ("plant/boiler/setpoint/set", "21,5", "a number is needed"),
                ("plant/boiler/setpoint/set", "101", "must be 0…100"),
                ("plant/boiler/setpoint/set", '{"value": 1', "neither JSON"),
                ("plant/boiler/setpoint/set", '{"valeu": 1}', "unknown key"),
                ("plant/boiler/setpoint/set", '{"value": 1, "expires": "now"}', "seconds since 1970"),
                ("plant/boiler/setpoint/set", '{"value": 1, "key": "busway-1"}', "made here"),
                ("plant/boiler/setpoint/set", "[" * 9000, "neither JSON"),
            ):
                answer = await user.ask(topic, payload)
                assert answer["state"] == "refused"
                assert sentence in answer["reason"]
            late = await user.ask("plant/boiler/setpoint/set", json.dumps({"value": 1, "expires": time.time() - 1}))
            assert late["state"] == "expired"
            # An answer never goes to a topic of commands: it would be one.
            await user.send("plant/boiler/setpoint/set", "[]", ResponseTopic="plant/boiler/mode/set")
            assert (await user.ask("plant/boiler/mode/set", "auto"))["state"] == "done"
            assert boiler.writes == [("holding_registers", 1, [1])]
            (status,) = collector.input_statuses()
            assert (status.name, status.taken) == ("broker", 13)
            assert status.refused == 8


async def test_retained_commands_are_refused_at_each_connection(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with MqttUser(server) as user:
            await user.send("plant/boiler/setpoint/set", "10", retain=True)
            async with plant(tmp_path, MQTT.format(port=server.port)) as (collector, boiler):
                await user.send("plant/boiler/setpoint/set", "20", retain=True)
                _, _, content = await asyncio.wait_for(user.answers.get(), 60)
                assert content["state"] == "refused"
                assert "retained commands are not executed" in content["reason"]
                assert (await user.ask("plant/boiler/setpoint/set", "30"))["state"] == "done"
                assert boiler.writes == [("holding_registers", 0, [300])]
                assert await collector.commands.newest(9)


async def test_commands_come_again_after_the_broker_was_away(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, MQTT.format(port=server.port)) as (collector, boiler):
            server.stop()
            await until(lambda: collector.input_statuses()[0].error is not None)
            server.start()
            await until(lambda: collector.input_statuses()[0].error is None, 30)
            async with MqttUser(server) as user:
                assert (await user.ask("plant/boiler/setpoint/set", "30"))["state"] == "done"
            assert len(boiler.writes) == 1


async def test_commands_by_nats_are_requests_with_a_reply(tmp_path: Path) -> None:
    nats = pytest.importorskip("nats")
    with nats_server(tmp_path) as server:
        async with plant(tmp_path, NATS.format(port=server.port)) as (collector, boiler):
            client = await nats.connect(f"nats://127.0.0.1:{server.port}")
            try:

                async def ask(subject: str, payload: str) -> dict[str, Any]:
                    reply = await client.request(subject, payload.encode(), timeout=20, headers={"by": "anna"})
                    content: dict[str, Any] = json.loads(reply.data)
                    return content

                answer = await ask("plant.boiler.setpoint.set", "21.5")
                assert (answer["state"], answer["by"], answer["origin"]) == ("done", "stream: anna", "nats")
                assert (await ask("plant.boiler.setpoint.set", "1000"))["state"] == "refused"
                answer = await ask("plant.boiler.pump.set", "true")
                assert "is no point that may be written from here" in answer["reason"]
                order = json.dumps({"value": "auto", "key": "order-1"})
                assert (await ask("plant.boiler.mode.set", order)) == (await ask("plant.boiler.mode.set", order))
                assert [items for _, _, items in boiler.writes] == [[215], [1]]
                server.stop()
                await until(lambda: collector.input_statuses()[0].error is not None)
                server.start()
                await until(lambda: collector.input_statuses()[0].error is None, 30)
            finally:
                await client.close()


class HeldReceiver:
    """A receiver whose commands end only when they are cancelled, as those of a device that does not answer."""

    def __init__(self) -> None:
        self.is_connected = asyncio.Event()
        self.has_taken = asyncio.Event()
        self.has_ended = False

    def connected(self) -> None:
        self.is_connected.set()

    def down(self, error: str) -> None:
        raise AssertionError(error)

    def is_for_commands(self, where: str) -> bool:
        return False

    async def handle(self, message: InputMessage) -> bytes:
        self.has_taken.set()
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            self.has_ended = True
        return b""


@contextlib.asynccontextmanager
async def receiving(made: Any) -> AsyncIterator[HeldReceiver]:
    """An input that receives; at the end it is cancelled as a collector that ends does it."""
    receiver = HeldReceiver()
    task = asyncio.create_task(made.run(receiver))
    try:
        await asyncio.wait_for(receiver.is_connected.wait(), 60)
        yield receiver
    finally:
        if task.done():
            task.result()  # it has failed: say why
        task.cancel()
        await asyncio.wait([task])


async def test_an_mqtt_input_has_ended_its_tasks_when_it_ends(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with mosquitto(tmp_path) as server:
        made = MqttCommands("127.0.0.1", server.port, InputRights("plant/{device}/{point}/set", ("*/*",)))
        async with MqttUser(server) as user:
            async with receiving(made) as receiver:
                await user.send("plant/boiler/setpoint/set", "1")
                await asyncio.wait_for(receiver.has_taken.wait(), 60)
            assert receiver.has_ended


async def test_a_nats_input_has_ended_its_tasks_when_it_ends(tmp_path: Path) -> None:
    nats = pytest.importorskip("nats")
    with nats_server(tmp_path) as server:
        url = f"nats://127.0.0.1:{server.port}"
        client = await nats.connect(url)
        try:
            async with receiving(NatsCommands(url, InputRights("plant.{device}.{point}.set", ("*/*",)))) as receiver:
                await client.publish("plant.boiler.setpoint.set", b"1")
                await asyncio.wait_for(receiver.has_taken.wait(), 60)
            assert receiver.has_ended
        finally:
            await client.close()


async def test_a_command_that_a_device_executes_while_the_collector_ends_is_recorded_and_audited(
    tmp_path: Path,
) -> None:
    pytest.importorskip("aiomqtt")
    written = asyncio.Event()
    with mosquitto(tmp_path) as server:
        async with plant(tmp_path, MQTT.format(port=server.port)) as (_, boiler), MqttUser(server) as user:
            boiler.before.append(lambda change: written.set())
            await user.send("plant/boiler/mode/set", '{"value": "auto", "key": "last"}')
            await asyncio.wait_for(written.wait(), 60)
    with contextlib.closing(CommandJournal(tmp_path / "data")) as journal:
        recorded = journal.find("last")
    assert recorded is not None
    assert recorded.state in (CommandState.DONE, CommandState.UNKNOWN)
    assert recorded.reason != CUT_OFF
    (line,) = [json.loads(each) for each in (tmp_path / "data" / "audit.log").read_text().splitlines()]
    assert (line["key"], line["outcome"]) == ("last", recorded.state.value)


@contextlib.asynccontextmanager
async def mute_server() -> AsyncIterator[tuple[int, asyncio.Event]]:
    """A server that accepts a connection and says nothing: its port, and the event that it has accepted one.

    At the end it waits until the connection is closed.
    """
    accepted, closed = asyncio.Event(), asyncio.Event()

    async def say_nothing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accepted.set()
        with contextlib.suppress(ConnectionError):
            await reader.read(-1)
        writer.close()
        closed.set()

    async with await asyncio.start_server(say_nothing, "127.0.0.1", 0) as server:
        yield server.sockets[0].getsockname()[1], accepted
        await asyncio.wait_for(closed.wait(), 60)


async def test_a_nats_input_is_connected_when_the_server_has_its_subscription() -> None:
    pytest.importorskip("nats")
    lines: list[bytes] = []

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b'INFO {"server_id": "test", "version": "2.9.10", "max_payload": 1048576}\r\n')
        async for line in reader:
            lines.append(line.split()[0])
            if lines[-1] == b"PING":
                writer.write(b"PONG\r\n")
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        rights = InputRights("plant.{device}.{point}.set", ("*/*",))
        async with receiving(NatsCommands(f"nats://127.0.0.1:{port}", rights)):
            told = list(lines)
    assert b"PING" in told[told.index(b"SUB") :], told


async def test_an_mqtt_input_that_ends_while_it_connects_closes_its_connection() -> None:
    pytest.importorskip("aiomqtt")
    async with mute_server() as (port, accepted):
        made = MqttCommands("127.0.0.1", port, InputRights("plant/{device}/{point}/set", ("*/*",)))
        task = asyncio.create_task(made.run(HeldReceiver()))
        await asyncio.wait_for(accepted.wait(), 60)
        task.cancel()
        await asyncio.wait([task])


async def test_a_nats_input_that_ends_while_it_connects_closes_its_connection() -> None:
    pytest.importorskip("nats")
    async with mute_server() as (port, accepted):
        made = NatsCommands(f"nats://127.0.0.1:{port}", InputRights("plant.{device}.{point}", ("*/*",)))
        task = asyncio.create_task(made.run(HeldReceiver()))
        await asyncio.wait_for(accepted.wait(), 60)
        task.cancel()
        await asyncio.wait([task])


@pytest.mark.parametrize(
    ("payload", "value"),
    [(b"21.5", 21.5), (b"true", True), (b'"auto"', "auto"), (b"auto", "auto"), (b"21,5", "21,5"), (b"[1, 2]", [1, 2])],
)
def test_a_message_is_json_or_the_name_of_a_number(payload: bytes, value: Any) -> None:
    assert parsed(payload) == {"value": value}


@pytest.mark.parametrize("payload", [b"", b"  ", b"\xff", b"{", b"{}", b'{"value": 1, "valeu": 2}', b"x" * 20_000])
def test_a_message_that_says_nothing_is_refused(payload: bytes) -> None:
    with pytest.raises(InvalidRequest):
        parsed(payload)


@pytest.mark.parametrize(
    ("commands", "sentence"),
    [
        (True, "must be a table, not True"),
        ({}, "is missing"),
        ({"points": []}, "names what may be written"),
        ({"points": ["*"]}, "names what may be written"),
        ({"points": ["a/b"], "topics": "x"}, "unknown key; is it topic"),
        ({"points": ["a/b"], "topic": "plant/set"}, "each once and as a level of its own"),
        ({"points": ["a/b"], "topic": "plant/{device}/{device}/{point}"}, "each once and as a level of its own"),
        ({"points": ["a/b"], "topic": "plant/{device}/x{point}"}, "each once and as a level of its own"),
        ({"points": ["a/b"], "topic": "#/{device}/{point}"}, "no wildcards"),
        ({"points": ["a/b"], "topic": "/{device}/{point}"}, "no wildcards"),
        ({"points": ["a/b"], "topic": "busway/{device}/{point}"}, "on which samples are sent"),
        ({"points": ["a/b"], "seconds": 0.0}, r"must be 0…86400, not 0"),
    ],
)
def test_a_table_of_commands_that_cannot_be_is_refused(commands: Any, sentence: str) -> None:
    pytest.importorskip("aiomqtt")
    table = {"name": "broker", "url": "mqtt://127.0.0.1", "per_point": True, "commands": commands}
    with pytest.raises((ConfigError, FileProblems), match=sentence):
        make_input(sink_section(table))


def test_commands_come_by_mqtt_and_nats_alone(tmp_path: Path) -> None:
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1", more='[[sink]]\nname = "l"\nurl = "file://l.jsonl"\n')
    file.write_text(file.read_text() + 'commands = { points = ["boiler/mode"] }\n')
    with pytest.raises(ConfigError, match=r"sink\[0\]\.commands: unknown key"):
        busway.collect(file)


def test_topics_overlap_where_a_name_may_stand() -> None:
    assert overlap("a/{device}/{point}", "a/x/{point}", "/")
    assert not overlap("a/{device}/{point}/set", "a/{device}/{point}", "/")
    assert not overlap("a.{device}.set", "a.{device}.get", ".")


class NotedRunner:
    """Notes the commands that it gets, and does none."""

    def __init__(self) -> None:
        self.got: list[tuple[str, str, float]] = []

    def refused(self, result: CommandResult, reason: str) -> CommandResult:
        return result.finished(CommandState.REFUSED, reason)

    async def write(self, device: str, point: str, value: Any, *, expires: float, **more: Any) -> CommandResult:
        self.got.append((device, point, expires))
        command = PointCommand("k", device, point, value, more["by"], more["origin"], expires)
        return CommandResult(command, CommandState.DONE, 0.0)


def receiver_of(names: list[str], permitted: list[str], **clocks: Any) -> tuple[CommandMessageHandler, NotedRunner]:
    """A receiver of messages for a device, ``d``, with points of these names at the topics ``plant/d/POINT``."""
    made = SimpleNamespace(
        rights=InputRights("plant/{device}/{point}", tuple(permitted), 10.0),
        kind="mqtt",
        level=topic_level,
        join=lambda group, member: bool(group),
    )
    points = [Point(each, Table.HOLDING_REGISTERS, n, value_type("uint16")) for n, each in enumerate(names)]
    points = [replace(each, writing=WriteRule()) if each.name != "shown" else each for each in points]
    plant = SimpleNamespace(devices={"d": SimpleNamespace(name="d", points=points)})
    runner = NotedRunner()
    return CommandMessageHandler("broker", made, runner, lambda: plant, **clocks), runner  # type: ignore[arg-type]


def test_a_right_for_a_name_with_an_index_is_for_that_name_alone() -> None:
    rights = InputRights("plant/{device}/{point}", ("plc/T[1]", "plc[2]/*"))
    assert rights.permits("plc", "T[1]")
    assert not rights.permits("plc", "T1")
    assert rights.permits("plc[2]", "speed")
    assert not rights.permits("plc2", "speed")


@pytest.mark.parametrize(
    ("names", "permitted", "asked", "written"),
    [
        (["a_b", "c"], ["d/a_b"], "a_b", "a_b"),
        (["a/b", "c"], ["d/a/b"], "a_b", "a/b"),
        (["a/b", "a_b"], ["d/a_b"], "a_b", None),  # the topic stands for both, and one of them is not permitted
        (["a/b", "a_b"], ["d/a_b", "d/a/b"], "a_b", None),
        (["a/b", "a+b"], ["d/*"], "a_b", None),
        (["x/a", "a"], ["*/a"], "x_a", None),  # a star for the device ends at the slash
        (["x/a", "a"], ["*/a"], "a", "a"),
        (["x/a", "a"], ["d*/a"], "x_a", None),
        (["x/a", "a"], ["d/*/a"], "x_a", "x/a"),
        (["a"], ["D/a", "d/A"], "a", None),
        (["shown"], ["d/*"], "shown", None),
    ],
)
async def test_a_topic_writes_the_point_that_the_file_permits_or_none(
    names: list[str], permitted: list[str], asked: str, written: str | None
) -> None:
    receiver, runner = receiver_of(names, permitted)
    answer = json.loads(await receiver.handle(InputMessage(f"plant/d/{asked}", b"1")))
    assert [point for _, point, _ in runner.got] == ([] if written is None else [written])
    assert answer["state"] == ("refused" if written is None else "done")


async def test_of_the_collectors_of_a_fleet_the_one_that_polls_the_device_answers_alone() -> None:
    made = SimpleNamespace(rights=InputRights("plant/{device}/{point}", ("*/a",), 10.0), kind="mqtt", level=topic_level)
    point = Point("a", Table.HOLDING_REGISTERS, 0, value_type("uint16"), writing=WriteRule())
    whole = SimpleNamespace(devices={name: SimpleNamespace(name=name, points=[point]) for name in ("d", "e")})
    runners, receivers = [], []
    for name in ("d", "e"):
        part = SimpleNamespace(devices={name: whole.devices[name]})
        runners.append(NotedRunner())
        receivers.append(
            CommandMessageHandler("broker", made, runners[-1], lambda part=part: part, plant=lambda: whole)  # type: ignore
        )

    async def answers(message: InputMessage) -> list[str | None]:
        found = [await each.handle(message) for each in receivers]
        return [None if each is None else json.loads(each)["state"] for each in found]

    assert await answers(InputMessage("plant/d/a", b"1")) == ["done", None]
    assert await answers(InputMessage("plant/e/a", b"1")) == [None, "done"]
    assert [[device for device, *_ in each.got] for each in runners] == [["d"], ["e"]]
    for refused in (InputMessage("plant/d/a", b"{"), InputMessage("plant/d/a", b"1", is_retained=True)):
        assert await answers(refused) == ["refused", None]
    assert await answers(InputMessage("plant/d/b", b"1")) == ["refused", "refused"], "a point of no collector"
    assert [each.status().refused for each in receivers] == [3, 1]


class NotedOwners:
    """A collector of a fleet that polls ``d`` since a moment, and whose messages go to all or to one of them."""

    def __init__(self, group: str, since: float | None) -> None:
        self.group, self.member, self.since = group, "c0", since

    def owned_since(self, device: str) -> float | None:
        return self.since

    async def answers(self, device: str | None) -> bool:
        return True

    async def pass_on(self, command: PointCommand) -> dict[str, Any]:
        raise AssertionError("it polls the device itself")


@pytest.mark.parametrize(
    ("group", "payload", "arrived", "state"),
    [
        ("", b"1", 100.0, "refused"),  # the very moment in which the link came
        ("", b"1", 99.0, "refused"),  # it came before, and waited here
        ("", b"1", 129.9, "refused"),
        ("", b"1", 130.0, "done"),
        ("", b'{"value": 1, "key": "k"}', 100.0, "done"),  # taken once in the whole fleet
        ("hall", b"1", 100.0, "done"),  # no other collector gets this message
    ],
)
async def test_a_message_without_a_key_that_an_earlier_owner_may_have_executed_is_refused(
    group: str, payload: bytes, arrived: float, state: str
) -> None:
    receiver, runner = receiver_of(["a"], ["d/a"], others=NotedOwners(group, 100.0), moment=lambda: 131.0)
    answer = json.loads(await receiver.handle(InputMessage("plant/d/a", payload, arrived=arrived)))
    assert answer["state"] == state, answer
    assert len(runner.got) == (state == "done")
    if state == "refused":
        assert "send it with a key" in answer["reason"]


@pytest.mark.parametrize(
    ("left", "payload", "expires"),
    [(None, b"1", 1010.0), (30.0, b"1", 1010.0), (4.0, b"1", 1004.0), (0.0, b"1", 1000.0), (4.0, EXPIRING, 1003.0)],
)
async def test_the_time_of_a_message_counts_from_its_arrival(
    left: float | None, payload: bytes, expires: float
) -> None:
    receiver, runner = receiver_of(["a"], ["d/a"], now=lambda: 1060.0, moment=lambda: 160.0)
    await receiver.handle(InputMessage("plant/d/a", payload, seconds_left=left, arrived=100.0))
    assert runner.got == [("d", "a", expires)]


@pytest.mark.parametrize(
    ("payload", "sentence"),
    [
        (b'{"value": 1, "by": 5}', "by is a text"),
        (b'{"value": 1, "by": "\\ud800"}', "by has 1"),
        (b'{"value": 1, "by": "a\\u202eb"}', "by has 1"),
        (b'{"value": "\\ud800"}', "half of a surrogate pair"),
        (b'{"value": ["on", "\\ud800"]}', "half of a surrogate pair"),
    ],
)
async def test_texts_that_no_answer_could_hold_are_refused(payload: bytes, sentence: str) -> None:
    receiver, runner = receiver_of(["a"], ["d/a"])
    answer = json.loads(await receiver.handle(InputMessage("plant/d/a", payload)))
    assert (answer["state"], runner.got) == ("refused", [])
    assert sentence in answer["reason"]


def test_messages_that_are_too_many_are_counted_and_logged(caplog: pytest.LogCaptureFixture) -> None:
    receiver, _ = receiver_of(["a"], ["d/a"])
    for _ in range(3):
        receiver.drop("plant/d/a")
    assert (receiver.status().taken, receiver.status().refused) == (3, 3)
    assert caplog.text.count("too many messages wait") == 1
