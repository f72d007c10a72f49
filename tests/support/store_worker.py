"""A program that writes a store and says what it has handed on; ended at a step, or by the test that started it.

    python store_worker.py FOLDER [--end-at STEP --times N] [--durability power] [--sync]
        [--commits N] [--every SECONDS]

What was handed on is a line of ``handed-on`` in the folder: number of the read, written after its commit.
"""

import argparse
import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, os.fspath(Path(__file__).parent))

from collected import at, meter_read

from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

READS_PER_COMMIT = 3
COMMITS_PER_SEGMENT = 4
SECONDS_PER_COMMIT = 10
HANDED_ON = "handed-on"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--end-at")
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--durability", default="process")
    parser.add_argument("--commits", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--keep", type=float)
    parser.add_argument("--sync", action="store_true", help="sync before anything is handed on")
    parser.add_argument(
        "--every", type=float, help="commit by the committer's thread, whose clock goes on so far each time"
    )
    asked = parser.parse_args()
    left = asked.times

    def step(name: str) -> None:
        nonlocal left
        if name == asked.end_at:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    options = StoreOptions(durability=asked.durability, retention=Retention(age=asked.keep))
    writer = StoreWriter(asked.folder, options, now=at(asked.first * SECONDS_PER_COMMIT), step=step)
    handed_on = os.open(asked.folder / HANDED_ON, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.fsync(handed_on)
    if asked.every is not None:
        commit_as_the_collector_does(writer, asked.commits, asked.every, handed_on)
        return
    for number in range(asked.first, asked.first + asked.commits):
        begin = number * SECONDS_PER_COMMIT
        reads = [meter_read(begin + index, number) for index in range(READS_PER_COMMIT)]
        writer.commit(reads, [], at(begin + SECONDS_PER_COMMIT / 2))
        if asked.sync:
            writer.sync()
        os.write(handed_on, f"{number}\n".encode())
        step("handed-on")
        if number % COMMITS_PER_SEGMENT == COMMITS_PER_SEGMENT - 1:
            writer.roll()
            writer.seal_closed()
            writer.apply_retention(at(begin))
    writer.close(at((asked.first + asked.commits) * SECONDS_PER_COMMIT))


def commit_as_the_collector_does(writer: StoreWriter, commits: int, every: float, handed_on: int) -> None:
    """Commit by the committer, one commit every so many seconds of its clock; it decides when the log is synced."""
    seconds = [0.0]
    number = 0

    def now() -> int:
        return at((number + 0.5) * SECONDS_PER_COMMIT)

    committer = Committer(writer, now=now, interval=every, clock=lambda: seconds[0])
    for number in range(commits):
        with committer._changed:  # all reads at once, so that they are one commit
            for index in range(READS_PER_COMMIT):
                committer.add(meter_read(number * SECONDS_PER_COMMIT + index, number))
        assert committer.flush(60.0)
        os.write(handed_on, f"{number}\n".encode())
        seconds[0] += every
    os._exit(0)


if __name__ == "__main__":
    main()
