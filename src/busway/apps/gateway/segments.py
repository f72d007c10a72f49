"""Routes by address of one unit and one function: found by where a request lies, not by looking through all of them.

Knows routes in their order, and ranges; knows no unit and no upstream.

The first route that a request touches decides, whether it takes it whole or only a part. So the table is cut at the
edges of all ranges, and each piece knows the first route that has it; of the pieces that a request lies on, the route
that stands first is the one.
"""

from bisect import bisect_right
from collections.abc import Iterable
from typing import TYPE_CHECKING

from ...codes import Table

if TYPE_CHECKING:
    from .routes import Route


class Segments:
    """One table, cut into pieces of which each has one first route.

    Args:
        table: the table that a function touches.
        routes: those that take the function, in their order; the last one may have no range.
    """

    __slots__ = ("_edges", "_first", "_routes")

    def __init__(self, table: Table, routes: Iterable["Route"]) -> None:
        self._routes = [one for one in routes if one.addresses is None or one.addresses.table is table]
        ranges = [one.addresses for one in self._routes if one.addresses is not None]
        self._edges = sorted({0, *(one.first for one in ranges), *(one.end for one in ranges)})
        nobody = len(self._routes)
        self._first = [nobody] * len(self._edges)
        for index in reversed(range(nobody)):
            taken = self._routes[index].addresses
            begin = 0 if taken is None else bisect_right(self._edges, taken.first) - 1
            end = len(self._edges) if taken is None else bisect_right(self._edges, taken.end - 1)
            self._first[begin:end] = [index] * (end - begin)

    def first_touched(self, address: int, end: int) -> "Route | None":
        """The first route of the items ``address`` … ``end - 1``; None where none has any of them.

        The whole request need not lie in its range.
        """
        edges = self._edges
        at = bisect_right(edges, address) - 1
        found = self._first[at]
        at += 1
        while at < len(edges) and edges[at] < end:  # mostly a request lies on one piece
            found = min(found, self._first[at])
            at += 1
        return self._routes[found] if found < len(self._routes) else None
