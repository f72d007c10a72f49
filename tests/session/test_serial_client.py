"""The master of a line: its states, its gaps, and how it comes back in step."""

import itertools

import pytest
from virtual_bus import Bus, honest

from busway.errors import (
    ExceptionReply,
    InvalidRequest,
    LinkDown,
    ModbusError,
    NoReply,
    Overloaded,
    WriteOutcomeUnknown,
)
from busway.framing.ascii import encode_ascii
from busway.framing.echo import Echo
from busway.framing.rtu import encode_rtu
from busway.options.client import ClientParameters
from busway.options.lines import FramingParameters, SerialClientParameters
from busway.pdu.diagnostics import ReturnQueryData
from busway.pdu.message import Message, Request
from busway.pdu.read_items import ReadCoils, ReadHoldingRegisters, ReadInputRegisters
from busway.pdu.write_items import WriteMultipleRegisters, WriteSingleCoil, WriteSingleRegister
from busway.server.device import Device
from busway.session.serial_client import MasterState

CHARACTER = 11 / 9600
T3_5 = 3.5 * CHARACTER
READ = ReadHoldingRegisters(0, 2)
REPLY = bytes.fromhex("03 04 00 01 00 02")


def registers(outcome: object) -> list[int]:
    assert isinstance(outcome, ReadHoldingRegisters.Reply), outcome
    return outcome.registers


# The state diagram.


@pytest.mark.clause("S4")
def test_master_waits_for_the_reply_and_is_idle_after_it() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10)})
    question = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    assert master.session.state is MasterState.WAITING_FOR_REPLY
    bus.run(until=lambda: question.done)
    assert master.session.state is MasterState.IDLE
    assert registers(question.outcome) == [0, 0]


@pytest.mark.clause("S1")
def test_one_transaction_at_a_time_for_all_callers() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10), 2: Device(holding_registers=10)})
    questions = [master.ask(1 + number % 2, READ, caller=number) for number in range(10)]
    bus.run(until=lambda: all(question.done for question in questions))
    talks = bus.line.transmissions()
    assert [talk.port for talk in talks] == [0, 1] * 10
    assert bus.line.collisions == 0


@pytest.mark.clause("S8")
def test_every_frame_leaves_t3_5_after_the_last_byte_of_any_station() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10), 2: Device(holding_registers=10)})
    questions = [master.ask(1 + number % 2, READ, caller=number) for number in range(6)]
    bus.run(until=lambda: all(question.done for question in questions))
    talks = bus.line.transmissions()
    assert talks[0].begin == pytest.approx(T3_5)  # the line was opened at 0: t3.5 must be heard before it is idle
    for before, after in itertools.pairwise(talks):
        assert after.begin - before.end == pytest.approx(T3_5)


@pytest.mark.clause("S4")
def test_response_timeout_counts_from_the_last_byte_sent() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.5, retries=0))
    outcome = master.get(1, READ)
    assert isinstance(outcome, NoReply)
    assert bus.now == pytest.approx(T3_5 + 8 * CHARACTER + 0.5)


def test_a_port_that_sends_later_than_by_arithmetic_puts_the_timeout_off() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.5, retries=0))
    question = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    master.session.still_sending(bus.now + 0.2)
    bus.run(until=lambda: question.done)
    assert bus.now == pytest.approx(T3_5 + 0.2 + 0.5)


