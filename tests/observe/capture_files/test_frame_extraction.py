"""Frames found in packets: connections, directions, missing bytes, other ports, lines."""

import io
from collections.abc import Sequence
from ipaddress import IPv4Address

import pytest
from captured import CLIENT, SERVER, Talk, captured
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from busway.framing.ascii import encode_ascii
from busway.framing.received import Direction
from busway.framing.rtu import encode_rtu
from busway.observe.capture import Capture
from busway.observe.capture_files.frame_extraction import (
    CapturedFrame,
    CapturedTraffic,
    ChannelEnd,
    ChannelEnding,
    FaultyBytes,
    TrafficEvent,
    TrafficFault,
)
from busway.observe.capture_files.packet_file import CapturedPacket, PacketFile
from busway.observe.capture_headers import Node, line_pdu, tcp_packet, udp_packet
from busway.observe.dissect import Framing

ASKED = "0001 0000 0006 01 03 006b 0003"
ANSWERED = "0001 0000 0009 01 03 06 022b 0000 0064"
REQUEST, REPLY = Direction.REQUEST, Direction.REPLY


def events(packets: Sequence[CapturedPacket], traffic: CapturedTraffic | None = None) -> list[TrafficEvent]:
    traffic = traffic or CapturedTraffic()
    return [event for packet in packets for event in traffic.take(packet)] + traffic.finish()


def told(found: Sequence[TrafficEvent]) -> list[object]:
    """Direction, packet and bytes of frames, faults by their words, endings."""
    return [
        (each.direction, each.packet, each.raw.hex())
        if isinstance(each, CapturedFrame)
        else each.text
        if isinstance(each, FaultyBytes)
        else each.ending
        for each in found
    ]


def hexed(text: str) -> str:
    return text.replace(" ", "")


def test_requests_and_replies_of_a_connection_are_found_with_their_packets() -> None:
    talk = Talk()
    talk.asks(ASKED)
    talk.answers(ANSWERED)
    found = events(talk.captured())
    assert told(found) == [(REQUEST, 3, hexed(ASKED)), (REPLY, 4, hexed(ANSWERED)), ChannelEnding.CAPTURE_ENDS]
    frame = found[0]
    assert isinstance(frame, CapturedFrame)
    assert (frame.unit, frame.transaction, frame.pdu.hex()) == (1, 1, "03006b0003")
    assert (frame.channel.client_text, frame.channel.server_text) == ("10.0.0.9", "10.0.0.5:502")


@pytest.mark.parametrize("cut", range(1, 15))
def test_a_frame_in_two_segments_is_one_frame_of_the_second(cut: int) -> None:
    talk = Talk()
    data = bytes.fromhex(ASKED + ANSWERED)
    talk.says(True, data[:cut])
    talk.says(True, data[cut:])
    frames = [each for each in events(talk.captured()) if isinstance(each, CapturedFrame)]
    assert [each.packet for each in frames] == [3 if cut >= 12 else 4, 4]
    assert b"".join(each.raw for each in frames) == data


def test_a_connection_that_begins_before_the_capture_is_taken_up_at_a_frame() -> None:
    talk = Talk(opened=False)
    talk.says(True, b"\x6b\x00\x03")
    talk.asks(ASKED)
    traffic = CapturedTraffic()
    assert told(events(talk.captured(), traffic)) == [
        "3 bytes skipped: no frame begins so",
        (REQUEST, 2, hexed(ASKED)),
        ChannelEnding.CAPTURE_ENDS,
    ]
    assert traffic.begun_inside == 1


def test_a_capture_of_busway_has_the_beginning_of_its_connections() -> None:
    stream = io.BytesIO()
    with Capture(stream) as capture:
        capture.stream(("127.0.0.1", 40001), ("127.0.0.1", 502)).sent(bytes.fromhex(ASKED))
        written = stream.getvalue()
    traffic = CapturedTraffic()
    assert told(events(list(PacketFile(io.BytesIO(written), "x.pcapng")), traffic))[0] == (REQUEST, 1, hexed(ASKED))
    assert traffic.begun_inside == 0


def test_missing_bytes_are_told_and_the_next_frame_is_found() -> None:
    talk = Talk()
    for text in (ASKED[:14], ASKED, ASKED):
        talk.asks(text)
    talk.answers(ANSWERED)  # acknowledges all
    packets = talk.captured()
    del packets[3]
    assert told(events(packets)) == [
        "the frame ends after 6 bytes",
        "12 bytes are missing in the capture",
        (REQUEST, 5, hexed(ASKED)),
        (REPLY, 6, hexed(ANSWERED)),
        ChannelEnding.CAPTURE_ENDS,
    ]


def test_a_length_that_cannot_be_breaks_the_stream_until_the_next_frame() -> None:
    talk = Talk()
    talk.asks("0001 0000 0200 01 03")
    talk.asks(ASKED)
    found = events(talk.captured())
    assert told(found)[:2] == ["length field 512, where 2…254 can be", (REQUEST, 4, hexed(ASKED))]
    assert isinstance(found[0], FaultyBytes)
    assert found[0].fault is TrafficFault.BAD_LENGTH


def test_another_protocol_is_told_and_the_stream_goes_on() -> None:
    talk = Talk()
    talk.asks("0001 0007 0006 01 03 006b 0003")
    talk.asks(ASKED)
    assert told(events(talk.captured()))[:2] == ["protocol 7, where Modbus has 0", (REQUEST, 4, hexed(ASKED))]


