"""RTU receiver: frames out of bursts, noise, echoes and foreign traffic; never one that is not there."""

import json
import random
from pathlib import Path

import pytest
from examples import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st
from processor_time import cpu_seconds

from busway.framing.character_times import SerialTiming
from busway.framing.crc import crc16
from busway.framing.echo import Echo
from busway.framing.frame_direction import LineRole
from busway.framing.received import Damage, Damaged, Direction, FrameOrDamage, SerialFrame, SerialReceiver
from busway.framing.rtu import DEFAULT_GAP_LIMIT, RtuReceiver, encode_rtu
from busway.pdu.fields import rest, u16
from busway.pdu.functions import STANDARD
from busway.pdu.message import ReplyMessage, Request

LINE = SerialTiming.of_line(9600)
CHARACTER, T3_5 = LINE.character, LINE.t3_5
VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "vectors.json").read_text())

READ = encode_rtu(1, bytes.fromhex("03 00 00 00 0A"))  # ten holding registers of unit 1
READ_REPLY = encode_rtu(1, bytes.fromhex("03 14") + bytes(range(20)))
WRITE = encode_rtu(1, bytes.fromhex("06 00 07 12 34"))  # its reply looks the same
WRITE_MANY = encode_rtu(1, bytes.fromhex("10 00 00 00 02 04 00 01 00 02"))
FOREIGN_READ = encode_rtu(5, bytes.fromhex("03 00 00 00 02"))
FOREIGN_REPLY = encode_rtu(5, bytes.fromhex("03 04 00 01 00 02"))
UNKNOWN = encode_rtu(5, bytes.fromhex("41 AA BB CC DD EE"))  # user-defined function without a length rule


class Line:
    """A line in the hands of a test: bytes go in at a pace, and what the receiver gives is kept."""

    def __init__(self, receiver: SerialReceiver, now: float = 100.0) -> None:
        self.receiver = receiver
        self.now = now
        self.found: list[FrameOrDamage] = []

    def bytes(self, data: bytes) -> list[FrameOrDamage]:
        """The bytes arrive without a gap behind what came before, and are read as soon as they are there."""
        self.now += len(data) * CHARACTER
        return self._kept(self.receiver.receive(data, self.now))

    def silence(self, seconds: float) -> list[FrameOrDamage]:
        """Nothing arrives; the receiver is woken at its deadlines, as a driver does it."""
        end = self.now + seconds
        given: list[FrameOrDamage] = []
        while (due := self.receiver.deadline()) is not None and due <= end:
            given += self.receiver.tick(due)
            assert self.receiver.deadline() != due, "the receiver asks for the same moment again"
        self.now = end
        return self._kept(given)

    def bursts(self, data: bytes, size: int, gap: float) -> list[FrameOrDamage]:
        given: list[FrameOrDamage] = []
        for start in range(0, len(data), size):
            if start:
                given += self.silence(gap)
            given += self.bytes(data[start : start + size])
        return given

    @property
    def frames(self) -> list[bytes]:
        return [one.raw for one in self.found if isinstance(one, SerialFrame)]

    @property
    def damage(self) -> list[Damaged]:
        return [one for one in self.found if isinstance(one, Damaged)]

    def _kept(self, given: list[FrameOrDamage]) -> list[FrameOrDamage]:
        self.found += given
        return given


def server(**options: object) -> Line:
    return Line(RtuReceiver(LineRole.SERVER, LINE, **{"units": {1, 2}, **options}))  # type: ignore[arg-type]


def master(unit: int = 1, function: int = 3, size: int = -1, **options: object) -> Line:
    receiver = RtuReceiver(LineRole.MASTER, LINE, **options)  # type: ignore[arg-type]
    receiver.expect(unit, function, size)
    return Line(receiver)


def observer() -> Line:
    return Line(RtuReceiver(LineRole.OBSERVER, LINE))


def broken(frame: bytes) -> bytes:
    """The frame with one bit of its CRC turned."""
    return frame[:-1] + bytes((frame[-1] ^ 0x10,))


# Frames as they should be.


