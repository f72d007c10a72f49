"""Which points have other names after a file was read again."""

import pytest

from busway.apps.collector.renaming import new_names
from busway.codes import Table
from busway.points.point import Point


def points(text: str) -> list[Point]:
    """Points from ``b:a c``: b was a, and c."""
    parts = (each.partition(":") for each in text.split())
    return [Point(name, Table.HOLDING_REGISTERS, 0, was=was) for name, _, was in parts]


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("a b", "a b", {}),
        ("a b", "n:a b", {"a": "n"}),
        ("n:a b", "n:a b", {}),  # it had its effect before
        ("a b", "b:a a:b", {"a": "b", "b": "a"}),
        ("b:a a:b", "b:a a:b", {}),
        ("a b c", "first:a a:b b:c", {"a": "first", "b": "a", "c": "b"}),
        ("a b", "b:a b2", {}),  # b keeps its name in what is kept
        ("n:a b", "n:a a", {}),  # a new point under a name that was given up
        ("a", "b", {}),
        ("a", "a:a", {}),
        ("a", "n:a m:a", {"a": "n"}),
    ],
)
def test_names_change_at_once_and_each_once(old: str, new: str, names: dict[str, str]) -> None:
    assert new_names(points(old), points(new)) == names


def test_a_point_that_is_only_in_what_is_kept_may_be_renamed_or_keep_its_name() -> None:
    assert new_names(points("b"), points("n:gone b"), ["gone"]) == {"gone": "n"}
    assert new_names(points("a"), points("gone:a"), ["gone"]) == {}
