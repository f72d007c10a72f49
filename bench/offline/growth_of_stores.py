"""Times a sample that is committed, sealed and read from a sealed part, by how many points the store has.

Part of `offline.growth`. The figure is ns of CPU time of one sample, that of the process that seals included.

1. A commit has the samples of 20 reads of 50 points each, of one device after the other.
2. A segment that is sealed has 200 000 samples, of few points or of many.
3. A sealed part that is read has 20 samples of each point; one device of 50 points is read.
4. Stores are in a temporary folder. Their times are made up, so that no segment ends in the middle.
"""

import random
import resource
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from functools import partial
from itertools import count, islice
from pathlib import Path

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.store.sealing import can_seal
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter
from offline.timing import quickest

BEGIN = 1_800_000_000 * 10**9
DEVICE = 50
"""Points of a device."""
POINTS = (500, 5000, 50_000)
READ_POINTS = (500, 5000, 25_000)
"""Points of a sealed part that is read; more take long to be stored."""
TIMED = 2
"""Rows that are timed by turns; those that are sealed are timed once."""
READS = 20
SEALED = 200_000
KEPT = 20
MILLISECOND = 1_000_000
Step = Callable[[], object]


class Growing:
    """A store with so many points; closed at the end. Attributes: ``writer``."""

    def __init__(self, folder: Path, points: int, samples: int) -> None:
        self.writer = StoreWriter(folder, now=BEGIN)
        self._reads = reads_of(points)
        for _ in range(samples // (READS * DEVICE)):
            self.commit()

    def commit(self) -> None:
        self.writer.commit(list(islice(self._reads, READS)), [], BEGIN)

    def seal(self) -> None:
        self.writer.roll()
        self.writer.seal_closed()

    def close(self) -> None:
        self.writer.close(BEGIN)


def reads_of(points: int) -> Iterator[SampleBatch]:
    """Reads without end, of one device after the other, a millisecond apart."""
    chance, names = random.Random(points), tuple(f"point-{place}" for place in range(DEVICE))
    groups = [PointGroup(f"meter-{number}", names) for number in range(points // DEVICE)]
    values = [[round(chance.uniform(0, 400), 1) for _ in range(DEVICE)] for _ in range(100)]
    for number in count():
        yield SampleBatch(
            groups[number % len(groups)], BEGIN + number * MILLISECOND, 4_321_000, values[number % 100], 0
        )


def committed(folder: Path, running: ExitStack) -> dict[int, tuple[Step, float]]:
    """Samples that are committed."""
    stores = {
        points: running.enter_context(closing(Growing(folder / str(points), points, points))) for points in POINTS
    }
    return {points: (store.commit, READS * DEVICE) for points, store in stores.items()}


def read(folder: Path) -> dict[int, tuple[Step, float]]:
    """Samples that are read from a sealed part."""
    found: dict[int, tuple[Step, float]] = {}
    for points in READ_POINTS:
        with closing(Growing(folder / str(points), points, KEPT * points)) as growing:
            growing.seal()
        found[points] = (partial(Store(folder / str(points)).read, "meter-7/*"), KEPT * DEVICE)
    return found


def sealed(folder: Path) -> dict[int, float]:
    """Nanoseconds of a sample that is sealed."""
    found = {}
    for points in POINTS:
        with closing(Growing(folder / str(points), points, SEALED)) as growing:
            before = cpu()
            growing.seal()
            found[points] = (cpu() - before) / SEALED * 1e9
    return found


def cpu() -> float:
    """CPU seconds of this process and of those that it started and that ended."""
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def timed(made: dict[int, tuple[Step, float]], seconds: float) -> dict[int, float]:
    best = quickest({str(size): step for size, (step, _) in made.items()}, seconds)
    return {size: best[str(size)] / per for size, (_, per) in made.items()}


def measured(seconds: float) -> dict[str, dict[int, float]]:
    """Nanoseconds by setting and size; sealed parts are left out where nothing can seal."""
    with ExitStack() as running:
        folder = Path(running.enter_context(tempfile.TemporaryDirectory(prefix="busway-bench-")))
        found = {"points of a store, sample committed": timed(committed(folder / "committed", running), seconds)}
        if can_seal():
            found["points of a store, sample sealed"] = sealed(folder / "sealed")
            found["points of a sealed part, sample read"] = timed(read(folder / "read"), seconds)
        return found
