"""What depends on time alone, against closed forms."""

import math
from typing import Any

import pytest

from busway.apps.simulator.behaviours.waves import Constant, Ramp, Sine, Square
from busway.config.files.behaviours import KINDS, BehaviourSection


def section(kind: str, **keys: Any) -> Any:
    made: BehaviourSection = KINDS[kind].model_validate({"kind": kind, **keys})
    return made


def test_a_constant_is_one_value() -> None:
    assert Constant(section("constant", value=3)).value(99.0) == 3.0
    assert Constant(section("constant", value=True)).value(0.0) == 1.0


@pytest.mark.parametrize(
    ("at_end", "values"),
    [
        ("repeat", [10, 12.5, 15, 17.5, 10, 12.5, 15, 17.5, 10]),
        ("hold", [10, 12.5, 15, 17.5, 20, 20, 20, 20, 20]),
        ("return", [10, 12.5, 15, 17.5, 20, 17.5, 15, 12.5, 10]),
    ],
)
def test_a_ramp_rises_and_then_does_as_it_is_told(at_end: str, values: list[float]) -> None:
    ramp = Ramp(section("ramp", first=10, last=20, duration=4, at_end=at_end))
    assert [ramp.value(float(time)) for time in range(9)] == pytest.approx(values)


def test_a_sine_begins_at_its_mean_and_its_phase_moves_it() -> None:
    sine = Sine(section("sine", mean=230, amplitude=10, period=60))
    assert sine.value(0.0) == 230
    assert sine.value(15.0) == pytest.approx(240)
    assert sine.value(45.0) == pytest.approx(220)
    shifted = Sine(section("sine", mean=230, amplitude=10, period=60, phase=90))
    assert shifted.value(0.0) == pytest.approx(240)


def test_a_sine_is_as_right_after_a_year() -> None:
    sine = Sine(section("sine", amplitude=1, period=7))
    later = 7.0 * 4_500_000 + 1.75
    assert sine.value(later) == pytest.approx(math.sin(math.pi / 2), abs=1e-9)


def test_a_square_is_high_first_for_its_duty() -> None:
    square = Square(section("square", low=1, high=5, period=4, duty=0.25))
    assert [square.value(float(time)) for time in range(8)] == [5, 1, 1, 1, 5, 1, 1, 1]
    half = Square(section("square", period=4, phase=180))
    assert [half.value(float(time)) for time in range(4)] == [0, 0, 1, 1]


def test_what_depends_on_time_has_nothing_to_go_on_from() -> None:
    sine = Sine(section("sine", amplitude=1, period=7))
    sine.resume(3.0, 100.0)
    assert sine.state(3.0) is None
    assert sine.value(0.0) == 0.0
