"""Processor time that a piece of work takes, as a machine of one known speed would take it.

Machines differ in speed by a factor of two, and one that others share is slower now and then. So a bound on time is
compared with what the work takes beside a fixed piece of work: the time is divided by how much longer that one takes.
"""

import gc
import time
from collections.abc import Callable

ATTEMPTS = 6
"""A processor that others use too is slower now and then: the best of some attempts is what the work costs."""

REFERENCE_SECONDS = 0.016
"""What `reference` takes on the machine that the bounds are meant for, while nothing else runs there."""


def reference() -> float:
    """Seconds of processor time for a fixed piece of work: how fast the machine is at this moment."""
    began = time.process_time()
    total = 0
    for number in range(400_000):
        total += number & 0xFF
    return time.process_time() - began


def slowness() -> float:
    """How many times longer than on the machine of the bounds things take here now; at least 1."""
    return max(reference() / REFERENCE_SECONDS, 1.0)


def cpu_seconds(work: Callable[[], object], most: float) -> float:
    """Seconds of processor time that a call takes, on a machine of reference speed; tried again while it is too much.

    What the tests before it left on the heap is not looked through meanwhile: it is not part of the work.
    """
    best = float("inf")
    gc.collect()
    gc.freeze()
    try:
        for _ in range(ATTEMPTS):
            before = slowness()
            began = time.process_time()
            work()
            took = time.process_time() - began
            best = min(best, took / ((before + slowness()) / 2))
            if best < most:
                break
    finally:
        gc.unfreeze()
    return best
