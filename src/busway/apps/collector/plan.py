"""The read plan: computes the cheapest set of reads that fetches all wanted points of a device.

Knows items, what a device allows, and what a read costs; knows no clock, no socket and no value.

1. An item is the place of one value. The bits of one register are one item, an atomic group is one item, and an item
   that lies inside another one takes no extra time.
2. A value is never split over two reads.
3. Reads stop at forbidden registers, at the borders of readable ranges and at those of exact blocks.
4. A register that belongs to no item could change when it is read. So a hole of such registers between two items is
   read only inside readable ranges, or if the device's rules say ``bridge``. Registers of items that are not wanted are
   no hole.
5. Within these limits the plan is the cheapest one. Items of which none lies inside another have one order, by start
   and by end, and there is a cheapest plan in which each read fetches items that follow each other in it. The best read
   that ends with item j begins with the item i for which ``best[i] − c · start[i]`` is least, of all i that the read
   can reach; a monotone queue keeps that minimum, so the time is linear in the number of items.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, Final, NamedTuple, Protocol, TypeAlias

from ...codes import Table
from ...points.point_rules import ItemRange, ReadRules
from ..service.gc_pauses import collecting_paused
from .cost import ReadCost

__all__ = [
    "DevicePlan",
    "ItemRange",
    "PlainItem",
    "PlannedRead",
    "ReadItem",
    "ReadRules",
    "Unreadable",
    "plan_reads",
    "predicted",
    "undeclared",
]


class ReadItem(Protocol):
    """Interface of an item: the registers or bits in a table that hold one value. `Point` implements it."""

    @property
    def table(self) -> Table:
        """Table that the item is in."""

    @property
    def start(self) -> int:
        """First register or bit of the item, 0-based."""

    @property
    def width(self) -> int:
        """Number of registers or bits of the item, 1 or more."""

    @property
    def group(self) -> Hashable | None:
        """The atomic group of the item: all items of a group must be read by one request. None for no group."""


@dataclass(frozen=True, slots=True)
class PlainItem:
    """The simplest `ReadItem`: a range of registers or bits that one read must fetch, without a value type.

    Attributes:
        table: the table of the range.
        start: first register or bit, 0-based.
        width: number of registers or bits, 1 or more.
        key: the caller's name for the range; not used here.
        group: the atomic group that the range is read with, or None.
    """

    table: Table
    start: int
    width: int = 1
    key: Hashable = None
    group: Hashable | None = None


@dataclass(frozen=True, slots=True)
class PlannedRead:
    """One read request of a plan: its range and the items it fetches.

    Attributes:
        table: the table to read.
        start: first register or bit to read, 0-based.
        width: number of registers or bits to read.
        items: the items whose values the read fetches, in the order of their starts; also those that were not wanted.
        seconds: how long the read is expected to take.
    """

    table: Table
    start: int
    width: int
    items: tuple[Any, ...]  # the caller's own kind of ReadItem
    seconds: float

    @property
    def end(self) -> int:
        """The 0-based register or bit after the last one of the read."""
        return self.start + self.width


@dataclass(frozen=True, slots=True)
class Unreadable:
    """An item that no allowed read can fetch, and the reason as a sentence."""

    item: Any  # the caller's own kind of ReadItem
    reason: str


@dataclass(frozen=True, slots=True)
class DevicePlan:
    """The read requests that fetch the wanted items of a device in the shortest time.

    Attributes:
        reads: the requests, in the order of tables and addresses.
        unreadable: wanted items that no allowed request can fetch, each with the reason.
        seconds: the time that all requests are expected to take together.
    """

    reads: tuple[PlannedRead, ...]
    unreadable: tuple[Unreadable, ...]
    seconds: float


def plan_reads(
    wanted: Iterable[ReadItem], rules: ReadRules, cost: ReadCost, *, others: Iterable[ReadItem] = ()
) -> DevicePlan:
    """Compute the cheapest read requests that fetch some items (such as points) of a device.

    Args:
        wanted: the items to read, in any order.
        rules: limits and ranges of reads that the device allows.
        cost: how long reads take.
        others: items that need not be read; a read that covers them anyway lists them too, but not where the rules say
            ``one_point``.

    Returns:
        Reads that fetch every wanted item, apart from those in ``unreadable``. Each item that is fetched is listed in
        one read, the first that covers it; an atomic group is in one read as a whole. If the rules say ``one_point``,
        a read fetches one wanted item or group, or several with exactly the same range, and lists nothing of
        ``others``.
    """
    due = _by_table(wanted)
    idle = _by_table(others)
    reads: list[PlannedRead] = []
    unreadable: list[Unreadable] = []
    with collecting_paused():  # a plan has no reference cycles, and looking for some took a fifth of a large one
        for table in Table:
            items = due.get(table)
            if items:
                not_due = idle.get(table, [])
                border = _Borders(table, rules, (*items, *not_due))
                _plan_table(table, _blocks(items), _blocks(not_due), border, rules, cost, reads, unreadable)
    return DevicePlan(tuple(reads), tuple(unreadable), sum(read.seconds for read in reads))


def predicted(reads: Iterable[PlannedRead], cost: ReadCost) -> float:
    """Return the seconds that planned reads take together at the given cost."""
    return sum(cost.of(read.table, read.width) for read in reads)


def undeclared(read: PlannedRead, known: Iterable[ReadItem], rules: ReadRules) -> list[ItemRange]:
    """Return the parts of a read, in order, that lie in no known item, no readable range and no exact block.

    Args:
        read: the read.
        known: all items of the device, in any order. Items of other tables are ignored, and computed points too, which
            have no registers.
        rules: the readable ranges and exact blocks of the device.
    """
    declared = [
        ItemRange(each.start, each.start + each.width) for each in known if each.width and each.table is read.table
    ]
    declared += [*rules.readable.get(read.table, ()), *rules.exact.get(read.table, ())]
    left: list[ItemRange] = []
    at = read.start
    for span in sorted(declared):
        if span.end <= at or span.start >= read.end:
            continue
        if span.start > at:
            left.append(ItemRange(at, span.start))
        at = span.end
    if at < read.end:
        left.append(ItemRange(at, read.end))
    return left


class _Block(NamedTuple):
    """Items that one read must fetch together: one item or a group. A tuple, for speed."""

    start: int
    end: int
    items: tuple[ReadItem, ...]


_Place: TypeAlias = tuple[int, int]
"""A range of registers or bits of one table: the first, and the one after the last."""
_PART: Final = 2.0**-17
"""Factor that makes a part of 1 of each width, so that start and width are sorted by one number."""


def _by_table(items: Iterable[ReadItem]) -> dict[Table, list[ReadItem]]:
    found: dict[Table, list[ReadItem]] = {}
    for item in items:
        table = item.table
        if table in found:
            found[table].append(item)
        else:
            found[table] = [item]
    return found


def _blocks(items: list[ReadItem]) -> list[_Block]:
    """Return items as blocks, one for each item or atomic group, sorted by start; with equal starts the wider first."""
    blocks: list[_Block] = []
    groups: dict[Hashable, list[ReadItem]] = {}
    # Sorted before blocks are made of them: blocks then lie in memory in the order in which all further steps use them.
    # Otherwise 50 000 items in an order of chance do not fit into the caches, and each step waits for memory.
    items.sort(key=_item_order)
    for item in items:
        if item.group is None:
            start = item.start
            blocks.append(_Block(start, start + item.width, (item,)))
        else:
            groups.setdefault(item.group, []).append(item)
    for members in groups.values():
        blocks.append(
            _Block(members[0].start, max(each.start + each.width for each in members), tuple(members)),
        )
    return _in_order(blocks) if groups else blocks


def _item_order(item: ReadItem) -> float:
    return item.start - item.width * _PART


def _block_order(block: _Block) -> float:
    return block[0] - (block[1] - block[0]) * _PART


def _in_order(blocks: list[_Block]) -> list[_Block]:
    """Sort blocks (items that one read must fetch together) in place and return them: by start, then wider first."""
    blocks.sort(key=_block_order)
    return blocks


def _plan_table(
    table: Table,
    due: list[_Block],
    idle: list[_Block],
    border: "_Borders",
    rules: ReadRules,
    cost: ReadCost,
    reads: list[PlannedRead],
    unreadable: list[Unreadable],
) -> None:
    places: list[_Place] = []
    kept: list[_Block] = []
    for block in due:
        place, reason = border.place_of(block)
        if place is None:
            unreadable += [Unreadable(item, reason) for item in block.items]
            continue
        kept.append(block)
        places.append(place)
    if rules.one_point:
        reads += _one_each(table, kept, places, cost)
        return
    chosen = _cheapest(_without_inner(places), border, rules.limit(table), cost.base, cost.per_item(table))
    blocks = _in_order([*kept, *idle]) if idle else kept
    reads += _with_items(table, chosen, blocks, cost)


class _Borders:
    """Decides by a device's rules which ranges of a table may be read, and which of them together by one read.

    Args:
        table: the table.
        rules: which reads the device allows.
        items: all items of the table, wanted or not.
    """

    def __init__(self, table: Table, rules: ReadRules, items: Sequence[ReadItem]) -> None:
        self._items = items
        self._declared: tuple[list[int], list[int]] | None = None
        self._label = table.label
        self._limit = rules.limit(table)
        self._bridge = rules.bridge
        self._readable = _ranges(rules.readable.get(table, ()))
        self._forbidden = _ranges(rules.forbidden.get(table, ()))
        self._exact = _ranges(rules.exact.get(table, ()))
        self._borders = sorted(rules.borders.get(table, ()))

    def place_of(self, block: _Block) -> tuple[_Place | None, str]:
        """Return the range to read for some items and an empty text; or None, and why no read may fetch the items.

        The range is that of the items, or the exact block of the device's rules that they lie in.

        Args:
            block: items that one read must fetch together.
        """
        start, end, items = block
        found: ItemRange | None = None
        if self._exact is not None:
            found = self._exact.touched(start, end)
            if found is not None:
                if not (found.start <= start and end <= found.end):
                    return None, f"it crosses the border of the exact block {found.start}…{found.end - 1}"
                start, end = found.start, found.end
        if end - start > self._limit:
            return None, f"{end - start} {self._label}s are more than the {self._limit} that one read may have"
        if self._forbidden is not None:
            forbidden = self._forbidden.touched(start, end)
            if forbidden is not None:
                return None, f"{self._label}s {forbidden.start}…{forbidden.end - 1} must not be read"
        if self._readable is not None:
            around = self._readable.touched(start, end)
            if around is None or not (around.start <= start and end <= around.end):
                return None, "it does not lie in one of the readable ranges"
        elif found is None and len(items) > 1 and not self._bridge and not self._is_declared(start, end):
            return None, "its group has an undeclared hole: give the readable range, or bridge = true"
        return (start, end), ""

    def cut_between(self, left: _Place, right: _Place) -> bool:
        """Whether two neighbouring ranges must not be fetched by one read.

        This is so if a border lies between them, if they are not in one readable range, or if one of them or the gap
        between them touches an exact block; also if the gap is forbidden, or if the device has no readable ranges, gaps
        are not bridged, and the gap has a register or bit of no item.
        """
        end, start = left[1], right[0]
        has_hole = start > end
        if self._exact is not None and (
            self._exact.touched(*left) is not None
            or self._exact.touched(*right) is not None
            or (has_hole and self._exact.touched(end, start) is not None)
        ):
            return True
        if self._readable is not None:
            around = self._readable.touched(*left)
            if around is not None and right[1] > around.end:
                return True
        elif has_hole and not self._bridge and not self._is_declared(end, start):
            return True
        if self._borders:
            at = bisect_left(self._borders, end)
            if at < len(self._borders) and self._borders[at] <= start:
                return True
        return has_hole and self._forbidden is not None and self._forbidden.touched(end, start) is not None

    def _is_declared(self, start: int, end: int) -> bool:
        """Whether each register or bit from ``start`` to before ``end`` belongs to an item, wanted or not."""
        if self._declared is None:  # made when the first hole is met: most devices have readable ranges, or no hole
            self._declared = _runs(self._items)
        starts, ends = self._declared
        at = bisect_right(starts, start) - 1
        return at >= 0 and ends[at] >= end


def _runs(items: Iterable[ReadItem]) -> tuple[list[int], list[int]]:
    """Return the starts and the ends of the runs of registers or bits that items fill without a hole, in order."""
    starts: list[int] = []
    ends: list[int] = []
    last = -1
    for start, end in sorted([(each.start, each.start + each.width) for each in items]):
        if start > last:
            starts.append(start)
            ends.append(end)
            last = end
        elif end > last:
            ends[-1] = last = end
    return starts, ends


class _Ranges:
    """A set of address ranges, with a fast search for one that overlaps a given range.

    Ranges that overlap each other are merged.
    """

    def __init__(self, spans: Sequence[ItemRange]) -> None:
        self._spans: list[ItemRange] = []
        for span in sorted(spans):
            if self._spans and span.start < self._spans[-1].end:
                last = self._spans.pop()
                span = ItemRange(last.start, max(last.end, span.end))
            self._spans.append(span)
        self._starts = [span.start for span in self._spans]

    def touched(self, start: int, end: int) -> ItemRange | None:
        """Return the last range that overlaps the one from ``start`` to before ``end``; None if no range does."""
        at = bisect_left(self._starts, end) - 1
        if at >= 0 and self._spans[at].end > start:
            return self._spans[at]
        return None


def _ranges(spans: Sequence[ItemRange]) -> _Ranges | None:
    return _Ranges(spans) if spans else None


def _without_inner(places: list[_Place]) -> list[_Place]:
    """Return the ranges that do not lie inside another one.

    They are sorted by start, then the wider first, as those of sorted blocks are: an exact block replaces all ranges
    inside it, and none crosses its border.
    """
    kept: list[_Place] = []
    last = -1
    for place in places:
        if place[1] > last:
            kept.append(place)
            last = place[1]
    return kept


def _cheapest(places: list[_Place], border: _Borders, limit: int, base: float, per_item: float) -> list[_Place]:
    """Return the ranges of the cheapest reads that cover sorted ranges.

    No read is wider than ``limit``, or fetches two ranges that `_Borders.cut_between` separates. The other arguments
    are those of `_shortest_path`.
    """
    chosen: list[_Place] = []
    begin = 0
    for at in range(1, len(places) + 1):
        if at == len(places) or border.cut_between(places[at - 1], places[at]):
            chosen += _shortest_path(places[begin:at], limit, base, per_item)
            begin = at
    return chosen


def _shortest_path(places: list[_Place], limit: int, base: float, per_item: float) -> list[_Place]:
    """Return the ranges of the cheapest reads that cover ranges in one table, none wider than ``limit`` (rule 5).

    Args:
        places: pairs of start and end, sorted by both; none is wider than ``limit``.
        limit: most registers or bits of a read.
        base: seconds of a read without its registers or bits.
        per_item: seconds of each register or bit that is read, those in holes included.
    """
    if len(places) == 1:
        return places
    origin = places[0][0]  # small numbers keep all digits
    begins: list[int] = []  # where the run that ends at each place begins
    candidates: deque[tuple[float, int, int]] = deque()  # best[i] − c · start[i], rising; start[i]; i
    best = 0.0
    for at, (start, end) in enumerate(places):
        value = best - per_item * (start - origin)
        while candidates and candidates[-1][0] >= value:
            candidates.pop()
        candidates.append((value, start, at))
        lowest = end - limit
        while candidates[0][1] < lowest:
            candidates.popleft()
        value, _, first = candidates[0]
        begins.append(first)
        best = value + base + per_item * (end - origin)
    chosen: list[_Place] = []
    at = len(places) - 1
    while at >= 0:
        chosen.append((places[begins[at]][0], places[at][1]))
        at = begins[at] - 1
    chosen.reverse()
    return chosen


def _one_each(table: Table, blocks: list[_Block], places: list[_Place], cost: ReadCost) -> list[PlannedRead]:
    """Return one read for each block of items; blocks with the same range to read, such as an exact block, share one.

    Args:
        table: the table of the items.
        blocks: the items, in the order of their starts.
        places: the range to read for each block of items.
        cost: how long reads take.
    """
    by_place = groupby(zip(places, blocks, strict=True), key=itemgetter(0))
    return [_read(table, start, end, [block for _, block in each], cost) for (start, end), each in by_place]


def _with_items(table: Table, places: list[_Place], blocks: list[_Block], cost: ReadCost) -> list[PlannedRead]:
    """Return a read for each range, with the items that it fetches.

    An item belongs to the first read that covers it.
    """
    starts = [block[0] for block in blocks]
    taken = bytearray(len(blocks))
    reads: list[PlannedRead] = []
    for start, end in places:
        inside: list[_Block] = []
        for at in range(bisect_left(starts, start), bisect_left(starts, end)):
            if not taken[at] and blocks[at][1] <= end:
                taken[at] = 1
                inside.append(blocks[at])
        reads.append(_read(table, start, end, inside, cost))
    return reads


def _read(table: Table, start: int, end: int, blocks: list[_Block], cost: ReadCost) -> PlannedRead:
    items = tuple([item for block in blocks for item in block.items])
    return PlannedRead(table, start, end - start, items, cost.of(table, end - start))