@pytest.mark.clause("S4")
def test_reply_of_an_unexpected_server_keeps_the_timer_running() -> None:
    def other(unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        return [(0.1, encode_rtu(7, REPLY)), (0.3, encode_rtu(unit, REPLY))]

    bus = Bus()
    master = bus.master(parameters=ClientParameters(retries=0))
    bus.device(other)
    assert registers(master.get(1, READ)) == [1, 2]
    assert master.session.counters.foreign_replies == 1
    late = Bus()
    master = late.master(parameters=ClientParameters(timeout=0.2, retries=0))
    late.device(lambda unit, pdu, now: [(0.1, encode_rtu(7, REPLY))])
    assert isinstance(master.get(1, READ), NoReply)
    assert late.now == pytest.approx(T3_5 + 8 * CHARACTER + 0.2)


@pytest.mark.clause("S4")
def test_damaged_reply_is_asked_again() -> None:
    frames = [encode_rtu(1, REPLY)[:-1] + b"\x00", encode_rtu(1, REPLY)]
    bus = Bus()
    master = bus.master()
    bus.device(lambda unit, pdu, now: [(T3_5, frames.pop(0))])
    assert registers(master.get(1, READ)) == [1, 2]
    assert master.session.counters.damaged_frames == 1
    assert master.session.counters.retries == 1


@pytest.mark.clause("S4")
def test_damaged_reply_is_shown_where_it_is_not_asked_again() -> None:
    damaged = encode_rtu(1, REPLY)[:-1] + b"\x00"
    bus = Bus()
    master = bus.master(parameters=ClientParameters(retries=0))
    bus.device(lambda unit, pdu, now: [(T3_5, damaged)])
    outcome = master.get(1, READ)
    assert isinstance(outcome, NoReply)
    assert outcome.kind == "partial"
    assert outcome.raw == damaged


@pytest.mark.clause("S14")
def test_marked_characters_discard_the_reply_they_stand_in() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(retries=0))
    question = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    bus.run(0.02)
    master.session.receive_damaged(encode_rtu(1, REPLY), bus.now)
    bus.run(until=lambda: question.done)
    assert isinstance(question.outcome, NoReply)
    assert master.session.counters.damaged_frames == 1


@pytest.mark.clause("S4")
def test_write_that_was_not_answered_is_not_repeated() -> None:
    bus = Bus()
    master = bus.master()
    outcome = master.get(1, WriteSingleRegister(0, 1))
    assert isinstance(outcome, WriteOutcomeUnknown)
    assert len(master.sent) == 1


@pytest.mark.clause("S4")
@pytest.mark.parametrize("retries", [0, 1, 3])
def test_read_is_repeated_as_often_as_is_set(retries: int) -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.1, retries=retries))
    assert isinstance(master.get(1, READ), ModbusError)
    assert len(master.sent) == min(1 + retries, 3)  # three timeouts in a row, and the unit is given up


def test_exception_is_the_answer_and_is_not_asked_again() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=1)})
    outcome = master.get(1, READ)
    assert isinstance(outcome, ExceptionReply)
    assert outcome.code == 2
    assert len(master.sent) == 1


# Broadcast.


@pytest.mark.clause("S2")
def test_broadcast_write_is_done_after_the_turnaround_and_by_every_server() -> None:
    bus = Bus(3)
    one, other = Device(holding_registers=4), Device(holding_registers=4)
    master, _, _ = bus.master(), bus.servers({1: one}), bus.servers({2: other})
    question = master.ask(0, WriteSingleRegister(3, 77))
    bus.run(until=lambda: bool(master.sent))
    assert master.session.state is MasterState.WAITING_TURNAROUND
    bus.run(until=lambda: question.done)
    assert isinstance(question.outcome, Message)
    assert bus.now == pytest.approx(T3_5 + 8 * CHARACTER + 0.1)
    assert one.holding_registers[3] == other.holding_registers[3] == 77
    assert len(bus.line.transmissions()) == 1


@pytest.mark.clause("S5")
def test_nothing_is_sent_within_the_turnaround_and_no_answer_is_taken() -> None:
    bus = Bus()
    master = bus.master(serial=SerialClientParameters(turnaround_delay=0.15))
    bus.device(lambda unit, pdu, now: [(0.02, encode_rtu(unit or 9, pdu))] if unit == 0 else [])
    question = master.ask(0, WriteSingleRegister(0, 1))
    master.ask(9, WriteSingleRegister(0, 1), timeout=0.1)
    bus.run(until=lambda: len(master.sent) == 2)
    assert question.done
    assert master.sent[1][0] - (T3_5 + 8 * CHARACTER) == pytest.approx(0.15)
    assert master.session.counters.foreign_replies == 1


