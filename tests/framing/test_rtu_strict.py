"""RTU by the state diagram: silence ends a frame, a gap above t1.5 spoils it, nothing is merged."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busway.framing.character_times import SerialTiming
from busway.framing.echo import Echo
from busway.framing.frame_direction import LineRole
from busway.framing.received import Damage, Damaged, Direction, FrameOrDamage, SerialFrame
from busway.framing.rtu import encode_rtu
from busway.framing.rtu_strict import LineState, StrictRtuReceiver

LINE = SerialTiming.of_line(9600)
READ = encode_rtu(1, bytes.fromhex("03 00 00 00 0A"))


class Line:
    """Characters one by one, with gaps, and what the receiver gives."""

    def __init__(self, **options: object) -> None:
        self.receiver = StrictRtuReceiver(LineRole.SERVER, LINE, **{"units": {1}, **options})  # type: ignore[arg-type]
        self.now = 10.0
        self.found: list[FrameOrDamage] = []

    def bytes(self, data: bytes, gap: float = 0.0) -> None:
        for position, byte in enumerate(data):
            self.now += LINE.character + (gap if position else 0.0)
            self.found += self.receiver.receive(bytes((byte,)), self.now)

    def silence(self, seconds: float) -> None:
        self.now += seconds
        self.found += self.receiver.tick(self.now)


@pytest.mark.clause("S10")
def test_a_frame_passes_through_the_states_and_is_given_after_t3_5() -> None:
    line = Line(started=10.0)
    assert line.receiver.state is LineState.INITIAL
    line.silence(LINE.t3_5)
    assert line.receiver.state is LineState.IDLE
    line.bytes(READ)
    assert line.receiver.state is LineState.RECEIVING
    line.silence(LINE.t1_5 * 1.01)
    assert (line.receiver.state, line.found) == (LineState.CONTROL_AND_WAITING, [])
    due = line.receiver.deadline()
    assert due == pytest.approx(line.now - LINE.t1_5 * 1.01 + LINE.t3_5)
    [found] = line.receiver.tick(due)
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction) == (READ, Direction.REQUEST)
    assert line.receiver.state is LineState.IDLE


@pytest.mark.clause("S8")
@pytest.mark.clause("S10")
def test_a_gap_above_t1_5_spoils_the_whole_frame_and_one_below_does_not() -> None:
    line = Line()
    line.bytes(READ, gap=LINE.t1_5 * 0.99)
    line.silence(LINE.t3_5)
    assert [type(one) for one in line.found] == [SerialFrame]
    line.found.clear()
    line.bytes(READ[:4])
    line.now += LINE.t1_5 * 1.5
    line.bytes(READ[4:])
    line.silence(LINE.t3_5)
    [damage] = line.found
    assert isinstance(damage, Damaged)
    assert (damage.raw, damage.reason) == (READ, Damage.GAP)


@pytest.mark.clause("S10")
def test_what_arrives_in_the_initial_state_is_not_received() -> None:
    line = Line(started=10.0)
    line.bytes(READ)
    line.silence(LINE.t3_5)
    assert line.found == []
    line.bytes(READ)
    line.silence(LINE.t3_5)
    assert len(line.found) == 1


@pytest.mark.clause("S10")
def test_frames_without_a_silence_between_them_are_deleted_whole() -> None:
    line = Line()
    line.bytes(READ + READ)
    line.silence(LINE.t3_5)
    assert [type(one) for one in line.found] == [Damaged]


@pytest.mark.clause("S10")
def test_emission_begins_from_idle_only_and_ends_t3_5_after_its_last_byte() -> None:
    line = Line()
    line.bytes(READ[:3])
    with pytest.raises(ValueError, match="idle"):
        line.receiver.sent(READ, line.now + 0.01)
    line.silence(LINE.t3_5)
    ends = line.now + 0.01
    line.receiver.sent(READ, ends)
    assert line.receiver.state is LineState.EMISSION
    assert line.receiver.clear_at() == pytest.approx(ends + LINE.t3_5)
    line.receiver.tick(ends + LINE.t3_5)
    assert line.receiver.state is LineState.IDLE


@pytest.mark.clause("S14")
def test_a_marked_error_spoils_the_frame() -> None:
    line = Line()
    line.bytes(READ[:4])
    line.receiver.damaged(line.now, overrun=True)
    line.bytes(READ[4:])
    line.silence(LINE.t3_5)
    [damage] = line.found
    assert isinstance(damage, Damaged)
    assert (damage.reason, damage.overrun, damage.size) == (Damage.OVERRUN, True, 8)


@pytest.mark.clause("S10")
def test_an_error_in_the_initial_state_spoils_no_later_frame() -> None:
    line = Line(started=10.0)
    line.receiver.damaged(line.now)
    line.silence(LINE.t3_5)
    line.bytes(READ)
    line.silence(LINE.t3_5)
    assert [type(one) for one in line.found] == [SerialFrame]


def test_an_error_while_this_station_sends_does_not_spoil_the_reply() -> None:
    receiver = StrictRtuReceiver(LineRole.MASTER, LINE)
    receiver.expect(1, 3)
    receiver.sent(READ, 1.0)
    assert receiver.damaged(0.995) == []
    reply = encode_rtu(1, bytes.fromhex("03 02 00 01"))
    assert receiver.receive(reply, 1.05) == []
    [found] = receiver.tick(1.1)
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction) == (reply, Direction.REPLY)


def test_a_frame_ends_at_the_deadline_also_where_t1_5_is_t3_5() -> None:
    receiver = StrictRtuReceiver(LineRole.SERVER, SerialTiming.of_network(), units={1})
    receiver.receive(READ, 1.0)
    due = receiver.deadline()
    assert due is not None
    [found] = receiver.tick(due)
    assert isinstance(found, SerialFrame)
    assert (found.raw, receiver.deadline()) == (READ, None)


def test_more_bytes_than_a_frame_has_are_one_error() -> None:
    line = Line()
    line.bytes(bytes(600))
    line.silence(LINE.t3_5)
    [damage] = line.found
    assert isinstance(damage, Damaged)
    assert (damage.reason, damage.size, len(damage.raw)) == (Damage.TOO_LONG, 600, 256)


def test_flush_and_echo_work_as_in_the_lenient_receiver() -> None:
    receiver = StrictRtuReceiver(LineRole.MASTER, LINE, echo=Echo.ON)
    receiver.expect(1, 3)
    receiver.sent(READ, 1.0)
    assert receiver.receive(READ, 1.0) == []
    reply = encode_rtu(1, bytes.fromhex("03 02 00 01"))
    receiver.receive(reply, 1.05)
    [found] = receiver.flush(1.05)
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction) == (reply, Direction.REPLY)
    receiver.expect_nothing()
    assert receiver.conversation.due is None


@given(st.lists(st.tuples(st.binary(max_size=300), st.floats(0, 0.01)), max_size=10))
def test_any_input_is_given_back_whole(steps: list[tuple[bytes, float]]) -> None:
    receiver = StrictRtuReceiver(LineRole.SERVER, LINE)
    now, size, found = 1.0, 0, []
    for data, gap in steps:
        now += len(data) * LINE.character + gap
        found += receiver.receive(data, now)
        size += len(data)
    found += receiver.flush(now)
    assert sum(len(one.raw) if isinstance(one, SerialFrame) else one.size for one in found) == size
    assert receiver.state is LineState.IDLE
