"""The measured part of a client on a serial line: so many reads, one after the other. For ours and the peers'.

The first read opens what has to be opened and is not counted. CPU time is that of the counted reads.
"""

import json
import time


class Reads:
    """Counts reads and checks their values: ``while reads.more(values): values = …``."""

    def __init__(self, count: int, registers: int) -> None:
        self._left = count
        self._count = count
        self._wanted = list(range(registers))
        self._began = 0.0
        self._cpu_before = 0.0

    def more(self, values: list[int] | None) -> bool:
        """Take the values of a read, and say whether there is another one to make."""
        if values != self._wanted:
            raise SystemExit(f"wrong values: {values}")
        if not self._began:
            self._began, self._cpu_before = time.perf_counter(), time.process_time()
            return True
        self._left -= 1
        if self._left:
            return True
        seconds = time.perf_counter() - self._began
        cpu = time.process_time() - self._cpu_before
        print(json.dumps({"seconds": seconds, "cpu": cpu, "reads": self._count}))
        return False
