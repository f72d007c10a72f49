"""Fault profiles of serial lines: junk around frames, echo of the request, replies to broadcasts.

Junk and echoes occur wherever serial frames are sent, on a line or over a network. On Modbus TCP they would break the
stream, and no such device is known.
"""

from dataclasses import replace
from typing import Annotated

from ...options.declaration import Range
from ..fault import Emission, Exchange, Fault
from ..profile import Carrier, FaultProfile

_LINES = frozenset({Carrier.SERIAL})
_LONGEST_JUNK = 250


def _leading_zero(zeros: Annotated[int, Range(1, _LONGEST_JUNK), "bytes before each reply"] = 1) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [replace(one, before=bytes(zeros) + one.before) for one in emissions]

    return Fault(answered=answered)


def _noise(
    size: Annotated[int, Range(1, _LONGEST_JUNK), "random bytes at each place"] = 3,
    before: Annotated[bool, "whether they come before a reply"] = True,
    after: Annotated[bool, "whether they come behind it"] = True,
) -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        def junk() -> bytes:
            return exchange.random.randbytes(size)

        return [
            replace(
                one,
                before=(junk() if before else b"") + one.before,
                after=one.after + (junk() if after else b""),
            )
            for one in emissions
        ]

    return Fault(answered=answered)


def _echo() -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        return [Emission(exchange.transaction, exchange.unit, before=exchange.adu), *emissions]

    return Fault(answered=answered)


_WHOLE_ECHO = frozenset({5, 6, 21, 22})
"""Codes of functions whose reply repeats the whole request; the reply of 15 and 16 is its first five bytes."""


def _broadcast_reply() -> Fault:
    def answered(exchange: Exchange, emissions: list[Emission]) -> list[Emission]:
        if not exchange.is_broadcast:
            return emissions
        pdu = exchange.pdu if exchange.function in _WHOLE_ECHO else exchange.pdu[:5]
        return [*emissions, Emission(exchange.transaction, exchange.unit, pdu)]

    return Fault(answered=answered)


LEADING_ZERO = FaultProfile(
    "leading-zero",
    "zeros come before a reply, as when a driver is switched on",
    ("minimalmodbus#61",),
    "slides to the frame whose check fits",
    _leading_zero,
    _LINES,
)
NOISE = FaultProfile(
    "noise",
    "junk before and behind replies",
    ("pymodbus#485",),
    "slides to the frame whose check fits; what is damaged itself is asked again",
    _noise,
    _LINES,
)
ECHO = FaultProfile(
    "echo",
    "the bytes of the request come back before the reply",
    ("pymodbus#2592", "libmodbus#34"),
    "takes out exactly one copy, with `echo` on or automatic",
    _echo,
    _LINES,
)
BROADCAST_REPLY = FaultProfile(
    "broadcast-reply",
    "answers what was sent to all",
    ("pymodbus#2378",),
    "swallows it within the turnaround",
    _broadcast_reply,
    _LINES,
)
