"""What the tests of frames share: a clock of their own processor time."""

import time
from collections.abc import Callable

import pytest

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


@pytest.fixture
def cpu_seconds() -> Callable[[Callable[[], None], float], float]:
    """Seconds of processor time that a call takes, on a machine of reference speed; tried again while it is too much.

    A machine that is slower, or shared at the moment, takes longer for everything: the time is divided by how much
    longer the reference takes just before and just after.
    """

    def measure(work: Callable[[], None], most: float) -> float:
        best = float("inf")
        for _ in range(ATTEMPTS):
            before = reference()
            began = time.process_time()
            work()
            took = time.process_time() - began
            slowness = max((before + reference()) / 2 / REFERENCE_SECONDS, 1.0)
            best = min(best, took / slowness)
            if best < most:
                break
        return best

    return measure
