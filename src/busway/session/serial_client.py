"""The master of a serial line: one transaction at a time, with the turnaround, gaps and doubts of a shared wire.

Knows the master's state diagram (Serial Line V1.02 §2.4.1) and how to come back in step; knows no port and no clock.
RTU and ASCII differ only in the framing that is handed in.

1. States: idle → waiting for a reply (unicast) or for the turnaround (broadcast) → idle. One request is in flight.
2. A reply of another unit keeps the timer running. A damaged frame counts, and may be repeated like a timeout.
3. After a timeout the line is drained: nothing is sent before it has been silent for ``quiet_window``, and nothing to
   the same unit before that much time has passed since the timeout. Whatever comes until then is late and dropped.
   Later on a late reply is told by its unit, function, length and echo.
4. What can not be told apart so is the late reply to another request of the same unit, function and length. A unit
   whose usual delay is known is taken to have missed the request. One that is not known to answer in time is not
   asked anything else (the same may be repeated) before twice its timeout has passed; others are meanwhile.
5. Nothing is sent before t3.5 after the last byte of anybody, ``request_gap`` after a reply and ``unit_switch_gap``
   where the unit changes. A unit that has a gap of its own is left alone for it; others are asked meanwhile.
6. Dead units cost the line no more than a probe (`breaker`); their requests fail with `UnitSuspended`.
7. A request that was cancelled, or whose deadline is over, stays in flight until its reply comes or its time is over.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial

from ..codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, ExceptionCode
from ..errors import (
    BadReply,
    ConfigError,
    ExceptionReply,
    InvalidRequest,
    LinkDown,
    ModbusError,
    NoReply,
    UnitSuspended,
)
from ..framing.received import Damaged, Direction, Received, SerialFrame
from ..pdu.general import decode_exception
from ..pdu.malformed import MalformedPdu
from ..pdu.message import Message, Request
from .breaker import BreakerParameters, Breakers
from .demand import Demand
from .ledger import Ledger, function_of
from .line_framing import LineFraming
from .parameters import ClientParameters

LATE_FOR = 10.0
"""Seconds for which a reply that did not come in time is still known as late when it comes."""
_PACE_FORGETS = 0.9
"""The usual delay of a unit is its slowest lately: each faster reply takes a tenth off."""


@dataclass(frozen=True, slots=True)
class SerialClientParameters:
    """What a master on a serial line has besides `ClientParameters`.

    Attributes:
        turnaround_delay: seconds after a broadcast before the next request (§2.4.1: 100…200 ms typical), 0…10.
        unit_switch_gap: seconds of silence where the next request goes to another unit, at least t3.5; 0…10.
        quiet_window: seconds of silence that end a drain after a timeout, 0…10.
        drain_limit: seconds after which a drain ends although the line never fell silent, 0…60.
    """

    turnaround_delay: float = 0.1
    unit_switch_gap: float = 0.0
    quiet_window: float = 0.05
    drain_limit: float = 1.0

    def __post_init__(self) -> None:
        for name, high in (
            ("turnaround_delay", 10.0),
            ("unit_switch_gap", 10.0),
            ("quiet_window", 10.0),
            ("drain_limit", 60.0),
        ):
            if not 0 <= getattr(self, name) <= high:
                raise ConfigError(f"must be 0…{high:g} seconds, not {getattr(self, name):g}", key=name)


class MasterState(Enum):
    """The states of the master (§2.4.1), and the one that brings it back in step."""

    IDLE = "idle"
    WAITING_FOR_REPLY = "waiting for reply"
    WAITING_TURNAROUND = "waiting turnaround"
    DRAINING = "draining"


@dataclass(slots=True)
class _Flight:
    """The request on the line. ``demand`` None: nobody waits for it any more."""

    demand: Demand | None
    request: Request
    position: int
    unit: int
    frame: bytes
    sent: float
    expires: float
    damage: bytes = b""

    @property
    def deadline(self) -> float | None:
        """When the call must have ended."""
        return None if self.demand is None else self.demand.deadline


@dataclass(frozen=True, slots=True)
class _Missed:
    """A request whose reply did not come in time."""

    function: int
    sent: float


@dataclass(frozen=True, slots=True)
class _Pause:
    """How long a unit is not asked: the same again, or anything else."""

    same_until: float
    other_until: float


class SerialClientSession:
    """One line's conversation, across reopenings of its port.

    Attributes:
        counters, finished, recycle, observed_delay, valid_reply: as in `TcpClientSession`.
        state: where the master stands.
        breakers: which units are not asked.
    """

    __slots__ = (
        "_connected",
        "_drain_until",
        "_flight",
        "_framing",
        "_last_byte",
        "_last_unit",
        "_ledger",
        "_missed",
        "_not_before",
        "_pace",
        "_pauses",
        "_receiver",
        "_serial",
        "_timeouts_in_row",
        "_try_at",
        "_unit_gaps",
        "breakers",
        "counters",
        "finished",
        "observed_delay",
        "parameters",
        "recycle",
        "state",
        "valid_reply",
    )

    def __init__(
        self,
        parameters: ClientParameters,
        *,
        framing: LineFraming,
        jitter: Callable[[], float],
        serial: SerialClientParameters | None = None,
        breaker: BreakerParameters | None = None,
        endpoint: str = "",
    ) -> None:
        """A session without a port.

        Args:
            parameters: timeout, retries, gaps, queue.
            framing: in the role of a master.
            jitter: gives a number 0…1 per call, for the pauses of `breaker`.
            serial: turnaround, gaps and drain.
            breaker: when units are given up.
            endpoint: URL of the link, for errors.
        """
        self.parameters = parameters
        self.recycle = ""
        self.observed_delay: float | None = None
        self.valid_reply = False
        self.state = MasterState.IDLE
        self.breakers = Breakers(breaker or BreakerParameters(), jitter)
        self._pauses: dict[int, _Pause] = {}
        self._ledger = Ledger(parameters, endpoint)
        self.counters = self._ledger.counters
        self.finished = self._ledger.finished
        self._serial = serial or SerialClientParameters()
        self._framing = framing
        self._receiver = framing.receiver
        self._connected = False
        self._flight: _Flight | None = None
        self._last_byte = 0.0
        self._last_unit: int | None = None
        self._not_before = 0.0
        self._try_at = 0.0  # before then `transmit` has nothing to send; 0 if it has to be asked
        self._drain_until = 0.0
        self._missed: dict[int, _Missed] = {}
        self._pace: dict[int, float] = {}
        self._timeouts_in_row = 0
        self._unit_gaps: Mapping[int, float] = {}

    # What the application asks.

    def leave_alone(self, unit_gaps: Mapping[int, float]) -> None:
        """Leave these units alone for so many seconds after each of their replies."""
        self._unit_gaps = dict(unit_gaps)

    def submit(self, demand: Demand, now: float) -> None:
        """Take a demand.

        Raises:
            InvalidRequest: a unit above 247, or a broadcast of something that is no write.
            Overloaded: the queue is full.
            UnitSuspended: the unit's breaker is open.
            In all cases nothing was sent.
        """
        self._check_unit(demand)
        pause = self.breakers.suspended_for(demand.unit, now)
        if pause is not None:
            raise self._suspended(demand, pause)
        self._ledger.submit(demand, now)
        self._try_at = 0.0

    def send_now(self, demand: Demand, now: float) -> bytes | None:
        """Always None: on a shared line every request takes its turn."""
        return None

    def _check_unit(self, demand: Demand) -> None:
        endpoint = self._ledger.endpoint or None
        if not 0 <= demand.unit <= LAST_SERIAL_UNIT:
            raise InvalidRequest(
                f"a unit on a serial line is 1…{LAST_SERIAL_UNIT}, or 0 for a broadcast, not {demand.unit}; "
                "nothing was sent",
                endpoint=endpoint,
            )
        if demand.unit == BROADCAST_UNIT:
            for request in demand.requests:
                if not request.broadcast:
                    raise InvalidRequest(
                        "can not be broadcast: nobody answers on unit 0, only writes go there; nothing was sent",
                        endpoint=endpoint,
                        unit=BROADCAST_UNIT,
                        function=function_of(request),
                    )

    def _suspended(self, demand: Demand, pause: float) -> UnitSuspended:
        self.counters.suspended += 1
        return UnitSuspended(
            f"not asked: it did not answer {self.breakers.parameters.open_after} times in a row; "
            f"it may be asked again in {pause:.1f} s",
            next_probe=pause,
            endpoint=self._ledger.endpoint or None,
            unit=demand.unit,
            function=function_of(demand.requests[0]),
        )

    def cancel(self, demand: Demand) -> None:
        """The caller has gone: nothing more of the demand is sent, and what is in flight finishes unseen."""
        if self._flight is not None and self._flight.demand is demand:
            self._flight.demand = None
        self._ledger.withdraw(demand)

    def serve_units_in_turn(self) -> None:
        """Serve the units of each caller in turn: for callers that stand for many, as a client of a gateway does."""
        self._ledger.queue.units_in_turn = True

    @property
    def has_demands(self) -> bool:
        """Whether something waits to be sent."""
        return self._ledger.queue.size > 0

    @property
    def has_gap(self) -> bool:
        """Whether what waits may be sent only later; on a serial line that is so after every frame."""
        return self._connected

    @property
    def queued(self) -> int:
        """Demands with something left to send."""
        return self._ledger.queue.size

    @property
    def in_flight(self) -> int:
        """1 while a reply, or the end of the turnaround, is awaited."""
        return 0 if self._flight is None else 1

    # What the port reports.

    def connected(self, now: float) -> None:
        """The port is open. Whether the line is idle is known t3.5 later."""
        self._connected = True
        self._receiver.flush(now)
        self._receiver.expect_nothing()
        self.state = MasterState.IDLE
        self._last_byte = now
        self._last_unit = None
        self._not_before = now + self.parameters.connect_delay
        self._try_at = 0.0
        self._timeouts_in_row = 0
        self._missed.clear()
        self._pauses.clear()
        self.recycle = ""
        self.valid_reply = False
        self.counters.connections += 1

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """The port has gone; what was in flight is repeated or fails, what waits stays in the queue.

        ``lost`` says that it went by itself.
        """
        if self._connected and lost:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        self.state = MasterState.IDLE
        flight, self._flight = self._flight, None
        if flight is not None:
            self.breakers.not_decided(flight.unit)
            what = "connection" if self._framing.is_network else "port"
            self._failed(
                flight, LinkDown(f"the {what} was lost before the reply: {reason}", sent=True), now, again=True
            )

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """The port can not be opened: everything that waits fails, at once and with the same reason.

        With ``keep_repeated`` a demand that is about to be repeated waits for the next attempt.
        """
        self._ledger.unreachable(now, error, keep_repeated=keep_repeated)

    def written(self, until: float) -> None:
        """The frame that `transmit` gave was handed over; its last character leaves at ``until``."""
        flight = self._flight
        if flight is not None and until > flight.sent:
            self._leaves_later(flight, until)
            self._receiver.sent(flight.frame, until)

    def still_sending(self, until: float) -> None:
        """The port still holds characters of the frame; the last one leaves at ``until`` at the earliest."""
        if self._flight is not None and until > self._flight.sent:
            self._leaves_later(self._flight, until)

    def _leaves_later(self, flight: _Flight, until: float) -> None:
        flight.expires += until - flight.sent
        flight.sent = until
        self._last_byte = max(self._last_byte, until)

    # What goes out.

    def transmit(self, now: float) -> list[bytes]:
        """The frame to send now, or nothing; it counts as sent when its last character has left."""
        queue = self._ledger.queue
        if not self._connected or self.state is not MasterState.IDLE or not queue.size or self.recycle:
            return []
        for found in self._receiver.tick(now):
            self._found(found, now)
        clear = max(self._last_byte + self._framing.send_gap, self._not_before)
        if now >= clear:
            demand = queue.peek(lambda one: self._may_ask(one, now))
            if demand is None:
                self._fail_suspended(now)
                self._try_at = min((self._askable_at(one, now) for one in queue), default=0.0)
                return []
            if self._last_unit is not None and demand.unit != self._last_unit:
                clear = max(clear, self._last_byte + self._serial.unit_switch_gap)
        if now < clear:
            self._try_at = clear
            return []
        self._try_at = 0.0
        demand = queue.pick(lambda one: self._may_ask(one, now))
        return [] if demand is None else [self._send(demand, now)]

    def _may_ask(self, demand: Demand, now: float) -> bool:
        return self.breakers.suspended_for(demand.unit, now) is None and self._askable_at(demand, now) <= now

    def _askable_at(self, demand: Demand, now: float) -> float:
        """When the unit may be asked, as far as a reply of it may still be on its way."""
        pause = self._pauses.get(demand.unit)
        if pause is None:
            return now
        # What is repeated is the request whose reply may be on its way: either reply answers it.
        return pause.same_until if demand.again else pause.other_until

    def _fail_suspended(self, now: float) -> None:
        """What waits for a unit whose breaker has opened meanwhile does not wait for its probe."""
        for demand in list(self._ledger.queue):
            pause = self.breakers.suspended_for(demand.unit, now)
            if pause is not None:
                self._ledger.give_up(demand, now, partial(self._suspended, demand, pause))

    def _send(self, demand: Demand, now: float) -> bytes:
        (position,) = demand.take(1)
        if not demand.has_more:
            self._ledger.queue.remove(demand)
        request = demand.requests[position]
        try:
            wire = request.wire
        except AttributeError:
            wire = request.prepare()
        unit = demand.unit
        frame = self._framing.encode(unit, wire)
        leaves = now + self._framing.timing.duration(len(frame))
        self._receiver.sent(frame, leaves)
        if unit == BROADCAST_UNIT:
            self._receiver.expect_nothing()
            self.state = MasterState.WAITING_TURNAROUND
            wait = self._serial.turnaround_delay
        else:
            self._receiver.expect(unit, wire[0], request.expected_size)
            self.state = MasterState.WAITING_FOR_REPLY
            usual = self._pace.get(unit) or max(self._pace.values(), default=0.0)
            wait = self.breakers.asked(unit, now, demand.timeout, usual)
        self._flight = _Flight(demand, request, position, unit, frame, leaves, leaves + wait)
        self._last_unit = unit
        self._last_byte = max(self._last_byte, leaves)
        self.counters.requests += 1
        return frame

    # What comes in.

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Work through the first ``size`` bytes of ``buffer``, read at ``now``."""
        self._last_byte = max(self._last_byte, now)
        for found in self._receiver.receive(bytes(memoryview(buffer)[:size]), now):
            self._found(found, now)

    def receive_damaged(self, data: bytes, now: float, *, overrun: bool = False) -> None:
        """Bytes among which the port marks a parity or framing error, or after which it lost some (S14).

        The frame in progress is discarded, and so is one that these bytes complete.
        """
        self._last_byte = max(self._last_byte, now)
        marked = [found for found in self._receiver.receive(data, now) if isinstance(found, Damaged)]
        for found in (*marked, *self._receiver.damaged(now, overrun=overrun)):
            self._found(found, now)

    def _found(self, found: Received, now: float) -> None:
        flight = self._flight
        if isinstance(found, Damaged):
            self.counters.damaged_frames += 1
            self.counters.overruns += found.overrun
            if flight is not None:
                flight.damage = found.raw
            return
        self._timeouts_in_row = 0
        if flight is None or self.state is not MasterState.WAITING_FOR_REPLY:
            self._unexpected(found)  # within a turnaround: somebody answers a broadcast
        elif found.unit != flight.unit or found.pdu[0] & 0x7F != flight.request.wire[0]:
            self._unexpected(found)
        elif found.direction is Direction.REQUEST and found.raw == flight.frame:
            self.counters.foreign_replies += 1  # our own frame, on a line that is not known to echo
        else:
            self._reply(flight, found, now)

    def _unexpected(self, frame: SerialFrame) -> None:
        """A frame that answers nothing asked now: of a unit that is slow, or of somebody else."""
        if not self._was_missed(frame):
            self.counters.foreign_replies += 1
            return
        missed = self._missed.pop(frame.unit)
        self._pauses.pop(frame.unit, None)
        self._try_at = 0.0
        self.counters.late_replies += 1
        self.observed_delay = frame.ended - missed.sent
        self.breakers.answered(frame.unit)

    def _was_missed(self, frame: SerialFrame) -> bool:
        missed = self._missed.get(frame.unit)
        return (
            missed is not None
            and frame.pdu[0] & 0x7F == missed.function
            and frame.direction is not Direction.REQUEST
            and frame.ended < missed.sent + LATE_FOR
        )

    def _reply(self, flight: _Flight, frame: SerialFrame, now: float) -> None:
        pdu = frame.pdu
        outcome: Message | ModbusError
        try:
            if pdu[0] & 0x80:
                outcome = ExceptionReply(decode_exception(pdu).exception, raw=frame.raw)
                self.counters.exceptions += 1
            else:
                outcome = flight.request.accept(pdu)
                self.counters.replies += 1
        except MalformedPdu as error:
            if self._was_missed(frame):
                self._unexpected(frame)  # it does not fit what is asked now, but comes from a unit that owes a reply
                return
            # The unit speaks, but breaks the protocol: no reason to ask it again, and none to give it up.
            self.counters.bad_replies += 1
            outcome = BadReply(error.reason, raw=frame.raw)
        self.valid_reply = True
        self.breakers.answered(frame.unit)
        self._learn_pace(flight, frame)
        if self._unit_gaps:
            self._keep_gap(frame)
        self._idle(frame.ended)
        demand, position = flight.demand, flight.position
        if demand is None:
            return
        if isinstance(outcome, Message):
            self._ledger.conclude(demand, position, outcome)
        elif isinstance(outcome, BadReply) or (
            _exception_code(outcome) == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND and flight.request.is_write
        ):
            self._ledger.failed(demand, position, outcome, now, again=False)
        else:
            self._ledger.conclude(demand, position, self._ledger.placed(outcome, demand, position, now))

    def _learn_pace(self, flight: _Flight, frame: SerialFrame) -> None:
        """How long the unit takes; where a missed reply could be this one, the other may still come."""
        unit = frame.unit
        delay = frame.ended - flight.sent
        missed = self._missed.get(unit)
        if missed is not None and unit not in self._pace and self._was_missed(frame):
            since = frame.ended - missed.sent
            self._missed[unit] = _Missed(missed.function, flight.sent)
            until = flight.sent + since + self._serial.quiet_window
            self._pauses[unit] = _Pause(until, until)
            return
        self._missed.pop(unit, None)
        self._pauses.pop(unit, None)
        self._pace[unit] = max(delay, self._pace.get(unit, 0.0) * _PACE_FORGETS)

    def _keep_gap(self, frame: SerialFrame) -> None:
        """The unit misses what comes too soon after its reply."""
        gap = self._unit_gaps.get(frame.unit)
        if gap:
            until = frame.ended + gap
            pause = self._pauses.get(frame.unit)
            same, other = (until, until) if pause is None else (pause.same_until, pause.other_until)
            self._pauses[frame.unit] = _Pause(max(until, same), max(until, other))

    def _idle(self, last_byte: float) -> None:
        """The transaction is over; gaps count from the end of the last frame."""
        self.state = MasterState.IDLE
        self._flight = None
        self._try_at = 0.0
        self._receiver.expect_nothing()
        if self.parameters.request_gap:
            self._not_before = max(self._not_before, last_byte + self.parameters.request_gap)

    # What time brings.

    def deadline(self) -> float | None:
        """When `tick` or `transmit` has something to do; None for never."""
        times = [time for time in (self._ledger.next_deadline(), self._receiver.deadline()) if time is not None]
        flight = self._flight
        if flight is not None:
            times.append(flight.expires)
            if flight.deadline is not None and self.state is MasterState.WAITING_FOR_REPLY:
                times.append(flight.deadline)
        elif self.state is MasterState.DRAINING:
            times.append(self._drained_at())
        elif self._ledger.queue.size and self._connected:
            times.append(self._try_at)
        return min(times, default=None)

    def _drained_at(self) -> float:
        return min(self._last_byte + self._serial.quiet_window, self._drain_until)

    def tick(self, now: float) -> None:
        """Let silences take effect, and end what has run out of time."""
        for found in self._receiver.tick(now):
            self._found(found, now)
        flight = self._flight
        if flight is not None:
            if now >= flight.expires:
                if self.state is MasterState.WAITING_TURNAROUND:
                    self._turned_around(flight, now)
                else:
                    self._time_out(flight, now)
            elif self.state is MasterState.WAITING_FOR_REPLY:
                self._keep_deadline(flight, now)
        elif self.state is MasterState.DRAINING and now >= self._drained_at():
            for found in self._receiver.flush(now):
                self._found(found, now)
            self.state = MasterState.IDLE
            self._try_at = 0.0
        flight = self._flight
        in_flight = {(id(flight.demand), flight.position)} if flight is not None else set()
        self._ledger.expire_queue(now, in_flight)

    def _keep_deadline(self, flight: _Flight, now: float) -> None:
        """A call that has run out of time ends; its request stays in flight (rule 7)."""
        demand = flight.demand
        if demand is not None and demand.deadline is not None and now >= demand.deadline:
            flight.demand = None
            error = NoReply("no answer before the deadline of the call", raw=flight.damage)
            self._ledger.failed(demand, flight.position, error, now, again=False)

    def _turned_around(self, flight: _Flight, now: float) -> None:
        """A broadcast has been sent and every server had its time: it is done."""
        self._idle(now)
        if flight.demand is not None:
            self._ledger.conclude(flight.demand, flight.position, flight.request)

    def _time_out(self, flight: _Flight, now: float) -> None:
        for found in self._receiver.flush(now):
            self._found(found, now)
        if self._flight is None:
            return  # the reply was there, held back until it was clear that nothing follows
        self._flight = None
        self.counters.timeouts += 1
        unit = flight.unit
        probing = self.breakers.is_probing(unit)
        opened = self.breakers.timed_out(unit, now)
        self.state = MasterState.DRAINING
        self._drain_until = now + self._serial.drain_limit
        self._receiver.expect_nothing()
        if unit not in self._missed or not self._is_repeated(flight):
            self._missed[unit] = _Missed(flight.request.wire[0], flight.sent)
        quiet = now + self._serial.quiet_window
        waited = flight.expires - flight.sent
        self._pauses[unit] = _Pause(quiet, quiet if unit in self._pace else max(quiet, flight.sent + 2 * waited))
        self._failed(flight, self._no_reply(flight), now, again=not probing and not opened)
        if opened:
            self._fail_suspended(now)
        self._timeouts_in_row += 1
        if self._framing.is_network and self._timeouts_in_row >= self.parameters.recycle_after_timeouts:
            self.recycle = f"{self._timeouts_in_row} timeouts in a row"
            self.counters.recycled += 1

    def _is_repeated(self, flight: _Flight) -> bool:
        return flight.demand is not None and flight.demand.attempts.get(flight.position, 1) > 1

    def _no_reply(self, flight: _Flight) -> NoReply:
        waited = flight.expires - flight.sent
        if flight.damage:
            return NoReply(f"only a damaged reply came within {waited:.3g} s", kind="partial", raw=flight.damage)
        if self.observed_delay is not None:
            return NoReply(
                f"no reply within {waited:.3g} s; the last late reply on this line had taken "
                f"{self.observed_delay:.3f} s, a longer timeout would take it",
                kind="late",
                observed_delay=self.observed_delay,
            )
        return NoReply(f"no reply within {waited:.3g} s")

    def _failed(self, flight: _Flight, error: ModbusError, now: float, *, again: bool) -> None:
        """End what was in flight with an error, or repeat it."""
        self._try_at = 0.0
        if flight.demand is not None:
            self._ledger.failed(flight.demand, flight.position, error, now, again=again)


def _exception_code(outcome: ModbusError) -> int | None:
    """The exception code of an outcome that is an exception."""
    return outcome.code if isinstance(outcome, ExceptionReply) else None
