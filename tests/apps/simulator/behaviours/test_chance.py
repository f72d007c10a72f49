"""Noise and random walk: the same for the same seed, and of the shape that they say."""

import itertools
import math
import statistics
from typing import Any

from busway.apps.simulator.behaviours.chance import Noise, RandomWalk, drawn, stream_of
from busway.config.files.behaviours import KINDS


def noise(**keys: Any) -> Any:
    return KINDS["noise"].model_validate({"kind": "noise", **keys})


def walk(**keys: Any) -> Any:
    return KINDS["random-walk"].model_validate({"kind": "random-walk", **keys})


def test_numbers_are_equally_distributed_and_each_seed_has_its_own() -> None:
    stream = stream_of(1, "1/a")
    numbers = [drawn(stream, index) for index in range(4000)]
    assert all(0 <= each < 1 for each in numbers)
    assert abs(statistics.fmean(numbers) - 0.5) < 0.02
    assert abs(statistics.pstdev(numbers) - 12**-0.5) < 0.01
    assert stream_of(1, "1/a") == stream
    assert len({stream, stream_of(2, "1/a"), stream_of(1, "1/b")}) == 3


def test_noise_lies_around_its_mean() -> None:
    uniform = Noise(noise(mean=10, spread=2), stream_of(0, "x"))
    values = [uniform.value(float(time)) for time in range(2000)]
    assert all(8 <= value < 12 for value in values)
    assert abs(statistics.fmean(values) - 10) < 0.1
    normal = Noise(noise(mean=10, spread=2, distribution="gauss"), stream_of(0, "x"))
    values = [normal.value(float(time)) for time in range(4000)]
    assert abs(statistics.fmean(values) - 10) < 0.15
    assert abs(statistics.pstdev(values) - 2) < 0.15
    assert all(map(math.isfinite, values))


def test_noise_at_a_moment_is_the_same_whatever_was_asked_before() -> None:
    one, other = (Noise(noise(spread=1, every=0.5), stream_of(3, "x")) for _ in range(2))
    before = [one.value(time / 2) for time in range(100)]
    assert other.value(40.0) == before[80]
    assert other.state(40.0) is None


def test_a_walk_makes_small_steps_and_turns_back_at_its_ends() -> None:
    walking = RandomWalk(walk(step=1.0), stream_of(0, "x"), 5.0, 4.0, 6.0)
    values = [walking.value(float(time)) for time in range(500)]
    assert values[0] == 5.0
    assert all(4 <= value <= 6 for value in values)
    assert all(abs(one - other) <= 1 for one, other in itertools.pairwise(values))
    assert max(values) > 5.8
    assert min(values) < 4.2


def test_a_walk_whose_moments_were_left_out_is_where_it_would_have_been() -> None:
    one, other = (RandomWalk(walk(step=1.0), stream_of(0, "x"), 0.0, None, None) for _ in range(2))
    values = [one.value(float(time)) for time in range(50)]
    assert other.value(49.0) == values[49]
    assert other.state(49.0) == values[49]


def test_a_walk_goes_on_from_what_it_was_set_to() -> None:
    walking = RandomWalk(walk(step=1.0), stream_of(0, "x"), 0.0, None, None)
    walking.value(10.0)
    walking.resume(10.4, 100.0)
    assert abs(walking.value(11.0) - 100.0) <= 1.0
