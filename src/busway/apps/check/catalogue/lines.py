"""Checks of serial lines: damaged frames, frames for other units, broadcasts.

Knows frames of RTU and ASCII; the requests inside are reads of the probe. A read that must not be answered asks for two
items, and the read of the probe after it for one: so a late reply to the first cannot be taken for that to the second.
"""

from ....codes import BROADCAST_UNIT
from ..check import Accepts, Ask, Check, FrameDamage, Level, Strength, Target
from ..frames import damages_of
from .shorthand import REPLY, SHOULD, SILENCE, check

_DAMAGES = {
    FrameDamage.CHECK_FLIPPED: ("check-flipped", "S9", Strength.MUST),
    FrameDamage.CHECK_SWAPPED: ("check-swapped", "S9", Strength.MUST),
    FrameDamage.CHECK_ZERO: ("check-zero", "S9", Strength.MUST),
    FrameDamage.CONTENT_FLIPPED: ("content-flipped", "S6", Strength.MUST),
    FrameDamage.NO_CHECK: ("no-check", "S9", Strength.MUST),
    FrameDamage.NO_END: ("no-end", "S8", Strength.MUST),
    FrameDamage.TINY: ("tiny", "S6", Strength.MUST),
    FrameDamage.NOT_HEX: ("not-hex", "S12", Strength.MUST),
    FrameDamage.ODD_DIGITS: ("odd-digits", "S12", Strength.MUST),
    FrameDamage.NO_COLON: ("no-colon", "S12", Strength.MUST),
    FrameDamage.NO_CR: ("no-cr", "S12", Strength.SHOULD),
    FrameDamage.TOO_LONG: ("too-long", "S8", Strength.MUST),
}
"""For each damage that makes a frame invalid: name of its check, clause (of RTU), and must or should."""
_ASCII_CLAUSES = {"S9": "S13", "S8": "S12"}
_HEALED = {
    FrameDamage.RESTARTED: ("restarted", "takes the frame that a second colon begins", Strength.MUST),
    FrameDamage.JUNK_BEFORE: ("junk-before", "takes a frame behind characters of no frame", Strength.MUST),
}


_ANY_WAY = Accepts(reply=True, exceptions=frozenset({2}), silence=True)


def line_checks(target: Target, probe: bytes, longer: bytes) -> list[Check]:
    """Return the checks of frames on RTU and ASCII lines.

    Args:
        target: the device to be checked; damages that its framing does not have are left out.
        probe: the PDU of a read of the probe.
        longer: the PDU of a read of two items: the probe and the item after it.
    """
    ask = Ask(probe, REPLY)
    known = damages_of(target.framing)
    other = target.unit % 247 + 1
    checks = [
        check(
            "after-other-unit",
            "S11",
            "answers after a frame for another unit",
            Ask(longer, Accepts(reply=True, exceptions=frozenset(range(256)), silence=True), unit=other),
            ask,
        ),
        check(
            "other-unit-silent",
            "S11",
            f"is silent at a frame for unit {other}, or unit {other} answers itself",
            Ask(longer, Accepts(reply=True, exceptions=frozenset(range(256)), silence=True), unit=other),
        ),
    ]
    checks += [
        check(
            f"reserved-{unit}",
            "S3",
            f"is silent at a frame for the reserved address {unit}",
            Ask(longer, SILENCE, unit=unit),
            strength=SHOULD,
        )
        for unit in (248, 250, 255)
    ]
    checks += [
        check(
            "broadcast-read",
            "S2",
            "does not answer a read that is sent to all",
            Ask(longer, SILENCE, unit=BROADCAST_UNIT),
            level=Level.READ,
        ),
        check(
            "broadcast-unknown",
            "S2",
            "does not answer an unknown function that is sent to all",
            Ask(b"\x40\x00\x00", SILENCE, unit=BROADCAST_UNIT),
            level=Level.DIAG,
        ),
        check(
            "broadcast-bad-count",
            "S2",
            "does not answer a read of 0 items that is sent to all",
            Ask(longer[:3] + b"\x00\x00", SILENCE, unit=BROADCAST_UNIT),
            level=Level.READ,
        ),
    ]
    for damage, (name, clause, strength) in _DAMAGES.items():
        if damage in known:
            if target.framing == "ascii":
                clause = _ASCII_CLAUSES.get(clause, clause)
            checks.append(
                check(
                    name,
                    clause,
                    f"does not answer a damaged frame: {damage.value}",
                    Ask(longer, SILENCE, damage=damage),
                    ask,
                    level=Level.DIAG,
                    strength=strength,
                )
            )
    for damage, (name, says, strength) in _HEALED.items():
        if damage in known:
            checks.append(
                check(name, "S12", says, Ask(probe, REPLY, damage=damage), level=Level.DIAG, strength=strength)
            )
    if target.framing == "ascii":
        checks.append(
            check(
                "lower-case",
                "S12",
                "takes no digits in lower case, or takes them all",
                Ask(
                    longer, Accepts(reply=True, exceptions=frozenset({2}), silence=True), damage=FrameDamage.LOWER_CASE
                ),
                ask,
                level=Level.DIAG,
                strength=SHOULD,
            )
        )
    return checks