@pytest.mark.clause("S9")
@pytest.mark.parametrize("vector", [one for one in VECTORS if one["framing"] == "rtu"], ids=lambda one: str(one["id"]))
def test_published_frames_are_encoded_and_found(vector: dict[str, str]) -> None:
    raw = bytes.fromhex(vector["hex"])
    assert encode_rtu(raw[0], raw[1:-2]) == raw
    line = observer()
    line.bytes(raw)
    line.silence(T3_5)  # for functions whose content does not tell the length
    assert line.frames == [raw]


@pytest.mark.clause("S8")
@pytest.mark.parametrize("frame", [READ, WRITE, WRITE_MANY])
def test_a_server_has_a_request_with_its_last_byte(frame: bytes) -> None:
    line = server()
    assert line.bytes(frame[:-1]) == []
    [found] = line.bytes(frame[-1:])
    assert found == SerialFrame(1, frame[1:-2], frame, Direction.REQUEST, found.began, found.ended)
    assert found.began == pytest.approx(100.0)
    assert found.ended == pytest.approx(100.0 + len(frame) * CHARACTER)
    assert line.receiver.deadline() is None


@pytest.mark.clause("S8")
@pytest.mark.parametrize(
    "reply", [READ_REPLY, encode_rtu(1, bytes.fromhex("83 02")), encode_rtu(1, bytes.fromhex("03 02 12 34"))]
)
def test_a_master_has_a_reply_with_its_last_byte(reply: bytes) -> None:
    line = master()
    assert line.bytes(reply[:-1]) == []
    [found] = line.bytes(reply[-1:])
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction, found.recovered) == (reply, Direction.REPLY, False)


@pytest.mark.parametrize("cut", range(1, len(READ_REPLY)))
def test_a_split_at_any_place_makes_no_difference(cut: int) -> None:
    line = master()
    line.bytes(READ_REPLY[:cut])
    line.bytes(READ_REPLY[cut:])
    assert line.frames == [READ_REPLY]


@pytest.mark.clause("S8")
def test_the_request_tells_the_length_of_a_reply_whose_content_does_not() -> None:
    echo_of_data = encode_rtu(1, bytes.fromhex("08 00 00 A5 37 11 22"))  # 08/00 with four bytes of data
    line = master(1, 8, size=7)
    assert len(line.bytes(echo_of_data)) == 1
    without = master(1, 8)
    assert without.bytes(echo_of_data) == []
    assert len(without.silence(T3_5)) == 1


@pytest.mark.clause("A8")
def test_a_function_of_the_user_is_framed_by_its_declaration() -> None:
    class Dose(Request):
        code = 0x41
        valve: int = u16()

        class Reply(ReplyMessage):
            data: bytes = rest(3, 3)

    line = Line(RtuReceiver(LineRole.SERVER, LINE, functions=STANDARD.with_functions(Dose), units={1}))
    assert len(line.bytes(encode_rtu(1, bytes.fromhex("41 00 07")))) == 1


# Silence.


@pytest.mark.clause("S8")
@pytest.mark.clause("S10")
def test_an_unknown_function_ends_with_the_silence_and_not_before() -> None:
    line = server(units={5})
    assert line.bytes(UNKNOWN) == []
    assert line.silence(T3_5 * 0.99) == []
    [found] = line.silence(T3_5 * 0.02)
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction) == (UNKNOWN, Direction.REQUEST)


@pytest.mark.clause("S8")
@pytest.mark.parametrize("count", [0, 2, 3, 6, 250])
def test_a_byte_count_that_contradicts_the_frame_leaves_the_chunk_between_two_silences(count: int) -> None:
    frame = encode_rtu(1, bytes.fromhex("10 00 00 00 02") + bytes((count,)) + bytes.fromhex("00 01 00 02"))
    line = server()
    line.bytes(frame)
    line.silence(T3_5)
    assert line.frames == [frame]
    assert line.damage == []


@pytest.mark.clause("S8")
@given(st.binary(min_size=1, max_size=256).filter(lambda data: crc16(data) != 0))
def test_silence_alone_never_makes_a_frame(data: bytes) -> None:
    for role in LineRole:
        line = Line(RtuReceiver(role, LINE, units={1, 2}))
        line.bytes(data)
        line.silence(1.0)
        assert all(crc16(raw) == 0 for raw in line.frames)
        assert sum(map(len, line.frames)) + sum(one.size for one in line.damage) == len(data)


