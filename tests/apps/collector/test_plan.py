"""The read plan: what it may touch, what comes for nothing, and that nothing cheaper exists."""

import functools
import heapq
import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from processor_time import cpu_seconds
from read_rules import USUAL_RULES, allowed, by_joining, seconds_of, spans

from busway.apps.collector.cost import ReadCost, baud_cost, network_cost
from busway.apps.collector.plan import DevicePlan, ItemRange, PlainItem, ReadRules, plan_reads, predicted, undeclared
from busway.codes import Table

H, C = Table.HOLDING_REGISTERS, Table.COILS
SLOW = baud_cost(9600)
BRIDGED = ReadRules(bridge=True)


def at(start: int, width: int = 1, table: Table = H, group: str | None = None) -> PlainItem:
    return PlainItem(table, start, width, f"{table.value}{start}+{width}", group)


def places(plan: DevicePlan) -> list[tuple[int, int]]:
    return [(read.start, read.width) for read in plan.reads]


# Which registers a read may touch.


def test_items_that_touch_come_with_one_read() -> None:
    plan = plan_reads([at(2, 2), at(0, 2), at(4)], ReadRules(), SLOW)
    assert places(plan) == [(0, 5)]
    assert [item.start for item in plan.reads[0].items] == [0, 2, 4]
    assert plan.seconds == pytest.approx(SLOW.of(H, 5))


def test_an_undeclared_gap_is_never_read() -> None:
    assert places(plan_reads([at(0), at(2)], ReadRules(), SLOW)) == [(0, 1), (2, 1)]


def test_a_hole_is_read_where_the_device_bridges_and_the_hole_is_cheaper_than_a_request() -> None:
    assert places(plan_reads([at(0), at(15)], BRIDGED, SLOW)) == [(0, 16)]
    assert places(plan_reads([at(0), at(16)], BRIDGED, SLOW)) == [(0, 1), (16, 1)]


def test_a_hole_inside_a_readable_range_is_read_and_none_between_two_ranges() -> None:
    rules = ReadRules(readable={H: spans((0, 10), (10, 20))})
    assert places(plan_reads([at(0), at(8), at(11), at(13)], rules, SLOW)) == [(0, 9), (11, 3)]


def test_values_that_touch_are_not_read_across_the_border_of_a_range() -> None:
    rules = ReadRules(readable={H: spans((0, 10), (10, 20))}, bridge=True)
    assert places(plan_reads([at(9), at(10)], rules, SLOW)) == [(9, 1), (10, 1)]


def test_no_read_touches_a_forbidden_register() -> None:
    rules = ReadRules(forbidden={H: spans((5, 6))}, bridge=True)
    assert places(plan_reads([at(0), at(4), at(6)], rules, SLOW)) == [(0, 5), (6, 1)]


def test_forbidden_ranges_may_overlap() -> None:
    rules = ReadRules(forbidden={H: spans((2, 20), (4, 6))}, bridge=True)
    assert places(plan_reads([at(0), at(21)], rules, SLOW)) == [(0, 1), (21, 1)]
    assert len(plan_reads([at(10)], rules, SLOW).unreadable) == 1


def test_an_item_that_no_read_may_bring_is_named_with_the_reason() -> None:
    rules = ReadRules(max_registers=10, forbidden={H: spans((5, 6))}, readable={H: spans((0, 50))})
    plan = plan_reads([at(4, 2), at(20, 11), at(49, 2), at(0)], rules, SLOW)
    assert places(plan) == [(0, 1)]
    reasons = {one.item.start: one.reason for one in plan.unreadable}
    assert reasons == {
        4: "holding registers 5…5 must not be read",
        20: "11 holding registers are more than the 10 that one read may have",
        49: "it does not lie in one of the readable ranges",
    }


def test_no_read_is_wider_than_the_device_allows() -> None:
    plan = plan_reads([at(start, 2) for start in range(0, 40, 2)], ReadRules(max_registers=9), SLOW)
    assert max(read.width for read in plan.reads) == 8
    assert len(plan.reads) == 5


def test_bits_have_their_own_limit_and_price() -> None:
    plan = plan_reads([at(0, table=C), at(1500, table=C)], ReadRules(bridge=True), SLOW)
    assert places(plan) == [(0, 1), (1500, 1)]
    plan = plan_reads([at(0, table=C), at(200, table=C)], ReadRules(bridge=True), SLOW)
    assert places(plan) == [(0, 201)]


