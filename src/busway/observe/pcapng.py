"""Writes capture files in the pcapng format (draft-ietf-opsawg-pcapng), which Wireshark and tshark read.

Knows blocks and options; knows nothing of what packets contain. `busway.observe.capture` decides what is written.

1. Little-endian; times in microseconds. One section.
2. Each block is written and flushed at once: the file is valid whenever the program ends, and readable while it grows.
3. No library is used: three kinds of blocks are enough, and rule 2 must hold.
"""

import struct
from enum import IntEnum
from typing import BinaryIO, Final

from ..version import __version__

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
SECTION_HEADER: Final = struct.pack("<I", _SECTION)
"""First four bytes of each pcapng file, the same in both byte orders."""
_BYTE_ORDER: Final = 0x1A2B3C4D
_UNKNOWN_LENGTH: Final = -1
_END_OF_OPTIONS: Final = 0
_COMMENT: Final = 1
_NAME, _DESCRIPTION, _TIME_RESOLUTION = 2, 3, 9
_APPLICATION: Final = 4
_FLAGS: Final = 2
_MICROSECONDS: Final = 6
_LONGEST_TEXT: Final = 4000
"""Most bytes of a comment or name; a longer one is cut off. The format has room for 65 535, more than is readable."""


class LinkType(IntEnum):
    """Kinds of packets that an interface of a capture file can have: IP packets, or exported PDUs."""

    RAW_IP = 101
    UPPER_PDU = 252


class Flow(IntEnum):
    """Direction of a captured packet, as seen from this program: received, sent, or UNKNOWN."""

    UNKNOWN = 0
    INCOMING = 1
    OUTGOING = 2


class PcapngWriter:
    """Writes a capture file in pcapng format into a binary stream of the caller; creating it writes the file's header.

    Errors of the stream, such as `OSError`, are passed on to the caller.

    Args:
        stream: the file, opened in binary mode; it is never closed here.
        comment: comment of the file; empty for none.

    Attributes:
        packets: number of packets written so far.
    """

    __slots__ = ("_interfaces", "_stream", "packets")

    def __init__(self, stream: BinaryIO, *, comment: str = "") -> None:
        self._stream = stream
        self._interfaces = 0
        self.packets: int = 0
        options = _text(_COMMENT, comment) + _text(_APPLICATION, f"busway {__version__}")
        self._write(_SECTION, struct.pack("<IHHq", _BYTE_ORDER, 1, 0, _UNKNOWN_LENGTH), options)

    def add_interface(self, link_type: LinkType, name: str, description: str = "") -> int:
        """Add an interface to the capture file. Returns its number for `add_packet`, counted from 0."""
        options = _text(_NAME, name) + _text(_DESCRIPTION, description)
        options += _option(_TIME_RESOLUTION, bytes((_MICROSECONDS,)))
        self._write(_INTERFACE, struct.pack("<HHI", link_type, 0, 0), options)
        self._interfaces += 1
        return self._interfaces - 1

    def add_packet(
        self, interface: int, data: bytes, time: float, *, flow: Flow = Flow.UNKNOWN, comment: str = ""
    ) -> None:
        """Write a packet to the capture file.

        Args:
            interface: number that `add_interface` returned.
            data: the bytes of the packet.
            time: when it was seen, in seconds since 1970.
            flow: whether it was received or sent, or UNKNOWN.
            comment: comment of the packet; empty for none.
        """
        microseconds = max(round(time * 1e6), 0)
        head = struct.pack("<IIIII", interface, microseconds >> 32, microseconds & 0xFFFF_FFFF, len(data), len(data))
        options = _text(_COMMENT, comment)
        if flow is not Flow.UNKNOWN:
            options += _option(_FLAGS, struct.pack("<I", flow))
        self._write(_PACKET, head + _padded(data), options)
        self.packets += 1

    def _write(self, kind: int, body: bytes, options: bytes) -> None:
        if options:
            options += _option(_END_OF_OPTIONS, b"")
        size = 12 + len(body) + len(options)
        self._stream.write(struct.pack("<II", kind, size) + body + options + struct.pack("<I", size))
        self._stream.flush()


def _text(code: int, text: str) -> bytes:
    """Encode a text option of a pcapng block; empty if there is no text."""
    if not text:
        return b""
    encoded = text.encode("utf-8")
    if len(encoded) > _LONGEST_TEXT:
        encoded = encoded[:_LONGEST_TEXT].decode("utf-8", errors="ignore").encode("utf-8")
    return _option(code, encoded)


def _option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)
