"""Commands by Sparkplug: what a payload says, which of them are in time, and to which device and point they go."""

import asyncio
import json

import pytest
from waiting import until

from busway.apps.collector.commands.command_messages import InputMessage, InputRights
from busway.apps.collector.commands.message_tasks import MOST_AT_ONCE, MOST_WAITING
from busway.apps.collector.commands.sparkplug import PLACE, SparkplugCommands
from busway.apps.collector.samples import SampleValue
from busway.apps.collector.sinks.sparkplug import SparkplugCommand, SparkplugSink, _Device
from busway.apps.collector.sinks.sparkplug_payload import DataType, Metric, decode_command, encode_payload

pytest.importorskip("aiomqtt")
pytest.importorskip("google.protobuf")
NOW = 1_800_000_000.0


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (DataType.INT64, -3),
        (DataType.UINT64, 2**64 - 3),
        (DataType.DOUBLE, 21.5),
        (DataType.BOOLEAN, False),
        (DataType.STRING, "auto"),
        (DataType.DOUBLE, None),
    ],
)
def test_a_command_says_a_value_by_the_type_of_the_message_or_of_the_birth(
    kind: DataType, value: SampleValue | None
) -> None:
    content = encode_payload([Metric("a/b", 5 * 10**9, kind, value)], 7 * 10**9, None)
    command = decode_command(content)
    assert (command.time, command.values) == (7000, (("a/b", value),))
    assert value is None or type(command.values[0][1]) is type(value)
    head, length, metric = content[:3], content[4], content[5:]
    assert (head, content[3], length) == (b"\x08\xd8\x36", 0x12, len(metric))  # 7000 ms, one metric
    metric = metric.replace(bytes([0x20, kind]), b"", 1)  # no data type, as the standard wants it of commands
    bare = head + bytes([0x12, len(metric)]) + metric
    assert decode_command(bare, {"a/b": kind}).values == (("a/b", value),)


def test_a_number_of_32_bits_has_a_sign_where_its_type_has_one() -> None:
    int_value = b"\x50\xfd\xff\xff\xff\x0f"  # field 10: 2**32 - 3
    for kind, value in ((1, -3), (2, -3), (3, -3), (6, 2**32 - 3), (7, 2**32 - 3)):
        metric = b"\x0a\x01a" + bytes([0x20, kind]) + int_value
        assert decode_command(b"\x12" + bytes([len(metric)]) + metric).values == (("a", value),)


@pytest.mark.parametrize("content", [b"\xff", b"\x12\x05a", b"{}"])
def test_what_is_no_payload_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="pars"):
        decode_command(content)


class Taker:
    """Notes the commands that a sink hands on."""

    def __init__(self) -> None:
        self.taken: list[SparkplugCommand] = []

    def take(self, command: SparkplugCommand) -> None:
        self.taken.append(command)

    def note(self, error: str | None) -> None: ...


def test_a_command_goes_to_the_device_that_its_topic_names_if_there_is_one(caplog: pytest.LogCaptureFixture) -> None:
    taker = Taker()
    sink = SparkplugSink("broker", group="plant", edge_node="hall", commands=taker)
    sink._devices |= {"a+b": _Device(), "c+d": _Device(), "c#d": _Device()}
    content = encode_payload([Metric("x", 0, DataType.INT64, 1), Metric("y", 0, DataType.STRING, "on")], 10**9, None)
    for device in ("a_b", "c_d", "e"):
        sink._take_device_command(f"spBv1.0/plant/DCMD/hall/{device}", content, is_retained=False)
    sink._take_device_command("spBv1.0/plant/DCMD/hall/a_b", b"\xff", is_retained=False)
    assert taker.taken == [SparkplugCommand("a+b", "x", 1, 1.0, False), SparkplugCommand("a+b", "y", "on", 1.0, False)]
    assert "2 devices are called c_d" in caplog.text
    assert "0 devices are called e" in caplog.text


class Receiver:
    """A receiver that notes what it is given."""

    def __init__(self) -> None:
        self.messages: list[InputMessage] = []
        self.states: list[str | None] = []
        self.dropped: list[str] = []
        self.holds = asyncio.Event()
        self.holds.set()

    def drop(self, where: str) -> None:
        self.dropped.append(where)

    def connected(self) -> None:
        self.states.append(None)

    def down(self, error: str) -> None:
        self.states.append(error)

    async def handle(self, message: InputMessage) -> bytes:
        await self.holds.wait()
        self.messages.append(message)
        return b""


async def test_a_command_has_the_time_from_when_the_host_sent_it_and_too_many_are_refused() -> None:
    made, receiver = SparkplugCommands(InputRights(PLACE, ("*/*",), 10.0), now=lambda: NOW), Receiver()
    made.take(SparkplugCommand("boiler", "a", 1, NOW, False))  # not receiving yet
    made.note(None)
    task = asyncio.create_task(made.run(receiver))  # type: ignore[arg-type]
    await until(lambda: receiver.states == [None])
    for sent in (NOW, NOW - 4, NOW - 60, None):
        await asyncio.to_thread(made.take, SparkplugCommand("boiler", "flow/rate", 21.5, sent, sent is None))
    await until(lambda: len(receiver.messages) == 4)
    assert {(each.where, json.loads(each.payload)["value"]) for each in receiver.messages} == {
        ("boiler/flow/rate", 21.5)
    }
    assert [(each.seconds_left, each.is_retained) for each in receiver.messages] == [
        *((10.0, False), (6.0, False), (-50.0, False), (None, True)),
    ]
    receiver.holds.clear()
    for number in range(MOST_AT_ONCE + MOST_WAITING + 100):
        made.take(SparkplugCommand("boiler", "a", number, NOW, False))
    made.note("gone")
    await until(lambda: receiver.states == [None, "gone"])
    receiver.holds.set()
    await until(lambda: len(receiver.messages) == 4 + MOST_AT_ONCE + MOST_WAITING)
    task.cancel()
    await asyncio.wait([task])
    assert receiver.dropped == ["boiler/a"] * 100