def test_a_new_connection_of_the_same_ends_is_another_one() -> None:
    first, second = Talk(), Talk()
    first.asks(ASKED[:9])
    second.packets[0] = (second.time, second.packets[0][1][:24] + bytes(4) + second.packets[0][1][28:])
    found = events(captured(first.packets + second.packets))
    assert told(found) == ["the frame ends after 4 bytes", ChannelEnding.CLOSED, ChannelEnding.CAPTURE_ENDS]
    assert [each.channel.number for each in found if isinstance(each, ChannelEnd)] == [1, 2]


def test_other_ports_are_counted_where_they_look_like_modbus() -> None:
    talk = Talk(server=Node(SERVER.address, 5020))
    talk.asks(ASKED)
    talk.answers(ANSWERED)
    traffic = CapturedTraffic()
    assert events(talk.captured(), traffic) == []
    assert traffic.other_ports == {5020: 2, 40_000: 2}
    assert traffic.ignored == {"TCP of other ports": 4}
    assert len(events(talk.captured(), CapturedTraffic([5020]))) == 3


def test_datagrams_are_frames_by_themselves() -> None:
    packets = [
        udp_packet(CLIENT, SERVER, bytes.fromhex(ASKED)),
        udp_packet(SERVER, CLIENT, bytes.fromhex(ANSWERED)[:9]),
    ]
    found = events(captured([(float(index), each) for index, each in enumerate(packets)]))
    assert told(found) == [(REQUEST, 1, hexed(ASKED)), "the frame ends after 9 bytes", ChannelEnding.CAPTURE_ENDS]


RTU = [encode_rtu(7, bytes.fromhex("03 006b 0001")), encode_rtu(7, bytes.fromhex("03 02 0005"))]


@pytest.mark.parametrize(
    ("link", "head"), [(147, b""), (250, bytes(12)), (252, line_pdu("mbrtu", CLIENT, SERVER, b""))]
)
def test_frames_of_a_line_have_the_direction_that_the_observer_sees(link: int, head: bytes) -> None:
    found = events(captured([(float(index), head + each) for index, each in enumerate(RTU)], link))
    assert told(found)[:2] == [(REQUEST, 1, RTU[0].hex()), (REPLY, 2, RTU[1].hex())]


def test_a_wrong_crc_is_damage_and_the_next_frame_is_found() -> None:
    broken = RTU[0][:-1] + b"\0"
    found = events(captured([(0.0, broken), (1.0, RTU[1])], 147))
    assert isinstance(found[0], FaultyBytes)
    assert found[0].fault is TrafficFault.DAMAGED
    assert found[0].raw == broken
    assert told(found)[1] == (REPLY, 2, RTU[1].hex())


def test_ascii_on_a_line_is_recognised_by_its_colon() -> None:
    frames = [encode_ascii(7, bytes.fromhex("03 006b 0001")), encode_ascii(7, bytes.fromhex("03 02 0005"))]
    found = events(captured([(float(index), each) for index, each in enumerate(frames)], 147))
    assert [each[:2] for each in told(found)[:2] if isinstance(each, tuple)] == [(REQUEST, 1), (REPLY, 2)]


def test_rtu_over_tcp_has_the_directions_of_its_addresses() -> None:
    talk = Talk()
    echo = encode_rtu(7, bytes.fromhex("06 0001 0002"))
    talk.says(True, echo[:3])
    talk.says(True, echo[3:])
    talk.says(False, echo)
    found = events(talk.captured(), CapturedTraffic(framing=Framing.RTU))
    assert told(found)[:2] == [(REQUEST, 4, echo.hex()), (REPLY, 5, echo.hex())]


def test_connections_are_limited_and_the_one_silent_longest_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.observe.capture_files.frame_extraction.MOST_CHANNELS", 3)
    packets = []
    for port in range(5):
        talk = Talk(client=Node(IPv4Address("10.0.0.9"), 40_000 + port))
        talk.asks(ASKED)
        packets += talk.packets
    endings = [each.ending for each in events(captured(packets)) if isinstance(each, ChannelEnd)]
    assert endings == [ChannelEnding.FORGOTTEN] * 2 + [ChannelEnding.CAPTURE_ENDS] * 3


PARTS = st.lists(
    st.tuples(st.booleans(), st.binary(max_size=30) | st.sampled_from([bytes.fromhex(ASKED), bytes.fromhex(ANSWERED)])),
    max_size=8,
)


@settings(max_examples=examples(60))
@given(PARTS, st.randoms(use_true_random=False), st.sampled_from(list(Framing)[:3]), st.integers(0, 100_000))
def test_any_packets_give_events_and_no_error(
    parts: list[tuple[bool, bytes]], chance: object, framing: Framing, bit: int
) -> None:
    talk = Talk(opened=bit % 2 == 0)
    for is_request, data in parts:
        talk.says(is_request, data)
    packets = [bytearray(data) for _, data in talk.packets]
    chance.shuffle(packets)  # type: ignore[attr-defined]
    for index, data in enumerate(packets):
        data[(bit + index) // 8 % len(data)] ^= 1 << bit % 8
    for link in (101, 147):
        events(captured([(0.0, bytes(each)) for each in packets], link), CapturedTraffic(framing=framing))


def test_a_packet_of_the_server_alone_is_a_reply() -> None:
    data = tcp_packet(SERVER, CLIENT, bytes.fromhex(ANSWERED), 5, 7)
    assert told(events(captured([(0.0, data)])))[0] == (REPLY, 1, hexed(ANSWERED))
