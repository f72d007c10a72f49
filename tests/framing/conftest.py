"""What the tests of frames share: a clock of their own processor time."""

import time
from collections.abc import Callable

import pytest

ATTEMPTS = 4
"""A processor that others use too is slower now and then: the best of some attempts is what the work costs."""


@pytest.fixture
def cpu_seconds() -> Callable[[Callable[[], None], float], float]:
    """Seconds of processor time that a call takes; tried again while it took more than it may."""

    def measure(work: Callable[[], None], most: float) -> float:
        best = float("inf")
        for _ in range(ATTEMPTS):
            began = time.process_time()
            work()
            best = min(best, time.process_time() - began)
            if best < most:
                break
        return best

    return measure
