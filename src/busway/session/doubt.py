"""Which units of a line owe replies, and what may be sent to them meanwhile.

Knows requests, units and times; knows no bytes of a frame beyond its PDU, no port and no clock.

Frames of RTU and ASCII have no transaction numbers. That a reply answers a request is known by its unit, function,
length and echo; a late reply to an earlier request may have all of them. What can be relied on is order: a unit answers
what it received at most once, and in the order in which it received it.

1. A request that got no answer is owed one (`OwedReply`), until the answer comes or order excludes that it comes. This
   outlives connections; no clock ends it.
2. A reply belongs to the earliest request of its unit that it could answer. What was sent before that request is not
   answered any more.
3. A unit is *in doubt* for a request while another call is owed a reply that could be taken for the reply to it. A
   read is known by function and length; its exception decides nothing then. A write is known by its function alone: it
   cannot be asked again to make sure.
4. Such a request goes out only behind a *marker*: a harmless request whose answer cannot be taken for an owed one. Its
   answer ends the doubt (rule 2).
5. A unit may not keep the order. So a request under a function that is owed an answer waits until twice the timeout has
   passed since the last attempt, or until as many answers have come as are owed. ``trust_reply_order`` skips that.
6. A unit that is silent to every marker is asked the read itself: what comes is counted against what is owed (rule 2),
   so a read may have to be repeated, and is never wrong. A write is not sent.
7. A unit that spoke unasked, or too early, is in doubt for that function. Answers nobody asked for may look like good
   ones at the moment: after `CHECK_EVERY` replies of one shape in a row a marker is sent, and shows a shift.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from ..pdu.diagnostics import GetCommEventCounter, ReadExceptionStatus, ReturnQueryData
from ..pdu.message import UNKNOWN_LENGTH, Request
from ..pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters

CHECK_EVERY: Final = 128
"""Replies of one shape in a row after which a marker is sent: below a hundredth of the requests of a line."""
OWED_LIMIT: Final = 256
"""Owed replies of a unit that are told apart. A unit that is dead for an hour is probed about 400 times."""
_EXCEPTION: Final = 0x80


class MarkerKind(Enum):
    """The harmless requests whose answer ends a doubt, in the order in which they are tried."""

    RETURN_QUERY_DATA = "08/00 with a number of its own"
    OTHER_LENGTH = "a read that was answered before, with another length"
    EVENT_COUNTER = "0B"
    EXCEPTION_STATUS = "07"


_OF_CHECKS: Final = (MarkerKind.OTHER_LENGTH, MarkerKind.RETURN_QUERY_DATA)


@dataclass(frozen=True, slots=True)
class Marker:
    """A request of our own.

    Attributes:
        kind: what it is.
        request: prepared to be sent.
    """

    kind: MarkerKind
    request: Request


@dataclass(frozen=True, slots=True, eq=False)
class OwedReply:
    """A request that was sent and got no answer.

    Attributes:
        request: what was asked, prepared.
        function: its function code.
        sent: when its last byte left, in seconds.
        until: when its answer has come even from a unit that keeps no order (rule 5).
        call, position: whose request it was; None of a marker, or of a call that nobody waits for.
    """

    request: Request
    function: int
    sent: float
    until: float
    call: object | None = None
    position: int = 0

    def may_be(self, pdu: bytes) -> bool:
        """Whether this PDU may be its answer."""
        if pdu[0] & ~_EXCEPTION != self.function:
            return False
        if pdu[0] & _EXCEPTION:
            return True
        request = self.request
        size = request.expected_size
        return (size in (UNKNOWN_LENGTH, len(pdu))) and pdu.startswith(request.expected_prefix)

    def is_of(self, call: object, position: int) -> bool:
        """Whether it is an earlier attempt of this very request."""
        return self.call is call and self.position == position and call is not None


@dataclass(slots=True)
class UnitDoubt:
    """What is known of one unit.

    Attributes:
        owed: the answers that may still come, in the order in which they were asked for.
        older: how many more are owed by function, asked for before all of ``owed``.
        pending: the same by count alone, for units that keep no order (rule 5).
        unasked: the function under which it spoke unasked; None where it did not.
        delay: seconds that its last late reply had taken; None before the first, and after a reply in time.
        last: the request that it answered last; None before the first.
        alike: replies in a row that could not be told from the one before by their shape (rule 7).
        silent: kinds of markers that it did not answer.
        works: the kind that it answered last.
        good: a read that it answered.
    """

    owed: list[OwedReply] = field(default_factory=list)
    older: dict[int, int] = field(default_factory=dict)
    pending: list[OwedReply] = field(default_factory=list)
    unasked: int | None = None
    delay: float | None = None
    last: Request | None = None
    alike: int = 0
    silent: set[MarkerKind] = field(default_factory=set)
    works: MarkerKind | None = None
    good: Request | None = None

    # What is owed.

    def owe(self, reply: OwedReply) -> None:
        """A request got no answer in time, or the connection ended before it."""
        if len(self.owed) >= OWED_LIMIT:
            first = self.owed.pop(0)
            self.older[first.function] = self.older.get(first.function, 0) + 1
        self.owed.append(reply)
        self.pending.append(reply)

    def is_older(self, pdu: bytes) -> bool:
        """Whether this PDU must be taken for an answer of which only the function is known any more.

        What 08/00 brings back tells its number.
        """
        function = pdu[0] & ~_EXCEPTION
        return function in self.older and pdu[0] != ReturnQueryData.code

    def older_came(self, pdu: bytes) -> None:
        """One of those has come; counting the earliest makes a doubt longer, never shorter."""
        function = pdu[0] & ~_EXCEPTION
        self.older[function] -= 1
        if not self.older[function]:
            del self.older[function]

    def candidates(self, pdu: bytes) -> list[OwedReply]:
        """The owed replies that this PDU may be, the earliest first: that is what it must be taken for (rule 2)."""
        return [owed for owed in self.owed if owed.may_be(pdu)]

    def came(self, reply: OwedReply) -> None:
        """An owed reply has come; what was asked before it is not answered any more."""
        del self.owed[: self.owed.index(reply) + 1]
        self.older.clear()
        self._count(reply.function)

    def _count(self, function: int) -> None:
        """One answer under this function has come, whichever it was."""
        for index, owed in enumerate(self.pending):
            if owed.function == function:
                del self.pending[index]
                return

    def answered(self, request: Request) -> None:
        """The request in flight was answered by what no owed reply could be: nothing sent before it comes any more."""
        self.owed.clear()
        self.older.clear()
        if request.wire[0] != self.unasked:
            self.unasked = None

    # What may be sent.

    def in_doubt(self, request: Request, call: object, position: int) -> bool:
        """Whether the answer to a prepared request could be taken for an owed one (rule 3); of its own call it may."""
        function = request.wire[0]
        if self.unasked == function or function in self.older:
            return True
        others = [owed for owed in self.owed if owed.function == function and not owed.is_of(call, position)]
        return any(request.is_write or _same_shape(owed.request, request) for owed in others)

    def waits_until(self, function: int, call: object, position: int, now: float) -> float:
        """When a request may be sent as far as the order of replies is not relied on (rule 5); ``now`` if it may."""
        if not self.pending:
            return now
        self.pending = [owed for owed in self.pending if owed.until > now]
        others = [owed for owed in self.pending if owed.function == function and not owed.is_of(call, position)]
        return max((owed.until for owed in others), default=now)

    @property
    def is_owed(self) -> bool:
        """Whether replies are owed, or it spoke unasked."""
        return bool(self.owed or self.older or self.unasked is not None)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is owed, and no time has to pass."""
        return not self.is_owed and not self.pending

    # Markers.

    def marker(self, number: int, *, is_check: bool = False) -> Marker | None:
        """The next request that may end the doubt, or None where the unit was silent to all of them.

        ``number``, 0…65535, is one that no marker used that is still owed an answer.
        """
        kinds: Iterable[MarkerKind] = _OF_CHECKS if is_check else MarkerKind
        if self.works is not None and not is_check:
            kinds = (self.works, *kinds)
        for kind in kinds:
            if kind not in self.silent:
                request = self._request_of(kind, number)
                if request is not None:
                    request.prepare()
                    return Marker(kind, request)
        return None

    def _request_of(self, kind: MarkerKind, number: int) -> Request | None:
        if kind is MarkerKind.RETURN_QUERY_DATA:
            return ReturnQueryData(number.to_bytes(2, "big"))
        if kind is MarkerKind.OTHER_LENGTH:
            return self._read_of_other_length()
        request = GetCommEventCounter() if kind is MarkerKind.EVENT_COUNTER else ReadExceptionStatus()
        taken = request.code in self.older or any(owed.function == request.code for owed in self.owed)
        taken = taken or self.unasked == request.code
        return None if taken else request

    def _read_of_other_length(self) -> Request | None:
        """A part of a read that was answered, of a length that no owed reply and no last one has."""
        good = self.good
        if good is None or good.wire[0] in self.older:
            return None
        step = 8 if isinstance(good, ReadCoils | ReadDiscreteInputs) else 1
        assert isinstance(good, _READS)
        for count in range(good.count - step, 0, -step):
            part = type(good)(good.address, count)
            part.prepare()
            if not any(_may_be_reply_to(part, owed) for owed in self.owed):
                return part
        return None

    def marked(self, kind: MarkerKind) -> None:
        """A marker was answered."""
        self.works = kind
        self.silent.discard(kind)
        self.unasked = None
        self.alike = 0

    def not_marked(self, kind: MarkerKind) -> None:
        """A marker was not answered."""
        self.silent.add(kind)

    def revived(self) -> None:
        """It answers after it had been given up: that it was silent to markers says nothing any more."""
        self.silent.clear()

    # What it answers in time.

    def heard(self, request: Request, *, is_exception: bool) -> None:
        """It answered a request in time; follow how often its replies looked alike."""
        last, self.last = self.last, request
        if request is last or (
            last is not None and self._is_alike(request, last, is_exception=is_exception)
        ):  # as a rule
            self.alike += 1
        else:
            self.alike = 0
        if not is_exception and request is not self.good and type(request) in _READS:
            self.good = request

    def _is_alike(self, request: Request, last: Request, *, is_exception: bool) -> bool:
        return request.wire[0] == last.wire[0] and (is_exception or _same_shape(request, last))


