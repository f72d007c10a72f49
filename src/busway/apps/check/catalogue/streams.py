"""Checks of Modbus TCP: MBAP headers, requests cut or joined in the TCP stream, and connections.

Knows headers and connections; the requests inside are reads of the probe.
"""

from typing import Final

from ..check import Accepts, Ask, BesideIt, Check, CutOff, FrameDamage, Idle, Level, Reopen, Target, Together
from .shorthand import REPLY, SHOULD, check

_CLOSED_OR_SILENT: Final = Accepts(silence=True, closed=True)


def stream_checks(target: Target, probe: bytes) -> list[Check]:
    """Return the checks of MBAP headers, of the TCP stream and of connections.

    Args:
        target: the device to be checked.
        probe: the PDU of a read of its probe.
    """
    ask = Ask(probe, REPLY)
    checks = [
        check(
            f"transaction-{number:04x}",
            "T30",
            f"repeats the transaction identifier {number:04X}",
            Ask(probe, REPLY, transaction=number),
        )
        for number in (0, 1, 0x00FF, 0x7FFF, 0x8000, 0xFFFF)
    ]
    checks += [
        check(
            f"unit-{unit}",
            "T24",
            f"answers unit {unit} with unit {unit}, or not at all, or 0A, 0B or 04",
            Ask(probe, Accepts(reply=True, exceptions=frozenset({1, 2, 4, 10, 11}), silence=True), unit=unit),
            strength=SHOULD,
        )
        for unit in (0, 255)
    ]
    checks += [
        check(
            f"together-{count}",
            "T9",
            f"answers {count} reads that arrive in one segment, each with its identifier",
            Together((probe,) * count),
            strength=SHOULD,
        )
        for count in (2, 4, 16)
    ]
    checks += [
        check(
            f"split-{name}",
            "T11",
            f"takes a request that arrives in pieces: {what}",
            Ask(probe, REPLY, pieces=cuts),
            strength=SHOULD,
        )
        for name, what, cuts in (
            ("header", "the header by itself", (7,)),
            ("length", "cut within the length", (5,)),
            ("first", "its first byte by itself", (1,)),
            ("last", "its last byte by itself", (11,)),
            ("bytes", "byte by byte", tuple(range(1, 12))),
        )
    ]
    other = target.unit % 247 + 1
    checks += [
        check(
            "after-other-unit",
            "T30",
            "answers after another unit was asked",
            Ask(probe, Accepts(reply=True, exceptions=frozenset(range(256)), silence=True), unit=other),
            ask,
        ),
        check("new-connection", "T7", "answers at once on a new connection", Reopen(), ask, strength=SHOULD),
        check(
            "second-connection",
            "T12",
            "answers on a second connection, and then on the first",
            ask,
            BesideIt(ask),
            ask,
            strength=SHOULD,
        ),
        check(
            "silent-start",
            "T7",
            "keeps a connection on which nothing is sent at first",
            Reopen(),
            Idle(),
            ask,
            strength=SHOULD,
        ),
        check("idle", "T7", "keeps a connection open between requests", Reopen(), ask, Idle(), ask, strength=SHOULD),
    ]
    for damage in (FrameDamage.PROTOCOL_1, FrameDamage.PROTOCOL_FFFF):
        checks.append(
            check(
                f"protocol-{'1' if damage is FrameDamage.PROTOCOL_1 else 'ffff'}",
                "T28",
                f"discards a request with {damage.value}",
                Ask(probe, _CLOSED_OR_SILENT, damage=damage),
                level=Level.DIAG,
            )
        )
    for name, damage in (
        ("0", FrameDamage.LENGTH_0),
        ("1", FrameDamage.LENGTH_1),
        ("255", FrameDamage.LENGTH_255),
        ("ffff", FrameDamage.LENGTH_FFFF),
    ):
        checks.append(
            check(
                f"length-{name}",
                "T28",
                f"closes the connection at a {damage.value}, which cannot be",
                Ask(probe, Accepts(closed=True), damage=damage),
                level=Level.DIAG,
            )
        )
    checks += [
        check(
            "length-short",
            "T28",
            "does not execute a frame whose length leaves out its last byte",
            Ask(probe, Accepts(exceptions=frozenset({3}), silence=True, closed=True), damage=FrameDamage.LENGTH_SHORT),
            Reopen(),
            ask,
            level=Level.DIAG,
            strength=SHOULD,
        ),
        check(
            "cut-header",
            "T18",
            "answers on a new connection after one ended within a header",
            CutOff(probe, 4),
            ask,
            level=Level.DIAG,
            strength=SHOULD,
        ),
        check(
            "cut-request",
            "T18",
            "answers on a new connection after one ended within a request",
            CutOff(probe, 10),
            ask,
            level=Level.DIAG,
            strength=SHOULD,
        ),
    ]
    return checks
