"""Finds the reply to each request of a capture, and what is wrong with request and reply.

Knows frames of a capture and the rules of replies; knows no file. `conversations` counts the exchanges found.

1. On TCP and UDP a reply belongs to the oldest waiting request with its transaction identifier. Frames of RTU and ASCII
   have no identifier: over a network a reply belongs to the request before it, on a line `busway.observe.pairing`
   decides.
2. A request waits until its reply comes, its identifier is used again after ``reply_window`` seconds, or the connection
   ends; over a network without identifiers also until the next request. A reply that comes after ``reply_window`` is
   late. A request that has waited for less than ``reply_window`` when the capture ends is no trouble.
3. A missing reply is not the device's fault if the capture lacks bytes of that direction: the trouble says so.
4. At most `MOST_WAITING` requests of a connection wait; then the oldest counts as unanswered.
"""

from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from ...codes import exception_meaning, function_name
from ...framing.received import Direction
from ...observe.capture_files.frame_extraction import (
    CapturedChannel,
    CapturedFrame,
    ChannelEnd,
    ChannelEnding,
    FaultyBytes,
    TrafficEvent,
    TrafficFault,
)
from ...observe.pairing import Heard, Kind, Pairing
from ...pdu.exception_response import ExceptionResponse
from ...pdu.functions import STANDARD, AnyRequest
from ...pdu.malformed_pdu import MalformedPdu
from ...pdu.malformed_request import MalformedRequest
from ...pdu.message import Message, Request
from ...values import Address, format_address

MOST_WAITING: Final = 4096
_REMEMBERED: Final = 16
"""Number of latest frames of a line that are kept with their packet numbers, for events that refer to them later."""


class TroubleKind(Enum):
    """Kinds of troubles in a capture; the value is the text that reports show."""

    NO_REPLY = "no reply"
    LATE_REPLY = "late reply"
    SLOW_REPLY = "slow reply"
    EXCEPTION = "exception"
    UNMATCHED = "reply without a request"
    DUPLICATE = "transaction number in use already"
    REPEATED = "request sent again"
    WRONG_UNIT = "reply of another unit"
    WRONG_FUNCTION = "reply of another function"
    BAD_REQUEST = "malformed request"
    BAD_REPLY = "reply that does not fit"
    BAD_LENGTH = "bad length"
    DAMAGED = "bad CRC or LRC"
    CUT_OFF = "frame cut off"
    FOREIGN_PROTOCOL = "another protocol"
    SKIPPED = "bytes that are no frame"
    MISSING = "missing in the capture"


