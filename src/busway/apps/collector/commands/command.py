"""Commands: a value to be written to a point, who asked for it and until when, and its result.

Pure: knows no device, no file and no clock.

1. A key names a command for ever. Keys that are made here begin with `MADE`; those of callers must not.
2. Times are seconds since 1970 UTC.
3. What a caller gives has limits: lengths of texts, items of a list, how far away the expiry is. Texts can be written
   as UTF-8, or else no journal and no answer could hold them; who gives a command has a name that can be seen.
"""

import json
import math
import re
import secrets
import sys
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

from ....errors import InvalidRequest
from ....values.refusal import shown
from ..samples import Value

MADE: Final = "busway-"
"""The beginning of keys that are made here."""
USUAL_SECONDS: Final = 30.0
"""Seconds in which a command is sent where it does not say until when."""
LONGEST_VALUE: Final = 2000
"""Characters of a value, as JSON."""

CommandValue = Value | list[Value]
"""What is written: a state, a number, a text, the name of a number; a list of names of flags, or of numbers."""

_KEY: Final = re.compile(r"[A-Za-z0-9._:@-]{1,100}")
_PRINTABLE: Final = re.compile(r"[^\x00-\x1f\x7f\ud800-\udfff]{1,200}")
_HALF_PAIR: Final = re.compile(r"[\ud800-\udfff]")
"""Halves of surrogate pairs, which JSON can have: they are no characters, and no answer could hold them."""


class CommandState(StrEnum):
    """States of a command while it is open, and the states with which it can end."""

    OPEN = "open"  # recorded, and not finished
    DONE = "done"  # the device has answered, and shows the value where the rule asks for that
    FAILED = "failed"  # it was refused by the device, was not sent, or the device shows another value
    UNKNOWN = "unknown"  # it may have been sent, and nothing says whether it was executed
    EXPIRED = "expired"  # its time was over; nothing was sent
    REFUSED = "refused"  # against a rule; nothing was sent


@dataclass(frozen=True, slots=True)
class OldValue:
    """The last known value of a point before a command wrote it.

    Attributes:
        value: the value; None where it is not known.
        quality: ``good``, ``uncertain`` or ``bad``.
        time: when it was read, seconds since 1970 UTC.
    """

    value: CommandValue | None
    quality: str
    time: float


@dataclass(frozen=True, slots=True)
class PointCommand:
    """A request of a person or program to write a value to a point of a collector.

    Attributes:
        key: names the command; it is sent at most once.
        device, point: the point to write.
        value: a number in the unit of measure, a state, a text, or a name of a number; a list of flags.
        by: name of the person or program that gives it.
        origin: on which way it came: ``page``, ``api``, ``program``, ``mqtt``, ``nats``, ``sparkplug``, ``fleet``.
        expires: until when it may be sent, seconds since 1970 UTC.

    Raises:
        InvalidRequest: one of these is out of its limits.
    """

    key: str
    device: str
    point: str
    value: CommandValue
    by: str
    origin: str
    expires: float

    def __post_init__(self) -> None:
        if not is_key(self.key):
            raise InvalidRequest(f"a key has 1…100 letters, digits or . _ : @ -, not {shown(self.key)}")
        for name in ("device", "point", "by", "origin"):
            text = getattr(self, name)
            is_text = isinstance(text, str) and _PRINTABLE.fullmatch(text)
            if not is_text or (name == "by" and not text.isprintable()):
                raise InvalidRequest(f"{name} has 1…200 printable characters, not {shown(text)}")
        if isinstance(self.expires, bool) or not isinstance(self.expires, int | float):
            raise InvalidRequest(f"expires is seconds since 1970, not {shown(self.expires)}")
        if not abs(self.expires) <= sys.float_info.max:  # not `isfinite`, which fails for longer integers
            raise InvalidRequest(f"expires is seconds since 1970, not {shown(self.expires)}")
        _check_value(self.value)

    def is_same(self, other: "PointCommand") -> bool:
        """Whether another command writes the same value to the same point; who gave it does not matter."""
        return (self.device, self.point) == (other.device, other.point) and same_value(self.value, other.value)


def is_key(key: object) -> bool:
    """Whether a key can be that of a command."""
    return isinstance(key, str) and _KEY.fullmatch(key) is not None


def _check_value(value: object) -> None:
    items = value if isinstance(value, list) else [value]
    for each in items:
        if not isinstance(each, bool | int | float | str):
            raise InvalidRequest(f"a value is a number, a text, true or false, or a list of them, not {shown(value)}")
        if isinstance(each, float) and not math.isfinite(each):
            raise InvalidRequest(f"{shown(each)} is no value to write")
        if isinstance(each, int) and abs(each) >= 1 << 64:
            raise InvalidRequest("a whole number has at most 64 bits")
        if isinstance(each, str) and len(each) > LONGEST_VALUE:
            raise InvalidRequest(f"a text has at most {LONGEST_VALUE} characters")
        if isinstance(each, str) and _HALF_PAIR.search(each):
            raise InvalidRequest(f"{shown(each)} has half of a surrogate pair, which is no character")
    if len(items) > LONGEST_VALUE or len(json.dumps(value)) > 6 * LONGEST_VALUE:
        raise InvalidRequest(f"a value has at most {LONGEST_VALUE} characters")


def same_value(one: CommandValue, other: CommandValue) -> bool:
    """Whether two values of a point are equal. A state and a number never are; an integer and a float may be."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(same_value(*pair) for pair in zip(one, other, strict=True))
    return isinstance(one, bool) is isinstance(other, bool) and one == other


def new_key(now: float) -> str:
    """Return a new, unique key for a command.

    It has the time, so that keys sort by it, and 96 random bits.

    Args:
        now: seconds since 1970 UTC.
    """
    return f"{MADE}{int(now * 1000):013d}-{secrets.token_hex(12)}"


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The result of a command that writes a point, or its state while it is not finished.

    Attributes:
        command: the command.
        state: what became of it; `CommandState.OPEN` while it is not finished.
        at: when it was accepted, seconds since 1970 UTC.
        old: the last known value before; None if none was known.
        read_back: the value read back afterwards, if the point's rule asks for that; else None.
        reason: why it is not done, as a sentence; empty if it is done without a remark.
    """

    command: PointCommand
    state: CommandState
    at: float
    old: OldValue | None = None
    read_back: CommandValue | None = None
    reason: str = ""

    @property
    def is_done(self) -> bool:
        """Whether the value was written to the point, and read back if the point's rule requires that."""
        return self.state is CommandState.DONE

    def finished(
        self,
        state: CommandState,
        reason: str = "",
        *,
        read_back: CommandValue | None = None,
        old: OldValue | None = None,
    ) -> "CommandResult":
        """Return a copy of the result with its final state.

        Args:
            state: the final state.
            reason: why the command is not done, as a sentence.
            read_back: the value that was read back afterwards.
            old: the value before; None to keep the present one.
        """
        return replace(self, state=state, reason=reason, read_back=read_back, old=old or self.old)

    def content(self) -> dict[str, Any]:  # JSON
        """Return the result of the command as JSON data, for responses and lists."""
        command = self.command
        return {
            "key": command.key,
            "at": self.at,
            "by": command.by,
            "origin": command.origin,
            "device": command.device,
            "point": command.point,
            "old": None if self.old is None else self.old.value,
            "value": command.value,
            "state": self.state.value,
            "read_back": self.read_back,
            "reason": self.reason or None,
        }
