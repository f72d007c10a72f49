"""Calls: what is still to be sent, what became of it, and what is kept with their requests."""

import math
import re
from typing import Any, cast

import pytest
from conversations import read

from busway.errors import ExceptionReply, InvalidRequest
from busway.options.client import ClientParameters
from busway.pdu.read_items import ReadHoldingRegisters
from busway.session.call import Call, CallOptions, call_for, encoded_request


def call_of(requests: int) -> Call:
    return Call(1, [ReadHoldingRegisters(0, 1)] * requests, is_write=False, timeout=1.0, retries=0)


def test_requests_are_taken_in_order_and_no_more_than_there_are() -> None:
    one = call_of(5)
    assert list(one.take(2)) == [0, 1]
    assert list(one.take(2)) == [2, 3]
    assert one.has_more
    assert list(one.take(2)) == [4]
    assert not one.has_more
    assert list(one.take(2)) == []


def test_what_is_repeated_is_taken_before_what_is_new() -> None:
    one = call_of(4)
    one.take(3)
    one.repeat(1)
    one.repeat(2)
    one.repeat(1)
    assert list(one.take(2)) == [1, 2]
    assert list(one.take(2)) == [1]
    assert list(one.take(2)) == [3]
    assert dict(one.attempts) == {1: 3, 2: 2}


def test_two_calls_share_nothing() -> None:
    one, other = call_of(2), call_of(2)
    one.take(2)
    one.repeat(0)
    assert not other.again
    assert not other.attempts
    assert one.outcomes is not other.outcomes


def test_the_error_of_a_call_is_the_first_among_its_outcomes() -> None:
    one = call_of(3)
    assert one.error is None
    one.outcomes[2] = ExceptionReply(2)
    one.outcomes[1] = ExceptionReply(3)
    assert one.error is one.outcomes[1]


# Options of one call.

LINK = ClientParameters(timeout=2.0, retries=3, deadline=9.0)


def called(**options: Any) -> tuple[float, int, float | None]:
    """Timeout, retries and deadline of a call at the time 100, with these options, over `LINK`."""
    call = call_for(1, [read(0)], LINK, cast(CallOptions, options), 100.0)
    return call.timeout, call.retries, call.deadline


def test_option_that_is_left_out_or_none_is_that_of_the_link() -> None:
    assert called() == (2.0, 3, 109.0)
    assert called(timeout=None, retries=None, deadline=None) == (2.0, 3, 109.0)
    assert called(timeout=0.5, retries=0, deadline=4) == (0.5, 0, 104.0)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        *[("timeout", value, repr(value)) for value in ("x", -1.0, 3601, math.nan, math.inf, [1])],
        *[("retries", value, repr(value)) for value in ("x", -1, 101, 1.5, math.nan, [])],
        *[("deadline", value, repr(value)) for value in ("x", -1, math.nan, [1])],
    ],
    ids=str,
)
def test_option_that_is_no_number_in_its_range_is_refused_by_name(name: str, value: object, said: str) -> None:
    with pytest.raises(InvalidRequest, match=f"^{name} must be .*, not {re.escape(said)}$"):
        called(**{name: value})


# What is kept of a request.


def test_what_was_made_for_a_request_is_kept_for_each_unit() -> None:
    request = read(7)
    first, second = encoded_request(request, 1), encoded_request(request, 2)
    assert (first.tail[4], second.tail[4]) == (1, 2)
    assert encoded_request(request, 1) is first
    assert encoded_request(request, 2) is second
    assert encoded_request(request, 3) is not first
    assert [encoded_request(request, unit).unit for unit in (1, 2, 3)] == [1, 2, 3]