@pytest.mark.clause("S8")
@settings(deadline=None)
@given(
    st.sampled_from([READ, WRITE_MANY, encode_rtu(1, b"\x10\x00\x00\x00\x78\xf0" + bytes(240))]),
    st.integers(1, 64),
    st.floats(0.0, 0.030),
)
def test_bursts_with_the_gaps_of_adapters_are_one_frame(frame: bytes, size: int, gap: float) -> None:
    line = server()
    line.bursts(frame, size, gap)
    assert line.frames == [frame]
    assert line.damage == []


@pytest.mark.clause("S8")
def test_an_unfinished_frame_is_given_up_after_the_gap_limit() -> None:
    line = server()
    line.bytes(READ[:5])
    assert line.silence(DEFAULT_GAP_LIMIT * 0.99) == []
    [found] = line.silence(DEFAULT_GAP_LIMIT * 0.02)
    assert isinstance(found, Damaged)
    assert (found.raw, found.reason, found.size) == (READ[:5], Damage.INCOMPLETE, 5)
    line.bytes(READ)
    assert line.frames == [READ]


@pytest.mark.clause("S8")
@pytest.mark.parametrize("heard", [1, 2, 3, 10, len(READ_REPLY) - 1])
def test_a_master_waits_for_the_rest_of_the_very_reply_it_asked_for(heard: int) -> None:
    line = master(size=len(READ_REPLY) - 3)
    line.bytes(READ_REPLY[:heard])
    assert line.silence(40 * DEFAULT_GAP_LIMIT) == []
    line.bytes(READ_REPLY[heard:])
    assert line.frames == [READ_REPLY]
    assert line.damage == []


@pytest.mark.clause("S8")
def test_the_response_timeout_of_a_master_is_its_own() -> None:
    line = master(size=len(READ_REPLY) - 3)
    line.bytes(READ_REPLY[:10])
    line.silence(1.0)
    [found] = line.receiver.flush(line.now)
    assert isinstance(found, Damaged)
    assert (found.raw, found.reason) == (READ_REPLY[:10], Damage.INCOMPLETE)


@pytest.mark.clause("S8")
def test_a_reply_that_begins_anew_after_a_pause_is_found_behind_its_first_beginning() -> None:
    line = master(size=len(READ_REPLY) - 3)
    line.bytes(READ_REPLY[:10])
    line.silence(1.0)
    line.bytes(READ_REPLY)
    line.silence(T3_5)
    assert line.frames == [READ_REPLY]
    assert [one.raw for one in line.damage] == [READ_REPLY[:10]]


@pytest.mark.parametrize(
    ("options", "head"),
    [
        ({"gap_limit": 0.02}, READ_REPLY[:10]),  # it was chosen
        ({}, b"\x02" + READ_REPLY[1:10]),  # of another unit
        ({}, b"\x01\x04" + READ_REPLY[2:10]),  # of another function
        ({}, b"\x01\x03\x16" + READ_REPLY[3:10]),  # of another size
    ],
)
def test_a_master_waits_no_longer_for_what_is_not_its_reply(options: dict[str, float], head: bytes) -> None:
    line = master(size=len(READ_REPLY) - 3, **options)
    line.bytes(head)
    line.silence(DEFAULT_GAP_LIMIT * 1.01)
    assert [one.raw for one in line.damage] == [head]


def test_fewer_bytes_than_a_frame_are_one_error() -> None:
    line = server()
    line.bytes(b"\x01\x03")
    line.silence(1.0)
    assert [one.reason for one in line.damage] == [Damage.TOO_SHORT]


@pytest.mark.parametrize("size", [257, 404])
def test_more_bytes_than_a_frame_has_are_too_long_whatever_they_end_with(size: int) -> None:
    receiver = RtuReceiver(LineRole.OBSERVER, SerialTiming.of_network())
    raw = encode_rtu(1, bytes([65]) + bytes(size - 4))
    assert receiver.receive(raw, 1.0) == []
    [found] = receiver.flush(2.0)
    assert isinstance(found, Damaged)
    assert (found.reason, found.size, found.raw) == (Damage.TOO_LONG, size, raw[:256])


def test_a_gap_limit_below_t3_5_is_refused() -> None:
    with pytest.raises(ValueError, match=r"t3\.5"):
        RtuReceiver(LineRole.SERVER, LINE, gap_limit=T3_5 / 2)


