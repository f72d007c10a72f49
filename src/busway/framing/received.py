"""What receivers of serial lines return (frames, damaged bytes), and the interfaces of the receivers of all framings.

Knows values; knows no framing.

1. A receiver returns good frames and damaged chunks; an empty list means that more bytes are needed. No damage is
   fatal: a serial line has no end, and the next frame may be good.
2. A damaged chunk is one disturbance, however long, and counts as one communication error (Serial Line V1.02,
   appendix A).
3. The direction of a frame is the likelier one of those that its length fits. It is `Direction.UNKNOWN` if the length
   fits neither, and the frames before it do not tell it.
"""

from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeVar

from .echo import EchoFilter


class Direction(Enum):
    """Whether a frame is a request or a reply; ``UNKNOWN`` if that cannot be told."""

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
        pdu: function code and data, 1…253 bytes.
        raw: the bytes as received: address to CRC, or ``:`` to the delimiter (without parity bits).
        direction: request or reply, guessed from its length and the frames before it, or UNKNOWN.
        began, ended: when its first byte began and its last one ended on the line, in seconds, estimated from the
            reads.
        recovered: whether it was found inside damaged bytes; never True in the receiver of a server.
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
        size: how many bytes there were; 0 if the port reported an error and gave no bytes.
        began, ended: when the first byte began and the last one ended, in seconds.
        overrun: whether the port lost characters; then diagnostic counter 8 counts too, besides counter 2 (Serial Line
            V1.02, appendix A).
    """

    raw: bytes
    reason: Damage
    size: int
    began: float
    ended: float
    overrun: bool = False


FrameOrDamage = SerialFrame | Damaged

Found = TypeVar("Found")


class Receiver(Protocol[Found]):
    """Interface of the receivers of all framings: bytes and times in, complete frames out.

    Times are seconds of the caller's clock.
    """

    def receive(self, data: bytes | bytearray, now: float) -> list[Found]:
        """Return the frames that ``data``, read at ``now``, completes, in order; empty if more bytes are needed.

        Receivers of serial lines return damaged bytes too, as `Damaged`.
        """

    def tick(self, now: float) -> list[Found]:
        """Return the frames, and on serial lines damaged bytes, that the silence until ``now`` completes, in order."""

    def deadline(self) -> float | None:
        """Return the time, in seconds, at which to call `tick`; None if only further bytes can complete a frame."""


class SerialReceiver(Receiver[FrameOrDamage], Protocol):
    """Interface of the receivers of serial lines: RTU, strict RTU and ASCII."""

    @property
    def echo(self) -> EchoFilter:
        """The filter that removes the echo of what this station sends."""

    def expect(self, unit: int, function: int, size: int) -> None:
        """Announce the request of this master that is sent next, so that the reply to it is recognised.

        Args:
            unit: unit of the request, 0…255.
            function: its function code, 1…127.
            size: length of the reply's PDU in bytes; `UNKNOWN_LENGTH` if the request does not tell it.
        """

    def expect_nothing(self) -> None:
        """Stop expecting a reply, because the master no longer waits for one."""

    def sent(self, raw: bytes, ends: float) -> None:
        """Tell the receiver that this station sends the bytes ``raw`` until ``ends`` (seconds); an echo is removed."""

    def damaged(self, now: float, *, overrun: bool = False) -> list[FrameOrDamage]:
        """Tell the receiver that the port reported an error after the bytes received so far.

        Returns the frames and damaged bytes that are complete now. The bytes of the disturbance are returned as
        `Damaged` when it ends: now or by a later call.

        Args:
            now: time of the report, in seconds.
            overrun: True for lost characters, False for a parity or framing error.
        """

    def flush(self, now: float) -> list[FrameOrDamage]:
        """Decide about all unfinished bytes without waiting, and return the frames and damaged bytes among them.

        Called at a response timeout, or when closing.
        """

    def clear_at(self) -> float:
        """Return the earliest time, in seconds, at which this station may send a frame on the line."""
