"""The clock of samples: in order whatever the wall clock does, and honest about it."""

import random
from itertools import pairwise

import pytest

from busway.apps.collector.sample_clock import EARLIEST, NANOSECONDS, SampleClock

START = EARLIEST + 1000 * NANOSECONDS
HOUR = 3600 * NANOSECONDS
NOON = START + 12 * HOUR


def test_it_is_the_wall_clock_while_that_runs_evenly() -> None:
    clock = SampleClock(50.0, START)
    assert clock.is_right
    assert clock.time_ns(60.0) == START + 10 * NANOSECONDS


def test_a_wall_clock_that_was_set_forward_is_followed_at_once() -> None:
    clock = SampleClock(0.0, START)
    clock.adjust(10.0, START + 10 * NANOSECONDS + HOUR)
    assert clock.time_ns(10.0) == START + 10 * NANOSECONDS + HOUR
    assert clock.is_right


def test_a_wall_clock_that_was_set_back_is_followed_without_a_step_and_that_is_said() -> None:
    clock = SampleClock(0.0, START)
    clock.adjust(10.0, START + 10 * NANOSECONDS - HOUR)
    assert clock.time_ns(10.0) == START + 10 * NANOSECONDS
    assert not clock.is_right
    times = []
    for second in range(11, 8000):
        clock.adjust(second, START + second * NANOSECONDS - HOUR)
        times.append(clock.time_ns(second))
    assert all(a < b for a, b in pairwise(times))
    assert times[-1] == START + 7999 * NANOSECONDS - HOUR
    assert clock.is_right


def test_samples_keep_their_order_whatever_the_wall_clock_does() -> None:
    source = random.Random(5)
    clock = SampleClock(0.0, START)
    wall = float(START)
    last, now = 0, 0.0
    for _ in range(5000):
        now += source.random()
        wall += source.choice((1, 1, 1, 1, 1e4, -1e4)) * NANOSECONDS * source.random()
        if source.random() < 0.5:
            clock.adjust(now, int(wall))
        time = clock.time_ns(now)
        assert time >= last
        last = time


def test_a_time_before_the_program_was_written_is_not_right() -> None:
    clock = SampleClock(0.0, 5 * NANOSECONDS)
    assert not clock.is_right
    clock.adjust(1.0, START)
    assert clock.is_right
    assert clock.time_ns(1.0) == START


def test_a_clock_that_was_never_set_is_not_followed_and_the_difference_is_told_once_when_it_is_set() -> None:
    clock = SampleClock(100.0, 5 * NANOSECONDS)
    assert clock.time_ns(110.0) == 15 * NANOSECONDS
    assert clock.adjust(110.0, 3000 * NANOSECONDS) is None, "a wrong time for another is no mend"
    assert clock.time_ns(120.0) == 25 * NANOSECONDS
    correction = clock.adjust(130.0, START)
    assert correction is not None
    assert correction.corrected(35 * NANOSECONDS) == START
    assert correction.corrected(START) == START
    assert clock.time_ns(130.0) == START
    assert clock.is_right
    assert clock.adjust(140.0, START + 11 * NANOSECONDS) is None
    assert clock.adjust(150.0, 7 * NANOSECONDS) is None
    assert not clock.is_right
    assert clock.adjust(160.0, START + 31 * NANOSECONDS) is None


def test_steps_of_an_hour_reorder_nothing_and_mend_nothing() -> None:
    clock, times = SampleClock(0.0, START), []
    for second in range(20_000):
        step = HOUR if 1000 <= second < 3000 or second >= 15_000 else -HOUR if 4000 <= second < 14_000 else 0
        if second % 5 == 0:
            assert clock.adjust(second, START + second * NANOSECONDS + step) is None
        times.append(clock.time_ns(second + 0.5))
    assert all(a < b for a, b in pairwise(times))


@pytest.mark.parametrize("step", [0, HOUR, -HOUR, 3 * NANOSECONDS, -3 * NANOSECONDS])
def test_a_clock_that_is_not_known_to_be_right_is_followed_and_corrected_once_it_is(step: int) -> None:
    clock = SampleClock(100.0, NOON, is_known=False)
    assert not clock.is_right
    given = [clock.time_ns(at) for at in (101.0, 105.0, 109.0)]
    assert clock.adjust(105.0, NOON + 5 * NANOSECONDS + step, is_known=False) is None
    assert clock.time_ns(105.0) == NOON + 5 * NANOSECONDS, "it may be set more than once"
    correction = clock.adjust(110.0, NOON + 10 * NANOSECONDS + step, is_known=True)
    assert correction is not None
    assert correction.shift == step
    assert [correction.corrected(each) for each in given] == [each + step for each in given]
    assert correction.corrected(NOON - 1) == NOON - 1, "times of an earlier process"
    assert clock.is_right
    assert clock.time_ns(111.0) == NOON + 11 * NANOSECONDS + step
    assert clock.adjust(120.0, NOON + 20 * NANOSECONDS + step, is_known=False) is None
    assert not clock.is_right
    assert clock.adjust(125.0, NOON + 25 * NANOSECONDS + step) is None
    assert clock.is_right
