"""The basic checks: each tests one facet that every reply must have right, such as the transaction identifier.

Knows the target's probe. Basic checks run first; all other checks rely on their results.
"""

from ..check import Accepts, Ask, Check, Facet, Target
from .shorthand import REPLY, check

_ANY = Accepts(reply=True, exceptions=frozenset(range(256)))


def basic_checks(target: Target, probe: bytes) -> list[Check]:
    """Return the basic checks, which read the probe and judge one facet of the reply each.

    Args:
        target: the device to be checked; its framing decides which checks there are.
        probe: the PDU of the request that reads the target's probe.
    """
    once = Ask(probe, _ANY)
    checks = [
        check("answers", "A21", "answers a read of the probe in time", once, facet=Facet.ANSWERED),
        check(
            "answers-at-once",
            "S6" if target.framing != "mbap" else "T30",
            "answers the next read too, sent right behind the reply",
            once,
            once,
            once,
            facet=Facet.ANSWERED,
        ),
        check(
            "nothing-else",
            "S1" if target.framing != "mbap" else "T30",
            "sends nothing but the reply: no other bytes, no second reply",
            once,
            once,
            facet=Facet.CLEAN,
        ),
    ]
    if target.framing == "mbap":
        checks += [
            check(
                "transaction-echoed",
                "T30",
                "repeats the transaction identifier of the request",
                once,
                once,
                facet=Facet.TRANSACTION,
            ),
            check("protocol-0", "T2", "answers with protocol identifier 0", once, facet=Facet.PROTOCOL),
        ]
    checks += [
        check(
            "unit-echoed",
            "S2" if target.framing != "mbap" else "T30",
            "answers as the unit that was asked",
            once,
            facet=Facet.UNIT,
        ),
        check(
            "reply-form",
            "A1",
            "answers with the function and the length that the request asks for",
            once,
            facet=Facet.FORM,
        ),
        check("probe-readable", "A7", "answers a read of the probe with data", Ask(probe, REPLY), facet=Facet.CONTENT),
    ]
    return checks
