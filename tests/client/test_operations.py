"""Operations of a unit: what is refused before a request is made."""

from typing import Any

import pytest

from busway.client.operations import write_values
from busway.errors import InvalidRequest
from busway.pdu.write_items import MaskWriteRegister


@pytest.mark.parametrize("address", ["0x1", "4x1", "4x1.3"])
def test_a_word_for_the_function_that_does_not_exist_is_refused_whatever_is_written(address: str) -> None:
    wrong: Any = "nonsense"
    with pytest.raises(InvalidRequest, match="function must be auto, single or multiple, not 'nonsense'"):
        next(write_values(address, True, None, "ABCD", wrong))


def test_a_bit_is_written_with_a_mask_by_each_word_for_the_function() -> None:
    for word in ("auto", "single", "multiple"):
        assert next(write_values("4x1.3", True, None, "ABCD", word)) == (MaskWriteRegister(0, 0xFFF7, 8),)  # type: ignore[arg-type]
