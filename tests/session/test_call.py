"""One call: what of it is still to be sent, and what became of it."""

from busway.errors import ExceptionReply
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.call import Call


def call(requests: int) -> Call:
    return Call(1, [ReadHoldingRegisters(0, 1)] * requests, is_write=False, timeout=1.0, retries=0)


def test_requests_are_taken_in_order_and_no_more_than_there_are() -> None:
    one = call(5)
    assert list(one.take(2)) == [0, 1]
    assert list(one.take(2)) == [2, 3]
    assert one.has_more
    assert list(one.take(2)) == [4]
    assert not one.has_more
    assert list(one.take(2)) == []


def test_what_is_repeated_is_taken_before_what_is_new() -> None:
    one = call(4)
    one.take(3)
    one.repeat(1)
    one.repeat(2)
    one.repeat(1)
    assert list(one.take(2)) == [1, 2]
    assert list(one.take(2)) == [1]
    assert list(one.take(2)) == [3]
    assert dict(one.attempts) == {1: 3, 2: 2}


def test_two_demands_share_nothing() -> None:
    one, other = call(2), call(2)
    one.take(2)
    one.repeat(0)
    assert not other.again
    assert not other.attempts
    assert one.outcomes is not other.outcomes


def test_the_error_of_a_demand_is_the_first_among_its_outcomes() -> None:
    one = call(3)
    assert one.error is None
    one.outcomes[2] = ExceptionReply(2)
    one.outcomes[1] = ExceptionReply(3)
    assert one.error is one.outcomes[1]