@pytest.mark.clause("S2")
@pytest.mark.clause("S3")
@pytest.mark.parametrize(("unit", "request_"), [(0, READ), (0, ReadCoils(0, 1)), (248, READ), (255, READ), (-1, READ)])
def test_read_of_the_broadcast_address_and_units_beyond_247_are_refused_and_nothing_is_sent(
    unit: int, request_: Request
) -> None:
    bus = Bus()
    master = bus.master()
    with pytest.raises(InvalidRequest, match="nothing was sent"):
        master.ask(unit, request_)
    bus.run(1.0)
    assert master.sent == []
    assert not bus.line.tap


# Gaps.


def test_connect_delay_passes_before_the_first_request() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(connect_delay=0.7))
    master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    assert bus.now == pytest.approx(0.7)


def test_request_gap_counts_from_the_end_of_the_reply() -> None:
    bus = Bus()
    master, _ = bus.master(parameters=ClientParameters(request_gap=0.04)), bus.servers({1: Device(holding_registers=4)})
    for _ in range(3):
        master.get(1, READ)
    talks = bus.line.transmissions()
    assert [talks[2].begin - talks[1].end, talks[4].begin - talks[3].end] == pytest.approx([0.04, 0.04])


def test_unit_switch_gap_is_kept_only_where_the_unit_changes() -> None:
    bus = Bus()
    master = bus.master(serial=SerialClientParameters(unit_switch_gap=0.05))
    bus.servers({1: Device(holding_registers=4), 2: Device(holding_registers=4)})
    for unit in (1, 1, 2, 2):
        master.get(unit, READ)
    talks = bus.line.transmissions()
    gaps = [talks[number].begin - talks[number - 1].end for number in (2, 4, 6)]
    assert gaps == pytest.approx([T3_5, 0.05, T3_5])


# Back in step.


@pytest.mark.clause("S4")
def test_after_a_timeout_nothing_is_sent_before_the_line_has_been_silent_for_the_quiet_window() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.1, retries=0))
    bus.line.inject(b"\x55" * 10, 0.1)
    master.get(1, READ)
    assert master.session.state is MasterState.DRAINING
    master.ask(2, READ)
    bus.run(until=lambda: len(master.sent) == 2)
    assert bus.now == pytest.approx(0.1 + 10 * CHARACTER + 0.05)


@pytest.mark.clause("S4")
def test_unit_that_timed_out_is_asked_again_when_the_quiet_window_is_over_and_others_at_once() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.1, retries=1))
    master.ask(1, READ)
    bus.run(until=lambda: master.session.counters.timeouts == 1)
    ended = bus.now
    master.ask(2, READ, retries=0)
    bus.run(until=lambda: len(master.sent) == 3)
    assert [frame[0] for _, frame in master.sent] == [1, 2, 1]
    assert master.sent[1][0] == pytest.approx(ended)
    alone = Bus()
    master = alone.master(parameters=ClientParameters(timeout=0.1, retries=1))
    master.get(1, READ)
    assert master.sent[1][0] == pytest.approx(ended + 0.05)


@pytest.mark.clause("S4")
def test_reply_within_the_quiet_window_is_late() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.1, retries=0))
    master.get(1, READ)
    begun = bus.now
    bus.line.inject(encode_rtu(1, REPLY), begun + 0.03)
    master.ask(1, ReadInputRegisters(0, 2))
    bus.run(until=lambda: len(master.sent) == 2)
    assert bus.now == pytest.approx(begun + 0.03 + 9 * CHARACTER + T3_5)  # what was late has come: no need to wait on
    assert master.session.counters.late_replies == 1
    delay = master.session.late_replies.of(1).delay
    assert delay == pytest.approx(begun + 0.03 + 9 * CHARACTER - T3_5 - 8 * CHARACTER)


def test_a_line_that_never_falls_silent_is_drained_no_longer_than_the_limit() -> None:
    bus = Bus()
    master = bus.master(
        parameters=ClientParameters(timeout=0.1, retries=0), serial=SerialClientParameters(drain_limit=0.4)
    )
    for number in range(40):
        bus.line.inject(b"\x55", 0.02 * number)
    master.get(1, READ)
    begun = bus.now
    master.ask(2, READ)
    bus.run(until=lambda: len(master.sent) == 2)
    assert bus.now == pytest.approx(begun + 0.4, abs=0.03)


