"""Which units owe replies, and what may be sent to them meanwhile."""

import pytest
from virtual_bus import Bus, MasterEnd, honest

from busway.errors import BadReply, ExceptionReply, NoReply, UnitSuspended, WriteOutcomeUnknown
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import BreakerParameters, SerialClientParameters
from busway.pdu.diagnostics import ReturnQueryData
from busway.pdu.message import Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import WriteMultipleRegisters, WriteSingleRegister
from busway.server.device import Device
from busway.session.serial_late_replies import (
    CHECK_EVERY,
    OWED_LIMIT,
    LateReplies,
    MarkerKind,
    OwedReply,
    UnitLateReplies,
)

READ = ReadHoldingRegisters(0, 2)
READ.prepare()  # a test may run alone
REPLY = bytes.fromhex("03 04 00 01 00 02")
EXCEPTION = bytes.fromhex("83 06")
NO_BREAKER = BreakerParameters(open_after=0)


def owed(request: Request, *, question: object = None, sent: float = 0.0) -> OwedReply:
    wire = request.prepare()
    return OwedReply(request, wire[0], sent, sent + 2.0, question)


def answered(request: Request) -> Request:
    request.prepare()
    return request


def registers(outcome: object) -> list[int]:
    assert isinstance(outcome, ReadHoldingRegisters.Reply), outcome
    return outcome.registers


# What is owed.


def test_reply_belongs_to_the_earliest_request_it_could_answer_and_ends_what_came_before() -> None:
    late = UnitLateReplies()
    coils, first, second = owed(ReadCoils(0, 8)), owed(READ), owed(READ)
    for one in (coils, first, second):
        late.owe(one)
    assert late.candidates(REPLY) == [first, second]
    late.came(first)
    assert late.owed == [second]


@pytest.mark.parametrize(
    ("request_", "pdu", "may_be"),
    [
        (READ, REPLY, True),
        (READ, EXCEPTION, True),
        (READ, REPLY[:-1], False),
        (READ, b"\x04" + REPLY[1:], False),
        (WriteSingleRegister(1, 2), bytes.fromhex("06 00 01 00 02"), True),
        (WriteSingleRegister(1, 2), bytes.fromhex("06 00 01 00 03"), False),
        (WriteMultipleRegisters.of(1, [2]), bytes.fromhex("10 00 01 00 01"), True),
        (ReturnQueryData(b"\x12\x34"), bytes.fromhex("08 00 00 12 34"), True),
        (ReturnQueryData(b"\x12\x34"), bytes.fromhex("08 00 00 12 35"), False),
        (ReturnQueryData(b"\x12\x34"), bytes.fromhex("88 01"), True),
    ],
)
def test_owed_reply_is_known_by_function_length_and_echo(request_: Request, pdu: bytes, may_be: bool) -> None:
    assert owed(request_).may_be(pdu) is may_be


def test_own_repetition_is_not_in_doubt_and_the_same_request_of_another_call_is() -> None:
    late, question = UnitLateReplies(), object()
    late.owe(owed(READ, question=question))
    assert not late.in_doubt(READ, question, 0)
    assert late.in_doubt(READ, question, 1)
    assert late.in_doubt(READ, object(), 0)
    for other in (ReadHoldingRegisters(0, 3), ReadInputRegisters(0, 2)):
        other.prepare()
        assert not late.in_doubt(other, object(), 0)


def test_write_is_in_doubt_by_its_function_alone_because_it_is_not_asked_again() -> None:
    late = UnitLateReplies()
    late.owe(owed(WriteSingleRegister(1, 2)))
    other = WriteSingleRegister(3, 4)
    other.prepare()
    assert late.in_doubt(other, None, 0)


def test_more_owed_replies_than_can_be_told_apart_make_a_doubt_longer_and_never_shorter() -> None:
    late = UnitLateReplies()
    for number in range(OWED_LIMIT + 1):
        late.owe(owed(ReadHoldingRegisters(0, 1 + number % 100)))
        late.owe(owed(ReturnQueryData(number.to_bytes(2, "big"))))
    assert len(late.owed) == OWED_LIMIT
    count = 0
    while late.is_older(REPLY):
        late.older_came(REPLY)
        assert late.in_doubt(READ, None, 0)
        count += 1
    assert count == (2 * (OWED_LIMIT + 1) - OWED_LIMIT) // 2
    number = bytes.fromhex("08 00 00 ff ff")  # one that no request had yet
    assert not late.is_older(number)
    assert late.candidates(number) == []


