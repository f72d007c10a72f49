"""Frames of checks: builds requests as bytes, also damaged ones, and finds replies in the received bytes.

Knows the three framings; knows no function code and no connection.

1. A damage is a function from a whole frame to damaged bytes, in one table per framing. Damages that make no sense for
   a framing are not in its table.
2. A search takes any bytes and separates them into frames and bytes that are in no frame. It judges neither.
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
    """One received frame: unit identifier, PDU and all its bytes (``raw``).

    ``transaction`` and ``protocol`` are those of the MBAP header; 0 on RTU and ASCII.
    """

    unit: int
    pdu: bytes
    raw: bytes
    transaction: int = 0
    protocol: int = 0


_AROUND_PDU: Final = 3
"""Number of bytes of an RTU frame beside its PDU: the unit and the CRC."""


class FrameSearch(Protocol):
    """Interface of an object that finds frames in the bytes received on one connection or line.

    ``function`` is the function code of the request whose reply is expected; 0 if none is.
    """

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Take received bytes, and return the frames that are now complete."""

    def finish(self, function: int) -> list[Frame]:
        """Return the frames that are complete if no more bytes come; called after the timeout."""

    def take_rest(self) -> bytes:
        """Return the received bytes that are in no complete frame. On RTU and ASCII they are then forgotten."""


class MbapSearch:
    """Finds MBAP frames in a TCP stream. Interface: `FrameSearch`; the argument ``function`` is not used."""

    def __init__(self) -> None:
        self._receiver = MbapReceiver()
        self._broken = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Take received bytes, and return the frames that are now complete."""
        found = []
        for one in self._receiver.receive(data):
            if one.kind is FrameKind.BROKEN:
                self._broken = one.pdu
            else:
                raw = HEAD.pack(one.transaction, one.protocol, len(one.pdu) + 1, one.unit) + one.pdu
                found.append(Frame(one.unit, one.pdu, raw, one.transaction, one.protocol))
        return found

    def finish(self, function: int) -> list[Frame]:
        """Return an empty list: an unfinished MBAP frame does not count as a frame."""
        return []

    def take_rest(self) -> bytes:
        """Return the bytes that broke the stream; if none did, the bytes of an unfinished frame.

        They are kept: after a broken stream no frame can follow, and an unfinished frame may still be completed.
        """
        return self._broken or self._receiver.unfinished


class RtuSearch:
    """Finds RTU frames in the bytes of a line: sections whose CRC is right. Interface: `FrameSearch`."""

    def __init__(self) -> None:
        self._kept = b""
        self._junk = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Take received bytes, and return the frames that are now complete.

        A frame behind other bytes is found only if its function code is ``function``, or that of an exception to it.
        """
        self._kept += data
        return self._found(function, is_over=False)

    def finish(self, function: int) -> list[Frame]:
        """Return the frames with a right CRC that are shorter than they announce; called after the timeout."""
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
        """Return the bytes that are in no frame, in the order received, and forget them."""
        rest, self._kept, self._junk = self._junk + self._kept, b"", b""
        return rest

    def _next(self, function: int, *, is_over: bool) -> tuple[int, int] | None:
        """Return the offsets (start, end) of the next frame in the kept bytes; None if there is none yet.

        The length that a reply announces is tried before all others: in one frame of 256 the last byte of the CRC is 0,
        and then the CRC is right without this byte too. ``is_over``: no more bytes will come.
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
    """Finds ASCII frames in the characters of a line: from colon to CR LF, with a right LRC.

    Interface: `FrameSearch`; the argument ``function`` is not used.
    """

    def __init__(self) -> None:
        self._kept = b""
        self._junk = b""

    def receive(self, data: bytes, function: int) -> list[Frame]:
        """Take received characters, and return the frames that are now complete."""
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
        """Return an empty list: an unfinished ASCII frame does not count as a frame."""
        return []

    def take_rest(self) -> bytes:
        """Return the characters that are in no frame, and forget them."""
        rest, self._kept, self._junk = self._junk + self._kept, b"", b""
        return rest


_ASCII_FRAME: Final = re.compile(rb":((?:[0-9A-Fa-f]{2})+)\r\n")

_Damager = Callable[[bytes], bytes]


def _with_length(length: int) -> _Damager:
    return lambda frame: frame[:4] + length.to_bytes(2, "big") + frame[6:]


def _with_crc(body: bytes) -> bytes:
    return body + crc_bytes(body)


def _ascii_damaged(change: _Damager) -> _Damager:
    """Return a function that damages an ASCII frame: it applies ``change`` to the hexadecimal digits, LRC included.

    The colon and the CR LF stay.
    """
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
    """Return the damages that exist for a framing: ``mbap``, ``rtu`` or ``ascii``.

    Each has a function that takes a whole correct frame and returns the damaged bytes.
    """
    return {"mbap": _MBAP, "rtu": _RTU, "ascii": _ASCII}[framing]


def encode_frame(framing: str, unit: int, pdu: bytes, transaction: int, damage: FrameDamage | None = None) -> bytes:
    """Return the frame of a PDU, damaged if ``damage`` is given.

    Args:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        unit: unit identifier.
        pdu: the PDU; it need not be valid.
        transaction: transaction identifier; not used by RTU and ASCII.
        damage: one of `damages_of` this framing; None for a correct frame.
    """
    if framing == "mbap":
        frame = encode_mbap(transaction, unit, pdu)
    else:
        frame = encode_rtu(unit, pdu) if framing == "rtu" else encode_ascii(unit, pdu)
    return frame if damage is None else damages_of(framing)[damage](frame)


def new_search(framing: str) -> FrameSearch:
    """Return a new search for the frames of one connection or line; ``framing`` is ``mbap``, ``rtu`` or ``ascii``."""
    kinds: Mapping[str, Callable[[], FrameSearch]] = {"mbap": MbapSearch, "rtu": RtuSearch, "ascii": AsciiSearch}
    return kinds[framing]()
