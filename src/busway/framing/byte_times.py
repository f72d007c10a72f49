"""Estimates when each received byte was on the serial line, from the times at which bytes were read.

Knows positions in a stream and times; knows no bytes. Bytes of one read are assumed to have been sent without gaps.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

NEVER: Final = float("-inf")


@dataclass(frozen=True, slots=True)
class _Burst:
    """The bytes that one read returned: position of the first one, when it began on the line, and seconds per byte."""

    place: int
    began: float
    each: float


_place = attrgetter("place")


class ByteTimes:
    """Estimates of when each byte in a buffer was on the serial line; position 0 is the first byte in the buffer."""

    __slots__ = ("_bursts", "_forgotten")

    def __init__(self) -> None:
        self._forgotten = 0  # bytes, so that the places of the bursts need not be moved
        self._bursts = [_Burst(0, NEVER, 0.0)]

    @property
    def latest(self) -> float:
        """The time in seconds at which the first byte of the latest read was on the line; -inf before any read."""
        return self._bursts[-1].began

    def add(self, place: int, began: float, each: float) -> None:
        """Record that a read has added bytes to the buffer.

        Args:
            place: position of the first of them in the buffer.
            began: time at which that byte began on the line, in seconds.
            each: seconds per byte.
        """
        self._bursts.append(_Burst(self._forgotten + place, began, each))

    def forget(self, count: int) -> None:
        """Note that the first ``count`` bytes were removed from the buffer; the byte after them has position 0 then."""
        self._forgotten += count
        del self._bursts[: bisect_right(self._bursts, self._forgotten, key=_place) - 1]

    def began(self, place: int) -> float:
        """Return the time in seconds at which the byte at position ``place`` began on the line.

        It is -inf before any read.
        """
        place += self._forgotten
        burst = self._bursts[max(bisect_right(self._bursts, place, key=_place) - 1, 0)]
        return burst.began + (place - burst.place) * burst.each

    def ended(self, place: int) -> float:
        """Return the time in seconds at which the byte before position ``place`` ended on the line.

        It is -inf before any read.
        """
        place += self._forgotten
        burst = self._bursts[max(bisect_left(self._bursts, place, key=_place) - 1, 0)]
        return burst.began + (place - burst.place) * burst.each
