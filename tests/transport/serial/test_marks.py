"""Marked characters in the stream of bytes."""

import os
import termios
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.transport.serial.marks import MarkDecoder, UnmarkedBytes, switch_marks_on


@pytest.mark.parametrize(
    ("stream", "data", "errors"),
    [
        ("01 03 00 0A", "01 03 00 0A", 0),
        ("01 FF FF 02", "01 FF 02", 0),  # a good FF is doubled
        ("01 FF 00 41 02", "01 41 02", 1),  # 41 with a parity error
        ("FF 00 00", "00", 1),  # a break
        ("FF 00 FF", "FF", 1),  # FF with a parity error
        ("FF FF 00 01", "FF 00 01", 0),  # a good FF and then two good characters
        ("FF 00 41 FF 00 42", "41 42", 2),
        ("FF 41", "FF 41", 0),  # which no system sends
    ],
)
def test_marks_are_taken_out_and_damaged_characters_stay(stream: str, data: str, errors: int) -> None:
    assert MarkDecoder().feed(bytes.fromhex(stream)) == UnmarkedBytes(bytes.fromhex(data), errors)


def test_a_mark_that_has_only_begun_gives_nothing_yet() -> None:
    decoder = MarkDecoder()
    assert decoder.feed(b"\xff") == UnmarkedBytes(b"", 0)
    assert decoder.feed(b"\x00") == UnmarkedBytes(b"", 0)
    assert decoder.feed(b"A") == UnmarkedBytes(b"A", 1)


@given(
    characters=st.lists(st.tuples(st.integers(0, 255), st.booleans())),
    cuts=st.lists(st.integers(0, 200), max_size=8),
)
def test_any_characters_survive_marking_however_the_stream_is_cut(
    characters: list[tuple[int, bool]], cuts: list[int]
) -> None:
    stream = b"".join(
        bytes([0xFF, 0x00, value]) if damaged else (b"\xff\xff" if value == 0xFF else bytes([value]))
        for value, damaged in characters
    )
    places = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
    decoder = MarkDecoder()
    received = [decoder.feed(stream[begin:end]) for begin, end in pairwise(places)]
    assert b"".join(part.data for part in received) == bytes(value for value, _ in characters)
    assert sum(part.errors for part in received) == sum(damaged for _, damaged in characters)


def test_the_system_marks_once_it_is_asked_to() -> None:
    near, far = os.openpty()
    try:
        switch_marks_on(far)
        assert termios.tcgetattr(far)[0] & (termios.PARMRK | termios.INPCK) == termios.PARMRK | termios.INPCK
    finally:
        os.close(near)
        os.close(far)


def test_what_is_no_port_cannot_be_marked() -> None:
    with open(os.devnull, "rb") as nothing, pytest.raises(OSError, match="ioctl"):
        switch_marks_on(nothing.fileno())
