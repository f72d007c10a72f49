"""Checks of diagnostics (function 08) and of function codes that do not exist.

Knows PDUs. The check that clears the counters of a device is of the level disruptive, all others of the level diag.
"""

from typing import Final

from ..check import Accepts, Ask, Check, Level, Target
from .shorthand import MUST, SHOULD, check, pdu, refused, refused_or_silent, reply_or

_COUNTERS: Final = {
    0x0B: "messages on the bus",
    0x0C: "communication errors",
    0x0D: "exceptions",
    0x0E: "messages to it",
    0x0F: "messages without answer",
    0x10: "negative acknowledgements",
    0x11: "busy replies",
    0x12: "overruns",
}
_UNKNOWN: Final = (25, 42, 64, 73, 99, 111, 127)
"""Function codes that no specification assigns and that are not user-defined (65 to 72, 100 to 110)."""
_OLD: Final = (9, 10, 13, 14, 18, 19)
"""Function codes that old controllers used for programming: reserved, so a device may know or refuse them."""


def diagnostic_checks(target: Target) -> list[Check]:
    """Return the checks of diagnostics (function 08) and of functions that do not exist."""
    return [*_of_08(target), *_of_unknown()]


def _of_08(target: Target) -> list[Check]:
    def one(
        what: str,
        clause: str,
        says: str,
        *steps: Ask,
        opens: bool = False,
        should: bool = False,
        level: Level = Level.DIAG,
    ) -> Check:
        return check(
            f"fc08-{what}",
            clause,
            says,
            *steps,
            function=8,
            opens=opens,
            level=level,
            strength=SHOULD if should else MUST,
        )

    def echoed(data: bytes) -> Ask:
        return Ask(pdu(8, 0, data), Accepts(reply=True, exact=pdu(8, 0, data)))

    checks = [
        one("echo", "S17", "echoes A5 5A (sub-function 00)", echoed(b"\xa5\x5a"), opens=True),
        one("echo-0", "S17", "echoes 00 00", echoed(bytes(2))),
        one("echo-ffff", "S17", "echoes FF FF", echoed(b"\xff\xff")),
        one(
            "register",
            "S17",
            "answers with its diagnostic register (sub-function 02), or 03",
            Ask(pdu(8, 2, 0), reply_or(1, 3)),
        ),
        one("unknown", "S17", "refuses the unknown sub-function 99 with 01 or 03", Ask(pdu(8, 0x63, 0), refused(1, 3))),
        one(
            "cut",
            "S17",
            "does not execute a request whose sub-function is cut: 03, or silence",
            Ask(pdu(8, b"\x00"), refused_or_silent(3)),
            should=True,
        ),
    ]
    for number, what in _COUNTERS.items():
        checks.append(
            one(
                f"counter-{number:02x}",
                "S16",
                f"answers with its counter of {what} (sub-function {number:02X}), or 01 or 03",
                Ask(pdu(8, number, 0), reply_or(1, 3)),
            )
        )
        checks.append(
            one(
                f"counter-{number:02x}-data",
                "S17",
                f"refuses sub-function {number:02X} with data other than 0: 03, or 01",
                Ask(pdu(8, number, 1), refused(1, 3)),
                should=True,
            )
        )
    checks.append(
        one(
            "clear",
            "S17",
            "clears its counters (sub-function 0A), or 01 or 03",
            Ask(pdu(8, 0x0A, 0), Accepts(reply=True, exceptions=frozenset({1, 3}))),
            level=Level.DISRUPTIVE,
        )
    )
    return checks


def _of_unknown() -> list[Check]:
    def unknown(code: int, what: str, says: str, request: bytes, accepts: Accepts) -> Check:
        return check(f"unknown-{code}{what}", "A2", says, Ask(request, accepts), level=Level.DIAG)

    checks = [unknown(0, "", "refuses function 0 with 80 01", pdu(0, 0, 1), refused(1))]
    checks += [
        unknown(code, "", f"refuses function {code}, which does not exist, with 01", pdu(code, 0, 1), refused(1))
        for code in _UNKNOWN
    ]
    checks += [
        unknown(
            code,
            "",
            f"refuses function {code}, which is reserved, with 01, or knows it",
            pdu(code, 0, 1),
            reply_or(1, 2, 3),
        )
        for code in _OLD
    ]
    checks += [
        unknown(64, "-alone", "refuses function 64 without data with 01", pdu(64), refused(1)),
        unknown(64, "-longest", "refuses function 64 with 252 bytes of data with 01", pdu(64, bytes(252)), refused(1)),
    ]
    for code in (0x80, 0x83, 0xFF):
        checks.append(
            check(
                f"unknown-{code}",
                "A2",
                f"does not execute function {code}, which no request can have",
                Ask(pdu(code, 0, 1), refused_or_silent(1)),
                level=Level.DIAG,
                strength=SHOULD,
            )
        )
    return checks
