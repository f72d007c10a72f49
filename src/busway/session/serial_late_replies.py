"""Late replies on a serial line: which may still come, and which requests must wait for them to be told apart.

Knows requests, units and times; knows no bytes of a frame beyond its PDU, no port and no clock.

Frames of RTU and ASCII have no transaction identifiers. A reply is matched to its request by unit, function, length
and echo; a late reply to an earlier request may have all of these in common. The order is reliable: a unit answers each
request at most once, and in the order in which it received them.

1. A request without a reply is *owed* one (`OwedReply`), until the reply comes or a reply to a later request shows that
   it will not come. This holds across connections, and no time limit ends it.
2. A reply belongs to the earliest request to its unit that it could answer. Requests sent before that request get no
   reply any more.
3. A unit is *in doubt* for a request while another call is owed a reply that could be taken for the reply to it. For a
   read these are owed replies of the same function and length; an exception reply, which has no such length, is taken
   for an owed one. For a write these are all owed replies of its function: a write cannot be repeated to make sure.
4. Such a request is sent only after a *marker*: a harmless request whose reply cannot be taken for an owed one. After
   the reply to the marker the unit is no longer in doubt (rule 2).
5. A unit may break the order. So while a reply to a function is owed, the next request with that function waits until
   twice the timeout has passed since the last attempt, or until as many replies have come as are owed. The option
   ``trust_reply_order`` skips that.
6. If a unit answers no marker, the read itself is sent: replies are counted against the owed ones (rule 2), so
   a read may have to be repeated, but its result is never wrong. Only one call at a time does so: two would owe each
   other their replies for ever. A write is not sent.
7. A unit that sent a frame without a request, or too early, is in doubt for that function. Such frames may also look
   like good replies: then every reply answers the request before. So after `CHECK_EVERY` replies in a row that are
   alike in function and length a marker is sent, whose reply shows whether replies are shifted.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Final

from ..pdu.diagnostics import GetCommEventCounter, ReadExceptionStatus, ReturnQueryData
from ..pdu.message import UNKNOWN_LENGTH, Request
from ..pdu.read_items import ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters
from .call import Call

CHECK_EVERY: Final = 128
"""Number of replies in a row that are alike in function and length, after which a marker is sent to check that replies
are not shifted by one request (rule 7). So markers are less than a hundredth of the requests.
"""
OWED_LIMIT: Final = 256
"""Owed replies of a unit that are kept one by one; of earlier ones only the number is kept. A unit that is dead for an
hour is probed about 400 times.
"""
_EXCEPTION: Final = 0x80


class MarkerKind(Enum):
    """Kinds of marker requests: harmless ones whose reply proves that no older reply will come.

    The kind that the unit answered last is tried first, then the others in this order; kinds that it did not answer are
    left out. The regular checks after `CHECK_EVERY` similar replies use only the kinds in `_OF_CHECKS`, in that order.
    """

    RETURN_QUERY_DATA = "08/00 with a number of its own"
    OTHER_LENGTH = "a read that was answered before, but shorter"
    EVENT_COUNTER = "0B"
    EXCEPTION_STATUS = "07"


_OF_CHECKS: Final = (MarkerKind.OTHER_LENGTH, MarkerKind.RETURN_QUERY_DATA)


@dataclass(frozen=True, slots=True)
class Marker:
    """A harmless request that the session sends itself; its reply proves that no older reply will come.

    When it is sent: rule 4 of this module.

    Attributes:
        kind: the kind of request.
        request: the request, prepared to be sent.
    """

    kind: MarkerKind
    request: Request


@dataclass(frozen=True, slots=True, eq=False)
class OwedReply:
    """A request that got no reply in time; its reply may still come.

    Attributes:
        request: the request, prepared.
        function: its function code.
        sent: when its last byte left, in seconds.
        until: time in seconds up to which other requests of the same function wait for this reply (rule 5).
        call, position: the call that made the request, and its position there; ``call`` is None for a marker request,
            or for a cancelled call.
        times: number of attempts in a row that this entry stands for; above 1 only when the list is full.
        echoed: whether its echo was received, on a line that echoes.
    """

    request: Request
    function: int
    sent: float
    until: float
    call: object | None = None
    position: int = 0
    times: int = 1
    echoed: bool = False

    def may_be(self, pdu: bytes) -> bool:
        """Whether a received PDU could be the late reply to this request."""
        return may_answer(self.request, pdu)

    def is_of(self, call: object, position: int) -> bool:
        """Whether this is an attempt at the request at ``position`` of ``call``; False for a marker request."""
        return self.call is call and self.position == position and call is not None


@dataclass(slots=True)
class UnitLateReplies:
    """The late replies that one unit may still send, and which kinds of marker requests (see `Marker`) it answers.

    Attributes:
        owed: the replies that may still come, in the order of their requests.
        older: number of further owed replies by function code, requested before all of ``owed``.
        pending: owed replies because of which new requests with the same function code wait (rule 5).
        unasked: the function code of a frame that the unit sent without a request; None if there was no such frame.
        delay: seconds that its last late reply had taken; None before the first, and after a reply in time.
        last: the request that the unit answered last; None before the first.
        alike: number of replies in a row that agree in function and length with the one before (rule 7).
        silent: kinds of marker requests that the unit did not answer.
        works: the kind of marker request that the unit answered last; None before the first.
        good: a read that the unit answered without an exception; None before the first.
        counting: the call whose read is repeated until the owed replies have come (rule 6); None without such a call.
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
    counting: Call | None = None

    # Owed replies.

    def owe(self, reply: OwedReply) -> None:
        """Record a request that was not answered in time, or before the connection ended: its reply may still come.

        If ``owed`` is full (`OWED_LIMIT`), the oldest reply is counted in ``older`` instead. An attempt at the request
        of the last entry then only raises ``times`` of that entry.
        """
        self.pending = [one for one in self.pending if one.until > reply.sent]
        if len(self.pending) >= OWED_LIMIT:
            self.pending.remove(min(self.pending, key=lambda one: one.until))
        self.pending.append(reply)
        if len(self.owed) >= OWED_LIMIT:
            last = self.owed[-1]
            if last.is_of(reply.call, reply.position):  # a read that counts off the others must not push them out
                self.owed[-1] = replace(last, times=last.times + 1)
                return
            first = self.owed[0]
            self.older[first.function] = self.older.get(first.function, 0) + first.times
            del self.owed[0]  # only now: an interrupt may have it owed twice, but never forgotten
        self.owed.append(reply)

    def is_owed_since(self, request: Request, sent: float) -> bool:
        """Whether the last entry of ``owed`` is for the attempt at ``request`` whose last byte left at ``sent``."""
        return bool(self.owed) and self.owed[-1].request is request and self.owed[-1].sent == sent

    def is_older(self, pdu: bytes) -> bool:
        """Whether a received PDU counts as one of the late replies in ``older``, of which only the number is known.

        False for a reply to 08/00, whose data identify its request.
        """
        function = pdu[0] & ~_EXCEPTION
        return function in self.older and pdu[0] != ReturnQueryData.code

    def older_came(self, pdu: bytes) -> None:
        """Record that one of the late replies in ``older`` was received: reduce the number for its function code.

        ``pending`` stays unchanged: a new request must not be sent too early because of it.
        """
        function = pdu[0] & ~_EXCEPTION
        left = self.older[function] - 1
        if left:
            self.older[function] = left
        else:
            del self.older[function]

    def candidates(self, pdu: bytes) -> list[OwedReply]:
        """Return the replies in ``owed`` that a received PDU could be, the earliest first.

        The caller takes the PDU for the first of them (rule 2).
        """
        return [owed for owed in self.owed if owed.may_be(pdu)]

    def echo_came(self, pdu: bytes) -> bool:
        """Return whether a received PDU is the late echo of a request in ``owed``, on a line that echoes.

        It is if the earliest such request without an echo has the same bytes; that request has its echo then.
        """
        for index, owed in enumerate(self.owed):
            if not owed.echoed and owed.request.wire == pdu:
                self.owed[index] = replace(owed, echoed=True)
                return True
        return False

    def came(self, reply: OwedReply) -> None:
        """Record that a late reply has come: remove it, and all owed replies to earlier requests (rule 2).

        An entry that stands for several attempts loses one of its ``times``. The earliest reply with the same function
        code leaves ``pending``.
        """
        index = self.owed.index(reply)
        if reply.times > 1:
            self.owed[index] = replace(reply, times=reply.times - 1)
            del self.owed[:index]
        else:
            del self.owed[: index + 1]
        self.older.clear()
        self._count(reply.function)

    def _count(self, function: int) -> None:
        """Remove the earliest reply with this function code from ``pending``, because a late reply has come."""
        for index, owed in enumerate(self.pending):
            if owed.function == function:
                del self.pending[index]
                return

    def answered(self, request: Request) -> None:
        """Forget all late replies of the unit: its reply to ``request`` proves that none is left (rule 2).

        A frame sent without a request (``unasked``) is forgotten too, unless it had the function code of ``request``.
        ``pending`` stays: requests that wait because of it go on waiting.
        """
        self.owed.clear()
        self.older.clear()
        if request.wire[0] != self.unasked:
            self.unasked = None

    # Requests that may be sent.

    def in_doubt(self, request: Request, call: object, position: int) -> bool:
        """Whether a late reply, or a frame sent without a request, could be taken for the reply to this request.

        For a read only replies of the same function and length count, for a write all of its function (rule 3).
        ``call`` and ``position`` identify the request: replies in ``owed`` to earlier attempts at it do not count.
        Those in ``older`` count always, because their requests are not known.
        """
        function = request.wire[0]
        if self.unasked == function or function in self.older:
            return True
        others = [owed for owed in self.owed if owed.function == function and not owed.is_of(call, position)]
        return any(request.is_write or _same_shape(owed.request, request) for owed in others)

    def waits_until(self, function: int, call: object, position: int, now: float) -> float:
        """Return the earliest time at which a request with this function code may be sent, given late replies (rule 5).

        It is ``now`` unless ``pending`` has a reply to another request with this function code; then it is the latest
        ``until`` of these. ``call`` and ``position`` identify the request to send; replies owed to earlier attempts at
        it do not delay it. Entries of ``pending`` whose time is over are removed.
        """
        if not self.pending:
            return now
        self.pending = [owed for owed in self.pending if owed.until > now]
        others = [owed for owed in self.pending if owed.function == function and not owed.is_of(call, position)]
        return max((owed.until for owed in others), default=now)

    @property
    def owed_count(self) -> int:
        """Number of replies that the unit may still send late."""
        return sum(one.times for one in self.owed) + sum(self.older.values())

    @property
    def is_owed(self) -> bool:
        """Whether the unit may still send late replies, or has sent a frame without a request."""
        return bool(self.owed or self.older or self.unasked is not None)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is recorded that concerns requests: `is_owed` is False and ``pending`` is empty."""
        return not self.is_owed and not self.pending

    # Markers.

    def marker(self, number: int, *, is_check: bool = False) -> Marker | None:
        """Return the next marker request to send (see `Marker`); None if no kind of marker can be used.

        A kind cannot be used if the unit did not answer it, or if an owed reply could be taken for its reply.

        Args:
            number: data of a marker of the kind 08/00, 0…65535; no marker whose reply is still owed may have the same.
            is_check: whether it is sent for the regular check after `CHECK_EVERY` similar replies, for which fewer
                kinds are used.
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
        """Return a read to be used as a marker: shorter than one answered before, so that no owed reply has its length.

        None if there is no such read.
        """
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
        """Record that the unit answered this kind of marker request (see `Marker`); it is tried first next time.

        A frame sent without a request (``unasked``) is forgotten, and ``alike`` begins at 0. Owed replies stay here;
        `answered` removes them.
        """
        self.works = kind
        self.silent.discard(kind)
        self.unasked = None
        self.alike = 0

    def not_marked(self, kind: MarkerKind) -> None:
        """Record that the unit did not answer this kind of marker request (see `Marker`)."""
        self.silent.add(kind)

    def revived(self) -> None:
        """Allow all kinds of marker requests (see `Marker`) again, because a unit that was silent has answered."""
        self.silent.clear()

    # Replies in time.

    def heard(self, request: Request, *, is_exception: bool) -> None:
        """Record a request that was answered in time, and count in ``alike`` how many in a row were alike (rule 7).

        They are alike if they have the same function code, and replies of the same length or an exception. A read
        without an exception is stored in ``good``, from which markers are made.
        """
        last, self.last = self.last, request
        if request is last or (last is not None and self._is_alike(request, last, is_exception=is_exception)):
            self.alike += 1
        else:
            self.alike = 0
        if not is_exception and request is not self.good and type(request) in _READS:
            self.good = request

    def _is_alike(self, request: Request, last: Request, *, is_exception: bool) -> bool:
        return request.wire[0] == last.wire[0] and (is_exception or _same_shape(request, last))


