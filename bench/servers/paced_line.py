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
from contextlib import suppress
from types import FrameType

from busway.testing.line import PacedLine

MASTER = 0


def main(baud: int) -> None:
    with suppress(PermissionError, AttributeError):
        # A wire is not late because the machine is busy. Threads that are started from now on inherit this.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    with PacedLine(ports=2, baud=baud) as line:

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


def silences(line: PacedLine) -> tuple[list[float], list[float]]:
    """Seconds of silence before each reply, and before each request that follows one."""
    found = line.transmissions()
    replies, requests = [], []
    for earlier, later in itertools.pairwise(found):
        if earlier.port != later.port:
            (requests if later.port == MASTER else replies).append(later.begin - earlier.end)
    return replies, requests


main(int(sys.argv[1]))
