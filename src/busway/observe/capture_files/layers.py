"""Takes a packet apart: link layer, IP, and TCP or UDP; or the bytes of a serial line.

Knows headers; knows no connection and no Modbus. No function raises an error, whatever the bytes are.

1. A packet that is not understood becomes an `Ignored` with the reason, to be counted: another protocol is no error.
2. Lengths come from the headers, since Ethernet pads short packets; bytes that a header announces and the capture does
   not have are counted in ``missing``.
3. Fragments of IP are not put together: Modbus over TCP has none.
"""

from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address
from typing import Final

from ..capture_headers import TCP, UDP, Node

ETHERNET, RAW_IP, RTAC_SERIAL, EXPORTED_PDU = 1, 101, 250, 252
_NULL, _LOOP, _SLL, _SLL2, _IPV4, _IPV6 = 0, 108, 113, 276, 228, 229
_USER: Final = range(147, 163)
_IPV4_TYPE, _IPV6_TYPE = 0x0800, 0x86DD
_TAGS: Final = frozenset((0x8100, 0x88A8, 0x9100))
"""EtherTypes of VLAN tags: 802.1Q, 802.1ad, and the one used before 802.1ad."""
_MOST_TAGS: Final = 4
_RTAC_HEADER: Final = 12
_DISSECTOR_TAG, _PROTOCOL_TABLE_TAG = 12, 14
_LINE_DISSECTORS: Final = (b"mbrtu", b"data")
_EXTENSIONS: Final = frozenset((0, 43, 60, 135))
"""Extension headers of IPv6 that all have one form: hop by hop, routing, destination options, mobility."""
_FRAGMENT, _AUTHENTICATION = 44, 51
_MOST_EXTENSIONS: Final = 8
_FIN, _SYN, _RST, _ACK = 1, 2, 4, 16


@dataclass(frozen=True, slots=True)
class TcpSegment:
    """A segment of a TCP connection, as far as the capture has it.

    Attributes:
        source, destination: its addresses and ports.
        sequence: sequence number of its first byte.
        acknowledged: sequence number of the next byte that the sender expects; None for a segment without ACK flag.
        payload: its bytes, as far as captured.
        missing: number of bytes at its end that were not captured.
        syn, fin, rst: its flags.
    """

    source: Node
    destination: Node
    sequence: int
    acknowledged: int | None
    payload: bytes
    missing: int = 0
    syn: bool = False
    fin: bool = False
    rst: bool = False


@dataclass(frozen=True, slots=True)
class UdpDatagram:
    """A UDP datagram, as far as the capture has it.

    Attributes:
        source, destination: its addresses and ports.
        payload: its bytes, as far as captured.
        missing: number of bytes at its end that were not captured.
    """

    source: Node
    destination: Node
    payload: bytes
    missing: int = 0


@dataclass(frozen=True, slots=True)
class LineBytes:
    """Bytes of a serial line in one packet.

    ``whole``: whether the packet has exactly one frame, intact or damaged; if not, the bytes are any part of the line's
    stream of bytes.
    """

    payload: bytes
    whole: bool


@dataclass(frozen=True, slots=True)
class Ignored:
    """A packet that has nothing to do with Modbus, or cannot be taken apart; ``reason`` says why in a few words."""

    reason: str


Carried = TcpSegment | UdpDatagram | LineBytes | Ignored
"""What `carried` returns: what a packet contains, or the reason why the packet is ignored."""


def carried(link_type: int, data: bytes) -> Carried:
    """Return what a packet carries: a TCP segment, a datagram, bytes of a line, or `Ignored` with the reason.

    Args:
        link_type: number of the packet's link type, as tcpdump.org lists them: with which header the packet begins.
        data: the bytes of the packet.
    """
    if link_type == ETHERNET:
        return _typed(data, 12)
    if link_type in (RAW_IP, _IPV4, _IPV6):
        return _ip(data)
    if link_type in (_NULL, _LOOP):
        return _ip(data[4:])
    if link_type == _SLL:
        return _typed(data, 14)
    if link_type == _SLL2:
        return _ip(data[20:]) if _number(data, 0) in (_IPV4_TYPE, _IPV6_TYPE) else _other_type(_number(data, 0))
    if link_type == RTAC_SERIAL:
        payload = data[_RTAC_HEADER:]
        return LineBytes(payload, whole=False) if payload else Ignored("an event of a serial line")
    if link_type in _USER:
        return LineBytes(data, whole=True)
    if link_type == EXPORTED_PDU:
        return _exported(data)
    return Ignored(f"link type {link_type}")


