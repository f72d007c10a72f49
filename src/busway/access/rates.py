"""Limits of requests per second by client host: a token bucket for each host, shared by all its connections.

Pure: knows hosts, numbers and the times that it is given; pauses nothing itself.

1. A bucket holds the requests of one second, and at least one. `Rates.allows` counts a request before it is executed.
   `Rates.charge` counts requests after they were answered: a host may exceed its bucket by the requests of one receive
   call, and then waits until the bucket is no longer below zero, so that the rate holds over any longer time.
2. Only buckets used recently are kept: a full bucket has the same effect as none.
"""

from collections import OrderedDict
from typing import Final

_HOSTS: Final = 4096
"""Most buckets that are kept; beyond that, the bucket unused longest is forgotten."""


class Rates:
    """Limits how many requests per second each client host may send: one token bucket for each host.

    Args:
        rate: requests a second that each host may send, above 0. A host may send the requests of one second at once.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._depth = max(rate, 1.0)
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # requests left, and when that was

    def __len__(self) -> int:
        return len(self._buckets)

    def charge(self, host: str, requests: int, now: float) -> float:
        """Count requests that a host has sent, and return the seconds for which nothing should be read from it now.

        The result is 0 if the host is within its rate. The requests are counted in any case.

        Args:
            host: the host.
            requests: how many requests it has sent.
            now: the time in seconds, monotonic.
        """
        left = self._left(host, now) - requests
        self._buckets[host] = (left, now)
        self._buckets.move_to_end(host)
        if len(self._buckets) > _HOSTS:
            self._buckets.popitem(last=False)
        return 0.0 if left >= 0 else -left / self.rate

    def allows(self, host: str, now: float) -> bool:
        """Whether one more request of a host is within its rate: if True, the request is counted; if False, it is not.

        ``now`` is the time in seconds, monotonic.
        """
        if self._left(host, now) < 1.0:
            return False
        self.charge(host, 1, now)
        return True

    def _left(self, host: str, now: float) -> float:
        left, when = self._buckets.get(host, (self._depth, now))
        return min(self._depth, left + (now - when) * self.rate)
