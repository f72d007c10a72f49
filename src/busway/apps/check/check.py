"""What a check of a device is, and its result: plain data.

Knows PDUs as bytes and the words of reports; knows no connection, no framing and no time.

1. A check belongs to one clause and has one level. It is a must only if the clause is one.
2. Its steps say what is sent and which answers are accepted. Any other answer fails the check; if the check is a
   should, it is only a warning.
3. A basic check judges one facet of every reply, such as its transaction identifier. The other checks rely on the basic
   ones, so that one defect of a device fails one check and not all.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Final

from ...codes import Table


class Level(IntEnum):
    """What a check may do to a device. A run up to a level includes the checks of all lower levels."""

    READ = 0
    """The check sends undamaged requests that only read, also invalid ones that the device has to refuse.

    Some of them go to other units, and on a serial line to all units.
    """
    DIAG = 1
    """The check may also send diagnostics, unknown function codes, damaged frames, broken streams and TLS handshakes
    that the device must refuse."""
    WRITE = 2
    """The check may also write to the scratch items: the registers and coils that the user has named for this.

    Invalid writes are among its requests; they, too, name scratch items only.
    """
    DISRUPTIVE = 3
    """The check may also reset counters, write to all units of a line by broadcast, or write beyond scratch items.

    A broadcast writes to the addresses of the scratch items; what it changes in other units is not restored. A correct
    device refuses a write beyond the scratch items; a faulty device that executes it changes other items.
    """


class Strength(Enum):
    """How strongly the specifications ask for what a check tests: must or should. A failed should is only a warning."""

    MUST = "must"
    SHOULD = "should"


class Outcome(Enum):
    """The outcome of a check; the value is the word that reports show.

    Attributes:
        PASSED: the device does what the check asks for.
        FAILED: the device does not, and the check is a must.
        WARNED: the device does not, and the check is a should.
        NOT_OFFERED: the device does not have the function that the check is about: it answers exception 01.
        UNDECIDED: the check could not be made, for example because a check that it relies on has failed.
        ABORTED: the device stopped answering during this check or an earlier one.
    """

    PASSED = "pass"
    FAILED = "fail"
    WARNED = "warn"
    NOT_OFFERED = "not offered"
    UNDECIDED = "undecided"
    ABORTED = "aborted"


class Facet(Enum):
    """Parts of an exchange that can be wrong independently of each other; every fault belongs to one of them.

    The list says when each part is right.

    Attributes:
        ANSWERED: a reply came in time, or silence where the check accepts silence.
        CLEAN: nothing but the reply came: no other bytes, no second reply, no echo of the request.
        TRANSACTION: the reply has the transaction identifier of the request.
        PROTOCOL: the protocol identifier of the reply is 0.
        UNIT: the unit identifier of the reply is that of the request; any is right after a request to 0 or 255 on TCP.
        FORM: the reply is a whole frame, and its function code, length and counts fit the request.
        CONTENT: the reply is one that the check accepts.
    """

    ANSWERED = "answered"
    CLEAN = "clean"
    TRANSACTION = "transaction"
    PROTOCOL = "protocol"
    UNIT = "unit"
    FORM = "form"
    CONTENT = "content"


class FrameDamage(Enum):
    """Ways to damage the frame of a request on purpose; the value describes the damage in reports."""

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
    """Ways to change a TLS handshake on purpose, so that a secure device must refuse the client or its request.

    The value describes the change in reports: "by TLS 1.0", "with an expired certificate".
    """

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


_ANY_EXCEPTION: Final = 255
"""From this number of accepted exception codes on, `Accepts` is described as "any exception", without the codes."""


@dataclass(frozen=True, slots=True)
class Accepts:
    """What a device may do after one request; anything else is a fault. ``str()`` describes it in words.

    Attributes:
        reply: whether a normal reply is accepted. Its length is compared with the request if the request is valid.
        exact: the only PDU that a normal reply may have; None for any.
        exceptions: the exception codes that are accepted in an exception reply.
        silence: whether the device may leave the request unanswered.
        closed: whether the device may close the connection instead of answering.
        wrong_with: function that takes the PDU of a normal reply and returns what is wrong with it, empty if nothing
            is; None for no further test.
    """

    reply: bool = False
    exact: bytes | None = None
    exceptions: frozenset[int] = frozenset()
    silence: bool = False
    closed: bool = False
    wrong_with: Callable[[bytes], str] | None = None

    def __str__(self) -> str:
        codes = " or ".join(f"{code:02X}" for code in sorted(self.exceptions))
        exception = "any exception" if len(self.exceptions) >= _ANY_EXCEPTION else f"exception {codes}"
        words = [
            "a reply" if self.reply and self.exact is None else "",
            f"the reply {self.exact.hex(' ')}" if self.exact is not None else "",
            exception if codes else "",
            "silence" if self.silence else "",
            "a closed connection" if self.closed else "",
        ]
        return ", or ".join(word for word in words if word)


@dataclass(frozen=True, slots=True)
class Ask:
    """Step of a check: send one request, and judge what comes back.

    Attributes:
        pdu: the PDU of the request; it need not be valid.
        accepts: the accepted answers.
        unit: unit identifier of the request; None for the unit that is checked.
        transaction: transaction identifier of the request; None for the next number of the connection.
        damage: how the frame is damaged; None for a correct frame.
        pieces: offsets in the frame, ascending, at which it is cut; the pieces are sent one after the other. Empty for
            no cut.
    """

    pdu: bytes
    accepts: Accepts
    unit: int | None = None
    transaction: int | None = None
    damage: FrameDamage | None = None
    pieces: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Together:
    """Step of a check: send several requests in one write (Modbus TCP only).

    Each of them must be answered, in any order, with a normal reply or exception 06.
    """

    pdus: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class Idle:
    """Step of a check: send nothing for the idle time of the run (`Pace.idle`)."""


@dataclass(frozen=True, slots=True)
class Reopen:
    """Step of a check: close the connection and open a new one; a serial port stays open."""


@dataclass(frozen=True, slots=True)
class BesideIt:
    """Step of a check: send a request over a second connection while the first one stays open.

    Attributes:
        ask: the request, and the accepted answers.
        change: how the TLS handshake of the second connection is changed; None for a correct connection.
    """

    ask: Ask
    change: TlsChange | None = None


@dataclass(frozen=True, slots=True)
class CutOff:
    """Step of a check: send only the first ``size`` bytes of the frame with this PDU, and close the connection."""

    pdu: bytes
    size: int


CheckStep = Ask | Together | Idle | Reopen | BesideIt | CutOff


@dataclass(frozen=True, slots=True)
class Check:
    """One check: something that a device has to do, and the steps that show whether it does.

    Attributes:
        id: unique name of the check.
        clause: the clause of the specifications that asks for it, a key of `CLAUSES`.
        says: what a correct device does, as a sentence without subject.
        word: whether the check is a must or a should.
        level: what the check may do to the device.
        steps: what is sent, and which answers are accepted.
        facet: for a basic check, the only facet of the replies that it judges; None for other checks.
        function: the function code that the check is about, which a device need not have; None for none.
        opens: True if the check shows whether the device has ``function`` at all. If it fails, or the device answers
            01, the later checks of this function are not made, nor others that need it.
    """

    id: str
    clause: str
    says: str
    word: Strength
    level: Level
    steps: tuple[CheckStep, ...]
    facet: Facet | None = None
    function: int | None = None
    opens: bool = False

    @property
    def requests(self) -> Iterator[bytes]:
        """Iterator over the PDUs that the steps `Ask` and `Together` of the check send, in order."""
        for step in self.steps:
            if isinstance(step, Ask):
                yield step.pdu
            elif isinstance(step, Together):
                yield from step.pdus

    @property
    def writes(self) -> bool:
        """Whether one of `requests` has a function code that writes, so that the scratch items must be saved first."""
        return any(pdu[0] in _WRITING for pdu in self.requests)


_WRITING: Final = frozenset({5, 6, 15, 16, 22, 23})


@dataclass(frozen=True, slots=True)
class Items:
    """Consecutive registers or bits of one table: the 0-based address of the first, and their number."""

    table: Table
    address: int
    count: int


@dataclass(frozen=True, slots=True)
class Target:
    """The device to be checked: how it is reached, and which items checks may read and write.

    Attributes:
        framing: ``mbap``, ``rtu`` or ``ascii``.
        has_connections: True for a network, where a connection can be closed and made again; False for a serial port.
        unit: identifier of the unit that is checked.
        probe: one register or bit that can be read at any time; reading it shows that the device still works.
        registers: scratch registers, which checks may write; None for none.
        coils: scratch coils, which checks may write; None for none.
        is_secure: whether the device is reached over TLS.
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
    """Bytes that a check sent or received, or an event such as the end of the connection; shown in reports.

    Attributes:
        sent: True for bytes sent to the device and for what the check did, False for what came from the device.
        data: the bytes; empty for an event.
        words: the meaning of the bytes, from the dissector; for an event, what happened.
    """

    sent: bool
    data: bytes
    words: str


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The result of one check.

    Attributes:
        check: the check.
        outcome: its outcome.
        reason: why it did not pass, in one sentence; empty if it passed.
        evidence: what was sent and received, in order.
    """

    check: Check
    outcome: Outcome
    reason: str = ""
    evidence: tuple[Evidence, ...] = field(default=())
