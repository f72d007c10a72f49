"""Strings ⇄ registers: order of characters, padding, encodings, and what is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import BadReply, InvalidRequest
from busway.values import decode, encode, value_type


@pytest.mark.parametrize(
    ("name", "order", "text", "wire"),
    [
        ("string:6", "AB", "Busway", "42 75 73 77 61 79"),
        ("string:6", "BA", "Busway", "75 42 77 73 79 61"),
        ("string:6", "AB", "pump", "70 75 6D 70 00 00"),
        ("string:6:space", "AB", "pump", "70 75 6D 70 20 20"),
        ("string:6:space", "BA", "pumps", "75 70 70 6D 20 73"),
        ("string:5", "AB", "pumps", "70 75 6D 70 73 00"),  # the sixth byte only fills the register
        ("string:5:space", "AB", "pumps", "70 75 6D 70 73 20"),
        ("string:1", "AB", "x", "78 00"),
        ("string:4:latin-1", "AB", "20°C", "32 30 B0 43"),
        ("string:6:utf-8", "AB", "20°C", "32 30 C2 B0 43 00"),
        ("string:6:utf-8:space", "AB", "20°C", "32 30 C2 B0 43 20"),
        ("string:4", "AB", "", "00 00 00 00"),
        ("string:2", "DCBA", "ab", "62 61"),  # an order of the device, reduced to one register
        ("string:2", "CDAB", "ab", "61 62"),
        ("string:3:low", "AB", "abc", "00 61 00 62 00 63"),  # one character in each register
        ("string:3:high", "AB", "abc", "61 00 62 00 63 00"),
        ("string:3:low", "BA", "abc", "61 00 62 00 63 00"),
        ("string:3:low", "AB", "a", "00 61 00 00 00 00"),
        ("string:3:space:high", "AB", "a", "61 00 20 00 20 00"),
        ("string:4:upper", "AB", "ABC", "41 42 43 00"),
    ],
)
def test_a_text_lies_in_its_registers(name: str, order: str, text: str, wire: str) -> None:
    assert encode([text], name, order) == bytes.fromhex(wire)
    assert decode(bytes.fromhex(wire), name, order) == [text]


def test_small_letters_become_capitals_in_both_directions() -> None:
    assert decode(bytes.fromhex("61 62 43 00"), "string:4:upper") == ["ABC"]
    assert encode(["abC"], "string:4:upper") == bytes.fromhex("41 42 43 00")
    assert decode(bytes.fromhex("00 61 00 62"), "string:2:low:upper") == ["AB"]


def test_several_texts_lie_one_after_the_other() -> None:
    wire = bytes.fromhex("61 62 63 00 64 00 00 00")  # "abc", "d"
    assert encode(["abc", "d"], "string:3") == wire
    assert decode(wire, "string:3") == ["abc", "d"]


def test_a_text_ends_at_the_first_nul_whatever_the_device_left_behind_it() -> None:
    assert decode(bytes.fromhex("61 62 00 FF 63 64"), "string:6") == ["ab"]
    assert decode(bytes.fromhex("61 20 00 FF 63 64"), "string:6:space") == ["a"]


def test_trailing_spaces_are_text_unless_they_are_the_padding() -> None:
    assert decode(b"ab  ", "string:4") == ["ab  "]
    assert decode(b"ab  ", "string:4:space") == ["ab"]


def test_the_filling_byte_of_an_odd_length_is_not_looked_at() -> None:
    assert decode(b"abc\xff", "string:3") == ["abc"]


@given(texts=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=5), max_size=4))
@pytest.mark.parametrize("order", ["AB", "BA"])
def test_texts_come_back_exactly(texts: list[str], order: str) -> None:
    kind = value_type("string:21:utf-8", order)
    assert kind.decode(kind.encode(texts)) == texts


@pytest.mark.parametrize(("name", "text", "size"), [("string:3", "four", 4), ("string:3:utf-8", "20°", 4)])
def test_a_text_too_long_is_refused_and_never_cut(name: str, text: str, size: int) -> None:
    with pytest.raises(InvalidRequest, match=rf"{text}.* does not fit {name}, .* at most 3 bytes .*; this is {size}"):
        encode([text], name)


def test_a_character_outside_the_encoding_is_refused() -> None:
    with pytest.raises(InvalidRequest, match=r"'20°C' does not fit string:8, which takes text .* in ascii"):
        encode(["20°C"], "string:8")


def test_a_nul_inside_a_text_is_refused_because_it_would_end_it() -> None:
    with pytest.raises(InvalidRequest, match="holds a NUL"):
        encode(["a\0b"], "string:8")


@pytest.mark.parametrize("value", [1, None, b"ab", ["a"]])
def test_what_is_not_text_is_refused(value: object) -> None:
    with pytest.raises(InvalidRequest, match="does not fit string:8"):
        encode([value], "string:8")


@pytest.mark.parametrize(("name", "wire"), [("string:2", "61 FF"), ("string:2:utf-8", "61 C2")])
def test_bytes_outside_the_encoding_are_a_broken_reply(name: str, wire: str) -> None:
    with pytest.raises(BadReply, match=f"as {name} expects; latin-1 takes every byte") as caught:
        decode(bytes.fromhex(wire), name)
    assert caught.value.raw == bytes.fromhex(wire)
