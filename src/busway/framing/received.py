"""What receivers of serial lines return (frames, damaged bytes), and the interfaces of the receivers of all framings.

Knows values; knows no framing.

1. A receiver gives good frames and damaged chunks. "Need more" is the empty list, and nothing is fatal: a serial line
   has no end, the next frame may be good.
2. A damaged chunk is one disturbance, however long: it is one count of the communication errors (appendix A).
3. Where a frame's direction cannot be told from its bytes, its ``direction`` says so.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeVar


class Direction(Enum):
    """Whether a frame is a request or a reply."""

    REQUEST = "request"
    REPLY = "reply"
    UNKNOWN = "unknown"


class Damage(Enum):
    """Reasons why received bytes are no valid frame."""

    TOO_SHORT = "too few bytes for a frame"
    TOO_LONG = "more bytes than a frame has"
    INCOMPLETE = "it ends before its length says"
    CHECKSUM = "no frame whose check fits"
    GAP = "a gap inside the frame"
    CHARACTER = "a parity or framing error"
    OVERRUN = "characters were lost"
    RESTARTED = "a new frame began inside it"
    NOT_HEXADECIMAL = "a character that is no hexadecimal digit"
    NO_DELIMITER = "CR without the end delimiter"


@dataclass(frozen=True, slots=True)
class SerialFrame:
    """A received frame of a serial line whose CRC or LRC is right.

    Attributes:
        unit: address byte, 0…255.
        pdu: function code and data, 1…253 bytes and, where a peer breaks the limit of 253, never more than 254.
        raw: the bytes as they came: address to CRC, or ``:`` to the delimiter (without parity bits).
        direction: request or reply, judged from the frames before it; a hint, not a fact.
        began, ended: when its first byte began and its last one ended, as far as the reads tell.
        recovered: whether it was found inside a damaged chunk. Servers never get such a frame.
    """

    unit: int
    pdu: bytes
    raw: bytes
    direction: Direction
    began: float
    ended: float
    recovered: bool = False


@dataclass(frozen=True, slots=True)
class Damaged:
    """Received bytes of a serial line that are no valid frame, and why.

    Attributes:
        raw: the bytes, at most the first 256 (RTU) or 513 (ASCII) of them.
        reason: what is wrong with them.
        size: how many there were.
        overrun: whether the port lost characters: this counts as 8 and 2 (Serial Line V1.02, appendix A).
        began, ended: when the first of them began and the last one ended.
    """

    raw: bytes
    reason: Damage
    size: int
    began: float
    ended: float
    overrun: bool = False


Received = SerialFrame | Damaged

Found = TypeVar("Found")


class Receiver(Protocol[Found]):
    """Interface of the receivers of all framings: bytes and times in, complete frames out."""

    def receive(self, data: bytes | bytearray, now: float) -> list[Found]:
        """Return the frames that ``data``, read at ``now``, completes, in order."""

    def tick(self, now: float) -> list[Found]:
        """Return the frames that the silence until ``now`` completes."""

    def deadline(self) -> float | None:
        """The time at which `tick` will have something to decide; None while only bytes can change anything."""


class SerialReceiver(Receiver[Received], Protocol):
    """Interface of the receivers of serial lines: RTU, strict RTU and ASCII."""

    def expect(self, unit: int, function: int, size: int) -> None:
        """Prepare for the reply to a request of this master: from ``unit``, ``size`` bytes long (or
        `UNKNOWN_LENGTH`).
        """

    def expect_nothing(self) -> None:
        """Stop expecting a reply, because the master no longer waits for one."""

    def sent(self, raw: bytes, ends: float) -> None:
        """Tell the receiver that this station sends bytes until ``ends``."""

    def damaged(self, now: float, *, overrun: bool = False) -> list[Received]:
        """Tell the receiver that the port reported an error at this position of the received bytes (S14)."""

    def flush(self, now: float) -> list[Received]:
        """Return what can be decided about unfinished bytes now, as after a long silence."""

    def clear_at(self) -> float:
        """Return the earliest time at which a frame may be sent on the line."""
