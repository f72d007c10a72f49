"""Types by name: what there is, how many registers each takes, lengths, and values written as text."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import InvalidRequest
from busway.values import TYPE_NAMES, ValueType, decode, encode, parse_value, value_type


@pytest.mark.parametrize(
    ("name", "registers"),
    [
        ("int16", 1),
        ("uint16", 1),
        ("float16", 1),
        ("bcd16", 1),
        ("int32", 2),
        ("uint32", 2),
        ("float32", 2),
        ("bcd32", 2),
        ("int64", 4),
        ("uint64", 4),
        ("float64", 4),
        ("bcd64", 4),
        ("bits", 1),
        ("bit:15", 1),
        ("string:1", 1),
        ("string:2", 1),
        ("string:3", 2),
        ("string:250", 125),
    ],
)
def test_a_type_takes_its_registers(name: str, registers: int) -> None:
    kind = value_type(name)
    assert (kind.name, kind.registers) == (name, registers)
    assert kind.registers_for(1) == registers
    assert kind.registers_for(10) == 10 * registers
    assert kind.decode(bytes(20 * registers)) == kind.decode(bytes(2 * registers)) * 10
    assert kind.decode(b"") == []


def test_the_list_of_types_names_what_exists() -> None:
    assert len(TYPE_NAMES) == 27
    for name in TYPE_NAMES:
        example = name.replace("FORMAT", ">hHl").replace("N", "7").replace("M", "9")
        assert value_type(example).name == example


@pytest.mark.parametrize(
    ("short", "name"),
    [
        ("i16", "int16"),
        ("u16", "uint16"),
        ("i32", "int32"),
        ("u32", "uint32"),
        ("i64", "int64"),
        ("u64", "uint64"),
        ("f16", "float16"),
        ("f32", "float32"),
        ("f64", "float64"),
        ("Float32", "float32"),
        (" UINT16 ", "uint16"),
        ("string:08:ascii:nul", "string:8"),
        ("string:8:UTF-8", "string:8:utf-8"),
        ("string:8:nul", "string:8"),
    ],
)
def test_other_spellings_mean_the_same_type(short: str, name: str) -> None:
    assert value_type(short) == value_type(name)


def test_a_type_is_compiled_once_and_says_what_it_is() -> None:
    kind = value_type("float32", "CDAB")
    assert value_type("float32", "CDAB") is kind
    assert value_type(kind) is kind
    assert value_type("float32", order="word-swapped") == kind
    assert value_type("float32") != kind
    assert (kind.name, kind.order, kind.registers) == ("float32", "CDAB", 2)
    assert repr(kind) == "ValueType(name='float32', order='CDAB', registers=2)"


def test_one_order_of_a_device_serves_all_its_types() -> None:
    found = {name: value_type(name, "CDAB").order for name in ("uint16", "float32", "float64", "string:4", "bits")}
    assert found == {"uint16": "AB", "float32": "CDAB", "float64": "GHEFCDAB", "string:4": "AB", "bits": "AB"}


@pytest.mark.parametrize("name", ["", "float", "int", "int8", "double", "float128", "u32le", "bool", "x" * 500])
def test_an_unknown_type_is_refused_with_the_types_that_exist(name: str) -> None:
    with pytest.raises(InvalidRequest, match=r"unknown type .*; there are int16, uint16, .*string:N, bits, bit:N"):
        value_type(name)


@pytest.mark.parametrize("name", ["bit", "bit:", "bit:16", "bit:-1", "bit:x", "bit:1:2", "bit:٣"])
def test_a_bit_without_its_place_is_refused(name: str) -> None:
    with pytest.raises(InvalidRequest, match="which bit of the register: bit:0 … bit:15"):
        value_type(name)


@pytest.mark.parametrize("name", ["string", "string:", "string:0", "string:251", "string:-1", "string:ascii"])
def test_a_string_without_its_length_is_refused(name: str) -> None:
    with pytest.raises(InvalidRequest, match="needs a length in bytes, string:1 … string:250"):
        value_type(name)


@pytest.mark.parametrize("name", ["string:8:utf-16", "string:8:space:ascii", "string:8:ascii:nul:x", "string:8:"])
def test_a_string_with_unknown_options_is_refused(name: str) -> None:
    with pytest.raises(InvalidRequest, match=r"ascii, latin-1, utf-8.*nul, space"):
        value_type(name)


@pytest.mark.parametrize(("name", "order"), [(16, "AB"), ("int16", None), (None, "AB"), (["int16"], "AB")])
def test_names_that_are_not_text_are_refused(name: object, order: object) -> None:
    with pytest.raises(InvalidRequest, match="are names"):
        value_type(name, order)  # type: ignore[arg-type]


def test_an_unknown_order_is_refused() -> None:
    for name in ("int32", "bits", "string:4"):
        with pytest.raises(InvalidRequest, match="unknown order 'ACBD'"):
            value_type(name, "ACBD")


@pytest.mark.parametrize("count", [0, -1, True, 1.0, "2", None])
def test_a_count_that_is_no_number_of_values_is_refused(count: object) -> None:
    with pytest.raises(InvalidRequest, match="a number of float32 values, 1 or more"):
        value_type("float32").registers_for(count)  # type: ignore[arg-type]


@pytest.mark.parametrize(("name", "size"), [("uint16", 1), ("uint16", 3), ("float32", 6), ("int64", 4), ("bcd32", 2)])
def test_bytes_that_are_no_whole_number_of_values_are_refused(name: str, size: int) -> None:
    with pytest.raises(InvalidRequest, match=rf"{size} bytes? (is|are) no whole number of {name} values"):
        decode(bytes(size), name)


def test_a_declared_count_has_to_fit_the_bytes() -> None:
    assert decode(bytes(8), "float32", count=2) == [0.0, 0.0]
    with pytest.raises(InvalidRequest, match="3 float32 values take 12 bytes, but there are 8"):
        decode(bytes(8), "float32", count=3)
    with pytest.raises(InvalidRequest, match="count is 0"):
        decode(b"", "float32", count=0)


@pytest.mark.parametrize("holder", [bytes, bytearray, memoryview])
@pytest.mark.parametrize(
    ("name", "order", "value"),
    [
        ("float32", "ABCD", -2.5),
        ("float32", "CDAB", -2.5),
        ("bcd16", "BA", 42),
        ("string:5", "BA", "pumps"),
        ("bits", "AB", (True,) * 16),
    ],
)
def test_registers_are_read_from_whatever_holds_bytes(holder: type, name: str, order: str, value: object) -> None:
    assert decode(holder(encode([value], name, order)), name, order) == [value]


def test_values_come_from_any_iterable() -> None:
    assert encode(range(3), "uint16") == bytes.fromhex("00 00 00 01 00 02")
    assert encode((number for number in (7,)), "uint16") == bytes.fromhex("00 07")
    assert encode([], "uint16") == b""


@pytest.mark.parametrize("values", [5, 1.5, "text", b"ab", None, bytearray(2)])
def test_a_single_value_without_its_list_is_refused(values: object) -> None:
    for name in ("uint16", "string:4"):
        with pytest.raises(InvalidRequest, match="a single one is given in a list"):
            encode(values, name)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("uint16", "42", 42),
        ("uint16", " 0xFFFF ", 65535),
        ("int16", "-0x8000", -32768),
        ("int32", "0b101", 5),
        ("uint64", "18446744073709551615", 18446744073709551615),
        ("bcd16", "0042", 42),
        ("float32", "1.5", 1.5),
        ("float32", "-1e3", -1000.0),
        ("float16", "65504", 65504.0),
        ("float64", "inf", math.inf),
        ("float32", "-Infinity", -math.inf),
        ("string:8", " pump 1", " pump 1"),
        ("string:4:utf-8", "°", "°"),
        ("bits", "0b101", tuple(bit in (0, 2) for bit in range(16))),
        ("bits", "0x8000", tuple(bit == 15 for bit in range(16))),
        ("bits", "0", (False,) * 16),
        ("bit:3", "on", True),
        ("bit:3", "0", False),
    ],
)
def test_a_value_is_read_as_people_write_it(name: str, text: str, value: object) -> None:
    assert parse_value(text, name) == value
    assert type(parse_value(text, name)) is type(value)
    assert value_type(name).parse(text) == value


def test_nan_is_a_number_of_a_float() -> None:
    assert math.isnan(parse_value("nan", "float16"))


@pytest.mark.parametrize(
    ("name", "text", "expects"),
    [
        ("uint16", "65536", "a whole number 0…65535"),
        ("uint16", "-1", "a whole number 0…65535"),
        ("int16", "0xFFFF", "a whole number -32768…32767"),
        ("uint16", "1.0", "a whole number 0…65535"),
        ("uint16", "ten", "a whole number 0…65535"),
        ("uint16", "", "a whole number 0…65535"),
        ("bcd16", "0x12", "a whole number 0…9999, in decimal"),
        ("bcd16", "-1", "a whole number 0…9999, in decimal"),
        ("bcd16", "10000", "a whole number 0…9999, in decimal"),
        ("float16", "65520", "a number -65504…65504, inf or nan"),
        ("float32", "1e39", "a number -3.4028234663852886e+38…3.4028234663852886e+38, inf or nan"),
        ("float64", "1e999", "a number -1.7976931348623157e+308…1.7976931348623157e+308, inf or nan"),
        ("float64", "1,5", "a number -1.7976931348623157e+308…1.7976931348623157e+308, inf or nan"),
        ("float64", "1_5", "a number -1.7976931348623157e+308…1.7976931348623157e+308, inf or nan"),
        ("float64", "١", "a number -1.7976931348623157e+308…1.7976931348623157e+308, inf or nan"),
        ("string:4", "pumps", "text of at most 4 bytes in ascii; this is 5"),
        ("string:1", "°", "text of at most 1 byte in ascii"),
        ("bits", "65536", "sixteen of True and False, the least significant bit first"),
        ("bit:3", "perhaps", "one of on, true, 1, off, false, 0"),
    ],
)
def test_a_text_that_is_no_value_is_refused_with_text_type_and_range(name: str, text: str, expects: str) -> None:
    with pytest.raises(InvalidRequest) as caught:
        parse_value(text, name)
    assert str(caught.value) == f"{text!r} does not fit {name}, which takes {expects}"


@given(name=st.sampled_from(["int16", "uint32", "int64", "bcd32"]), text=st.text(max_size=30))
def test_any_text_is_a_value_that_fits_or_is_refused(name: str, text: str) -> None:
    kind: ValueType = value_type(name)
    try:
        value = kind.parse(text)
    except InvalidRequest:
        return
    assert kind.decode(kind.encode([value])) == [value]


@given(text=st.text(max_size=60), order=st.text(max_size=12))
def test_any_name_and_order_is_a_type_or_refused(text: str, order: str) -> None:
    try:
        kind = value_type(text, order)
    except InvalidRequest:
        return
    assert value_type(kind.name, kind.order) == kind
