"""Capture files made by hand: pcap and pcapng in both byte orders, and conversations to put into them."""

import struct
from collections.abc import Iterable, Sequence
from ipaddress import IPv4Address
from itertools import pairwise

from busway.observe.capture_files.packet_file import CapturedPacket
from busway.observe.capture_headers import Node, tcp_packet

CLIENT = Node(IPv4Address("10.0.0.9"), 40_000)
SERVER = Node(IPv4Address("10.0.0.5"), 502)

Timed = tuple[float, bytes]


def pcap(packets: Iterable[Timed], *, link: int = 101, order: str = "<", ticks: int = 1_000_000) -> bytes:
    """A pcap file with these packets."""
    magic = 0xA1B2C3D4 if ticks == 1_000_000 else 0xA1B23C4D
    data = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 262_144, link)
    for time, packet in packets:
        whole, part = divmod(round(time * ticks), ticks)
        data += struct.pack(f"{order}IIII", whole, part, len(packet), len(packet)) + packet
    return data


def block(kind: int, body: bytes, order: str = "<") -> bytes:
    """A block of pcapng."""
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}I", len(body) + 12)
    return struct.pack(f"{order}I", kind) + size + body + size


def section(order: str = "<") -> bytes:
    """A section header."""
    return block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1), order)


def interface(link: int = 101, order: str = "<", *, snap: int = 0, options: Sequence[tuple[int, bytes]] = ()) -> bytes:
    """An interface block."""
    body = struct.pack(f"{order}HHI", link, 0, snap)
    for code, value in options:
        body += struct.pack(f"{order}HH", code, len(value)) + value + bytes(-len(value) % 4)
    return block(1, body, order)


def packet(number: int, data: bytes, ticks: int = 0, order: str = "<", *, original: int | None = None) -> bytes:
    """An enhanced packet block."""
    size = len(data) if original is None else original
    head = struct.pack(f"{order}IIIII", number, ticks >> 32, ticks & 0xFFFF_FFFF, len(data), size)
    return block(6, head + data + bytes(-len(data) % 4), order)


class Talk:
    """A TCP conversation, as raw IP packets with the right sequence numbers."""

    def __init__(self, client: Node = CLIENT, server: Node = SERVER, *, opened: bool = True) -> None:
        self.client, self.server = client, server
        self.packets: list[Timed] = []
        self.time = 1_000.0
        self._next = {True: 1_000, False: 4_294_967_290}  # the second wraps
        if opened:
            for is_request in (True, False):
                syn = bytearray(tcp_packet(*self._ends(is_request), b"", self._next[is_request] - 1, 0))
                syn[33] = 0x02 if is_request else 0x12
                if not is_request:
                    syn[28:32] = self._next[True].to_bytes(4, "big")
                self.packets.append((self.time, bytes(syn)))

    def asks(self, text: str, *, after: float = 0.01) -> None:
        """The client sends these bytes."""
        self.says(True, bytes.fromhex(text), after)

    def answers(self, text: str, *, after: float = 0.01) -> None:
        """The server sends these bytes."""
        self.says(False, bytes.fromhex(text), after)

    def says(self, is_request: bool, data: bytes, after: float = 0.01) -> None:
        """One end sends bytes in one segment."""
        self.time += after
        sequence = self._next[is_request]
        self._next[is_request] += len(data)
        acknowledged = self._next[not is_request]
        self.packets.append((self.time, tcp_packet(*self._ends(is_request), data, sequence, acknowledged)))

    def _ends(self, is_request: bool) -> tuple[Node, Node]:
        return (self.client, self.server) if is_request else (self.server, self.client)

    def captured(self) -> list[CapturedPacket]:
        """The packets as a capture file has them."""
        return captured(self.packets)


def captured(packets: Iterable[Timed], link: int = 101) -> list[CapturedPacket]:
    """Packets as a file of one interface has them."""
    return [CapturedPacket(number, time, link, data) for number, (time, data) in enumerate(packets, 1)]


def pieces(data: bytes, cuts: Iterable[int]) -> list[tuple[int, bytes]]:
    """The bytes cut at these places: the offset of each piece, and the piece."""
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [(first, data[first:end]) for first, end in pairwise(places)]
