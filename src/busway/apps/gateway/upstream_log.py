"""Writes log lines about an upstream: when it cannot be reached, and which requests were answered 0A or 0B.

Knows reasons and times; knows no link and no request.

1. Why the upstream cannot be reached is logged once, and again when the reason changes. That it can be reached again is
   logged, too.
2. The first request that is answered 0A is logged with the reason. Later ones are counted, and their number is logged
   once a minute, when the reason changes, or when the upstream is back: a client that polls would fill the log.
3. For each unit the first request that is answered 0B is logged, then one in ten minutes with the number of the others.
"""

import logging
import math
from collections.abc import Callable
from typing import Final

from ...log_limiter import LogLimiter, suppressed_note

_log = logging.getLogger("busway.apps.gateway")

AGAIN_AFTER: Final = 60.0
"""Seconds between log lines about requests answered 0A for the same reason."""
SILENT_AGAIN_AFTER: Final = 600.0
"""Seconds between log lines about requests to one unit answered 0B: a line may have many dead units."""
WAITING: Final = "waiting for it"
"""End of a log line if the gateway tries again by itself; `busway serve` writes the same about its ports."""
AT_NEED: Final = "tried again when something is asked"
"""End of a log line if the gateway tries again at the next request."""


class UpstreamLog:
    """Writes the log lines about one upstream: that it cannot be reached, and that requests were answered 0A or 0B.

    Args:
        name: name of the upstream in routes.
        endpoint: URL of the upstream.
        is_waited_for: whether the gateway tries to open the upstream again without a request, as with serial ports.
        clock: returns the time in monotonic seconds.
    """

    __slots__ = (
        "_clock",
        "_endpoint",
        "_name",
        "_no_path",
        "_no_path_reason",
        "_reason",
        "_silent",
        "_then",
        "_told_at",
    )

    def __init__(self, name: str, endpoint: str, *, is_waited_for: bool, clock: Callable[[], float]) -> None:
        self._name = name
        self._endpoint = endpoint
        self._then = WAITING if is_waited_for else AT_NEED
        self._clock = clock
        self._reason = ""
        self._silent = LogLimiter(SILENT_AGAIN_AFTER)
        self._no_path = 0
        self._no_path_reason = ""
        self._told_at = -math.inf

    def is_down(self, reason: str) -> None:
        """Log that the upstream cannot be reached, and why; log nothing if the reason is that of the last such line."""
        if reason != self._reason:
            self._reason = reason
            _log.warning("%s: %s; %s", self._endpoint, reason, self._then)

    def is_up(self) -> None:
        """Log that the upstream can be reached again, if it was logged as down, and how many more requests got 0A."""
        if self._reason:
            self._reason = ""
            _log.warning("%s: open again", self._endpoint)
        self._log_count()
        self._no_path_reason = ""

    def no_path(self, reason: str) -> None:
        """Log a request that was answered with exception code 0A, or count it if the same reason was logged already."""
        if reason != self._no_path_reason:
            self._log_count()
            self._no_path_reason = reason
            self._told_at = self._clock()
            _log.warning("line %s: a request was answered 0A: %s", self._name, reason)
            return
        self._no_path += 1
        if self._clock() >= self._told_at + AGAIN_AFTER:
            self._log_count()

    def no_answer(self, unit: int | None, reason: str) -> None:
        """Log that a request was answered with exception code 0B because its unit did not answer.

        For each unit at most one line in ten minutes is written; it has the number of requests left out.

        Args:
            unit: unit identifier on the upstream; None if it is not known.
            reason: the error, in words.
        """
        repeated = self._silent.admit(str(unit), self._clock())
        if repeated is not None:
            text = "line %s: a request to unit %s was answered 0B: %s%s"
            _log.warning(text, self._name, unit, reason, suppressed_note(repeated))

    def _log_count(self) -> None:
        """Log how many requests were answered 0A since the last such line; log nothing if there were none."""
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
