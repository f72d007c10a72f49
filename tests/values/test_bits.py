"""Registers as bits, and states as people write them."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import InvalidRequest
from busway.values import decode, encode, parse_bit, value_type


def lit(*numbers: int) -> tuple[bool, ...]:
    return tuple(bit in numbers for bit in range(16))


@pytest.mark.parametrize(
    ("order", "wire", "bits"),
    [
        ("AB", "00 01", (0,)),
        ("AB", "80 00", (15,)),
        ("AB", "01 82", (1, 7, 8)),
        ("BA", "82 01", (1, 7, 8)),
        ("AB", "00 00", ()),
        ("AB", "FF FF", tuple(range(16))),
    ],
)
def test_a_register_is_sixteen_bits_least_significant_first(order: str, wire: str, bits: tuple[int, ...]) -> None:
    data = bytes.fromhex(wire)
    assert decode(data, "bits", order) == [lit(*bits)]
    assert encode([lit(*bits)], "bits", order) == data
    assert encode([[int(state) for state in lit(*bits)]], "bits", order) == data


@given(raw=st.binary(max_size=40))
@pytest.mark.parametrize("order", ["AB", "BA"])
def test_any_registers_read_as_bits_are_written_back_unchanged(raw: bytes, order: str) -> None:
    raw = raw[: len(raw) & ~1]
    kind = value_type("bits", order)
    assert kind.encode(kind.decode(raw)) == raw


@pytest.mark.parametrize(
    "value", [True, 5, "0101010101010101", [True] * 15, [True] * 17, [2] * 16, [None] * 16, [1.0] * 16, ["1"] * 16]
)
def test_what_is_not_sixteen_states_is_refused(value: object) -> None:
    with pytest.raises(InvalidRequest, match="does not fit bits, which takes sixteen of True and False"):
        encode([value], "bits")


@given(raw=st.binary(min_size=2, max_size=20), bit=st.integers(0, 15))
@pytest.mark.parametrize("order", ["AB", "BA"])
def test_one_bit_is_the_same_as_that_of_all_sixteen(raw: bytes, bit: int, order: str) -> None:
    raw = raw[: len(raw) & ~1]
    assert decode(raw, f"bit:{bit}", order) == [register[bit] for register in decode(raw, "bits", order)]


@pytest.mark.parametrize(
    ("name", "order", "and_mask", "or_mask"),
    [
        ("bit:0", "AB", "FFFE", "0001"),
        ("bit:3", "AB", "FFF7", "0008"),
        ("bit:15", "AB", "7FFF", "8000"),
        ("bit:3", "BA", "F7FF", "0800"),  # the bit lies in the other byte of the register
    ],
)
def test_writing_one_bit_is_refused_with_the_mask_write_that_does_it(
    name: str, order: str, and_mask: str, or_mask: str
) -> None:
    with pytest.raises(InvalidRequest, match=rf"{name} cannot be written.*mask write .*0x{and_mask}.*0x{or_mask}"):
        encode([True], name, order)


@pytest.mark.parametrize(
    ("text", "state"),
    [("on", True), ("OFF", False), ("true", True), ("False", False), ("1", True), ("0", False), (" on ", True)],
)
def test_a_state_is_read_as_people_write_it(text: str, state: bool) -> None:
    assert parse_bit(text) is state
    assert value_type("bit:4").parse(text) is state


@pytest.mark.parametrize("text", ["", "2", "yes", "onn", "0x1", "1.0"])
def test_what_is_no_state_is_refused(text: str) -> None:
    with pytest.raises(InvalidRequest, match="is not a state, which is one of on, true, 1, off, false, 0"):
        parse_bit(text)
    with pytest.raises(InvalidRequest, match="does not fit bit:4, which takes one of on, true"):
        value_type("bit:4").parse(text)
