"""How long a processor of this machine stood still, so that a bound on time is about the program that is measured.

A virtual machine that shares its processors is stopped for some 10 ms again and again. Whatever is asked meanwhile is
answered later by that much, and no program can do anything about it.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

BEAT = 0.0005
"""Seconds between two looks at the clock on each processor."""
PAUSE = 0.0005
"""Seconds that a look may be late before it counts as a pause."""


class MachinePauses:
    """The spans, on `time.perf_counter`, in which at least one processor stood still."""

    def __init__(self) -> None:
        self._spans: list[tuple[float, float]] = []
        self._is_over = threading.Event()

    def lost(self, began: float, ended: float) -> float:
        """Seconds between two moments in which a processor stood still; pauses of two at once count once."""
        total, until = 0.0, began
        for start, end in sorted(self._spans):
            total += max(0.0, min(end, ended) - max(start, until))
            until = max(until, end)
        return total

    def _watch(self, processor: int) -> None:
        os.sched_setaffinity(0, {processor})
        with suppress(
            PermissionError
        ):  # before everything that may run: only a machine that stands still makes it late
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        before = time.perf_counter()
        while not self._is_over.is_set():
            time.sleep(BEAT)
            now = time.perf_counter()
            if now - before > BEAT + PAUSE:
                self._spans.append((before, now))
            before = now


@contextmanager
def machine_pauses() -> Iterator[MachinePauses]:
    """Notes pauses of all processors until the block ends."""
    pauses = MachinePauses()
    watchers = [threading.Thread(target=pauses._watch, args=(each,)) for each in os.sched_getaffinity(0)]
    for watcher in watchers:
        watcher.start()
    try:
        yield pauses
    finally:
        pauses._is_over.set()
        for watcher in watchers:
            watcher.join()
