"""Byte and register orders: names, extensions, and that a swap is its own inverse."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.errors import InvalidRequest
from busway.values import ORDERS
from busway.values.orders import ByteOrder, byte_order, swapped

ALL_ORDERS = [(bits // 8, text) for bits, texts in ORDERS.items() for text in texts]


def test_there_are_two_orders_for_16_bits_four_for_32_and_eight_for_48_and_64() -> None:
    assert ORDERS == {
        16: ("AB", "BA"),
        32: ("ABCD", "BADC", "CDAB", "DCBA"),
        48: ("ABCDEF", "BADCFE", "EFCDAB", "FEDCBA", "CDABEF", "DCBAFE", "ABEFCD", "BAFEDC"),
        64: ("ABCDEFGH", "BADCFEHG", "CDABGHEF", "DCBAHGFE", "EFGHABCD", "FEHGBADC", "GHEFCDAB", "HGFEDCBA"),
    }


@pytest.mark.parametrize(("size", "text"), ALL_ORDERS)
def test_the_letters_are_the_bytes_in_the_sequence_in_which_they_travel(size: int, text: str) -> None:
    # Two values, "ABCD" and "abcd": the wire spells the order itself.
    wire = (text + text.lower()).encode()
    values = ("ABCDEFGH"[:size] + "abcdefgh"[:size]).encode()
    order = byte_order(text, size)
    assert order.text == text
    assert swapped(wire, order.swaps) == values


@given(place=st.sampled_from(ALL_ORDERS), data=st.binary(max_size=30))
def test_swapping_twice_gives_the_same_bytes(place: tuple[int, str], data: bytes) -> None:
    size, text = place
    block = data * size
    swaps = byte_order(text, size).swaps
    assert swapped(swapped(block, swaps), swaps) == block


@pytest.mark.parametrize(
    ("text", "size", "meant"),
    [
        # one order for a device, given to its larger types
        ("ABCD", 8, "ABCDEFGH"),
        ("CDAB", 8, "GHEFCDAB"),
        ("BADC", 8, "BADCFEHG"),
        ("DCBA", 8, "HGFEDCBA"),
        ("AB", 4, "ABCD"),
        ("BA", 4, "BADC"),
        ("AB", 8, "ABCDEFGH"),
        ("BA", 8, "BADCFEHG"),
        # and to its smaller ones
        ("ABCD", 2, "AB"),
        ("CDAB", 2, "AB"),
        ("BADC", 2, "BA"),
        ("DCBA", 2, "BA"),
        ("ABCDEFGH", 4, "ABCD"),
        ("GHEFCDAB", 4, "CDAB"),
        ("CDABGHEF", 4, "CDAB"),
        ("BADCFEHG", 4, "BADC"),
        ("HGFEDCBA", 4, "DCBA"),
        ("DCBAHGFE", 4, "DCBA"),
        ("EFGHABCD", 4, "ABCD"),
        ("FEHGBADC", 4, "BADC"),
        ("HGFEDCBA", 2, "BA"),
        # words
        ("big", 2, "AB"),
        ("big", 4, "ABCD"),
        ("big", 8, "ABCDEFGH"),
        ("little", 2, "BA"),
        ("little", 4, "DCBA"),
        ("little", 8, "HGFEDCBA"),
        ("word-swapped", 2, "AB"),
        ("word-swapped", 4, "CDAB"),
        ("word-swapped", 8, "GHEFCDAB"),
        ("byte-swapped", 2, "BA"),
        ("byte-swapped", 4, "BADC"),
        ("byte-swapped", 8, "BADCFEHG"),
        # spelling
        (" cdab ", 4, "CDAB"),
        ("Word_Swapped", 4, "CDAB"),
    ],
)
def test_a_name_for_another_size_is_taken_in_the_same_sense(text: str, size: int, meant: str) -> None:
    assert byte_order(text, size).text == meant


@pytest.mark.parametrize("text", ["", "ACBD", "ABC", "ABCDE", "middle", "AABB"])
def test_an_unknown_order_is_refused_with_the_orders_that_exist(text: str) -> None:
    with pytest.raises(InvalidRequest, match=r"unknown order .*ABCD, BADC, CDAB, DCBA.*word-swapped"):
        byte_order(text, 4)


def test_an_order_that_is_not_text_is_refused() -> None:
    with pytest.raises(InvalidRequest, match="not int"):
        byte_order(1234, 4)  # type: ignore[arg-type]


def test_swapping_takes_whatever_holds_bytes() -> None:
    swaps = ByteOrder(4, 2).swaps
    for holder in (bytes, bytearray, memoryview):
        assert swapped(holder(b"CDAB"), swaps) == b"ABCD"
