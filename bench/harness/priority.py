"""Real-time priority for programs whose times are measured in tens of microseconds on a machine that others use too.

What the machine does besides is not what such a measurement is about. Without the right to it, nothing changes, and the
figures are those of the machine's busy moments.
"""

import os
from contextlib import suppress

PROGRAM, WIRE = 1, 2


def real_time(level: int) -> None:
    """Run before everything of a lower level, and before all usual programs. Threads started later inherit it."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
