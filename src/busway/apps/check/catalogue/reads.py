"""Checks of the functions that read: 01 to 04, 07, 11, 12, 17, 20, 24 and 43.

Knows PDUs. Which items a device has is not known, so exception 02 (no such address) is accepted for valid reads, except
of the probe.
"""

from dataclasses import dataclass
from typing import Final

from ....codes import Table
from ..check import Accepts, Ask, Check, Target
from .shorthand import MUST, SHOULD, check, pdu, refused, refused_or_silent, reply_or

_BEYOND: Final = 0xFFFF


@dataclass(frozen=True, slots=True)
class _Read:
    """A function that reads one table: function code, clause of its checks, and the table.

    ``most`` is the largest count of one request, ``name`` what the items are called in sentences.
    """

    code: int
    clause: str
    table: Table
    most: int
    name: str


_READS: Final = (
    _Read(1, "A9", Table.COILS, 2000, "coils"),
    _Read(2, "A9", Table.DISCRETE_INPUTS, 2000, "discrete inputs"),
    _Read(3, "A10", Table.HOLDING_REGISTERS, 125, "holding registers"),
    _Read(4, "A10", Table.INPUT_REGISTERS, 125, "input registers"),
)


def read_checks(target: Target) -> list[Check]:
    """Return the checks of the functions that read: 01 to 04, 07, 11, 12, 17, 20, 24 and 43."""
    checks = [one for read in _READS for one in _of_table(read, target)]
    checks += _of_status()
    checks += _of_files()
    checks += _of_identification()
    return checks


def _of_table(read: _Read, target: Target) -> list[Check]:
    code, at = read.code, target.probe.address
    own = read.table is target.probe.table
    name = f"fc{code:02}"
    may_refuse = reply_or() if own else reply_or(2)

    def one(
        what: str, says: str, *steps: Ask, clause: str = read.clause, strength: object = MUST, opens: bool = False
    ) -> Check:
        return check(
            f"{name}-{what}",
            clause,
            says,
            *steps,
            function=code,
            opens=opens,
            strength=SHOULD if strength is SHOULD else MUST,
        )

    bits = code <= 2
    checks = [
        one(
            "answers", f"answers a read of one of its {read.name}, or 02", Ask(pdu(code, at, 1), may_refuse), opens=True
        ),
        one("count-0", "refuses a count of 0 with 03", Ask(pdu(code, at, 0), refused(3)), clause="A7"),
        one("count-over", f"refuses a count of {read.most + 1} with 03", Ask(pdu(code, 0, read.most + 1), refused(3))),
        one("count-ffff", "refuses a count of 65535 with 03", Ask(pdu(code, 0, 0xFFFF), refused(3))),
        one(
            "count-most",
            f"allows a count of {read.most}: answers, or 02 where so many do not exist",
            Ask(pdu(code, at, read.most) if at + read.most <= 0x10000 else pdu(code, 0, read.most), reply_or(2)),
        ),
        one(
            "count-before-address",
            "judges the count before the address: 03",
            Ask(pdu(code, _BEYOND, 0), refused(3)),
            clause="A7",
        ),
        one(
            "beyond-end",
            "refuses a range that ends beyond 65535 with 02",
            Ask(pdu(code, _BEYOND, 2), refused(2)),
            clause="A7",
        ),
        one("last-item", "answers a read of item 65535, or 02", Ask(pdu(code, _BEYOND, 1), reply_or(2)), clause="A4"),
        one(
            "cut",
            "does not execute a request whose count is missing: 03, or silence",
            Ask(pdu(code, at), refused_or_silent(3)),
            strength=SHOULD,
            clause="A7",
        ),
        one(
            "code-alone",
            "does not execute a request that is its function code alone: 03, or silence",
            Ask(pdu(code), refused_or_silent(3)),
            strength=SHOULD,
            clause="A7",
        ),
        one(
            "byte-too-many",
            "does not execute a request with a byte too many: 03, or silence",
            Ask(pdu(code, at, 1, b"\x55"), refused_or_silent(3)),
            strength=SHOULD,
            clause="A7",
        ),
    ]
    if own and bits:
        checks.append(
            one(
                "unused-bits",
                "leaves the unused bits of the last byte 0",
                Ask(pdu(code, at, 1), Accepts(reply=True, wrong_with=_unused_bits)),
            )
        )
    return checks


def _unused_bits(reply: bytes) -> str:
    return f"the byte is {reply[2]:02X}, where only its lowest bit was asked for" if reply[2] > 1 else ""


_STATUS: Final = (
    (7, "exception status"),
    (11, "the event counter"),
    (12, "the event log"),
    (17, "its server id"),
)


def _of_status() -> list[Check]:
    checks = []
    for code, what in _STATUS:
        checks += [
            check(
                f"fc{code:02}-answers",
                "A22",
                f"answers a read of {what}",
                Ask(pdu(code), reply_or()),
                function=code,
                opens=True,
            ),
            check(
                f"fc{code:02}-byte-too-many",
                "A22",
                "does not execute a request with a byte too many: 03, or silence",
                Ask(pdu(code, b"\x55"), refused_or_silent(3)),
                function=code,
                strength=SHOULD,
            ),
        ]
    checks += [
        check(
            "fc12-log-form",
            "A23",
            "answers with a log of at most 64 events",
            Ask(pdu(12), Accepts(reply=True, wrong_with=_wrong_log)),
            function=12,
        ),
        check(
            "fc11-status",
            "A23",
            "answers with status 0000 or FFFF",
            Ask(pdu(11), Accepts(reply=True, wrong_with=_wrong_status)),
            function=11,
        ),
        check(
            "fc24-answers",
            "A22",
            "answers a read of a queue, or 02, or 03 where it is too long",
            Ask(pdu(24, 0), reply_or(2, 3)),
            function=24,
            opens=True,
        ),
        check(
            "fc24-cut",
            "A22",
            "does not execute a request whose address is cut: 03, or silence",
            Ask(pdu(24, b"\x00"), refused_or_silent(3)),
            function=24,
            strength=SHOULD,
        ),
        check(
            "fc24-byte-too-many",
            "A22",
            "does not execute a request with a byte too many: 03, or silence",
            Ask(pdu(24, 0, b"\x55"), refused_or_silent(3)),
            function=24,
            strength=SHOULD,
        ),
    ]
    return checks


