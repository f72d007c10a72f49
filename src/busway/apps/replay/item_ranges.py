"""The items of one table that requests have read or written, as ranges that do not overlap.

Knows numbers; knows no request.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator


class ItemRanges:
    """A set of registers or bits of one table, kept as sorted ranges; ranges that touch or overlap are joined.

    Iterating gives the ranges as (first, end); ``len`` is the number of ranges, not of items.
    """

    __slots__ = ("_ends", "_firsts")

    def __init__(self) -> None:
        self._firsts: list[int] = []
        self._ends: list[int] = []

    def add(self, first: int, count: int) -> None:
        """Add ``count`` registers or bits, from the 0-based offset ``first`` on."""
        end = first + count
        low, high = bisect_left(self._ends, first), bisect_right(self._firsts, end)
        if low < high:
            first, end = min(first, self._firsts[low]), max(end, self._ends[high - 1])
        self._firsts[low:high] = [first]
        self._ends[low:high] = [end]

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Return an iterator over the ranges, ascending: 0-based offset of the first item, and that after the last."""
        return zip(self._firsts, self._ends, strict=True)

    def __len__(self) -> int:
        return len(self._firsts)
