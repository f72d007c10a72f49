"""Samples into a store, per second of CPU time: bare SQLite, our writer, our committer with sealing. Prints JSON.

    store.py ROUNDS

1. 400 reads of 50 points in each commit: 20 000 rows. Values have one decimal and drift; 1 % are uncertain.
2. Bare: the same rows, made before, inserted by one `executemany` for each commit into a table with the same columns
   and key, in WAL mode. It is what SQLite and Python's module for it take at least.
3. Each figure is CPU time of the process, all threads together, and of the one that seals; the best round counts.
"""

import json
import random
import resource
import shutil
import sqlite3
import sys
import tempfile
import time
from pathlib import Path

from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.sealing import can_seal
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

BEGIN = 1_800_000_000 * 10**9
DEVICES, POINTS, COMMITS = 400, 50, 60
TABLE = """CREATE TABLE samples (time INTEGER NOT NULL, point INTEGER NOT NULL, value, reason INTEGER NOT NULL,
half_width INTEGER NOT NULL, commit_number INTEGER NOT NULL, PRIMARY KEY (time, point)) WITHOUT ROWID"""


def commits() -> list[list[SampleBatch]]:
    """What is stored: for each commit, one read of each device."""
    chance = random.Random(7)
    groups = [PointGroup(f"meter-{number}", tuple(f"point-{p}" for p in range(POINTS))) for number in range(DEVICES)]
    values = [[round(chance.uniform(0, 400), 1) for _ in range(POINTS)] for _ in groups]
    found = []
    for commit in range(COMMITS):
        batches = []
        for index, group in enumerate(groups):
            now = values[index] = [round(value + chance.choice((0, 0, 0.1, -0.1)), 1) for value in values[index]]
            uncertain = chance.random() < 0.01
            moment = BEGIN + commit * 10**9 + index * 2_000_000
            batches.append(SampleBatch(group, moment, 4_321_000, now, 2 if uncertain else 0))
        found.append(batches)
    return found


def cpu() -> float:
    """CPU seconds of this process and of those that it started and that ended: sealing is one."""
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def bare(folder: Path, work: list[list[SampleBatch]]) -> dict[str, float]:
    rows = [
        [
            (batch.time, index * POINTS + point, value, batch.reasons, batch.half_width, number)
            for index, batch in enumerate(batches)
            for point, value in enumerate(batch.values)
        ]
        for number, batches in enumerate(work)
    ]
    database = sqlite3.connect(folder / "bare.sqlite", isolation_level=None)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA synchronous=NORMAL")
    database.execute(TABLE)
    before = cpu()
    for each in rows:
        database.execute("BEGIN")
        database.executemany("INSERT INTO samples VALUES (?, ?, ?, ?, ?, ?)", each)
        database.execute("COMMIT")
    database.close()
    return {"rows/s": sum(map(len, rows)) / (cpu() - before)}


def written(folder: Path, work: list[list[SampleBatch]]) -> dict[str, float]:
    writer = StoreWriter(folder / "written", StoreOptions(seals=False), now=BEGIN)
    before = cpu()
    for number, batches in enumerate(work):
        writer.commit(batches, [], BEGIN + number * 10**9)
    writer.close(BEGIN)
    rows = DEVICES * POINTS * COMMITS
    used = cpu() - before
    size = sum(path.stat().st_size for path in (folder / "written" / "segments").iterdir())
    return {"rows/s": rows / used, "bytes/row": size / rows}


def committed(folder: Path, work: list[list[SampleBatch]]) -> dict[str, float]:
    """As `busway collect` does: batches one by one, a thread that commits, then the segment is sealed."""
    writer = StoreWriter(folder / "committed", now=BEGIN)
    committer = Committer(writer, now=lambda: BEGIN + COMMITS * 10**9)
    before = cpu()
    for batches in work:
        for batch in batches:
            committer.add(batch)
        while committer.status().waiting > 200_000:
            time.sleep(0.005)
    committer.flush(60)
    stored = cpu() - before
    writer.roll()
    middle = cpu()
    writer.seal_closed()
    sealed = cpu() - middle
    rows = DEVICES * POINTS * COMMITS
    found = {"rows/s": rows / stored, "sealing rows/s": rows / sealed, "with sealing rows/s": rows / (stored + sealed)}
    size = sum(path.stat().st_size for path in (folder / "committed" / "segments").glob("*.parquet"))
    found["sealed bytes/row"] = size / rows
    committer.close()
    store = Store(folder / "committed")
    store.read("meter-8/point-1")  # loads what pyarrow loads at first
    before = cpu()
    count = len(store.read("meter-7/*"))
    found["read rows/s, one device"] = count / (cpu() - before)
    before = cpu()
    store.read(bucket=10.0)
    found["rows/s into buckets"] = rows / (cpu() - before)
    return found


def main() -> None:
    work = commits()
    best: dict[str, dict[str, float]] = {}
    for _ in range(int(sys.argv[1])):
        for measure in (bare, written, *([committed] if can_seal() else [])):
            folder = Path(tempfile.mkdtemp(prefix="busway-bench-"))
            try:
                found = measure(folder, work)
            finally:
                shutil.rmtree(folder)
            known = best.setdefault(measure.__name__, found)
            known.update((name, max(value, known[name])) for name, value in found.items() if "rows/s" in name)
    print(json.dumps(best))


if __name__ == "__main__":
    main()
