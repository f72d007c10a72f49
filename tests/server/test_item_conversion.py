"""Items as an application sees them."""

from typing import Any

import pytest

from busway.errors import InvalidRequest
from busway.server.item_conversion import packed, unpacked


def test_registers_are_numbers_and_bits_are_states() -> None:
    assert unpacked(bytes.fromhex("12 34 FF FF"), 2, bits=False) == [0x1234, 0xFFFF]
    bits = unpacked(b"\x05", 4, bits=True)
    assert bits == [True, False, True, False]
    assert all(isinstance(bit, bool) for bit in bits)


def test_packing_undoes_unpacking() -> None:
    assert packed([0x1234, 0xFFFF], bits=False) == bytes.fromhex("12 34 FF FF")
    assert packed([True, 0, 1], bits=True) == b"\x05"


@pytest.mark.parametrize(
    ("values", "bits"), [([65536], False), ([-1], False), (["1"], False), ([1.0], False), (["off"], True), ([2], True)]
)
def test_a_value_that_does_not_fit_is_refused(values: Any, bits: bool) -> None:
    with pytest.raises(InvalidRequest, match="value 1"):
        packed(values, bits=bits)
