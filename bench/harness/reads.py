"""The measured part of a client on a serial line: so many reads, one after the other. For ours and the peers'.

The first read opens what has to be opened and is not counted. CPU time is that of the counted reads.
"""

import json
import statistics
import time

from harness.priority import PROGRAM, real_time


class Reads:
    """Counts reads and checks their values: ``while reads.more(values): values = …``; made before all else."""

    def __init__(self, count: int, registers: int) -> None:
        real_time(PROGRAM)
        self._count = count
        self._wanted = list(range(registers))
        self._ended: list[float] = []
        self._cpu_before = 0.0

    def more(self, values: list[int] | None) -> bool:
        """Take the values of a read, and say whether there is another one to make."""
        now = time.perf_counter()
        if values != self._wanted:
            raise SystemExit(f"wrong values: {values}")
        self._ended.append(now)
        if len(self._ended) == 1:
            self._cpu_before = time.process_time()
        if len(self._ended) <= self._count:
            return True
        self._report()
        return False

    def _report(self) -> None:
        each = [later - earlier for earlier, later in zip(self._ended, self._ended[1:], strict=False)]
        cpu = time.process_time() - self._cpu_before
        print(json.dumps({"seconds": sum(each), "typical": statistics.median(each) * len(each), "cpu": cpu}))
