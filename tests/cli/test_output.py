"""How values look: as `busway write` takes them."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.cli.output import TableRow, fewest_digits, float32_digits, json_value, shown_value, value_rows
from busway.values import parse_address, parse_value, value_type


@given(st.binary(min_size=4, max_size=4))
def test_the_fewest_digits_give_the_same_register_back(data: bytes) -> None:
    (value,) = struct.unpack(">f", data)
    if math.isfinite(value):
        assert struct.pack(">f", fewest_digits(value, 4)) == data


@pytest.mark.parametrize(
    ("value", "size", "text"),
    [(0.1, 4, "0.1"), (3.4028234663852886e38, 4, "3.4028235e+38"), (0.1, 8, "0.1"), (65504.0, 2, "65500.0")],
)
def test_floats_have_no_digits_that_say_nothing(value: float, size: int, text: str) -> None:
    letter = {2: ">e", 4: ">f", 8: ">d"}[size]
    (stored,) = struct.unpack(letter, struct.pack(letter, value))
    assert str(fewest_digits(stored, size)) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, "on"), (False, "off"), (-5, "-5"), (1.5, "1.5"), (float("nan"), "nan"), ("a\x00b\n", "a\\x00b\\n")],
)
def test_a_value_as_a_person_reads_it(value: object, text: str) -> None:
    assert shown_value(value) == text


def test_sixteen_bits_are_shown_as_they_are_written() -> None:
    (bits,) = value_type("bits").decode(b"\x00\x05")
    assert shown_value(bits) == "0b0000000000000101"
    assert parse_value(shown_value(bits), "bits") == bits


@pytest.mark.parametrize(
    ("value", "expected"), [(math.nan, "nan"), (-math.inf, "-inf"), (1.5, 1.5), ((True, False), [True, False])]
)
def test_a_value_as_json_can_hold_it(value: object, expected: object) -> None:
    assert json_value(value) == expected


def test_consecutive_values_stand_at_consecutive_places() -> None:
    rows = value_rows(parse_address("4x10"), value_type("uint32"), [1, 2], bytes(range(8)))
    assert rows == [
        TableRow(parse_address("4x10"), 1, b"\x00\x01\x02\x03", "uint32"),
        TableRow(parse_address("4x12"), 2, b"\x04\x05\x06\x07", "uint32"),
    ]
    assert rows[1].raw_text == "0405 0607"
    assert [TableRow(parse_address("4x1"), None, raw).raw_text for raw in (b"", b"\1")] == ["", "1"]


@pytest.mark.parametrize("value", [1e300, 0.1, 16777217.0, math.inf, 7, True, "0.1", None])
def test_what_is_no_float32_is_shown_as_it_was_stored(value: object) -> None:
    assert float32_digits(value) is value


@pytest.mark.parametrize("text", ["0.1", "230.2", "-1e-40", "3.4028235e+38", "16777216.0", "0.0"])
def test_a_float32_is_shown_with_its_own_digits(text: str) -> None:
    (stored,) = struct.unpack(">f", struct.pack(">f", float(text)))
    shown = str(float32_digits(stored))
    assert struct.pack(">f", float(shown)) == struct.pack(">f", stored)
    assert len(shown) <= len(text)