LATE = [
    (2, ReadHoldingRegisters(0, 2)),  # another unit
    (1, ReadInputRegisters(0, 2)),  # another function
    (1, ReadHoldingRegisters(0, 3)),  # another length
    (1, WriteSingleRegister(0, 1)),
    (1, WriteMultipleRegisters.of(5, [1, 2])),
]


FIRST = ReadHoldingRegisters(4, 2)


@pytest.mark.clause("S4")
@pytest.mark.parametrize(("unit", "request_"), LATE)
@pytest.mark.parametrize("delay", [0.31, 0.35, 0.5, 0.62])
def test_late_reply_is_never_taken_for_the_next_one(unit: int, request_: Request, delay: float) -> None:
    """The first request is answered too late, at any time; the next one gets its own answer."""
    device = Device(holding_registers=10, input_registers=10)
    device.holding_registers[0:3] = [500, 501, 502]
    answer = honest({1: device, 2: device})

    def behaviour(asked: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        if pdu == FIRST.encode():
            return [(delay, encode_rtu(1, bytes.fromhex("03 04 11 11 22 22")))]
        reply = answer(asked, pdu)
        return [(0.02, encode_rtu(asked, reply))] if reply else []

    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.device(behaviour)
    assert isinstance(master.get(1, FIRST), NoReply)
    outcome = master.get(unit, request_, retries=3, idempotent=True)
    assert isinstance(outcome, Message), outcome
    if isinstance(outcome, ReadHoldingRegisters.Reply):
        assert outcome.registers[0] == 500


@pytest.mark.clause("S4")
@pytest.mark.parametrize("delay", [0.31, 0.4, 0.5, 0.59])
def test_late_reply_of_the_same_unit_function_and_length_is_never_taken_where_the_unit_never_answered_in_time(
    delay: float,
) -> None:
    def behaviour(asked: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        return [(delay, encode_rtu(asked, b"\x03\x04" + pdu[1:3] * 2))]

    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.device(behaviour)
    for address in range(2):
        outcome = master.get(1, ReadHoldingRegisters(address, 2))
        assert isinstance(outcome, NoReply), outcome
    assert master.session.counters.late_replies >= 1


@pytest.mark.clause("S4")
@pytest.mark.parametrize("trusted", [False, True])
def test_unit_that_missed_a_request_is_asked_again_behind_a_marker(trusted: bool) -> None:
    deaf: list[bool] = []
    answer = honest({1: Device(holding_registers=10)})

    def behaviour(asked: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        reply = None if deaf and deaf.pop() else answer(asked, pdu)
        return [(T3_5, encode_rtu(asked, reply))] if reply else []

    bus = Bus()
    master = bus.master(
        parameters=ClientParameters(timeout=0.3, retries=0), serial=SerialClientParameters(trust_reply_order=trusted)
    )
    bus.device(behaviour)
    assert registers(master.get(1, READ)) == [0, 0]
    deaf.append(True)
    assert isinstance(master.get(1, READ), NoReply)
    ended = bus.now
    assert registers(master.get(1, ReadHoldingRegisters(1, 2))) == [0, 0]
    at, marker = master.sent[-2]
    assert marker[1:4] == b"\x08\x00\x00"
    assert at == pytest.approx(ended + (0.05 if trusted else 0.3))  # twice the timeout since the request
    assert master.session.counters.markers == 1
    asked_at, _ = master.sent[-1]
    assert asked_at == pytest.approx(at + 16 * CHARACTER + 3 * T3_5, abs=1e-3)  # 08 has no length of its own


@pytest.mark.clause("S4")
def test_unit_that_may_be_late_holds_up_no_other() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.servers({2: Device(holding_registers=10)})
    master.get(1, READ)
    begun = bus.now
    slow = master.ask(1, FIRST)
    for _ in range(3):
        assert registers(master.get(2, READ)) == [0, 0]
    assert not slow.done
    assert bus.now < begun + 0.3
    bus.run(until=lambda: slow.done)


def test_error_of_a_slow_device_names_its_delay() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.device(lambda unit, pdu, now: [(0.32, encode_rtu(unit, REPLY))])
    master.get(1, READ)
    bus.run(0.5)
    outcome = master.get(1, READ)
    assert isinstance(outcome, NoReply)
    assert outcome.kind == "late"
    assert outcome.observed_delay == pytest.approx(0.32 + 9 * CHARACTER)
    assert "longer timeout" in str(outcome)


# To the letter.


@pytest.mark.clause("S10")
def test_strict_timing_works_where_each_character_is_heard_by_itself() -> None:
    bus = Bus(3, by_character=True)
    framing = FramingParameters(strict_timing=True)
    master = bus.master(framing=framing)
    bus.servers({1: Device(holding_registers=10)}, framing=framing)
    bus.servers({2: Device(holding_registers=10)}, framing=framing)
    for number in range(10):
        assert registers(master.get(1 + number % 2, READ)) == [0, 0]
    for before, after in itertools.pairwise(bus.line.transmissions()):
        assert after.begin - before.end >= T3_5 - 1e-9


@pytest.mark.clause("S10")
def test_gap_above_t1_5_spoils_a_reply_in_strict_timing_and_is_forgiven_otherwise() -> None:
    frame = encode_rtu(1, REPLY)
    for strict in (True, False):
        bus = Bus(by_character=True)
        master = bus.master(
            parameters=ClientParameters(retries=0, timeout=0.5), framing=FramingParameters(strict_timing=strict)
        )
        bus.device(lambda unit, pdu, now: [(T3_5, frame[:4]), (T3_5 + 4 * CHARACTER + 2 * CHARACTER, frame[4:])])
        assert isinstance(master.get(1, READ), NoReply) is strict


# Deadlines, cancelling, the queue, the port.


def test_call_that_ran_out_of_time_ends_then_and_its_request_stays_in_flight() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(timeout=1.0, retries=3))
    bus.device(lambda unit, pdu, now: [(0.5, encode_rtu(unit, REPLY))])
    question = master.ask(1, READ, deadline=0.2)
    bus.run(until=lambda: question.done)
    assert bus.now == pytest.approx(0.2)
    assert isinstance(question.outcome, NoReply)
    assert "deadline" in str(question.outcome)
    assert master.session.in_flight == 1
    following = master.ask(1, ReadInputRegisters(0, 1))
    bus.run(0.4)
    assert len(master.sent) == 2  # the reply came and was dropped, and the next one could go
    assert not following.done
    assert master.session.breakers.states() == {}


def test_cancelled_request_finishes_unseen_and_its_reply_goes_to_no_call() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10)})
    question = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    master.session.cancel(question.call)
    assert registers(master.get(1, ReadHoldingRegisters(1, 3))) == [0, 0, 0]
    assert question.call.outcomes == [None]
    assert master.session.counters.cancelled == 1


