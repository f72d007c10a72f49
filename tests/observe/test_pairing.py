"""Frames of a line as a conversation: made by hand, and heard on a virtual line by a receiver that observes."""

from collections.abc import Iterator

import pytest

from busway.framing.character_times import SerialTiming
from busway.framing.frame_direction import LineRole
from busway.framing.received import Damage, Damaged, Direction, SerialFrame
from busway.framing.rtu import RtuReceiver, encode_rtu
from busway.observe.pairing import SURE_REPLIES, Heard, Kind, Pairing
from busway.testing.virtual_line import VirtualLine

REQUEST, REPLY, UNKNOWN = Direction.REQUEST, Direction.REPLY, Direction.UNKNOWN
READ, VALUES = "03 006b 0001", "03 02 022b"
WRITE = "06 0001 0003"


def frame(unit: int, pdu: str, direction: Direction, began: float, ended: float | None = None) -> SerialFrame:
    data = bytes.fromhex(pdu)
    return SerialFrame(unit, data, encode_rtu(unit, data), direction, began, began + 0.01 if ended is None else ended)


def kinds(events: list[Heard]) -> list[Kind]:
    return [event.kind for event in events]


def test_a_reply_belongs_to_the_request_before_it_and_is_timed_from_its_end() -> None:
    pairing = Pairing()
    (asked,) = pairing.heard(frame(1, READ, REQUEST, 10.0, 10.01))
    (answered,) = pairing.heard(frame(1, VALUES, REPLY, 10.05, 10.06))
    assert (asked.kind, asked.gap) == (Kind.REQUEST, None)
    assert answered.kind is Kind.REPLY
    assert answered.request is asked.frame
    assert answered.response_time == answered.gap == pytest.approx(0.04)
    assert pairing.deadline() is None
    unit = pairing.statistics.units[1]
    assert (unit.requests, unit.replies, unit.exceptions, unit.unanswered) == (1, 1, 0, 0)
    assert unit.response_times.mean == unit.response_times.slowest == pytest.approx(0.04)


def test_an_exception_is_a_reply_that_is_counted_by_itself() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0))
    assert kinds(pairing.heard(frame(1, "83 02", REPLY, 0.05))) == [Kind.REPLY]
    unit = pairing.statistics.units[1]
    assert (unit.replies, unit.exceptions) == (1, 1)


def test_a_request_is_unanswered_when_its_time_is_over() -> None:
    pairing = Pairing(reply_window=0.5)
    (asked,) = pairing.heard(frame(1, READ, REQUEST, 0.0, 0.01))
    assert pairing.deadline() == pytest.approx(0.51)
    assert pairing.tick(0.5) == []
    (event,) = pairing.tick(0.6)
    assert (event.kind, event.frame) == (Kind.UNANSWERED, asked.frame)
    assert event.response_time == pytest.approx(0.5)
    assert event.at == pytest.approx(0.51)
    assert pairing.tick(2.0) == []
    assert pairing.statistics.units[1].unanswered == 1


def test_a_request_is_unanswered_when_the_next_one_is_heard() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0, 0.01))
    unanswered, asked = pairing.heard(frame(2, READ, REQUEST, 0.21))
    assert (unanswered.kind, asked.kind, asked.is_repeat) == (Kind.UNANSWERED, Kind.REQUEST, False)
    assert unanswered.response_time == pytest.approx(0.2)


def test_the_same_request_again_is_a_repeat() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0))
    _, again = pairing.heard(frame(1, READ, REQUEST, 0.5))
    assert again.is_repeat
    assert pairing.statistics.units[1].repeats == 1
    pairing.heard(frame(1, VALUES, REPLY, 0.6))
    (asked,) = pairing.heard(frame(1, READ, REQUEST, 1.0))
    assert not asked.is_repeat


def test_a_read_from_an_address_that_looks_like_a_byte_count_does_not_answer_itself() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, "03 0300 0001", REQUEST, 0.0))
    assert kinds(pairing.heard(frame(1, "03 0300 0001", REPLY, 0.05))) == [Kind.UNANSWERED, Kind.REQUEST]


def test_a_broadcast_waits_for_nothing() -> None:
    pairing = Pairing()
    assert kinds(pairing.heard(frame(0, WRITE, REQUEST, 0.0))) == [Kind.BROADCAST]
    assert pairing.deadline() is None
    assert pairing.statistics.broadcasts == 1
    assert not pairing.statistics.units


@pytest.mark.parametrize(("unit", "pdu"), [(2, VALUES), (1, "04 02 022b")])
def test_a_reply_of_another_unit_answers_nothing_and_the_request_waits_on(unit: int, pdu: str) -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0))
    assert kinds(pairing.heard(frame(unit, pdu, REPLY, 0.1))) == [Kind.STRAY]
    assert kinds(pairing.heard(frame(1, VALUES, REPLY, 0.2))) == [Kind.REPLY]
    assert pairing.statistics.units[unit].stray_replies == 1


def test_a_reply_without_a_request_is_stray() -> None:
    assert kinds(Pairing().heard(frame(1, VALUES, REPLY, 0.0))) == [Kind.STRAY]


