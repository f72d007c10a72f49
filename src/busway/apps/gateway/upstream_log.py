"""Log lines about an upstream of a gateway: that it cannot be reached, and how many requests got 0A for it.

Knows reasons and times; knows no link and no request.

1. A reason is told once, and again when it changes; that the upstream is back is told too.
2. The first request that gets 0A is told with its reason. Those after it are counted, and told once a minute, or when
   the reason changes, or when the upstream is back: a poller would fill the log.
"""

import logging
import math
from collections.abc import Callable
from typing import Final

_log = logging.getLogger("busway.apps.gateway")

AGAIN_AFTER: Final = 60.0
"""Seconds after which requests that got 0A for the same reason are told again."""
WAITING: Final = "waiting for it"
"""What follows the reason where the upstream is tried again by itself; `busway serve` says so of its ports."""
AT_NEED: Final = "tried again when something is asked"
"""What follows it elsewhere."""


class UpstreamLog:
    """The log lines of one upstream.

    Args:
        name: what routes call it.
        endpoint: where it leads.
        is_waited_for: whether it is tried again by itself.
        clock: seconds.
    """

    __slots__ = ("_clock", "_endpoint", "_name", "_no_path", "_no_path_reason", "_reason", "_then", "_told_at")

    def __init__(self, name: str, endpoint: str, *, is_waited_for: bool, clock: Callable[[], float]) -> None:
        self._name = name
        self._endpoint = endpoint
        self._then = WAITING if is_waited_for else AT_NEED
        self._clock = clock
        self._reason = ""
        self._no_path = 0
        self._no_path_reason = ""
        self._told_at = -math.inf

    def is_down(self, reason: str) -> None:
        """It cannot be reached."""
        if reason != self._reason:
            self._reason = reason
            _log.warning("%s: %s; %s", self._endpoint, reason, self._then)

    def is_up(self) -> None:
        """It can be reached."""
        if self._reason:
            self._reason = ""
            _log.warning("%s: open again", self._endpoint)
        self._tell_count()
        self._no_path_reason = ""

    def no_path(self, reason: str) -> None:
        """A request got 0A."""
        if reason != self._no_path_reason:
            self._tell_count()
            self._no_path_reason = reason
            self._told_at = self._clock()
            _log.warning("line %s: a request was answered 0A: %s", self._name, reason)
            return
        self._no_path += 1
        if self._clock() >= self._told_at + AGAIN_AFTER:
            self._tell_count()

    def _tell_count(self) -> None:
        """Tell how many requests got 0A since it was told last."""
        if self._no_path:
            now = self._clock()
            _log.warning(
                "line %s: %d more %s answered 0A within %.0f s: %s",
                self._name,
                self._no_path,
                "request was" if self._no_path == 1 else "requests were",
                now - self._told_at,
                self._no_path_reason,
            )
            self._no_path = 0
            self._told_at = now