def test_attempts_of_one_read_push_no_other_owed_reply_out_of_a_full_list() -> None:
    """Otherwise each would add one to those that it counts off, and the read would never end."""
    late, call = UnitLateReplies(), object()
    for _ in range(OWED_LIMIT + 10):
        late.owe(owed(READ))
    counted = 0
    while late.in_doubt(READ, call, 0):
        counted += 1
        assert counted < 1000
        late.owe(owed(READ, question=call, sent=float(counted)))
        if late.is_older(REPLY):
            late.older_came(REPLY)
        else:
            late.came(late.candidates(REPLY)[0])
    assert counted == OWED_LIMIT + 10
    assert late.owed_count == counted
    assert len(late.pending) <= OWED_LIMIT


def test_requests_that_were_never_answered_take_a_bounded_place() -> None:
    late = UnitLateReplies()
    for number in range(10 * OWED_LIMIT):
        late.owe(owed(ReadHoldingRegisters(number, 1 + number % 100)))
    assert len(late.owed) == len(late.pending) == OWED_LIMIT
    late.owe(owed(READ, sent=100.0))
    assert len(late.pending) == 1


def test_what_two_links_were_owed_is_put_in_the_order_in_which_it_was_asked() -> None:
    ours, theirs = LateReplies(), LateReplies()
    ours.of(1).owe(owed(READ, sent=2.0))
    theirs.of(1).owe(owed(ReadCoils(0, 1), sent=1.0))
    theirs.of(7).owe(owed(READ, sent=1.0))
    ours.add(theirs)
    assert [one.sent for one in ours.of(1).owed] == [1.0, 2.0]
    assert ours.in_doubt() == [1, 7]


def test_a_unit_of_whose_late_replies_only_the_number_is_left_is_in_doubt() -> None:
    late_replies = LateReplies()
    late_replies.of(3).older[3] = 1
    late_replies.of(4)
    assert late_replies.in_doubt() == [3]


# Markers.


def test_markers_are_tried_one_after_the_other_and_what_worked_is_tried_first() -> None:
    late = UnitLateReplies(good=answered(ReadHoldingRegisters(10, 4)))
    late.owe(owed(ReadHoldingRegisters(10, 4)))
    kinds = []
    while (marker := late.marker(1)) is not None:
        kinds.append(marker.kind)
        late.not_marked(marker.kind)
    assert kinds == list(MarkerKind)
    late.marked(MarkerKind.OTHER_LENGTH)
    again = late.marker(2)
    assert again is not None
    assert again.request == ReadHoldingRegisters(10, 3)
    late.revived()
    first = late.marker(3)
    assert first is not None
    assert first.kind is MarkerKind.OTHER_LENGTH


def test_read_of_another_length_has_none_that_is_owed() -> None:
    late = UnitLateReplies(good=answered(ReadHoldingRegisters(10, 4)), works=MarkerKind.OTHER_LENGTH)
    for count in (4, 3, 2):
        late.owe(owed(ReadHoldingRegisters(0, count)))
    marker = late.marker(1)
    assert marker is not None
    assert marker.request == ReadHoldingRegisters(10, 1)
    late.owe(owed(marker.request))
    following = late.marker(2)
    assert following is not None
    assert following.kind is MarkerKind.RETURN_QUERY_DATA


# The master.


