"""Which datagrams are one whole frame."""

import pytest

from busway.framing.ascii import encode_ascii
from busway.framing.datagram import WHOLE
from busway.framing.mbap import encode_mbap
from busway.framing.rtu import encode_rtu

PDU = bytes.fromhex("03 00 00 00 0a")
WHOLE_ONES = {"mbap": encode_mbap(7, 1, PDU), "rtu": encode_rtu(1, PDU), "ascii": encode_ascii(1, PDU)}


@pytest.mark.parametrize("framing", WHOLE_ONES)
def test_one_frame_is_whole_and_nothing_less_or_more(framing: str) -> None:
    is_whole, frame = WHOLE[framing], WHOLE_ONES[framing]
    assert is_whole(frame)
    for end in range(len(frame)):
        assert not is_whole(frame[:end]), end
    for more in (b"\x00", b":", b"\r\n", frame):
        assert not is_whole(frame + more), more
        assert not is_whole(more + frame), more


@pytest.mark.parametrize("framing", ["rtu", "mbap"])
def test_each_flipped_byte_that_says_how_long_or_whether_it_fits_is_noticed(framing: str) -> None:
    frame = WHOLE_ONES[framing]
    places = range(len(frame)) if framing == "rtu" else (4, 5)
    for place in places:
        damaged = bytearray(frame)
        damaged[place] ^= 0x20
        assert not WHOLE[framing](bytes(damaged))


def test_largest_frames_are_whole_and_larger_ones_are_not() -> None:
    longest = b"\x41" + bytes(252)
    assert WHOLE["mbap"](encode_mbap(1, 1, longest))
    assert WHOLE["rtu"](encode_rtu(1, longest))
    assert WHOLE["ascii"](encode_ascii(1, longest))
    assert not WHOLE["mbap"](encode_mbap(1, 1, longest + b"\x00"))
    assert not WHOLE["rtu"](encode_rtu(1, longest + b"\x00"))
    assert not WHOLE["ascii"](encode_ascii(1, longest + b"\x00"))
