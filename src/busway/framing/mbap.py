"""MBAP framing: the seven-byte header before a PDU on TCP (Messaging on TCP/IP V1.0b §3.1.3).

Knows headers and streams of them; knows no socket, no transaction table and no function.

1. The header, big-endian: ``transaction``, 2 bytes; ``protocol``, 2 bytes (0); ``length`` of unit and PDU, 2 bytes;
   ``unit``, 1 byte. The PDU follows.
2. The length alone finds the next frame. With a length outside 2…254 the stream is broken, and no further frame can be
   found (Messaging on TCP/IP §4.4.2). The error is reported as soon as the two bytes of the length are there.
3. A frame whose protocol is not 0 is complete but not Modbus: it is skipped and reported, and the stream goes on.
4. How the stream is cut into reads makes no difference.
"""

import struct
from dataclasses import dataclass
from enum import Enum

from ..codes import PDU_LIMIT

HEADER_SIZE = 7
MIN_LENGTH = 2
MAX_LENGTH = 1 + PDU_LIMIT

HEAD = struct.Struct(">HHHB")
"""The MBAP header: transaction, protocol, length, unit."""
HEAD_AND_FUNCTION = struct.Struct(">HHHBB")
"""The header and the function code, unpacked in one step."""


class FrameKind(Enum):
    """What the MBAP receiver found: a valid frame, a frame of another protocol, or that the stream is broken.

    A stream is broken by a length field that no frame can have: the next frame cannot be found.
    """

    FRAME = "frame"
    FOREIGN_PROTOCOL = "foreign protocol"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class MbapFrame:
    """One received frame (ADU) of a TCP stream, or the notice that the stream is broken.

    Attributes:
        kind: a valid frame, a frame of another protocol, or a broken stream.
        transaction: transaction identifier, 0…65535.
        protocol: protocol identifier; 0 for Modbus.
        unit: unit identifier, 0…255; 0 for ``BROKEN``.
        pdu: the PDU, or what another protocol has in its place; for ``BROKEN``, the received bytes from the header with
            the impossible length on.
        reason: for ``BROKEN``, what is wrong; otherwise empty.
    """

    kind: FrameKind
    transaction: int
    protocol: int
    unit: int
    pdu: bytes
    reason: str = ""


def encode_mbap(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return the ADU for a PDU on TCP: the MBAP header, followed by the PDU.

    Args:
        transaction: transaction identifier, 0…65535.
        unit: unit identifier, 0…255.
        pdu: function code and data, 1…253 bytes.
    """
    return HEAD.pack(transaction, 0, 1 + len(pdu), unit) + pdu


def impossible_length(length: int) -> str:
    """Return the error text for a value that the length field of the MBAP header cannot have."""
    return f"length field {length}, where {MIN_LENGTH}…{MAX_LENGTH} can be"


class StreamBuffer:
    """Keeps the beginning of a frame between two reads of a stream, until the rest of it arrives.

    A connection without an unfinished frame keeps nothing, so thousands of idle ones cost no memory. At most the 260
    bytes of a frame are kept.

    Attributes:
        kept: the kept bytes; empty if no frame is unfinished.
    """

    __slots__ = ("kept",)

    def __init__(self) -> None:
        self.kept: bytes = b""

    def join(self, buffer: bytes | bytearray, size: int) -> tuple[bytes | bytearray, int]:
        """Return the kept bytes followed by the first ``size`` bytes of ``buffer``, and the number of these bytes.

        If no bytes are kept, ``buffer`` itself is returned, with ``size``. Afterwards nothing is kept.
        """
        if not self.kept:
            return buffer, size
        whole = self.kept + bytes(buffer[:size])
        self.kept = b""
        return whole, len(whole)

    def keep(self, buffer: bytes | bytearray, at: int, size: int) -> None:
        """Keep ``buffer[at:size]``, the beginning of a frame or no bytes, for the next call of `join`."""
        self.kept = bytes(buffer[at:size])


class MbapReceiver:
    """Receiver of MBAP frames from a TCP stream. After a ``BROKEN`` frame it returns nothing more.

    Attributes:
        broken: whether the stream is broken: a length field was impossible.
    """

    __slots__ = ("_buffer", "broken")

    def __init__(self) -> None:
        self._buffer = StreamBuffer()
        self.broken: bool = False

    @property
    def unfinished(self) -> bytes:
        """The received bytes of a frame that is not complete yet; empty if there is none."""
        return self._buffer.kept

    def receive(self, data: bytes | bytearray, now: float = 0.0) -> list[MbapFrame]:
        """Return all frames that ``data`` completes, in order; empty if more bytes are needed.

        A broken stream gives one frame `FrameKind.BROKEN`, and no more frames after it. ``now`` is ignored: on TCP only
        the length ends a frame.
        """
        frames: list[MbapFrame] = []
        if self.broken:
            return frames
        stream, size = self._buffer.join(data, len(data))
        at = 0
        while size - at >= 6:
            length = stream[at + 4] << 8 | stream[at + 5]
            transaction, protocol = stream[at] << 8 | stream[at + 1], stream[at + 2] << 8 | stream[at + 3]
            if not MIN_LENGTH <= length <= MAX_LENGTH:
                self.broken = True
                rest = bytes(stream[at:size])
                frames.append(MbapFrame(FrameKind.BROKEN, transaction, protocol, 0, rest, impossible_length(length)))
                return frames
            end = at + 6 + length
            if end > size:
                break
            kind = FrameKind.FOREIGN_PROTOCOL if protocol else FrameKind.FRAME
            frames.append(MbapFrame(kind, transaction, protocol, stream[at + 6], bytes(stream[at + 7 : end])))
            at = end
        self._buffer.keep(stream, at, size)
        return frames

    def tick(self, now: float) -> list[MbapFrame]:
        """Return nothing, always: on a TCP stream, silence completes no frame."""
        return []

    def deadline(self) -> float | None:
        """Return None, always: on a TCP stream, time completes no frame."""
        return None
