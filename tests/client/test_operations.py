"""Operations of a unit: what is refused before a request is made, and which outcomes are errors."""

from typing import Any

import pytest

from busway.client.operations import errors_among, write_values
from busway.errors import InvalidRequest, LinkDown, NoReply
from busway.pdu.read_items import ReadCoils
from busway.pdu.write_items import MaskWriteRegister


@pytest.mark.parametrize("address", ["0x1", "4x1", "4x1.3"])
def test_a_word_for_the_function_that_does_not_exist_is_refused_whatever_is_written(address: str) -> None:
    wrong: Any = "nonsense"
    with pytest.raises(InvalidRequest, match="function must be auto, single or multiple, not 'nonsense'"):
        next(write_values(address, True, None, "ABCD", wrong))


def test_a_bit_is_written_with_a_mask_by_each_word_for_the_function() -> None:
    for word in ("auto", "single", "multiple"):
        assert next(write_values("4x1.3", True, None, "ABCD", word)) == (MaskWriteRegister(0, 0xFFF7, 8),)  # type: ignore[arg-type]


def test_errors_among_outcomes_keep_their_order_and_replies_are_none() -> None:
    reply, first, second = ReadCoils.Reply(b"\x01"), NoReply("late"), LinkDown("gone", kind="lost")
    assert errors_among([reply, first, reply, second]) == [first, second]
    assert errors_among([reply, reply]) == errors_among([]) == []
