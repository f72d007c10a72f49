"""The types of values as constants."""

from typing import Any

import pytest

import busway
from busway.errors import InvalidRequest

NAMES = [name for name in busway.__all__ if name.isupper() and isinstance(getattr(busway, name), busway.ValueType)]


@pytest.mark.parametrize("name", NAMES)
def test_a_constant_is_the_type_of_its_name(name: str) -> None:
    constant: busway.ValueType[Any] = getattr(busway, name)
    assert constant == busway.value_type(name.lower())


def test_there_is_a_constant_for_each_type_without_a_parameter() -> None:
    assert len(NAMES) == 13


def test_a_string_has_its_length_encoding_and_padding() -> None:
    assert busway.string(16) == busway.value_type("string:16")
    assert busway.string(5, "utf-8", "space").decode(b"abc   ") == ["abc"]
    assert busway.string(5).registers == 3
    with pytest.raises(InvalidRequest):
        busway.string(0)


def test_an_order_beside_a_constant_holds() -> None:
    swapped = busway.value_type(busway.FLOAT32, "CDAB")
    assert swapped == busway.value_type("float32", "CDAB")
    assert busway.value_type(swapped) is swapped
