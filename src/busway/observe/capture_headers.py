"""Builds the headers around Modbus bytes in capture files: IP, TCP, UDP, and the tag that names a line's dissector.

Knows the layouts of headers; knows no file and no Modbus. A program sees payloads, not packets, so the headers are
made from the addresses of the connection.

1. Ports and addresses are the true ones; sequence numbers count from 1 (RFC 9293), checksums are valid.
2. A frame of a serial line travels in no packet. It is written as an "upper PDU" of Wireshark: tags that name the
   dissector and stand for sender and receiver, then the frame.
"""

import struct
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

TCP: Final = 6
UDP: Final = 17

_HOP_LIMIT: Final = 64
_IPV4: Final = struct.Struct(">BBHHHBBH4s4s")
_IPV6: Final = struct.Struct(">IHBB16s16s")
_TCP: Final = struct.Struct(">HHIIBBHHH")
_UDP: Final = struct.Struct(">HHHH")
_DATA_AND_ACK: Final = 0x18
_WINDOW: Final = 0xFFFF

_TAG: Final = struct.Struct(">HH")
_END_OF_TAGS: Final = bytes(4)
_DISSECTOR: Final = 12
_IPV4_SOURCE, _IPV4_DESTINATION = 20, 21
_PORT_TYPE, _SOURCE_PORT, _DESTINATION_PORT = 24, 25, 26
_PORT_TYPE_UDP: Final = 3
_PROTOCOL_COLUMN, _INFO_COLUMN = 33, 36


@dataclass(frozen=True, slots=True)
class Node:
    """One end of a connection in a capture file: an IP address and a port, 0…65535."""

    address: IPv4Address | IPv6Address
    port: int

    @classmethod
    def of(cls, socket_address: object) -> "Node":
        """Return address and port of a socket address of asyncio or `socket`: a tuple of IP address and port.

        0.0.0.0:0 for any other object. An IPv4-mapped IPv6 address becomes IPv4.
        """
        if isinstance(socket_address, tuple) and len(socket_address) >= 2:
            host, port = socket_address[:2]
            try:
                return cls(_unmapped(ip_address(str(host).partition("%")[0])), int(port))
            except ValueError:
                pass  # no network address: a pair in memory
        return cls(IPv4Address(0), 0)


def _unmapped(address: IPv4Address | IPv6Address) -> IPv4Address | IPv6Address:
    """Return the IPv4 address in an IPv4-mapped IPv6 address, as dual-stack listeners report it; others unchanged."""
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return mapped or address


def tcp_packet(source: Node, destination: Node, payload: bytes, sequence: int, acknowledged: int) -> bytes:
    """Return an IP packet with a TCP segment.

    Args:
        source, destination: addresses and ports.
        payload: at most 65 000 bytes.
        sequence, acknowledged: sequence number and acknowledgement number of the segment, taken modulo 2³².
    """
    header = _TCP.pack(
        source.port,
        destination.port,
        sequence & 0xFFFF_FFFF,
        acknowledged & 0xFFFF_FFFF,
        _TCP.size // 4 << 4,
        _DATA_AND_ACK,
        _WINDOW,
        0,
        0,
    )
    return _ip_packet(source, destination, TCP, header, 16, payload)


def udp_packet(source: Node, destination: Node, payload: bytes) -> bytes:
    """Return an IP packet with a UDP datagram of at most 65 000 bytes."""
    header = _UDP.pack(source.port, destination.port, _UDP.size + len(payload), 0)
    return _ip_packet(source, destination, UDP, header, 6, payload)


def _ip_packet(
    source: Node, destination: Node, protocol: int, header: bytes, checksum_at: int, payload: bytes
) -> bytes:
    """Return an IP packet with a TCP or UDP header and its payload, both checksums filled in; IPv6 if an end has IPv6.

    ``checksum_at`` is the offset of the checksum in ``header``, in bytes.
    """
    size = len(header) + len(payload)
    pseudo = source.address.packed + destination.address.packed + struct.pack(">II", size, protocol)
    total = checksum(pseudo + header + payload) or 0xFFFF
    inner = header[:checksum_at] + total.to_bytes(2, "big") + header[checksum_at + 2 :]
    if isinstance(source.address, IPv6Address) or isinstance(destination.address, IPv6Address):
        ends = [IPv6Address(node.address.packed.rjust(16, b"\0")) for node in (source, destination)]
        return _IPV6.pack(6 << 28, size, protocol, _HOP_LIMIT, ends[0].packed, ends[1].packed) + inner + payload
    fields = (0x45, 0, _IPV4.size + size, 0, 0x4000, _HOP_LIMIT, protocol)
    packed = source.address.packed, destination.address.packed
    outer = _IPV4.pack(*fields, checksum(_IPV4.pack(*fields, 0, *packed)), *packed)
    return outer + inner + payload


def checksum(data: bytes) -> int:
    """Return the internet checksum of bytes, 0…65535 (RFC 1071)."""
    even = data if len(data) % 2 == 0 else data + b"\0"
    total: int = sum(struct.unpack(f">{len(even) // 2}H", even))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def line_pdu(dissector: str, source: Node, destination: Node, frame: bytes, *, info: str = "") -> bytes:
    """Return a serial frame as a packet of Wireshark's form "exported PDU".

    Args:
        dissector: Wireshark's name of the dissector that is to decode the frame, such as ``mbrtu``.
        source, destination: IPv4 addresses and ports that stand for master and unit.
        frame: the bytes of the frame.
        info: text for Wireshark's list of packets, for frames of which the dissector shows nothing; empty for none.
    """
    tags = _tag(_DISSECTOR, dissector.encode("ascii"))
    tags += _tag(_IPV4_SOURCE, source.address.packed) + _tag(_IPV4_DESTINATION, destination.address.packed)
    for name, number in (
        (_PORT_TYPE, _PORT_TYPE_UDP),
        (_SOURCE_PORT, source.port),
        (_DESTINATION_PORT, destination.port),
    ):
        tags += _tag(name, number.to_bytes(4, "big"))
    if info:
        tags += _tag(_PROTOCOL_COLUMN, b"Modbus") + _tag(_INFO_COLUMN, info.encode("utf-8"))
    return tags + _END_OF_TAGS + frame


def _tag(number: int, value: bytes) -> bytes:
    padded = value + bytes(-len(value) % 4)
    return _TAG.pack(number, len(padded)) + padded
