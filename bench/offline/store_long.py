"""Samples into a store for minutes while a page reads it: rate, largest write-ahead log, memory. Prints JSON.

    store_long.py SECONDS CORE_OF_THE_PAGE

1. As `busway collect` does: batches one by one, a thread that commits, another that has finished segments sealed, by
   processes on the same core. 400 devices of 50 points; times are those of the wall clock.
2. No more is stored than can be sealed: while two finished segments wait, nothing is added. What is left at the end is
   sealed too, and its CPU time counts.
3. Beside it, on another core, a program reads as a page with six trends and one device does, all the time.
4. The rate is samples by CPU time of this process and of those that seal. What a batch costs until it is added counts.
"""

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from busway.apps.collector.samples import SampleBatch
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.writer import StoreOptions, StoreWriter
from offline.store import BEGIN, DEVICES, POINTS, commits, cpu

MOST_WAITING, MOST_UNSEALED = 200_000, 2
LOOK_EVERY = 0.1
KEEP = 4_000_000_000
"""Bytes of the store: what is older is dropped meanwhile, as in a plant that runs for years."""
PAGE = """
import json, os, sqlite3, sys, time
from busway.apps.collector.store.store_reader import Store
os.sched_setaffinity(0, {int(sys.argv[3])})
until, store, times = time.monotonic() + float(sys.argv[2]), Store(sys.argv[1]), []
failures = 0
trends = [f"meter-{n}/point-{n}" for n in range(6)]
while time.monotonic() < until:
    before = time.monotonic()
    try:
        assert len(store.read(trends, since="10m", bucket=2.0)), "no trend"
        store.read("meter-7/*", since="10s")
    except sqlite3.Error as error:
        print(error, file=sys.stderr)
        failures += 1
    times.append(time.monotonic() - before)
    time.sleep(0.5)
ordered = sorted(times)
found = {"looks": len(times), "failures": failures, "median": ordered[len(times) // 2], "slowest": ordered[-1]}
print(json.dumps(found))
"""


@dataclass
class Seen:
    """What is looked at ten times a second: the log, memory, finished segments; and the rate of each minute."""

    folder: Path
    largest_log: int = 0
    unsealed: int = 0
    most_unsealed: int = 0
    memory: list[int] = field(default_factory=list)

    def look(self) -> None:
        logs, finished = 0, 0
        for path in (self.folder / "segments").iterdir():
            with suppress(FileNotFoundError):
                logs = max(logs, path.stat().st_size if path.name.endswith("-wal") else 0)
                finished += path.suffix == ".sqlite"
        self.largest_log = max(self.largest_log, logs)
        self.unsealed = finished - 1
        self.most_unsealed = max(self.most_unsealed, self.unsealed)
        self.memory.append(resident())

    def growth(self) -> float:
        """Growth of memory in bytes, from the first tenth of the time to the last."""
        tenth = max(1, len(self.memory) // 10)
        return statistics.median(self.memory[-tenth:]) - statistics.median(self.memory[:tenth])

    def until(self, ended: threading.Event) -> None:
        while not ended.wait(LOOK_EVERY):
            self.look()


def resident() -> int:
    """Bytes of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def store_for(seconds: float, folder: Path, page_core: int) -> dict[str, object]:
    work = commits()
    began_with = resident()
    writer = StoreWriter(folder / "long", StoreOptions(retention=Retention(size=KEEP)), now=time.time_ns())
    committer = Committer(writer)
    seen, ended = Seen(folder / "long"), threading.Event()
    looking = threading.Thread(target=seen.until, args=(ended,))
    _feed(committer, work, lambda: True, rounds=1)  # points, modules
    committer.flush(60)
    first = resident()
    page = subprocess.Popen(
        [sys.executable, "-c", PAGE, folder / "long", str(seconds), str(page_core)], stdout=subprocess.PIPE
    )
    looking.start()
    before, begin = cpu(), time.monotonic()
    rows = 0
    minutes: list[float] = []
    try:
        while time.monotonic() - begin < seconds:
            used, since = cpu(), time.monotonic()
            length = min(60.0, seconds)
            made = _feed(
                committer,
                work,
                lambda until=since + length: time.monotonic() < until,  # type: ignore[misc]
                may=lambda: seen.unsealed <= MOST_UNSEALED,
            )
            rows += made
            minutes.append(made / (cpu() - used))
        committer.flush(60)
        took = time.monotonic() - begin
        writer.roll()
        writer.seal_closed()
        used = cpu() - before
    finally:
        ended.set()
        looking.join()
        said = page.communicate(timeout=120)[0]
    committer.close()
    return {
        "rows": rows,
        "rows/s": rows / used,
        "rows/s, wall": rows / took,
        "core": used / took,
        "slowest minute, rows/s": min(minutes),
        "median minute, rows/s": statistics.median(minutes),
        "largest log": seen.largest_log,
        "most finished segments that waited": seen.most_unsealed,
        "memory at first": first,
        "memory at most": max(seen.memory),
        "memory at last": seen.memory[-1],
        "growth/point": seen.growth() / (DEVICES * POINTS),
        "memory before the store": began_with,
        "lost": committer.status().lost,
        "page": json.loads(said),
        "load": os.getloadavg(),
    }


def _feed(
    committer: Committer,
    work: list[list[SampleBatch]],
    goes_on: Callable[[], bool],
    *,
    may: Callable[[], bool] = lambda: True,
    rounds: int | None = None,
) -> int:
    """Add batches with times of now, as long as it is wanted; how many samples."""
    rows = number = 0
    while goes_on() and number != rounds:
        if committer.status().waiting > MOST_WAITING or not may():
            time.sleep(0.005)
            continue
        batches = work[number % len(work)]
        shift = time.time_ns() - BEGIN - number % len(work) * 10**9
        for index, batch in enumerate(batches):
            at = batch.time + shift - index * 1_999_000  # a microsecond apart
            committer.add(SampleBatch(batch.group, at, batch.half_width, batch.values, batch.reasons))
            rows += len(batch)
        number += 1
    return rows


def main() -> None:
    seconds, page_core = float(sys.argv[1]), int(sys.argv[2])
    folder = Path(tempfile.mkdtemp(prefix="busway-bench-"))
    try:
        print(json.dumps(store_for(seconds, folder, page_core)))
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
