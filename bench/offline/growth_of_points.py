"""Times a value that is read, a point that is planned and a sample that is put into a message, by how many there are.

Part of `offline.growth`. Sizes of a row take turns; the figure is ns of CPU time of one value, point or sample.

1. A polled value is requested, decoded and put into a batch; the link answers at once (`offline.collect`).
2. Plans are made of points that are equally scattered, whatever their number, for a line of 9600 baud.
3. A message has the samples of devices of 50 points each, as the outbox of a fleet sends them; or 1000 samples of few
   points or of many.
4. `read_many` reads float32, uint16 and bits of registers that follow one another; the device answers at once.
"""

import asyncio
import random
import time
from collections.abc import Callable

import busway
from busway.apps.collector.cost import baud_cost
from busway.apps.collector.plan import PlainItem, plan_reads
from busway.apps.collector.poller import LinkPoller
from busway.apps.collector.samples import SampleBatch
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.messages import SampleMessage
from busway.codes import Table
from busway.points import ReadRules
from offline.collect import HALF, poller, profile
from offline.timing import quickest
from offline.wire import Device, MemoryLoop

DEVICES = (1, 10, 100, 1000)
POINTS = (100, 1000, 10_000, 50_000)
SAMPLES = (250, 500, 1000, 2000)
MESSAGE, MESSAGE_POINTS = 1000, (10, 50, 250, 1000)
"""Samples of a message, and the points that they are of."""
READ_POINTS = (100, 300, 1000, 2000)
KINDS = {"float32": 2, "uint16": 1, "bit:3": 1}
"""Types of points that are read, and their registers."""
VALUES = 500
"""Values of a step: those of two devices."""
SCATTER = 1.3
"""Registers for each point of a plan."""
Step = Callable[[], object]


def polled(size: int) -> tuple[Step, float]:
    """Values of so many devices of 250 points each."""
    loop, taken = asyncio.new_event_loop(), 0

    def take(batch: SampleBatch) -> None:
        nonlocal taken
        taken += len(batch)

    engine = poller(profile(), take, devices=size)

    async def until(values: int) -> None:
        while taken < values:
            await turn_of(engine)

    loop.run_until_complete(until(4 * HALF * size))
    return lambda: loop.run_until_complete(until(taken + VALUES)), VALUES


async def turn_of(engine: LinkPoller) -> None:
    turn = engine.schedule.next(time.monotonic())
    if not isinstance(turn, float):
        await engine.make(turn)


def planned(size: int) -> tuple[Step, float]:
    """A plan of so many points."""
    source = random.Random(size)
    items = [
        PlainItem(Table.HOLDING_REGISTERS, start, source.choice((1, 2)), start)
        for start in source.sample(range(int(size * SCATTER)), size)
    ]
    rules, cost = ReadRules(bridge=True), baud_cost(9600)
    return lambda: plan_reads(items, rules, cost), size


def packed(size: int) -> tuple[Step, float]:
    """A message with so many samples."""
    return message(size, size).encode, size


def packed_points(size: int) -> tuple[Step, float]:
    """A message with samples of so many points."""
    return message(MESSAGE, size).encode, MESSAGE


def message(samples: int, points: int) -> SampleMessage:
    chance = random.Random(samples)
    rows = [
        CommittedSample(
            place // 1000,
            f"meter-{place % points // 50}",
            f"point-{place % points % 50}",
            place,
            4_321_000,
            chance.random(),
            0,
            "V",
        )
        for place in range(samples)
    ]
    return SampleMessage("west", "store", "hall", Epoch(1, 7), 3, 1, 0, rows)


def read_together(size: int) -> tuple[Step, float]:
    """Values of so many points of a device, read by one call of `read_many`."""
    wanted: dict[str, busway.NamedRead] = {}
    kinds, at = list(KINDS.items()), 1
    for number in range(size):
        kind, registers = kinds[number % len(kinds)]
        wanted[f"{number} {kind}"] = (f"4x{at}", kind)
        at += registers
    loop = MemoryLoop()
    loop.listeners[1] = Device
    link = busway.open("tcp://127.0.0.1:1", max_transactions=16)
    loop.run_until_complete(link.__aenter__())
    unit = link.unit(1)

    def step() -> None:
        loop.run_until_complete(unit.read_many(wanted))

    step()
    return step, size


SETTINGS: dict[str, tuple[Callable[[int], tuple[Step, float]], tuple[int, ...]]] = {
    "devices of a collector, value polled": (polled, DEVICES),
    "points of a plan": (planned, POINTS),
    "samples of a message": (packed, SAMPLES),
    "points of a message of 1000 samples": (packed_points, MESSAGE_POINTS),
    "points of a device, value read by read_many": (read_together, READ_POINTS),
}


def measured(seconds: float, *, quick: bool) -> dict[str, dict[int, float]]:
    """Nanoseconds by setting and size."""
    found = {}
    for setting, (make, sizes) in SETTINGS.items():
        made = {size: make(size) for size in (sizes[::2] if quick else sizes)}
        best = quickest({str(size): step for size, (step, _) in made.items()}, seconds)
        found[setting] = {size: best[str(size)] / per for size, (_, per) in made.items()}
    return found
