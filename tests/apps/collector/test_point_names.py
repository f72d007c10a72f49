"""Which points have other names after a file was read again."""

import pytest

from busway.apps.collector.point_names import PointNames
from busway.apps.collector.samples import PointDescription


def described(text: str) -> list[PointDescription]:
    """Points from ``b:a c``: b was a, and c."""
    parts = (each.partition(":") for each in text.split())
    return [PointDescription("pump", name, was=was or None) for name, _, was in parts]


def names_after(*files: str) -> PointNames:
    names = PointNames()
    for file in files:
        names.describe(described(file))
    return names


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
    moved = names_after(old).describe(described(new))
    assert {was: name for (_, was), name in moved.items()} == names


def test_a_line_that_had_its_effect_has_none_when_it_comes_back() -> None:
    names = names_after("a b", "b:a a:b", "a b")
    numbers = dict(names.ids)
    assert names.describe(described("b:a a:b")) == {}
    assert names.ids == numbers


def test_a_new_point_under_a_name_that_was_given_up_keeps_it_while_the_line_stays() -> None:
    names = names_after("a", "n:a")
    assert names.describe(described("n:a a")) == {}
    assert names.describe(described("n:a a")) == {}
    assert names.describe(described("n:a m:a")) == {("pump", "a"): "m"}


def test_points_of_other_devices_have_names_of_their_own() -> None:
    names = names_after("a")
    assert names.describe([PointDescription("valve", "n", was="a")]) == {}
