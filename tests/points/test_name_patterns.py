"""Patterns of names."""

import pytest

from busway.points.name_patterns import is_meant, point_pattern


@pytest.mark.parametrize(
    ("given", "whole"),
    [("meter-7", "meter-7/*"), ("meter-*", "meter-*/*"), ("meter-7/power", "meter-7/power"), ("*", "*")],
)
def test_a_device_alone_means_all_its_points(given: str, whole: str) -> None:
    assert point_pattern(given) == whole


def test_brackets_stand_for_themselves_and_a_star_also_for_a_slash() -> None:
    assert is_meant("plc/level[3]", "plc/level[3]")
    assert not is_meant("plc/level3", "plc/level[3]")
    assert is_meant("plc/level[3]", "*")
