"""Pairs the frames heard on a serial line: which reply answers which request, which is missing, how long it took.

Knows frames and times; knows no port and no clock. The frames come from a receiver in the role of an observer.

1. A request waits for its reply until the next request is heard, or ``reply_window`` has passed. A broadcast awaits
   no reply.
2. A reply of another unit or function than that of the request is stray, and the request goes on waiting.
3. Damaged bytes while a request waits are taken for its reply, if no other comes.
4. If request and reply are alike (05, 06, 08, 22), nothing in the bytes tells a reply from the same request sent again.
   Then time decides: a frame that comes much later than the slowest reply recognised for sure is another request. Until
   enough such replies were heard, every frame within ``reply_window`` is a reply.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from ..codes import BROADCAST_UNIT
from ..framing.frame_direction import REPLY_WINDOW
from ..framing.received import Damage, Damaged, Direction, FrameOrDamage, SerialFrame
from ..pdu.functions import STANDARD, FunctionTable
from ..pdu.malformed_pdu import MalformedPdu

SURE_REPLIES: Final = 3
"""Number of sure replies (different from their requests) whose slowest then limits how late a reply can be (rule 4)."""
MUCH_LATER: Final = 3.0
"""Multiple of the response time of the slowest sure reply. A frame equal to its request that begins later is no reply.

