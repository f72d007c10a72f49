"""Puts the segments of one direction of a TCP connection in order, and says which bytes are missing.

Knows sequence numbers (RFC 9293 §3.4) and bytes; knows no address and no Modbus. Nothing is guessed: bytes that the
capture does not have become a `StreamGap` with their number.

1. A stream begins with its SYN, or with the first segment that the capture has: then it *begins in the middle*.
2. Bytes that came before are a retransmission and dropped, also where segments overlap; those that came first stay.
3. A segment beyond the next byte waits for the missing bytes before it. They are missing for good when the peer has
   acknowledged the segment (the peer has them, the capture does not), when more than `MOST_WAITING` bytes or too many
   segments wait, and at the end.
4. A segment more than `FARTHEST` away belongs to another connection with the same addresses: the stream begins anew.
"""

from dataclasses import dataclass
from typing import Final

MOST_WAITING: Final = 32 << 10
"""Most bytes that are kept, for each direction of a connection, until missing bytes before them arrive."""
_MOST_SEGMENTS: Final = 256
FARTHEST: Final = 1 << 24
"""Most bytes between a segment and the next expected byte; beyond, the segment is of another connection.

No window of a Modbus device comes near.
"""


@dataclass(frozen=True, slots=True)
class StreamPiece:
    """Bytes of a stream, in order, with number and time (seconds since 1970) of the packet that contained them."""

    data: bytes
    packet: int
    time: float


@dataclass(frozen=True, slots=True)
class StreamGap:
    """Bytes of a stream that the capture does not have.

    Attributes:
        size: how many bytes are missing; None if unknown, because the stream begins in the middle or begins anew.
        packet, time: number and time (seconds since 1970) of the packet at which the gap was found.
    """

    size: int | None
    packet: int
    time: float


StreamPart = StreamPiece | StreamGap


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A segment that waits for bytes before it.

    ``at`` is the distance of its first byte from the first byte of the stream, ``missing`` the number of bytes at its
    end that were not captured.
    """

    at: int
    data: bytes
    missing: int
    packet: int
    time: float

    @property
    def end(self) -> int:
        return self.at + len(self.data) + self.missing


class StreamAssembler:
    """Puts the segments of one direction of a TCP connection in order.

    Attributes:
        repeated: number of bytes that were received once more, and dropped.
        out_of_order: number of segments that were received while bytes before them were missing.
    """

    __slots__ = ("_acknowledged", "_next", "_size", "_start", "_waiting", "out_of_order", "repeated")

    def __init__(self) -> None:
        self.repeated: int = 0
        self.out_of_order: int = 0
        self._start: int | None = None  # sequence number of the first byte
        self._next = 0  # distances from the first byte, so that nothing wraps
        self._acknowledged = 0
        self._size = 0
        self._waiting: list[_Waiting] = []

    @property
    def has_begun(self) -> bool:
        """Whether the first byte of the stream is known, by a SYN or a segment."""
        return self._start is not None

    def begin(self, sequence: int) -> None:
        """Start the stream at the byte after a SYN with this sequence number; the same SYN again changes nothing.

        With another SYN, segments that still wait for missing bytes are dropped.
        """
        if self._start != (sequence + 1) & 0xFFFF_FFFF:
            self._start, self._next, self._acknowledged = (sequence + 1) & 0xFFFF_FFFF, 0, 0
            self._waiting, self._size = [], 0

    def segment(self, sequence: int, data: bytes, missing: int, packet: int, time: float) -> list[StreamPart]:
        """Add a segment with bytes. Returns the pieces and gaps that are in order now.

        A segment behind missing bytes waits, and is returned by a later call.

        Args:
            sequence: sequence number of its first byte.
            data: its bytes, as far as captured.
            missing: number of bytes behind them that were not captured.
            packet, time: number and time of the packet.
        """
        found: list[StreamPart] = []
        if self._start is None:
            self._start = sequence
            found.append(StreamGap(None, packet, time))
        at = self._distance(sequence)
        if abs(at - self._next) > FARTHEST:
            found += self.finish()
            found.append(StreamGap(None, packet, time))
            self._start, self._next, self._acknowledged, at = sequence, 0, 0, 0
        segment = _Waiting(at, data, missing, packet, time)
        if at > self._next:
            self._wait(segment)
            if self._size > MOST_WAITING or len(self._waiting) > _MOST_SEGMENTS or self._is_acknowledged():
                found += self._skip()
            return found
        self._deliver(segment, found)
        self._drain(found)
        return found

    def acknowledge(self, number: int) -> list[StreamPart]:
        """Process an acknowledgement of the peer. Returns the pieces and gaps that are in order now.

        ``number`` is the sequence number of the next byte that the peer expects. Once a waiting segment is acknowledged
        as a whole, the bytes before it are missing for good. Empty before the stream has begun.
        """
        if self._start is None:
            return []
        at = self._distance(number)
        if self._acknowledged < at <= self._next + FARTHEST:
            self._acknowledged = at
        found: list[StreamPart] = []
        while self._is_acknowledged():
            found += self._skip()
        return found

    def finish(self) -> list[StreamPart]:
        """Return the pieces that still wait for missing bytes, each gap before its piece."""
        found: list[StreamPart] = []
        while self._waiting:
            found += self._skip()
        return found

    # Inside.

    def _distance(self, sequence: int) -> int:
        """Return the distance in bytes of a sequence number from the first byte of the stream.

        Sequence numbers repeat every 2³² bytes; the distance nearest to the next byte is meant.
        """
        assert self._start is not None
        ahead = (sequence - self._start - self._next + (1 << 31)) & 0xFFFF_FFFF
        return self._next + ahead - (1 << 31)

    def _is_acknowledged(self) -> bool:
        return bool(self._waiting) and self._waiting[0].end <= self._acknowledged

    def _wait(self, segment: _Waiting) -> None:
        place = next((index for index, each in enumerate(self._waiting) if each.at > segment.at), len(self._waiting))
        if place and self._waiting[place - 1].at == segment.at and self._waiting[place - 1].end >= segment.end:
            self.repeated += len(segment.data)
            return
        self.out_of_order += 1
        self._waiting.insert(place, segment)
        self._size += len(segment.data)

    def _deliver(self, segment: _Waiting, found: list[StreamPart]) -> None:
        """Append to ``found`` the bytes of a segment that are new, and a gap for its bytes that were not captured.

        The segment begins at the next expected byte or before it.
        """
        known = self._next - segment.at
        fresh = segment.data[known:]
        self.repeated += len(segment.data) - len(fresh)
        if fresh:
            found.append(StreamPiece(fresh, segment.packet, segment.time))
            self._next += len(fresh)
        if segment.end > self._next:
            found.append(StreamGap(segment.end - self._next, segment.packet, segment.time))
            self._next = segment.end

    def _drain(self, found: list[StreamPart]) -> None:
        while self._waiting and self._waiting[0].at <= self._next:
            segment = self._waiting.pop(0)
            self._size -= len(segment.data)
            self._deliver(segment, found)

    def _skip(self) -> list[StreamPart]:
        """Stop waiting for the bytes before the first waiting segment. Returns their gap, and the pieces after it."""
        first = self._waiting[0]
        found: list[StreamPart] = [StreamGap(first.at - self._next, first.packet, first.time)]
        self._next = first.at
        self._drain(found)
        return found
