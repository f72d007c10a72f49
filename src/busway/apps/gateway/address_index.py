"""An index of many address ranges that finds the first range a request touches, without going through all ranges.

Knows ranges in their order; knows no route, table or unit.

The addresses are cut at the edges of all ranges, and for each piece the first range that covers it is known. The result
is the first of these ranges over all pieces that a request lies on, whether it covers the whole request or only a part.
"""

from bisect import bisect_right
from collections.abc import Sequence


class AddressIndex:
    """An index of many address ranges of one table, which finds the first range that a request touches.

    Args:
        ranges: first address and end (last address + 1) of each range, in their order; None for all addresses.
    """

    __slots__ = ("_edges", "_first", "_size")

    def __init__(self, ranges: Sequence[tuple[int, int] | None]) -> None:
        self._edges = sorted({0, *(edge for one in ranges if one is not None for edge in one)})
        self._size = len(ranges)
        self._first = [self._size] * len(self._edges)
        for index in reversed(range(self._size)):
            taken = ranges[index]
            begin = 0 if taken is None else bisect_right(self._edges, taken[0]) - 1
            end = len(self._edges) if taken is None else bisect_right(self._edges, taken[1] - 1)
            self._first[begin:end] = [index] * (end - begin)

    def first_touched(self, address: int, end: int) -> int | None:
        """Return the position of the first range that has any item of ``address`` … ``end - 1``; None if none has."""
        edges = self._edges
        at = bisect_right(edges, address) - 1
        found = self._first[at]
        at += 1
        while at < len(edges) and edges[at] < end:  # usually a request lies on one piece
            found = min(found, self._first[at])
            at += 1
        return found if found < self._size else None