@pytest.mark.clause("S8")
@pytest.mark.clause("S10")
def test_sending_waits_for_t3_5_after_the_last_byte_of_any_station() -> None:
    line = server(started=100.0)
    assert line.receiver.clear_at() == pytest.approx(100.0 + T3_5)
    line.silence(1.0)
    line.bytes(READ)
    assert line.receiver.clear_at() == pytest.approx(line.now + T3_5)
    line.receiver.sent(READ_REPLY, line.now + 0.1)
    assert line.receiver.clear_at() == pytest.approx(line.now + 0.1 + T3_5)


# Servers on a shared line.


@pytest.mark.clause("S11")
def test_foreign_requests_and_replies_keep_a_server_in_step_however_they_are_glued() -> None:
    stream = FOREIGN_READ + FOREIGN_REPLY + READ + FOREIGN_READ + FOREIGN_REPLY + WRITE
    for size in (1, 3, 7, 64, len(stream)):
        line = server()
        line.bursts(stream, size, 0.0)
        assert line.frames == [FOREIGN_READ, FOREIGN_REPLY, READ, FOREIGN_READ, FOREIGN_REPLY, WRITE]
        directions = [one.direction for one in line.found if isinstance(one, SerialFrame)]
        assert directions == [Direction.REQUEST, Direction.REPLY, Direction.REQUEST] * 2


@pytest.mark.clause("S11")
def test_after_a_foreign_request_its_reply_comes_first_even_where_it_begins_like_a_request() -> None:
    # The first eight bytes of this reply are a request whose CRC fits, and a request to us stands in its data.
    beginning = encode_rtu(5, bytes.fromhex("03 10 00 00 01"))
    reply = encode_rtu(5, (beginning[1:] + WRITE + bytes(16))[: 2 + 0x10])
    assert WRITE in reply
    line = server()
    line.bytes(FOREIGN_READ)
    line.silence(0.005)
    line.bursts(reply, 5, 0.001)
    assert line.frames == [FOREIGN_READ, reply]


@pytest.mark.clause("S11")
def test_a_dead_foreign_unit_costs_no_step() -> None:
    asked = encode_rtu(5, bytes.fromhex("03 50 00 00 01"))  # its address looks like a byte count of 80
    line = server()
    for _ in range(3):
        line.bytes(asked)
        line.silence(0.020)
    line.bytes(READ)
    assert line.frames == [asked, asked, asked, READ]
    assert line.damage == []


@pytest.mark.clause("S11")
def test_foreign_functions_without_a_length_rule_cost_no_step() -> None:
    line = server()
    line.bytes(UNKNOWN)
    line.silence(T3_5 * 1.1)
    line.bytes(encode_rtu(5, bytes.fromhex("41 01")))
    line.silence(T3_5 * 1.1)
    assert line.bytes(READ)
    glued = server()
    glued.bytes(UNKNOWN + encode_rtu(5, bytes.fromhex("41 01")) + READ)
    glued.silence(T3_5)
    assert glued.frames == [UNKNOWN, encode_rtu(5, bytes.fromhex("41 01")), READ]


@pytest.mark.clause("S6")
@pytest.mark.parametrize("cut", range(1, 6))
def test_a_server_never_takes_what_stands_inside_a_damaged_frame(cut: int) -> None:
    inside = encode_rtu(1, b"\x10\x00\x00\x00\x08\x10" + WRITE + READ)
    for damaged in (broken(inside), b"\x00" + inside, inside[cut:] + b"\x55", b"\x07\x07" + WRITE + WRITE):
        for size in (1, 4, len(damaged)):
            line = server()
            line.bursts(damaged, size, 0.0)
            line.silence(T3_5)
            assert line.frames == []
            line.silence(1.0)
            assert line.frames == []
            assert len(line.damage) == 1
            line.bytes(READ)
            assert line.frames == [READ]


@pytest.mark.clause("S6")
def test_a_server_takes_up_again_at_a_silence_of_t3_5_after_damage() -> None:
    line = server()
    line.bytes(broken(FOREIGN_REPLY))
    line.silence(T3_5 * 1.5)
    line.bytes(READ)
    line.silence(T3_5)  # not in step: the frame has to stand between two silences
    assert line.frames == [READ]
    assert len(line.damage) == 1
    line.silence(T3_5)
    line.bytes(WRITE)
    assert line.frames == [READ, WRITE]


