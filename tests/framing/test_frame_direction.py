"""Conversation: which direction comes first, for whom."""

import pytest

from busway.framing.frame_direction import REPLY_WINDOW, Conversation, Due, LineRole
from busway.framing.received import Direction

REQUEST, REPLY, UNKNOWN = Direction.REQUEST, Direction.REPLY, Direction.UNKNOWN


def test_a_master_expects_replies_first_and_none_from_unit_0() -> None:
    master = Conversation(LineRole.MASTER)
    assert master.order(1, 3, 0.0) == (REPLY, REQUEST)
    assert master.order(0, 3, 0.0) == (REQUEST,)
    master.due = Due(0, 3)
    assert master.order(0, 3, 0.0) == (REPLY, REQUEST)


@pytest.mark.clause("S11")
def test_a_server_hears_only_requests_for_its_own_units_and_broadcasts() -> None:
    server = Conversation(LineRole.SERVER, {1})
    assert server.order(1, 3, 0.0) == server.order(0, 6, 0.0) == (REQUEST,)
    assert server.order(5, 3, 0.0) == (REQUEST, REPLY)


@pytest.mark.clause("S11")
def test_after_a_foreign_request_its_reply_comes_first_for_a_while() -> None:
    server = Conversation(LineRole.SERVER, {1})
    server.follow(5, 3, REQUEST, 10.0)
    assert server.order(5, 3, 10.1) == (REPLY, REQUEST)
    assert server.order(5, 4, 10.1) == server.order(6, 3, 10.1) == (REQUEST, REPLY)
    assert server.order(5, 3, 10.01 + REPLY_WINDOW) == (REQUEST, REPLY)
    server.follow(5, 3, REPLY, 10.2)
    assert server.order(5, 3, 10.3) == (REQUEST, REPLY)


def test_an_exception_is_a_reply() -> None:
    assert Conversation(LineRole.OBSERVER).order(5, 0x83, 0.0) == (REPLY,)


def test_no_unit_replies_to_a_broadcast_or_to_a_request_for_us() -> None:
    server = Conversation(LineRole.SERVER, {1})
    for unit in (0, 1):
        server.follow(5, 6, REQUEST, 0.0)
        server.follow(unit, 6, REQUEST, 0.0)
        assert server.due is None


def test_a_frame_whose_length_fits_no_rule_is_guessed_from_what_went_before() -> None:
    observer = Conversation(LineRole.OBSERVER)
    assert observer.guess(5, 0x41, 0.0) is UNKNOWN
    observer.follow(5, 0x41, UNKNOWN, 0.0)
    assert observer.guess(5, 0x41, 0.1) is REPLY
    assert observer.guess(5, 0xC1, 9.0) is REPLY
    assert Conversation(LineRole.SERVER, {5}).guess(5, 0x41, 0.0) is REQUEST
