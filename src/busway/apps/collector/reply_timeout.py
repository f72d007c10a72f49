"""The timeout for replies of one polled device: adaptive on TCP, as configured on serial lines.

Pure: knows seconds.

1. Where replies carry a number, one that comes too late does no harm. So the time is that of TCP (RFC 6298): smoothed
   reply time plus four times its deviation, doubled by each silence, between `SHORTEST` and the configured time.
2. On a line a timeout makes doubt about the next reply, so the configured time is never shortened. Behind a gateway to
   a line it is not, either: a request waits there while another device of the line is silent.
"""

from typing import Final

SHORTEST: Final = 0.2
"""Seconds, as Linux has it for TCP: who answers in a millisecond may still clean up memory now and then."""
_GAIN: Final = 0.125
_DEVIATION_GAIN: Final = 0.25


class ReplyTimeout:
    """The timeout for replies of one polled device, which follows its replies on TCP.

    Args:
        configured: seconds; the longest, and the one to begin with.
        numbered: whether replies carry a number.

    Attributes:
        seconds: how long to wait for the next reply.
    """

    __slots__ = ("_configured", "_deviation", "_numbered", "_smoothed", "seconds")

    def __init__(self, configured: float, *, numbered: bool) -> None:
        self._configured = configured
        self._numbered = numbered
        self._smoothed: float | None = None
        self._deviation = 0.0
        self.seconds: float = configured

    def answered(self, elapsed: float) -> None:
        """Adapt the timeout to a reply of the device that took ``elapsed`` seconds."""
        if not self._numbered:
            return
        if self._smoothed is None:
            self._smoothed, self._deviation = elapsed, elapsed / 2
        else:
            self._deviation += _DEVIATION_GAIN * (abs(elapsed - self._smoothed) - self._deviation)
            self._smoothed += _GAIN * (elapsed - self._smoothed)
        self.seconds = min(max(self._smoothed + 4 * self._deviation, SHORTEST), self._configured)

    def silent(self) -> None:
        """Lengthen the timeout, on TCP only, after a reply of the device did not come in time."""
        if self._numbered:
            self.seconds = min(2 * self.seconds, self._configured)
