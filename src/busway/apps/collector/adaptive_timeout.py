"""The adaptive timeout for replies of one polled device: adapts on TCP, stays as configured on serial lines.

Pure: knows seconds.

1. If replies carry a transaction identifier, a late reply does no harm. So the timeout is computed as in TCP (RFC
   6298): smoothed reply time plus four times its deviation, doubled after each silence; at least `SHORTEST`, at most
   the configured timeout.
2. On a serial line a late reply can be taken for the next one, so the configured timeout is never shortened. It is not
   shortened behind a gateway to a line either: a request waits there while another device of the line is silent.
"""

from typing import Final

SHORTEST: Final = 0.2
"""The shortest adaptive timeout in seconds, as Linux has it for TCP: a device that usually answers in a millisecond
sometimes takes longer."""
_GAIN: Final = 0.125
_DEVIATION_GAIN: Final = 0.25


class AdaptiveTimeout:
    """The timeout for replies of one polled device; adapts to its reply times if replies carry an identifier.

    Args:
        configured: the configured timeout in seconds: the first and the longest one.
        numbered: whether replies carry a transaction identifier, as on TCP. If not, the timeout never changes.

    Attributes:
        seconds: how long to wait for the next reply, at most the configured timeout.
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
        """Double the timeout, up to the configured one, because a reply of the device did not come in time.

        Does nothing if replies carry no transaction identifier.
        """
        if self._numbered:
            self.seconds = min(2 * self.seconds, self._configured)
