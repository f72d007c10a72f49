"""Requests and replies of a capture paired, and each thing that can be wrong with them."""

from collections.abc import Iterable

import pytest
from captured import Talk, captured
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.apps.replay.exchanges import CapturedExchange, Exchanges, TroubleKind
from busway.framing.rtu import encode_rtu
from busway.observe.capture_files.frame_extraction import CapturedTraffic
from busway.observe.capture_files.packet_file import CapturedPacket
from busway.observe.dissect import Framing
from busway.pdu.read_items import ReadHoldingRegisters

READ = "0000 0006 01 03 006b 0001"
VALUE = "0000 0005 01 03 02 022b"


def exchanges(packets: Iterable[CapturedPacket], framing: Framing = Framing.MBAP) -> list[CapturedExchange]:
    traffic, pairs = CapturedTraffic(framing=framing), Exchanges(reply_window=3.0, slow=1.0)
    events = [event for packet in packets for event in traffic.take(packet)] + traffic.finish()
    return [exchange for event in events for exchange in pairs.take(event)]


def troubles(found: Iterable[CapturedExchange]) -> list[tuple[str, int]]:
    return [(trouble.kind.value, trouble.packet) for exchange in found for trouble in exchange.troubles]


def test_a_reply_is_given_with_its_request_and_the_time_between() -> None:
    talk = Talk()
    talk.asks("0001" + READ)
    talk.answers("0001" + VALUE, after=0.25)
    (found,) = exchanges(talk.captured())
    assert found.asked is not None
    assert found.answered is not None
    assert found.request == ReadHoldingRegisters(0x6B, 1)
    assert found.reply == ReadHoldingRegisters.Reply(bytes.fromhex("022b"))
    assert (found.asked.packet, found.answered.packet, found.unit) == (3, 4, 1)
    assert found.seconds == pytest.approx(0.25)
    assert not found.troubles


def test_replies_in_another_order_find_their_requests_by_their_numbers() -> None:
    talk = Talk()
    for number in (1, 2):
        talk.asks(f"000{number}" + READ)
    for number in (2, 1):
        talk.answers(f"000{number}" + VALUE)
    found = exchanges(talk.captured())
    assert [(each.asked.packet, each.answered.packet) for each in found if each.asked and each.answered] == [
        (4, 5),
        (3, 6),
    ]
    assert troubles(found) == []


@pytest.mark.parametrize(
    ("asked", "answered", "after", "kind"),
    [
        (READ, VALUE, 1.5, TroubleKind.SLOW_REPLY),
        (READ, VALUE, 3.5, TroubleKind.LATE_REPLY),
        (READ, "0000 0003 01 83 02", 0.1, TroubleKind.EXCEPTION),
        (READ, "0000 0005 02 03 02 022b", 0.1, TroubleKind.WRONG_UNIT),
        (READ, "0000 0005 01 04 02 022b", 0.1, TroubleKind.WRONG_FUNCTION),
        (READ, "0000 0007 01 03 04 022b 0000", 0.1, TroubleKind.BAD_REPLY),
        (READ, "0000 0005 01 03 04 022b", 0.1, TroubleKind.BAD_REPLY),
        ("0000 0006 01 03 006b 0000", "0000 0003 01 83 03", 0.1, TroubleKind.BAD_REQUEST),
        (READ, "0000 0201 01 03", 0.1, TroubleKind.BAD_LENGTH),
        (READ, "0009 0005 01 03 02 022b", 0.1, TroubleKind.FOREIGN_PROTOCOL),
    ],
)
def test_what_is_wrong_with_a_reply_is_told(asked: str, answered: str, after: float, kind: TroubleKind) -> None:
    talk = Talk()
    talk.asks("0001" + asked)
    talk.answers("0001" + answered, after=after)
    found = troubles(exchanges(talk.captured()))
    assert (kind.value, 3 if kind is TroubleKind.BAD_REQUEST else 4) in found


def test_a_request_without_a_reply_is_told_when_its_number_is_used_again_later() -> None:
    talk = Talk()
    talk.asks("0001" + READ)
    talk.asks("0001" + READ, after=5.0)
    talk.answers("0001" + VALUE)
    assert troubles(exchanges(talk.captured())) == [("no reply", 3)]


def test_a_request_that_waits_when_the_capture_ends_is_open_and_an_old_one_without_reply() -> None:
    talk = Talk()
    talk.asks("0001" + READ)
    talk.asks("0002" + READ, after=5.0)
    found = exchanges(talk.captured())
    assert [each.is_open for each in found] == [False, True]
    assert troubles(found) == [("no reply", 3)]


