"""Numbers ⇄ registers: every type in every order byte by byte, round trips, and every refusal."""

import gc
import math
import struct
import sys
from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from types import FrameType
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import BadReply, InvalidRequest
from busway.values import ORDERS, ValueType, decode, encode, value_type
from busway.values.numbers import whole_number

VECTORS: list[tuple[str, str, int | float, str]] = [
    ("int16", "AB", -2, "FF FE"),
    ("int16", "BA", -2, "FE FF"),
    ("uint16", "AB", 0xABCD, "AB CD"),
    ("uint16", "BA", 0xABCD, "CD AB"),
    ("float16", "AB", -1.5, "BE 00"),
    ("float16", "BA", -1.5, "00 BE"),
    ("int32", "ABCD", -123_456_789, "F8 A4 32 EB"),
    ("int32", "BADC", -123_456_789, "A4 F8 EB 32"),
    ("int32", "CDAB", -123_456_789, "32 EB F8 A4"),
    ("int32", "DCBA", -123_456_789, "EB 32 A4 F8"),
    ("uint32", "ABCD", 0xDEADBEEF, "DE AD BE EF"),
    ("uint32", "BADC", 0xDEADBEEF, "AD DE EF BE"),
    ("uint32", "CDAB", 0xDEADBEEF, "BE EF DE AD"),
    ("uint32", "DCBA", 0xDEADBEEF, "EF BE AD DE"),
    ("float32", "ABCD", 123456.0, "47 F1 20 00"),
    ("float32", "BADC", 123456.0, "F1 47 00 20"),
    ("float32", "CDAB", 123456.0, "20 00 47 F1"),
    ("float32", "DCBA", 123456.0, "00 20 F1 47"),
    ("int64", "ABCDEFGH", -1_234_567_890_123_456_789, "EE DD EF 0B 82 16 7E EB"),
    ("int64", "BADCFEHG", -1_234_567_890_123_456_789, "DD EE 0B EF 16 82 EB 7E"),
    ("int64", "CDABGHEF", -1_234_567_890_123_456_789, "EF 0B EE DD 7E EB 82 16"),
    ("int64", "DCBAHGFE", -1_234_567_890_123_456_789, "0B EF DD EE EB 7E 16 82"),
    ("int64", "EFGHABCD", -1_234_567_890_123_456_789, "82 16 7E EB EE DD EF 0B"),
    ("int64", "FEHGBADC", -1_234_567_890_123_456_789, "16 82 EB 7E DD EE 0B EF"),
    ("int64", "GHEFCDAB", -1_234_567_890_123_456_789, "7E EB 82 16 EF 0B EE DD"),
    ("int64", "HGFEDCBA", -1_234_567_890_123_456_789, "EB 7E 16 82 0B EF DD EE"),
    ("uint64", "ABCDEFGH", 0x0123456789ABCDEF, "01 23 45 67 89 AB CD EF"),
    ("uint64", "BADCFEHG", 0x0123456789ABCDEF, "23 01 67 45 AB 89 EF CD"),
    ("uint64", "CDABGHEF", 0x0123456789ABCDEF, "45 67 01 23 CD EF 89 AB"),
    ("uint64", "DCBAHGFE", 0x0123456789ABCDEF, "67 45 23 01 EF CD AB 89"),
    ("uint64", "EFGHABCD", 0x0123456789ABCDEF, "89 AB CD EF 01 23 45 67"),
    ("uint64", "FEHGBADC", 0x0123456789ABCDEF, "AB 89 EF CD 23 01 67 45"),
    ("uint64", "GHEFCDAB", 0x0123456789ABCDEF, "CD EF 89 AB 45 67 01 23"),
    ("uint64", "HGFEDCBA", 0x0123456789ABCDEF, "EF CD AB 89 67 45 23 01"),
    ("float64", "ABCDEFGH", 3.141592653589793, "40 09 21 FB 54 44 2D 18"),
    ("float64", "BADCFEHG", 3.141592653589793, "09 40 FB 21 44 54 18 2D"),
    ("float64", "CDABGHEF", 3.141592653589793, "21 FB 40 09 2D 18 54 44"),
    ("float64", "DCBAHGFE", 3.141592653589793, "FB 21 09 40 18 2D 44 54"),
    ("float64", "EFGHABCD", 3.141592653589793, "54 44 2D 18 40 09 21 FB"),
    ("float64", "FEHGBADC", 3.141592653589793, "44 54 18 2D 09 40 FB 21"),
    ("float64", "GHEFCDAB", 3.141592653589793, "2D 18 54 44 21 FB 40 09"),
    ("float64", "HGFEDCBA", 3.141592653589793, "18 2D 44 54 FB 21 09 40"),
    ("bcd16", "AB", 1234, "12 34"),
    ("bcd16", "BA", 1234, "34 12"),
    ("bcd32", "ABCD", 12_345_678, "12 34 56 78"),
    ("bcd32", "BADC", 12_345_678, "34 12 78 56"),
    ("bcd32", "CDAB", 12_345_678, "56 78 12 34"),
    ("bcd32", "DCBA", 12_345_678, "78 56 34 12"),
    ("bcd64", "ABCDEFGH", 1_234_567_890_123_456, "12 34 56 78 90 12 34 56"),
    ("bcd64", "BADCFEHG", 1_234_567_890_123_456, "34 12 78 56 12 90 56 34"),
    ("bcd64", "CDABGHEF", 1_234_567_890_123_456, "56 78 12 34 34 56 90 12"),
    ("bcd64", "DCBAHGFE", 1_234_567_890_123_456, "78 56 34 12 56 34 12 90"),
    ("bcd64", "EFGHABCD", 1_234_567_890_123_456, "90 12 34 56 12 34 56 78"),
    ("bcd64", "FEHGBADC", 1_234_567_890_123_456, "12 90 56 34 34 12 78 56"),
    ("bcd64", "GHEFCDAB", 1_234_567_890_123_456, "34 56 90 12 56 78 12 34"),
    ("bcd64", "HGFEDCBA", 1_234_567_890_123_456, "56 34 12 90 78 56 34 12"),
]

