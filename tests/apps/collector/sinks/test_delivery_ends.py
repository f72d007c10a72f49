"""An end at each moment of what a sink is sent: the next start sends nothing of it again, and leaves nothing out."""

import asyncio
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from collected import PUMP, at, read_of
from waiting import wait_until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.sinks.delivery import ASIDE, Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import SinkRefused
from busway.apps.collector.sinks.sink_thread import SinkThread
from busway.apps.collector.store.committed_samples import CommitReader, CommittedAlarm, CommittedSample
from busway.apps.collector.store.manifest import Manifest
from busway.apps.collector.store.writer import StoreWriter

REFUSED = at(3)


class StoppedSink:
    """Takes everything but one sample and one event; the process ends at one of its steps, which goes on then."""

    def __init__(self, stops_at: int, wait: Any) -> None:
        self.steps, self.stops_at, self.wait = 0, stops_at, wait
        self.taken: list[CommittedSample] = []
        self.alarms: list[CommittedAlarm] = []

    async def step(self) -> None:
        self.steps += 1
        if self.steps == self.stops_at:
            await self.wait()

    async def open(self) -> None:
        await self.step()

    async def close(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        await self.step()
        if any(each.time == REFUSED for each in samples):
            raise SinkRefused("refused")
        self.taken += samples
        await self.step()

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        await self.step()
        if any(each.event.at == REFUSED for each in alarms):
            raise SinkRefused("refused")
        self.alarms += alarms
        await self.step()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[StoreWriter]:
    """Samples that are equal but for their times, and as many events of alarms."""
    with StoreWriter(tmp_path, now=at(0)) as writer:
        for second in range(1, 6):
            alarm = AlarmEvent("pump-1", "speed", "H", AlarmEventKind.RAISED, at(second), 1.0)
            writer.commit([read_of(PUMP, second, 1.0)], [], at(second), [alarm])
        yield writer


@pytest.mark.parametrize("way", ["close", "remove"])
@pytest.mark.parametrize("stops_at", [*range(1, 24), "read", "set_cursor"])
def test_what_was_being_sent_at_an_end_is_not_sent_again_and_nothing_is_left_out(
    store: StoreWriter, monkeypatch: pytest.MonkeyPatch, stops_at: int | str, way: str
) -> None:
    is_there, is_ending = threading.Event(), threading.Event()
    finish = Delivery.finish

    async def note_and_finish(delivery: Delivery, seconds: float) -> None:
        is_ending.set()
        await finish(delivery, seconds)

    async def wait() -> None:
        is_there.set()
        assert await asyncio.to_thread(is_ending.wait, 60)
        await asyncio.sleep(0)

    def stopped(name: str, call: Any) -> Any:
        def call_late(*arguments: Any) -> Any:
            if name == stops_at and not (name == "set_cursor" and arguments[2] == 0):
                is_there.set()
                assert is_ending.wait(60)
            return call(*arguments)

        return call_late

    monkeypatch.setattr(Delivery, "finish", note_and_finish)
    monkeypatch.setattr(CommitReader, "read", stopped("read", CommitReader.read))
    monkeypatch.setattr(Manifest, "set_cursor", stopped("set_cursor", Manifest.set_cursor))
    options = DeliveryOptions(age=0)
    sinks = [StoppedSink(stops_at if isinstance(stops_at, int) else 0, wait), StoppedSink(0, wait)]
    thread = SinkThread(store, {"sink": (sinks[0], options), "equal": (StoppedSink(0, wait), options)})
    wait_until(lambda: is_there.is_set() or store.manifest.cursors()["sink"][0] == store.newest_commit)
    if way == "remove":
        thread.remove("sink")
    thread.close()
    is_ending.set()
    cursor = store.manifest.cursors()["sink"][0]
    assert cursor == store.newest_commit, "what was sent is known to be"
    thread = SinkThread(store, {"sink": (sinks[1], options), "equal": (StoppedSink(0, wait), options)})
    wait_until(lambda: store.manifest.cursors()["sink"][0] == store.newest_commit)
    thread.close()
    assert [each.time for sink in sinks for each in sink.taken] == [at(second) for second in (1, 2, 4, 5)]
    assert [each.event.at for sink in sinks for each in sink.alarms] == [at(second) for second in (1, 2, 4, 5)]
    assert len((store.folder / ASIDE / "sink.jsonl").read_text().splitlines()) == 2
