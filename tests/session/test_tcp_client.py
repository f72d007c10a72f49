"""The client's side of a TCP connection, with the clock and the wire in the hands of the test."""

from typing import Any

import pytest
from conversations import ClientWire, answer_to, read

from busway.errors import (
    BadReply,
    ExceptionReply,
    LinkDown,
    ModbusError,
    NoReply,
    Overloaded,
    WriteOutcomeUnknown,
)
from busway.framing.mbap import encode_mbap
from busway.options.client import MismatchPolicy
from busway.pdu.encapsulated import ReadDeviceIdentification
from busway.pdu.read_items import ReadFifoQueue, ReadHoldingRegisters
from busway.pdu.unknown_functions import OpaqueRequest
from busway.pdu.write_items import WriteMultipleRegisters, WriteSingleRegister
from busway.session.call import Call

WRITE = WriteSingleRegister(7, 0x1234)


def registers(call: Call, position: int = 0) -> list[int]:
    reply = call.outcomes[position]
    assert isinstance(reply, ReadHoldingRegisters.Reply), reply
    return reply.registers


def error(call: Call, position: int = 0) -> Any:
    outcome = call.outcomes[position]
    assert isinstance(outcome, ModbusError), outcome
    return outcome


# A request and its reply.


@pytest.mark.clause("T21")
@pytest.mark.clause("T2")
def test_a_call_becomes_an_adu_and_its_reply_the_outcome() -> None:
    wire = ClientWire(first_transaction=0x14FF)
    call = wire.ask(read(0x6B, 3), unit=17)
    frame = wire.send_one()
    assert (frame.protocol, frame.unit, frame.pdu) == (0, 17, bytes.fromhex("03 006B 0003"))
    assert (wire.session.in_flight, wire.session.queued) == (1, 0)
    wire.reply(frame)
    assert registers(call) == [0x6B, 0x6C, 0x6D]
    assert wire.finished() == [call]
    assert (wire.session.in_flight, call.ended, call.error) == (0, True, None)
    assert wire.session.valid_reply
    assert (wire.session.counters.requests, wire.session.counters.replies) == (1, 1)


def test_a_request_that_nothing_holds_up_leaves_without_the_queue() -> None:
    wire = ClientWire()
    call = wire.call([read(5)])
    adu = wire.session.send_now(call, wire.now)
    assert adu is not None
    wire.feed(adu[:4] + b"\x00\x05\x01\x03\x02\x00\x05")
    assert registers(call) == [5]
    # With a place taken, something waiting, or no connection, it has to wait like the others.
    wire.session.send_now(wire.call([read(6)]), wire.now)
    assert wire.session.send_now(wire.call([read(7)]), wire.now) is None
    assert ClientWire(connected=False).session.send_now(wire.call([read()]), 0.0) is None
    assert ClientWire(connect_delay=1.0).session.send_now(wire.call([read()]), 100.5) is None


@pytest.mark.clause("T9")
@pytest.mark.clause("T23")
def test_several_transactions_are_in_flight_and_their_replies_come_in_any_order() -> None:
    wire = ClientWire(max_transactions=4)
    calls = [wire.ask(read(address), caller=address) for address in range(6)]
    frames = wire.transmit()
    assert [frame.pdu[2] for frame in frames] == [0, 1, 2, 3]
    assert wire.transmit() == []
    for frame in reversed(frames):
        wire.reply(frame)
    for frame in wire.transmit():
        wire.reply(frame)
    assert [registers(call) for call in calls] == [[address] for address in range(6)]


@pytest.mark.clause("T22")
@pytest.mark.parametrize("first", [0, 1, 0x7FFF, 0xFFFE, 0xFFFF])
def test_identifiers_in_flight_are_unique_also_around_the_wrap(first: int) -> None:
    wire = ClientWire(max_transactions=16, first_transaction=first)
    for _ in range(20):
        call = wire.ask(*[read(address) for address in range(16)])
        frames = wire.transmit()
        assert len({frame.transaction for frame in frames}) == 16
        for frame in frames:
            wire.reply(frame)
        assert call.ended


