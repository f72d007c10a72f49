"""From a value to bytes: every type and order as the types themselves encode it, and nothing that does not fit."""

import math
from typing import Any

import pytest

from busway.apps.simulator.point_encoding import begin_of, form_of, largest_of
from busway.config.files.simulation import SimulatedPointSection
from busway.values import value_type
from busway.values.orders import ORDERS
from busway.values.types import TYPE_NAMES

NUMBERS = [name for name in TYPE_NAMES if name.startswith(("int", "uint", "float", "bcd")) and ":" not in name]


def section(**keys: Any) -> SimulatedPointSection:
    return SimulatedPointSection.model_validate({"name": "a", "address": "4x1", **keys})


@pytest.mark.parametrize("name", NUMBERS)
def test_every_order_packs_as_the_type_encodes(name: str) -> None:
    number = 1.5 if name.startswith("float") else 1234
    for order in ORDERS[16 * value_type(name).registers]:
        form = form_of(section(type=name, order=order))
        data = bytearray(b"\xee" * 16)
        form.put(data, 4, number)
        size = 2 * form.size
        assert data[4 : 4 + size] == value_type(name, order).encode([number])
        assert set(data[:4] + data[4 + size :]) == {0xEE}


def test_a_bit_is_put_without_touching_its_neighbours() -> None:
    form = form_of(section(address="0x1"))
    data = bytearray(b"\x00\xff")
    form.put(data, 3, True)
    form.put(data, 9, False)
    assert data == b"\x08\xfd"
    assert [form.quantise(value) for value in (0.4, 0.5, 7.0, -1.0, math.nan)] == [False, True, True, False, None]


@pytest.mark.parametrize(
    ("keys", "values"),
    [
        ({"type": "uint16"}, {3.4: 3, -1.0: 0, 70_000.0: 65_535, math.inf: 65_535, -math.inf: 0}),
        ({"type": "int16"}, {-3.6: -4, -40_000.0: -32_768}),
        ({"type": "bcd16"}, {-1.0: 0, 12_345.0: 9999}),
        ({"type": "int16", "scale": 0.1}, {23.04: 230, 1e9: 32_767}),
        ({"type": "int16", "scale": -0.1, "minimum": -2.0, "maximum": 1.0}, {23.0: -10, -23.0: 20, -math.inf: 20}),
        ({"type": "uint16", "scale": 0.1, "minimum": 0.25, "maximum": 0.7}, {0.0: 3, 9.0: 7}),
        ({"type": "float32", "scale": 2.0, "minimum": -4.0, "maximum": 6.0}, {5.0: 2.5, -5.0: -2.0, math.inf: 3.0}),
        ({"type": "float16"}, {1e9: 65_504.0, -math.inf: -65_504.0}),
        ({"type": "int16", "scale_from": "exponent", "minimum": 1, "maximum": 10}, {-50.0: -50, 50.0: 50}),
        ({"type": "float32", "scale_from": "exponent", "minimum": 1, "maximum": 10}, {-50.0: -50.0, 50.0: 50.0}),
    ],
)
def test_a_value_becomes_the_nearest_that_the_point_can_hold(keys: dict[str, Any], values: dict[float, Any]) -> None:
    quantise = form_of(section(**keys)).quantise
    assert {value: quantise(value) for value in values} == values


def test_what_is_no_number_shows_in_floats_alone() -> None:
    assert form_of(section(type="int32")).quantise(math.nan) is None
    assert math.isnan(form_of(section(type="float32")).quantise(math.nan))


def test_a_counter_rolls_over_where_its_type_ends() -> None:
    assert largest_of(form_of(section(type="uint16"))) == 65_536
    assert largest_of(form_of(section(type="bcd16", scale=0.5))) == 5000
    assert largest_of(form_of(section(type="float32"))) is None
    assert largest_of(form_of(section(address="0x1"))) is None


@pytest.mark.parametrize(
    ("keys", "begin", "end"),
    [
        ({"type": "uint16", "offset": -1000}, -1000, 64_536),
        ({"type": "uint16", "scale": 0.5, "offset": 100}, 100, 32_868),
        ({"type": "int16", "offset": -1000}, -1000, 31_768),
        ({"type": "int16", "scale": -1}, 0, 32_769),
        ({"type": "int16", "scale": -0.5, "offset": 10}, 10, 16_394.5),
        ({"type": "uint16", "scale": -1, "offset": 65_535}, 0, 65_536),
        ({"type": "uint16", "offset": -1000, "rollover": 500}, 0, 500),
    ],
)
def test_a_counter_of_a_point_with_an_offset_begins_again_where_its_registers_do(
    keys: dict[str, Any], begin: float, end: float
) -> None:
    form = form_of(section(**keys))
    assert (begin_of(form), largest_of(form)) == (begin, end)
