"""Packets taken apart: each link type, and what is no TCP or UDP."""

import struct
from ipaddress import IPv6Address

import pytest
from captured import CLIENT, SERVER
from hypothesis import given
from hypothesis import strategies as st

from busway.observe.capture_files.layers import Carried, Ignored, LineBytes, TcpSegment, UdpDatagram, carried
from busway.observe.capture_headers import Node, line_pdu, tcp_packet, udp_packet

CLIENT6, SERVER6 = Node(IPv6Address("fe80::1"), 40_000), Node(IPv6Address("fe80::2"), 502)
SEGMENT = TcpSegment(CLIENT, SERVER, 1, 2, b"hello")
IPV4 = tcp_packet(CLIENT, SERVER, b"hello", 1, 2)
IPV6 = tcp_packet(CLIENT6, SERVER6, b"hello", 1, 2)
MACS = bytes(12)


@pytest.mark.parametrize(
    ("link", "data"),
    [
        (1, MACS + b"\x08\0" + IPV4),
        (1, MACS + b"\x08\0" + IPV4 + bytes(1)),  # padded
        (1, MACS + b"\x81\0\0\x07\x08\0" + IPV4),
        (1, MACS + b"\x88\xa8\0\x01\x81\0\0\x07\x08\0" + IPV4),
        (101, IPV4),
        (228, IPV4),
        (0, b"\x02\0\0\0" + IPV4),
        (0, b"\0\0\0\x02" + IPV4),
        (108, b"\0\0\0\x02" + IPV4),
        (113, bytes(14) + b"\x08\0" + IPV4),
        (113, bytes(14) + b"\x81\0\0\x07\x08\0" + IPV4),
        (276, b"\x08\0" + bytes(18) + IPV4),
    ],
)
def test_a_segment_is_found_behind_each_kind_of_link_layer(link: int, data: bytes) -> None:
    assert carried(link, data) == SEGMENT


@pytest.mark.parametrize(
    ("link", "data"),
    [
        (1, MACS + b"\x86\xdd" + IPV6),
        (229, IPV6),
        (0, b"\x1e\0\0\0" + IPV6),
        (101, IPV6[:6] + b"\0" + IPV6[7:40] + b"\x06\0" + bytes(6) + IPV6[40:]),  # hop by hop
        (101, IPV6[:6] + b"\x2c" + IPV6[7:40] + b"\x06\0" + bytes(6) + IPV6[40:]),  # a fragment that is whole
    ],
)
def test_a_segment_over_ipv6_is_found_behind_extension_headers(link: int, data: bytes) -> None:
    data = data if len(data) == len(IPV6) or link != 101 else data[:4] + struct.pack(">H", len(data) - 40) + data[6:]
    found = carried(link, data)
    assert isinstance(found, TcpSegment)
    assert (found.source, found.destination, found.payload, found.missing) == (CLIENT6, SERVER6, b"hello", 0)


def test_a_datagram_has_the_length_of_its_header() -> None:
    assert carried(101, udp_packet(CLIENT, SERVER, b"hello")) == UdpDatagram(CLIENT, SERVER, b"hello")


def test_what_was_not_captured_is_counted() -> None:
    found = carried(101, IPV4[:-2])
    assert isinstance(found, TcpSegment)
    assert (found.payload, found.missing) == (b"hel", 2)
    assert carried(101, udp_packet(CLIENT, SERVER, b"hello")[:-1]) == UdpDatagram(CLIENT, SERVER, b"hell", 1)


def test_lines_have_bytes_that_are_frames_or_pieces() -> None:
    frame = bytes.fromhex("01 03 006b 0003 7417")
    assert carried(147, frame) == LineBytes(frame, whole=True)
    assert carried(162, frame) == LineBytes(frame, whole=True)
    assert carried(250, bytes(12) + frame) == LineBytes(frame, whole=False)
    assert carried(252, line_pdu("mbrtu", CLIENT, SERVER, frame, info="x")) == LineBytes(frame, whole=True)


@pytest.mark.parametrize(
    ("link", "data", "reason"),
    [
        (1, MACS + b"\x08\x06" + bytes(28), "EtherType 0806"),
        (1, MACS + b"\0\x26" + bytes(38), "no IP"),
        (1, MACS, "a cut off link layer"),
        (101, b"", "a cut off IP header"),
        (101, b"\x45\0", "a cut off IP header"),
        (101, b"\x15" + bytes(40), "no IP"),
        (101, IPV4[:6] + b"\x20\0" + IPV4[8:], "a fragment of IP"),
        (101, IPV4[:9] + b"\x01" + IPV4[10:], "IP protocol 1"),
        (101, IPV4[:30], "a cut off header of TCP or UDP"),
        (127, b"radio", "link type 127"),
        (250, bytes(12), "an event of a serial line"),
        (252, b"\0\x0c\0\x04http\0\0\0\0", "an exported PDU of another protocol"),
        (252, b"\0\x0c", "a cut off exported PDU"),
    ],
)
def test_other_packets_have_a_reason(link: int, data: bytes, reason: str) -> None:
    assert carried(link, data) == Ignored(reason)


LINKS = [0, 1, 101, 108, 113, 147, 228, 229, 250, 252, 276, 9_999]


@given(st.sampled_from(LINKS), st.binary(max_size=120))
def test_any_bytes_are_taken_apart_or_ignored(link: int, data: bytes) -> None:
    assert isinstance(carried(link, data), Carried)


@given(st.sampled_from([IPV4, IPV6, udp_packet(CLIENT6, SERVER6, b"hello")]), st.integers(0, 700), st.integers(0, 80))
def test_any_broken_header_is_taken_apart_or_ignored(whole: bytes, bit: int, size: int) -> None:
    data = bytearray(whole)
    data[bit // 8 % len(data)] ^= 1 << bit % 8
    for each in (bytes(data), bytes(data[:size])):
        assert isinstance(carried(101, each), Carried)