def may_answer(request: Request, pdu: bytes) -> bool:
    """Whether a received PDU could be the normal reply, or an exception reply, to a request.

    Judged by function code, length and first bytes; the values in the reply are not looked at.
    """
    if pdu[0] & ~_EXCEPTION != request.wire[0]:
        return False
    if pdu[0] & _EXCEPTION:
        return True
    size = request.expected_size
    return size in (UNKNOWN_LENGTH, len(pdu)) and pdu.startswith(request.expected_prefix)


_READS: Final = (ReadCoils, ReadDiscreteInputs, ReadHoldingRegisters, ReadInputRegisters)


def _same_shape(request: Request, other: Request) -> bool:
    """Whether the normal replies to two requests have the same length and first bytes; True if a length is unknown."""
    return (
        request is other
        or UNKNOWN_LENGTH in (request.expected_size, other.expected_size)
        or (request.expected_size == other.expected_size and request.expected_prefix == other.expected_prefix)
    )


def _may_be_reply_to(part: Request, owed: OwedReply) -> bool:
    return owed.function == part.wire[0] and _same_shape(part, owed.request)


class LateReplies:
    """The late replies that all units of one link may still send.

    The record outlives connections, and is passed on to the next link to the same endpoint.

    Attributes:
        units: the record of each unit that has answered a request, or owes or has owed a reply.
        echoes: number of replies without an echo that would show that the line echoes no more; 0: it does not echo.
    """

    __slots__ = ("_number", "echoes", "units")

    def __init__(self) -> None:
        self.units: dict[int, UnitLateReplies] = {}
        self.echoes: int = 0
        self._number = 0

    def of(self, unit: int) -> UnitLateReplies:
        """Return the record of late replies of one unit, created empty at the first use."""
        found = self.units.get(unit)
        if found is None:
            found = self.units[unit] = UnitLateReplies()
        return found

    def marker(self, unit: int, *, is_check: bool = False) -> Marker | None:
        """Return the next marker request (see `Marker`) for a unit; None if no kind of marker can be used for it.

        Each call uses up one of the numbers that tell markers 08/00 apart.

        ``is_check``: see `UnitLateReplies.marker`.
        """
        self._number = (self._number + 1) & 0xFFFF
        return self.of(unit).marker(self._number, is_check=is_check)

    def in_doubt(self) -> list[int]:
        """Return the units that may still send a late reply or have sent a frame without a request, ascending."""
        return sorted(unit for unit, late in self.units.items() if late.is_owed)

    @property
    def is_owed(self) -> bool:
        """Whether late replies may still come, or requests wait for them.

        Then the next link to the endpoint needs this record. True also after a frame that was sent without a request.
        """
        return any(not late.is_empty for late in self.units.values())

    def add(self, other: "LateReplies") -> None:
        """Add what an earlier link to the same endpoint knew of late replies and echoes; ``other`` stays as it is.

        These are owed replies, merged in the order of their requests, replies for which requests wait (``pending``),
        and frames sent without a request.
        """
        for unit, theirs in other.units.items():
            ours = self.of(unit)
            ours.owed = sorted((*ours.owed, *theirs.owed), key=lambda owed: owed.sent)
            for function, count in theirs.older.items():
                ours.older[function] = ours.older.get(function, 0) + count
            ours.pending = sorted((*ours.pending, *theirs.pending), key=lambda owed: owed.sent)
            if ours.unasked is None:
                ours.unasked = theirs.unasked
        self.echoes = max(self.echoes, other.echoes)
        self._number = max(self._number, other._number)
