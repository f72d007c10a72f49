"""Values through poller and store per second of CPU time, plans of many points, memory of a point. Prints JSON.

    collect.py ROUNDS

1. 40 devices of one profile, 250 points each: half 16-bit with a scale, half float32. Each is read in three requests of
   at most 125 registers; the link answers at once with replies made before, so that nothing but the collector works.
2. Polled: schedule, request, decoding, batches. Collected: the same into a store, committed, not sealed.
3. Each figure is CPU time of the process, all threads together; the best of the rounds counts.
"""

import asyncio
import gc
import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from busway.apps.collector.cost import baud_cost, network_cost
from busway.apps.collector.plan import PlainItem, plan_reads
from busway.apps.collector.plan_cache import PlanBook
from busway.apps.collector.poller import LinkPoller
from busway.apps.collector.sample_clock import SampleClock
from busway.apps.collector.samples import SampleBatch
from busway.apps.collector.schedule import LinkSchedule
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.writer import Commit, StoreOptions, StoreWriter
from busway.codes import Table
from busway.pdu.read_items import ReadHoldingRegisters
from busway.points import Conversion, Point, ReadRules
from busway.values import value_type

DEVICES, HALF = 40, 125
WARM_ROUNDS, VALUES = 40, 1_500_000
PERIOD = 0.005  # more than one core can do: rounds are always due, and most are skipped


class Answering:
    """A link that answers at once."""

    def __init__(self) -> None:
        self._replies: dict[int, Any] = {}

    async def run(self, unit: int, requests: Sequence[Any], call_options: Any) -> list[Any]:
        found = []
        for request in requests:
            if request.count not in self._replies:
                # Small numbers: the same as 16 bits, and as floats no NaN.
                self._replies[request.count] = ReadHoldingRegisters.Reply(bytes((0, 7)) * request.count)
            found.append(self._replies[request.count])
        return found


def profile() -> list[Point]:
    """250 points in 375 registers."""
    scale = Conversion(scale=0.1)
    small = [Point(f"i{at}", Table.HOLDING_REGISTERS, at, value_type("int16"), scale) for at in range(HALF)]
    large = [Point(f"f{at}", Table.HOLDING_REGISTERS, HALF + 2 * at, value_type("float32")) for at in range(HALF)]
    return [*small, *large]


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def poller(points: Sequence[Point], take: Callable[[SampleBatch], None], devices: int = DEVICES) -> LinkPoller:
    now = time.monotonic
    made = LinkPoller(
        "bench",
        Answering(),
        LinkSchedule(1.0),
        SampleClock(now(), time.time_ns()),
        take,
        lambda interval: None,
        numbered=True,
        now=now,
    )
    for number in range(devices):
        period = PERIOD * devices / DEVICES  # so that as many due times pass in a second, however many devices
        made.add(f"meter-{number}", 1, PlanBook({"all": points}, ReadRules(), network_cost()), {"all": period})
    return made


async def polled(take: Callable[[SampleBatch], None], finish: Callable[[], object]) -> float:
    """Values per second of CPU time, once plans and decoders are made."""
    count = 0

    def counted(batch: SampleBatch) -> None:
        nonlocal count
        count += len(batch)
        take(batch)

    engine = poller(profile(), counted)

    async def until(values: int) -> None:
        while count < values:
            turn = engine.schedule.next(time.monotonic())
            if not isinstance(turn, float):
                await engine.make(turn)

    await until(WARM_ROUNDS * DEVICES * 2 * HALF)
    finish()
    count = 0
    before = cpu()
    await until(VALUES)
    finish()
    return count / (cpu() - before)


def collected(folder: Path) -> float:
    committer = Committer(StoreWriter(folder, StoreOptions(seals=False), now=time.time_ns()), most_waiting=10**8)
    try:
        return asyncio.run(polled(committer.add, lambda: committer.flush(60)))
    finally:
        committer.close()


def bytes_of_a_point(more: int, *, own: bool) -> float:
    """Memory of plans, decoders, schedule and last values for ``more`` more devices, by their points.

    ``own``: whether each has a profile of its own, whose points, names and limits count too, or all have the same.
    """
    points = profile()
    engine = poller(points, lambda batch: None)
    last = LastValues()
    gc.collect()
    tracemalloc.start()
    for number in range(more):
        points = profile() if own else points
        book = PlanBook({"all": points}, ReadRules(), network_cost())
        limits = {point.name: 3.0 for point in points} if own else None
        engine.add(f"more-{number}", 1, book, {"all": 1.0}, limits=limits)
        device = engine.devices[f"more-{number}"]
        for read in book.plan_for(frozenset({"all"})).reads:
            group = device.compiled(read).group
            values = tuple(number + 0.5 * at for at in range(len(read.items)))
            last.update(Commit(1, 1, [SampleBatch(group, 1, 1, values)], []))
    gc.collect()
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return used / (more * len(points))


def planning(count: int) -> float:
    """Seconds for a plan of scattered points."""
    source = random.Random(count)
    items = [
        PlainItem(Table.HOLDING_REGISTERS, start, source.choice((1, 2)), start)
        for start in source.sample(range(65_530), count)
    ]
    before = time.thread_time()
    plan_reads(items, ReadRules(bridge=True), baud_cost(9600))
    return time.thread_time() - before


def main() -> None:
    found: dict[str, float] = {
        "bytes/point": bytes_of_a_point(200, own=False),
        "bytes/own point": bytes_of_a_point(40, own=True),
    }
    for _ in range(int(sys.argv[1])):
        folder = Path(tempfile.mkdtemp(dir=os.environ.get("TMPDIR")))
        try:
            figures = {
                "polled/s": asyncio.run(polled(lambda batch: None, lambda: None)),
                "collected/s": collected(folder / "data"),
            }
        finally:
            shutil.rmtree(folder)
        for name, value in figures.items():
            found[name] = max(found.get(name, 0.0), value)
        for count in (10_000, 50_000):
            found[f"plan of {count}"] = min(found.get(f"plan of {count}", 1e9), planning(count))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
