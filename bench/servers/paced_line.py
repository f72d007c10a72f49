"""A serial line in a process of its own: what passes on it takes its time, and can be told afterwards.

Run from `bench/`: python -m servers.paced_line BAUD

1. `line PATH PATH` on the first line: the ports of the master and of the server, 8E1.
2. SIGUSR1 forgets what has passed: `forgotten 0`.
3. SIGUSR2 tells the medians of the silences before replies and before requests, in seconds, and how many replies there
   were: `silences R Q N`.
"""

import itertools
import os
import signal
import statistics
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from harness.priority import WIRE, real_time

from busway.testing.line import PacedLine

MASTER = 0


def main(baud: int) -> None:
    real_time(WIRE)
    with on_all_cores():  # the line measures how long a pty takes from one core to another, as it will be used
        line = PacedLine(ports=2, baud=baud)
    with line:

        def forget(number: int, frame: FrameType | None) -> None:
            line.forget()
            print("forgotten 0", flush=True)

        def tell(number: int, frame: FrameType | None) -> None:
            before_replies, before_requests = silences(line)
            print(
                f"silences {statistics.median(before_replies or [0]):.6f} "
                f"{statistics.median(before_requests or [0]):.6f} {len(before_replies)}",
                flush=True,
            )

        signal.signal(signal.SIGUSR1, forget)
        signal.signal(signal.SIGUSR2, tell)
        print("line", *line.paths, flush=True)
        threading.Event().wait()


@contextmanager
def on_all_cores() -> Iterator[None]:
    """Threads of this program have the cores of the machine in this block, and its own afterwards."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    yield
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), mine)


def silences(line: PacedLine) -> tuple[list[float], list[float]]:
    """Seconds of silence before each reply, and before each request that follows one."""
    found = line.transmissions()
    replies, requests = [], []
    for earlier, later in itertools.pairwise(found):
        if earlier.port != later.port:
            (requests if later.port == MASTER else replies).append(later.begin - earlier.end)
    return replies, requests


main(int(sys.argv[1]))
