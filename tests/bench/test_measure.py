"""Medians, spreads, ratios and exponents of the benchmark, and what becomes of a contender that fails."""

from collections.abc import Callable

import pytest
from harness.measure import Sample, Series, alternate, in_pairs, ratio, spread
from harness.report import Bar
from harness.window import BURST, burst
from offline.timing import exponent


def series(*rates: float) -> Series:
    return Series("one", [Sample(rate) for rate in rates])


def test_ratio_is_taken_round_by_round_so_that_a_noisy_round_hits_both() -> None:
    mine, theirs = series(100, 10, 120), series(50, 5, 40)
    assert ratio(mine, theirs, "rate") == 2.0


def test_ratio_with_a_contender_that_is_not_there_is_not_measured() -> None:
    assert ratio(series(1), None, "rate") is None
    assert ratio(series(1), series(), "rate") is None


def test_spread_is_half_the_distance_of_the_extremes_in_per_cent_of_the_median() -> None:
    assert spread([90, 100, 120]) == pytest.approx(15.0)
    assert spread([]) is None


def test_contender_that_fails_is_left_out_from_then_on_and_says_why() -> None:
    calls = []

    def fails() -> Sample:
        calls.append("fails")
        raise OSError("it is gone")

    def works() -> Sample:
        calls.append("works")
        return Sample(1.0)

    found = alternate({"a": fails, "b": works}, 2, (OSError,), lambda text: None)
    assert calls == ["fails", "works", "works"]
    assert (found["a"].samples, found["a"].missing) == ([], "it is gone")
    assert len(found["b"].samples) == 2


@pytest.mark.parametrize(
    ("value", "relation", "verdict"),
    [(5.0, ">=", "ok"), (4.9, ">=", "missed"), (5.0, "<=", "ok"), (5.1, "<=", "missed"), (None, ">=", "not measured")],
)
def test_bar_says_what_became_of_a_goal(value: float | None, relation: str, verdict: str) -> None:
    assert Bar("a goal", value, relation, 5.0).verdict == verdict  # type: ignore[arg-type]


def test_exponent_is_0_for_a_flat_cost_and_1_for_one_in_proportion() -> None:
    sizes = (1, 10, 100)
    assert exponent(sizes, (7, 7, 7)) == pytest.approx(0.0)
    assert exponent(sizes, (3, 30, 300)) == pytest.approx(1.0)
    assert exponent(sizes, (2, 20**0.5 * 2**0.5, 20)) == pytest.approx(0.5)


def test_callers_report_less_at_a_time_where_they_are_many() -> None:
    assert burst(1) == burst(16) == BURST
    assert burst(64) == 2
    assert burst(1000) == 1


def test_two_contenders_follow_each_other_in_pairs_and_come_first_by_turns() -> None:
    calls: list[str] = []

    def contender(name: str) -> Callable[[], Sample]:
        return lambda: calls.append(name) or Sample(float(len(calls)))  # type: ignore[func-returns-value]

    found = in_pairs({name: contender(name) for name in "ab"}, 3, (OSError,), lambda text: None)
    assert calls == ["a", "b", "b", "a", "a", "b"]
    assert (found["a"].values("rate"), found["b"].values("rate")) == ([1, 4, 5], [2, 3, 6])


def test_pairs_end_when_one_of_both_fails() -> None:
    said: list[str] = []
    samples = iter([Sample(1.0)])

    def fails_later() -> Sample:
        for sample in samples:
            return sample
        raise OSError("it is gone")

    found = in_pairs({"a": lambda: Sample(2.0), "b": fails_later}, 5, (OSError,), said.append)
    assert (found["a"].values("rate"), found["b"].values("rate")) == ([2.0], [])
    assert (found["b"].missing, said) == ("it is gone", ["b: left out. it is gone"])
