"""What a check is, and what comes of it: plain data.

Knows PDUs as bytes and the words of reports; knows no connection, no framing and no time.

1. A check belongs to one clause and is of one level. It is a must only if the clause is one.
2. Its steps say what is sent and what may come back. Whatever else comes is a failure, or a warning for a should.
3. A basic check is about one facet of every reply, such as its transaction identifier. The others assume what the basic
   checks have shown, so one defect fails one check and not all.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Final

from ...codes import Table


class Level(IntEnum):
    """What a check may do to a device; each level includes those below it."""

    READ = 0
    """Whole requests that read, also with contents that have to be refused."""
    DIAG = 1
    """Diagnostics, unknown functions, damaged frames and broken streams too."""
    WRITE = 2
    """Writes to the scratch items too."""
    DISRUPTIVE = 3
    """Also what may stop a device, reset its counters, or write beyond the scratch items if it is careless."""


class Strength(Enum):
    """How strongly the documents ask for something."""

    MUST = "must"
    SHOULD = "should"


class Outcome(Enum):
    """What came of a check."""

    PASSED = "pass"
    FAILED = "fail"
    WARNED = "warn"
    NOT_OFFERED = "not offered"
    UNDECIDED = "undecided"
    ABORTED = "aborted"


class Facet(Enum):
    """Parts of an exchange that can be wrong by themselves, in the order in which they are looked at."""

    ANSWERED = "answered"
    CLEAN = "clean"
    TRANSACTION = "transaction"
    PROTOCOL = "protocol"
    UNIT = "unit"
    FORM = "form"
    CONTENT = "content"


class FrameDamage(Enum):
    """How the frame of a request is damaged on purpose."""

    PROTOCOL_1 = "protocol identifier 1"
    PROTOCOL_FFFF = "protocol identifier FFFF"
    LENGTH_0 = "length field 0"
    LENGTH_1 = "length field 1"
    LENGTH_255 = "length field 255"
    LENGTH_FFFF = "length field FFFF"
    LENGTH_SHORT = "length field one less than the frame"
    NO_END = "the end is missing"
    CHECK_FLIPPED = "one bit of the checksum differs"
    CHECK_SWAPPED = "the bytes of the CRC are exchanged"
    CHECK_ZERO = "the checksum is 0"
    CONTENT_FLIPPED = "one bit of the content differs"
    NO_CHECK = "the checksum is missing"
    TOO_LONG = "longer than a frame can be"
    TINY = "too short to be a frame"
    NOT_HEX = "a character is no hexadecimal digit"
    ODD_DIGITS = "one digit is missing"
    NO_COLON = "the colon is missing"
    NO_CR = "CR is missing"
    RESTARTED = "begun twice: a colon interrupts a frame"
    JUNK_BEFORE = "characters of no frame come before it"
    LOWER_CASE = "its digits are in lower case"


class TlsChange(Enum):
    """How a connection differs from the one that a device has to accept, on purpose."""

    PLAIN = "without TLS"
    TLS_1_0 = "by TLS 1.0"
    TLS_1_1 = "by TLS 1.1"
    SHA_1 = "with suites of SHA-1 alone"
    NO_ENCRYPTION = "with suites without encryption alone"
    NO_CERTIFICATE = "without a certificate"
    FOREIGN_CERTIFICATE = "with a certificate of an unknown authority"
    EXPIRED_CERTIFICATE = "with an expired certificate"
    REVOKED_CERTIFICATE = "with a revoked certificate"
    DENIED_ROLE = "with a certificate whose role may not read"
    NO_ROLE = "with a certificate without a role"


@dataclass(frozen=True, slots=True)
class Accepts:
    """What may come back for one request.

    Attributes:
        reply: whether a normal reply may come. Its form is checked against the request where the request is valid.
        exact: the only PDU that a normal reply may have; None for any.
        exceptions: the exception codes that may come.
        silence: whether nothing may come.
        closed: whether the device may close the connection instead.
        wrong_with: says what is wrong with the PDU of a normal reply; an empty text for nothing.
    """

    reply: bool = False
    exact: bytes | None = None
    exceptions: frozenset[int] = frozenset()
    silence: bool = False
    closed: bool = False
    wrong_with: Callable[[bytes], str] | None = None

    def __str__(self) -> str:
        codes = " or ".join(f"{code:02X}" for code in sorted(self.exceptions))
        words = [
            "a reply" if self.reply and self.exact is None else "",
            f"the reply {self.exact.hex(' ')}" if self.exact is not None else "",
            f"exception {codes}" if codes else "",
            "silence" if self.silence else "",
            "a closed connection" if self.closed else "",
        ]
        return ", or ".join(word for word in words if word)


@dataclass(frozen=True, slots=True)
class Ask:
    """Send one request and judge what comes back.

    Attributes:
        pdu: the request.
        accepts: what may come back.
        unit: instead of the unit that is checked.
        transaction: identifier, instead of the next one.
        damage: what is done to its frame.
        pieces: offsets at which the frame is cut; the pieces are sent one after the other.
    """

    pdu: bytes
    accepts: Accepts
    unit: int | None = None
    transaction: int | None = None
    damage: FrameDamage | None = None
    pieces: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Together:
    """Send several requests in one write; each must be answered, in any order, 06 being an answer too."""

    pdus: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class Idle:
    """Send nothing for the idle time of the run."""


@dataclass(frozen=True, slots=True)
class Reopen:
    """Close the connection and make a new one."""


@dataclass(frozen=True, slots=True)
class BesideIt:
    """Ask over a second connection while the first stays open; ``change`` is what differs in its handshake."""

    ask: Ask
    change: TlsChange | None = None


@dataclass(frozen=True, slots=True)
class CutOff:
    """Send the first bytes of a request and close the connection."""

    pdu: bytes
    size: int


Step = Ask | Together | Idle | Reopen | BesideIt | CutOff


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that a device has to do.

    Attributes:
        id: its name, unique.
        clause: the clause that asks for it.
        says: what the device does if it passes.
        word: must or should.
        level: what it may do to the device.
        steps: what is sent, and what may come back.
        facet: for a basic check, the facet of the reply that it is about.
        function: the function that it is about; where the device answers 01, it is not offered.
        opens: whether it shows that the device has the function at all; the function's other checks need it.
    """

    id: str
    clause: str
    says: str
    word: Strength
    level: Level
    steps: tuple[Step, ...]
    facet: Facet | None = None
    function: int | None = None
    opens: bool = False

    @property
    def requests(self) -> Iterator[bytes]:
        """The PDUs that it sends."""
        for step in self.steps:
            if isinstance(step, Ask):
                yield step.pdu
            elif isinstance(step, Together):
                yield from step.pdus

    @property
    def writes(self) -> bool:
        """Whether it writes to the scratch items."""
        return any(pdu[0] in _WRITING for pdu in self.requests)


