"""MBAP: whatever the stream is cut into, the same frames; a length outside of the limits breaks it at once."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.mbap import (
    MAX_LENGTH,
    FrameKind,
    MbapFrame,
    MbapReceiver,
    StreamBuffer,
    encode_mbap,
    impossible_length,
)

REQUEST = bytes.fromhex("00 07 00 00 00 06 11 03 00 6B 00 03")
REPLY = bytes.fromhex("00 07 00 00 00 09 11 03 06 02 2B 00 00 00 64")

frames = st.tuples(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=1, max_size=253))


def frame(transaction: int, unit: int, pdu: bytes) -> MbapFrame:
    return MbapFrame(FrameKind.FRAME, transaction, 0, unit, pdu)


@pytest.mark.clause("T2")
def test_the_header_is_transaction_protocol_length_unit() -> None:
    assert encode_mbap(7, 0x11, bytes.fromhex("03 00 6B 00 03")) == REQUEST
    assert MbapReceiver().receive(REQUEST) == [frame(7, 0x11, REQUEST[7:])]


@pytest.mark.clause("T11")
@pytest.mark.parametrize("cut", range(1, len(REQUEST + REPLY)))
def test_a_split_at_any_place_makes_no_difference(cut: int) -> None:
    receiver = MbapReceiver()
    stream = REQUEST + REPLY
    found = receiver.receive(stream[:cut]) + receiver.receive(stream[cut:])
    assert found == [frame(7, 0x11, REQUEST[7:]), frame(7, 0x11, REPLY[7:])]
    assert len(receiver.unfinished) == 0


def test_a_frame_byte_by_byte_comes_out_with_its_last_byte() -> None:
    receiver = MbapReceiver()
    for count, byte in enumerate(REQUEST, start=1):
        found = receiver.receive(bytes((byte,)))
        assert len(found) == (count == len(REQUEST))
        assert len(receiver.unfinished) == (0 if found else count)


@pytest.mark.clause("T11")
@given(st.lists(frames, max_size=8), st.lists(st.integers(0, 2100), max_size=12), st.binary(max_size=5))
def test_any_cut_of_any_stream_gives_the_same_frames(
    sent: list[tuple[int, int, bytes]], cuts: list[int], beginning: bytes
) -> None:
    stream = b"".join(encode_mbap(*one) for one in sent) + beginning
    receiver = MbapReceiver()
    found = []
    places = sorted({0, *(min(cut, len(stream)) for cut in cuts), len(stream)})
    for start, end in pairwise(places):
        found += receiver.receive(bytearray(stream[start:end]))
    assert found == [frame(*one) for one in sent]
    assert len(receiver.unfinished) == len(beginning)


@pytest.mark.clause("T28")
@pytest.mark.parametrize("length", [0, 1, MAX_LENGTH + 1, 255, 65_535])
def test_a_length_that_cannot_be_breaks_the_stream_as_soon_as_it_is_there(length: int) -> None:
    receiver = MbapReceiver()
    good = receiver.receive(REQUEST)
    [broken] = receiver.receive(b"\x00\x08\x00\x00" + length.to_bytes(2, "big"))
    assert len(good) == 1
    assert broken.kind is FrameKind.BROKEN
    assert broken.reason == impossible_length(length)
    assert receiver.broken
    assert receiver.receive(REQUEST) == []


@pytest.mark.parametrize("length", [2, MAX_LENGTH])
def test_the_shortest_and_the_longest_length_are_frames(length: int) -> None:
    pdu = bytes(length - 1)
    assert MbapReceiver().receive(encode_mbap(1, 2, pdu)) == [frame(1, 2, pdu)]


def test_the_frames_before_a_broken_one_are_given() -> None:
    found = MbapReceiver().receive(REQUEST + REPLY + bytes.fromhex("FF FF FF FF FF FF FF"))
    assert [one.kind for one in found] == [FrameKind.FRAME, FrameKind.FRAME, FrameKind.BROKEN]
    assert found[2].pdu == bytes.fromhex("FF FF FF FF FF FF FF")


@pytest.mark.clause("T25")
@pytest.mark.clause("T28")
def test_another_protocol_is_reported_and_the_stream_goes_on() -> None:
    foreign = bytearray(REQUEST)
    foreign[2:4] = b"\x12\x34"
    found = MbapReceiver().receive(bytes(foreign) + REPLY)
    assert [one.kind for one in found] == [FrameKind.FOREIGN_PROTOCOL, FrameKind.FRAME]
    assert found[0].protocol == 0x1234


def test_trailing_bytes_wait_for_the_rest() -> None:
    receiver = MbapReceiver()
    assert len(receiver.receive(REQUEST + REPLY[:5])) == 1
    assert len(receiver.unfinished) == 5
    assert len(receiver.receive(REPLY[5:])) == 1


@given(st.binary(max_size=600), st.integers(1, 50))
def test_noise_never_keeps_more_than_a_frame_and_never_raises(noise: bytes, burst: int) -> None:
    receiver = MbapReceiver()
    for start in range(0, len(noise), burst):
        receiver.receive(noise[start : start + burst])
        assert len(receiver.unfinished) < 260


def test_silence_decides_nothing() -> None:
    receiver = MbapReceiver()
    receiver.receive(REQUEST[:5], 1.0)
    assert receiver.deadline() is None
    assert receiver.tick(1000.0) == []
    assert receiver.receive(REQUEST[5:], 1001.0) == [frame(7, 0x11, REQUEST[7:])]


def test_a_buffer_that_keeps_nothing_hands_through_what_it_is_given() -> None:
    buffer = StreamBuffer()
    data = bytearray(b"abcdef")
    assert buffer.join(data, 4) == (data, 4)
    buffer.keep(data, 4, 6)
    assert buffer.join(b"gh", 2) == (b"efgh", 4)
    assert buffer.kept == b""