@pytest.mark.clause("S6")
def test_a_server_gives_up_a_chunk_that_is_longer_than_any_frame() -> None:
    line = server()
    line.bytes(bytes.fromhex("07 77") * 200 + READ)
    line.silence(T3_5)
    assert line.frames == []
    assert [(one.reason, one.size, len(one.raw)) for one in line.damage] == [(Damage.TOO_LONG, 408, 256)]
    line.bytes(READ)
    line.silence(T3_5)
    assert line.frames == [READ]


def test_a_stray_byte_ahead_of_a_request_costs_nothing_if_silence_stands_between() -> None:
    line = server()
    line.bytes(b"\x00")
    line.silence(0.010)
    line.bytes(READ)
    line.silence(T3_5)
    assert line.frames == [READ]


def test_zeros_behind_a_request_are_not_part_of_it() -> None:
    line = server()
    line.bytes(READ + b"\x00\x00")
    line.silence(1.0)
    assert line.frames == [READ]
    assert [one.raw for one in line.damage] == [b"\x00\x00"]


# Masters.


@pytest.mark.parametrize("junk", [b"\x00", b"\xff", b"\x00\x00\x00", b"\x01", b"\x01\x03", bytes.fromhex("01 03 FA")])
@pytest.mark.parametrize("size", [1, 5, 64])
def test_a_master_finds_its_reply_behind_leading_junk(junk: bytes, size: int) -> None:
    line = master(size=22)
    line.bursts(junk + READ_REPLY, size, 0.0)
    line.silence(DEFAULT_GAP_LIMIT)
    assert line.frames == [READ_REPLY]
    assert [one.raw for one in line.damage] == [junk]


def test_a_leading_zero_delays_a_reply_by_no_more_than_t3_5() -> None:
    line = master()
    line.bytes(b"\x00" + READ_REPLY)
    line.silence(T3_5)
    assert line.frames == [READ_REPLY]


def test_a_frame_found_behind_noise_is_marked_as_recovered_and_the_next_is_not() -> None:
    line = master()
    line.bytes(b"\x55" + READ_REPLY)
    line.silence(T3_5)
    line.bytes(READ_REPLY)
    assert [one.recovered for one in line.found if isinstance(one, SerialFrame)] == [True, False]


def test_a_late_reply_of_another_unit_comes_first_and_is_named() -> None:
    line = master()
    line.bytes(FOREIGN_REPLY + READ_REPLY)
    assert [one.unit for one in line.found if isinstance(one, SerialFrame)] == [5, 1]


def test_a_reply_of_the_wrong_length_whose_crc_fits_is_given_for_judgement() -> None:
    short = encode_rtu(1, bytes.fromhex("03 14 00 01"))
    line = master(size=22)
    line.bytes(short)
    [found] = line.silence(T3_5)
    assert isinstance(found, SerialFrame)
    assert (found.raw, found.direction) == (short, Direction.REPLY)


def test_a_reply_inside_a_reply_is_not_taken() -> None:
    outer = encode_rtu(1, b"\x03\x20" + encode_rtu(1, bytes.fromhex("03 02 12 34")) + bytes(25))
    for size in (1, 9, 10, 64):
        line = master()
        line.bursts(outer, size, 0.010)
        line.silence(1.0)
        assert line.frames == [outer]


def test_half_a_reply_and_then_a_whole_one() -> None:
    line = master()
    line.bytes(READ_REPLY[:11])
    line.silence(0.200)
    line.bytes(READ_REPLY)
    assert line.frames == [READ_REPLY]


def test_flush_decides_at_the_response_timeout() -> None:
    line = master()
    line.bytes(READ_REPLY[:-1])
    [found] = line.receiver.flush(line.now)
    assert isinstance(found, Damaged)
    assert found.raw == READ_REPLY[:-1]
    assert line.receiver.deadline() is None
    assert line.receiver.flush(line.now) == []


