"""Durations as people write them."""

import pytest

from busway.values.durations import duration


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("500ms", 0.5), (" 1.5 s ", 1.5), (".5m", 30), ("2min", 120), ("1h", 3600), ("1d", 86_400), ("2w", 1_209_600)],
)
def test_a_duration_has_a_number_and_a_unit(text: str, seconds: float) -> None:
    assert duration(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "5 x", "-1s", "1e3s", "1s 2m", "ms", "10", "1234567890s"])
def test_everything_else_is_none(text: str) -> None:
    assert duration(text) is None


def test_a_bare_number_is_seconds_where_that_is_meant() -> None:
    assert (duration("10", bare=True), duration("2m", bare=True)) == (10, 120)