class Slave:
    """A unit with one queue: it answers in order, each after the delay that is set when it begins."""

    def __init__(self, delays: list[float], *, silent_to: tuple[int, ...] = (), refuses: tuple[int, ...] = ()) -> None:
        self.delays = delays
        self.free = 0.0
        self.reads = 0
        self.device = Device(holding_registers=100, input_registers=100, coils=16)
        self.silent_to = silent_to
        self.refuses = refuses
        self._answer = honest({1: self.device})

    def __call__(self, unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        if unit != 1 or pdu[0] in self.silent_to:
            return []
        delay = self.delays.pop(0) if self.delays else 0.02
        self.free = max(self.free, now) + (0.01 if delay < 0 else delay)
        if pdu[0] == 3:
            self.reads += 1
            self.device.holding_registers[int.from_bytes(pdu[1:3], "big")] = self.reads
        reply = bytes((pdu[0] | 0x80, 1)) if pdu[0] in self.refuses else self._answer(unit, pdu)
        if delay < 0 or reply is None:  # lost
            return []
        return [(self.free - now, encode_rtu(unit, reply))]


def polled(slave: Slave, count: int, *, breaker: BreakerParameters | None = None, retries: int = 1) -> MasterEnd:
    """Poll the same registers over and over: each value that comes must be the newest."""
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=retries), breaker=breaker)
    bus.device(slave)
    for _ in range(count):
        before = slave.reads
        outcome = master.get(1, READ)
        if not isinstance(outcome, NoReply):
            assert registers(outcome)[0] > before
    return master


@pytest.mark.parametrize("warm", [0, 5])
def test_hiccup_after_which_both_attempts_are_answered_does_not_shift_the_replies(warm: int) -> None:
    slave = Slave([0.02] * warm + [1.2])
    master = polled(slave, warm + 50)
    assert master.session.counters.replies == warm + 50
    assert master.session.counters.late_replies == 1
    assert master.session.late_replies.of(1).owed == []


def test_attempt_that_was_lost_costs_one_marker() -> None:
    slave = Slave([0.02, -1.0])
    master = polled(slave, 50)
    assert master.session.counters.replies == 50
    assert master.session.counters.markers == 1


def test_unit_that_refuses_the_marker_is_clear_after_its_exception() -> None:
    slave = Slave([0.02, -1.0], refuses=(8,))
    master = polled(slave, 20)
    assert master.session.counters.replies == 20
    assert master.session.counters.markers == 1


def test_unit_that_is_silent_to_unknown_functions_is_clear_after_a_part_of_its_read() -> None:
    slave = Slave([0.02, -1.0, 0.02, 0.02, -1.0], silent_to=(7, 8, 11))
    master = polled(slave, 20)
    assert master.session.counters.replies >= 18
    assert master.session.late_replies.of(1).works is MarkerKind.OTHER_LENGTH


def test_unit_that_answers_nothing_but_one_read_of_one_register_is_read_by_counting() -> None:
    slave = Slave([0.02, -1.0], silent_to=(7, 8, 11))
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=2), breaker=NO_BREAKER)
    bus.device(slave)
    good = 0
    for _ in range(30):
        before = slave.reads
        outcome = master.get(1, ReadHoldingRegisters(0, 1))
        if isinstance(outcome, ReadHoldingRegisters.Reply):
            good += 1
            assert outcome.registers[0] > before
    assert good >= 25


def test_write_to_a_unit_in_doubt_that_is_silent_to_every_marker_is_not_sent() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=1), breaker=NO_BREAKER)
    device = bus.device(lambda unit, pdu, now: [])
    assert isinstance(master.get(1, WriteSingleRegister(0, 100)), WriteOutcomeUnknown)
    outcome = master.get(1, WriteSingleRegister(0, 200))
    assert isinstance(outcome, NoReply)
    assert outcome.kind == "in doubt"
    assert "nothing was sent" in str(outcome)
    writes = [pdu for _, _, pdu in device.heard if pdu[0] == 6]
    assert len(writes) == 1


def test_write_is_not_confirmed_by_the_reply_to_an_earlier_one() -> None:
    slave = Slave([1.5, 5.0])
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0))
    bus.device(slave)
    assert isinstance(master.get(1, WriteMultipleRegisters.of(0, [100, 100])), WriteOutcomeUnknown)
    outcome = master.get(1, WriteMultipleRegisters.of(0, [200, 200]))
    held = [slave.device.holding_registers[address] for address in (0, 1)]
    assert held == [200, 200] or not isinstance(outcome, WriteMultipleRegisters.Reply)
    assert master.session.counters.late_replies == 1