@settings(deadline=None, max_examples=examples(60))
@given(st.binary(max_size=400), st.integers(1, 64), st.floats(0, 0.02), st.sampled_from([22, -1]))
def test_the_next_good_reply_is_found_within_one_transaction(noise: bytes, size: int, gap: float, length: int) -> None:
    line = master(size=length)
    line.bursts(noise, size, gap)
    line.silence(1.0)  # the response timeout
    line.receiver.flush(line.now)
    line.receiver.expect(1, 3, length)
    line.bursts(READ_REPLY, size, gap)
    line.silence(DEFAULT_GAP_LIMIT)
    assert line.frames[-1:] == [READ_REPLY]


# Echo.


@pytest.mark.clause("S15")
@pytest.mark.parametrize("size", [1, 3, 8, 64])
def test_with_echo_on_one_copy_is_taken_out_and_only_one(size: int) -> None:
    line = master(1, 6, size=5, echo=Echo.ON)
    line.receiver.sent(WRITE, line.now + len(WRITE) * CHARACTER)
    line.bursts(WRITE + WRITE, size, 0.0)
    assert line.frames == [WRITE]
    assert line.damage == []


@pytest.mark.clause("S15")
def test_automatic_learns_from_the_first_read_that_the_line_echoes() -> None:
    line = master(echo=Echo.AUTOMATIC)
    line.receiver.sent(READ, line.now + len(READ) * CHARACTER)
    line.bytes(READ)
    line.silence(0.010)
    line.bytes(READ_REPLY)
    assert line.frames == [READ_REPLY]
    line.receiver.expect(1, 6, 5)
    line.silence(0.010)
    line.receiver.sent(WRITE, line.now + len(WRITE) * CHARACTER)
    assert line.bytes(WRITE) == []
    line.silence(0.010)
    assert len(line.bytes(WRITE)) == 1


@pytest.mark.clause("S15")
def test_automatic_holds_a_first_write_reply_until_it_cannot_be_the_echo() -> None:
    line = master(1, 6, size=5, echo=Echo.AUTOMATIC)
    line.receiver.sent(WRITE, line.now)
    line.bytes(WRITE)
    assert line.silence(0.5) == []
    [found] = line.receiver.flush(line.now)  # the response timeout: no second copy, so there is no echo
    assert isinstance(found, SerialFrame)
    line.receiver.sent(WRITE, line.now)
    assert len(line.bytes(WRITE)) == 1


# Errors that the port marks.


@pytest.mark.clause("S14")
@pytest.mark.parametrize("overrun", [False, True])
def test_a_marked_error_discards_the_frame_in_progress_and_counts_once(overrun: bool) -> None:
    line = server()
    line.bytes(READ[:4])
    line.receiver.damaged(line.now, overrun=overrun)
    line.bytes(READ[5:] + READ)
    line.silence(1.0)
    assert line.frames == []
    [damage] = line.damage
    assert damage.reason is (Damage.OVERRUN if overrun else Damage.CHARACTER)
    assert (damage.overrun, damage.size) == (overrun, 15)
    line.bytes(READ)
    assert line.frames == [READ]


@pytest.mark.clause("S14")
def test_a_marked_error_on_an_idle_line_counts_too() -> None:
    line = server()
    line.receiver.damaged(line.now)
    assert [type(one) for one in line.silence(T3_5)] == [Damaged]


def test_a_master_finds_its_reply_behind_a_marked_glitch() -> None:
    line = master()
    line.receiver.damaged(line.now)
    line.bytes(READ_REPLY)
    assert line.frames == [READ_REPLY]
    assert [one.reason for one in line.damage] == [Damage.CHARACTER]


# Observers.


def test_an_observer_pairs_requests_and_replies_that_look_alike() -> None:
    line = observer()
    for _ in range(3):
        line.bytes(WRITE)
        line.silence(0.005)
    assert [one.direction for one in line.found if isinstance(one, SerialFrame)] == [
        Direction.REQUEST,
        Direction.REPLY,
        Direction.REQUEST,
    ]
    dead = observer()
    for _ in range(3):
        dead.bytes(WRITE)
        dead.silence(1.5)  # no answer: it is asked again
    assert {one.direction for one in dead.found if isinstance(one, SerialFrame)} == {Direction.REQUEST}


def test_an_observer_finds_frames_between_noise() -> None:
    line = observer()
    line.bytes(b"\x99\x98" + FOREIGN_READ + b"\x97" + FOREIGN_REPLY + READ)
    line.silence(1.0)
    assert line.frames == [FOREIGN_READ, FOREIGN_REPLY, READ]
    assert [one.raw for one in line.damage] == [b"\x99\x98", b"\x97"]