def _number(data: bytes, at: int) -> int:
    """Return the two bytes at ``at`` as a number; -1 if they are not there."""
    return data[at] << 8 | data[at + 1] if len(data) >= at + 2 else -1


def _typed(data: bytes, at: int) -> Carried:
    """Return what a packet carries whose EtherType, or first VLAN tag, is at the offset ``at``, in bytes."""
    kind = _number(data, at)
    for _ in range(_MOST_TAGS):
        if kind not in _TAGS:
            break
        at += 4
        kind = _number(data, at)
    return _ip(data[at + 2 :]) if kind in (_IPV4_TYPE, _IPV6_TYPE) else _other_type(kind)


def _other_type(kind: int) -> Ignored:
    if kind < 0:
        return Ignored("a cut off link layer")
    return Ignored("no IP" if kind < 0x600 else f"EtherType {kind:04X}")


def _ip(data: bytes) -> Carried:
    version = data[0] >> 4 if data else 0
    if version == 4 and len(data) >= 20:
        return _ipv4(data)
    if version == 6 and len(data) >= 40:
        return _ipv6(data)
    return Ignored("a cut off IP header" if version in (4, 6) or not data else "no IP")


def _ipv4(data: bytes) -> Carried:
    header, size = (data[0] & 15) * 4, _number(data, 2)
    if header < 20 or len(data) < header:
        return Ignored("a cut off IP header")
    if _number(data, 6) & 0x3FFF:  # more fragments, or an offset
        return Ignored("a fragment of IP")
    size = max(size, header) if size else len(data)  # 0: cut into segments by the network card
    ends = IPv4Address(data[12:16]), IPv4Address(data[16:20])
    return _transport(data[9], *ends, data[header:size], max(size - len(data), 0))


def _ipv6(data: bytes) -> Carried:
    size = _number(data, 4)
    size = 40 + size if size else len(data)
    missing = max(size - len(data), 0)
    ends = IPv6Address(data[8:24]), IPv6Address(data[24:40])
    kind, data = data[6], data[40:size]
    for _ in range(_MOST_EXTENSIONS):
        if kind not in _EXTENSIONS and kind not in (_FRAGMENT, _AUTHENTICATION):
            break
        if len(data) < 8:
            return Ignored("a cut off IP header")
        if kind == _FRAGMENT and _number(data, 2) & 0xFFF9:
            return Ignored("a fragment of IP")
        length = 8 if kind == _FRAGMENT else 4 * (data[1] + 2) if kind == _AUTHENTICATION else 8 * (data[1] + 1)
        kind, data = data[0], data[length:]
    return _transport(kind, *ends, data, missing)


def _transport(
    kind: int,
    source: IPv4Address | IPv6Address,
    destination: IPv4Address | IPv6Address,
    data: bytes,
    missing: int,
) -> Carried:
    if kind not in (TCP, UDP):
        return Ignored(f"IP protocol {kind}")
    if len(data) < (20 if kind == TCP else 8):
        return Ignored("a cut off header of TCP or UDP")
    ends = Node(source, _number(data, 0)), Node(destination, _number(data, 2))
    if kind == UDP:
        size = max(_number(data, 4), 8)
        return UdpDatagram(*ends, data[8:size], missing)
    header, flags = (data[12] >> 4) * 4, data[13]
    if header < 20 or len(data) < header:
        return Ignored("a cut off header of TCP or UDP")
    return TcpSegment(
        *ends,
        int.from_bytes(data[4:8], "big"),
        int.from_bytes(data[8:12], "big") if flags & _ACK else None,
        data[header:],
        missing,
        syn=bool(flags & _SYN),
        fin=bool(flags & _FIN),
        rst=bool(flags & _RST),
    )


def _exported(data: bytes) -> Carried:
    """Return the serial frame in a packet of Wireshark's form "exported PDU", as `busway.observe.capture` writes it.

    `Ignored` if the packet is cut off or has no frame of a serial line.
    """
    at, dissector = 0, b""
    while True:
        tag, size = _number(data, at), _number(data, at + 2)
        if tag < 0 or size < 0:
            return Ignored("a cut off exported PDU")
        if tag == 0:
            break
        if tag in (_DISSECTOR_TAG, _PROTOCOL_TABLE_TAG):
            dissector = dissector or data[at + 4 : at + 4 + size].rstrip(b"\0")
        at += 4 + size
    if dissector not in _LINE_DISSECTORS:
        return Ignored("an exported PDU of another protocol")
    return LineBytes(data[at + 4 :], whole=True)
