"""One turn of a client on a serial line: so many reads, one after the other. For ours and the peers'.

The first read opens what has to be opened and is not counted. CPU time is that of the counted reads.
"""

import time

from harness.turns import Took


class Reads:
    """Counts reads and checks their values: ``while reads.more(values): values = …``, then `took`."""

    def __init__(self, count: int, registers: int) -> None:
        self._count = count
        self._wanted = list(range(registers))
        self._ended: list[float] = []
        self._cpu_before = self._cpu = 0.0

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
        self._cpu = time.process_time() - self._cpu_before
        return False

    def took(self) -> Took:
        """What they took."""
        return Took.of(self._ended, self._cpu)