INTEGER_RANGES = {
    "int16": (-32_768, 32_767),
    "uint16": (0, 65_535),
    "int32": (-2_147_483_648, 2_147_483_647),
    "uint32": (0, 4_294_967_295),
    "int64": (-9_223_372_036_854_775_808, 9_223_372_036_854_775_807),
    "uint64": (0, 18_446_744_073_709_551_615),
    "bcd16": (0, 9_999),
    "bcd32": (0, 99_999_999),
    "bcd64": (0, 9_999_999_999_999_999),
}
INTEGERS = sorted(INTEGER_RANGES)
FLOATS = ["float16", "float32", "float64"]


def bits_of(name: str) -> int:
    return int(name[-2:])


def each_order(name: str) -> list[ValueType]:
    return [value_type(name, order) for order in ORDERS[bits_of(name)]]


@pytest.mark.parametrize(("name", "order", "value", "wire"), VECTORS)
def test_a_number_lies_on_the_wire_as_its_order_says(name: str, order: str, value: float, wire: str) -> None:
    data = bytes.fromhex(wire)
    assert encode([value], name, order) == data
    assert decode(data, name, order) == [value]


@pytest.mark.parametrize(("name", "order", "value", "wire"), VECTORS)
def test_several_values_lie_one_after_the_other(name: str, order: str, value: float, wire: str) -> None:
    data = bytes.fromhex(wire) + bytes(len(bytes.fromhex(wire))) + bytes.fromhex(wire)
    assert decode(data, name, order) == [value, 0, value]
    assert encode([value, 0, value], name, order) == data


def test_every_type_and_order_has_a_vector() -> None:
    assert {(name, order) for name, order, _, _ in VECTORS} == {
        (name, order) for name in INTEGERS + FLOATS for order in ORDERS[bits_of(name)]
    }


@given(data=st.data(), name=st.sampled_from(INTEGERS))
def test_integers_come_back_exactly_in_every_order(data: st.DataObject, name: str) -> None:
    low, high = INTEGER_RANGES[name]
    values = data.draw(st.lists(st.integers(low, high), max_size=8))
    for kind in each_order(name):
        assert kind.decode(kind.encode(values)) == values


@given(data=st.data(), name=st.sampled_from(FLOATS))
def test_floats_come_back_exactly_in_every_order(data: st.DataObject, name: str) -> None:
    widths: dict[str, Literal[16, 32, 64]] = {"float16": 16, "float32": 32, "float64": 64}
    values = data.draw(st.lists(st.floats(width=widths[name], allow_nan=False), max_size=8))
    for kind in each_order(name):
        again = kind.decode(kind.encode(values))
        assert again == values
        assert [math.copysign(1, value) for value in again] == [math.copysign(1, value) for value in values]


