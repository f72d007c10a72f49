"""Short functions with which the other files write checks: accepted answers, and PDUs built from numbers.

Knows the classes of checks; contains no check.
"""

from typing import Final

from ..check import Accepts, Check, CheckStep, Facet, Level, Strength

MUST: Final = Strength.MUST
SHOULD: Final = Strength.SHOULD
REPLY: Final = Accepts(reply=True)
SILENCE: Final = Accepts(silence=True)


def word(number: int) -> bytes:
    """Return a number, 0…65535, as two bytes in big-endian order."""
    return number.to_bytes(2, "big")


def pdu(code: int, *parts: int | bytes) -> bytes:
    """Return a PDU: the function code as one byte, then the parts; a number takes two bytes, bytes stay as they are."""
    return bytes((code,)) + b"".join(part if isinstance(part, bytes) else word(part) for part in parts)


def refused(*codes: int) -> Accepts:
    """Return an `Accepts` for exception replies with one of these codes, and nothing else."""
    return Accepts(exceptions=frozenset(codes))


def reply_or(*codes: int) -> Accepts:
    """Return an `Accepts` for a normal reply, or an exception reply with one of these codes."""
    return Accepts(reply=True, exceptions=frozenset(codes))


def refused_or_silent(*codes: int) -> Accepts:
    """Return an `Accepts` for an exception reply with one of these codes, or no answer."""
    return Accepts(exceptions=frozenset(codes), silence=True)


def check(
    id: str,
    clause: str,
    says: str,
    *steps: CheckStep,
    strength: Strength = MUST,
    level: Level = Level.READ,
    facet: Facet | None = None,
    function: int | None = None,
    opens: bool = False,
) -> Check:
    """Create a check. The arguments are the attributes of `Check`; ``strength`` becomes its attribute ``word``.

    ``says`` is what a correct device does, as a sentence without subject: "answers a read of a queue".
    """
    return Check(id, clause, says, strength, level, steps, facet, function, opens)