def test_each_table_is_read_by_itself() -> None:
    plan = plan_reads([at(0), at(0, table=Table.INPUT_REGISTERS), at(0, table=C)], BRIDGED, SLOW)
    assert [read.table for read in plan.reads] == [C, Table.INPUT_REGISTERS, H]


def test_an_exact_block_is_read_as_a_whole_and_alone() -> None:
    rules = ReadRules(exact={H: spans((10, 20))}, bridge=True)
    plan = plan_reads([at(9), at(12), at(18, 2), at(20)], rules, SLOW)
    assert places(plan) == [(9, 1), (10, 10), (20, 1)]
    assert [item.start for item in plan.reads[1].items] == [12, 18]
    across = plan_reads([at(19, 2)], rules, SLOW)
    assert across.unreadable[0].reason == "it crosses the border of the exact block 10…19"


def test_an_exact_block_that_nothing_is_wanted_of_is_not_touched() -> None:
    rules = ReadRules(exact={H: spans((10, 12))}, bridge=True)
    assert places(plan_reads([at(9), at(12)], rules, SLOW)) == [(9, 1), (12, 1)]


def test_an_exact_block_is_read_whole_and_once_also_where_each_point_takes_a_request_of_its_own() -> None:
    rules = ReadRules(one_point=True, exact={H: spans((0, 10))})
    assert places(plan_reads([at(3)], rules, SLOW)) == [(0, 10)]
    plan = plan_reads([at(12), at(5), at(3, 2), at(4), at(11)], rules, SLOW)
    assert places(plan) == [(0, 10), (11, 1), (12, 1)]
    assert [item.start for item in plan.reads[0].items] == [3, 4, 5]


def test_a_device_that_gives_one_point_for_a_request_is_asked_for_one_at_a_time() -> None:
    plan = plan_reads([at(0), at(1), at(1), at(0, 2)], ReadRules(one_point=True), SLOW)
    assert sorted(places(plan)) == [(0, 1), (0, 2), (1, 1)]
    assert sum(len(read.items) for read in plan.reads) == 4


# What comes together, and what comes for nothing.


def test_the_bits_of_one_register_are_one_item() -> None:
    bits = [PlainItem(H, 7, 1, f"bit {bit}") for bit in range(16)]
    plan = plan_reads(bits, ReadRules(), SLOW)
    assert places(plan) == [(7, 1)]
    assert len(plan.reads[0].items) == 16


def test_an_item_inside_another_is_free() -> None:
    plan = plan_reads([at(10, 20), at(12, 4), at(29)], ReadRules(), SLOW)
    assert places(plan) == [(10, 20)]
    assert len(plan.reads[0].items) == 3


def test_a_point_that_is_not_due_comes_with_a_read_that_covers_it_and_never_causes_one() -> None:
    others = [at(2), at(1, 3), at(50)]
    plan = plan_reads([at(0), at(4)], BRIDGED, SLOW, others=others)
    assert places(plan) == [(0, 5)]
    assert {item.key for item in plan.reads[0].items} == {at(0).key, at(4).key, at(2).key, at(1, 3).key}


def test_a_hole_between_points_that_are_due_is_read_where_points_that_are_not_due_fill_it() -> None:
    due = [at(0), at(4)]
    assert places(plan_reads(due, ReadRules(), SLOW, others=[at(1), at(2, 2)])) == [(0, 5)]
    assert places(plan_reads(due, ReadRules(), SLOW, others=[at(0, 5)])) == [(0, 5)]
    assert places(plan_reads(due, ReadRules(), SLOW, others=[at(1, 2)])) == [(0, 1), (4, 1)], "nothing says what 3 is"
    assert places(plan_reads(due, ReadRules(), SLOW, others=[at(1, 3, table=C)])) == [(0, 1), (4, 1)]


def test_an_atomic_group_whose_hole_another_point_fills_is_read() -> None:
    group = [at(0, group="g"), at(2, group="g")]
    assert places(plan_reads([*group, at(1)], ReadRules(), SLOW)) == [(0, 3)]
    assert places(plan_reads(group, ReadRules(), SLOW, others=[at(1)])) == [(0, 3)]