Hardly a unit needs three times as long for a write as the slowest unit for a read.
"""
NEVER_LATE_BEFORE: Final = 0.1
"""Seconds within which a frame equal to the request is always a reply: masters wait longer before they ask again."""


class Kind(Enum):
    """Kinds of events on a serial line: request, broadcast, reply, stray reply, missing reply, damaged bytes."""

    REQUEST = "request"
    BROADCAST = "broadcast"
    REPLY = "reply"
    STRAY = "stray reply"
    UNANSWERED = "no reply"
    DAMAGED = "damaged"


@dataclass(frozen=True, slots=True)
class Heard:
    """One event heard on a serial line: a request, a reply, damaged bytes, or a missing reply.

    Attributes:
        kind: the kind of event.
        frame: the frame; for `Kind.UNANSWERED` the request; None for damaged bytes.
        damaged: the damaged bytes; for `Kind.UNANSWERED` those that came in place of the reply, if any did.
        gap: seconds of silence before the frame or damaged bytes; None for the first ones and for `Kind.UNANSWERED`.
        request: for a reply, the request that it answers; otherwise None.
        response_time: for a reply, seconds from the end of the request to the beginning of the reply; for
            `Kind.UNANSWERED`, seconds that were waited; otherwise None.
        is_repeat: for a request, whether the request before it had the same bytes and got no reply.
    """

    kind: Kind
    frame: SerialFrame | None = None
    damaged: Damaged | None = None
    gap: float | None = None
    request: SerialFrame | None = None
    response_time: float | None = None
    is_repeat: bool = False

    @property
    def at(self) -> float:
        """Time in seconds, by the clock of the frames, at which the frame or the damaged bytes began.

        For `Kind.UNANSWERED`, the time at which waiting for the reply ended.
        """
        if self.kind is Kind.UNANSWERED and self.frame is not None and self.response_time is not None:
            return self.frame.ended + self.response_time
        found = self.frame if self.frame is not None else self.damaged
        assert found is not None
        return found.began


@dataclass(slots=True)
class ResponseTimes:
    """Number, sum and extremes of the response times of a unit, in seconds; all 0 before the first."""

    count: int = 0
    total: float = 0.0
    fastest: float = 0.0
    slowest: float = 0.0

    def add(self, seconds: float) -> None:
        """Add the response time of one more reply, in seconds."""
        self.fastest = min(self.fastest, seconds) if self.count else seconds
        self.slowest = max(self.slowest, seconds)
        self.total += seconds
        self.count += 1

    @property
    def mean(self) -> float:
        """The mean response time in seconds; 0 without any."""
        return self.total / self.count if self.count else 0.0


@dataclass(slots=True)
class UnitStatistics:
    """Counts and response times of one unit, as heard on a serial line.

    Attributes:
        requests: number of requests to the unit, repeats included.
        repeats: number of requests with the same bytes as the unanswered request directly before them on the line; the
            next regular poll counts too.
        replies: number of replies that answered a request, exceptions included.
        exceptions: number of exception replies among them.
        unanswered: number of requests without a reply, those with a damaged one included.
        damaged_replies: number of requests after which damaged bytes came in place of the reply.
        stray_replies: number of replies that answered no request.
        response_times: the response times of the replies.
    """

    requests: int = 0
    repeats: int = 0
    replies: int = 0
    exceptions: int = 0
    unanswered: int = 0
    damaged_replies: int = 0
    stray_replies: int = 0
    response_times: ResponseTimes = field(default_factory=ResponseTimes)


@dataclass(slots=True)
class LineStatistics:
    """Counts and response times of all units, as heard on a serial line.

    Attributes:
        frames: number of good frames.
        frame_bytes: number of bytes in them.
        broadcasts: number of frames for unit 0.
        damaged: number of times that damaged bytes were heard, by reason.
        damaged_bytes: number of damaged bytes.
        busy: seconds that frames and damaged bytes lasted; 0 over a network.
        units: the statistics of each unit, by number.
    """

    frames: int = 0
    frame_bytes: int = 0
    broadcasts: int = 0
    damaged: Counter[Damage] = field(default_factory=Counter)
    damaged_bytes: int = 0
    busy: float = 0.0
    units: dict[int, UnitStatistics] = field(default_factory=dict)

    def unit(self, number: int) -> UnitStatistics:
        """Return the statistics of a unit 0…255, created at its first use."""
        return self.units.setdefault(number, UnitStatistics())


class Pairing:
    """Finds out which reply on a serial line answers which request, from the frames heard in order.

    Attributes:
        statistics: counts and response times so far.
        reply_window: seconds for which a reply is awaited.
    """

    __slots__ = ("_asked", "_damage", "_functions", "_last_end", "_missed", "_sure", "reply_window", "statistics")

    def __init__(self, reply_window: float = REPLY_WINDOW, *, functions: FunctionTable = STANDARD) -> None:
        """Create a pairing that has heard no request yet.

        Args:
            reply_window: seconds for which a reply is awaited, above 0.
            functions: the table of functions; it tells whether a frame that is equal to its request may be the reply.
        """
        self.statistics: LineStatistics = LineStatistics()
        self.reply_window: float = reply_window
        self._functions = functions
        self._asked: SerialFrame | None = None
        self._damage: Damaged | None = None  # what came while `_asked` waits
        self._missed: SerialFrame | None = None  # the request that stayed unanswered just before
        self._last_end: float | None = None
        self._sure = ResponseTimes()

    def heard(self, found: FrameOrDamage) -> list[Heard]:
        """Process a frame or damaged bytes. Returns the resulting events in order.

        The event of a missing reply comes first, if the frame shows that the request before it got none.
        """
        events = self.tick(found.began)
        gap = None if self._last_end is None else max(found.began - self._last_end, 0.0)
        self._last_end = found.ended
        self.statistics.busy += max(found.ended - found.began, 0.0)
        if isinstance(found, Damaged):
            events.append(self._damaged(found, gap))
        else:
            self.statistics.frames += 1
            self.statistics.frame_bytes += len(found.raw)
            self._frame(found, gap, events)
        return events

    def tick(self, now: float) -> list[Heard]:
        """Return the event `Kind.UNANSWERED` if ``reply_window`` after the last request is over; else an empty list.

        ``now`` is the time in seconds by the clock of the frames.
        """
        deadline = self.deadline()
        return [] if deadline is None or now < deadline else [self._unanswered(deadline)]

    def deadline(self) -> float | None:
        """Return the time in seconds, by the clock of the frames, at which the last request counts as unanswered.

        None if no reply is awaited.
        """
        return None if self._asked is None else self._asked.ended + self.reply_window

    # Inside.

    def _frame(self, frame: SerialFrame, gap: float | None, events: list[Heard]) -> None:
        asked = self._asked
        if self._is_reply(frame, asked):
            if asked is not None and _answers(frame, asked):
                events.append(self._reply(frame, asked, gap))
            else:
                self.statistics.unit(frame.unit).stray_replies += 1
                events.append(Heard(Kind.STRAY, frame, gap=gap))
            return
        if asked is not None:
            events.append(self._unanswered(frame.began))
        events.append(self._request(frame, gap))

    def _is_reply(self, frame: SerialFrame, asked: SerialFrame | None) -> bool:
        if asked is not None and frame.raw == asked.raw:
            return self._may_reply(frame) and frame.began - asked.ended <= self._reply_limit()
        if frame.direction is Direction.UNKNOWN:
            return asked is not None and _answers(frame, asked)
        return frame.direction is Direction.REPLY

    def _may_reply(self, frame: SerialFrame) -> bool:
        """Whether a frame with the bytes of the last request is also a valid reply."""
        try:
            self._functions.decode_reply(frame.pdu)
        except MalformedPdu:
            return False
        return True

    def _reply_limit(self) -> float:
        """Return for how many seconds the bytes of a request, heard again, count as its reply (rule 4)."""
        if self._sure.count < SURE_REPLIES:
            return self.reply_window
        return min(max(MUCH_LATER * self._sure.slowest, NEVER_LATE_BEFORE), self.reply_window)

    def _request(self, frame: SerialFrame, gap: float | None) -> Heard:
        missed, self._missed = self._missed, None
        if frame.unit == BROADCAST_UNIT:
            self.statistics.broadcasts += 1
            return Heard(Kind.BROADCAST, frame, gap=gap)
        is_repeat = missed is not None and missed.raw == frame.raw
        unit = self.statistics.unit(frame.unit)
        unit.requests += 1
        unit.repeats += is_repeat
        self._asked = frame
        return Heard(Kind.REQUEST, frame, gap=gap, is_repeat=is_repeat)

    def _reply(self, frame: SerialFrame, asked: SerialFrame, gap: float | None) -> Heard:
        time = max(frame.began - asked.ended, 0.0)
        unit = self.statistics.unit(frame.unit)
        unit.replies += 1
        unit.exceptions += frame.pdu[0] >> 7
        unit.response_times.add(time)
        if frame.raw != asked.raw:
            self._sure.add(time)
        self._asked = self._damage = self._missed = None
        return Heard(Kind.REPLY, frame, gap=gap, request=asked, response_time=time)

    def _damaged(self, found: Damaged, gap: float | None) -> Heard:
        self.statistics.damaged[found.reason] += 1
        self.statistics.damaged_bytes += found.size
        if self._asked is not None:
            self._damage = found
        return Heard(Kind.DAMAGED, damaged=found, gap=gap)

    def _unanswered(self, until: float) -> Heard:
        """Count the last request as unanswered, and return the event; waiting ended at the time ``until`` (seconds)."""
        asked, damage = self._asked, self._damage
        assert asked is not None
        unit = self.statistics.unit(asked.unit)
        unit.unanswered += 1
        unit.damaged_replies += damage is not None
        self._missed = asked
        self._asked = self._damage = None
        return Heard(Kind.UNANSWERED, asked, damage, response_time=max(until - asked.ended, 0.0))


def _answers(reply: SerialFrame, asked: SerialFrame) -> bool:
    """Whether a reply, or an exception reply, has the unit and the function of a request."""
    return reply.unit == asked.unit and reply.pdu[0] & 0x7F == asked.pdu[0]
