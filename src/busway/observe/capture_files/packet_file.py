"""Reads the packets of a capture file: pcap in its four forms, and pcapng (draft-ietf-opsawg-pcapng).

Knows records and blocks; knows nothing of what packets contain. The file is read as a binary stream from beginning to
end, so a pipe serves too, and one packet at a time is in memory.

1. A file that ends inside a record is *truncated*: its whole records are read, and `PacketFile.truncated_at` says where
   it ends.
2. At a record that breaks the rules of its format `ConfigError` is raised, which names the file and the offset of the
   record. The packets before the record are read. There is no other exception but `OSError` of the stream.
3. pcapng: byte order and interfaces belong to a section, and a file may have several. Blocks of unknown kinds are
   skipped, as the format asks. A packet of a simple block has no time; it gets that of the packet before it.
4. Limits: `MOST_RECORD` bytes of a record, `MOST_INTERFACES` of a section.
5. No library is used: those that read captures are a network stack of their own, or no longer maintained.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Final

from ...errors import ConfigError

MOST_RECORD: Final = 16 << 20
"""Most bytes of one record or block; Wireshark refuses packets above 256 KiB, or 128 MiB of a few link types."""
MOST_INTERFACES: Final = 4096

_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _PACKET = 0x0A0D0D0A, 1, 2, 3, 6
_BYTE_ORDER: Final = b"\x1a\x2b\x3c\x4d"
_PCAP_MAGICS: Final = {
    b"\xa1\xb2\xc3\xd4": (">", 1_000_000),
    b"\xd4\xc3\xb2\xa1": ("<", 1_000_000),
    b"\xa1\xb2\x3c\x4d": (">", 1_000_000_000),
    b"\x4d\x3c\xb2\xa1": ("<", 1_000_000_000),
}
_OTHERS: Final = (
    (b"\x1f\x8b", "is compressed with gzip; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "is compressed with zstd; unpack it first"),
    (b"\x04\x22\x4d\x18", "is compressed with lz4; unpack it first"),
    (b"\xa1\xb2\xcd\x34", "is a pcap of a modified format; `editcap` makes a pcapng of it"),
    (b"\x34\xcd\xb2\xa1", "is a pcap of a modified format; `editcap` makes a pcapng of it"),
    (b"snoop\0", "is a capture of snoop; `editcap` makes a pcapng of it"),
)
_END_OF_OPTIONS, _TIME_RESOLUTION, _TIME_OFFSET, _NAME = 0, 9, 14, 2


@dataclass(frozen=True, slots=True)
class CapturedPacket:
    """One packet of a capture file.

    Attributes:
        number: counted from 1 over the whole file, as Wireshark counts.
        time: seconds since 1970. A packet without a time gets that of the packet before it; the first packet gets 0.
        link_type: number of its link type, as tcpdump.org lists them: with which header it begins.
        data: its bytes, as far as they were captured.
        missing: number of bytes at its end that were not captured.
        interface: number of its interface, counted from 0 over the whole file; 0 for a pcap.
        interface_name: name of its interface; empty if the file has none.
    """

    number: int
    time: float
    link_type: int
    data: bytes
    missing: int = 0
    interface: int = 0
    interface_name: str = ""


@dataclass(frozen=True, slots=True)
class _Interface:
    """One interface of a pcapng section; a pcap counts as one interface.

    Attributes:
        number: counted from 0 over the whole file.
        link_type: number of the link type of its packets.
        snap_length: most bytes that were captured of a packet; 0 for no limit.
        ticks: ticks of its clock in a second.
        offset: seconds to add to its times.
        name: empty if it has none.
    """

    number: int
    link_type: int
    snap_length: int
    ticks: int = 1_000_000
    offset: int = 0
    name: str = ""


class _EndError(Exception):
    """Error: the file ends inside a record."""


def is_capture_file(head: bytes) -> bool:
    """Whether the first four bytes of a file are those of a pcap or pcapng file."""
    return head[:4] in _PCAP_MAGICS or head[:4] == struct.pack("<I", _SECTION)


class PacketFile:
    """The packets of a capture file; iterating yields each as a `CapturedPacket`.

    Args:
        stream: the file, opened in binary mode, at its beginning.
        name: its name, for errors.

    Attributes:
        packets: number of packets yielded so far.
        truncated_at: offset in bytes of the record inside which the file ends; None for a file that is whole, and until
            the end has been reached.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self.packets: int = 0
        self.truncated_at: int | None = None
        self._stream = stream
        self._name = name
        self._at = 0  # offset of the next byte
        self._record = 0  # offset of the record that is read
        self._time = 0.0
        self._interfaces_seen = 0

    def __iter__(self) -> Iterator[CapturedPacket]:
        """Yield the packets in their order, once.

        If the file ends inside a record, the iteration ends without an error and sets ``truncated_at``.

        Raises:
            ConfigError: the file is no capture, or is broken; packets before that place were yielded.
            OSError: the stream cannot be read.
        """
        try:
            magic = self._up_to(4)
            if magic in _PCAP_MAGICS:
                yield from self._pcap(*_PCAP_MAGICS[magic])
            elif magic == struct.pack("<I", _SECTION):
                yield from self._pcapng()
            else:
                raise self._no_capture(magic)
        except _EndError:
            self.truncated_at = self._record

    # pcap.

    def _pcap(self, order: str, ticks: int) -> Iterator[CapturedPacket]:
        major, _minor, _zone, _accuracy, snap_length, link = struct.unpack(f"{order}HHiIII", self._exactly(20))
        if major != 2:
            raise self._broken(f"version {major} of pcap, where 2 can be read")
        interface = _Interface(0, link & 0xFFFF, snap_length, ticks)
        header = struct.Struct(f"{order}IIII")
        while head := self._next(header.size):
            seconds, fraction, captured, original = header.unpack(head)
            if captured > MOST_RECORD:
                raise self._broken(f"a packet of {captured} bytes, where {MOST_RECORD} can be")
            yield self._packet(interface, self._exactly(captured), original, seconds + fraction / ticks)

    # pcapng.

    def _pcapng(self) -> Iterator[CapturedPacket]:
        order, interfaces = self._section(), list[_Interface]()
        while head := self._next(4):
            if head == struct.pack("<I", _SECTION):
                order, interfaces = self._section(), []
                continue
            (kind,) = struct.unpack(f"{order}I", head)
            body = self._block(order)
            if kind == _INTERFACE:
                if len(interfaces) == MOST_INTERFACES:
                    raise self._broken(f"more than {MOST_INTERFACES} interfaces")
                interfaces.append(self._interface(order, body))
            elif kind == _PACKET:
                yield self._enhanced(order, body, interfaces)
            elif kind == _OLD_PACKET:
                self._at_least(body, 20, "a packet block")
                number, _drops, *rest = struct.unpack_from(f"{order}HHIIII", body)
                yield self._timed(order, body, interfaces, number, rest)
            elif kind == _SIMPLE_PACKET:
                yield self._simple(order, body, interfaces)

    def _section(self) -> str:
        """Read the rest of a section header. Returns the byte order of the section, ``<`` or ``>``."""
        length, mark = self._exactly(4), self._exactly(4)
        order = {_BYTE_ORDER: ">", _BYTE_ORDER[::-1]: "<"}.get(mark)
        if order is None:
            raise self._broken(f"a section whose byte order mark is {mark.hex(' ')}")
        body = self._rest_of_block(order, length, already=4)
        if len(body) < 12:
            raise self._broken("a section header that is too short")
        (major,) = struct.unpack_from(f"{order}H", body)
        if major != 1:
            raise self._broken(f"version {major} of pcapng, where 1 can be read")
        return order

    def _block(self, order: str) -> bytes:
        return self._rest_of_block(order, self._exactly(4), already=0)

    def _rest_of_block(self, order: str, length: bytes, *, already: int) -> bytes:
        """Read the rest of a pcapng block, and return it without the block's two lengths.

        Args:
            order: byte order of the section, ``<`` or ``>``.
            length: the length at the block's beginning, four bytes.
            already: number of bytes of the body that were read before.
        """
        (size,) = struct.unpack(f"{order}I", length)
        if size % 4 or size < 12 + already or size > MOST_RECORD:
            raise self._broken(f"a block of {size} bytes, where multiples of 4 up to {MOST_RECORD} can be")
        body = self._exactly(size - 12 - already)
        if self._exactly(4) != length:
            raise self._broken("a block whose two lengths differ")
        return body

    def _interface(self, order: str, body: bytes) -> _Interface:
        self._at_least(body, 8, "an interface block")
        link, _, snap_length = struct.unpack_from(f"{order}HHI", body)
        ticks, offset, name = 1_000_000, 0, ""
        for code, value in _options(order, body[8:]):
            if code == _TIME_RESOLUTION and len(value) == 1:
                exponent = value[0] & 0x7F
                ticks = 2**exponent if value[0] & 0x80 else 10**exponent
            elif code == _TIME_OFFSET and len(value) == 8:
                (offset,) = struct.unpack(f"{order}q", value)
            elif code == _NAME:
                name = value.decode("utf-8", errors="replace").rstrip("\0")
        self._interfaces_seen += 1
        return _Interface(self._interfaces_seen - 1, link, snap_length, ticks, offset, name)

    def _enhanced(self, order: str, body: bytes, interfaces: list[_Interface]) -> CapturedPacket:
        self._at_least(body, 20, "a packet block")
        number, *rest = struct.unpack_from(f"{order}IIIII", body)
        return self._timed(order, body, interfaces, number, rest)

    def _timed(
        self, order: str, body: bytes, interfaces: list[_Interface], number: int, rest: list[int]
    ) -> CapturedPacket:
        high, low, captured, original = rest
        interface = self._interface_at(interfaces, number)
        if captured > len(body) - 20:
            raise self._broken(f"a packet of {captured} bytes in a block with {len(body) - 20}")
        # Whole numbers first: a float has no room for nanoseconds since 1970.
        whole, part = divmod(high << 32 | low, interface.ticks)
        return self._packet(
            interface, body[20 : 20 + captured], original, whole + interface.offset + part / interface.ticks
        )

    def _simple(self, order: str, body: bytes, interfaces: list[_Interface]) -> CapturedPacket:
        self._at_least(body, 4, "a simple packet block")
        interface = self._interface_at(interfaces, 0)
        (original,) = struct.unpack_from(f"{order}I", body)
        captured = min(original, interface.snap_length or original, len(body) - 4)
        return self._packet(interface, body[4 : 4 + captured], original, self._time)

    def _interface_at(self, interfaces: list[_Interface], number: int) -> _Interface:
        if number >= len(interfaces):
            raise self._broken(f"a packet of interface {number}, where the section has {len(interfaces)}")
        return interfaces[number]

    # Both.

    def _packet(self, interface: _Interface, data: bytes, original: int, time: float) -> CapturedPacket:
        self.packets += 1
        self._time = time
        missing = max(original - len(data), 0)
        return CapturedPacket(self.packets, time, interface.link_type, data, missing, interface.number, interface.name)

    def _next(self, size: int) -> bytes:
        """Return the first ``size`` bytes of the next record; empty at the end of the file."""
        self._record = self._at
        first = self._up_to(size)
        if first and len(first) < size:
            raise _EndError
        return first

    def _exactly(self, size: int) -> bytes:
        data = self._up_to(size)
        if len(data) < size:
            raise _EndError
        return data

    def _up_to(self, size: int) -> bytes:
        """Return the next ``size`` bytes; fewer only at the end of the file."""
        data = self._stream.read(size)
        while 0 < len(data) < size:  # a pipe gives less at once
            more = self._stream.read(size - len(data))
            if not more:
                break
            data += more
        self._at += len(data)
        return data

    def _at_least(self, body: bytes, size: int, what: str) -> None:
        if len(body) < size:
            raise self._broken(f"{what} with {len(body)} bytes, where it has at least {size}")

    def _broken(self, what: str) -> ConfigError:
        return ConfigError(f"the capture is broken at offset {self._record}: {what}", file=self._name)

    def _no_capture(self, magic: bytes) -> ConfigError:
        if not magic:
            return ConfigError("is empty, and no capture", file=self._name)
        head = magic + self._up_to(2)
        why = next((sentence for begin, sentence in _OTHERS if head.startswith(begin)), "")
        return ConfigError(why or f"is no pcap and no pcapng: it begins {magic.hex(' ')}", file=self._name)


def _options(order: str, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield number and value of each option of a block, as far as they are whole."""
    at = 0
    while at + 4 <= len(data):
        code, size = struct.unpack_from(f"{order}HH", data, at)
        if code == _END_OF_OPTIONS or at + 4 + size > len(data):
            return
        yield code, data[at + 4 : at + 4 + size]
        at += 4 + size + -size % 4