def test_an_atomic_group_is_in_one_read() -> None:
    group = [at(0, 2, group="energy"), at(60, 2, group="energy"), at(30)]
    assert places(plan_reads(group, BRIDGED, SLOW)) == [(0, 62)]
    assert places(plan_reads([at(0, 2), at(60, 2), at(30)], BRIDGED, SLOW)) == [(0, 2), (30, 1), (60, 2)]


def test_an_atomic_group_in_an_exact_block_may_have_holes_which_are_read_anyway() -> None:
    plan = plan_reads([at(12, group="g"), at(18, group="g")], ReadRules(exact={H: spans((10, 20))}), SLOW)
    assert places(plan) == [(10, 10)]
    assert [item.start for item in plan.reads[0].items] == [12, 18]


def test_an_atomic_group_with_an_undeclared_hole_is_refused_instead_of_read() -> None:
    plan = plan_reads([at(0, group="g"), at(2, group="g")], ReadRules(), SLOW)
    assert not plan.reads
    assert len(plan.unreadable) == 2
    assert "its group has an undeclared hole" in plan.unreadable[0].reason


def test_a_group_that_is_not_due_comes_whole_or_not_at_all() -> None:
    group = [at(1, group="g"), at(3, group="g")]
    plan = plan_reads([at(0), at(2)], BRIDGED, SLOW, others=group)
    assert [item.start for item in plan.reads[0].items] == [0, 2]


def test_undeclared_registers_that_a_read_touches_are_listed() -> None:
    items = [at(0), at(3), at(8)]
    read = plan_reads(items, BRIDGED, SLOW).reads[0]
    assert undeclared(read, items, BRIDGED) == list(spans((1, 3), (4, 8)))
    inside = ReadRules(readable={H: spans((0, 6))}, bridge=True)
    assert undeclared(read, items, inside) == list(spans((6, 8)))


def test_the_cost_of_reads_is_told_for_another_device_too() -> None:
    plan = plan_reads([at(0), at(100)], BRIDGED, SLOW)
    assert predicted(plan.reads, SLOW) == pytest.approx(plan.seconds)
    assert predicted(plan.reads, SLOW.with_base(1.0)) == pytest.approx(2 * (1.0 + SLOW.per_register))


def test_of_two_plans_with_as_many_reads_the_narrower_is_taken_on_a_network() -> None:
    plan = plan_reads([at(0), at(100), at(130)], BRIDGED, network_cost())
    assert places(plan) == [(0, 1), (100, 31)]


# Nothing cheaper exists.

COSTS = st.builds(
    ReadCost, st.floats(0.001, 0.1), st.sampled_from((1e-7, 0.0002, 0.0023)), st.sampled_from((1e-8, 0.0001))
)


@st.composite
def maps(
    draw: st.DrawFn, most: int, size: int, groups: tuple[str | None, ...] = (None, None, None, "a", "b")
) -> list[PlainItem]:
    """Items of a table: scattered, touching, overlapping, one inside another; some of them in atomic groups."""
    count = draw(st.integers(1, most))
    found: list[PlainItem] = []
    edge = 0
    for key in range(count):
        step = draw(st.sampled_from((0, 0, 0, 1, 2, 5, 14, 30, -1, -2)))
        width = draw(st.sampled_from((1, 1, 2, 2, 4, 8)))
        start = min(max(0, edge + step), size - width)
        found.append(PlainItem(H, start, width, key, draw(st.sampled_from(groups))))
        edge = start + width
    return found


@st.composite
def device_rules(draw: st.DrawFn, size: int, exact: bool = True) -> ReadRules:
    """Limits, ranges, forbidden registers and exact blocks."""
    limit = draw(st.sampled_from((8, 16, 40, 125)))
    borders = sorted(draw(st.sets(st.integers(1, size - 1), max_size=3)))
    readable: tuple[ItemRange, ...] = ()
    if draw(st.booleans()):
        edges = [0, *borders, size]
        readable = tuple(ItemRange(low, high) for low, high in pairwise(edges))
    forbidden = tuple(
        ItemRange(place, place + 1) for place in sorted(draw(st.sets(st.integers(0, size - 1), max_size=3)))
    )
    blocks: list[ItemRange] = []
    for start in sorted(draw(st.sets(st.integers(0, size - 1), max_size=3 if exact else 0))):
        if not blocks or start >= blocks[-1].end:
            blocks.append(ItemRange(start, min(start + draw(st.sampled_from((1, 2, 5, 10, 30))), size)))
    return ReadRules(
        max_registers=limit,
        readable={H: readable} if readable else {},
        forbidden={H: forbidden} if forbidden else {},
        exact={H: tuple(blocks)} if blocks else {},
        bridge=draw(st.booleans()),
    )


