"""Frames of checks: requests as bytes, also damaged ones, and replies found in what was received.

Knows the three framings; knows no function and no connection.

1. A damage is one function from a whole frame to bytes, in one table per framing. What a framing has not is not asked.
2. A receiver takes bytes of any quality and says what is in them: frames, bytes that are in no frame, and whether more
   is needed. It judges nothing.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from ...codes import ASCII_ADU_LIMIT, RTU_ADU_LIMIT
from ...framing.ascii import encode_ascii
from ...framing.crc import crc16, crc_bytes
from ...framing.lrc import lrc
from ...framing.mbap import HEAD, FrameKind, MbapReceiver, encode_mbap
from ...framing.rtu import encode_rtu
from ...pdu.functions import STANDARD
from ...pdu.message import UNKNOWN_LENGTH
from .check import FrameDamage


@dataclass(frozen=True, slots=True)
class Frame:
    """One received frame: its addressing, its PDU, and the bytes that it was."""

    unit: int
    pdu: bytes
    raw: bytes
    transaction: int = 0
    protocol: int = 0


_AROUND_PDU: Final = 3
"""Bytes of an RTU frame beside its PDU."""


class FrameSearch(Protocol):
    """Finds frames in received bytes; one object for each connection."""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Return the frames that ``data`` completes; ``function`` was asked last."""

    def finish(self, function: int) -> list[Frame]:
        """Return the frames that are complete because nothing more comes."""

    def take_rest(self) -> bytes:
        """Return and forget the bytes that are in no frame, or in an unfinished one."""


class MbapSearch:
    """Finds frames in a stream of Modbus on TCP/IP."""

    def __init__(self) -> None:
        self._receiver = MbapReceiver()
        self._broken = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Return the frames that ``data`` completes."""
        found = []
        for one in self._receiver.receive(data):
            if one.kind is FrameKind.BROKEN:
                self._broken = one.pdu
            else:
                raw = HEAD.pack(one.transaction, one.protocol, len(one.pdu) + 1, one.unit) + one.pdu
                found.append(Frame(one.unit, one.pdu, raw, one.transaction, one.protocol))
        return found

    def finish(self, function: int) -> list[Frame]:
        """Return nothing: an unfinished frame of this framing is none."""
        return []

    def take_rest(self) -> bytes:
        """Return the bytes that break the stream, or the size of an unfinished frame as zeros."""
        return self._broken or bytes(self._receiver.pending)


class RtuSearch:
    """Finds frames in the bytes of an RTU line: those whose CRC fits."""

    def __init__(self) -> None:
        self._kept = b""
        self._junk = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Return the frames that ``data`` completes. Behind junk, only frames of the function asked are looked for."""
        self._kept += data
        return self._found(function, is_over=False)

    def finish(self, function: int) -> list[Frame]:
        """Return frames that are shorter than they announce, because nothing more comes."""
        return self._found(function, is_over=True)

    def _found(self, function: int, *, is_over: bool) -> list[Frame]:
        found = []
        while (place := self._next(function, is_over=is_over)) is not None:
            start, end = place
            raw = self._kept[start:end]
            self._junk += self._kept[:start]
            self._kept = self._kept[end:]
            found.append(Frame(raw[0], raw[1:-2], raw))
        return found

    def take_rest(self) -> bytes:
        """Return and forget the bytes that are in no frame."""
        rest, self._kept, self._junk = self._junk + self._kept, b"", b""
        return rest

    def _next(self, function: int, *, is_over: bool) -> tuple[int, int] | None:
        """Return where the next frame is.

        The length that a reply announces comes first: where the second byte of a CRC is 0, which is so in one frame of
        256, the CRC fits without it too.
        """
        data = self._kept
        for start in range(len(data) - 3):
            if start and data[start + 1] & 0x7F != function & 0x7F:
                continue
            length = STANDARD.reply_length(data, start + 1, len(data))
            end = start + length + _AROUND_PDU
            if length > 0 and end <= len(data) and not crc16(data[start:end]):
                return start, end
            if length != UNKNOWN_LENGTH and (length <= 0 or end > len(data)) and not is_over:
                continue
            if len(data) - start <= RTU_ADU_LIMIT and not crc16(data[start:]):
                return start, len(data)
            state = crc16(data[start : start + 3])
            for end in range(start + 4, min(len(data), start + RTU_ADU_LIMIT) + 1):
                state = crc16(data[end - 1 : end], state)
                if state == 0:
                    return start, end
        return None


