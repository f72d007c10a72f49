"""The master of a serial line: one transaction at a time, with turnaround, gaps and safe handling of late replies.

Knows the master's state diagram (Serial Line V1.02 §2.4.1) and how to recover after errors; knows no port and no clock.
RTU and ASCII differ only in the framing that is passed in.

1. States: idle → waiting for a reply (unicast) or for the turnaround (broadcast) → idle. One request is in flight.
2. A reply of another unit keeps the timer running. So does a damaged frame: it is counted, and the request may be
   repeated as after a timeout.
3. After a timeout the line is drained: nothing is sent until it has been silent for ``quiet_window``, at the latest
   until ``drain_limit`` has passed. The unit that did not answer gets no request for ``quiet_window`` from the timeout
   on, unless its late reply comes before. Frames received while the line is drained are late and dropped.
4. A unit that owes a reply is in doubt (`serial_late_replies`): a request whose reply could be confused with the owed
   one is sent only after a marker, a harmless request of the session. A late reply goes to its own call or is dropped.
   Other units are served meanwhile.
5. Nothing is sent before t3.5 after the last byte on the line, ``request_gap`` after a reply and ``unit_switch_gap``
   before a request to another unit. A unit with a gap of its own gets no request for that time; others do.
6. Dead units cost the line no more than a probe (`unit_breaker`); their requests fail with `UnitSuspended`.
7. A request that was cancelled, or whose deadline is over, stays in flight until its reply comes or its time is over.
8. A frame is no reply to a request if it began before t3.5 had passed since the last byte of the request.
9. A line that gives back a request that no unit sends, such as a read, echoes, whatever the option ``echo`` says. From
   then on the first copy of each request is its echo, also where the reply has the same bytes (05, 06, 08, 22): else a
   write that no unit has received would end as done. A late echo is told from a late reply: the first frame with the
   bytes of an owed request is its echo, unless that came in time. Three replies in a row without an echo end all that.
   An echo that the option ``echo`` removes shows it too: the option does not remove the echo of a request that comes
   after the next request was sent.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Final

from ..codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, ExceptionCode
from ..errors import (
    BadReply,
    ExceptionReply,
    InvalidRequest,
    LinkDown,
    ModbusError,
    NoReply,
    UnitSuspended,
)
from ..framing.echo import Echo, EchoFilter
from ..framing.received import Damaged, Direction, FrameOrDamage, SerialFrame
from ..options.client import ClientParameters
from ..options.lines import BreakerParameters, SerialClientParameters
from ..pdu.diagnostics import RestartCommunications
from ..pdu.exception_response import decode_exception
from ..pdu.malformed_pdu import MalformedPdu
from ..pdu.message import Message, Request
from .call import Call
from .call_retries_and_deadlines import CallTracker, function_of
from .client_counters import ClientCounters
from .queue import RequestQueue
from .serial_late_replies import CHECK_EVERY, LateReplies, Marker, MarkerKind, OwedReply, UnitLateReplies, may_answer
from .unit_breaker import Breakers

if TYPE_CHECKING:
    from .line_framing import LineFraming

OWED_FOR: Final = 2.0
"""Multiple of the timeout, counted from the last byte of a request, after which its late reply no longer delays other
requests: even a unit that breaks the order of replies has replied by then (rule 5 of `serial_late_replies`).
"""
_NOTES_AT_MOST: Final = 16
_REPLIES_WITHOUT_ECHO: Final = 3
"""Replies in a row, each without an echo before it, that show that a line echoes no more: one echo can get lost."""
_PACE_FORGETS = 0.9
"""Factor that multiplies the usual response time of a unit at each reply that took less; a reply that took longer sets
the usual response time to its own.
"""


class MasterState(Enum):
    """States of the master of a line (Serial Line V1.02 §2.4.1); DRAINING: it waits for silence after a timeout."""

    IDLE = "idle"
    WAITING_FOR_REPLY = "waiting for reply"
    WAITING_TURNAROUND = "waiting turnaround"
    DRAINING = "draining"


@dataclass(slots=True)
class _RequestInFlight:
    """The request whose reply the master awaits.

    Attributes:
        call: the call of the request; None if the call was cancelled or its deadline is over, and for a marker request.
        request, position: the request, and its position in the call.
        unit, frame: the unit asked, and the bytes sent.
        marker: the marker request that this is; None for a request of a call.
        begun, sent: when its first byte left and when its last byte leaves, in the clock of ``now``.
        expires: when it times out; for a broadcast, when the turnaround delay is over.
        timeout: seconds allowed for a reply, by the options of the call.
        damage: bytes of the last damaged frame since it was sent; empty without one.
        early: whether a frame was received that began too early to be its reply (rule 8).
        echoed: whether its echo was received (rule 9).
    """

    call: Call | None
    request: Request
    position: int
    unit: int
    frame: bytes
    begun: float
    sent: float
    expires: float
    timeout: float
    marker: Marker | None = None
    damage: bytes = b""
    early: bool = False
    echoed: bool = False

    @property
    def deadline(self) -> float | None:
        """The deadline of the call that the request belongs to; None without a call or without a deadline."""
        return None if self.call is None else self.call.deadline


class SerialClientSession:
    """State of one serial line on the client: queue, request in flight, late replies. It survives reopening the port.

    Attributes:
        counters: counters of the link.
        queue: calls with requests left to send.
        finished: calls whose requests all have an outcome; the driver empties the list.
        recycle: why the driver must close the connection and open another; empty if it need not.
        valid_reply: whether the port, since it was opened, has brought a reply in time to a request, even a broken one;
            the driver sets it to False after a timeout, to see whether another comes.
        state: state of the master.
        breakers: the circuit breakers of the units.
        late_replies: the late replies that units may still send.
        notes: texts for a trace about late replies and markers; the driver empties the list.
        characters_take_time: whether sending takes the computed time of the characters, as on a wire. On a
            pseudo-terminal it does not: a reply may come before the computed end of its request.
    """

    __slots__ = (
        "_awaited",
        "_connected",
        "_doubtful",
        "_drain_until",
        "_echo",
        "_framing",
        "_last_byte",
        "_last_unit",
        "_not_asked_before",
        "_not_before",
        "_pace",
        "_receiver",
        "_serial",
        "_timeouts_in_row",
        "_tracker",
        "_try_at",
        "_unit_gaps",
        "breakers",
        "characters_take_time",
        "counters",
        "finished",
        "late_replies",
        "notes",
        "parameters",
        "queue",
        "recycle",
        "state",
        "valid_reply",
    )

    def __init__(
        self,
        parameters: ClientParameters,
        *,
        framing: "LineFraming",
        jitter: Callable[[], float],
        serial: SerialClientParameters | None = None,
        breaker: BreakerParameters | None = None,
        endpoint: str = "",
        late_replies: LateReplies | None = None,
    ) -> None:
        """Create the client session of a serial line; the port is opened later.

        Args:
            parameters: timeout, retries, gaps, queue.
            framing: the framing, in the role of a master.
            jitter: returns a number 0…1, for the pauses of `unit_breaker`.
            serial: turnaround, gaps and drain.
            breaker: when units are suspended.
            endpoint: URL of the link, for errors.
            late_replies: the late replies owed to an earlier link to the same endpoint.
        """
        self.parameters: ClientParameters = parameters
        self.recycle: str = ""
        self.late_replies: LateReplies = late_replies or LateReplies()
        self.notes: list[str] = []
        self.characters_take_time: bool = True
        self.valid_reply: bool = False
        self.state: MasterState = MasterState.IDLE
        self.breakers: Breakers = Breakers(breaker or BreakerParameters(), jitter)
        self._doubtful = self.breakers.doubtful  # units that timed out and have not answered since
        self._not_asked_before: dict[int, float] = {}
        self._tracker = CallTracker(parameters, endpoint)
        self.counters: ClientCounters = self._tracker.counters
        self.queue: RequestQueue = self._tracker.queue
        self.finished: list[Call] = self._tracker.finished
        self._serial = serial or SerialClientParameters()
        self._framing = framing
        self._receiver = framing.receiver
        self._echo = self._echo_filter()
        if self._echo is not None and self._echo.mode is Echo.ON:
            self.late_replies.echoes = _REPLIES_WITHOUT_ECHO
        self._connected = False
        self._awaited: _RequestInFlight | None = None
        self._last_byte = 0.0
        self._last_unit: int | None = None
        self._not_before = 0.0
        self._try_at = 0.0  # before then `transmit` has nothing to send; 0 if it has to be asked
        self._drain_until = 0.0
        self._pace: dict[int, float] = {}
        self._timeouts_in_row = 0
        self._unit_gaps: Mapping[int, float] = {}

    # Calls of the application.

    def set_unit_gaps(self, unit_gaps: Mapping[int, float]) -> None:
        """Set for some units the seconds after each of their replies in which the unit gets no request."""
        self._unit_gaps = dict(unit_gaps)

    def submit(self, call: Call, now: float) -> None:
        """Queue a call; `transmit` sends its requests.

        Raises:
            InvalidRequest: a unit above 247, or a broadcast of a request that is no write; nothing was sent.
            Overloaded: the queue is full; nothing was sent.
            UnitSuspended: the circuit breaker of the unit is open; nothing was sent.
        """
        unit = call.unit
        if not BROADCAST_UNIT < unit <= LAST_SERIAL_UNIT:
            self._check_unit(call)
        if unit in self._doubtful:
            pause = self.breakers.suspended_for(unit, now)
            if pause is not None:
                raise self._suspended(call, pause)
        self._tracker.submit(call, now)
        self._try_at = 0.0

    def send_now(self, call: Call, now: float) -> bytes | None:
        """Return None always: on a serial line every call has to be queued with `submit`."""
        return None

    def _check_unit(self, call: Call) -> None:
        endpoint = self._tracker.endpoint or None
        if not 0 <= call.unit <= LAST_SERIAL_UNIT:
            raise InvalidRequest(
                f"a unit on a serial line is 1…{LAST_SERIAL_UNIT}, or 0 for a broadcast, not {call.unit}; "
                "nothing was sent",
                endpoint=endpoint,
            )
        if call.unit == BROADCAST_UNIT:
            for request in call.requests:
                if not request.broadcast:
                    raise InvalidRequest(
                        "cannot be broadcast: no unit answers on 0, so only writes are allowed; nothing was sent",
                        endpoint=endpoint,
                        unit=BROADCAST_UNIT,
                        function=function_of(request),
                    )

    def _suspended(self, call: Call, pause: float) -> UnitSuspended:
        return self._tracker.suspended(call, pause, self.breakers.parameters.open_after)

    def cancel(self, call: Call) -> bool:
        """Cancel a call: no more requests of it are sent, and the reply to the one in flight is dropped.

        Returns:
            Whether one of its requests is in flight.
        """
        awaited = self._awaited
        is_flying = awaited is not None and awaited.call is call
        if awaited is not None and is_flying:
            awaited.call = None
        self._tracker.withdraw(call)
        return is_flying

    def serve_units_in_turn(self) -> None:
        """From now on, take the requests of one caller unit by unit in rotation, and not in the order of its calls.

        For a gateway's upstream links, where one client may flood one unit.
        """
        self.queue.units_in_turn = True

    @property
    def has_gap(self) -> bool:
        """Whether requests may have to wait for silence before they are sent: always True while the port is open."""
        return self._connected

    @property
    def queued(self) -> int:
        """Number of calls in the queue: those that have requests left to send."""
        return self.queue.size

    @property
    def in_flight(self) -> int:
        """1 while a reply or the end of the turnaround delay is awaited, else 0."""
        return 0 if self._awaited is None else 1

    # Events of the port.

    def connected(self, now: float) -> None:
        """Tell the session that the port is open.

        It sends nothing before t3.5 of silence shows that the line is idle.
        """
        self._connected = True
        self._receiver.flush(now)
        self._receiver.expect_nothing()
        self.state = MasterState.IDLE
        self._last_byte = now
        self._last_unit = None
        self._not_before = now + self.parameters.connect_delay
        self._try_at = 0.0
        self._timeouts_in_row = 0
        self._not_asked_before.clear()
        self.recycle = ""
        self.valid_reply = False
        self.counters.connections += 1

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """Repeat or fail the request in flight because the port was lost; queued calls stay.

        ``lost`` is False if the client itself closed an unused port.
        """
        if self._connected and lost:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        self.state = MasterState.IDLE
        awaited = self._awaited
        if awaited is not None:
            self._owe(awaited)
            self._awaited = None  # after it is owed: an interrupt in between must not lose that
            self.breakers.not_decided(awaited.unit)
            what = "connection" if self._framing.is_network else "port"
            self._failed(
                awaited,
                LinkDown(f"the {what} was lost before the reply: {reason}", kind="lost", sent=True),
                now,
                again=True,
            )

    def begin_again(self) -> None:
        """Forget all calls and the port: an exception such as KeyboardInterrupt may have left them inconsistent.

        The reply to the request in flight stays owed. The driver has closed the port, and then passes its calls to
        `resume`.
        """
        if self._connected:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        awaited = self._awaited
        if awaited is not None:
            if not self.late_replies.of(awaited.unit).is_owed_since(awaited.request, awaited.sent):
                self._owe(awaited)
            self._awaited = None
        self.state = MasterState.IDLE
        self._try_at = 0.0
        self._framing.begin_again()
        self._receiver = self._framing.receiver
        self._echo = self._echo_filter()
        for late in self.late_replies.units.values():
            late.counting = None
        self._tracker.begin_again()
        self.breakers.none_decided()

    def resume(self, call: Call, now: float) -> None:
        """Queue a call again after `begin_again`: what was sent is repeated or fails as after a lost connection."""
        self._tracker.resume(call, now)

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """End all queued calls, because the port could not be opened: each open request gets a copy of ``error``.

        A write that was sent before ends as `WriteOutcomeUnknown`. If ``keep_repeated``, a call of which a request is
        about to be repeated stays in the queue.
        """
        self._tracker.unreachable(now, error, keep_repeated=keep_repeated)

    def written(self, until: float) -> None:
        """Record that the port has accepted the frame to send; its last character leaves at ``until``."""
        awaited = self._awaited
        if awaited is not None and until > awaited.sent:
            self._leaves_later(awaited, until)
            self._receiver.sent(awaited.frame, until)

    def still_sending(self, until: float) -> None:
        """Record that the port still holds characters of the frame to send; the last leaves at ``until`` or later."""
        if self._awaited is not None and until > self._awaited.sent:
            self._leaves_later(self._awaited, until)

    def _leaves_later(self, awaited: _RequestInFlight, until: float) -> None:
        awaited.expires += until - awaited.sent
        awaited.sent = until
        self._last_byte = max(self._last_byte, until)

    # Sending.

    def transmit(self, now: float) -> list[bytes]:
        """Return the frame to send now, as the only element of a list; an empty list if there is none.

        It is a request of a queued call, or a marker of the session's own. Its timeout begins when its last character
        has left.
        """
        queue = self._tracker.queue
        if not self._connected or self.state is not MasterState.IDLE or not queue.size or self.recycle:
            return []
        for found in self._receiver.tick(now):
            self._found(found, now)
        clear = max(self._last_byte + self._framing.send_gap, self._not_before)
        if now < clear:
            self._try_at = clear
            return []
        call = queue.peek(lambda one: self._may_ask(one, now))
        if call is None:
            self._fail_suspended(now)
            # A request that could be sent now is queued after one that cannot: the time of that one counts.
            times = [self._askable_at(one, now) for one in queue]
            self._try_at = min((time for time in times if time > now), default=0.0)
            return []
        if self._last_unit is not None and call.unit != self._last_unit:
            clear = max(clear, self._last_byte + self._serial.unit_switch_gap)
            if now < clear:
                self._try_at = clear
                return []
        self._try_at = 0.0
        marker = self._marker_before(call)
        if marker is not None:
            return [self._send_marker(marker, call, now)]
        queue.take_turn(call)
        (position,) = call.take(1)
        if not call.has_more:
            queue.remove(call)
        request = call.requests[position]
        frame = self._framing.encode(call.unit, request.wire if hasattr(request, "wire") else request.prepare())
        broadcast = call.unit == BROADCAST_UNIT
        self.state = MasterState.WAITING_TURNAROUND if broadcast else MasterState.WAITING_FOR_REPLY
        self._begin(_RequestInFlight(call, request, position, call.unit, frame, now, now, 0.0, call.timeout))
        return [frame]

    def _may_ask(self, call: Call, now: float) -> bool:
        unit = call.unit
        if unit in self._doubtful and self.breakers.suspended_for(unit, now) is not None:
            return False
        late = self.late_replies.units.get(unit)
        if late is not None and late.counting not in (None, call) and self._waits_for_counting(late, call):
            return False
        is_clear = late is None or not late.pending
        return (is_clear and not self._not_asked_before) or self._askable_at(call, now) <= now

    def _waits_for_counting(self, late: UnitLateReplies, call: Call) -> bool:
        """Whether the next request, a read, must wait while another call's read is repeated to use up late replies.

        Only one call of a unit does that at a time (rule 6 of `serial_late_replies`).
        """
        if late.counting is None or late.counting.ended:
            late.counting = None
            return False
        request = call.requests[call.next_position]
        return not request.is_write and self._is_in_doubt(late, call)

    def _askable_at(self, call: Call, now: float) -> float:
        """Return the earliest time to send the next request of this call, given pauses and late replies of its unit.

        It can be in the past. Circuit breakers and silences of the line are not considered.
        """
        at = self._not_asked_before.get(call.unit, now)
        late = self.late_replies.units.get(call.unit)
        if late is None or not late.pending or self._serial.trust_reply_order:
            return at
        position = call.next_position
        request = call.requests[position]
        if isinstance(request, RestartCommunications):
            return at
        return max(at, late.waits_until(function_of(request), call, position, now))

    def _marker_before(self, call: Call) -> Marker | None:
        """Return the marker request to send before the next request of a call; None if there is none to send.

        After the reply to a marker, a harmless request, no late reply can be taken for the reply to the call's request.
        Function 08/01 (restart) needs none: a unit in listen-only mode answers nothing before it (V1.1b3 §6.8.1).
        """
        unit = call.unit
        late = self.late_replies.units.get(unit)
        if late is None or unit == BROADCAST_UNIT:
            return None
        if not (late.owed or late.unasked is not None or late.older) or not self._is_in_doubt(late, call):
            if late.alike < CHECK_EVERY:  # the usual case
                return None
            marker = self.late_replies.marker(unit, is_check=True)
            if marker is None:
                late.alike = 0  # it answers no marker: a shift cannot be detected
            return marker
        request = call.requests[call.next_position]
        if isinstance(request, RestartCommunications):
            return None
        marker = self.late_replies.marker(unit)
        if marker is None and request.is_write:
            late.silent.clear()
            marker = self.late_replies.marker(unit)
        return marker

    def _is_in_doubt(self, late: UnitLateReplies, call: Call) -> bool:
        """Whether the reply to the next request of a call could be confused with a late one."""
        position = call.next_position
        request = call.requests[position]
        if not hasattr(request, "wire"):
            request.prepare()
        return late.in_doubt(request, call, position)

    def _fail_suspended(self, now: float) -> None:
        """Fail the queued calls of units whose circuit breaker has opened, instead of letting them wait for a probe."""
        for call in list(self._tracker.queue):
            pause = self.breakers.suspended_for(call.unit, now)
            if pause is not None:
                self._tracker.give_up(call, now, partial(self._suspended, call, pause))

    def _send_marker(self, marker: Marker, call: Call, now: float) -> bytes:
        """Return the frame of a marker request, and await its reply, which proves that no late reply will come.

        The call for which it is sent keeps its position in the queue.
        """
        frame = self._framing.encode(call.unit, marker.request.wire)
        self.counters.markers += 1
        late = self.late_replies.of(call.unit)
        why = "a check" if late.is_empty else f"it owes {late.owed_count}"
        self._note(f"unit {call.unit}: that was a request of the link's own, a marker ({why})")
        self.state = MasterState.WAITING_FOR_REPLY
        self._begin(_RequestInFlight(None, marker.request, 0, call.unit, frame, now, now, 0.0, call.timeout, marker))
        return frame

    def _begin(self, awaited: _RequestInFlight) -> None:
        unit, frame, now = awaited.unit, awaited.frame, awaited.begun
        awaited.sent = leaves = now + self._framing.timing.duration(len(frame))
        if self._echo is not None:
            self._echo.times_tell = self.characters_take_time
        self._receiver.sent(frame, leaves)
        if self.state is MasterState.WAITING_TURNAROUND:
            self._receiver.expect_nothing()
            wait = self._serial.turnaround_delay
        else:
            self._receiver.expect(unit, awaited.request.wire[0], awaited.request.expected_size)
            wait = awaited.timeout
            if unit in self._doubtful:
                usual = self._pace.get(unit) or max(self._pace.values(), default=0.0)
                wait = self.breakers.asked(unit, now, wait, usual)
        awaited.expires = leaves + wait
        self._awaited = awaited
        self._last_unit = unit
        self._last_byte = max(self._last_byte, leaves)
        self.counters.requests += 1

    # Receiving.

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Process the first ``size`` bytes of ``buffer``, read at ``now``.

        Calls that they complete are added to ``finished``.
        """
        self._last_byte = max(self._last_byte, now)
        for found in self._receiver.receive(bytes(memoryview(buffer)[:size]), now):
            self._found(found, now)

    def receive_damaged(self, data: bytes, now: float, *, overrun: bool = False) -> None:
        """Process bytes of which the port marked one as damaged (parity or framing error), or after which it lost some.

        The frame in progress is discarded, and so is a frame that these bytes complete. ``overrun``: whether characters
        were lost.
        """
        self._last_byte = max(self._last_byte, now)
        marked = [found for found in self._receiver.receive(data, now) if isinstance(found, Damaged)]
        for found in (*marked, *self._receiver.damaged(now, overrun=overrun)):
            self._found(found, now)

    def _found(self, found: FrameOrDamage, now: float) -> None:
        awaited = self._awaited
        if isinstance(found, Damaged):
            self.counters.damaged_frames += 1
            self.counters.overruns += found.overrun
            if awaited is not None:
                awaited.damage = found.raw
            return
        self._timeouts_in_row = 0
        if self._echo is not None and awaited is not None:
            self._note_removed_echo(awaited, self._echo)
        if self.late_replies.echoes and self._is_late_echo(found):
            self.counters.foreign_replies += 1
        elif awaited is None or self.state is not MasterState.WAITING_FOR_REPLY or found.unit != awaited.unit:
            self._not_awaited(found)  # late, or of another device; in a turnaround, an answer to a broadcast
        elif (self.late_replies.echoes or found.direction is Direction.REQUEST) and self._is_echo(awaited, found):
            self.counters.foreign_replies += 1
        elif found.began < awaited.sent + self._framing.send_gap and self._is_early(awaited, found):
            if self._is_shown_echo(awaited, found):
                self.counters.foreign_replies += 1
            else:
                awaited.early = True
                self._not_awaited(found)
        else:
            self._of_awaited_unit(awaited, found, now)

    def _is_echo(self, awaited: _RequestInFlight, frame: SerialFrame) -> bool:
        """Whether a received frame is the echo of the request in flight (rule 9); a read shows that a line echoes.

        Called for requests, and on a line that echoes for all frames while a reply is awaited.
        """
        is_request = frame.direction is Direction.REQUEST
        if frame.raw != awaited.frame or (awaited.echoed and not is_request):
            return False
        if is_request:
            self._note_echo()
        awaited.echoed = True
        return True

    def _is_shown_echo(self, awaited: _RequestInFlight, frame: SerialFrame) -> bool:
        """Whether a frame on a wire is the request in flight, and began before its end: no other station sends then.

        False if the unit owes a reply, which may come while this station sends.
        """
        late = self.late_replies.units.get(frame.unit)
        if awaited.echoed or (late is not None and (late.owed or late.older)):
            return False
        if not self._is_copy_before_the_end(awaited, frame):
            return False
        self._note_echo()
        awaited.echoed = True
        return True

    def _is_copy_before_the_end(self, awaited: _RequestInFlight, frame: SerialFrame) -> bool:
        """Whether a frame on a wire has the bytes of the request in flight, and began while that was sent."""
        if not self.characters_take_time or self._framing.is_network or frame.raw != awaited.frame:
            return False
        margin = self._framing.timing.character / 2  # times are estimates
        return awaited.begun - margin <= frame.began < awaited.sent - margin

    def _note_echo(self) -> None:
        """Record that the line echoes."""
        if not self.late_replies.echoes:
            self._note("the line gives back what is sent; its echo is no reply")
        self.late_replies.echoes = _REPLIES_WITHOUT_ECHO

    def _echo_filter(self) -> EchoFilter | None:
        """Return what removes echoes by the option ``echo``; None if that is off."""
        found = self._receiver.echo
        return None if found.mode is Echo.OFF else found

    def _note_removed_echo(self, awaited: _RequestInFlight, echo: EchoFilter) -> None:
        """Record that the echo of the request in flight was removed, if it was: no later copy is its echo (rule 9)."""
        if echo.has_removed and not awaited.echoed:
            awaited.echoed = True
            self.late_replies.echoes = _REPLIES_WITHOUT_ECHO

    def _is_late_echo(self, frame: SerialFrame) -> bool:
        """Whether a frame is the echo of a request whose reply is owed (rule 9); the next one like it is the reply."""
        late = self.late_replies.units.get(frame.unit)
        return late is not None and late.echo_came(frame.pdu)

    def _is_early(self, awaited: _RequestInFlight, frame: SerialFrame) -> bool:
        """Whether a received frame began, or ended, too early to be the reply to the request in flight (rule 8).

        On a wire: it began before t3.5 had passed since the last byte of the request, or, with the option
        ``early_replies``, before the first byte. Where characters take no time: it ended before the first byte.
        """
        if not self.characters_take_time or self._framing.is_network:
            return frame.ended < awaited.begun
        if self._serial.early_replies:
            return frame.began < awaited.begun or self._is_copy_before_the_end(awaited, frame)
        framing = self._framing
        # Bytes that are read late seem to begin late. A tenth of a character allows for rounding of times.
        return frame.began < awaited.sent + framing.send_gap - framing.timing.character / 10

    def _of_awaited_unit(self, awaited: _RequestInFlight, frame: SerialFrame, now: float) -> None:
        """Handle a frame from the unit that was asked: the expected reply, or a late one (`serial_late_replies`)."""
        late = self.late_replies.of(awaited.unit)
        if not late.owed and not late.older:  # the usual case
            if frame.pdu[0] & 0x7F == awaited.request.wire[0]:
                self._reply(awaited, frame, now, late)
            else:
                self._not_awaited(frame)
            return
        owed = late.candidates(frame.pdu)
        if late.is_older(frame.pdu) or not all(one.is_of(awaited.call, awaited.position) for one in owed):
            self._late(late, owed, frame)
            self._ask_at_once(awaited, frame)
        elif owed:
            # It may answer an earlier attempt of the call; then the one in flight is still owed its own reply.
            late.came(owed[0])
            self._owe(awaited)
            self._reply(awaited, frame, now, late, owes_own=True)
        elif frame.pdu[0] & 0x7F != awaited.request.wire[0]:
            self._not_awaited(frame)
        else:
            self._reply(awaited, frame, now, late)

    def _is_of_another(self, awaited: _RequestInFlight, late: UnitLateReplies, pdu: bytes) -> bool:
        """Whether a reply that does not fit the request in flight is the late reply to an older request.

        If False, it is a broken reply to the request in flight, whose function code it has. Always True while a marker
        request is in flight.
        """
        last = late.last
        return (
            awaited.marker is not None
            or any(one.function == pdu[0] for one in late.owed)
            or (last is not None and last.wire[0] == pdu[0] and _fits(last, pdu))
        )

    def _not_awaited(self, frame: SerialFrame) -> None:
        """Handle a frame that does not answer the request in flight: a late reply, or another device's traffic."""
        late = self.late_replies.units.get(frame.unit)
        if late is None or frame.direction is Direction.REQUEST:
            self.counters.foreign_replies += 1
            return
        owed = late.candidates(frame.pdu)
        if owed or late.is_older(frame.pdu):
            self._late(late, owed, frame)
            return
        self.counters.foreign_replies += 1
        late.unasked = frame.pdu[0] & 0x7F

    def _ask_at_once(self, awaited: _RequestInFlight, frame: SerialFrame) -> None:
        """Repeat the read in flight now if ``frame``, which was taken for a late reply, may have been its own reply.

        The reply to the present attempt is then owed too.
        """
        call = awaited.call
        if call is None or awaited.request.is_write or not may_answer(awaited.request, frame.pdu):
            return
        self._owe(awaited)
        self._idle(frame.ended)
        self.late_replies.of(awaited.unit).counting = call
        self._tracker.repeat(call, awaited.position)

    def _late(self, late: UnitLateReplies, owed: Sequence[OwedReply], frame: SerialFrame) -> None:
        """Drop a late reply, count it, and remove it from the replies that are owed.

        If it counts as an older reply, of which only the number is known (`UnitLateReplies.is_older`), that number is
        reduced. Otherwise the frame is the reply to the first of ``owed``; replies to requests sent before that one are
        no longer owed. The unit is alive: if its breaker has suspended it, the suspension ends.

        Args:
            late: the late replies of the unit.
            owed: those of ``late.owed`` that the frame could be (`UnitLateReplies.candidates`).
            frame: the late reply.
        """
        if late.is_older(frame.pdu):
            late.older_came(frame.pdu)
        else:
            late.came(owed[0])
            late.delay = frame.ended - owed[0].sent
            self._note(f"unit {frame.unit}: a reply that was owed came after {late.delay:.3f} s; dropped")
        self._try_at = 0.0
        if not late.owed and not late.older:
            self._not_asked_before.pop(frame.unit, None)
        if self._unit_gaps:
            self._keep_gap(frame)
        self.counters.late_replies += 1
        if self.breakers.answered(frame.unit):
            late.revived()

    def _note(self, text: str) -> None:
        if len(self.notes) < _NOTES_AT_MOST:
            self.notes.append(text)

    def _owe(self, awaited: _RequestInFlight) -> None:
        """Record that the reply to the request in flight may still come late; for a broadcast do nothing."""
        if awaited.unit == BROADCAST_UNIT:
            return
        if self._echo is not None:
            self._note_removed_echo(awaited, self._echo)
        until = awaited.sent + OWED_FOR * awaited.timeout
        function = awaited.request.wire[0]
        self.late_replies.of(awaited.unit).owe(
            OwedReply(
                awaited.request,
                function,
                awaited.sent,
                until,
                awaited.call,
                awaited.position,
                echoed=awaited.echoed,
            )
        )

    def _reply(
        self,
        awaited: _RequestInFlight,
        frame: SerialFrame,
        now: float,
        late: UnitLateReplies,
        *,
        owes_own: bool = False,
    ) -> None:
        """End the request in flight with the reply in ``frame``: its outcome is a message or an error.

        But if the reply fits only an older request, it is handled as a late one and the request goes on waiting.
        ``owes_own``: True if the reply may belong to an earlier attempt at the same request; then the reply to the
        latest attempt may still come.
        """
        pdu = frame.pdu
        outcome: Message | ModbusError
        try:
            if pdu[0] & 0x80:
                outcome = ExceptionReply(decode_exception(pdu).exception, raw=frame.raw)
            else:
                outcome = awaited.request.accept(pdu)
        except MalformedPdu as error:
            if self._is_of_another(awaited, late, pdu):
                self._not_awaited(frame)
                return
            # The unit answers, but breaks the protocol: no reason to repeat the request, and none to suspend the unit.
            self.counters.bad_replies += 1
            outcome = BadReply(error.reason, kind="content", raw=frame.raw)
        if self.late_replies.echoes and not (awaited.damage or owes_own or isinstance(outcome, BadReply)):
            self.late_replies.echoes = _REPLIES_WITHOUT_ECHO if awaited.echoed else self.late_replies.echoes - 1
        if not owes_own and (late.owed or late.unasked is not None):
            late.answered(awaited.request)
        if late.counting is not None and awaited.call is late.counting:
            late.counting = None
        self.valid_reply = True
        if frame.unit in self._doubtful and self.breakers.answered(frame.unit):
            late.revived()
        self._learn_pace(awaited, frame, late)
        if self._unit_gaps:
            self._keep_gap(frame)
        self._idle(frame.ended)
        if awaited.marker is not None:
            self._marked(awaited.marker, outcome, late)
            return
        if not isinstance(outcome, ModbusError):
            self.counters.replies += 1
            late.heard(awaited.request, is_exception=False)
        elif isinstance(outcome, ExceptionReply):
            self.counters.exceptions += 1
            late.heard(awaited.request, is_exception=True)
        self._conclude(awaited, outcome, now)

    def _marked(self, marker: Marker, outcome: Message | ModbusError, late: UnitLateReplies) -> None:
        """Record that a unit answered a kind of marker request, which proves that no late reply of the unit will come.

        A shorter read that was answered with an error proves it too, but that kind is not used again for the unit.
        """
        if isinstance(outcome, ModbusError) and marker.kind is MarkerKind.OTHER_LENGTH:
            late.not_marked(marker.kind)  # it reads nothing but that length
        else:
            late.marked(marker.kind)

    def _conclude(self, awaited: _RequestInFlight, outcome: Message | ModbusError, now: float) -> None:
        call, position = awaited.call, awaited.position
        if call is None:
            return
        if not isinstance(outcome, ModbusError):
            self._tracker.conclude(call, position, outcome)
        elif isinstance(outcome, BadReply) or (
            _exception_code(outcome) == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND and awaited.request.is_write
        ):
            self._tracker.failed(call, position, outcome, now, again=False)
        else:
            self._tracker.conclude(call, position, self._tracker.placed(outcome, call, position, now))

    def _learn_pace(self, awaited: _RequestInFlight, frame: SerialFrame, late: UnitLateReplies) -> None:
        """Update the usual response time of a unit with a reply, unless it may belong to an earlier attempt.

        It is the time of this reply, or 0.9 of the earlier value if that is longer.
        """
        unit = frame.unit
        if self._not_asked_before:
            self._not_asked_before.pop(unit, None)
        if late.owed:
            return
        late.delay = None
        self._pace[unit] = max(frame.ended - awaited.sent, self._pace.get(unit, 0.0) * _PACE_FORGETS)

    def _keep_gap(self, frame: SerialFrame) -> None:
        """Start the pause after a reply in which its unit gets no request (`set_unit_gaps`)."""
        gap = self._unit_gaps.get(frame.unit)
        if gap:
            before = self._not_asked_before.get(frame.unit, 0.0)
            self._not_asked_before[frame.unit] = max(before, frame.ended + gap)

    def _idle(self, last_byte: float) -> None:
        """End the transaction on the line; pauses before the next request count from ``last_byte``, its last byte."""
        self.state = MasterState.IDLE
        self._awaited = None
        self._try_at = 0.0
        self._receiver.expect_nothing()
        if self.parameters.request_gap:
            self._not_before = max(self._not_before, last_byte + self.parameters.request_gap)

    # Timeouts.

    def deadline(self) -> float | None:
        """Return the time at which to call `tick` and `transmit`, by the clock of ``now``; 0: at once; None: never."""
        first = self._next_step()
        times = [self._receiver.deadline()]
        if self._tracker.deadlines:
            times.append(self._tracker.next_deadline())
            if self._awaited is not None and self.state is MasterState.WAITING_FOR_REPLY:
                times.append(self._awaited.deadline)
        for time in times:
            if time is not None and (first is None or time < first):
                first = time
        return first

    def _next_step(self) -> float | None:
        """Return the time of the master's next step if nothing is received: a timeout, the end of a wait, or a request.

        0 means at once; None that there is nothing to do.
        """
        if self._awaited is not None:
            return self._awaited.expires
        if self.state is MasterState.DRAINING:
            return self._drained_at()
        return self._try_at if self.queue.size and self._connected else None

    def _drained_at(self) -> float:
        return min(self._last_byte + self._serial.quiet_window, self._drain_until)

    def tick(self, now: float) -> None:
        """Handle silences of the line, and timeouts and deadlines that have passed, up to ``now``."""
        for found in self._receiver.tick(now):
            self._found(found, now)
        awaited = self._awaited
        if awaited is not None:
            if now >= awaited.expires:
                if self.state is MasterState.WAITING_TURNAROUND:
                    self._turned_around(awaited, now)
                else:
                    self._time_out(awaited, now)
            elif self.state is MasterState.WAITING_FOR_REPLY:
                self._keep_deadline(awaited, now)
        elif self.state is MasterState.DRAINING and now >= self._drained_at():
            for found in self._receiver.flush(now):
                self._found(found, now)
            self.state = MasterState.IDLE
            self._try_at = 0.0
        awaited = self._awaited
        in_flight = {(id(awaited.call), awaited.position)} if awaited is not None else set()
        self._tracker.expire_queue(now, in_flight, self._why_not_sent)

    def _why_not_sent(self, call: Call) -> NoReply | None:
        """Return the error for a call whose deadline passed while its request had to wait because of late replies.

        None if the call waited for another reason.
        """
        late = self.late_replies.units.get(call.unit)
        if late is None or not self._is_in_doubt(late, call):
            return None
        return self._in_doubt(late, call, "the deadline of the call passed")

    def _in_doubt(self, late: UnitLateReplies, call: Call, why: str) -> NoReply:
        owed = late.owed_count
        if call.next_position in call.attempts:
            return NoReply(
                f"no reply, and {why} before the unit, which owes {owed} more, answered what tells its replies apart",
                observed_delay=late.delay,
            )
        what = f"owes {owed} {'reply' if owed == 1 else 'replies'}" if owed else "spoke without being asked"
        return NoReply(
            f"not asked: the unit {what}, and {why} before it answered a request that tells its replies apart; "
            "nothing was sent",
            kind="in doubt",
            observed_delay=late.delay,
        )

    def _keep_deadline(self, awaited: _RequestInFlight, now: float) -> None:
        """End the request in flight with an error if the deadline of its call has passed.

        The master still waits for the reply before it sends another request (rule 7).
        """
        call = awaited.call
        if call is not None and call.deadline is not None and now >= call.deadline:
            awaited.call = None
            error = NoReply("no answer before the deadline of the call", raw=awaited.damage)
            self._tracker.failed(call, awaited.position, error, now, again=False)

    def _turned_around(self, awaited: _RequestInFlight, now: float) -> None:
        """End a broadcast: the turnaround delay, in which the servers execute it, is over.

        Its outcome is the request itself, because there is no reply.
        """
        self._idle(now)
        if awaited.call is not None:
            self._tracker.conclude(awaited.call, awaited.position, awaited.request)

    def _time_out(self, awaited: _RequestInFlight, now: float) -> None:
        for found in self._receiver.flush(now):
            self._found(found, now)
        if self._awaited is None:
            return  # the reply had been held back until it was clear that nothing follows
        self._owe(awaited)
        self._awaited = None  # after it is owed: an interrupt in between must not lose that
        self.counters.timeouts += 1
        unit = awaited.unit
        probing = self.breakers.is_probing(unit)
        opened = self.breakers.timed_out(unit, now)
        self.state = MasterState.DRAINING
        self._drain_until = now + self._serial.drain_limit
        self._receiver.expect_nothing()
        self._not_asked_before[unit] = now + self._serial.quiet_window
        if awaited.marker is None:
            self._failed(awaited, self._no_reply(awaited), now, again=not probing and not opened)
        else:
            self._not_marked(awaited, awaited.marker, now)
        if opened:
            self._fail_suspended(now)
        self._timeouts_in_row += 1
        if self._framing.is_network and self._timeouts_in_row >= self.parameters.recycle_after_timeouts:
            self.recycle = f"{self._timeouts_in_row} timeouts in a row"
            self.counters.recycled += 1

    def _not_marked(self, awaited: _RequestInFlight, marker: Marker, now: float) -> None:
        """Handle a marker request without reply: queued calls that had to wait for it fail if no attempt is left.

        Each queued call to the unit whose next request is still in doubt counts the marker in ``Call.markers``. It
        fails when it has counted more markers than it has ``retries``.
        """
        late = self.late_replies.of(awaited.unit)
        late.not_marked(marker.kind)
        late.alike = 0
        self._try_at = 0.0
        for call in list(self._tracker.queue):
            if call.unit != awaited.unit:
                continue
            if not self._is_in_doubt(late, call):
                continue
            call.markers += 1
            if call.markers > call.retries:
                why = "it did not answer" if call.markers == 1 else f"{call.markers} attempts passed"
                self._tracker.give_up(call, now, partial(self._in_doubt, late, call, why))

    def _no_reply(self, awaited: _RequestInFlight) -> NoReply:
        waited = awaited.expires - awaited.sent
        if awaited.damage:
            return NoReply(f"only a damaged reply came within {waited:.3g} s", kind="partial", raw=awaited.damage)
        if awaited.early:
            return NoReply(
                f"no reply within {waited:.3g} s but one that began before t3.5 had passed since the request; "
                "early_replies takes such replies",
                kind="early",
            )
        delay = self.late_replies.of(awaited.unit).delay
        if delay is not None:
            return NoReply(
                f"no reply within {waited:.3g} s; the last late reply of this unit had taken {delay:.3f} s, "
                "a longer timeout would take it",
                kind="late",
                observed_delay=delay,
            )
        return NoReply(f"no reply within {waited:.3g} s")

    def _failed(self, awaited: _RequestInFlight, error: ModbusError, now: float, *, again: bool) -> None:
        """End the request in flight with ``error``; or, if ``again``, repeat it while attempts are left."""
        self._try_at = 0.0
        if awaited.call is not None:
            late = self.late_replies.units.get(awaited.unit)
            if late is not None:
                late.counting = None
            self._tracker.failed(awaited.call, awaited.position, error, now, again=again)


def _fits(request: Request, pdu: bytes) -> bool:
    """Whether a PDU with the function code of a request is an exception reply or a valid normal reply to it."""
    try:
        request.accept(pdu)
    except MalformedPdu:
        return bool(pdu[0] & 0x80)
    return True


def _exception_code(outcome: ModbusError) -> int | None:
    """Return the exception code that an error carries; None for other errors."""
    return outcome.code if isinstance(outcome, ExceptionReply) else None
