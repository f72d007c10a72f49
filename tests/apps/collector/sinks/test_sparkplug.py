"""What a host application is shown by a Sparkplug sink, case by case; `test_sparkplug_walk` mixes them."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from collected import NOON, at, read_of
from deliveries import delivery_to
from sparkplug_broker import SparkplugBroker
from sparkplug_host import SparkplugHost
from waiting import until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import PointDescription, PointGroup, Reason, SampleValue
from busway.apps.collector.sinks import sparkplug
from busway.apps.collector.sinks.delivery import DeliveryOptions
from busway.apps.collector.sinks.interface import SinkDown, SinkRefused
from busway.apps.collector.sinks.sparkplug import SparkplugSink
from busway.apps.collector.sinks.sparkplug_payload import DataType, Metric, encode_payload
from busway.apps.collector.store.committed_samples import CommittedAlarm, CommittedSample
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule

pytest.importorskip("aiomqtt")
pytest.importorskip("google.protobuf")


class Plant:
    """A sink, the broker that it has, and the host behind it."""

    def __init__(self) -> None:
        self.host = SparkplugHost()
        self.broker = SparkplugBroker(self.host.take)
        self.now = NOON
        self.seconds = 0

    @asynccontextmanager
    async def sink(self, primary_host: str | None = None) -> AsyncIterator[SparkplugSink]:
        made = SparkplugSink("broker", group="plant", edge_node="hall", primary_host=primary_host, now=lambda: self.now)
        try:
            yield made
        finally:
            await made.close()

    def sample(
        self, point: str, value: SampleValue | None, reason: int = 0, *, seconds: float | None = None
    ) -> CommittedSample:
        """A sample of the device ``pump``, one second after the last."""
        self.seconds += 1
        time = at(self.seconds if seconds is None else seconds)
        return CommittedSample(self.seconds, "pump", point, time, 0, value, reason)

    def shown(self) -> dict[str, tuple[SampleValue | None, int]]:
        return {name: (each.value, each.quality) for name, each in self.host.current.get("pump", {}).items()}

    def data(self, point: str) -> list[tuple[SampleValue | None, int]]:
        return [(each.value, each.kind) for _, _, each in self.host.data if each.name == point]

    def ask(self) -> None:
        wanted = [Metric("Node Control/Rebirth", self.now, DataType.BOOLEAN, True)]
        self.broker.say("spBv1.0/plant/NCMD/hall", encode_payload(wanted, self.now, None))

    def state(self, *, online: bool, timestamp: int) -> None:
        content = json.dumps({"online": online, "timestamp": timestamp}).encode()
        self.broker.say("spBv1.0/STATE/scada", content, retain=True)


@pytest.fixture
def plant(monkeypatch: pytest.MonkeyPatch) -> Plant:
    made = Plant()
    monkeypatch.setattr("aiomqtt.Client", made.broker.client)
    monkeypatch.setattr(sparkplug, "REBIRTH_PAUSE", 0.0)
    return made


async def turns() -> None:
    """Run all tasks until each of them waits."""
    for _ in range(100):
        await asyncio.sleep(0)


@pytest.mark.parametrize("reason", [Reason.SUSPENDED, Reason.MAINTENANCE, Reason.NO_CONNECTION])
async def test_a_device_that_is_gone_is_not_born_because_a_host_asks_or_the_connection_was_lost(
    plant: Plant, reason: Reason
) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        await sink.send([plant.sample("speed", None, reason)])
        assert "pump" not in plant.host.current
        plant.ask()
        await turns()
        assert (plant.host.births, plant.host.current) == (2, {})
        await sink.close()
        await sink.open()
        assert (plant.host.births, plant.host.current) == (3, {})
        await sink.send([plant.sample("speed", 2)])
        assert plant.shown() == {"speed": (2, 192)}


async def test_births_and_data_are_of_qos_0_and_one_more_message_of_qos_1_ends_a_batch(plant: Plant) -> None:
    """What the standard wants; the broker answers none of them, so the answer to that message stands for all."""
    async with plant.sink() as sink:
        await sink.open()
        assert plant.broker.qualities == [("NBIRTH", 0)]
        plant.broker.qualities.clear()
        await sink.send([plant.sample("speed", 1)])
        await sink.send([plant.sample("speed", 2), plant.sample("level", 0.5), plant.sample("level", None, 33)])
        assert plant.broker.qualities == [
            ("DBIRTH", 0), ("DDATA", 0), ("plant", 1),
            ("DBIRTH", 0), ("DDATA", 0), ("DDEATH", 0), ("plant", 1),
        ]  # fmt: skip
        plant.broker.qualities.clear()
    assert plant.broker.qualities == [("NDEATH", 1)]


async def test_a_batch_is_not_taken_before_the_broker_has_answered_the_message_after_it(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        plant.broker.is_mute = True
        sending = asyncio.create_task(sink.send([plant.sample("speed", 1)]))
        await turns()
        assert plant.shown() == {"speed": (1, 192)}, "the host has it, but the broker has said nothing"
        assert not sending.done()
        plant.broker.answer()
        await sending


async def test_births_show_what_is_bad_as_bad(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        await sink.send([plant.sample("speed", None, Reason.TIMEOUT)])
        assert plant.shown() == {"speed": (None, 0)}
        plant.ask()
        await turns()
        assert plant.host.births == 2
        assert plant.shown() == {"speed": (None, 0)}


@pytest.mark.parametrize(
    "values",
    [
        ("on", 5),
        (5, "on", 6, True),
        (5, True),
        (2**63 + 5, -3),
        (2**53 + 1, 0.5),
        (None, 2**60 + 1),
        (0.5, 7, 2**60 + 1, 1),
    ],
)
async def test_values_of_many_types_in_one_batch_are_what_they_were(
    plant: Plant, values: tuple[SampleValue | None, ...]
) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("mode", value) for value in values])
        told = plant.data("mode")
    assert [value for value, _ in told] == list(values)
    for value, (_, kind) in zip(values, told, strict=True):
        if value is not None:
            assert isinstance(value, bool) is (kind == DataType.BOOLEAN)


async def test_whole_numbers_among_fractions_do_not_need_a_birth_each(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("level", 0.5)])
        seen: list[str] = []
        plant.broker.take = lambda topic, content: seen.append(topic.split("/")[2])
        for value in (7, 0.25, 8, None, 9):
            await sink.send([plant.sample("level", value)])
    assert [each for each in seen if each.startswith("D")][:5] == ["DDATA"] * 5


async def test_what_went_as_history_is_shown_when_no_more_follows(plant: Plant) -> None:
    plant.now = at(100)
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1), plant.sample("mode", "on")])
        await sink.send([plant.sample("speed", 2)])
        assert [each.is_historical for _, _, each in plant.host.data] == [True] * 3
        await sink.show_current()
        assert plant.shown() == {"speed": (2, 192), "mode": ("on", 192)}
        births = plant.broker.taken
        await sink.show_current()
        assert plant.broker.taken == births, "once is enough"
        await sink.send([plant.sample("speed", 3, seconds=100)])
        assert not plant.host.data[-1][2].is_historical, "as old as the connection is not older"
        assert plant.shown()["speed"] == (3, 192)


async def test_points_and_devices_that_there_are_no_longer_leave_the_births_at_once(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        samples = [plant.sample("speed", 1), plant.sample("level", 2)]
        await sink.send([*samples, samples[0]._replace(device="valve")])
        await sink.show_current({("pump", "speed")})
        assert plant.shown() == {"speed": (1, 192)}
        assert "valve" not in plant.host.current
        births = plant.broker.taken
        await sink.show_current({("pump", "speed")})
        assert plant.broker.taken == births, "once is enough"
        await sink.close()
        await sink.open()
        assert list(plant.host.current) == ["pump"]
        assert plant.shown() == {"speed": (1, 192)}


async def test_a_device_that_is_gone_and_removed_is_not_born_again(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        await sink.send([plant.sample("speed", None, Reason.SUSPENDED)])
        await sink.show_current(set())
        await sink.send([plant.sample("speed", 2)])  # it was on its way
        assert plant.shown() == {"speed": (2, 192)}
        await sink.show_current(set())
        assert plant.host.current == {}


ON_CHANGE = {("pump", "mode"): ReportRule("change"), ("pump", "speed"): ReportRule("change")}


@pytest.mark.parametrize("reason", [0, Reason.OUT_OF_RANGE, Reason.SUSPENDED])
async def test_points_that_are_sent_on_change_are_in_the_births_after_a_restart(
    plant: Plant, tmp_path: Path, reason: int
) -> None:
    quality = 192 if not reason else 500
    with StoreWriter(tmp_path / "store", now=NOON) as writer:
        writer.describe_points([PointDescription("pump", "mode", "%"), PointDescription("pump", "speed", "1/min")])
        for names in (ON_CHANGE.keys(), ON_CHANGE.keys(), {("pump", "mode")}):
            values = {name: value for name, value in (("speed", 5), ("mode", "on")) if ("pump", name) in names}
            given = [None] * len(values) if reason == Reason.SUSPENDED else list(values.values())
            writer.commit([read_of(PointGroup("pump", tuple(values)), 1, *given, reasons=reason)], [], at(1))
            async with plant.sink() as sink:
                delivery = delivery_to(sink, writer, points=names, point_rules=ON_CHANGE)
                while await delivery.step():
                    pass
                if reason == Reason.SUSPENDED:
                    assert plant.host.current == {}
                    continue
                assert plant.shown() == {name: (value, quality) for name, value in values.items()}
                if plant.host.connection > 1:
                    assert plant.host.current["pump"]["mode"].unit == "%", "by the birth alone"
    assert len(plant.host.data) == (0 if reason == Reason.SUSPENDED else 2)


async def test_an_edge_node_is_there_before_the_first_sample_and_again_when_its_connection_was_lost(
    plant: Plant, tmp_path: Path
) -> None:
    with StoreWriter(tmp_path / "store", now=NOON) as writer:
        async with plant.sink() as sink:
            delivery = delivery_to(sink, writer)
            await delivery.step()
            assert plant.host.is_online
            writer.commit([read_of(PointGroup("pump", ("speed",)), 1, 5)], [], at(1))
            await delivery.step()
            plant.broker.lose()
            assert not plant.host.is_online
            await turns()
            with pytest.raises(SinkDown):
                await delivery.step()
            await delivery._down(SinkDown("it was lost"))
            await delivery.step()
            assert plant.host.is_online
            assert plant.shown() == {"speed": (5, 192)}
            assert delivery.status().error is None


async def test_a_primary_host_that_goes_offline_is_noticed_at_once_where_nothing_is_to_be_sent(
    plant: Plant, tmp_path: Path
) -> None:
    plant.state(online=True, timestamp=5)
    with StoreWriter(tmp_path / "store", now=NOON) as writer:
        async with plant.sink("scada") as sink:
            delivery = delivery_to(sink, writer, DeliveryOptions(age=3600.0, keep=1e6))
            pauses: list[float] = []

            async def pause(seconds: float) -> None:
                pauses.append(seconds)
                await (asyncio.Future() if seconds == 3600.0 else asyncio.sleep(0.01))

            delivery._pause = pause
            running = asyncio.create_task(delivery.run())
            try:
                await until(lambda: plant.host.is_online and 3600.0 in pauses)
                plant.state(online=False, timestamp=6)
                await until(lambda: not plant.host.is_online)
                await until(lambda: "scada went offline" in str(delivery.status().error))
                plant.state(online=True, timestamp=7)
                await until(lambda: plant.host.is_online and delivery.status().error is None)
                plant.broker.lose()
                assert not plant.host.is_online
                await until(lambda: plant.host.is_online)
            finally:
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
    assert len(plant.host.sessions) == 3


async def test_a_sample_from_before_a_rebirth_is_not_history(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        read = plant.sample("speed", 2)
        plant.now = at(50)
        plant.ask()
        await turns()
        assert plant.host.births == 2
        await sink.send([read])
        assert plant.shown() == {"speed": (2, 192)}


async def test_a_host_that_asks_while_births_are_published_gets_them_again(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        take, asked = plant.broker.take, []

        def hear(topic: str, content: bytes) -> None:
            take(topic, content)
            if "NBIRTH" in topic and not asked:
                asked.append(topic)
                plant.ask()

        plant.broker.take = hear
        await sink.close()
        await sink.open()
        await turns()
        assert plant.host.births == 3
        asked.clear()
        plant.ask()
        await turns()
        assert plant.host.births == 5, "one for each request"


async def test_a_primary_host_that_was_away_gets_births_before_data(plant: Plant) -> None:
    plant.state(online=True, timestamp=5)
    async with plant.sink("scada") as sink:
        await sink.open()
        await sink.send([plant.sample("speed", 1)])
        plant.state(online=False, timestamp=5)  # its last will, as old as its birth
        await turns()
        with pytest.raises(SinkDown, match="went offline"):
            await sink.send([plant.sample("speed", 2)])
        plant.state(online=True, timestamp=7)
        with contextlib.suppress(SinkDown):  # it has not noticed yet that the host is back
            await sink.send([plant.sample("speed", 2)])
        assert len(plant.host.data) == 1
        await turns()
        assert plant.host.births == 2, "also where there are no samples"
        plant.state(online=False, timestamp=6)  # an old one that comes late
        await turns()
        await sink.send([plant.sample("speed", 3)])
        assert plant.data("speed")[-1][0] == 3


async def test_a_birth_that_is_too_large_goes_without_values(plant: Plant) -> None:
    plant.broker.most = 1000
    async with plant.sink() as sink:
        await sink.open()
        await sink.send([plant.sample("a", "x"), plant.sample("b", "y")])
        await sink.send([plant.sample("a", "x" * 700)])
        await sink.send([plant.sample("b", "y" * 700)])  # each has room, both together have not
        await sink.close()
        await sink.open()
        assert plant.shown() == {"a": (None, 500), "b": (None, 500)}
        await sink.send([plant.sample("b", "z")])
        assert plant.shown() == {"a": (None, 500), "b": ("z", 192)}
        with pytest.raises(SinkRefused):
            await sink.send([plant.sample("b", "z" * 1000)])
        await sink.send([plant.sample("b", "after")])
        assert plant.shown()["b"] == ("after", 192)


async def test_an_alarm_that_is_too_large_for_the_birth_of_the_node_does_not_keep_it_from_being_born(
    plant: Plant,
) -> None:
    event = AlarmEvent("pump", "speed", "H", AlarmEventKind.RAISED, at(1), 9.0, text="")
    plant.broker.most = 1000
    async with plant.sink() as sink:
        await sink.open()
        refused = 0
        for length in range(600, 1000):  # until it has just room
            try:
                await sink.send_alarms([CommittedAlarm(1, 0, replace(event, text="x" * length))])
            except SinkRefused:
                refused += 1
                break
        assert refused
        await sink.close()
        await sink.open()
        assert plant.host.births == 2


async def test_what_is_published_of_a_batch_that_is_refused_is_not_published_again(
    plant: Plant, tmp_path: Path
) -> None:
    plant.broker.most = 1000
    other = PointGroup("boiler", ("level",))
    group = PointGroup("pump", ("speed", "name"))
    raised = AlarmEvent("pump", "speed", "H", AlarmEventKind.RAISED, at(5), 9.0)
    with StoreWriter(tmp_path / "store", now=NOON) as writer:
        for second in range(1, 9):
            name = "x" * 2000 if second in (3, 6) else "on"
            events = [replace(raised, text=text) for text in ("first", "y" * 2000, "last")] if second == 5 else []
            writer.commit([read_of(group, second, second, name), read_of(other, second, second)], [], at(9), events)
        async with plant.sink() as sink:
            delivery = delivery_to(sink, writer)
            while await delivery.step():
                pass
        assert (delivery.status().sent, delivery.status().set_aside) == (22, 3)
    for point in ("speed", "level"):
        assert [value for value, _ in plant.data(point)] == list(range(1, 9))
    assert [value for value, _ in plant.data("name")] == ["on"] * 6
    assert [json.loads(str(each.value))["text"] for _, each in plant.host.events] == ["first", "last"]


async def test_what_was_published_before_a_refusal_comes_again_if_the_connection_is_lost(plant: Plant) -> None:
    plant.broker.most = 1000
    async with plant.sink() as sink:
        await sink.open()
        samples = [plant.sample("a", 1), plant.sample("b", "x" * 2000)]
        await sink.send(samples[:1])
        with pytest.raises(SinkRefused):
            await sink.send([plant.sample("a", 2), samples[1]._replace(device="valve", commit=3)])
        plant.broker.lose()
        await turns()
        await sink.close()
        await sink.open()
        await sink.send([samples[0]._replace(time=at(3), commit=3, value=2)])
        assert [value for value, _ in plant.data("a")] == [1, 2, 2]


async def test_numbers_of_messages_begin_again_behind_255(plant: Plant) -> None:
    async with plant.sink() as sink:
        await sink.open()
        for number in range(600):
            await sink.send([plant.sample("speed", number)])
    assert [value for value, _ in plant.data("speed")] == list(range(600)), "the host has checked each number"
