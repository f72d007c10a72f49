"""ASCII receiver: frames between colon and delimiter, whatever stands around them."""

import json
import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from processor_time import cpu_seconds

from busway.framing.ascii import CR, AsciiReceiver, AsciiState, encode_ascii
from busway.framing.character_times import SerialTiming
from busway.framing.echo import Echo
from busway.framing.frame_direction import LineRole
from busway.framing.received import Damage, Damaged, Direction, FrameOrDamage, SerialFrame

LINE = SerialTiming.of_line(9600, data_bits=7)
VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "vectors.json").read_text())
READ = encode_ascii(0x11, bytes.fromhex("03 00 6B 00 03"))
LONGEST = encode_ascii(1, bytes(253))


def receiver(role: LineRole = LineRole.SERVER, **options: object) -> AsciiReceiver:
    return AsciiReceiver(role, LINE, **{"units": {0x11}, **options})  # type: ignore[arg-type]


def frames(found: list[FrameOrDamage]) -> list[bytes]:
    return [one.raw for one in found if isinstance(one, SerialFrame)]


def reasons(found: list[FrameOrDamage]) -> list[Damage]:
    return [one.reason for one in found if isinstance(one, Damaged)]


@pytest.mark.clause("S12")
@pytest.mark.parametrize(
    "vector", [one for one in VECTORS if one["framing"] == "ascii"], ids=lambda one: str(one["id"])
)
def test_published_frames_are_encoded_and_found(vector: dict[str, str]) -> None:
    raw = bytes.fromhex(vector["hex"])
    [found] = receiver().receive(raw, 1.0)
    assert isinstance(found, SerialFrame)
    assert found.raw == raw
    assert encode_ascii(found.unit, found.pdu) == raw


@pytest.mark.clause("S12")
@pytest.mark.clause("S13")
def test_a_request_in_characters() -> None:
    assert READ == b":1103006B00037E\r\n"
    [found] = receiver().receive(READ, 1.0)
    assert found == SerialFrame(
        0x11, bytes.fromhex("03 00 6B 00 03"), READ, Direction.REQUEST, pytest.approx(1.0 - 17 * 10 / 9600), 1.0
    )


@pytest.mark.parametrize("cut", range(1, len(READ)))
def test_a_split_at_any_place_makes_no_difference(cut: int) -> None:
    line = receiver()
    assert line.receive(READ[:cut], 1.0) == []
    assert frames(line.receive(READ[cut:], 1.1)) == [READ]


@pytest.mark.clause("S12")
def test_up_to_the_timeout_may_pass_between_characters_and_no_more() -> None:
    patient = receiver()
    now = 1.0
    found: list[FrameOrDamage] = []
    for character in READ:
        found += patient.receive(bytes((character,)), now)
        now += 1.0
    assert frames(found) == [READ]

    late = receiver()
    late.receive(READ[:5], 1.0)
    due = late.deadline()
    assert due == pytest.approx(2.0, abs=1e-5)
    assert reasons(late.tick(due)) == [Damage.GAP]
    assert late.deadline() is None
    assert late.receive(READ[5:], 2.5) == []
    assert frames(late.receive(READ, 2.6)) == [READ]


@pytest.mark.clause("S12")
def test_a_late_character_ends_the_frame_without_a_tick_too() -> None:
    line = receiver(character_timeout=0.2)
    line.receive(READ[:5], 1.0)
    assert reasons(line.receive(READ[5:], 1.5)) == [Damage.GAP]


@pytest.mark.clause("S12")
@pytest.mark.parametrize("cut", range(2, len(READ)))
def test_a_colon_discards_the_frame_in_progress_also_behind_cr(cut: int) -> None:
    found = receiver().receive(READ[:cut] + READ, 1.0)
    assert frames(found) == [READ]
    assert reasons(found) == [Damage.RESTARTED]


def test_colons_alone_are_no_errors() -> None:
    found = receiver().receive(b":::" + READ, 1.0)
    assert (frames(found), reasons(found)) == ([READ], [])


def test_junk_between_frames_is_skipped() -> None:
    found = receiver().receive(b"\r\n12\xff" + READ + b"garbage\r\n" + READ, 1.0)
    assert (frames(found), reasons(found)) == ([READ, READ], [])


@pytest.mark.clause("S12")
def test_a_frame_has_513_characters_at_most() -> None:
    assert len(LONGEST) == 513
    assert frames(receiver().receive(LONGEST, 1.0)) == [LONGEST]
    longer = encode_ascii(1, bytes(254))
    found = receiver().receive(longer + READ, 1.0)
    assert (frames(found), reasons(found)) == ([READ], [Damage.TOO_LONG])


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b":1103006B00037F\r\n", Damage.CHECKSUM),
        (b":1103006B0003GE\r\n", Damage.NOT_HEXADECIMAL),
        (b":1103 06B00037E\r\n", Damage.NOT_HEXADECIMAL),
        (b":1103006B00037\r\n", Damage.INCOMPLETE),
        (b":11EF\r\n", Damage.TOO_SHORT),
        (b":\r\n", Damage.TOO_SHORT),
        (b":1103006B00037E\rX", Damage.NO_DELIMITER),
    ],
)
def test_what_is_no_frame_says_why_and_the_next_is_found(text: bytes, reason: Damage) -> None:
    found = receiver().receive(text + READ, 1.0)
    assert (reasons(found), frames(found)) == ([reason], [READ])


@pytest.mark.clause("S12")
def test_the_delimiter_can_be_changed() -> None:
    line = receiver()
    line.delimiter = ord("$")
    changed = encode_ascii(0x11, bytes.fromhex("03 00 6B 00 03"), ord("$"))
    assert changed.endswith(b"\r$")
    assert frames(line.receive(changed, 1.0)) == [changed]
    assert reasons(line.receive(READ, 1.1)) == [Damage.NO_DELIMITER]