class AsciiSearch:
    """Finds frames in the characters of an ASCII line: those from colon to CR LF whose LRC fits."""

    def __init__(self) -> None:
        self._kept = b""
        self._junk = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Return the frames that ``data`` completes."""
        self._kept += data
        found = []
        while match := _ASCII_FRAME.search(self._kept):
            content = bytes.fromhex(match[1].decode("ascii"))
            self._junk += self._kept[: match.start()]
            self._kept = self._kept[match.end() :]
            if lrc(content) or len(content) < 3:
                self._junk += match[0]
            else:
                found.append(Frame(content[0], content[1:-1], match[0]))
        return found

    def finish(self, function: int) -> list[Frame]:
        """Return nothing: an unfinished frame of this framing is none."""
        return []

    def take_rest(self) -> bytes:
        """Return and forget the characters that are in no frame."""
        rest, self._kept, self._junk = self._junk + self._kept, b"", b""
        return rest


_ASCII_FRAME: Final = re.compile(rb":((?:[0-9A-Fa-f]{2})+)\r\n")

_Damager = Callable[[bytes], bytes]


def _with_length(length: int) -> _Damager:
    return lambda frame: frame[:4] + length.to_bytes(2, "big") + frame[6:]


def _with_crc(body: bytes) -> bytes:
    return body + crc_bytes(body)


def _ascii_damaged(change: _Damager) -> _Damager:
    """FrameDamage the content of an ASCII frame, LRC included, and keep colon and end."""
    return lambda frame: b":" + change(frame[1:-2]) + frame[-2:]


_MBAP: Final[Mapping[FrameDamage, _Damager]] = {
    FrameDamage.PROTOCOL_1: lambda frame: frame[:2] + b"\x00\x01" + frame[4:],
    FrameDamage.PROTOCOL_FFFF: lambda frame: frame[:2] + b"\xff\xff" + frame[4:],
    FrameDamage.LENGTH_0: _with_length(0),
    FrameDamage.LENGTH_1: _with_length(1),
    FrameDamage.LENGTH_255: _with_length(255),
    FrameDamage.LENGTH_FFFF: _with_length(0xFFFF),
    FrameDamage.LENGTH_SHORT: lambda frame: frame[:4] + (len(frame) - 7).to_bytes(2, "big") + frame[6:],
}
_RTU: Final[Mapping[FrameDamage, _Damager]] = {
    FrameDamage.NO_END: lambda frame: frame[:-3],
    FrameDamage.CHECK_FLIPPED: lambda frame: frame[:-2] + bytes((frame[-2] ^ 1, frame[-1])),
    FrameDamage.CHECK_SWAPPED: lambda frame: frame[:-2] + frame[:-3:-1],
    FrameDamage.CHECK_ZERO: lambda frame: frame[:-2] + b"\x00\x00",
    FrameDamage.CONTENT_FLIPPED: lambda frame: frame[:2] + bytes((frame[2] ^ 0x80,)) + frame[3:],
    FrameDamage.NO_CHECK: lambda frame: frame[:-2],
    FrameDamage.TOO_LONG: lambda frame: _with_crc(frame[:-2] + bytes(RTU_ADU_LIMIT)),
    FrameDamage.TINY: lambda frame: frame[:3],
}
_ASCII: Final[Mapping[FrameDamage, _Damager]] = {
    FrameDamage.NO_END: lambda frame: frame[:-2],
    FrameDamage.CHECK_FLIPPED: _ascii_damaged(lambda text: text[:-1] + b"%X" % (int(text[-1:], 16) ^ 1)),
    FrameDamage.CHECK_ZERO: _ascii_damaged(lambda text: text[:-2] + b"00"),
    FrameDamage.CONTENT_FLIPPED: _ascii_damaged(lambda text: text[:5] + b"%X" % (int(text[5:6], 16) ^ 1) + text[6:]),
    FrameDamage.NO_CHECK: _ascii_damaged(lambda text: text[:-2]),
    FrameDamage.TOO_LONG: _ascii_damaged(lambda text: text + b"0" * ASCII_ADU_LIMIT),
    FrameDamage.TINY: lambda frame: b":FF\r\n",
    FrameDamage.NOT_HEX: _ascii_damaged(lambda text: text[:-3] + b"G" + text[-2:]),
    FrameDamage.ODD_DIGITS: _ascii_damaged(lambda text: text[:-1]),
    FrameDamage.NO_COLON: lambda frame: frame[1:],
    FrameDamage.NO_CR: lambda frame: frame[:-2] + b"\n",
    FrameDamage.RESTARTED: lambda frame: frame[:7] + frame,
    FrameDamage.JUNK_BEFORE: lambda frame: b"0123\r\nXYZ" + frame,
    FrameDamage.LOWER_CASE: lambda frame: frame.lower(),
}


def damages_of(framing: str) -> Mapping[FrameDamage, _Damager]:
    """Return what can be damaged in a frame of this framing."""
    return {"mbap": _MBAP, "rtu": _RTU, "ascii": _ASCII}[framing]


def encode_frame(framing: str, unit: int, pdu: bytes, transaction: int, damage: FrameDamage | None = None) -> bytes:
    """Return the frame of a PDU, damaged if that is asked for."""
    if framing == "mbap":
        frame = encode_mbap(transaction, unit, pdu)
    else:
        frame = encode_rtu(unit, pdu) if framing == "rtu" else encode_ascii(unit, pdu)
    return frame if damage is None else damages_of(framing)[damage](frame)


def new_search(framing: str) -> FrameSearch:
    """Return a new search for the frames of one connection."""
    kinds: Mapping[str, Callable[[], FrameSearch]] = {"mbap": MbapSearch, "rtu": RtuSearch, "ascii": AsciiSearch}
    return kinds[framing]()
