"""Packed bits: the first item in the lowest bit, unused bits zero, at any offset."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.pdu.bits import pack_bits, slice_bits, splice_bits, unpack_bits

BITS = st.lists(st.booleans(), max_size=70)


@pytest.mark.clause("A9")
def test_the_first_item_is_the_lowest_bit_and_unused_bits_are_zero() -> None:
    assert pack_bits([True, False, True, True, False, False, True, True, True, False]) == b"\xcd\x01"
    assert pack_bits([]) == b""
    assert pack_bits([False] * 9) == b"\x00\x00"


def test_unpacking_gives_no_more_than_was_asked_and_no_more_than_there_is() -> None:
    assert unpack_bits(b"\xcd\x01", 10) == [True, False, True, True, False, False, True, True, True, False]
    assert unpack_bits(b"\x03", 1) == [True]
    assert unpack_bits(b"\x03", 20) == [True, True, False, False, False, False, False, False]
    assert unpack_bits(b"", 5) == []


@given(BITS)
def test_packed_bits_unpack_to_themselves(bits: list[bool]) -> None:
    assert unpack_bits(pack_bits(bits), len(bits)) == bits


@given(st.data())
def test_a_slice_holds_the_bits_of_its_range(data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.booleans(), min_size=1, max_size=70))
    first = data.draw(st.integers(0, len(bits) - 1))
    count = data.draw(st.integers(1, len(bits) - first))
    assert slice_bits(pack_bits(bits), first, count) == pack_bits(bits[first : first + count])


@given(st.data())
def test_a_splice_changes_its_range_and_nothing_else(data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.booleans(), min_size=1, max_size=70))
    first = data.draw(st.integers(0, len(bits) - 1))
    count = data.draw(st.integers(1, len(bits) - first))
    new = data.draw(st.lists(st.booleans(), min_size=count, max_size=count))
    stored = bytearray(pack_bits(bits))
    # What stands in the unused bits of the new bytes must not get in.
    packed = bytearray(pack_bits(new))
    if count % 8:
        packed[-1] |= 0xFF << count % 8 & 0xFF
    splice_bits(stored, first, count, bytes(packed))
    assert unpack_bits(bytes(stored), len(bits)) == bits[:first] + new + bits[first + count :]
