"""The quality of a point's value (good, uncertain, bad), and the codes of the reasons if it is not good.

Knows the codes only. A reason is set where it is found: by `decoder` for a reply, by `derived` for computed points, by
`busway.apps.collector.poller` for a read without reply, by the store's `recovery` for the time of a stop.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from ..codes import exception_meaning
from ..errors import InvalidRequest
from ..values.unfit_values import shown

_EXCEPTIONS: Final = 256
"""The reason for a device's exception code is this number plus the code."""


class Quality(IntEnum):
    """How far a point's value can be trusted: good, uncertain or bad; larger is worse."""

    GOOD = 0
    UNCERTAIN = 1
    """There is a value, but it may be wrong."""
    BAD = 2
    """There is no value, or none that can be trusted."""

    @property
    def label(self) -> str:
        """The quality as a word: ``good``, ``uncertain``, ``bad``."""
        return self.name.lower()


class Reason(IntEnum):
    """Why a point's value is not good or is missing; NONE is the reason of a good value.

    `reason_text` returns each reason in words. Reasons 1 to 15 make a value uncertain, reasons from 16 on make it bad.
    Reasons for exception codes are plain ints from 256 on, made by `exception_reason`.
    """

    NONE = 0
    HELD = 1
    OUT_OF_RANGE = 2
    CLOCK = 3
    TIMEOUT = 16
    BROKEN_REPLY = 17
    IN_DOUBT = 18
    NO_CONNECTION = 19
    CONFIGURATION = 20
    MAINTENANCE = 21
    OWNERSHIP = 22
    NO_VALUE = 23
    NOT_A_NUMBER = 24
    NO_SCALE_FACTOR = 25
    MEANINGLESS = 26
    NO_INPUT = 27
    SKIPPED = 32
    SUSPENDED = 33
    STOPPED = 34
    KILLED = 35
    LOST = 36


_TEXTS: Final[dict[int, str]] = {
    Reason.NONE: "",
    Reason.HELD: "held",
    Reason.OUT_OF_RANGE: "out of range",
    Reason.CLOCK: "clock not set",
    Reason.TIMEOUT: "timeout",
    Reason.BROKEN_REPLY: "broken reply",
    Reason.IN_DOUBT: "in doubt",
    Reason.NO_CONNECTION: "no connection",
    Reason.CONFIGURATION: "wrong configuration",
    Reason.MAINTENANCE: "maintenance",
    Reason.OWNERSHIP: "gap of ownership",
    Reason.NO_VALUE: "no value",
    Reason.NOT_A_NUMBER: "not a number",
    Reason.NO_SCALE_FACTOR: "scale factor not known",
    Reason.MEANINGLESS: "bytes mean nothing in its type",
    Reason.NO_INPUT: "computed from a point without value",
    Reason.SKIPPED: "round skipped",
    Reason.SUSPENDED: "device suspended",
    Reason.STOPPED: "collector stopped",
    Reason.KILLED: "collector ended unexpectedly",
    Reason.LOST: "store could not be written",
}


def exception_reason(code: int) -> int:
    """Return the reason code (256 and more) of a missing value whose read was answered with an exception code, 0…255.

    Raises `InvalidRequest` for another number.
    """
    if not 0 <= code <= 255:
        raise InvalidRequest(f"an exception code is 0…255, not {shown(code)}")
    return _EXCEPTIONS + code


def exception_code_of(reason: int) -> int | None:
    """Return the exception code, 0…255, that a reason from `exception_reason` stands for; None for other reasons."""
    return reason - _EXCEPTIONS if reason >= _EXCEPTIONS else None


def quality_of(reason: int) -> Quality:
    """Return whether a value with this reason is good, uncertain or bad."""
    if reason == 0:
        return Quality.GOOD
    return Quality.UNCERTAIN if reason < Reason.TIMEOUT else Quality.BAD


def reason_text(reason: int) -> str:
    """Return a reason why a value is not good, in words; empty for reason 0, that of a good value."""
    if reason >= _EXCEPTIONS:
        code = reason - _EXCEPTIONS
        return f"exception {code:02X}, {exception_meaning(code)}"
    return _TEXTS.get(reason) or (f"reason {reason}" if reason else "")


@dataclass(frozen=True, slots=True)
class Reading:
    """The value of one point from a read, and the reason if it is not good.

    Attributes:
        value: the value in the unit of measure; None for no value.
        reason: why the value is not good or is missing: a `Reason` or a code of `exception_reason`; 0 for a good value.
    """

    value: Any  # what the point's type says
    reason: int = Reason.NONE

    @property
    def quality(self) -> Quality:
        """The quality (good, uncertain, bad) that follows from the reason."""
        return quality_of(self.reason)
