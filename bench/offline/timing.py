"""How long a step takes, in nanoseconds of CPU time of this process.

1. A step is repeated until one measurement lasts `SLICE` seconds; the quickest of several measurements counts: what
   makes it slower is the machine, not the step.
2. Garbage collection does not run meanwhile.
"""

import gc
import math
import time
from collections.abc import Callable, Mapping, Sequence

SLICE = 0.005
"""Seconds."""


def repetitions(step: Callable[[], object]) -> int:
    """How many times a step fits into a slice."""
    times = 1
    while True:
        took = _lasting(step, times)
        if took >= SLICE / 4:
            return max(1, round(times * SLICE / took))
        times *= 4


def quickest(steps: Mapping[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    """Nanoseconds of each step; they take turns until the time is over, twice each at least."""
    counts = {name: repetitions(step) for name, step in steps.items()}
    best = dict.fromkeys(steps, math.inf)
    end = time.monotonic() + seconds
    rounds = 0
    while rounds < 2 or time.monotonic() < end:
        for name, step in steps.items():
            best[name] = min(best[name], _lasting(step, counts[name]) / counts[name] * 1e9)
        rounds += 1
    return best


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The power of the size with which a cost grows: 0 is flat, 1 is in proportion. By least squares of logarithms."""
    across, up = [math.log(size) for size in sizes], [math.log(cost) for cost in costs]
    middle_across, middle_up = sum(across) / len(across), sum(up) / len(up)
    slope = sum((x - middle_across) * (y - middle_up) for x, y in zip(across, up, strict=True))
    return slope / sum((x - middle_across) ** 2 for x in across)


def _lasting(step: Callable[[], object], times: int) -> float:
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        began = time.process_time()
        for _ in range(times):
            step()
        return time.process_time() - began
    finally:
        if was_enabled:
            gc.enable()
