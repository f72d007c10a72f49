"""Who is served next: round robin over callers, writes before reads to other units, no caller past itself."""

from collections.abc import Callable

import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.errors import Overloaded
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.session.call import Call
from busway.session.queue import RESERVED_PLACES, RequestQueue


def call(
    caller: object = "a", unit: int = 1, *, write: bool = False, requests: int = 1, is_priority: bool = False
) -> Call:
    request = WriteSingleRegister(0, 1) if write else ReadHoldingRegisters(0, 1)
    made = Call(unit, [request] * requests, is_write=write, timeout=1.0, retries=0, caller=caller)
    made.is_priority = is_priority
    return made


def serve(queue: RequestQueue, eligible: Callable[[Call], bool] | None = None) -> list[Call]:
    """Take one request at a time until nothing is left that may be sent."""
    order = []
    while (picked := queue.pick(eligible)) is not None:
        picked.take(1)
        order.append(picked)
        if not picked.has_more:
            queue.remove(picked)
    return order


def filled(*calls: Call) -> RequestQueue:
    queue = RequestQueue(64)
    for one in calls:
        queue.add(one)
    return queue


def test_callers_take_turns_whatever_each_has_asked() -> None:
    busy = [call("busy") for _ in range(4)]
    quiet, other = call("quiet"), call("other")
    assert serve(filled(*busy, quiet, other)) == [busy[0], quiet, other, *busy[1:]]


def test_a_batch_takes_turns_request_by_request() -> None:
    batch, one = call("a", requests=3), call("b")
    assert serve(filled(batch, one)) == [batch, one, batch, batch]


def test_calls_of_one_caller_to_one_unit_keep_their_order_whatever_they_are() -> None:
    calls = [call(write=position % 2 == 1) for position in range(6)]
    assert serve(filled(*calls)) == calls


def test_a_callers_writes_go_before_its_reads_to_other_units() -> None:
    first, second, write = call(unit=1), call(unit=2), call(unit=3, write=True)
    assert serve(filled(first, second, write)) == [write, first, second]


def test_a_write_does_not_pass_an_earlier_read_of_the_same_unit() -> None:
    other, read, write = call(unit=2), call(unit=1), call(unit=1, write=True)
    assert serve(filled(other, read, write)) == [other, read, write]
    # Once the read is gone, the write goes before the reads to other units.
    read, first, second, write = call(unit=1), call(unit=2), call(unit=2), call(unit=1, write=True)
    assert serve(filled(read, first, second, write)) == [read, write, first, second]


def test_the_writes_of_one_caller_do_not_pass_the_reads_of_another() -> None:
    reads = [call("reader", unit=1) for _ in range(2)]
    writes = [call("writer", unit=2, write=True) for _ in range(2)]
    assert serve(filled(*reads, *writes)) == [reads[0], writes[0], reads[1], writes[1]]


def test_a_unit_that_must_not_be_asked_holds_up_its_own_requests_only() -> None:
    held, free, held_too, later = call(unit=1), call(unit=2), call("b", unit=1), call(unit=3)
    queue = filled(held, free, held_too, later)
    assert serve(queue, lambda one: one.unit != 1) == [free, later]
    assert list(queue) == [held, held_too] or list(queue) == [held_too, held]
    assert queue.size == 2


def test_of_a_unit_that_is_held_up_no_later_request_goes_first() -> None:
    held, write = call(unit=1), call(unit=1, write=True)
    assert serve(filled(held, write), lambda one: one is not held) == []


def test_what_is_repeated_goes_before_the_others_of_its_caller() -> None:
    first, second = call(), call()
    queue = filled(second)
    queue.add_again(first)
    assert serve(queue) == [first, second]


def test_what_is_repeated_and_still_waits_is_there_once() -> None:
    batch = call(requests=2)
    queue = filled(batch)
    queue.add_again(batch)
    assert (queue.size, list(queue)) == (1, [batch])


@pytest.mark.clause("T23")
@pytest.mark.parametrize("limit", [1, 3])
def test_a_full_queue_refuses_one_more_but_takes_back_what_is_repeated(limit: int) -> None:
    queue = RequestQueue(limit)
    for caller in range(limit):
        queue.add(call(caller))
    refused = call("late")
    with pytest.raises(Overloaded, match=f"{limit} calls wait on this link already; nothing was sent"):
        queue.add(refused)
    assert queue.size == limit
    queue.add_again(refused)
    assert queue.size == limit + 1