_READS: Final = (ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters)


def _same_shape(request: Request, other: Request) -> bool:
    """Whether a normal reply to one may be taken for a reply to the other."""
    return (
        request is other
        or UNKNOWN_LENGTH in (request.expected_size, other.expected_size)
        or (request.expected_size == other.expected_size and request.expected_prefix == other.expected_prefix)
    )


def _may_be_reply_to(part: Request, owed: OwedReply) -> bool:
    return owed.function == part.wire[0] and _same_shape(part, owed.request)


class Doubts:
    """The units of one link. It outlives connections, and the link too (`busway.client.doubts`).

    Attributes:
        units: what is known of each unit that was asked.
    """

    __slots__ = ("_number", "units")

    def __init__(self) -> None:
        self.units: dict[int, UnitDoubt] = {}
        self._number = 0

    def of(self, unit: int) -> UnitDoubt:
        """What is known of a unit, from the first time on."""
        found = self.units.get(unit)
        if found is None:
            found = self.units[unit] = UnitDoubt()
        return found

    def marker(self, unit: int, *, is_check: bool = False) -> Marker | None:
        """The next request that may end the doubt of a unit, or None (`UnitDoubt.marker`)."""
        self._number = (self._number + 1) & 0xFFFF
        return self.of(unit).marker(self._number, is_check=is_check)

    def in_doubt(self) -> list[int]:
        """The units that owe something, in their order."""
        return sorted(unit for unit, doubt in self.units.items() if doubt.owed or doubt.unasked is not None)

    @property
    def is_owed(self) -> bool:
        """Whether there is something that another link to the same endpoint must know."""
        return any(not doubt.is_empty for doubt in self.units.values())

    def add(self, other: "Doubts") -> None:
        """Take over what another link to the same endpoint was owed, in the order in which it was asked."""
        for unit, theirs in other.units.items():
            ours = self.of(unit)
            ours.owed = sorted((*ours.owed, *theirs.owed), key=lambda owed: owed.sent)
            for function, count in theirs.older.items():
                ours.older[function] = ours.older.get(function, 0) + count
            ours.pending = sorted((*ours.pending, *theirs.pending), key=lambda owed: owed.sent)
            if ours.unasked is None:
                ours.unasked = theirs.unasked
        self._number = max(self._number, other._number)
