"""Totals of counters that begin again, and points that are computed from others."""

import pytest

from busway.codes import Table
from busway.points import Conversion, Point, Quality, Reading, Reason
from busway.points.derived import Accumulator, Derivation
from busway.values import value_type

HOLDING = Table.HOLDING_REGISTERS


def computed(name: str, formula: str, **keys: object) -> Point:
    return Point(name, HOLDING, 0, formula=formula, **keys)  # type: ignore[arg-type]


def test_a_total_goes_on_where_the_counter_begins_again() -> None:
    counter = Accumulator(65536.0)
    assert [counter.take(value) for value in (65_000, 65_535, 10, 500)] == [65_000, 65_535, 65_546, 66_036]
    assert counter.resets == 0


def test_a_counter_that_the_device_set_back_is_no_rollover() -> None:
    counter = Accumulator(2.0**32)
    assert [counter.take(value) for value in (1000, 1500, 20, 30)] == [1000, 1500, 1520, 1530]
    assert counter.resets == 1


@pytest.mark.parametrize(
    ("readings", "totals"),
    [
        ((32_760, 5, 10), (32_760, 32_773, 32_778)),  # begins again from 0
        ((32_760, -32_764, -32_760), (32_760, 32_772, 32_776)),  # goes on from -32768
        ((-3, -1, 2), (-3, -1, 2)),
    ],
)
def test_a_counter_with_a_sign_goes_on_from_0_or_from_its_least_number(
    readings: tuple[int, ...], totals: tuple[int, ...]
) -> None:
    counter = Accumulator(32_768.0)
    assert tuple(counter.take(value) for value in readings) == totals
    assert counter.resets == 0


@pytest.mark.parametrize("readings", [(100, -100), (-100, -200), (30_000, 0)])
def test_a_total_never_falls(readings: tuple[int, int]) -> None:
    counter = Accumulator(10_000.0)
    first, second = (counter.take(value) for value in readings)
    assert second == first


def test_a_computed_point_needs_all_its_inputs_and_is_as_uncertain_as_they_are() -> None:
    derivation = Derivation([computed("twice", "sum * 2"), computed("sum", 'a + point("b c")')])
    assert derivation.inputs() == {"a", "b c", "sum"}
    found = derivation.apply({"a": Reading(1), "b c": Reading(2.5)})
    assert found == {"sum": Reading(3.5), "twice": Reading(7.0)}
    uncertain = derivation.apply({"a": Reading(1, Reason.HELD), "b c": Reading(2.5)})["twice"]
    assert (uncertain.value, uncertain.quality, uncertain.reason) == (7.0, Quality.UNCERTAIN, Reason.HELD)
    for broken in ({"a": Reading(1)}, {"a": Reading(1), "b c": Reading(None, Reason.TIMEOUT)}):
        assert derivation.apply(broken)["twice"] == Reading(None, Reason.NO_INPUT)


def test_what_cannot_be_computed_is_bad_and_what_lies_outside_its_range_uncertain() -> None:
    derivation = Derivation([computed("share", "a / b", conversion=Conversion(valid=(0.0, 1.0)))])
    assert derivation.apply({"a": Reading(1), "b": Reading(0)})["share"] == Reading(None, Reason.NOT_A_NUMBER)
    assert derivation.apply({"a": Reading(3), "b": Reading(2)})["share"] == Reading(1.5, Reason.OUT_OF_RANGE)
    assert derivation.apply({"a": Reading(True), "b": Reading(2)})["share"] == Reading(0.5)


def test_accumulators_feed_computed_points() -> None:
    energy = Point("wh", HOLDING, 0, value_type("uint16"), rollover=65536.0)
    derivation = Derivation([energy, computed("kwh", "wh / 1000")])
    derivation.apply({"wh": Reading(65_000)})
    found = derivation.apply({"wh": Reading(464)})
    assert found == {"wh": Reading(66_000.0), "kwh": Reading(66.0)}
    assert derivation.apply({"wh": Reading(None, Reason.TIMEOUT)}).keys() == {"kwh"}


def test_where_the_type_of_a_counter_ends_is_multiplied_by_its_scale_factor() -> None:
    conversion = Conversion(scale_from="sf")
    energy = Point("wh", HOLDING, 0, value_type("uint16"), conversion, rollover=65_536.0, rollover_is_scaled=True)
    for exponent, first, second in ((3, 65_530_000.0, 65_540_000.0), (-2, 655.3, 655.4)):
        derivation = Derivation([energy])
        exponents = {"sf": exponent}
        assert derivation.apply({"wh": Reading(first)}, exponents=exponents)["wh"].value == first
        found = derivation.apply({"wh": Reading(4 * 10.0**exponent)}, exponents=exponents)
        assert found["wh"].value == pytest.approx(second)
        assert derivation.accumulators["wh"].resets == 0


@pytest.mark.parametrize("points", [[], [Point("a", HOLDING, 0, value_type("uint16"))]])
def test_nothing_is_derived_from_plain_points(points: list[Point]) -> None:
    assert Derivation(points).is_empty