@given(raw=st.binary(max_size=64), name=st.sampled_from([name for name in INTEGERS if "int" in name]))
def test_any_registers_read_as_integers_are_written_back_unchanged(raw: bytes, name: str) -> None:
    raw = raw[: len(raw) // (bits_of(name) // 8) * (bits_of(name) // 8)]
    for kind in each_order(name):
        assert kind.encode(kind.decode(raw)) == raw


@given(raw=st.binary(min_size=2, max_size=64), name=st.sampled_from(FLOATS))
def test_any_registers_but_nans_read_as_floats_are_written_back_unchanged(raw: bytes, name: str) -> None:
    size = bits_of(name) // 8
    raw = raw[: len(raw) // size * size]
    for kind in each_order(name):
        values = kind.decode(raw)
        written = kind.encode(values)
        for index, value in enumerate(values):
            place = slice(index * size, (index + 1) * size)
            if math.isnan(value):
                assert math.isnan(kind.decode(written[place])[0])
            else:
                assert written[place] == raw[place]


@pytest.mark.parametrize(
    ("name", "wire"),
    [
        ("float32", "7F C0 00 00"),  # the usual quiet NaN
        ("float32", "FF C0 12 34"),  # with a sign and a payload
        ("float64", "7F F8 00 00 00 00 00 00"),
        ("float64", "FF F8 00 00 00 00 12 34"),
        ("float64", "7F F0 00 00 00 00 00 01"),  # signalling
        ("float16", "7E 00"),
        ("float16", "FE 00"),
    ],
)
def test_nan_payloads_that_python_keeps_are_written_back_unchanged(name: str, wire: str) -> None:
    values = decode(bytes.fromhex(wire), name)
    assert math.isnan(values[0])
    assert encode(values, name) == bytes.fromhex(wire)


@pytest.mark.parametrize("name", FLOATS)
def test_infinities_and_negative_zero_are_numbers_of_a_float(name: str) -> None:
    values = decode(encode([math.inf, -math.inf, -0.0], name), name)
    assert values == [math.inf, -math.inf, 0.0]
    assert math.copysign(1, values[2]) == -1


@pytest.mark.parametrize("name", INTEGERS)
def test_the_ends_of_the_range_fit_and_one_beyond_is_refused(name: str) -> None:
    low, high = INTEGER_RANGES[name]
    for kind in each_order(name):
        assert kind.decode(kind.encode([low, high])) == [low, high]
        for beyond in (low - 1, high + 1):
            with pytest.raises(InvalidRequest, match=f"^{beyond} does not fit {name}, which takes .*{low}…{high}"):
                kind.encode([beyond])


@pytest.mark.parametrize("name", INTEGERS)
@pytest.mark.parametrize("value", [True, False, 3.0, 1.5, math.nan, math.inf, "12", None, Decimal(1), b"\0"])
def test_what_is_not_an_integer_is_refused_by_integer_types(name: str, value: object) -> None:
    with pytest.raises(InvalidRequest, match=rf"values\[1\] = .* does not fit {name}, which takes a whole number"):
        encode([1, value, 1], name)


class NoNumber:
    """Has ``__index__``, which refuses, as that of a numpy array of several numbers does."""

    def __index__(self) -> int:
        raise TypeError("only integer scalar arrays can be converted to a scalar index")


@pytest.mark.parametrize("name", INTEGERS)
def test_what_refuses_to_be_an_integer_is_refused_by_integer_types(name: str) -> None:
    with pytest.raises(InvalidRequest, match=rf"values\[1\] = .* does not fit {name}, which takes a whole number"):
        encode([1, NoNumber(), 1], name)
    with pytest.raises(InvalidRequest, match=rf"^values\[1\] = .* does not fit {name}, which takes a whole number"):
        encode([1, NoNumber(), 1 << 70], name)


def test_a_fraction_for_an_integer_type_is_answered_with_a_hint() -> None:
    with pytest.raises(InvalidRequest, match=r"1\.5 does not fit uint16, .*; round it first"):
        encode([1.5], "uint16")


@pytest.mark.parametrize("name", INTEGERS)
def test_integers_of_other_libraries_are_integers(name: str) -> None:
    class Foreign:
        def __init__(self, number: int) -> None:
            self.number = number

        def __index__(self) -> int:
            return self.number

    assert decode(encode([Foreign(7), 8], name), name) == [7, 8]
    with pytest.raises(InvalidRequest, match=r"values\[0\]"):
        encode([Foreign(1 << 70), 8], name)


def test_the_value_at_fault_among_many_is_named_by_its_index() -> None:
    with pytest.raises(InvalidRequest, match=r"^values\[2\] = 65536 does not fit uint16, .* 0…65535$"):
        encode([1, 2, 65_536, 70_000], "uint16")
    with pytest.raises(InvalidRequest, match=r"^values\[1\] = 1e\+39 does not fit float32"):
        encode([1, 1e39], "float32")


@pytest.mark.parametrize(
    ("name", "largest", "beyond"),
    [
        ("float16", 65504.0, 65520.0),
        ("float32", 3.4028234663852886e38, 3.4028235677973366e38),
        ("float64", sys.float_info.max, 10**400),
    ],
)
def test_a_float_too_large_for_its_type_is_refused_and_never_becomes_infinite(
    name: str, largest: float, beyond: float
) -> None:
    assert decode(encode([largest, -largest], name), name) == [largest, -largest]
    for value in (beyond, -beyond):
        with pytest.raises(InvalidRequest, match=f"does not fit {name}, which takes a number -"):
            encode([value], name)


@pytest.mark.parametrize("name", FLOATS)
@pytest.mark.parametrize("value", [True, "1.5", None, 1j, b"\0", Decimal("sNaN")])
def test_what_is_not_a_number_is_refused_by_float_types(name: str, value: object) -> None:
    with pytest.raises(InvalidRequest, match=rf"values\[0\] = .* does not fit {name}"):
        encode([value, 1.0], name)


@pytest.mark.parametrize("value", [3, Decimal("3"), Fraction(3)])
def test_every_real_number_is_taken_by_float_types(value: object) -> None:
    assert encode([value], "float32") == bytes.fromhex("40 40 00 00")  # 3.0


def test_a_float_is_stored_as_the_nearest_number_of_its_format() -> None:
    assert encode([0.1], "float32") == bytes.fromhex("3D CC CC CD")
    assert encode([1e-60], "float32") == bytes(4)


def test_an_integer_of_thousands_of_digits_is_refused_in_a_short_sentence() -> None:
    with pytest.raises(InvalidRequest) as caught:
        encode([10**6000], "uint64")
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("name", "order", "wire", "place", "value"),
    [
        ("bcd16", "AB", "12 3A", 0, "123A"),
        ("bcd16", "AB", "00 01 F0 00 00 02", 1, "F000"),
        ("bcd16", "BA", "0A 12", 0, "120A"),
        ("bcd32", "CDAB", "00 00 00 00 00 0B 12 34", 1, "1234000B"),
        ("bcd64", "ABCDEFGH", "FF FF FF FF FF FF FF FF", 0, "FFFFFFFFFFFFFFFF"),
    ],
)
def test_a_bcd_digit_above_nine_is_a_broken_reply_that_names_the_value(
    name: str, order: str, wire: str, place: int, value: str
) -> None:
    data = bytes.fromhex(wire)
    with pytest.raises(BadReply, match=f"value {place} of the block reads {value}, which is no {name}") as caught:
        decode(memoryview(data), name, order)
    assert caught.value.raw == data


@given(raw=st.binary(min_size=2, max_size=2))
def test_any_register_is_bcd_exactly_if_its_digits_are_decimal(raw: bytes) -> None:
    if raw.hex().isdecimal():
        assert decode(raw, "bcd16") == [int(raw.hex())]
    else:
        with pytest.raises(BadReply):
            decode(raw, "bcd16")


@pytest.mark.parametrize(
    ("text", "number"),
    [("0", 0), ("007", 7), ("-12", -12), ("+12", 12), ("0x1F", 31), ("-0XfF", -255), ("0b101", 5), ("10", 10)],
)
def test_whole_numbers_are_read_in_decimal_hexadecimal_and_binary(text: str, number: int) -> None:
    assert whole_number(text) == number


@pytest.mark.parametrize(
    "text", ["", "-", "1.0", "1e3", "0x", "0b2", "0o7", "1_000", "１２", "0x" + "F" * 17, "9" * 41]
)
def test_what_is_no_whole_number_is_not_guessed(text: str) -> None:
    with pytest.raises(ValueError, match=r".*"):
        whole_number(text)


def calls(convert: Callable[[Any], object], block: object) -> int:
    """Function calls, into C too, that a conversion makes: work done value by value shows in their number."""
    count = 0

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    convert(block)  # whatever is done once only, is done now
    before = sys.getprofile()
    gc.disable()  # a collection may call what others hooked to it
    sys.setprofile(profile)
    try:
        convert(block)
    finally:
        sys.setprofile(before)
        gc.enable()
    return count


@pytest.mark.parametrize("name", [name for name in INTEGERS + FLOATS if not name.startswith("bcd")])
def test_125_registers_are_converted_as_a_block_and_not_value_by_value(name: str) -> None:
    size = bits_of(name) // 8
    block = struct.pack(">125H", *range(125))[: 250 // size * size]
    for kind in each_order(name):
        values = kind.decode(block)
        assert calls(kind.decode, block) == calls(kind.decode, block[:size]) > 2
        assert calls(kind.encode, values) == calls(kind.encode, values[:1]) > 2