def test_damaged_bytes_in_place_of_a_reply_are_told_with_the_silence() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0))
    chunk = Damaged(b"\x01\x03\x02", Damage.CHECKSUM, 3, 0.05, 0.06)
    (damaged,) = pairing.heard(chunk)
    assert (damaged.kind, damaged.damaged, damaged.at) == (Kind.DAMAGED, chunk, 0.05)
    (unanswered,) = pairing.tick(5.0)
    assert unanswered.damaged is chunk
    assert pairing.statistics.units[1].damaged_replies == 1
    assert pairing.statistics.damaged == {Damage.CHECKSUM: 1}


def test_a_good_reply_behind_noise_is_the_reply() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0))
    pairing.heard(Damaged(b"\xff", Damage.TOO_SHORT, 1, 0.05, 0.06))
    assert kinds(pairing.heard(frame(1, VALUES, REPLY, 0.07))) == [Kind.REPLY]
    assert pairing.statistics.units[1].damaged_replies == 0


def test_a_frame_of_unknown_direction_is_a_reply_where_its_unit_and_function_were_asked() -> None:
    pairing = Pairing()
    assert kinds(pairing.heard(frame(1, "41 01", UNKNOWN, 0.0))) == [Kind.REQUEST]
    assert kinds(pairing.heard(frame(1, "41 02 03", UNKNOWN, 0.1))) == [Kind.REPLY]
    assert kinds(pairing.heard(frame(1, "42", UNKNOWN, 0.2))) == [Kind.REQUEST]


def test_an_echoing_reply_is_a_reply_whatever_the_receiver_guesses() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, WRITE, REQUEST, 0.0))
    assert kinds(pairing.heard(frame(1, WRITE, REQUEST, 0.05))) == [Kind.REPLY]


def test_a_dead_unit_that_is_written_to_again_and_again_does_not_answer_itself() -> None:
    pairing = Pairing()
    for number in range(SURE_REPLIES):  # another unit, which shows how fast replies are here
        pairing.heard(frame(2, READ, REQUEST, number))
        pairing.heard(frame(2, VALUES, REPLY, number + 0.03))
    directions = [REQUEST, REPLY, REQUEST, REPLY]  # what a receiver makes of four equal frames
    events = [
        event
        for number, direction in enumerate(directions)
        for event in pairing.heard(frame(1, WRITE, direction, 10 + 0.5 * number))
    ]
    assert kinds(events) == [Kind.REQUEST] + 3 * [Kind.UNANSWERED, Kind.REQUEST]
    assert kinds(pairing.heard(frame(1, WRITE, REQUEST, 11.55))) == [Kind.REPLY]
    assert pairing.statistics.units[1].replies == 1


def test_a_write_may_be_slower_than_the_reads_and_still_be_answered() -> None:
    pairing = Pairing()
    for number in range(SURE_REPLIES):
        pairing.heard(frame(1, READ, REQUEST, number))
        pairing.heard(frame(1, VALUES, REPLY, number + 0.012))
    pairing.heard(frame(1, WRITE, REQUEST, 10.0))
    assert kinds(pairing.heard(frame(1, WRITE, REPLY, 10.1))) == [Kind.REPLY]


def test_the_busy_time_and_the_bytes_are_summed() -> None:
    pairing = Pairing()
    pairing.heard(frame(1, READ, REQUEST, 0.0, 0.02))
    pairing.heard(Damaged(b"\x01", Damage.TOO_SHORT, 700, 0.1, 0.5))
    assert pairing.statistics.frames == 1
    assert pairing.statistics.frame_bytes == 8
    assert pairing.statistics.damaged_bytes == 700
    assert pairing.statistics.busy == pytest.approx(0.42)


def heard_on(line: VirtualLine, until: float) -> Iterator[Heard]:
    """What an observer at port 2 of a virtual line understands, the line advanced in steps of a millisecond."""
    timing = SerialTiming.of_line(9600)
    receiver = RtuReceiver(LineRole.OBSERVER, timing)
    pairing = Pairing()
    for step in range(int(until * 1000)):
        now = step / 1000
        line.advance(now)
        data = line.ports[2].read().data
        for found in receiver.receive(data, now) if data else receiver.tick(now):
            yield from pairing.heard(found)
        yield from pairing.tick(now)


def test_what_is_heard_on_a_line() -> None:
    line = VirtualLine(ports=3, baud=9600)
    master, unit = line.ports[0], line.ports[1]
    conversation = [
        (master, "01 03 006b 0001", 0.100),
        (unit, "01 03 02 022b", 0.150),
        (master, "02 03 006b 0001", 0.300),  # no answer
        (master, "01 06 0001 0003", 1.500),
        (unit, "01 06 0001 0003", 1.550),
        (master, "00 06 0001 0003", 1.700),
        (master, "01 03 ffff 0001", 1.900),
        (unit, "01 83 02", 1.950),
    ]
    for port, content, when in conversation:
        data = bytes.fromhex(content)
        port.write(encode_rtu(data[0], data[1:]), when)
    line.inject(b"\xff\x00\xff", 2.1)
    events = list(heard_on(line, 2.4))
    assert kinds(events) == [
        Kind.REQUEST,
        Kind.REPLY,
        Kind.REQUEST,
        Kind.UNANSWERED,
        Kind.REQUEST,
        Kind.REPLY,
        Kind.BROADCAST,
        Kind.REQUEST,
        Kind.REPLY,
        Kind.DAMAGED,
    ]
    took = events[1].response_time
    assert took is not None
    # The request of 8 characters of 11 bits ends at 0.100 + 9.2 ms.
    assert took == pytest.approx(0.050 - 8 * 11 / 9600, abs=0.002)