def units_of(
    items: Sequence[PlainItem], rules: ReadRules, others: Sequence[PlainItem] = ()
) -> tuple[list[PlainItem], list[PlainItem]]:
    """What a read brings as a whole, as one item each, and the items of it: items, groups, exact blocks; in that order.

    What no read may bring is left out. A group may have a hole where holes may be read, in an exact block, and where
    other items fill it.
    """
    groups: dict[object, list[PlainItem]] = {}
    for one in items:
        groups.setdefault(one.key if one.group is None else one.group, []).append(one)
    units: list[PlainItem] = []
    kept: list[PlainItem] = []
    for key, members in groups.items():
        start, end = min(one.start for one in members), max(one.start + one.width for one in members)
        for block in rules.exact.get(H, ()):
            if block.start <= start and end <= block.end:
                start, end = block.start, block.end
        if allowed(H, start, end, [*items, *others], rules):
            units.append(PlainItem(H, start, end - start, key))
            kept += members
    return units, kept


def partitions(items: Sequence[PlainItem]) -> Iterator[list[list[PlainItem]]]:
    """Every way to put items into reads, in any order and with any neighbours."""
    if not items:
        yield []
        return
    first, rest = items[0], items[1:]
    for other in partitions(rest):
        yield [[first], *other]
        for index, part in enumerate(other):
            yield [*other[:index], [first, *part], *other[index + 1 :]]


def by_trying_everything(
    units: Sequence[PlainItem], known: Sequence[PlainItem], rules: ReadRules, cost: ReadCost
) -> float:
    least = float("inf")
    can_read = functools.cache(lambda start, end: allowed(H, start, end, known, rules))  # also what no unit fills
    for parts in partitions(units):
        total = 0.0
        for part in parts:
            start, end = min(one.start for one in part), max(one.start + one.width for one in part)
            if not can_read(start, end):
                break
            total += cost.of(H, end - start)
        else:
            least = min(least, total)
    return least


@given(maps(7, 80), maps(7, 80), device_rules(80), COSTS)
@settings(max_examples=examples(300))
def test_no_way_to_put_few_items_into_reads_is_cheaper(
    items: list[PlainItem], others: list[PlainItem], rules: ReadRules, cost: ReadCost
) -> None:
    plan = plan_reads(items, rules, cost, others=not_due(others))
    units, possible = units_of(items, rules, others)
    assert {one.item.key for one in plan.unreadable} == {one.key for one in items} - {one.key for one in possible}
    assert plan.seconds == pytest.approx(by_trying_everything(units, [*items, *others], rules, cost))
    check_reads(plan, possible, [*units, *items, *others], rules)


def by_walking_registers(
    items: Sequence[PlainItem], known: Sequence[PlainItem], rules: ReadRules, cost: ReadCost
) -> float:
    """The least cost by Dijkstra over registers: a state is "all items that begin before here are read".

    From a register that begins an item, a read may have any width the rules allow; it leads to the first item that it
    does not bring. Nothing here knows of items inside one another, or of runs.
    """
    if not items:
        return 0.0
    starts = sorted({one.start for one in items})
    heap: list[tuple[float, int]] = [(0.0, starts[0])]
    settled: dict[int, float] = {}
    while heap:
        spent, place = heapq.heappop(heap)
        if place in settled:
            continue
        settled[place] = spent
        if place > starts[-1]:
            return spent
        for end in sorted({one.start + one.width for one in items if one.start >= place}):
            if end - place > rules.limit(H):
                break
            inside = [one for one in items if place <= one.start and one.start + one.width <= end]
            if inside and allowed(H, place, end, known, rules):
                left = [one.start for one in items if one.start >= place and one not in inside]
                heapq.heappush(heap, (spent + cost.of(H, end - place), min(left, default=starts[-1] + 1)))
    raise AssertionError("no way to read all items")


