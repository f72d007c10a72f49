"""Detects characters that a serial port has lost, by the counters of its driver.

Knows the driver's counters, and not what a loss means for a frame. If a driver has no counters, losses cannot be seen,
and it is not asked again.
"""

from collections.abc import Callable

from ...errors import LinkDown
from .driver_counters import DriverCounters


class Overruns:
    """Detects characters that one open port has lost, by its driver's counters."""

    __slots__ = ("_counters", "_lost")

    def __init__(self, counters: Callable[[], DriverCounters | None]) -> None:
        """Start to count lost characters; earlier losses are ignored.

        ``counters`` returns the driver's counters, or None if it has none; may raise `LinkDown`.
        """
        self._counters = counters
        self._lost = self._read()

    def more(self) -> bool:
        """Whether the port has lost characters since the last call, or at first since this object was created.

        False if its driver does not count them, or if the port is gone.
        """
        if self._lost is None:
            return False
        before, now = self._lost, self._read()
        if now is None:
            return False
        self._lost = now
        return now > before

    def _read(self) -> int | None:
        try:
            counted = self._counters()
        except LinkDown:
            return None  # the port tells by itself that it has gone
        return None if counted is None else counted.overruns + counted.buffer_overruns