def _wrong_log(reply: bytes) -> str:
    return f"the log has {len(reply) - 8} events" if len(reply) - 8 > 64 else ""


def _wrong_status(reply: bytes) -> str:
    return "" if reply[1:3] in (b"\x00\x00", b"\xff\xff") else f"the status is {reply[1:3].hex(' ')}"


def _of_files() -> list[Check]:
    group = b"\x06" + bytes((0, 1, 0, 0, 0, 1))

    def one(what: str, says: str, request: bytes, accepts: Accepts, **more: bool) -> Check:
        return check(f"fc20-{what}", "A15", says, Ask(request, accepts), function=20, opens=more.get("opens", False))

    return [
        one(
            "answers",
            "answers a read of file 1, or refuses it with 02, 03, 04 or 08",
            pdu(20, b"\x07", group),
            reply_or(2, 3, 4, 8),
            opens=True,
        ),
        one("no-group", "refuses a byte count of 0 with 03", pdu(20, b"\x00"), refused(3)),
        one(
            "byte-count-under",
            "refuses a byte count below that of one group with 03",
            pdu(20, b"\x06", group[:-1]),
            refused(3),
        ),
        one("byte-count-over", "refuses a byte count of F6 with 03", pdu(20, b"\xf6", group * 35, b"\x06"), refused(3)),
        one(
            "byte-count-wrong",
            "refuses a byte count that is not that of the request with 03",
            pdu(20, b"\x0e", group),
            refused(3),
        ),
        one("file-0", "refuses file 0 with 02 or 03", pdu(20, b"\x07\x06", 0, 0, 1), refused(2, 3)),
        one("record-10000", "refuses record 10000 with 02 or 03", pdu(20, b"\x07\x06", 1, 10_000, 1), refused(2, 3)),
        one("type-5", "refuses reference type 5 with 02 or 03", pdu(20, b"\x07\x05", 1, 0, 1), refused(2, 3)),
        one(
            "reply-too-long",
            "refuses what does not fit into one reply with 02 or 03",
            pdu(20, b"\x07\x06", 1, 0, 200),
            refused(2, 3),
        ),
    ]


def _of_identification() -> list[Check]:
    def one(
        what: str, says: str, request: bytes, accepts: Accepts, *, opens: bool = False, should: bool = False
    ) -> Check:
        return check(
            f"fc43-{what}",
            "A19",
            says,
            Ask(request, accepts),
            function=43,
            opens=opens,
            strength=SHOULD if should else MUST,
        )

    def stream(code: int, first: int = 0) -> bytes:
        return bytes((43, 14, code, first))

    return [
        one("basic", "answers with its basic identification", stream(1), reply_or(), opens=True),
        one(
            "basic-objects",
            "has the objects 0, 1 and 2 in its basic identification",
            stream(1),
            Accepts(reply=True, wrong_with=_wrong_objects),
        ),
        one(
            "conformity",
            "says a conformity level of 01 to 03 or 81 to 83",
            stream(1),
            Accepts(reply=True, wrong_with=_wrong_conformity),
        ),
        one("regular", "answers to the regular level, with its own level", stream(2), reply_or()),
        one("extended", "answers to the extended level, with its own level", stream(3), reply_or()),
        one("object-0", "answers object 0 alone, or 03 where it has no individual access", stream(4), reply_or(3)),
        one(
            "object-unknown",
            "refuses an object that it has not with 02, or 03 without individual access",
            stream(4, 0x7F),
            refused(2, 3),
        ),
        one(
            "stream-restarts",
            "begins with object 0 where the stream begins at an unknown one",
            stream(1, 0x7F),
            Accepts(reply=True, wrong_with=_wrong_restart),
        ),
        one("code-0", "refuses the read code 0 with 03", stream(0), refused(3)),
        one("code-5", "refuses the read code 5 with 03", stream(5), refused(3)),
        one(
            "cut",
            "does not execute a request whose object is missing: 03, or silence",
            bytes((43, 14, 1)),
            refused_or_silent(3),
            should=True,
        ),
        one(
            "byte-too-many",
            "does not execute a request with a byte too many: 03, or silence",
            stream(1) + b"\x55",
            refused_or_silent(3),
            should=True,
        ),
        one(
            "type-unknown",
            "refuses the unknown type 63 with 01 or 03",
            bytes((43, 0x63, 1, 0)),
            Accepts(exceptions=frozenset({1, 3})),
        ),
    ]


def _objects(reply: bytes) -> list[int]:
    at, found = 7, []
    while at + 1 < len(reply):
        found.append(reply[at])
        at += 2 + reply[at + 1]
    return found


def _wrong_objects(reply: bytes) -> str:
    missing = {0, 1, 2} - set(_objects(reply))
    more_follows = reply[4] == 0xFF
    return f"the object {min(missing)} is missing" if missing and not more_follows else ""


def _wrong_conformity(reply: bytes) -> str:
    return "" if reply[3] & 0x7F in (1, 2, 3) else f"the conformity level is {reply[3]:02X}"


def _wrong_restart(reply: bytes) -> str:
    return "" if _objects(reply)[:1] == [0] else "the stream does not begin with object 0"