_OF_BYTES: Final = {
    TrafficFault.MISSING: TroubleKind.MISSING,
    TrafficFault.SKIPPED: TroubleKind.SKIPPED,
    TrafficFault.BAD_LENGTH: TroubleKind.BAD_LENGTH,
    TrafficFault.CUT_OFF: TroubleKind.CUT_OFF,
    TrafficFault.FOREIGN_PROTOCOL: TroubleKind.FOREIGN_PROTOCOL,
    TrafficFault.DAMAGED: TroubleKind.DAMAGED,
}


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that was wrong in a capture.

    Attributes:
        kind: the kind of trouble.
        packet: number of the packet that it concerns, as Wireshark counts: from 1; for a missing reply, the packet of
            the request.
        time: time of that packet, seconds since 1970.
        text: details in words; may be empty.
    """

    kind: TroubleKind
    packet: int
    time: float
    text: str


@dataclass(frozen=True, slots=True)
class CapturedExchange:
    """A request and its reply in a capture; or only one of them; or bytes that are no frame.

    On a serial line, a request that repeats the one before it, which got no reply, has two exchanges: one with the
    trouble `TroubleKind.REPEATED` only, where ``asked`` and ``answered`` are None, and a later one with its outcome.

    Attributes:
        channel: the connection or line.
        unit: unit identifier of the request, or of a reply without request. For bytes that are no frame, that of a
            request that waits for its reply; None if none does or it is not known.
        time: time of the first frame or of the bytes, seconds since 1970.
        asked: the frame of the request; None if there is none.
        request: the decoded request, a `MalformedRequest` if it is malformed; None without request or if its function
            code is not 1…127.
        answered: the frame of the reply; None if there is none.
        reply: the decoded reply; None without reply, or if it is malformed, of another function, or does not fit the
            request.
        seconds: response time, from request to reply; None if one of them is missing.
        troubles: what is wrong with the exchange; empty if nothing is.
        is_open: whether the request still waited for its reply when the capture ended.
        is_broadcast: whether the request is a broadcast, which no unit answers.
    """

    channel: CapturedChannel
    unit: int | None
    time: float
    asked: CapturedFrame | None = None
    request: AnyRequest | None = None
    answered: CapturedFrame | None = None
    reply: Message | None = None
    seconds: float | None = None
    troubles: tuple[Trouble, ...] = ()
    is_open: bool = False
    is_broadcast: bool = False

    @property
    def exception(self) -> int | None:
        """The exception code of the reply; None if there is no reply, or it is no exception."""
        return self.reply.exception if isinstance(self.reply, ExceptionResponse) else None


class Exchanges:
    """Finds the exchanges of a capture: takes the events of `CapturedTraffic`, and joins requests with their replies.

    Args:
        reply_window: seconds after which a reply is reported as late.
        slow: seconds after which a reply that is not late is reported as slow.
    """

    def __init__(self, reply_window: float = 3.0, slow: float = 1.0) -> None:
        self._reply_window = reply_window
        self._slow = slow
        self._matchers: dict[int, _NetworkMatcher | _LineMatcher] = {}

    def take(self, event: TrafficEvent) -> Iterator[CapturedExchange]:
        """Process the next event of the capture, and yield the exchanges that are now complete; often none.

        Call it for each event in order, and use up each iterator before the next event.
        """
        channel = event.channel
        matcher = self._matchers.get(channel.number)
        if matcher is None:
            matcher = (
                _LineMatcher(self._reply_window) if channel.client is None else _NetworkMatcher(self._reply_window)
            )
            self._matchers[channel.number] = matcher
        if isinstance(event, ChannelEnd):
            del self._matchers[channel.number]
        for exchange in matcher.take(event):
            yield self._judged(exchange)

    def _judged(self, exchange: CapturedExchange) -> CapturedExchange:
        """Return the exchange, with added troubles if its reply is late, slow or an exception."""
        answered, seconds = exchange.answered, exchange.seconds
        if answered is None:
            return exchange
        added = []
        if seconds is not None and seconds > self._reply_window:
            added.append((TroubleKind.LATE_REPLY, f"after {seconds:.3f} s"))
        elif seconds is not None and seconds > self._slow:
            added.append((TroubleKind.SLOW_REPLY, f"after {seconds:.3f} s"))
        if exchange.exception is not None:
            asked = f"{function_name(answered.pdu[0] & 0x7F)}{_place(exchange.request)}"
            meaning = f"{exchange.exception:02X}, {exception_meaning(exchange.exception)}"
            added.append((TroubleKind.EXCEPTION, f"{meaning}, to {asked}"))
        if not added:
            return exchange
        troubles = tuple(Trouble(kind, answered.packet, answered.time, text) for kind, text in added)
        return replace(exchange, troubles=exchange.troubles + troubles)


def _place(request: AnyRequest | None) -> str:
    """Return the first range of items that a request reads or writes as text to append: ``, 2 from 4x101 on``.

    Empty if the request has no items, or is None or malformed.
    """
    if not isinstance(request, Request):
        return ""
    return "".join(
        f", {each.count} from {format_address(Address(each.table, each.address))} on" for each in request.spans()[:1]
    )


def _decoded(asked: CapturedFrame) -> tuple[AnyRequest | None, list[Trouble]]:
    if not 0 < asked.pdu[0] < 0x80:
        text = f"a request has a function code 1…127, not {asked.pdu[0]}"
        return None, [Trouble(TroubleKind.BAD_REQUEST, asked.packet, asked.time, text)]
    request = STANDARD.decode_request(asked.pdu)
    if isinstance(request, MalformedRequest):
        return request, [Trouble(TroubleKind.BAD_REQUEST, asked.packet, asked.time, request.reason)]
    return request, []


def _reply_to(request: AnyRequest | None, answered: CapturedFrame) -> tuple[Message | None, list[Trouble]]:
    """Decode a reply with the help of its request, and return the message and an empty list.

    If the reply is malformed or does not fit the request, return None and a list with one trouble.
    """
    try:
        reply = STANDARD.decode_reply(answered.pdu)
        if isinstance(request, Request) and not isinstance(reply, ExceptionResponse):
            request.prepare()
            reply = request.accept(answered.pdu)
    except MalformedPdu as error:
        return None, [Trouble(TroubleKind.BAD_REPLY, answered.packet, answered.time, error.reason)]
    return reply, []


def _of_bytes(event: FaultyBytes, unit: int | None) -> CapturedExchange:
    trouble = Trouble(_OF_BYTES[event.fault], event.packet, event.time, event.text)
    return CapturedExchange(event.channel, unit, event.time, troubles=(trouble,))


def _unmatched(answered: CapturedFrame, text: str) -> CapturedExchange:
    trouble = Trouble(TroubleKind.UNMATCHED, answered.packet, answered.time, text)
    return CapturedExchange(answered.channel, answered.unit, answered.time, answered=answered, troubles=(trouble,))


@dataclass(slots=True)
class _Waiting:
    """A request of a capture that waits for its reply.

    Attributes:
        asked: the frame of the request.
        request: the decoded request; None if its function code is not 1…127.
        troubles: what is wrong with the request.
        lacks_bytes: whether the capture lacks bytes that may have been the reply.
    """

    asked: CapturedFrame
    request: AnyRequest | None
    troubles: list[Trouble]
    lacks_bytes: bool = False

    def exchange(self, *more: Trouble, is_open: bool = False) -> CapturedExchange:
        """Return an exchange that has this request and no reply; ``more`` are added to the troubles of the request.

        ``is_open``: the request still waits for its reply when the capture ends.
        """
        asked = self.asked
        troubles = (*self.troubles, *more)
        return CapturedExchange(
            asked.channel, asked.unit, asked.time, asked, self.request, troubles=troubles, is_open=is_open
        )

    def unanswered(self, why: str = "") -> CapturedExchange:
        """Return an exchange that has this request and no reply, with the trouble `TroubleKind.NO_REPLY`.

        If the capture lacks bytes that may have been the reply, the trouble is `TroubleKind.MISSING` instead. ``why``
        is appended to its text.
        """
        kind, text = TroubleKind.NO_REPLY, f"to {function_name(self.asked.pdu[0])}{_place(self.request)}{why}"
        if self.lacks_bytes:
            kind, text = TroubleKind.MISSING, f"perhaps the reply {text}"
        return self.exchange(Trouble(kind, self.asked.packet, self.asked.time, text))

    def answered_by(self, answered: CapturedFrame) -> CapturedExchange:
        """Return the exchange of this request and its reply, with troubles if the reply does not fit the request."""
        asked = self.asked
        packet, time = answered.packet, answered.time
        troubles = list(self.troubles)
        reply: Message | None = None
        if answered.unit != asked.unit:
            text = f"unit {answered.unit}, where {asked.unit} was asked"
            troubles.append(Trouble(TroubleKind.WRONG_UNIT, packet, time, text))
        if answered.pdu[0] & 0x7F != asked.pdu[0] & 0x7F:
            text = f"function {answered.pdu[0] & 0x7F}, where {asked.pdu[0]} was asked"
            troubles.append(Trouble(TroubleKind.WRONG_FUNCTION, packet, time, text))
        else:
            reply, wrong = _reply_to(self.request, answered)
            troubles += wrong
        seconds = max(time - asked.time, 0.0)
        return CapturedExchange(
            asked.channel, asked.unit, asked.time, asked, self.request, answered, reply, seconds, tuple(troubles)
        )


class _NetworkMatcher:
    """Joins requests and replies of one TCP connection or UDP conversation, where the capture shows their direction."""

    def __init__(self, reply_window: float) -> None:
        self._window = reply_window
        self._waiting: OrderedDict[int | None, deque[_Waiting]] = OrderedDict()
        self._size = 0

    def take(self, event: TrafficEvent) -> Iterator[CapturedExchange]:
        """Process the next event of the connection, and yield the exchanges that are now complete."""
        if isinstance(event, ChannelEnd):
            yield from self._end(event)
        elif isinstance(event, FaultyBytes):
            yield self._faulty(event)
        elif event.direction is Direction.REQUEST:
            yield from self._request(event)
        else:
            yield self._reply(event)

    def _request(self, asked: CapturedFrame) -> Iterator[CapturedExchange]:
        request, troubles = _decoded(asked)
        number = asked.transaction
        queue = self._waiting.setdefault(number, deque())
        while queue and (number is None or asked.time - queue[0].asked.time > self._window):
            yield self._pop(number).unanswered()
            queue = self._waiting.setdefault(number, deque())
        if queue:
            text = f"{number}, of packet {queue[-1].asked.packet}"
            repeated = queue[-1].asked.raw == asked.raw
            kind = TroubleKind.REPEATED if repeated else TroubleKind.DUPLICATE
            troubles.append(Trouble(kind, asked.packet, asked.time, text))
        queue.append(_Waiting(asked, request, troubles))
        self._size += 1
        if self._size > MOST_WAITING:
            yield self._pop(next(iter(self._waiting))).unanswered()

    def _reply(self, answered: CapturedFrame) -> CapturedExchange:
        number = answered.transaction
        queue = self._waiting.get(number)
        if not queue:
            return _unmatched(answered, "" if number is None else f"transaction {number}")
        if number is None and (answered.unit, answered.pdu[0] & 0x7F) != (queue[0].asked.unit, queue[0].asked.pdu[0]):
            return _unmatched(answered, f"{function_name(answered.pdu[0] & 0x7F)}")
        return self._pop(number).answered_by(answered)

    def _pop(self, number: int | None) -> _Waiting:
        queue = self._waiting[number]
        found = queue.popleft()
        self._size -= 1
        if not queue:
            del self._waiting[number]
        return found

    def _faulty(self, event: FaultyBytes) -> CapturedExchange:
        if event.fault in (TrafficFault.MISSING, TrafficFault.SKIPPED) and event.direction is not Direction.REQUEST:
            for queue in self._waiting.values():
                for each in queue:
                    each.lacks_bytes = True
        first = next((queue[0].asked.unit for queue in self._waiting.values()), None)
        return _of_bytes(event, first)

    def _end(self, end: ChannelEnd) -> Iterator[CapturedExchange]:
        waiting = sorted(
            (each for queue in self._waiting.values() for each in queue), key=lambda each: each.asked.packet
        )
        for each in waiting:
            if end.ending is ChannelEnding.CAPTURE_ENDS and end.time - each.asked.time <= self._window:
                yield each.exchange(is_open=True)
            else:
                why = {
                    ChannelEnding.CLOSED: "; the connection was closed",
                    ChannelEnding.RESET: "; the connection was reset",
                }.get(end.ending, "")
                yield each.unanswered(why)


class _LineMatcher:
    """Joins requests and replies of one serial line, where `Pairing` has to find out which frame is which."""

    def __init__(self, reply_window: float) -> None:
        self._pairing = Pairing(reply_window)
        self._frames: OrderedDict[int, CapturedFrame] = OrderedDict()
        self._now = 0.0

    def take(self, event: TrafficEvent) -> Iterator[CapturedExchange]:
        """Process the next event of the line, and yield the exchanges that are now complete."""
        if isinstance(event, ChannelEnd):
            asked = self._pairing.deadline()
            for heard in self._pairing.tick(max(event.time, self._now)):
                yield from self._told(heard, event)
            if asked is not None and self._pairing.deadline() is not None:
                yield from self._still_open()
            return
        if event.received is None:
            yield _of_bytes(event, None) if isinstance(event, FaultyBytes) else _unmatched(event, "")
            return
        if isinstance(event, CapturedFrame):
            self._frames[id(event.received)] = event  # which keeps the object, so its id
            if len(self._frames) > _REMEMBERED:
                self._frames.popitem(last=False)
        self._now = max(self._now, event.received.ended)
        for heard in self._pairing.heard(event.received):
            yield from self._told(heard, event)

    def _told(self, heard: Heard, event: TrafficEvent) -> Iterator[CapturedExchange]:
        frame = None if heard.frame is None else self._frames.get(id(heard.frame))
        asked = None if heard.request is None else self._frames.get(id(heard.request))
        if heard.kind is Kind.DAMAGED:
            assert isinstance(event, FaultyBytes)
            yield _of_bytes(event, self._asked_unit())
        elif frame is None:
            return
        elif heard.kind is Kind.REPLY and asked is not None:
            waiting = self._waiting(asked)
            yield replace(waiting.answered_by(frame), seconds=heard.response_time)
        elif heard.kind is Kind.STRAY:
            yield _unmatched(frame, function_name(frame.pdu[0] & 0x7F))
        elif heard.kind is Kind.UNANSWERED:
            yield self._waiting(frame).unanswered("; damaged bytes came" if heard.damaged is not None else "")
        elif heard.kind is Kind.BROADCAST:
            yield replace(self._waiting(frame).exchange(), is_broadcast=True)
        elif heard.kind is Kind.REQUEST and heard.is_repeat:
            trouble = Trouble(TroubleKind.REPEATED, frame.packet, frame.time, function_name(frame.pdu[0]))
            yield CapturedExchange(frame.channel, frame.unit, frame.time, troubles=(trouble,))

    def _waiting(self, asked: CapturedFrame) -> _Waiting:
        return _Waiting(asked, *_decoded(asked))

    def _asked_unit(self) -> int | None:
        if self._pairing.deadline() is None:
            return None
        last = next((each for each in reversed(self._frames.values())), None)
        return None if last is None else last.unit

    def _still_open(self) -> Iterator[CapturedExchange]:
        last = next((each for each in reversed(self._frames.values())), None)
        if last is not None:
            yield self._waiting(last).exchange(is_open=True)