@pytest.mark.clause("S12")
def test_lower_case_is_received_unless_it_is_refused() -> None:
    lower = READ.lower()
    assert len(frames(receiver().receive(lower, 1.0))) == 1
    assert reasons(receiver(upper_case_only=True).receive(lower, 1.0)) == [Damage.NOT_HEXADECIMAL]
    assert frames(receiver(upper_case_only=True).receive(READ, 1.0)) == [READ]


@pytest.mark.clause("S12")
def test_parity_bits_in_the_eighth_place_are_stripped_if_wanted() -> None:
    with_parity = bytes(one | (0x80 if one.bit_count() % 2 else 0) for one in READ)
    assert frames(receiver().receive(with_parity, 1.0)) == []
    assert frames(receiver(strip_parity=True).receive(with_parity, 1.0)) == [READ]


@pytest.mark.clause("S14")
@pytest.mark.parametrize("overrun", [False, True])
def test_a_marked_error_discards_the_frame_in_progress(overrun: bool) -> None:
    line = receiver()
    line.receive(READ[:7], 1.0)
    [damage] = line.damaged(1.0, overrun=overrun)
    assert isinstance(damage, Damaged)
    assert (damage.raw, damage.overrun) == (READ[:7], overrun)
    assert line.state is AsciiState.IDLE
    assert frames(line.receive(READ[7:] + READ, 1.1)) == [READ]


def test_a_reply_is_told_from_a_request_by_its_length() -> None:
    line = receiver(LineRole.OBSERVER)
    reply = encode_ascii(0x11, bytes.fromhex("03 06 02 2B 00 00 00 64"))
    unknown = encode_ascii(0x11, bytes.fromhex("41 00"))
    found = line.receive(READ + reply + unknown, 1.0)
    assert [one.direction for one in found if isinstance(one, SerialFrame)] == [
        Direction.REQUEST,
        Direction.REPLY,
        Direction.UNKNOWN,
    ]


@pytest.mark.clause("S15")
def test_the_echo_is_taken_out() -> None:
    write = encode_ascii(0x11, bytes.fromhex("06 00 01 00 02"))
    line = receiver(LineRole.MASTER, echo=Echo.ON)
    line.expect(0x11, 6, 5)
    line.sent(write, 1.0)
    assert line.receive(write, 1.0) == []
    assert frames(line.receive(write, 1.1)) == [write]


def test_flush_gives_up_an_unfinished_frame() -> None:
    line = receiver()
    line.receive(READ[:-1], 1.0)
    assert reasons(line.flush(1.0)) == [Damage.INCOMPLETE]
    assert line.flush(1.0) == []
    assert line.clear_at() == 1.0


@pytest.mark.parametrize("wrong", [{"delimiter": 0x80}, {"delimiter": -1}, {"character_timeout": 0.0}])
def test_a_setting_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="not"):
        receiver(**wrong)


@given(st.integers(0, 255), st.binary(min_size=1, max_size=253), st.integers(0, 0x7F))
def test_what_is_encoded_is_received(unit: int, pdu: bytes, delimiter: int) -> None:
    raw = encode_ascii(unit, pdu, delimiter)
    [found] = receiver(delimiter=delimiter).receive(raw, 1.0)
    assert isinstance(found, SerialFrame)
    assert (found.unit, found.pdu, found.raw) == (unit, pdu, raw)


@given(
    st.lists(st.one_of(st.binary(max_size=30), st.sampled_from([READ, READ[:6], b":", b"\r", b"\n", b":11"]))),
    st.floats(0, 1.5),
)
def test_any_input_leaves_the_next_frame_to_be_found(pieces: list[bytes], gap: float) -> None:
    line = receiver()
    now = 1.0
    for piece in pieces:
        line.receive(piece, now)
        now += gap
    found = line.receive(READ, now)
    assert frames(found)[-1:] == [READ]
    assert line.state is AsciiState.IDLE


MEGABYTE = 1 << 20


@pytest.mark.parametrize(
    ("pattern", "most"),
    [
        (b"", 1.0),
        (b":", 1.0),
        (b"0", 1.0),
        (bytes((CR,)), 1.0),
        (READ, 2.0),
        (b":0", 2.0),
        (b":\r", 2.0),
        (b":0\r", 2.0),
    ],
)
@pytest.mark.real_time
def test_a_megabyte_of_noise_costs_less_than_a_second_and_of_beginnings_not_much_more(
    pattern: bytes, most: float
) -> None:
    data = (pattern * MEGABYTE)[:MEGABYTE] if pattern else random.Random(1).randbytes(MEGABYTE)

    def feed() -> None:
        line = receiver()
        for start in range(0, MEGABYTE, 65_536):
            line.receive(data[start : start + 65_536], start * LINE.character)

    assert cpu_seconds(feed, most) < most


@pytest.mark.clause("S12")
def test_frames_that_colons_cut_off_are_one_disturbance() -> None:
    found = receiver().receive(b":11" * 400 + READ, 1.0)
    assert frames(found) == [READ]
    [damage] = [one for one in found if isinstance(one, Damaged)]
    assert (damage.reason, damage.size, len(damage.raw)) == (Damage.RESTARTED, 1200, 513)
    [bad] = receiver().receive(b":11:1103006B0003FF\r\n", 1.0)
    assert isinstance(bad, Damaged)
    assert (bad.reason, bad.raw) == (Damage.CHECKSUM, b":11:1103006B0003FF")