# Any input.


@settings(deadline=None, max_examples=examples(150))
@given(
    st.sampled_from(list(LineRole)),
    st.lists(
        st.tuples(
            st.one_of(
                st.binary(max_size=40),
                st.sampled_from([READ, READ_REPLY, WRITE, FOREIGN_READ, FOREIGN_REPLY, UNKNOWN, READ[:5], b"\x00"]),
            ),
            st.sampled_from([0.0, CHARACTER, T3_5, 0.010, 0.049, 0.050, 0.2, 2.0]),
            st.sampled_from(["", "", "", "mark", "flush", "sent"]),
        ),
        max_size=25,
    ),
)
@example(LineRole.MASTER, [(b"\x01", 0.0, "")])
def test_every_byte_is_given_exactly_once_in_order(role: LineRole, steps: list[tuple[bytes, float, str]]) -> None:
    line = Line(RtuReceiver(role, LINE, units={1, 2}))
    line.receiver.expect(1, 3, -1)
    fed = b""
    for data, gap, action in steps:
        line.bytes(data)
        fed += data
        if action == "mark":
            line.found += line.receiver.damaged(line.now)
        elif action == "flush":
            line.found += line.receiver.flush(line.now)
        elif action == "sent":
            line.receiver.sent(READ, line.now)
        line.silence(gap)
    line.silence(10.0)
    assert line.receiver.deadline() is None
    if role is LineRole.MASTER:  # the begin of the awaited reply is kept until the master gives up
        line.found += line.receiver.flush(line.now)
    assert sum(len(one.raw) if isinstance(one, SerialFrame) else one.size for one in line.found) == len(fed)
    if all(len(one.raw) == one.size for one in line.damage):
        assert b"".join(one.raw for one in line.found) == fed
    for one in line.found:
        assert one.began <= one.ended + 1e-9
        if isinstance(one, SerialFrame):
            assert crc16(one.raw) == 0
            assert not (one.recovered and role is LineRole.SERVER)


@pytest.mark.clause("S11")
def test_a_long_mixed_conversation_is_followed_frame_by_frame() -> None:
    chance = random.Random(3)
    line = server()
    sent: list[bytes] = []
    for _ in range(400):
        unit = chance.choice((1, 2, 5, 6))
        count = chance.randint(1, 60)
        request = encode_rtu(unit, bytes((chance.choice((3, 4)), 0, chance.randrange(256), 0, count)))
        reply = encode_rtu(unit, bytes((request[1], 2 * count)) + chance.randbytes(2 * count))
        for frame in (request, reply) if unit > 2 and chance.random() < 0.8 else (request,):
            line.bursts(frame, chance.randint(1, 64), chance.uniform(0, 0.003))
            line.silence(chance.uniform(T3_5, 0.040))
            sent.append(frame)
        if unit > 2 and sent[-1] is request:
            line.silence(0.3)
    assert line.frames == sent


# Cost.

MEGABYTE = 1 << 20
PATTERNS = {
    "random": random.Random(1).randbytes(MEGABYTE),
    **{
        name: (bytes.fromhex(name) * MEGABYTE)[:MEGABYTE]
        for name in (
            "01 03 FA",
            "01",
            "0F",
            "01 10 00 00 00 7B F6",
            "2B 0E",
            "01 18",
            "83",
            "05 41 C1 0F 00 00 00",
            "01 2B 0E 01",
        )
    },
}


@pytest.mark.clause("S8")
@pytest.mark.parametrize("role", list(LineRole))
@pytest.mark.parametrize("name", list(PATTERNS))
@pytest.mark.real_time
def test_a_megabyte_of_anything_costs_less_than_a_second(name: str, role: LineRole) -> None:
    data = PATTERNS[name]

    def feed() -> None:
        receiver = RtuReceiver(role, LINE, units={1})
        receiver.expect(data[0], data[1] & 0x7F)
        for start in range(0, MEGABYTE, 4096):
            receiver.receive(data[start : start + 4096], start * CHARACTER)
        receiver.flush(MEGABYTE * CHARACTER)

    assert cpu_seconds(feed, 1.0) < 1.0
