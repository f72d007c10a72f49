"""What becomes of calls, whatever the conversation: retries, deadlines, and errors that say what is true."""

from typing import Any

import pytest

from busway.errors import LinkDown, ModbusError, NoReply, Overloaded, WriteOutcomeUnknown
from busway.options.client import ClientParameters
from busway.pdu.message import Request
from busway.pdu.read_items import ReadHoldingRegisters
from busway.pdu.write_items import WriteSingleRegister
from busway.session.call import Call
from busway.session.call_retries_and_deadlines import CallTracker

READ, WRITE = ReadHoldingRegisters(5, 1), WriteSingleRegister(6, 1)


def tracker(**options: Any) -> CallTracker:
    return CallTracker(ClientParameters(**options), "tcp://192.0.2.5:502")


def call(*requests: Request, **options: Any) -> Call:
    values: dict[str, Any] = {"timeout": 1.0, "retries": 1, **options}
    return Call(3, requests, is_write=any(one.is_write for one in requests), **values)


def send(book: CallTracker, one: Call) -> None:
    one.take(len(one.requests))
    book.queue.remove(one)


def outcome(one: Call, position: int = 0) -> Any:
    found = one.outcomes[position]
    assert isinstance(found, ModbusError)
    return found


def test_a_call_that_has_all_its_outcomes_is_finished_once() -> None:
    book, one = tracker(), call(READ, READ, deadline=9.0)
    book.submit(one, 1.0)
    assert (one.submitted, book.deadlines) == (1.0, 1)
    send(book, one)
    book.conclude(one, 1, READ.Reply(b"\x00\x01"))
    assert book.finished == []
    book.conclude(one, 0, READ.Reply(b"\x00\x02"))
    assert book.finished == [one]
    assert (one.ended, book.deadlines) == (True, 0)


def test_a_full_queue_says_whose_request_was_refused_and_counts_it() -> None:
    book = tracker(queue=1)
    book.submit(call(READ, deadline=5.0), 0.0)
    with pytest.raises(Overloaded) as caught:
        book.submit(call(READ, deadline=5.0), 0.0)
    assert (caught.value.unit, caught.value.endpoint) == (3, "tcp://192.0.2.5:502")
    assert (book.counters.overloaded, book.deadlines) == (1, 1)


@pytest.mark.parametrize(
    ("request_", "options", "link_options", "attempts"),
    [
        (READ, {"retries": 0}, {}, 1),
        (READ, {"retries": 3}, {}, 4),
        (WRITE, {"retries": 3}, {}, 1),
        (WRITE, {"retries": 3}, {"write_retries": 2}, 3),
        (WRITE, {"retries": 3, "idempotent": True}, {}, 4),
    ],
)
def test_what_may_be_repeated_is_repeated_so_often(
    request_: Request, options: dict[str, Any], link_options: dict[str, Any], attempts: int
) -> None:
    book, one = tracker(**link_options), call(request_, **options)
    book.submit(one, 0.0)
    sent = 0
    while not one.ended:
        send(book, one)
        sent += 1
        book.failed(one, 0, NoReply("no reply"), 1.0, again=True)
    assert sent == attempts
    assert outcome(one).attempt == attempts
    assert type(outcome(one)) is (WriteOutcomeUnknown if request_.is_write else NoReply)


def test_an_error_says_where_it_was_and_when() -> None:
    book, one = tracker(), call(READ, WRITE)
    book.submit(one, 10.0)
    send(book, one)
    book.failed(one, 0, NoReply("no reply"), 12.5, again=False)
    book.failed(one, 1, NoReply("no reply", raw=b"\x01"), 12.5, again=False)
    for position, function, address in ((0, 3, 5), (1, 6, 6)):
        error = outcome(one, position)
        assert (error.endpoint, error.unit, error.function, error.address) == (
            "tcp://192.0.2.5:502",
            3,
            function,
            address,
        )
        assert (error.elapsed, error.attempt) == (2.5, 1)
    assert outcome(one, 1).raw == b"\x01"


def test_what_is_withdrawn_is_not_repeated_and_not_finished() -> None:
    book, one = tracker(), call(READ, deadline=9.0)
    book.submit(one, 0.0)
    send(book, one)
    book.withdraw(one)
    book.withdraw(one)
    assert (book.counters.cancelled, book.deadlines, one.ended) == (1, 0, True)
    book.failed(one, 0, NoReply("no reply"), 1.0, again=True)
    assert book.queue.size == 0


def test_a_deadline_ends_what_waits_and_leaves_what_is_in_flight() -> None:
    book, one, other = tracker(), call(READ, READ, deadline=2.0), call(READ)
    book.submit(one, 0.0)
    book.submit(other, 0.0)
    assert book.next_deadline() == 2.0
    one.take(1)
    book.expire_queue(1.9, set())
    assert one.outcomes == [None, None]
    book.expire_queue(2.0, {(id(one), 0)})
    assert one.outcomes[0] is None
    assert "nothing was sent" in str(outcome(one, 1))
    assert not other.ended
    assert book.next_deadline() is None


@pytest.mark.parametrize("end", ["deadline", "unreachable", "given up"])
def test_a_write_that_was_sent_and_waits_to_be_repeated_ends_as_unknown(end: str) -> None:
    book = tracker(write_retries=1)
    written, read, fresh = call(WRITE, deadline=5.0), call(READ, deadline=5.0), call(WRITE, deadline=5.0)
    for one in (written, read, fresh):
        book.submit(one, 0.0)
    for one in (written, read):
        send(book, one)
        book.failed(one, 0, NoReply("no reply"), 1.0, again=True)
    if end == "deadline":
        book.expire_queue(5.0, set())
    elif end == "unreachable":
        book.unreachable(5.0, LinkDown("refused"))
    else:
        for one in (written, read, fresh):
            book.give_up(one, 5.0, lambda: NoReply("suspended"))
    assert type(outcome(written)) is WriteOutcomeUnknown
    assert outcome(written).attempt == outcome(written).__cause__.attempt == 1
    for one in (read, fresh):
        assert type(outcome(one)) is (LinkDown if end == "unreachable" else NoReply)
    assert outcome(read).attempt == 1
    assert outcome(fresh).attempt is None
    assert book.queue.size == book.deadlines == 0


def test_a_read_that_is_asked_once_more_lets_no_other_request_of_its_call_be_sent_twice() -> None:
    book = tracker()
    one = call(ReadHoldingRegisters(0, 1), WriteSingleRegister(0, 1), ReadHoldingRegisters(0, 1), retries=0)
    book.submit(one, 0.0)
    one.take(3)
    book.queue.remove(one)
    book.repeat(one, 0)
    book.failed(one, 1, NoReply("no reply"), 1.0, again=True)
    book.failed(one, 2, NoReply("no reply"), 1.0, again=True)
    assert isinstance(outcome(one, 1), WriteOutcomeUnknown)
    assert isinstance(outcome(one, 2), NoReply)
    assert list(one.again) == [0]
