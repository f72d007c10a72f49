"""Tells whether the next frame on a shared serial line, heard by any station, is a request or a reply.

Knows units, functions and the request that was seen last; knows no bytes of a frame beyond its first two.

1. A master hears replies; a frame that looks like a request is its own echo, or another master's.
2. A server hears requests for its own units. On a shared bus it also hears requests to other units and their replies:
   after such a request a frame is first taken for the reply to it; any other frame is first taken for a request.
3. An observer hears both, and follows the pairs in the same way.
4. A reply is expected for `REPLY_WINDOW` seconds; after that a frame of the same unit and function is another request:
   requests and replies of functions that echo (05, 06, 08, 22) look alike, and a dead unit that is asked again and
   again must not seem to answer itself.
"""

from collections.abc import Container
from dataclasses import dataclass
from enum import Enum
from typing import Final

from ..codes import BROADCAST_UNIT
from ..pdu.message import UNKNOWN_LENGTH
from .received import Direction

REPLY_WINDOW: Final = 1.0
"""Seconds for which a server or observer expects the reply to a request to another unit, by default."""

_REQUEST_ONLY = (Direction.REQUEST,)
_REPLY_ONLY = (Direction.REPLY,)
_REQUEST_FIRST = (Direction.REQUEST, Direction.REPLY)
_REPLY_FIRST = (Direction.REPLY, Direction.REQUEST)


class LineRole(Enum):
    """Role of a station on a serial line: master, server or observer."""

    MASTER = "master"
    SERVER = "server"
    OBSERVER = "observer"


@dataclass(frozen=True, slots=True)
class Due:
    """A reply that is expected on the line.

    Attributes:
        unit: the unit that is to answer.
        function: the function code of the request, 1…127.
        size: length of the reply's PDU in bytes; `UNKNOWN_LENGTH` if the request does not tell it.
        until: time after which the reply is no longer expected, in seconds of the receiver's clock; infinity for a
            master, whose driver ends the wait.
    """

    unit: int
    function: int
    size: int = UNKNOWN_LENGTH
    until: float = float("inf")

    def answers(self, unit: int, code: int, now: float) -> bool:
        """Whether a frame with this unit and function code, at the time ``now`` (seconds), can be the expected reply.

        The exception bit, 0x80 of ``code``, is ignored.
        """
        return unit == self.unit and code & 0x7F == self.function and now <= self.until


class Conversation:
    """The last request heard on a line and the reply expected to it; they tell whether a frame is request or reply.

    Attributes:
        role: the role of the station that receives.
        units: the own units of a server; a container whose content changes is allowed.
        due: the reply that is expected; None for none. A master's driver sets it, otherwise `follow`.
        reply_window: seconds for which a server or observer expects the reply to a request to another unit.
    """

    __slots__ = ("due", "reply_window", "role", "units")

    def __init__(self, role: LineRole, units: Container[int] = (), reply_window: float = REPLY_WINDOW) -> None:
        self.role: LineRole = role
        self.units: Container[int] = units
        self.due: Due | None = None
        self.reply_window: float = reply_window

    def order(self, unit: int, code: int, now: float) -> tuple[Direction, ...]:
        """Return the directions, one or two, that a frame with this unit and function byte can have, likelier first.

        ``code`` has 0x80 set in an exception reply. ``now`` is the time of the frame, in seconds.
        """
        if code & 0x80:
            return _REPLY_ONLY
        if self.role is LineRole.MASTER:
            due = self.due
            # No unit answers a broadcast; a zero ahead of a reply must not pass for an address.
            return _REPLY_FIRST if unit != BROADCAST_UNIT or (due and due.unit == unit) else _REQUEST_ONLY
        if unit == BROADCAST_UNIT or self.is_own(unit):
            return _REQUEST_ONLY
        due = self.due
        return _REPLY_FIRST if due is not None and due.answers(unit, code, now) else _REQUEST_FIRST

    def guess(self, unit: int, code: int, now: float) -> Direction:
        """Return the direction of a complete frame whose length fits neither a request nor a reply of its function.

        `Direction.UNKNOWN` if unit, code and the expected reply do not tell it. ``now`` is the time of the frame, in
        seconds.
        """
        if code & 0x80 or (self.due is not None and self.due.answers(unit, code, now)):
            return Direction.REPLY
        if self.role is LineRole.SERVER and (unit == BROADCAST_UNIT or self.is_own(unit)):
            return Direction.REQUEST
        return Direction.UNKNOWN

    def is_own(self, unit: int) -> bool:
        """Return True if this station is a server and ``unit`` one of its own; False for a master and an observer."""
        return self.role is LineRole.SERVER and unit in self.units

    def follow(self, unit: int, code: int, direction: Direction, now: float) -> None:
        """Record a frame that ended on the line at ``now`` (seconds), to predict the direction of the next one.

        After a frame that is not a reply, to a unit of another station, a reply is expected for ``reply_window``
        seconds; after any other frame none is. Ignored for a master: its driver sets ``due``.
        """
        if self.role is LineRole.MASTER:
            return
        if direction is Direction.REPLY or unit == BROADCAST_UNIT or self.is_own(unit):
            self.due = None
        else:
            self.due = Due(unit, code & 0x7F, until=now + self.reply_window)
