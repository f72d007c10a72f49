"""CRC-16: the wire order of the document's example, every way of computing it the same, any span in one comparison."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.crc import PRESET, crc16, crc_bytes, running_states, span_check


def bit_by_bit(data: bytes) -> int:
    """The procedure of Serial Line V1.02 §6.2.2, step by step."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            carry = register & 1
            register >>= 1
            if carry:
                register ^= 0xA001
    return register


@pytest.mark.clause("S9")
def test_the_example_of_the_document_is_sent_low_byte_first() -> None:
    # §6.2.2 works out the frame 02 07: the register ends at 1241, on the wire 41 12.
    assert crc16(bytes.fromhex("02 07")) == 0x1241
    assert crc_bytes(bytes.fromhex("02 07")) == bytes.fromhex("41 12")


def test_nothing_leaves_the_preset() -> None:
    assert crc16(b"") == PRESET == 0xFFFF


@pytest.mark.clause("S9")
@given(st.binary(max_size=300))
def test_every_length_gives_what_the_bitwise_procedure_gives(data: bytes) -> None:
    assert crc16(data) == bit_by_bit(data)


@given(st.binary(max_size=100), st.binary(max_size=100))
def test_it_goes_on_from_an_earlier_state(first: bytes, second: bytes) -> None:
    assert crc16(second, crc16(first)) == crc16(first + second)


@given(st.binary(max_size=100))
def test_the_crc_of_a_frame_with_its_crc_is_zero(data: bytes) -> None:
    assert crc16(data + crc_bytes(data)) == 0


@given(st.binary(max_size=100))
def test_running_states_are_the_states_after_each_byte(data: bytes) -> None:
    assert running_states(data, PRESET) == [crc16(data[: end + 1]) for end in range(len(data))]


@given(st.binary(max_size=60), st.binary(min_size=2, max_size=254), st.binary(max_size=60))
def test_a_span_is_checked_from_the_running_states(before: bytes, body: bytes, behind: bytes) -> None:
    frame = body + crc_bytes(body)
    states = [0, *running_states(before + frame + behind)]
    check = span_check(len(frame))
    assert check.fits(states[len(before)], states[len(before) + len(frame)])


@given(st.binary(min_size=4, max_size=256), st.integers(0, 100))
def test_a_span_fits_exactly_where_its_crc_is_zero(data: bytes, start: int) -> None:
    start %= len(data) - 3
    states = [0, *running_states(data)]
    assert span_check(len(data) - start).fits(states[start], states[-1]) == (crc16(data[start:]) == 0)
