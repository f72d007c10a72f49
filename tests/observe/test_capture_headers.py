"""Packet headers against the layouts of the RFCs."""

import struct
from ipaddress import IPv4Address, IPv6Address

import pytest

from busway.observe.capture_headers import Node, checksum, line_pdu, tcp_packet, udp_packet

CLIENT = Node(IPv4Address("10.0.0.1"), 40_000)
SERVER = Node(IPv4Address("10.0.0.5"), 502)


def test_the_checksum_of_the_example_of_rfc_1071() -> None:
    assert checksum(bytes.fromhex("00 01 f2 03 f4 f5 f6 f7")) == ~0xDDF2 & 0xFFFF


def test_an_odd_number_of_bytes_is_summed_with_a_zero_behind_it() -> None:
    assert checksum(b"\x01\x02\x03") == checksum(b"\x01\x02\x03\x00")


def test_a_tcp_segment_over_ipv4() -> None:
    packet = tcp_packet(CLIENT, SERVER, b"\x01\x02\x03", 1, 7)
    assert packet[0] == 0x45
    assert struct.unpack(">H", packet[2:4]) == (len(packet),)
    assert packet[9] == 6
    assert packet[12:20] == bytes((10, 0, 0, 1, 10, 0, 0, 5))
    assert struct.unpack(">HHII", packet[20:32]) == (40_000, 502, 1, 7)
    assert packet[40:] == b"\x01\x02\x03"
    assert checksum(packet[:20]) == 0
    pseudo = packet[12:20] + struct.pack(">II", len(packet) - 20, 6)
    assert checksum(pseudo + packet[20:]) == 0


def test_a_datagram_over_ipv6() -> None:
    here, there = Node(IPv6Address("::1"), 5020), Node(IPv6Address("fe80::2"), 502)
    packet = udp_packet(here, there, b"\x01\x02")
    assert packet[0] >> 4 == 6
    assert struct.unpack(">HB", packet[4:7]) == (10, 17)
    assert packet[8:40] == here.address.packed + there.address.packed
    assert struct.unpack(">HHH", packet[40:46]) == (5020, 502, 10)
    assert checksum(packet[8:40] + struct.pack(">II", 10, 17) + packet[40:]) == 0


def test_sequence_numbers_start_over_behind_the_last_one() -> None:
    assert tcp_packet(CLIENT, SERVER, b"", 2**32 + 5, 2**32)[24:32] == struct.pack(">II", 5, 0)


@pytest.mark.parametrize(
    ("socket_address", "node"),
    [
        (("10.0.0.5", 502), SERVER),
        (("::1", 502, 0, 0), Node(IPv6Address("::1"), 502)),
        (("::ffff:10.0.0.5", 502, 0, 0), SERVER),
        (("fe80::2%eth0", 502, 0, 3), Node(IPv6Address("fe80::2"), 502)),
        (("a pair in memory", 1), Node(IPv4Address(0), 0)),
        ("/run/socket", Node(IPv4Address(0), 0)),
        (None, Node(IPv4Address(0), 0)),
    ],
)
def test_the_node_of_a_socket_address(socket_address: object, node: Node) -> None:
    assert Node.of(socket_address) == node


def test_a_frame_of_a_line_names_its_dissector_and_both_ends() -> None:
    frame = bytes.fromhex("07 03 00 6b 00 03 74 71")
    pdu = line_pdu("mbrtu", Node(IPv4Address(0), 50_000), Node(IPv4Address(7), 1), frame)
    assert pdu == bytes.fromhex(
        "000c 0008 6d62727475000000"  # dissector name, padded
        "0014 0004 00000000"  # IPv4 source
        "0015 0004 00000007"  # IPv4 destination
        "0018 0004 00000003"  # port type UDP
        "0019 0004 0000c350"  # source port
        "001a 0004 00000001"  # destination port
        "0000 0000"  # end
        "07 03 00 6b 00 03 74 71"
    )
