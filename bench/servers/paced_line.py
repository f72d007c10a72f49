"""Serial lines in a process of their own: what passes on them takes its time, and can be told afterwards.

Run from `bench/`: python -m servers.paced_line BAUD…

1. `line PATH PATH …` on the first line: the ports of the master and of the server of each line, 8E1.
2. SIGUSR1 forgets what has passed, and measures anew how long a pty takes: `forgotten 0`.
3. SIGUSR2 tells the medians of the silences before replies and before requests, in seconds, and how many replies there
   were, on all lines together: `silences R Q N`.
4. All lines take the same time for the way through a pty: figures of two lines can be compared to a microsecond. 20 µs
   less in that measure make a read at 115 200 baud 1 % longer; it swings by as much, and a busy machine makes the way
   longer. So it is taken anew for each turn, and many turns make the swing even out.
"""

import itertools
import os
import signal
import statistics
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

from harness.priority import WIRE, real_time

from busway.testing.line import PacedLine

MASTER = 0


def main(bauds: list[int]) -> None:
    real_time(WIRE)
    with ExitStack() as running:
        lines = [running.enter_context(PacedLine(ports=2, baud=baud)) for baud in bauds]
        agree_on_transit(lines)

        def forget(number: int, frame: FrameType | None) -> None:
            agree_on_transit(lines)
            for line in lines:
                line.forget()
            print("forgotten 0", flush=True)

        def tell(number: int, frame: FrameType | None) -> None:
            before_replies, before_requests = silences(lines)
            print(
                f"silences {statistics.median(before_replies or [0]):.6f} "
                f"{statistics.median(before_requests or [0]):.6f} {len(before_replies)}",
                flush=True,
            )

        signal.signal(signal.SIGUSR1, forget)
        signal.signal(signal.SIGUSR2, tell)
        print("line", *(path for line in lines for path in line.paths), flush=True)
        threading.Event().wait()


def agree_on_transit(lines: list[PacedLine]) -> None:
    """Give all lines what a new one measures now."""
    with on_all_cores(), PacedLine(ports=1) as measured:  # from one core to another, as they are used
        transit = measured._transit
    for line in lines:
        line._transit = transit


@contextmanager
def on_all_cores() -> Iterator[None]:
    """Threads of this program have the cores of the machine in this block, and its own afterwards."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, range(os.cpu_count() or 1))
    yield
    for thread in os.listdir("/proc/self/task"):
        os.sched_setaffinity(int(thread), mine)


def silences(lines: list[PacedLine]) -> tuple[list[float], list[float]]:
    """Seconds of silence before each reply, and before each request that follows one."""
    replies, requests = [], []
    for line in lines:
        for earlier, later in itertools.pairwise(line.transmissions()):
            if earlier.port != later.port:
                (requests if later.port == MASTER else replies).append(later.begin - earlier.end)
    return replies, requests


main([int(baud) for baud in sys.argv[1:]])
