"""The master of a serial line: one transaction at a time, with the turnaround, gaps and doubts of a shared wire.

Knows the master's state diagram (Serial Line V1.02 §2.4.1) and how to come back in step; knows no port and no clock.
RTU and ASCII differ only in the receiver and in the encoding that are handed in.

1. States: idle → waiting for a reply (unicast) or for the turnaround (broadcast) → idle. One request is in flight.
2. A reply of another unit keeps the timer running. A damaged frame counts, and may be repeated like a timeout.
3. After a timeout the line is drained: nothing is sent before it has been silent for ``quiet_window``. Whatever comes
   until then is late and dropped. What can not be told apart on RTU is a reply that comes after that window with the
   unit, function and length of the next request: the window is what guards against it.
4. Nothing is sent before t3.5 after the last byte of anybody, ``request_gap`` after a reply and ``unit_switch_gap``
   where the unit changes.
5. Dead units cost the line no more than a probe (`breaker`); their requests fail with `UnitSuspended`.
6. A cancelled request stays in flight until its reply comes or its time is over.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

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
from ..framing.received import Damaged, SerialFrame, SerialReceiver
from ..framing.timing import SerialTiming
from ..pdu.general import ExceptionResponse
from ..pdu.malformed import MalformedPdu
from ..pdu.message import Message, Request
from .breaker import BreakerParameters, Breakers
from .demand import Demand
from .ledger import Ledger, function_of
from .parameters import ClientParameters

EncodeFrame = Callable[[int, bytes], bytes]


@dataclass(frozen=True, slots=True)
class SerialClientParameters:
    """What a master on a serial line has besides `ClientParameters`.

    Attributes:
        turnaround_delay: seconds after a broadcast before the next request (§2.4.1: 100…200 ms typical).
        unit_switch_gap: seconds of silence where the next request goes to another unit, at least t3.5.
        quiet_window: seconds of silence that end a drain after a timeout.
        drain_limit: seconds after which a drain ends although the line never fell silent.
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