def test_queue_is_bounded_and_what_does_not_fit_is_refused() -> None:
    bus = Bus()
    master = bus.master(parameters=ClientParameters(queue=3))
    for _ in range(3):
        master.ask(1, READ)
    with pytest.raises(Overloaded):
        master.ask(1, READ)


@pytest.mark.clause("S4")
def test_lost_port_repeats_reads_and_leaves_the_outcome_of_writes_unknown() -> None:
    bus = Bus()
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10)})
    read = master.ask(1, READ)
    bus.run(until=lambda: bool(master.sent))
    master.session.disconnected(bus.now, "unplugged")
    bus.run(0.2)
    master.session.connected(bus.now)
    bus.run(until=lambda: read.done)
    assert registers(read.outcome) == [0, 0]
    write = master.ask(1, WriteSingleRegister(0, 1))
    bus.run(until=lambda: len(master.sent) == 3)
    master.session.disconnected(bus.now, "unplugged")
    assert isinstance(write.call.outcomes[0], WriteOutcomeUnknown)
    assert isinstance(write.call.outcomes[0].__cause__, LinkDown)


def test_unreachable_port_ends_all_that_waits() -> None:
    bus = Bus()
    master = bus.master()
    questions = [master.ask(unit, READ) for unit in (1, 2)]
    master.session.unreachable(bus.now, LinkDown("it is not there"))
    assert all(isinstance(question.call.outcomes[0], LinkDown) for question in questions)


