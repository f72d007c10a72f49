"""PDUs as one line of text."""

import pytest

from busway.framing.received import Direction
from busway.observe.wording import described, in_words
from busway.pdu.functions import STANDARD


@pytest.mark.parametrize(
    ("pdu", "direction", "words"),
    [
        (
            "03 006b 0003",
            Direction.REQUEST,
            "3 (read holding registers), request: address 107, holding register 4x108; count 3",
        ),
        (
            "83 02",
            Direction.REPLY,
            "3 (read holding registers), exception: exception code 02, illegal data address: an item in the range does"
            " not exist or may not be written",
        ),
        ("07", Direction.UNKNOWN, "7 (read exception status), request"),
        ("41 0102", Direction.REQUEST, "65 (0x41), request: data 01 02"),
    ],
)
def test_a_pdu_in_one_line(pdu: str, direction: Direction, words: str) -> None:
    assert in_words(described(bytes.fromhex(pdu), direction)) == words


def test_a_reply_is_explained_by_its_request() -> None:
    request = STANDARD.decode_request(bytes.fromhex("01 0000 0003"))
    assert in_words(described(bytes.fromhex("01 01 05"), Direction.REPLY, request=request)).endswith("on off on")


def test_what_is_wrong_comes_last() -> None:
    assert " ! " in in_words(described(bytes.fromhex("03 006b"), Direction.REQUEST))