def test_a_number_in_use_and_the_same_request_again_are_told_apart() -> None:
    talk = Talk()
    talk.asks("0001" + READ)
    talk.asks("0001" + READ)
    talk.asks("0001" + READ.replace("006b", "006c"))
    for _ in range(4):
        talk.answers("0001" + VALUE)
    found = troubles(exchanges(talk.captured()))
    assert [each for each in found if each[0] != "reply that does not fit"] == [
        ("request sent again", 4),
        ("transaction number in use already", 5),
        ("reply without a request", 9),
    ]


def test_a_reply_that_the_capture_lacks_is_not_said_to_be_missing_on_the_wire() -> None:
    talk = Talk()
    talk.asks("0001" + READ)
    talk.answers("0001" + VALUE)
    talk.asks("0002" + READ, after=9.0)
    talk.answers("0002" + VALUE)
    talk.asks("0003" + READ)  # acknowledges the second reply
    packets = talk.captured()
    del packets[3]
    assert [kind for kind, _ in troubles(exchanges(packets))] == ["missing in the capture"] * 2


def line(*frames: tuple[float, bytes]) -> list[CapturedPacket]:
    return captured(frames, 147)


RTU_READ = encode_rtu(7, bytes.fromhex("03 006b 0001"))
RTU_VALUE = encode_rtu(7, bytes.fromhex("03 02 0005"))


def test_frames_of_a_line_are_paired_and_a_wrong_crc_is_told() -> None:
    broken = RTU_VALUE[:-1] + b"\0"
    packets = line(
        (1.0, RTU_READ), (1.1, RTU_VALUE), (10.0, RTU_READ), (10.1, broken), (20.0, RTU_READ), (20.1, RTU_VALUE)
    )
    found = exchanges(packets)
    assert troubles(found) == [("bad CRC or LRC", 4), ("no reply", 3), ("request sent again", 5)]
    answered = [each for each in found if each.answered is not None]
    assert [each.seconds for each in answered] == pytest.approx([0.1, 0.1])
    assert {each.unit for each in found} == {7}


def test_a_broadcast_of_a_line_waits_for_nothing() -> None:
    (found,) = exchanges(line((1.0, encode_rtu(0, bytes.fromhex("06 0001 0002")))))
    assert found.is_broadcast
    assert not found.troubles


def test_a_reply_alone_on_a_line_answers_nothing_and_a_last_request_is_open() -> None:
    found = exchanges(line((1.0, RTU_VALUE), (5.0, RTU_READ)))
    assert troubles(found) == [("reply without a request", 1)]
    assert found[-1].is_open


def test_rtu_over_tcp_is_paired_by_its_addresses() -> None:
    talk = Talk()
    talk.says(True, RTU_READ)
    talk.says(False, RTU_VALUE)
    talk.says(True, RTU_READ)
    talk.says(True, RTU_READ, after=9.0)
    talk.says(False, RTU_VALUE)
    assert troubles(exchanges(talk.captured(), Framing.RTU)) == [("no reply", 5)]


PARTS = st.lists(
    st.tuples(
        st.booleans(),
        st.binary(max_size=12)
        | st.sampled_from([bytes.fromhex("0001" + READ), bytes.fromhex("0001" + VALUE), RTU_READ, RTU_VALUE]),
        st.floats(0, 5),
    ),
    max_size=10,
)


@settings(max_examples=examples(60))
@given(PARTS, st.sampled_from([Framing.MBAP, Framing.RTU]))
def test_any_conversation_is_paired_and_every_request_is_told_once(
    parts: list[tuple[bool, bytes, float]], framing: Framing
) -> None:
    talk = Talk()
    for is_request, data, after in parts:
        talk.says(is_request, data, after)
    found = exchanges(talk.captured(), framing)
    asked = [each.asked.packet for each in found if each.asked is not None]
    answered = [each.answered.packet for each in found if each.answered is not None]
    sent = {True: 0, False: 0}
    traffic = CapturedTraffic(framing=framing)
    for packet in talk.captured():
        for event in traffic.take(packet):
            if hasattr(event, "pdu"):
                sent[event.direction.value == "request"] += 1
    if framing is Framing.MBAP:
        assert (len(asked), len(answered)) == (sent[True], sent[False])
    exchanges(captured(talk.packets, 147))
