"""Length rules: the flattened table says what the functions say, for every prefix of every kind of message."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.lengths import AROUND_PDU, ASK, FrameLengths, lengths_of, shape_of
from busway.framing.received import Direction
from busway.pdu.functions import STANDARD
from busway.pdu.message import NEED_MORE, UNKNOWN_LENGTH

LENGTHS = lengths_of(STANDARD)
VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "vectors.json").read_text())
RULE = {Direction.REQUEST: STANDARD.request_length, Direction.REPLY: STANDARD.reply_length}


@pytest.mark.clause("S8")
@given(st.binary(max_size=300), st.sampled_from([*STANDARD.codes(), 0x83, 0xAB, 0x41]), st.sampled_from(list(RULE)))
def test_it_says_what_the_table_says_as_soon_as_the_table_does(body: bytes, code: int, direction: Direction) -> None:
    data = bytearray((1, code)) + body
    for end in range(2, len(data) + 1):
        said = RULE[direction](bytes(data[1:end]), 0, end - 1)
        length = LENGTHS.length(direction, data, 0, end)
        if said in (NEED_MORE, UNKNOWN_LENGTH):
            # A fixed length is known from the function code alone, which is earlier than the table says it.
            assert length == said or length > 0
        else:
            assert length == said + AROUND_PDU


@pytest.mark.parametrize("vector", [one for one in VECTORS if one["framing"] == "pdu"], ids=lambda one: str(one["id"]))
def test_published_messages_are_as_long_as_the_rule_says(vector: dict[str, str]) -> None:
    frame = bytearray(b"\x01" + bytes.fromhex(vector["hex"]) + b"\0\0")
    direction = Direction.REQUEST if vector["direction"] == "request" else Direction.REPLY
    assert LENGTHS.length(direction, frame, 0, len(frame)) in (len(frame), UNKNOWN_LENGTH)


def test_one_look_is_enough_for_all_but_a_few() -> None:
    asked = {code for code in range(256) if ASK in (LENGTHS.requests[code], LENGTHS.replies[code])}
    assert asked == {0x08, 0x18, 0x2B, 0xAB}


def test_a_code_that_is_no_function_has_no_rule() -> None:
    for code in (0x00, 0x80, 0x41):
        assert LENGTHS.requests[code] == 0
        assert shape_of(LENGTHS.requests[code]) is None
    assert LENGTHS.replies[0x00] == LENGTHS.replies[0x80] == 0


@pytest.mark.parametrize(
    ("pdu", "may_be"),
    [
        ("03 0000 0002", True),
        ("06 0000 0009", True),  # a request and its reply
        ("03 04 0001 0002", False),  # a reply
        ("83 02", False),
        ("08 0000 A537", True),
        ("41 00", True),  # unknown to the table
        ("41", True),
        ("", True),  # too short for a frame
    ],
)
def test_frame_may_be_a_request_by_its_function_and_length(pdu: str, may_be: bool) -> None:
    assert LENGTHS.may_be_request(bytearray(b"\x05" + bytes.fromhex(pdu) + b"\0\0")) is may_be


def test_noise_does_not_fill_the_memory_of_answers() -> None:
    lengths = FrameLengths(STANDARD)
    for value in range(0x10000):
        lengths.length(Direction.REPLY, bytearray((1, 8, value >> 8, value & 0xFF, 0, 0)), 0, 6)
    assert 0 < len(lengths.asked_replies.answers) <= 4096


def test_rules_are_flattened_once_for_each_table() -> None:
    assert lengths_of(STANDARD) is LENGTHS


def test_replies_that_three_bytes_do_not_measure_are_measured_each_time_anew() -> None:
    lengths = FrameLengths(STANDARD)
    head = bytes.fromhex("01 2B 0E 01 81 00 00 01 00")
    for size in (1, 7, 200):
        frame = bytearray(head + bytes((size,)) + bytes(size + 2))
        assert lengths.length(Direction.REPLY, frame, 0, len(head)) == NEED_MORE
        assert lengths.length(Direction.REPLY, frame, 0, len(frame)) == len(frame)
    assert not lengths.asked_replies.answers
