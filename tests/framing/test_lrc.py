"""LRC: two's complement of the sum of the binary content."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.lrc import lrc


@pytest.mark.clause("S13")
def test_a_published_frame() -> None:
    # :0B0800000203E8, a loop back to unit 11
    assert lrc(bytes.fromhex("0B 08 00 00 02 03")) == 0xE8


@pytest.mark.clause("S13")
@given(st.binary(max_size=300))
def test_it_is_the_inverted_sum_plus_one_and_makes_the_sum_zero(data: bytes) -> None:
    assert lrc(data) == ((0xFF - sum(data) % 256) + 1) % 256
    assert lrc(data + bytes((lrc(data),))) == 0