def test_what_is_taken_out_is_gone_and_what_is_not_in_is_not_taken_out() -> None:
    one, other = call("a", write=True), call("b")
    queue = filled(one, other)
    assert queue.remove(one)
    assert not queue.remove(one)
    assert not queue.remove(call("c"))
    assert not queue.remove(call("b"))
    assert (queue.size, queue.share(9), list(queue)) == (1, 9, [other])
    assert serve(queue) == [other]
    assert queue.pick() is None


def test_a_look_ahead_gives_what_comes_next_and_changes_nothing() -> None:
    one, other = call("a"), call("b")
    queue = filled(one, other)
    assert queue.peek() is one
    assert queue.peek() is one
    assert queue.peek(lambda each: each is other) is other
    assert serve(queue) == [one, other]
    assert queue.peek() is None


CALLS = st.lists(
    st.builds(call, st.sampled_from("abc"), st.integers(1, 3), write=st.booleans(), requests=st.integers(1, 3)),
    max_size=20,
)


@given(CALLS)
@settings(max_examples=examples(200))
def test_everything_is_served_once_and_no_unit_sees_a_caller_out_of_order(calls: list[Call]) -> None:
    order = serve(filled(*calls))
    assert len(order) == sum(len(one.requests) for one in calls)
    for caller in "abc":
        for unit in (1, 2, 3):
            asked = [one for one in calls if (one.caller, one.unit) == (caller, unit) for _ in one.requests]
            assert [one for one in order if (one.caller, one.unit) == (caller, unit)] == asked


@given(CALLS)
@settings(max_examples=examples(200))
def test_no_caller_is_passed_twice_while_it_waits(calls: list[Call]) -> None:
    waiting = {caller: sum(len(one.requests) for one in calls if one.caller == caller) for caller in "abc"}
    since: dict[str, set[object]] = {caller: set() for caller in "abc"}
    for one in serve(filled(*calls)):
        caller = str(one.caller)
        for other in "abc":
            if other != caller and waiting[other]:
                assert caller not in since[other], "one turn each"
                since[other].add(caller)
        since[caller] = set()
        waiting[caller] -= 1


def test_who_comes_anew_is_served_before_the_one_that_was_served_last() -> None:
    flood = [call("flood") for _ in range(3)]
    queue = filled(*flood)
    assert queue.pick() is flood[0]
    queue.remove(flood[0])
    quiet = call("quiet")
    queue.add(quiet)
    assert serve(queue) == [quiet, *flood[1:]]


def test_two_that_ask_one_by_one_take_turns_with_a_flood() -> None:
    flood = [call("flood") for _ in range(6)]
    queue = filled(*flood)
    order = []
    for number in range(9):
        if number in (1, 4):
            queue.add(call("one"))
            queue.add(call("two"))
        picked = queue.pick()
        assert picked is not None
        queue.remove(picked)
        order.append(picked.caller)
    assert order == ["flood", "one", "two", "flood", "one", "two", "flood", "flood", "flood"]


def test_no_new_connection_keeps_another_waiting_for_ever() -> None:
    queue = filled(call("first"), call("second"))
    assert queue.pick().caller == "first"  # type: ignore[union-attr]
    served = []
    for number in range(4):
        queue.add(call(f"new {number}"))
        picked = queue.pick()
        assert picked is not None
        queue.remove(picked)
        served.append(picked.caller)
    assert served[0] == "second"
    assert "first" in served


def test_a_turn_is_a_burst_or_a_share_of_the_room_where_that_is_asked_for() -> None:
    queue = filled(*(call(caller) for caller in "abcd"))
    assert queue.share(16) == 1
    queue.burst = 2
    assert [queue.share(room) for room in (1, 2, 8, 12, 16)] == [2, 2, 2, 3, 4]
    for one in list(queue)[1:]:
        queue.remove(one)
    assert queue.share(16) == 16  # no other caller waits


def test_in_its_turn_a_caller_gets_what_it_would_get_next_and_then_the_next_one_is_due() -> None:
    first, write, batch, other = call("a"), call("a", 2, write=True), call("a", 3, requests=4), call("b")
    queue = filled(first, write, batch, other)
    queue.burst = 4
    order = []
    picked = queue.pick()
    while picked is not None and len(order) < 4:
        picked.take(1)
        order.append(picked)
        queue.sent(picked, 1)
        picked = queue.pick_same()
    assert order == [write, first, batch, batch]
    assert list(queue.begun) == [batch]
    assert queue.pick() is other
    queue.remove(other)
    assert queue.pick_same() is None
    queue.remove(batch)
    assert not queue.begun


