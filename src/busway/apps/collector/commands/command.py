"""Commands: a value to be written to a point, who asked for it and until when, and its result.

Pure: knows no device, no file and no clock.

1. A key names a command for ever. Keys that the collector makes begin with `MADE`; keys of callers must not.
2. Times are seconds since 1970 UTC.
3. What a caller gives has limits: lengths of texts and lists, and the size of numbers. Texts must be possible in UTF-8,
   because journal and answers hold them; the name of the writer has only printable characters.
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
from ....values.unfit_values import shown
from ..samples import SampleValue

MADE: Final = "busway-"
"""Prefix of the keys that the collector makes itself; a key of a caller must not have it."""
USUAL_SECONDS: Final = 30.0
"""Seconds within which a command without an expiry may be sent."""
LONGEST_VALUE: Final = 2000
"""Most characters of a text, and most items of a list, in the value of a command. As JSON, the value has six times as
many characters at most.
"""

CommandValue = SampleValue | list[SampleValue]
"""Value of a command: a state, a number, a text or the name of a number; or a list of numbers or of names of flags."""

_KEY: Final = re.compile(r"[A-Za-z0-9._:@-]{1,100}")
_PRINTABLE: Final = re.compile(r"[^\x00-\x1f\x7f\ud800-\udfff]{1,200}")
_HALF_PAIR: Final = re.compile(r"[\ud800-\udfff]")
"""Matches half of a surrogate pair: JSON can have it, but it is no character, and no answer could hold it."""


class CommandState(StrEnum):
    """States of a command: OPEN until it ends, and the states with which it can end."""

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
        value: the value; None if the last sample had none.
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
        key: names the command for ever; a command with this key is sent at most once.
        device, point: the point to write.
        value: a number in the unit of measure, a state, a text, the name of a number, or a list of names of flags.
        by: name of the person or program that gives it.
        origin: the way on which it came: ``page``, ``api``, ``program``, ``mqtt``, ``nats``, ``sparkplug``, ``fleet``.
        expires: until when it may be sent, seconds since 1970 UTC.

    Raises:
        InvalidRequest: an attribute has the wrong type or is out of its limits. Whether the point takes the value, and
            how far away the expiry is, is checked by `CommandRunner`.
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
        """Whether another command writes the same value to the same point, whatever its key, writer and expiry."""
        return (self.device, self.point) == (other.device, other.point) and same_value(self.value, other.value)


def is_key(key: object) -> bool:
    """Whether an object is a valid key of a command: a text of 1…100 letters, digits or ``. _ : @ -``."""
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
    """Whether two values of a point are equal. A state never equals a number; an integer can equal a float (1, 1.0)."""
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(same_value(*pair) for pair in zip(one, other, strict=True))
    return isinstance(one, bool) is isinstance(other, bool) and one == other


def new_key(now: float) -> str:
    """Return a new, unique key for a command.

    It contains ``now``, so that keys sort by time, and 96 random bits.

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
        at: when the collector got the command, seconds since 1970 UTC.
        old: the point's last known value before the command; None if none was known.
        read_back: the value that the device showed afterwards; None if the point's rule asks for no reading back, or
            none succeeded.
        reason: why the command is not done, or a remark about one that is done, as a sentence; else empty.
    """

    command: PointCommand
    state: CommandState
    at: float
    old: OldValue | None = None
    read_back: CommandValue | None = None
    reason: str = ""

    @property
    def is_done(self) -> bool:
        """Whether the device has accepted the value, and shows it if the point's rule asks to read it back."""
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
            reason: why the command is not done, or a remark, as a sentence; empty for none.
            read_back: the value that was read back afterwards; None if none was.
            old: the point's value before the command; None to keep the one that this result has.
        """
        return replace(self, state=state, reason=reason, read_back=read_back, old=old or self.old)

    def content(self) -> dict[str, Any]:  # JSON
        """Return the result of the command as JSON data, for responses and lists.

        The keys are ``key``, ``at`` (seconds since 1970 UTC), ``by``, ``origin``, ``device``, ``point``, ``old``,
        ``value``, ``state``, ``read_back`` and ``reason``. ``old`` is the old value without its quality and time, or
        None; an empty reason is None. The expiry is left out.
        """
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