def test_exception_under_an_owed_function_decides_nothing() -> None:
    """The late exception of the first read must not end the second one."""
    frames = [(1.3, EXCEPTION), None, (0.02, REPLY)]

    def behaviour(unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        if pdu[0] != 3:
            return []
        said = frames.pop(0) if frames else (0.02, REPLY)
        return [] if said is None else [(said[0], encode_rtu(unit, said[1]))]

    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=0), breaker=NO_BREAKER)
    bus.device(behaviour)
    assert isinstance(master.get(1, READ), NoReply)
    second = master.get(1, READ)
    assert not isinstance(second, ExceptionReply)


def test_reply_that_may_answer_another_call_between_two_attempts_ends_no_call() -> None:
    """Attempts of one call on both sides of another's: the reply may be the other's, so it is refuse_all's."""
    bus = Bus()
    master = bus.master(
        parameters=ClientParameters(timeout=0.3, retries=3),
        serial=SerialClientParameters(trust_reply_order=True),
        breaker=NO_BREAKER,
    )
    bus.device(lambda unit, pdu, now: [])
    ours = master.ask(1, ReadHoldingRegisters(0, 1), caller="a")
    bus.run(until=lambda: len(master.sent) == 1)
    late = master.session.late_replies.of(1)
    late.silent.update(MarkerKind)
    bus.run(until=lambda: master.session.counters.timeouts == 1)
    late.owe(owed(ReadHoldingRegisters(50, 1), question=object(), sent=bus.now))
    bus.run(until=lambda: len(master.sent) == 2)
    bus.line.inject(encode_rtu(1, bytes.fromhex("03 02 be ef")), bus.now + 0.05)
    bus.run(0.2)
    assert not ours.done
    assert master.session.counters.late_replies == 1


def test_master_sleeps_while_a_call_that_could_be_asked_stands_behind_one_that_cannot() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=0), breaker=NO_BREAKER)
    bus.device(lambda unit, pdu, now: [])
    master.get(1, WriteSingleRegister(0, 1))
    master.ask(1, WriteSingleRegister(0, 1))
    master.ask(1, READ)
    bus.run(0.2)
    due = master.session.deadline()
    assert due is not None
    assert due > bus.now + 0.5


def test_error_of_a_call_that_was_sent_does_not_say_that_nothing_was_sent() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=2), breaker=NO_BREAKER)
    bus.device(lambda unit, pdu, now: [])
    questions = [master.ask(1, ReadHoldingRegisters(address, 1), caller=address) for address in (0, 1)]
    bus.run(until=lambda: all(question.done for question in questions))
    for address, question in enumerate(questions):
        sent = any(frame[1:4] == bytes((3, 0, address)) for _, frame in master.sent)
        assert isinstance(question.outcome, NoReply)
        assert ("nothing was sent" in str(question.outcome)) != sent
        assert (question.outcome.kind == "in doubt") != sent


def test_doubt_survives_a_reconnection() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.5, retries=0))
    bus.device(Slave([0.8]))
    question = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    master.session.disconnected(bus.now, "unplugged")
    assert question.call.ended or master.session.queued
    master.session.connected(bus.now)
    bus.run(2.0)
    assert master.session.counters.late_replies + master.session.counters.replies == 1
    assert registers(master.get(1, READ))[0] == 2


def test_other_units_wait_no_longer_because_of_a_unit_in_doubt() -> None:
    bus = Bus(3)
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=0))
    bus.device(lambda unit, pdu, now: [])
    bus.servers({2: Device(holding_registers=10)})
    assert isinstance(master.get(1, READ), NoReply)
    held = master.ask(1, READ)
    begun = bus.now
    for _ in range(10):
        master.get(2, READ)
    assert bus.now - begun < 0.6
    assert not held.done


def test_request_under_a_function_that_is_not_owed_goes_out_at_once_and_ends_the_doubt() -> None:
    slave = Slave([-1.0])
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.5, retries=0))
    bus.device(slave)
    assert isinstance(master.get(1, READ), NoReply)
    ended = bus.now
    assert isinstance(master.get(1, ReadInputRegisters(0, 2)), ReadInputRegisters.Reply)
    assert bus.now < ended + 0.2
    assert master.session.counters.markers == 0
    assert master.session.late_replies.of(1).owed == []


