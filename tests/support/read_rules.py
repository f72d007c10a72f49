"""Rules that other programs use to cut a register map into reads, and the cost of these reads.

Each rule keeps to what a device allows: a read ends where the device requires a cut. The rules share no code with the
planner, so that they can judge it.
"""

from collections.abc import Callable, Iterable, Sequence

from busway.apps.collector.cost import ReadCost
from busway.apps.collector.plan import ItemRange, PlainItem, ReadRules
from busway.codes import Table

Reads = list[tuple[Table, int, int]]


def allowed(table: Table, start: int, end: int, members: Iterable[PlainItem], rules: ReadRules) -> bool:
    """Whether one read of ``start``…``end`` may be made to fetch some items."""
    if end - start > rules.limit(table):
        return False
    if any(each.start < end and start < each.end for each in rules.forbidden.get(table, ())):
        return False
    touched_blocks = [each for each in rules.exact.get(table, ()) if each.start < end and start < each.end]
    if any((each.start, each.end) != (start, end) for each in touched_blocks):
        return False
    ranges = rules.readable.get(table, ())
    if ranges:
        return any(each.start <= start and end <= each.end for each in ranges)
    if rules.bridge or touched_blocks:
        return True
    declared: set[int] = set()
    for item in members:
        declared.update(range(item.start, item.start + item.width))
    return declared.issuperset(range(start, end))


def by_joining(items: Sequence[PlainItem], rules: ReadRules, joins: Callable[[int], bool]) -> Reads:
    """Reads made from left to right: an item joins the last read if the gap before it is of a size that ``joins``."""
    reads: Reads = []
    for table in Table:
        members: list[PlainItem] = []
        start = end = -1
        for item in sorted((one for one in items if one.table is table), key=lambda one: (one.start, one.width)):
            stop = max(end, item.start + item.width)
            if members and joins(item.start - end) and allowed(table, start, stop, [*members, item], rules):
                members.append(item)
                end = stop
                continue
            if members:
                reads.append((table, start, end))
            members, start, end = [item], item.start, item.start + item.width
        if members:
            reads.append((table, start, end))
    return reads


USUAL_RULES: dict[str, Callable[[int], bool]] = {
    "one read each": lambda gap: False,
    "overlapping": lambda gap: gap < 0,
    "touching": lambda gap: gap <= 0,
    "gap 1": lambda gap: gap <= 1,
    "gap 5": lambda gap: gap <= 5,
    "gap 10": lambda gap: gap <= 10,
    "gap 16": lambda gap: gap <= 16,
    "gap 50": lambda gap: gap <= 50,
    "gap 100": lambda gap: gap <= 100,
    "no gap limit": lambda gap: True,
}


def seconds_of(reads: Reads, cost: ReadCost) -> float:
    """What reads cost."""
    return sum(cost.of(table, end - start) for table, start, end in reads)


def spans(*pairs: tuple[int, int]) -> tuple[ItemRange, ...]:
    """Spans from pairs of first and end."""
    return tuple(ItemRange(start, end) for start, end in pairs)