_WRITING: Final = frozenset({5, 6, 15, 16, 22, 23})


@dataclass(frozen=True, slots=True)
class Items:
    """Consecutive items of one table: the first address, 0-based, and how many."""

    table: Table
    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Target:
    """What the checks are made for.

    Attributes:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        has_connections: whether it can be connected to more than once.
        unit: the unit that is checked.
        probe: one item that can be read at any time.
        registers, coils: items that may be written; None for none.
        is_secure: whether it is reached over TLS.
    """

    framing: str
    has_connections: bool
    unit: int
    probe: Items
    registers: Items | None = None
    coils: Items | None = None
    is_secure: bool = False


@dataclass(frozen=True, slots=True)
class Evidence:
    """Bytes that were sent or received, and what they mean.

    Attributes:
        sent: True for bytes to the device, False for bytes from it.
        data: the bytes; none where an event is told instead.
        words: the dissector's words, or the event.
    """

    sent: bool
    data: bytes
    words: str


@dataclass(frozen=True, slots=True)
class Result:
    """What came of one check.

    Attributes:
        check: the check.
        outcome: what came of it.
        reason: why it did not pass, in one sentence.
        evidence: what was sent and received.
    """

    check: Check
    outcome: Outcome
    reason: str = ""
    evidence: tuple[Evidence, ...] = field(default=())