class SerialClientSession:
    """One line's conversation, across reopenings of its port.

    Attributes:
        counters, finished, recycle, observed_delay, valid_reply: as in `TcpClientSession`.
        state: where the master stands.
        breakers: which units are not asked.
    """

    __slots__ = (
        "_connected",
        "_demand",
        "_drain_until",
        "_encode",
        "_expires",
        "_last_unit",
        "_late",
        "_ledger",
        "_not_before",
        "_position",
        "_raw",
        "_receiver",
        "_request",
        "_sent",
        "_serial",
        "_timing",
        "_unit",
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
        receiver: SerialReceiver,
        encode: EncodeFrame,
        timing: SerialTiming,
        jitter: Callable[[], float],
        serial: SerialClientParameters | None = None,
        breaker: BreakerParameters | None = None,
        endpoint: str = "",
    ) -> None:
        self.parameters = parameters
        self.recycle = ""
        self.observed_delay: float | None = None
        self.valid_reply = False
        self.state = MasterState.IDLE
        self.breakers = Breakers(breaker or BreakerParameters(), jitter)
        self._ledger = Ledger(parameters, endpoint)
        self.counters = self._ledger.counters
        self.finished = self._ledger.finished
        self._serial = serial or SerialClientParameters()
        self._receiver = receiver
        self._encode = encode
        self._timing = timing
        self._connected = False
        self._demand: Demand | None = None  # None while nothing is in flight, or what is was cancelled
        self._request: Request | None = None
        self._position = 0
        self._unit = BROADCAST_UNIT
        self._sent = 0.0  # when the last byte of the request left
        self._expires = 0.0
        self._raw = b""
        self._last_unit: int | None = None
        self._not_before = 0.0
        self._drain_until = 0.0
        self._late: tuple[int, int, float] | None = None  # unit, function and sending time of what timed out last

    # What the application asks.

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
            self.counters.suspended += 1
            raise self._suspended(demand, pause)
        self._ledger.submit(demand, now)

    def _check_unit(self, demand: Demand) -> None:
        endpoint = self._ledger.endpoint or None
        if not 0 <= demand.unit <= LAST_SERIAL_UNIT:
            raise InvalidRequest(
                f"a unit on a serial line is 1…{LAST_SERIAL_UNIT}, not {demand.unit}", endpoint=endpoint
            )
        if demand.unit == BROADCAST_UNIT:
            for request in demand.requests:
                if not request.broadcast:
                    raise InvalidRequest(
                        f"{type(request).__name__} can not be broadcast: only writes go to unit 0",
                        endpoint=endpoint,
                        unit=0,
                        function=function_of(request),
                    )

    def _suspended(self, demand: Demand, pause: float) -> UnitSuspended:
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
        if self._demand is demand:
            self._demand = None
        self._ledger.withdraw(demand)

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
        """1 while a reply is awaited."""
        return 1 if self._request is not None else 0

    # What the port reports.

    def connected(self, now: float) -> None:
        """The port is open."""
        self._connected = True
        self._receiver.flush(now)
        self._receiver.expect_nothing()
        self.state = MasterState.IDLE
        self._not_before = now + self.parameters.connect_delay
        self.recycle = ""
        self.valid_reply = False
        self.counters.connections += 1

    def disconnected(self, now: float, reason: str) -> None:
        """The port has gone; what was in flight is repeated or fails, what waits stays in the queue."""
        if self._connected:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        error = LinkDown(f"the port was lost before the reply: {reason}", sent=True)
        self._end(error, now, again=True)
        self.state = MasterState.IDLE

    def unreachable(self, now: float, error: ModbusError) -> None:
        """The port can not be opened: everything that waits fails, at once and with the same reason."""
        self._ledger.unreachable(now, error)

    # What goes out.

    def transmit(self, now: float) -> list[bytes]:
        """The frame to send now, or nothing; it counts as sent when its last character has left."""
        if not self._connected or self.state is not MasterState.IDLE or not self._ledger.queue.size:
            return []
        if now < self._clear_at():
            return []
        queue = self._ledger.queue
        demand = queue.pick(lambda unit: self._may_ask(unit, now))
        if demand is None:
            self._fail_suspended(now)
            return []
        (position,) = demand.take(1)
        if not demand.has_more:
            queue.remove(demand)
        request = demand.requests[position]
        try:
            wire = request.wire
        except AttributeError:
            wire = request.prepare()
        frame = self._encode(demand.unit, wire)
        leaves = now + self._timing.duration(len(frame))
        timeout = self.breakers.asked(demand.unit, now, demand.timeout)
        self._demand, self._request, self._position, self._unit = demand, request, position, demand.unit
        self._sent = leaves
        self._raw = b""
        self._last_unit = demand.unit
        self.counters.requests += 1
        self._receiver.sent(frame, leaves)
        if demand.unit == BROADCAST_UNIT:
            self._receiver.expect_nothing()
            self.state = MasterState.WAITING_TURNAROUND
            self._expires = leaves + self._serial.turnaround_delay
        else:
            self._receiver.expect(demand.unit, wire[0], request.expected_size)
            self.state = MasterState.WAITING_FOR_REPLY
            self._expires = leaves + timeout
        return [frame]

    def _clear_at(self) -> float:
        """When a frame may be sent: t3.5 after anybody's last byte, and after the gaps that devices need."""
        clear = max(self._receiver.clear_at(), self._not_before)
        gap = self._serial.unit_switch_gap
        if gap:
            unit = self._next_unit()
            if unit is not None and self._last_unit is not None and unit != self._last_unit:
                clear = max(clear, self._sent + gap, self._receiver.clear_at() - self._timing.t3_5 + gap)
        return clear

    def _next_unit(self) -> int | None:
        """The unit that is asked next, as far as the queue tells without turning."""
        return next((demand.unit for demand in self._ledger.queue), None)

    def _may_ask(self, unit: int, now: float) -> bool:
        return self.breakers.suspended_for(unit, now) is None

    def _fail_suspended(self, now: float) -> None:
        """What waits for a unit whose breaker has opened meanwhile does not wait for its probe."""
        for demand in list(self._ledger.queue):
            pause = self.breakers.suspended_for(demand.unit, now)
            if pause is None:
                continue
            self._ledger.queue.remove(demand)
            for position, outcome in enumerate(demand.outcomes):
                if outcome is None:
                    self.counters.suspended += 1
                    error = self._suspended(demand, pause)
                    self._ledger.conclude(demand, position, self._ledger.placed(error, demand, position, now))

    # What comes in.

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Work through the first ``size`` bytes of ``buffer``, read at ``now``."""
        for found in self._receiver.receive(bytes(buffer[:size]), now):
            self._found(found, now)

    def damaged(self, now: float, *, overrun: bool = False) -> None:
        """The port marks a parity or framing error, or lost characters, here."""
        for found in self._receiver.damaged(now, overrun=overrun):
            self._found(found, now)

    def _found(self, found: SerialFrame | Damaged, now: float) -> None:
        if isinstance(found, Damaged):
            self.counters.damaged_frames += 1
            if self.state is MasterState.WAITING_FOR_REPLY:
                self._raw = found.raw
            return
        if self.state is MasterState.WAITING_TURNAROUND:
            self.counters.foreign_replies += 1  # somebody answers a broadcast: swallowed
            return
        if self.state is not MasterState.WAITING_FOR_REPLY or self._request is None:
            self._late_frame(found)
            return
        if found.unit != self._unit or found.pdu[0] & 0x7F != self._request.wire[0]:
            self._late_frame(found)
            return
        self._reply(found, now)

    def _late_frame(self, frame: SerialFrame) -> None:
        """A frame that answers nothing asked now: of a unit that is slow, or of somebody else."""
        late = self._late
        if late is not None and frame.unit == late[0] and frame.pdu[0] & 0x7F == late[1]:
            self.counters.late_replies += 1
            self.observed_delay = frame.ended - late[2]
            self._late = None
            self.breakers.answered(frame.unit)
        else:
            self.counters.foreign_replies += 1

    def _reply(self, frame: SerialFrame, now: float) -> None:
        request = self._request
        assert request is not None
        pdu = frame.pdu
        outcome: Message | ModbusError
        try:
            if pdu[0] & 0x80:
                # 43/14 may be refused with AB 0E cc, the form that the figure of its section prints.
                short = pdu[:1] + pdu[2:] if pdu[0] == 0xAB and len(pdu) == 3 else pdu
                outcome = ExceptionReply(ExceptionResponse.decode(short).exception, raw=frame.raw)
                self.counters.exceptions += 1
            else:
                outcome = request.accept(pdu)
                self.counters.replies += 1
        except MalformedPdu as error:
            # The unit speaks, but breaks the protocol: no reason to ask it again, and none to give it up.
            self.counters.bad_replies += 1
            outcome = BadReply(error.reason, raw=frame.raw)
        self.valid_reply = True
        self.breakers.answered(frame.unit)
        demand = self._demand
        position = self._position
        self._idle(frame.ended)
        if demand is None:
            return
        if isinstance(outcome, Message):
            self._ledger.conclude(demand, position, outcome)
        elif isinstance(outcome, BadReply) or (
            isinstance(outcome, ExceptionReply)
            and outcome.code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND
            and request.is_write
        ):
            self._ledger.failed(demand, position, outcome, now, again=False)
        else:
            self._ledger.conclude(demand, position, self._ledger.placed(outcome, demand, position, now))

    def _idle(self, last_byte: float) -> None:
        """The transaction is over; gaps count from the end of the last frame."""
        self.state = MasterState.IDLE
        self._receiver.expect_nothing()
        self._demand = self._request = None
        if self.parameters.request_gap:
            self._not_before = max(self._not_before, last_byte + self.parameters.request_gap)

    # What time brings.

    def deadline(self) -> float | None:
        """When `tick` or `transmit` has something to do; None for never."""
        times = [time for time in (self._ledger.next_deadline(), self._receiver.deadline()) if time is not None]
        if self.state in (MasterState.WAITING_FOR_REPLY, MasterState.WAITING_TURNAROUND):
            times.append(self._expires)
            if self._demand is not None and self._demand.deadline is not None:
                times.append(self._demand.deadline)
        elif self.state is MasterState.DRAINING:
            times.append(self._drained_at())
        elif self._ledger.queue.size and self._connected:
            times.append(self._clear_at())
        return min(times, default=None)

    def _drained_at(self) -> float:
        quiet = self._receiver.clear_at() - self._timing.t3_5 + self._serial.quiet_window
        return min(max(quiet, self._sent + self._serial.quiet_window), self._drain_until)

    def tick(self, now: float) -> None:
        """Let silences take effect, and end what has run out of time."""
        for found in self._receiver.tick(now):
            self._found(found, now)
        demand = self._demand
        if self.state is MasterState.WAITING_FOR_REPLY:
            over = demand is not None and demand.deadline is not None and now >= demand.deadline
            if now >= self._expires or over:
                self._time_out(now, over=over)
        elif self.state is MasterState.WAITING_TURNAROUND and now >= self._expires:
            self._turned_around(now)
        elif self.state is MasterState.DRAINING and now >= self._drained_at():
            self._receiver.flush(now)
            self.state = MasterState.IDLE
        in_flight = {(id(self._demand), self._position)} if self._demand is not None else set()
        self._ledger.expire_queue(now, in_flight)

    def _turned_around(self, now: float) -> None:
        """A broadcast has been sent and every server had its time: it is done."""
        demand, request, position = self._demand, self._request, self._position
        self._idle(now)
        if demand is not None and request is not None:
            self._ledger.conclude(demand, position, request)

    def _time_out(self, now: float, *, over: bool) -> None:
        for found in self._receiver.flush(now):
            self._found(found, now)
        request = self._request
        if request is None:
            return  # the reply was there, held back until it was clear that nothing follows
        self.counters.timeouts += 1
        unit = self._unit
        probing = self.breakers.is_probing(unit)
        self._late = (unit, request.wire[0], self._sent)
        opened = self.breakers.timed_out(unit, now)
        self.state = MasterState.DRAINING
        self._drain_until = now + self._serial.drain_limit
        self._receiver.expect_nothing()
        waited = self._expires - self._sent
        error: ModbusError
        if self._raw:
            error = NoReply(f"only a damaged reply came within {waited:.3g} s", kind="partial", raw=self._raw)
        elif self.observed_delay is not None:
            error = NoReply(
                f"no reply within {waited:.3g} s; the last late reply on this line had taken "
                f"{self.observed_delay:.3f} s, a longer timeout would take it",
                kind="late",
                observed_delay=self.observed_delay,
            )
        else:
            error = NoReply(f"no reply within {waited:.3g} s")
        self._end(error, now, again=not over and not probing and not opened)

    def _end(self, error: ModbusError, now: float, *, again: bool) -> None:
        """End what is in flight with an error, or repeat it."""
        demand, position = self._demand, self._position
        self._demand = self._request = None
        if demand is not None:
            self._ledger.failed(demand, position, error, now, again=again)