def test_what_takes_several_places_gives_each_free_when_it_is_sent() -> None:
    queue = RequestQueue(5)
    queue.burst = 4
    batch = call("a", requests=4)
    batch.places = 4
    queue.add(batch)
    too_much = call("b", requests=2)
    too_much.places = 2
    with pytest.raises(Overloaded):
        queue.add(too_much)
    assert (queue.size, queue.waiting) == (1, 4)
    assert queue.pick() is batch
    batch.take(3)
    queue.sent(batch, 3)
    assert (queue.size, queue.waiting) == (1, 1)
    queue.add(too_much)
    assert queue.waiting == 3
    assert queue.remove(batch)
    assert (queue.size, queue.waiting) == (1, 2)


def test_what_is_asked_again_has_begun_until_it_is_sent_or_taken_out() -> None:
    queue = RequestQueue(5)
    queue.burst = 4
    one, other = call("a"), call("b")
    for each in (one, other):
        queue.add_again(each)
    assert list(queue.begun) == [one, other]
    assert queue.pick() is one
    one.take(1)
    queue.sent(one, 1)
    queue.remove(other)
    assert not queue.begun


def test_units_of_a_caller_are_served_in_turn_where_that_is_asked_for() -> None:
    calls = [call(unit=unit) for unit in (1, 1, 1, 2, 2, 3)]
    queue = RequestQueue(64)
    queue.units_in_turn = True
    for one in calls:
        queue.add(one)
    assert [one.unit for one in serve(queue)] == [1, 2, 3, 1, 2, 1]


def test_units_in_turn_keep_the_order_within_a_unit_and_pass_those_that_may_not_be_asked() -> None:
    calls = [call(unit=unit) for unit in (1, 1, 2, 2)]
    queue = RequestQueue(64)
    queue.units_in_turn = True
    for one in calls:
        queue.add(one)
    assert serve(queue, lambda one: one.unit == 2) == calls[2:]
    assert serve(queue) == calls[:2]


def test_priority_hosts_go_first_each_once_and_then_one_of_the_others() -> None:
    flood = [call(f"flood {number % 2}") for number in range(4)]
    hosts = [call(f"host {number % 2}", is_priority=True) for number in range(6)]
    order = [one.caller for one in serve(filled(*flood, *hosts))]
    assert order == [
        *("host 0", "host 1", "flood 0"),
        *("host 0", "host 1", "flood 1"),
        *("host 0", "host 1", "flood 0"),
        "flood 1",
    ]


def test_priority_host_that_asks_one_by_one_waits_for_one_turn_of_the_others_at_most() -> None:
    queue = filled(*(call(f"flood {number}") for number in range(50)))
    waited = []
    for _ in range(10):
        host = call("host", is_priority=True)
        queue.add(host)
        before = 0
        while (picked := queue.pick()) is not host:
            assert picked is not None
            queue.remove(picked)
            before += 1
        queue.remove(host)
        waited.append(before)
    assert max(waited) <= 1


def test_priority_host_without_others_owes_them_no_turn_when_they_come() -> None:
    queue = filled(*(call("host", is_priority=True) for _ in range(4)))
    for _ in range(3):
        picked = queue.pick()
        assert picked is not None
        queue.remove(picked)
    queue.add(call("flood"))
    assert [one.caller for one in serve(queue)] == ["host", "flood"]


def test_unit_that_must_not_be_asked_holds_up_neither_priority_hosts_nor_others() -> None:
    host, other = call("host", unit=1, is_priority=True), call("flood", unit=2)
    queue = filled(host, other, call("host", unit=1, is_priority=True))
    assert serve(queue, lambda one: one.unit == 2) == [other]
    assert serve(queue)[0] is host


@pytest.mark.parametrize("limit", [1, 10])
def test_full_queue_has_places_that_priority_hosts_alone_take(limit: int) -> None:
    queue = RequestQueue(limit)
    for _ in range(limit):
        queue.add(call("flood"))
    for _ in range(RESERVED_PLACES):
        with pytest.raises(Overloaded):
            queue.add(call("flood"))
        queue.add(call("host", is_priority=True))
    with pytest.raises(Overloaded, match=f"{limit + RESERVED_PLACES} calls wait"):
        queue.add(call("host", is_priority=True))
    assert queue.waiting == limit + RESERVED_PLACES


@given(st.lists(st.builds(call, st.sampled_from("abc"), st.integers(1, 2), write=st.booleans()), max_size=20))
@settings(max_examples=examples(100))
def test_look_ahead_gives_what_is_picked_whichever_caller_has_priority(calls: list[Call]) -> None:
    for one in calls:
        one.is_priority = one.caller in "ab"
    queue = filled(*calls)
    while (ahead := queue.peek()) is not None:
        assert queue.pick() is ahead
        queue.remove(ahead)
    assert queue.pick() is None
    assert queue.size == 0
