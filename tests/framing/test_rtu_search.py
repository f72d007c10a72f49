"""Looking for a frame inside noise: the first place where one fits or may, rejected places never again."""

import pytest

from busway.framing.crc import running_states
from busway.framing.frame_direction import Due
from busway.framing.lengths import lengths_of
from busway.framing.rtu import encode_rtu
from busway.framing.rtu_search import DEAD, WAITS, FoundFrame, find_any, find_reply
from busway.pdu.functions import STANDARD

LENGTHS = lengths_of(STANDARD)
REPLY = encode_rtu(1, bytes.fromhex("03 02 00 07"))
JUNK = bytes.fromhex("00 00 FF 00")


def looked(data: bytes, due: Due | None = None, *, start: int = 0, at_limit: bool = False) -> FoundFrame:
    """Where a master with a reply due finds it, or an observer a frame."""
    buffer, states = bytearray(data), [0, *running_states(data)]
    if due is None:
        return find_any(buffer, states, start, LENGTHS, at_limit=at_limit)
    return find_reply(buffer, states, start, LENGTHS, due, at_limit=at_limit)


@pytest.mark.parametrize("due", [None, Due(1, 3)])
def test_a_frame_behind_junk_is_found(due: Due | None) -> None:
    assert looked(JUNK + REPLY, due, at_limit=True) == (4, 4 + len(REPLY))
    assert looked(JUNK + REPLY + JUNK, due, at_limit=True) == (4, 4 + len(REPLY))


@pytest.mark.parametrize("due", [None, Due(1, 3)])
def test_what_is_unfinished_is_waited_for_until_the_limit(due: Due | None) -> None:
    assert looked(REPLY[:-1], due) == (0, WAITS)
    place, end = looked(REPLY[:-1], due, at_limit=True)
    assert (place, end) == (len(REPLY) - 1, DEAD)


def test_the_last_bytes_may_begin_a_frame_that_shows_too_little_yet() -> None:
    assert looked(b"\xff" * 10, Due(1, 3)) == (7, WAITS)
    assert looked(b"\xff" * 10, Due(1, 3), at_limit=True) == (10, DEAD)


def test_only_the_reply_that_is_due_and_its_exception_are_looked_for() -> None:
    refusal = encode_rtu(1, b"\x83\x02")
    assert looked(REPLY, Due(2, 3), at_limit=True) == (len(REPLY), DEAD)
    assert looked(REPLY, Due(1, 4), at_limit=True) == (len(REPLY), DEAD)
    assert looked(JUNK + refusal, Due(1, 3), at_limit=True) == (4, 4 + len(refusal))
    buffer = bytearray(REPLY)
    assert find_reply(buffer, [0, *running_states(buffer)], 0, LENGTHS, None, at_limit=True) == (len(REPLY), DEAD)


def test_a_reply_of_a_function_without_a_rule_is_found_by_the_length_that_its_request_tells() -> None:
    frame = encode_rtu(1, b"\x41\x01\x02\x03")
    assert looked(JUNK + frame, Due(1, 0x41, 4), at_limit=True) == (4, 4 + len(frame))
    assert looked(JUNK + frame, Due(1, 0x41), at_limit=True) == (4 + len(frame), DEAD)


def test_rejected_places_are_not_looked_at_again() -> None:
    assert looked(REPLY + REPLY, start=1, at_limit=True) == (len(REPLY), 2 * len(REPLY))


def test_a_reply_that_only_its_content_measures_is_found_whole() -> None:
    frame = encode_rtu(1, bytes.fromhex("2B 0E 01 81 00 00 01 00 02 41 42"))
    assert looked(JUNK + frame, Due(1, 0x2B), at_limit=True) == (4, 4 + len(frame))
    assert looked(JUNK + frame[:-3], Due(1, 0x2B)) == (4, WAITS)
