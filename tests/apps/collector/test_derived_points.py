"""Points that are more than what a reply says: totals, computed points, members that a count names."""

import math
from typing import Any

import pytest

from busway.apps.collector.derived_points import DerivedPoints
from busway.apps.collector.samples import PointGroup, SampleBatch
from busway.codes import Table
from busway.points import Point, Reason
from busway.values import value_type

H = Table.HOLDING_REGISTERS


def number(name: str, start: int, **more: Any) -> Point:
    return Point(name, H, start, value_type("uint16"), **more)


def computed(name: str, formula: str) -> Point:
    return Point(name, H, 0, formula=formula)


def batch(values: dict[str, Any], reasons: Any = 0) -> SampleBatch:
    return SampleBatch(PointGroup("d", tuple(values)), 1000, 10, list(values.values()), reasons)


def test_a_device_without_such_points_needs_nothing() -> None:
    assert DerivedPoints("d", [number("a", 1)]).is_empty


def test_the_sample_of_an_accumulator_is_its_total() -> None:
    derived = DerivedPoints("d", [number("energy", 1, rollover=65_536.0), number("a", 2)])
    assert list(derived.take(batch({"energy": 65_000, "a": 1}), 0.0)[0].values) == [65_000, 1]
    assert list(derived.take(batch({"energy": 100, "a": 2}), 0.0)[0].values) == [65_636, 2]
    assert derived.computed(1, 1, 0.0) is None


def test_computed_points_get_a_sample_after_a_round_that_read_one_of_their_inputs() -> None:
    derived = DerivedPoints("d", [number("u", 1), number("i", 2), number("x", 3), computed("p", "u * i")])
    derived.take(batch({"u": 230}), 0.0)
    first = derived.computed(7, 1, 0.0)
    assert first is not None
    assert first.time == 7
    assert (list(first.values), list(first.reason_column())) == ([None], [Reason.NO_INPUT])
    derived.take(batch({"i": 2}), 0.0)
    second = derived.computed(8, 1, 0.0)
    assert second is not None
    assert (second.points, list(second.values), second.reasons) == (("p",), [460.0], 0)
    derived.take(batch({"x": 5}), 0.0)
    assert derived.computed(9, 1, 0.0) is None


def test_what_is_computed_from_an_input_that_was_not_read_when_due_is_held() -> None:
    points = [number("fast", 1), number("slow", 2), computed("sum", "fast + slow"), computed("twice", "2 * fast")]
    derived = DerivedPoints("d", points, limits={"fast": 3.0, "slow": 120.0, "sum": 3.0})
    derived.take(batch({"fast": 1, "slow": 2}), 0.0)
    for at, reason in [(119.0, Reason.NONE), (121.0, Reason.HELD)]:
        derived.take(batch({"fast": 1}), at)
        found = derived.computed(1, 1, at)
        assert found is not None
        assert list(found.values) == [3.0, 2.0]
        assert list(found.reason_column()) == [reason, Reason.NONE], at
    derived.take(batch({"slow": 5}), 122.0)
    found = derived.computed(1, 1, 122.0)
    assert found is not None
    assert (list(found.values), found.reasons) == ([6.0, 2.0], 0)


def test_whether_the_clock_is_right_now_decides_and_not_whether_it_was_when_inputs_were_read() -> None:
    derived = DerivedPoints("d", [number("fast", 1), number("slow", 2), computed("sum", "fast + slow")])
    derived.take(batch({"fast": 1, "slow": 2}, Reason.CLOCK), 0.0)
    early = derived.computed(1, 1, 0.0, Reason.CLOCK)
    derived.take(batch({"fast": 1}), 1.0)
    right = derived.computed(1, 1, 1.0)
    derived.take(batch({"fast": 1}), 2.0)
    lost = derived.computed(1, 1, 2.0, Reason.CLOCK)
    assert [list(each.reason_column()) for each in (early, right, lost) if each] == [
        [Reason.CLOCK],
        [0],
        [Reason.CLOCK],
    ]


def test_a_computed_point_has_no_value_where_a_read_of_an_input_failed() -> None:
    derived = DerivedPoints("d", [number("u", 1), computed("double", "2 * u")])
    derived.take(batch({"u": 1}), 0.0)
    derived.failed(("u",), Reason.TIMEOUT)
    found = derived.computed(1, 1, 0.0)
    assert found is not None
    assert list(found.reason_column()) == [Reason.NO_INPUT]


def test_members_of_a_group_are_there_once_their_number_is_known() -> None:
    members = [number(f"string.{at}", 10 + at, exists=(("strings", at),)) for at in (1, 2, 3)]
    derived = DerivedPoints("d", [number("strings", 1), *members])
    assert derived.absent() == members
    _, changed = derived.take(batch({"strings": 2}), 0.0)
    assert changed
    assert derived.absent() == members[2:]
    assert not derived.take(batch({"strings": 2}), 0.0)[1]
    assert derived.take(batch({"strings": 3}), 0.0)[1]
    assert derived.absent() == []


@pytest.mark.parametrize("size", [math.inf, -math.inf, math.nan, None, "2"])
def test_a_size_of_a_group_that_is_no_number_of_members_leaves_the_members_as_they_were(size: Any) -> None:
    members = [number(f"string.{at}", 10 + at, exists=(("strings", at),)) for at in (1, 2, 3)]
    derived = DerivedPoints("d", [Point("strings", H, 1, value_type("float32")), *members])
    assert not derived.take(batch({"strings": size}), 0.0)[1]
    assert derived.absent() == members
    assert derived.take(batch({"strings": 2.0}), 0.0)[1]
    assert not derived.take(batch({"strings": size}), 0.0)[1]
    assert derived.absent() == members[2:]