# Echo.


@pytest.mark.clause("S15")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("mode", [Echo.ON, Echo.AUTOMATIC])
@pytest.mark.parametrize("request_", [READ, WriteSingleRegister(3, 9), ReturnQueryData(b"\x12\x34")])
def test_own_echo_is_taken_out_exactly_once(framing: str, mode: Echo, request_: Request) -> None:
    bus = Bus(framing=framing, echo=True)
    master = bus.master(echo=mode)
    bus.servers({1: Device(holding_registers=10)}, echo=mode)
    for _ in range(3):
        assert isinstance(master.get(1, request_), Message)
    assert master.session.counters.replies == 3
    assert master.session.counters.timeouts == 0


@pytest.mark.clause("S15")
@pytest.mark.parametrize("request_", [READ, WriteSingleRegister(3, 9)])
def test_echo_that_is_looked_for_and_not_there_costs_nothing(request_: Request) -> None:
    bus = Bus()
    master, _ = bus.master(echo=Echo.AUTOMATIC), bus.servers({1: Device(holding_registers=10)})
    assert isinstance(master.get(1, request_), Message)
    assert isinstance(master.get(1, request_), Message)


@pytest.mark.clause("S15")
def test_echo_that_is_not_expected_is_no_reply_to_a_read() -> None:
    bus = Bus(echo=True)
    master, _ = bus.master(), bus.servers({1: Device(holding_registers=10)})
    assert registers(master.get(1, READ)) == [0, 0]
    assert master.session.counters.foreign_replies == 1


LIKE_THEIR_REPLIES = [WriteSingleRegister(3, 9), WriteSingleCoil(0, 0xFF00), ReturnQueryData(b"\x12\x34")]


@pytest.mark.clause("S15")
@pytest.mark.parametrize("framing", ["rtu", "ascii"])
@pytest.mark.parametrize("request_", LIKE_THEIR_REPLIES)
def test_where_a_read_has_shown_the_echo_no_copy_of_a_request_passes_for_its_reply(
    framing: str, request_: Request
) -> None:
    bus = Bus(framing=framing, echo=[0])
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    master.session.characters_take_time = False  # so that its time does not show the echo
    answers = {"on": True}

    def device(unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
        if not answers["on"]:
            return []
        reply = REPLY if pdu[0] == 3 else pdu
        return [(0.05, encode_rtu(unit, reply) if framing == "rtu" else encode_ascii(unit, reply))]

    bus.device(device)
    assert registers(master.get(1, READ)) == [1, 2]
    assert isinstance(master.get(1, request_), Message)
    answers["on"] = False
    assert isinstance(master.get(1, request_), ModbusError)
    assert master.session.counters.timeouts == 1


@pytest.mark.clause("S15")
def test_three_replies_without_an_echo_before_them_show_that_the_line_echoes_no_more() -> None:
    class Ends:
        """A device that sends back what it hears until it is told to stop."""

        echoes = True

        def __call__(self, unit: int, pdu: bytes, now: float) -> list[tuple[float, bytes]]:
            reply = encode_rtu(unit, REPLY if pdu[0] == 3 else pdu)
            return [(0.01, encode_rtu(unit, pdu)), (0.1, reply)] if self.echoes else [(0.1, reply)]

    bus, device = Bus(), Ends()
    master = bus.master(parameters=ClientParameters(timeout=0.3, retries=0))
    bus.device(device)
    assert registers(master.get(1, READ)) == [1, 2]
    assert isinstance(master.get(1, WriteSingleRegister(3, 9)), Message)
    device.echoes = False
    for _ in range(3):
        assert registers(master.get(1, READ)) == [1, 2]
    assert isinstance(master.get(1, WriteSingleRegister(3, 9)), Message)
    assert master.session.counters.timeouts == 0