def test_unit_that_does_not_keep_the_order_is_never_wrong_below_twice_the_timeout() -> None:
    """The first attempt is answered after 1.9 timeouts, its repetition and the marker at once."""
    said = {0: 1.9, 1: 0.02}
    count = 0

    def behaviour(unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        nonlocal count
        if pdu[0] != 3:
            return [(0.02, encode_rtu(unit, pdu))]
        delay = said.get(count, 0.02)
        count += 1
        return [(delay, encode_rtu(unit, b"\x03\x04" + count.to_bytes(2, "big") * 2))]

    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=1))
    bus.device(behaviour)
    for _ in range(6):
        before = count
        assert registers(master.get(1, READ))[0] > before


def test_where_the_order_is_trusted_a_unit_is_back_after_one_marker() -> None:
    for trusted, back in ((True, 0.3), (False, 2.2)):
        slave = Slave([-1.0])
        bus = Bus()
        master = bus.master(
            parameters=ClientParameters(timeout=1.0, retries=1),
            serial=SerialClientParameters(trust_reply_order=trusted),
        )
        bus.device(slave)
        assert registers(master.get(1, READ))
        answered = bus.now
        assert registers(master.get(1, READ))
        assert bus.now - answered < back


def test_frame_that_began_before_the_request_had_left_is_no_reply_and_puts_the_unit_in_doubt() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.servers({1: Device(holding_registers=10)})
    registers(master.get(1, READ))
    question = master.ask(1, READ)
    bus.run(until=lambda: len(master.sent) == 2)
    begun = bus.now
    early = encode_rtu(1, REPLY)
    bus.run(0.012)  # the request has left, t3.5 has not passed
    assert bus.now > begun
    master.session.receive(early, len(early), bus.now + 9 * 11 / 9600 * 0.3)
    bus.run(until=lambda: question.done)
    assert master.session.counters.foreign_replies == 1
    assert not isinstance(question.outcome, BadReply)
    assert master.session.late_replies.of(1).unasked == 3
    assert registers(master.get(1, READ)) == [0, 0]
    assert master.session.counters.markers == 1


@pytest.mark.parametrize("accepted", [False, True])
def test_reply_before_t3_5_is_taken_where_that_was_chosen_and_the_error_says_so(accepted: bool) -> None:
    bus = Bus()
    master = bus.master(
        parameters=ClientParameters(timeout=0.3, retries=0), serial=SerialClientParameters(early_replies=accepted)
    )
    bus.device(lambda unit, pdu, now: [(0.0, encode_rtu(unit, REPLY))])
    outcome = master.get(1, READ)
    if accepted:
        assert registers(outcome) == [1, 2]
    else:
        assert isinstance(outcome, NoReply)
        assert outcome.kind == "early"
        assert "early_replies" in str(outcome)


# Answers without a request.


def test_a_shift_by_a_doubled_answer_ends_after_the_stated_number_of_replies() -> None:
    """One reply is sent twice, so late that it passes for the next one, and so do all that follow."""
    values: list[int] = []
    backlog: list[bytes] = []

    def behaviour(unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        values.append(len(values) + 1)
        reply = bytes((3, 2 * pdu[4])) + values[-1].to_bytes(2, "big") * pdu[4] if pdu[0] == 3 else pdu
        backlog.append(encode_rtu(unit, reply))
        if len(values) == 3:
            backlog.append(backlog[-1])
        shown = backlog.pop(0)
        return [(0.02, shown)]

    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.2, retries=0))
    bus.device(behaviour)
    wrong = 0
    for _ in range(3 * CHECK_EVERY):
        try:
            outcome = master.get(1, READ)
        except UnitSuspended:
            bus.run(1.0)
            continue
        if isinstance(outcome, ReadHoldingRegisters.Reply) and outcome.registers[0] != len(values):
            wrong += 1
    assert 0 < wrong <= CHECK_EVERY


def test_checks_take_less_than_a_hundredth_of_the_requests() -> None:
    slave = Slave([])
    master = polled(slave, 1000)
    assert 0 < master.session.counters.markers <= 10
    assert master.session.counters.timeouts == 0
