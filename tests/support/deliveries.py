"""Deliveries for the tests of sinks: run until everything has arrived."""

import asyncio
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from collected import at, meter_read

from busway.apps.collector.sinks.delivery import Delivery, DeliveryOptions
from busway.apps.collector.sinks.interface import Sink, SinkDown, SinkRefused
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule


async def short_pause(seconds: float) -> None:
    """Waits at most 20 ms."""
    await asyncio.sleep(min(seconds, 0.02))


def delivery_to(
    sink: Sink,
    writer: StoreWriter,
    options: DeliveryOptions | None = None,
    name: str = "sink",
    *,
    points: Collection[tuple[str, str]] | None = None,
    point_rules: Mapping[tuple[str, str], ReportRule] | None = None,
) -> Delivery:
    return Delivery(
        name,
        sink,
        writer.folder,
        writer.manifest,
        options or DeliveryOptions(age=0.0),
        points=points,
        point_rules=point_rules,
        now=lambda: at(1000),
        pause=short_pause,
    )


async def run_until(delivery: Delivery, done: Callable[[], bool], seconds: float = 60.0) -> None:
    """Deliver until something is so; looked at only while the delivery pauses, so that its cursor has moved."""
    reached = asyncio.Event()

    async def look_and_pause(pause: float) -> None:
        if done():
            reached.set()
        await short_pause(pause)

    delivery._pause = look_and_pause
    task = asyncio.create_task(delivery.run())
    try:
        async with asyncio.timeout(seconds):
            await asyncio.wait([task, waiting := asyncio.create_task(reached.wait())], return_when="FIRST_COMPLETED")
    finally:
        task.cancel()
        waiting.cancel()
        await asyncio.gather(task, waiting, return_exceptions=True)
    assert reached.is_set()


def commit_reads(writer: StoreWriter, first: int, count: int) -> None:
    """Commit reads of the meter, one second and one commit each; the current is the number of the read."""
    for number in range(first, first + count):
        writer.commit([meter_read(number, number)], [], at(number))


class RecordingSink:
    """Takes samples and keeps them; fails as it is told to."""

    def __init__(self, poison: Callable[[CommittedSample], bool] = lambda sample: False) -> None:
        self.taken: list[CommittedSample] = []
        self.batches: list[int] = []
        self.is_down = False
        self.takes_then_fails = 0
        self.opened = self.closed = 0
        self._poison = poison

    async def open(self) -> None:
        self.opened += 1
        if self.is_down:
            raise SinkDown("no answer")

    async def close(self) -> None:
        self.closed += 1

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        if self.is_down:
            raise SinkDown("no answer")
        if any(map(self._poison, samples)):
            raise SinkRefused("a value is refused")
        self.taken += samples
        self.batches.append(len(samples))
        if self.takes_then_fails:
            self.takes_then_fails -= 1
            raise SinkDown("the connection ended before the answer")


def delivered_once(samples: Sequence[CommittedSample]) -> list[CommittedSample]:
    """The samples without repetitions, in the order in which each came first."""
    return list({(sample.device, sample.point, sample.time): sample for sample in reversed(samples)}.values())[::-1]


def assert_in_order(samples: Sequence[CommittedSample]) -> None:
    """Each point's samples come in the order of commits and times, repetitions aside."""
    by_point: dict[tuple[str, str], list[tuple[int, int]]] = {}
    for sample in delivered_once(samples):
        by_point.setdefault((sample.device, sample.point), []).append((sample.commit, sample.time))
    for places in by_point.values():
        assert places == sorted(places)


def folder_of(tmp_path: Path) -> Path:
    return tmp_path / "store"
