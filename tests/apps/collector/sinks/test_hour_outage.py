"""Real servers that are down for an hour of the plant: everything arrives, in order for each point, when they are back.

The clock of the plant goes while the delivery pauses, and only then: what a plant polls meanwhile is committed in each
pause. So an hour with all its attempts takes a second. In real time: `test_long_outage.py`.
"""

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from collected import NOON, at, read_of
from foreign_servers import PostgresqlServer, durable_mosquitto, nats_server
from kept_once import Delivered
from sink_receivers import MqttReceiver, NatsReceiver, PostgresqlReceiver, Receiver

from busway.apps.collector.samples import PointGroup
from busway.apps.collector.sinks.delivery import PAUSE_LIMIT, Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import Sink
from busway.apps.collector.sinks.mqtt import MqttSink
from busway.apps.collector.sinks.nats import NatsSink
from busway.apps.collector.sinks.postgresql import PostgresqlSink
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

DEVICES = [PointGroup(f"meter-{number}", ("energy", "power", "state")) for number in range(4)]
PERIOD, HOUR = 30.0, 3600.0


class Plant:
    """Four meters that are polled every half minute of a clock that goes when it is told to."""

    def __init__(self, writer: StoreWriter) -> None:
        self.writer, self.seconds, self.lines = writer, 0.0, Delivered()
        self._polled = 0

    def now(self) -> int:
        return at(self.seconds)

    def go_on(self, seconds: float) -> None:
        """Let time pass, with all rounds that it has."""
        self.seconds += seconds
        while (self._polled + 1) * PERIOD <= self.seconds:
            self._polled += 1
            self._poll(self._polled * PERIOD, self._polled)

    def _poll(self, moment: float, turn: int) -> None:
        reads = [
            read_of(group, moment + place / 100, turn * 10 + place, turn / 4, turn % 3 == 0)
            for place, group in enumerate(DEVICES)
        ]
        commit = self.writer.commit(reads, [], at(moment + 1))
        for read in reads:
            for point, value in zip(read.points, read.values, strict=True):
                self.lines.take((read.device, point, read.time), value, commit.number)


async def down_for_an_hour(folder: Path, receiver: Receiver, sink: Sink, *, every: int = 1) -> None:
    """Deliver, stop the server for an hour of the plant, start it, and deliver the rest.

    Args:
        folder, receiver, sink: of the store, what is judged, and what sends to it.
        every: makes each pause so many times longer where an attempt takes a tenth of a second.
    """
    with StoreWriter(folder, StoreOptions(seals=False), now=NOON) as writer:
        plant = Plant(writer)
        attempts = 0

        async def deliver(step: Callable[[float], float | None]) -> None:
            """Deliver; in each pause ``step`` gets its seconds and says how many pass, None for the end."""
            ended = asyncio.Event()

            async def pause(seconds: float) -> None:
                passing = step(seconds)
                if passing is None:
                    ended.set()
                    await asyncio.Event().wait()
                else:
                    await asyncio.to_thread(plant.go_on, passing)

            delivery._pause = pause
            task = asyncio.create_task(delivery.run())
            waiting = asyncio.create_task(ended.wait())
            await asyncio.wait([task, waiting], return_when=asyncio.FIRST_COMPLETED)
            for each in (task, waiting):
                each.cancel()
            await asyncio.gather(task, waiting, return_exceptions=True)
            assert ended.is_set(), task

        def until_two_minutes(seconds: float) -> float | None:
            return PERIOD if plant.seconds < 120 or delivery.status().cursor < len(plant.lines.order) / 12 else None

        def through_the_hour(seconds: float) -> float | None:
            nonlocal attempts
            attempts += 1
            assert seconds <= PAUSE_LIMIT
            return every * seconds if plant.seconds < begin + HOUR else None

        def until_all_is_sent(seconds: float) -> float | None:
            return 0.0 if delivery.status().sent < len(plant.lines.order) else None

        options = DeliveryOptions(age=0.0, most=1000)
        delivery = Delivery("sink", sink, folder, writer.manifest, options, now=plant.now)
        await deliver(until_two_minutes)
        before = delivery.status()
        assert before.error is None
        receiver.server.stop()
        begin = plant.seconds
        plant.go_on(PERIOD)
        await deliver(through_the_hour)
        assert delivery.status().error is not None
        assert delivery.status().sent == before.sent
        assert attempts >= HOUR / PAUSE_LIMIT / every
        receiver.server.start()
        await deliver(until_all_is_sent)
        assert (delivery.status().error, delivery.status().lost, delivery.status().set_aside) == (None, 0, 0)
        assert len(plant.lines.order) >= HOUR / PERIOD * 12
    found = await asyncio.to_thread(lambda: list(receiver.problems(plant.lines)))
    assert found[:10] == []


async def test_a_broker(tmp_path: Path) -> None:
    pytest.importorskip("aiomqtt")
    with durable_mosquitto(tmp_path) as server:
        sink = MqttSink("127.0.0.1", server.port, topic="plant/{device}", timeout=5.0)
        await down_for_an_hour(tmp_path / "store", await asyncio.to_thread(MqttReceiver, server), sink, every=5)


async def test_a_stream(tmp_path: Path) -> None:
    pytest.importorskip("nats")
    with nats_server(tmp_path) as server:
        sink = NatsSink(f"nats://127.0.0.1:{server.port}", subject="plant.{device}", stream="PLANT", timeout=5.0)
        await down_for_an_hour(tmp_path / "store", NatsReceiver(server), sink, every=10)


@pytest.fixture
def database() -> Iterator[PostgresqlServer]:
    pytest.importorskip("asyncpg")
    with PostgresqlServer() as server:
        yield server


async def test_a_database(database: PostgresqlServer, tmp_path: Path) -> None:
    sink = PostgresqlSink(database.url, password=database.PASSWORD, table="outage", timeout=10.0)
    await down_for_an_hour(tmp_path / "store", PostgresqlReceiver(database, tmp_path), sink, every=5)
