"""Ranges of items: compared with a set of offsets."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from busway.apps.replay.item_ranges import ItemRanges


@given(st.lists(st.tuples(st.integers(0, 60), st.integers(1, 8)), max_size=25))
def test_ranges_hold_what_was_added_and_touch_nowhere(added: list[tuple[int, int]]) -> None:
    ranges = ItemRanges()
    for first, count in added:
        ranges.add(first, count)
    found = list(ranges)
    wanted = {offset for first, count in added for offset in range(first, first + count)}
    assert [offset for first, end in found for offset in range(first, end)] == sorted(wanted)
    assert all(end < first for (_, end), (first, _) in pairwise(found))
    assert len(ranges) == len(found)
