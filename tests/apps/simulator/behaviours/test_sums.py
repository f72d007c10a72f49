"""Counters and lags, against closed forms."""

import math

import pytest

from busway.apps.simulator.behaviours.sums import Counter, Lag, SteadyCounter, SteadyLag


def test_a_steady_counter_is_start_and_rate_times_time() -> None:
    counter = SteadyCounter(0.1, None, 5.0)
    assert counter.value(1e6) == 5.0 + 0.1 * 1e6
    assert counter.state(10.0) == 6.0


def test_a_counter_begins_again_at_its_rollover() -> None:
    assert [SteadyCounter(3.0, 10.0, 0.0).value(float(time)) for time in range(5)] == [0, 3, 6, 9, 2]
    assert SteadyCounter(-1.0, 10.0, 0.0).value(1.0) == 9.0
    assert [SteadyCounter(3.0, 10.0, 8.0, -5.0).value(float(time)) for time in range(3)] == [8, -4, -1]


def test_a_counter_that_counts_down_never_shows_its_rollover() -> None:
    down = SteadyCounter(-0.1, 100.0, 0.3)
    assert down.value(3.0) == 0.0, "0.3 - 0.1 * 3 is below 0 by a rounding error"
    seen = Counter(lambda time: -0.1, 65536.0, 0.3)
    seen.observe(0.0)
    assert seen.value(3.0) == 0.0
    assert SteadyCounter(-1e-20, 10.0, -5.0, -5.0).value(1.0) == -5.0


def test_a_counter_of_a_type_with_a_sign_goes_on_below_zero() -> None:
    down = SteadyCounter(-2.0, 32768.0, 1.0, goes_below=True)
    assert [down.value(float(time)) for time in range(3)] == [1, -1, -3]
    up = SteadyCounter(1.0, 3.0, -2.0, goes_below=True)
    assert [up.value(float(time)) for time in range(7)] == [-2, -1, 0, 1, 2, 0, 1]
    seen = Counter(lambda time: -3.0, 32768.0, 2.0, goes_below=True)
    seen.observe(0.0)
    assert seen.value(1.0) == -1.0


def test_a_counter_goes_on_from_what_it_was_set_to() -> None:
    counter = SteadyCounter(2.0, None, 0.0)
    counter.resume(10.0, 0.0)
    assert counter.value(13.0) == 6.0


def test_a_rate_that_is_an_expression_holds_from_when_it_was_seen() -> None:
    rates = iter([1.0, 5.0, math.nan, 2.0])
    counter = Counter(lambda time: next(rates), None, 0.0)
    found = []
    for time in range(5):
        found.append(counter.value(float(time)))
        if time < 4:
            counter.observe(float(time))
    assert found == [0, 1, 6, 6, 8]
    assert counter.state(4.0) == 8.0
    counter.resume(4.0, 1.0)
    assert counter.value(5.0) == 3.0


def test_before_the_time_at_which_it_was_set_it_is_what_it_was_set_to() -> None:
    for behaviour in (
        SteadyCounter(1e300, None, 0.0),
        SteadyLag(1.0, 0.001, 0.0),
        Counter(lambda time: 1e300, None, 0.0),
        Lag(lambda time: 1.0, 0.001, 0.0),
    ):
        behaviour.value(0.0)
        if isinstance(behaviour, Counter | Lag):
            behaviour.observe(0.0)
        behaviour.resume(10.7, 5.0)
        assert behaviour.value(10.0) == pytest.approx(5.0)


def test_a_counter_of_an_expression_rolls_over_too() -> None:
    counter = Counter(lambda time: 7.0, 10.0, 0.0)
    counter.observe(0.0)
    assert [counter.value(float(time)) for time in range(4)] == [0, 7, 4, 1]
    counter = Counter(lambda time: 7.0, 10.0, 0.0, -5.0)
    counter.observe(0.0)
    assert [counter.value(float(time)) for time in range(3)] == [0, 7, -1]


def test_a_lag_makes_63_percent_of_its_way_in_its_time_constant() -> None:
    lag = SteadyLag(100.0, 20.0, 0.0)
    assert lag.value(0.0) == 0.0
    assert lag.value(20.0) == pytest.approx(100 * (1 - math.exp(-1)))
    lag.resume(20.0, 0.0)
    assert lag.state(40.0) == pytest.approx(100 * (1 - math.exp(-1)))


def test_a_lag_towards_an_expression_goes_where_it_was_seen_last() -> None:
    targets = {0.0: 100.0, 10.0: math.nan, 20.0: 0.0}
    lag = Lag(lambda time: targets[time], 10.0, 0.0)
    assert lag.value(0.0) == 0.0
    lag.observe(0.0)
    way = 100 * (1 - math.exp(-1))
    assert lag.value(10.0) == pytest.approx(way)
    lag.observe(10.0)
    assert lag.value(20.0) == pytest.approx(way)
    lag.observe(20.0)
    assert lag.value(30.0) == pytest.approx(way * math.exp(-1))
    assert lag.state(30.0) == pytest.approx(way * math.exp(-1))
    lag.resume(30.0, 7.0)
    assert lag.value(30.0) == 7.0
