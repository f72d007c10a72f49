"""How many requests a host may make: a token bucket each, shared by all its connections.

Pure: knows hosts, numbers and times handed in; pauses nothing itself.

1. A bucket holds the requests of one second. What was answered already is paid afterwards: a host may go into debt by
   what one receive call held, and then waits until it is paid, so that the rate holds over any longer time.
2. There are as many buckets as were used lately; a full one says nothing and is forgotten.
"""

from collections import OrderedDict
from typing import Final

_HOSTS: Final = 4096
"""Buckets at most; beyond, the one that was used longest ago is forgotten."""


class Rates:
    """The buckets of a listener.

    Args:
        rate: requests a second, for each host.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._depth = max(rate, 1.0)
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # requests left, and when that was

    def __len__(self) -> int:
        return len(self._buckets)

    def charge(self, host: str, requests: int, now: float) -> float:
        """Take ``requests`` that were made; how many seconds the host has to wait now, 0 within its rate."""
        left = self._left(host, now) - requests
        self._buckets[host] = (left, now)
        self._buckets.move_to_end(host)
        if len(self._buckets) > _HOSTS:
            self._buckets.popitem(last=False)
        return 0.0 if left >= 0 else -left / self.rate

    def allows(self, host: str, now: float) -> bool:
        """Take one request if there is one left: for those who can be refused, and not only slowed down."""
        if self._left(host, now) < 1.0:
            return False
        self.charge(host, 1, now)
        return True

    def _left(self, host: str, now: float) -> float:
        left, when = self._buckets.get(host, (self._depth, now))
        return min(self._depth, left + (now - when) * self.rate)
