"""The measured part of a client's run: when it begins, when it ends, what was done in it.

For the client programs, ours and the peers', so that all of them count alike. Knows no Modbus.

Rules (the same as of the load generator in C):
1. The first fifth of the run, 0.1 s at least, warms up: it is in `all_transactions` and `cpu`, not in rate and latency.
2. A client reports a burst of transactions at a time, with the duration of its last one as a sample of latency:
   the clock is not read for each transaction.
3. What is reported between the two points counts, and the time between them is what it is divided by: from the first
   report to the last, callers in step would seem to do one round in no time.
"""

import json
import time
from array import array

BURST = 8  # transactions per report of a client that awaits each; 0.3 µs of bookkeeping become 0.04 µs each


def burst(callers: int) -> int:
    """How many transactions a caller reports at a time: where callers are many, a round of all of them stays short."""
    return max(1, min(BURST, 16 * BURST // callers))


class Window:
    """Counts transactions between two points of time; opens when it is built."""

    def __init__(self, seconds: float) -> None:
        self._cpu_before = time.process_time()
        self._start = time.perf_counter() + max(seconds / 5, 0.1)
        self._stop = self._start + seconds
        self._seconds = seconds
        self._counted = 0
        self._all = 0
        self._latencies = array("d")

    def count(self, transactions: int, began: float) -> bool:
        """Reports a burst whose last part began at `began` (`time.perf_counter()`); False when the time is over."""
        now = time.perf_counter()
        self._all += transactions
        if self._start <= now < self._stop:
            self._counted += transactions
            self._latencies.append(now - began)
        return now < self._stop

    def report(self) -> None:
        """Prints the result as one line of JSON, with the keys of the load generator."""
        cpu = time.process_time() - self._cpu_before
        ordered = sorted(self._latencies)
        if not ordered:
            raise SystemExit("no transaction was counted")
        result: dict[str, float] = {
            "transactions": self._counted,
            "all_transactions": self._all,
            "seconds": self._seconds,
            "rate": self._counted / self._seconds,
            "cpu": cpu,
            "errors": 0,
        }
        for name, share in (("p50", 0.50), ("p99", 0.99), ("p99.9", 0.999)):
            result[name] = ordered[int(share * len(ordered))] * 1e6
        print(json.dumps(result))