@pytest.mark.clause("T22")
def test_every_identifier_is_used_before_one_comes_again() -> None:
    wire = ClientWire(max_transactions=16)
    seen: set[int] = set()
    for _ in range(65_536 // 16):
        wire.ask(*[read(address) for address in range(16)])
        for frame in wire.transmit():
            assert frame.transaction not in seen
            seen.add(frame.transaction)
            wire.reply(frame)
    assert len(seen) == 65_536


@pytest.mark.clause("T22")
def test_the_identifier_of_a_late_reply_is_not_used_again_also_after_the_wrap() -> None:
    wire = ClientWire(max_transactions=16, recycle_after_timeouts=1000)
    lost = wire.ask(read(999), retries=0)
    expired = wire.send_one().transaction
    wire.wait(1.0)
    assert lost.ended
    used = 0
    while used < 66_000:
        wire.ask(*[read(address) for address in range(16)])
        for frame in wire.transmit():
            assert frame.transaction != expired
            used += 1
            wire.reply(frame)
    # Once its late reply has come, nothing more can, and it is an identifier like the others.
    wire.feed(encode_mbap(expired, 1, b"\x03\x02\x03\xe7"))
    assert wire.session.counters.late_replies == 1
    seen = set()
    for _ in range(65_536 // 16):
        wire.ask(*[read(address) for address in range(16)])
        for frame in wire.transmit():
            seen.add(frame.transaction)
            wire.reply(frame)
    assert expired in seen


def test_replies_that_arrive_split_or_joined_make_no_difference() -> None:
    for size in (1, 2, 3, 5, 7, 11, 1000):
        wire = ClientWire(max_transactions=3)
        call = wire.ask(*[read(address, 2) for address in range(3)])
        stream = b"".join(encode_mbap(frame.transaction, 1, answer_to(frame)) for frame in wire.transmit())
        for at in range(0, len(stream), size):
            wire.feed(stream[at : at + size])
        assert [registers(call, position) for position in range(3)] == [[0, 1], [1, 2], [2, 3]]


def test_a_receive_buffer_that_is_used_again_does_not_change_a_reply() -> None:
    wire = ClientWire()
    call = wire.ask(read(0x1111))
    frame = wire.send_one()
    buffer = bytearray(encode_mbap(frame.transaction, 1, answer_to(frame)))
    size = len(buffer)
    buffer += bytes(50)
    wire.session.receive(buffer, size, wire.now)
    buffer[:] = b"\xff" * len(buffer)
    assert registers(call) == [0x1111]


# Batches.


@pytest.mark.clause("T11")
def test_requests_of_a_batch_leave_joined_unless_each_is_to_have_its_segment() -> None:
    for single, segments in ((False, 1), (True, 4)):
        wire = ClientWire(max_transactions=4, single_adu_segments=single)
        wire.ask(*[read(address) for address in range(4)])
        assert len(wire.session.transmit(wire.now)) == segments


def test_calls_of_different_callers_leave_one_by_one() -> None:
    wire = ClientWire(max_transactions=4)
    for caller in range(3):
        wire.ask(read(caller), caller=caller)
    assert len(wire.session.transmit(wire.now)) == 3


def test_a_batch_has_mixed_outcomes_each_in_its_place() -> None:
    wire = ClientWire(max_transactions=16)
    call = wire.ask(read(0), read(1), WRITE, read(3), ReadFifoQueue(4), retries=0)
    first, second, third, fourth, _ = wire.transmit()
    wire.reply(second, b"\x83\x02")
    wire.reply(third)
    wire.reply(fourth, b"\x03\x03\x00\x00\x00")
    wire.reply(first)
    assert wire.finished() == []
    wire.wait(1.0)
    assert wire.finished() == [call]
    assert registers(call, 0) == [0]
    assert (type(error(call, 1)), error(call, 1).code) == (ExceptionReply, 2)
    assert call.outcomes[2] == WriteSingleRegister.Reply(7, 0x1234)
    assert type(error(call, 3)) is BadReply
    assert type(error(call, 4)) is NoReply
    assert call.error is call.outcomes[1]


def test_a_large_batch_keeps_the_limit_and_the_order() -> None:
    wire = ClientWire(max_transactions=16)
    call = wire.ask(*[read(address) for address in range(100)])
    most = 0
    while not call.ended:
        frames = wire.transmit()
        most = max(most, wire.session.in_flight)
        for frame in frames[::-1]:
            wire.reply(frame)
    assert most == 16
    assert [registers(call, position) for position in range(100)] == [[address] for address in range(100)]


def test_what_of_a_batch_gets_no_reply_is_repeated_alone() -> None:
    wire = ClientWire(max_transactions=4)
    call = wire.ask(*[read(address) for address in range(4)], retries=1)
    frames = wire.transmit()
    for frame in frames[:3]:
        wire.reply(frame)
    wire.wait(1.0)
    again = wire.send_one()
    assert again.pdu == frames[3].pdu
    assert again.transaction != frames[3].transaction
    wire.reply(again)
    assert [registers(call, position) for position in range(4)] == [[address] for address in range(4)]
    assert wire.session.counters.retries == 1


# Time.


@pytest.mark.clause("T26")
def test_a_read_without_a_reply_is_repeated_and_then_fails_with_what_is_known() -> None:
    wire = ClientWire(timeout=0.5, retries=2)
    call = wire.ask(read(40))
    for attempt in range(3):
        assert not call.ended
        wire.send_one()
        assert wire.session.deadline() == wire.now + 0.5
        wire.wait(0.499)
        assert wire.transmit() == []
        wire.wait(0.001)
        assert call.ended == (attempt == 2)
    failure = error(call)
    assert type(failure) is NoReply
    assert (failure.kind, failure.attempt, failure.unit, failure.function) == ("nothing", 3, 1, 3)
    assert (failure.address, failure.endpoint) == (40, "tcp://192.0.2.5:502")
    assert failure.elapsed == pytest.approx(1.5)
    assert wire.session.deadline() is None


@pytest.mark.clause("T26")
def test_each_call_may_have_its_own_timeout() -> None:
    wire = ClientWire(max_transactions=2)
    short, long = wire.ask(read(1), timeout=0.2, retries=0), wire.ask(read(2), timeout=5.0, caller="other")
    wire.transmit()
    wire.wait(0.2)
    assert short.ended
    wire.wait(4.0)
    assert not long.ended


def test_a_deadline_in_the_queue_ends_the_call_before_anything_is_sent() -> None:
    wire = ClientWire()
    wire.ask(read(1), timeout=10.0)
    wire.transmit()
    waiting = wire.ask(read(2), deadline=wire.now + 0.3)
    assert wire.session.deadline() == wire.now + 0.3
    wire.wait(0.3)
    assert "nothing was sent" in str(error(waiting))
    assert error(waiting).attempt is None
    assert wire.session.queued == 0


def test_a_deadline_in_flight_ends_the_call_without_a_further_attempt() -> None:
    wire = ClientWire()
    call = wire.ask(read(1), timeout=1.0, retries=5, deadline=wire.now + 0.4)
    wire.send_one()
    assert wire.session.deadline() == wire.now + 0.4
    wire.wait(0.4)
    assert type(error(call)) is NoReply
    assert "before the deadline of the call" in str(error(call))
    assert wire.transmit() == []
    assert wire.session.deadline() is None


def test_a_deadline_ends_a_batch_part_of_which_is_answered_in_flight_and_unsent() -> None:
    wire = ClientWire(max_transactions=2)
    call = wire.ask(read(0), read(1), read(2), read(3), deadline=wire.now + 0.5)
    first, _ = wire.transmit()
    wire.reply(first)
    wire.transmit()
    wire.wait(0.5)
    assert registers(call, 0) == [0]
    assert [type(error(call, position)) for position in (1, 2, 3)] == [NoReply] * 3
    assert "nothing was sent" in str(error(call, 3))
    assert "nothing was sent" not in str(error(call, 1))
    assert wire.places == 2


def test_a_write_whose_deadline_passes_while_it_waits_to_be_repeated_may_have_been_executed() -> None:
    wire = ClientWire(max_transactions=1)
    call = wire.ask(WRITE, idempotent=True, retries=3, deadline=wire.now + 2.0)
    wire.send_one()
    wire.wait(1.0)  # repeated, but another caller has the turn
    wire.session.disconnected(wire.now, "gone")
    wire.wait(1.0)
    assert type(error(call)) is WriteOutcomeUnknown
    assert type(error(call).__cause__) is NoReply
    assert error(call).attempt == 1


def test_a_write_that_waits_to_be_repeated_when_no_connection_can_be_had_may_have_been_executed() -> None:
    wire = ClientWire(write_retries=2)
    call, never_sent, other = wire.ask(WRITE), wire.ask(WRITE, caller="b"), wire.ask(read(), caller="c")
    wire.send_one()
    wire.session.disconnected(wire.now, "gone")
    wire.session.unreachable(wire.now, LinkDown("connection refused"))
    assert type(error(call)) is WriteOutcomeUnknown
    cause = error(call).__cause__
    assert type(cause) is LinkDown
    assert cause.sent
    for waiting in (never_sent, other):
        assert type(error(waiting)) is LinkDown
        assert not error(waiting).sent
        assert error(waiting).message == "connection refused"


def test_the_timer_never_lies_in_the_past_of_a_link_that_may_not_send() -> None:
    wire = ClientWire(connect_delay=0.5)
    wire.ask(read())
    assert wire.session.deadline() == wire.now + 0.5
    wire.wait(0.5)
    # The transport takes nothing more, so nothing is transmitted: nothing to wake up for.
    assert wire.session.deadline() is None


# Late replies.


@pytest.mark.clause("T22")
@pytest.mark.clause("T25")
def test_a_late_reply_is_dropped_and_tells_how_slow_the_device_is() -> None:
    wire = ClientWire(timeout=1.0, retries=0)
    first = wire.ask(read(1))
    late = wire.send_one()
    wire.wait(1.0)
    second = wire.ask(read(2))
    frame = wire.send_one()
    wire.now += 0.4
    wire.reply(late)
    assert not second.ended
    assert [delay for _, delay in wire.session.late_units.values()] == pytest.approx([1.4])
    assert wire.session.counters.late_replies == 1
    wire.reply(frame)
    assert registers(second) == [2]
    assert error(first).kind == "nothing"


def test_a_timeout_after_a_late_reply_says_that_a_longer_one_would_do() -> None:
    wire = ClientWire(timeout=1.0, retries=0)
    wire.ask(read(1))
    late = wire.send_one()
    wire.wait(1.0)
    second = wire.ask(read(2))
    wire.send_one()
    wire.now += 0.4
    wire.reply(late)
    wire.wait(0.6)
    assert (error(second).kind, error(second).observed_delay) == ("late", pytest.approx(1.4))
    assert "1.400 s" in str(error(second))


def test_a_reply_to_an_earlier_attempt_is_late_though_the_request_is_in_flight_again() -> None:
    wire = ClientWire()
    call = wire.ask(read(9))
    first = wire.send_one()
    wire.wait(1.0)
    second = wire.send_one()
    wire.reply(first)
    assert not call.ended
    wire.reply(second)
    assert registers(call) == [9]


# Writes.


@pytest.mark.parametrize("retries", [0, 5])
def test_a_write_without_a_reply_is_not_repeated_and_its_outcome_is_unknown(retries: int) -> None:
    wire = ClientWire(retries=retries)
    call = wire.ask(WRITE, retries=retries)
    wire.send_one()
    wire.wait(1.0)
    failure = error(call)
    assert type(failure) is WriteOutcomeUnknown
    assert (failure.unit, failure.function, failure.address, failure.attempt) == (1, 6, 7, 1)
    assert type(failure.__cause__) is NoReply
    assert wire.transmit() == []


@pytest.mark.parametrize(("options", "idempotent"), [({"write_retries": 1}, False), ({"retries": 1}, True)])
def test_a_write_is_repeated_where_the_caller_says_that_it_may(options: dict[str, Any], idempotent: bool) -> None:
    wire = ClientWire(**options)
    call = wire.ask(WRITE, idempotent=idempotent)
    wire.send_one()
    wire.wait(1.0)
    wire.reply(wire.send_one())
    assert call.outcomes == [WriteSingleRegister.Reply(7, 0x1234)]


def test_a_write_whose_connection_ends_or_whose_reply_is_broken_has_an_unknown_outcome() -> None:
    wire = ClientWire()
    lost = wire.ask(WRITE)
    wire.send_one()
    wire.session.disconnected(wire.now, "reset by peer")
    assert type(error(lost).__cause__) is LinkDown
    assert error(lost).__cause__.sent
    wire.session.connected(wire.now)
    broken = wire.ask(WRITE)
    wire.reply(wire.send_one(), b"\x06\x00\x07\x12\x35")
    assert type(error(broken)) is WriteOutcomeUnknown
    assert type(error(broken).__cause__) is BadReply
    assert error(broken).raw == error(broken).__cause__.raw != b""


def test_a_write_answered_0b_by_a_gateway_has_an_unknown_outcome_and_a_read_was_refused() -> None:
    wire = ClientWire()
    write = wire.ask(WRITE)
    wire.reply(wire.send_one(), b"\x86\x0b")
    assert type(error(write)) is WriteOutcomeUnknown
    assert error(write).__cause__.from_gateway
    reading = wire.ask(read())
    wire.reply(wire.send_one(), b"\x83\x0b")
    assert (type(error(reading)), error(reading).code) == (ExceptionReply, 0x0B)


@pytest.mark.clause("A20")
@pytest.mark.parametrize("code", [*range(1, 12), 0, 0x55, 0xFF])
def test_an_exception_is_a_confirmation_with_its_code_and_nothing_is_repeated(code: int) -> None:
    wire = ClientWire(retries=3)
    call = wire.ask(read(4), unit=9)
    wire.reply(wire.send_one(), bytes((0x83, code)))
    assert (error(call).code, error(call).unit, error(call).address) == (code, 9, 4)
    assert wire.transmit() == []
    assert wire.session.counters.exceptions == 1


@pytest.mark.clause("A19")
def test_identification_may_be_refused_with_its_mei_type_between() -> None:
    for pdu in (b"\xab\x02", b"\xab\x0e\x02"):
        wire = ClientWire()
        call = wire.ask(ReadDeviceIdentification(4, 9))
        wire.reply(wire.send_one(), pdu)
        assert error(call).code == 2


# What does not fit.


@pytest.mark.clause("T25")
@pytest.mark.parametrize(
    ("request_", "pdu", "reason"),
    [
        (read(0, 2), "04 04 0000 0000", "function 4 answers function 3"),
        (read(0, 2), "84 02", "function 132 answers function 3"),
        (read(0, 2), "03 02 0000", "4 bytes where 6 answer the request"),
        (read(0, 2), "03 06 0000 0000 0000", "8 bytes where 6 answer the request"),
        (read(0, 2), "03 04 0000 00", "byte count 4 where 3 bytes follow"),
        (read(0, 2), "03", "1 byte where this function has at least 2"),
        (read(0, 2), "83", "1 byte where this function has 2"),
        (read(0, 2), "83 02 00", "3 bytes where this function has 2"),
        (WRITE, "06 0007 1235", "it begins 06 00 07 12 35"),
        (WRITE, "06 0008 1234", "it begins 06 00 08 12 34"),
        (WriteMultipleRegisters.of(1, [1, 2]), "10 0001 0003", "it begins 10 00 01 00 03"),
    ],
)
def test_a_reply_that_breaks_the_protocol_ends_its_request_with_the_bytes(request_: Any, pdu: str, reason: str) -> None:
    wire = ClientWire(retries=3)
    call = wire.ask(request_)
    frame = wire.send_one()
    wire.reply(frame, bytes.fromhex(pdu))
    failure = error(call)
    if request_.is_write:
        failure = failure.__cause__
    assert type(failure) is BadReply
    assert failure.reason.startswith(reason)
    assert failure.raw == encode_mbap(frame.transaction, 1, bytes.fromhex(pdu))
    assert (wire.session.counters.bad_replies, wire.session.in_flight) == (1, 0)
    assert wire.transmit() == []
    # The conversation goes on.
    after = wire.ask(read(5))
    wire.reply(wire.send_one())
    assert registers(after) == [5]


@pytest.mark.clause("T25")
def test_a_reply_of_another_protocol_is_negative_where_pending_and_dropped_where_not() -> None:
    wire = ClientWire()
    call = wire.ask(read(1))
    frame = wire.send_one()
    good = encode_mbap(frame.transaction, 1, answer_to(frame))
    wire.feed(encode_mbap(frame.transaction ^ 1, 1, answer_to(frame))[:2] + b"\x00\x07" + good[4:])
    assert not call.ended
    wire.feed(good[:2] + b"\x00\x07" + good[4:])
    assert error(call).reason == "protocol identifier 7 where 0 is Modbus"
    assert wire.session.counters.foreign_protocol == 2


@pytest.mark.clause("T25")
def test_a_reply_of_an_unknown_transaction_is_dropped_and_many_in_a_row_end_the_connection() -> None:
    wire = ClientWire(recycle_after_foreign=4)
    call = wire.ask(read(1))
    frame = wire.send_one()
    for shift in range(1, 4):
        wire.reply(frame, shift=shift)
        assert not call.ended
    assert (wire.session.counters.foreign_replies, wire.session.recycle) == (3, "")
    wire.reply(frame)
    assert registers(call) == [1]
    for shift in range(1, 5):
        wire.reply(frame, shift=shift)
    assert "answer nothing asked here" in wire.session.recycle
    wire.ask(read(2))
    assert wire.transmit() == []


@pytest.mark.clause("T25")
@pytest.mark.parametrize("asked", [0, 255])
@pytest.mark.parametrize("answered", [0, 1, 17, 255])
def test_asked_with_255_or_0_the_unit_of_the_reply_makes_no_difference(asked: int, answered: int) -> None:
    wire = ClientWire()
    call = wire.ask(read(3), unit=asked)
    wire.reply(wire.send_one(), unit=answered)
    assert registers(call) == [3]


@pytest.mark.clause("T25")
@pytest.mark.parametrize("answered", [0, 2, 255])
def test_asked_with_another_unit_it_must_be_the_same(answered: int) -> None:
    wire = ClientWire()
    call = wire.ask(read(3), unit=1)
    wire.reply(wire.send_one(), unit=answered)
    assert error(call).reason == f"unit {answered} answered where 1 was asked"


@pytest.mark.clause("T25")
@pytest.mark.parametrize("policy", [MismatchPolicy.AUTOMATIC, MismatchPolicy.IGNORE])
def test_another_unit_may_be_tolerated(policy: MismatchPolicy) -> None:
    wire = ClientWire(unit_policy=policy)
    call = wire.ask(read(3), unit=1)
    wire.reply(wire.send_one(), unit=255)
    assert registers(call) == [3]


@pytest.mark.clause("T25")
def test_another_unit_is_tolerated_automatically_only_while_nothing_else_is_in_flight() -> None:
    wire = ClientWire(unit_policy=MismatchPolicy.AUTOMATIC, max_transactions=2)
    first, second = wire.ask(read(3)), wire.ask(read(4), caller="b")
    one, two = wire.transmit()
    wire.reply(one, unit=255)
    assert error(first).reason == "unit 255 answered where 1 was asked"
    wire.reply(two, unit=255)
    assert registers(second) == [4]


@pytest.mark.clause("T25")
@pytest.mark.parametrize("policy", [MismatchPolicy.AUTOMATIC, MismatchPolicy.IGNORE])
def test_another_transaction_may_be_tolerated_while_one_request_is_in_flight(policy: MismatchPolicy) -> None:
    wire = ClientWire(transaction_policy=policy)
    for address in range(3):
        call = wire.ask(read(address))
        wire.reply(wire.send_one(), shift=1)
        assert registers(call) == [address]
    assert wire.session.counters.tolerated_replies == 3


@pytest.mark.clause("T25")
def test_another_transaction_is_not_tolerated_while_two_requests_are_in_flight() -> None:
    wire = ClientWire(transaction_policy=MismatchPolicy.AUTOMATIC, max_transactions=2)
    first, second = wire.ask(read(3)), wire.ask(read(4), caller="b")
    one, two = wire.transmit()
    wire.reply(one, shift=7)
    assert not first.ended
    assert not second.ended
    wire.reply(two)
    wire.reply(one, shift=7)
    assert (registers(first), registers(second)) == ([3], [4])


@pytest.mark.clause("T25")
def test_automatic_takes_only_what_fits_and_ignore_says_what_does_not() -> None:
    wire = ClientWire(transaction_policy=MismatchPolicy.AUTOMATIC)
    call = wire.ask(read(3, 2))
    frame = wire.send_one()
    wire.reply(frame, b"\x03\x02\x00\x00", shift=1)
    wire.reply(frame, b"\x04\x04\x00\x00\x00\x00", shift=1)
    wire.reply(frame, shift=1, unit=9)
    assert not call.ended
    assert wire.session.counters.foreign_replies == 3
    wire.reply(frame, b"\x83\x02", shift=1)
    assert error(call).code == 2
    wire = ClientWire(transaction_policy=MismatchPolicy.IGNORE)
    call = wire.ask(read(3, 2))
    wire.reply(wire.send_one(), b"\x03\x02\x00\x00", shift=1)
    assert type(error(call)) is BadReply


@pytest.mark.parametrize("policy", [MismatchPolicy.AUTOMATIC, MismatchPolicy.IGNORE])
def test_where_transactions_cannot_be_told_apart_a_timeout_ends_the_connection(policy: MismatchPolicy) -> None:
    wire = ClientWire(transaction_policy=policy)
    call = wire.ask(read(3), retries=1)
    late = wire.send_one()
    wire.wait(1.0)
    assert "cannot be told apart" in wire.session.recycle
    assert wire.transmit() == []
    wire.reconnect()
    frame = wire.send_one()
    assert frame.pdu == late.pdu
    wire.reply(frame, shift=1)
    assert registers(call) == [3]


def test_a_late_reply_that_comes_before_the_connection_is_closed_is_not_given_to_another() -> None:
    wire = ClientWire(transaction_policy=MismatchPolicy.AUTOMATIC, max_transactions=2)
    slow, other = wire.ask(read(3), timeout=0.5, retries=0), wire.ask(read(4), timeout=5.0, caller="b")
    late, _ = wire.transmit()
    wire.wait(0.5)
    assert slow.ended
    assert wire.session.recycle
    wire.reply(late, shift=1)  # it would fit the other in unit, function and length
    assert not other.ended


# The stream.


def test_a_length_that_cannot_be_ends_what_is_in_flight_and_the_connection() -> None:
    for length in (0, 1, 255, 0xFFFF):
        wire = ClientWire(max_transactions=2)
        call, write = wire.ask(read(1)), wire.ask(WRITE, caller="b")
        waiting = wire.ask(read(2), caller="c")
        one, _ = wire.transmit()
        wire.feed(one.transaction.to_bytes(2, "big") + b"\x00\x00" + length.to_bytes(2, "big"))
        assert type(error(call)) is BadReply
        assert f"length field {length}" in error(call).reason
        assert type(error(write)) is WriteOutcomeUnknown
        assert f"length field {length}" in wire.session.recycle
        assert not waiting.ended
        wire.reconnect()
        wire.run(waiting)
        assert registers(waiting) == [2]


def test_a_part_of_a_reply_is_said_to_be_one_and_ends_the_connection() -> None:
    wire = ClientWire(retries=0)
    call = wire.ask(read(1, 5))
    frame = wire.send_one()
    half = encode_mbap(frame.transaction, 1, answer_to(frame))[:9]
    wire.feed(half)
    wire.wait(1.0)
    assert (error(call).kind, error(call).raw) == ("partial", half)
    assert "did not end within the timeout" in wire.session.recycle


def test_bytes_that_answer_nothing_end_the_connection_before_the_next_request() -> None:
    wire = ClientWire()
    wire.feed(b"\x00\x01\x00")
    call = wire.ask(read(1))
    assert wire.transmit() == []
    assert "3 bytes of an unfinished frame" in wire.session.recycle
    wire.reconnect()
    wire.run(call)
    assert registers(call) == [1]


def test_what_an_old_connection_left_behind_does_not_reach_the_new_one() -> None:
    wire = ClientWire()
    call = wire.ask(read(1))
    frame = wire.send_one()
    wire.feed(encode_mbap(frame.transaction, 1, answer_to(frame))[:5])
    wire.reconnect()
    wire.run(call)
    assert registers(call) == [1]


# Connections.


@pytest.mark.clause("T37")
def test_a_connection_that_ends_in_a_batch_repeats_reads_and_keeps_what_waits() -> None:
    wire = ClientWire(max_transactions=3)
    call = wire.ask(read(0), read(1), WRITE, read(3), read(4))
    frames = wire.transmit()
    wire.reply(frames[0])
    wire.session.disconnected(wire.now, "reset by peer")
    assert wire.session.in_flight == 0
    assert type(error(call, 2)) is WriteOutcomeUnknown
    assert wire.transmit() == []
    wire.session.connected(wire.now)
    wire.run(call)
    assert [registers(call, position) for position in (0, 1, 3, 4)] == [[0], [1], [3], [4]]
    assert sum(frame.pdu == WRITE.encode() for frame in wire.sent) == 1
    assert wire.session.counters.lost_connections == 1
    assert wire.places == 3


def test_a_read_fails_with_the_reason_once_its_retries_are_used_up_by_lost_connections() -> None:
    wire = ClientWire(retries=1)
    call = wire.ask(read(1))
    for _ in range(2):
        wire.send_one()
        wire.reconnect("reset by peer")
    assert type(error(call)) is LinkDown
    assert error(call).sent
    assert error(call).attempt == 2
    assert "reset by peer" in str(error(call))


@pytest.mark.clause("T21")
def test_without_a_connection_nothing_leaves_and_all_that_waits_fails_with_the_reason() -> None:
    wire = ClientWire(connected=False)
    calls = [wire.ask(read(1)), wire.ask(WRITE, caller="b"), wire.ask(read(2), read(3), caller="c")]
    assert wire.transmit() == []
    cause = OSError("refused")
    reason = LinkDown("connection refused")
    reason.__cause__ = cause
    wire.session.unreachable(wire.now + 2.5, reason)
    assert wire.finished() == calls
    for call in calls:
        for position in range(len(call.requests)):
            failure = error(call, position)
            assert type(failure) is LinkDown
            assert failure.__cause__ is cause
            assert not failure.sent
            assert failure.elapsed == 2.5
    assert len({id(error(call)) for call in calls}) == 3, "each call has an error of its own"


def test_a_device_that_says_nothing_any_more_gets_a_new_connection() -> None:
    wire = ClientWire(retries=0, recycle_after_timeouts=3)
    for attempt in range(3):
        assert not wire.session.recycle
        wire.ask(read(attempt))
        wire.send_one()
        wire.wait(1.0)
    assert wire.session.recycle == "3 timeouts in a row"
    assert wire.session.counters.recycled == 1


def test_a_sign_of_life_starts_the_count_of_timeouts_anew() -> None:
    wire = ClientWire(retries=0, recycle_after_timeouts=2)
    for pdu in (None, b"\x83\x02", b"\x04\x02\x00\x00"):
        wire.ask(read(1))
        wire.send_one()
        wire.wait(1.0)
        wire.ask(read(1))
        wire.reply(wire.send_one(), pdu)
    assert not wire.session.recycle


def test_a_device_whose_replies_are_always_late_gets_a_new_connection_in_the_end() -> None:
    wire = ClientWire(retries=0, recycle_after_timeouts=2)
    for _ in range(10):
        wire.ask(read(1))
        late = wire.send_one()
        wire.wait(1.0)
        if wire.session.recycle:
            break
        wire.reply(late)
    assert "only late replies" in wire.session.recycle


# Pacing.


def test_after_connecting_a_device_may_want_to_be_left_alone() -> None:
    wire = ClientWire(connect_delay=2.0)
    call = wire.ask(read(1))
    assert wire.transmit() == []
    assert wire.session.has_gap
    assert wire.session.deadline() == wire.now + 2.0
    wire.wait(2.0)
    wire.run(call)
    assert registers(call) == [1]


@pytest.mark.parametrize("pdu", [None, b"\x83\x06", b"\x04\x00"], ids=["reply", "exception", "broken reply"])
def test_from_the_end_of_a_reply_to_the_next_request_a_device_may_want_a_gap(pdu: bytes | None) -> None:
    wire = ClientWire(request_gap=0.25)
    wire.ask(read(1))
    second = wire.ask(read(2), caller="b")
    wire.reply(wire.send_one(), pdu)
    assert wire.transmit() == []
    assert wire.session.deadline() == wire.now + 0.25
    wire.wait(0.249)
    assert wire.transmit() == []
    wire.wait(0.001)
    wire.reply(wire.send_one())
    assert registers(second) == [2]


def test_a_batch_keeps_the_gap_between_its_requests() -> None:
    wire = ClientWire(request_gap=0.1)
    call = wire.ask(*[read(address) for address in range(3)])
    began = wire.now
    while not call.ended:
        for frame in wire.transmit():
            wire.reply(frame)
        wire.wait(0.05)
    assert wire.now - began == pytest.approx(0.25)


# The queue.


@pytest.mark.clause("T23")
def test_more_than_the_queue_holds_is_refused_before_anything_is_sent() -> None:
    wire = ClientWire(queue=2)
    wire.ask(read(1))
    wire.ask(read(2))
    with pytest.raises(Overloaded, match=r"2 calls wait .* nothing was sent") as caught:
        wire.ask(read(3), deadline=wire.now + 1)
    assert (caught.value.unit, caught.value.endpoint) == (1, "tcp://192.0.2.5:502")
    assert wire.session.counters.overloaded == 1
    wire.transmit()
    wire.ask(read(3))


# Cancellation.


def test_a_cancelled_request_keeps_its_place_until_its_reply_comes() -> None:
    wire = ClientWire()
    gone, after = wire.ask(read(1)), wire.ask(read(2), caller="b")
    frame = wire.send_one()
    wire.session.cancel(gone)
    assert gone.ended
    assert wire.transmit() == []
    wire.reply(frame)
    assert gone.outcomes == [None]
    assert wire.finished() == []
    wire.reply(wire.send_one())
    assert registers(after) == [2]
    assert wire.session.counters.cancelled == 1


def test_a_cancelled_request_keeps_its_place_until_its_time_is_over_and_its_late_reply_is_dropped() -> None:
    wire = ClientWire()
    gone, after = wire.ask(read(1), retries=5), wire.ask(read(2), caller="b")
    frame = wire.send_one()
    wire.session.cancel(gone)
    wire.wait(1.0)
    second = wire.send_one()
    assert second.pdu == read(2).encode()
    wire.reply(frame)
    assert not after.ended
    wire.reply(second)
    assert registers(after) == [2]
    assert wire.session.counters.timeouts == 0


def test_a_call_cancelled_in_the_queue_never_leaves() -> None:
    wire = ClientWire()
    wire.ask(read(1))
    gone = wire.ask(read(2), deadline=wire.now + 1.0)
    wire.session.cancel(gone)
    wire.session.cancel(gone)  # a second time changes nothing
    wire.reply(wire.send_one())
    assert wire.transmit() == []
    assert wire.session.deadline() is None
    assert wire.session.counters.cancelled == 1


def test_a_batch_cancelled_in_the_middle_sends_no_more() -> None:
    wire = ClientWire(max_transactions=2)
    gone = wire.ask(*[read(address) for address in range(6)])
    frames = wire.transmit()
    wire.reply(frames[0])
    wire.session.cancel(gone)
    wire.reply(frames[1])
    assert wire.transmit() == []
    assert wire.places == 2
    after = wire.ask(read(9))
    wire.run(after)
    assert registers(after) == [9]


def test_cancelling_what_has_ended_changes_nothing() -> None:
    wire = ClientWire()
    call = wire.ask(read(1), deadline=wire.now + 5)
    wire.run(call)
    wire.session.cancel(call)
    assert registers(call) == [1]
    assert wire.session.counters.cancelled == 0
    other = wire.ask(read(2), deadline=wire.now + 1)
    wire.transmit()
    assert wire.session.deadline() == wire.now + 1
    assert not other.ended


def test_a_cancelled_request_is_not_repeated_on_a_new_connection() -> None:
    wire = ClientWire()
    gone = wire.ask(read(1))
    wire.send_one()
    wire.session.cancel(gone)
    wire.reconnect()
    assert wire.transmit() == []
    assert wire.places == 1


def test_a_function_of_the_users_own_goes_both_ways() -> None:
    wire = ClientWire()
    call = wire.ask(OpaqueRequest(0x41, b"\x01"), retries=3)
    wire.reply(wire.send_one(), b"\x41\x05\x06")
    assert call.outcomes[0].data == b"\x05\x06"  # type: ignore[union-attr]
    # What is not known may change something: it is not repeated.
    lost = wire.ask(OpaqueRequest(0x41, b"\x01"), retries=3)
    wire.send_one()
    wire.wait(1.0)
    assert type(error(lost)) is WriteOutcomeUnknown
