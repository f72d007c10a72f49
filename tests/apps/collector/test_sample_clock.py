"""The clock of samples: in order whatever the wall clock does, and honest about it."""

import random
from itertools import pairwise

from busway.apps.collector.sample_clock import EARLIEST, NANOSECONDS, SampleClock

START = EARLIEST + 1000 * NANOSECONDS
HOUR = 3600 * NANOSECONDS


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