@given(maps(30, 300), maps(30, 300), device_rules(300), COSTS)
@settings(max_examples=examples(150))
def test_an_independent_search_over_registers_finds_nothing_cheaper(
    items: list[PlainItem], others: list[PlainItem], rules: ReadRules, cost: ReadCost
) -> None:
    units, possible = units_of(items, rules, others)
    plan = plan_reads(items, rules, cost, others=not_due(others))
    assert plan.seconds == pytest.approx(by_walking_registers(units, [*items, *others], rules, cost))
    check_reads(plan, possible, [*units, *items, *others], rules)


@given(maps(60, 2000, (None,)), device_rules(2000, exact=False), COSTS)
@settings(max_examples=examples(200))
def test_none_of_the_usual_rules_is_cheaper_on_any_map(
    items: list[PlainItem], rules: ReadRules, cost: ReadCost
) -> None:
    """Without groups and exact blocks, which these rules do not know: what they read would not be what is wanted."""
    plan = plan_reads(items, rules, cost)
    _, possible = units_of(items, rules)
    for name, joins in USUAL_RULES.items():
        usual = seconds_of(by_joining(possible, rules, joins), cost)
        assert plan.seconds <= usual * (1 + 1e-9), name


def check_reads(plan: DevicePlan, items: Sequence[PlainItem], units: Sequence[PlainItem], rules: ReadRules) -> None:
    """Each item comes once and whole, a group by one read, and no read touches what it must not."""
    brought = [item.key for read in plan.reads for item in read.items if not str(item.key).startswith("not due")]
    assert sorted(brought) == sorted(one.key for one in items)
    for read in plan.reads:
        assert all(read.start <= one.start and one.start + one.width <= read.end for one in read.items)
        assert allowed(read.table, read.start, read.end, [one for one in units if one.start < read.end], rules)
    for name in {one.group for one in items} - {None}:
        assert sum(name in {one.group for one in read.items} for read in plan.reads) == 1


def not_due(others: Sequence[PlainItem]) -> list[PlainItem]:
    """Items that need not be read, with keys and groups of their own."""
    return [
        replace(one, key=f"not due {one.key}", group=None if one.group is None else f"not due {one.group}")
        for one in others
    ]


# How the usual rules compare.


def test_the_usual_rules_cost_from_a_little_to_several_times_the_optimum_over_random_maps() -> None:
    source = random.Random(20_261_122)
    worst = dict.fromkeys(USUAL_RULES, 1.0)
    for _ in range(60):
        count, size = source.choice(((20, 200), (60, 400), (120, 3000))), source.choice((9600, 115_200, 0))
        cost = baud_cost(size) if size else network_cost()
        items = [PlainItem(H, start, 1, start) for start in source.sample(range(count[1]), count[0])]
        best = plan_reads(items, BRIDGED, cost).seconds
        for name, joins in USUAL_RULES.items():
            ratio = seconds_of(by_joining(items, BRIDGED, joins), cost) / best
            assert ratio >= 1 - 1e-9
            worst[name] = max(worst[name], ratio)
    assert all(ratio > 1.02 for ratio in worst.values())
    assert max(worst.values()) == pytest.approx(19.9, abs=0.1)


def test_a_free_register_after_each_value_makes_two_of_the_usual_rules_twenty_times_as_dear_on_a_network() -> None:
    items, cost = [at(place) for place in range(0, 40, 2)], network_cost()
    plan = plan_reads(items, BRIDGED, cost)
    assert places(plan) == [(0, 39)]
    for name in ("one read each", "touching"):
        reads = by_joining(items, BRIDGED, USUAL_RULES[name])
        assert len(reads) == 20
        assert seconds_of(reads, cost) / plan.seconds == pytest.approx(20, abs=0.05)


# How long planning takes.


@pytest.mark.alone
@pytest.mark.parametrize(("count", "limit"), [(10_000, 0.050), (50_000, 0.300)])
def test_a_plan_of_many_points_takes_little_time_of_the_processor(count: int, limit: float) -> None:
    source = random.Random(count)
    items = [PlainItem(H, start, source.choice((1, 2)), start) for start in source.sample(range(65_530), count)]
    assert cpu_seconds(lambda: plan_reads(items, BRIDGED, SLOW), limit) <= limit
