"""The client's side of a TCP connection: demands in, ADUs out, replies matched to what was asked.

Knows the rules of Messaging on TCP/IP V1.0b §4.4.1 and of devices that break them; knows no socket and no clock:
times are ``now`` in seconds, and whoever drives a session calls `TcpClientSession.tick` at `deadline`.

1. At most ``max_transactions`` requests are in flight; the rest waits in a bounded queue, in the order of `queue`.
2. A reply belongs to the pending transaction it names, and must fit it in unit, function, length and echo. What fits
   no pending transaction is dropped and counted; it is never given to another request.
3. The identifier of a request that timed out or was cancelled is remembered and not used again while the connection
   lasts; its late reply is dropped, and tells how slow the device is.
4. A read is repeated after a timeout or a lost connection, a write only if nothing of it left this host or
   ``write_retries`` says so; otherwise it ends as `WriteOutcomeUnknown`.
5. Where transactions can not be told apart (policies automatic and ignore), a timeout ends the connection: the next
   reply could be the late one.
6. A connection that brings nothing but timeouts, or late replies only, is made anew.
7. A cancelled request keeps its place among those in flight until its reply comes or its time is over: the device is
   still working on it.
8. Where units are watched, one that does not answer is not asked for a while, and its requests fail with
   `UnitSuspended`: one transaction at a time would else be lost to it, and all others wait (`breaker`).
9. Reads of one demand fly as a volley, and are taken together when all of them are answered in their order. Whatever
   else happens takes all volleys apart first (`_scatter`), so that all rules are about single requests.
"""

from collections import deque
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType

from ..codes import TCP_DEVICE_UNIT, ExceptionCode
from ..errors import BadReply, ExceptionReply, LinkDown, ModbusError, NoReply
from ..framing.mbap import HEAD_AND_FUNCTION, MAX_LENGTH, MIN_LENGTH, StreamBuffer, impossible_length
from ..pdu.general import decode_exception
from ..pdu.malformed import MalformedPdu
from ..pdu.message import Request
from .breaker import Breakers, BreakerState
from .demand import Demand
from .flights import HEAD_SIZE, Flight, Places, Volley, places, plan_of, route_of
from .ledger import Ledger
from .parameters import ClientParameters, MismatchPolicy
from .queue import BURST

_unpack = HEAD_AND_FUNCTION.unpack_from
_EXPIRED_LIMIT = 4096
_PACE_FORGETS = 0.9
"""The usual time of a unit is its slowest lately: each faster reply takes a tenth off."""
_LAUNCHES_APART = 32
"""So many times requests fly one by one after replies have come in another order, or one was an exception: to take a
volley apart costs a fifth of what its requests cost."""
_LATE_FACTOR = 2
_LATE_KNOWN = 60.0
"""Seconds for which a unit that answered too late is called slow."""
"""A late reply is a sign of life, but where replies run behind for ever (Growatt_ModbusTCP#317) only a new connection
helps: so many times more timeouts are borne while late replies come."""
_NO_DOUBTS: Mapping[int, object] = MappingProxyType({})
_STEP = 1021
"""From one identifier to the next; odd, so that all are used. Devices that answer with the identifier of the request
plus 1 (sunsynk#680) would with a step of 1 hit another request in flight, and give it the wrong data."""


class TcpClientSession:
    """One link's conversation, across reconnections.

    Attributes:
        counters: what happened.
        finished: demands that have all their outcomes; the driver empties the list.
        recycle: why the connection must be closed and made anew; empty while it need not.
        late_units: by unit, when its last late reply came and how many seconds it had taken.
        valid_reply: whether this connection has brought a reply that answers a request, in time or late.
        breakers: which units are not asked; None where units are not watched.
    """

    __slots__ = (
        "_buffer",
        "_connected",
        "_doubtful",
        "_expired",
        "_foreign_in_row",
        "_free",
        "_launches_apart",
        "_ledger",
        "_not_before",
        "_pace",
        "_pending",
        "_queue",
        "_timeouts_in_row",
        "_timeouts_since_reply",
        "_transaction",
        "_volleys",
        "breakers",
        "counters",
        "finished",
        "late_units",
        "parameters",
        "recycle",
        "valid_reply",
    )

    def __init__(
        self,
        parameters: ClientParameters,
        *,
        endpoint: str = "",
        first_transaction: int = 0,
        shared_places: Places | None = None,
    ) -> None:
        self.parameters = parameters
        self._ledger = Ledger(parameters, endpoint)
        self.counters = self._ledger.counters
        self.finished = self._ledger.finished
        self.recycle = ""
        self.late_units: dict[int, tuple[float, float]] = {}
        self.valid_reply = False
        self._queue = self._ledger.queue
        self._pending: dict[int, Flight] = {}
        self._volleys: deque[Volley] = deque()
        self._free = places(parameters.max_transactions) if shared_places is None else shared_places
        self._expired: dict[int, float] = {}
        self._transaction = first_transaction & 0xFFFF
        self._buffer = StreamBuffer()
        self._connected = False
        self._not_before = 0.0
        self._timeouts_in_row = 0
        self._timeouts_since_reply = 0
        self._foreign_in_row = 0
        self._launches_apart = 0  # how many more times requests fly one by one
        self.breakers: Breakers | None = None
        self._doubtful: Mapping[int, object] = _NO_DOUBTS  # units that timed out and have not answered since
        self._pace: dict[int, float] = {}  # seconds that units usually take, where they are watched

    def watch_units(self, breakers: Breakers) -> None:
        """Ask no unit for a while that does not answer."""
        self.breakers = breakers
        self._doubtful = breakers.doubtful

    # What the application asks.

    def submit(self, demand: Demand, now: float) -> None:
        """Take a demand. Raises `Overloaded` where the queue is full, `UnitSuspended`; nothing was sent then."""
        if self.breakers is not None:
            pause = self.breakers.suspended_for(demand.unit, now)
            if pause is not None:
                raise self._ledger.suspended(demand, pause, self.breakers.parameters.open_after)
        self._ledger.submit(demand, now)

    def cancel(self, demand: Demand) -> bool:
        """The caller has gone: nothing more of the demand is sent, and what is in flight finishes unseen.

        Returns:
            Whether something of it is in flight.
        """
        self._scatter()
        flights = [flight for flight in self._pending.values() if flight.demand is demand]
        for flight in flights:
            flight.demand = None
        self._ledger.withdraw(demand)
        return bool(flights)

    def serve_units_in_turn(self) -> None:
        """Serve the units of each caller in turn: for callers that stand for many, as a client of a gateway does."""
        self._queue.units_in_turn = True
        self._queue.burst = BURST

    @property
    def has_demands(self) -> bool:
        """Whether something waits to be sent."""
        return self._queue.size > 0

    @property
    def has_gap(self) -> bool:
        """Whether what waits may be sent only later: after the connect delay or the request gap."""
        return self._connected and self._not_before > 0.0

    @property
    def queued(self) -> int:
        """What waits to be sent: calls, or requests of a gateway's clients."""
        return self._queue.waiting

    @property
    def in_flight(self) -> int:
        """Requests whose reply is awaited."""
        return len(self._pending) + sum(len(volley.places) for volley in self._volleys)

    # What the connection reports.

    def connected(self, now: float) -> None:
        """A new connection stands."""
        self._connected = True
        self._buffer = StreamBuffer()
        self._expired.clear()
        self._timeouts_in_row = self._timeouts_since_reply = self._foreign_in_row = 0
        if self._not_before <= now:
            self._not_before = 0.0  # else the device still wants its gap, whichever connection it comes from
        if self.parameters.connect_delay:
            self._not_before = max(self._not_before, now + self.parameters.connect_delay)
        self.recycle = ""
        self.valid_reply = False
        self.counters.connections += 1

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """The connection has ended; what was in flight is repeated or fails, what waits stays in the queue.

        ``lost`` says that it ended by itself.
        """
        if self._connected and lost:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        self._scatter()
        for flight in list(self._pending.values()):
            self._release(flight)
            if self.breakers is not None:
                self.breakers.not_decided(flight.route.unit)
            if flight.demand is not None:
                error = LinkDown(f"the connection ended before the reply: {reason}", sent=True)
                self._failed(flight, flight.demand, error, now, again=True)
        self._pending.clear()

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """No connection could be had: everything that waits fails, at once and with the same reason.

        With ``keep_repeated`` a demand that is about to be repeated waits for the next attempt.
        """
        self._ledger.unreachable(now, error, keep_repeated=keep_repeated)

    # What goes out and comes in.

    def transmit(self, now: float) -> list[bytes]:
        """The ADUs to send now, in order; they count as sent at ``now``."""
        out: list[bytes] = []
        queue = self._queue
        if not queue.size or not self._connected or self.recycle or not self._free:
            return out
        if self._buffer.kept and not self._pending and not self._volleys:
            # Bytes that answer nothing: the next reply would be read as their continuation.
            self._recycle(f"{len(self._buffer.kept)} bytes of an unfinished frame before the request")
            return out
        if now < self._not_before:
            return out
        self._not_before = 0.0
        free = self._free
        gap = self.parameters.request_gap
        room = len(free)
        eligible = partial(self._may_ask, now) if self._doubtful else None
        while free and (demand := queue.pick(eligible)) is not None:
            turn = 1 if gap else min(len(free), queue.share(room))
            while demand is not None:
                before = len(free)
                self._send(demand, now, out, at_most=turn)
                sent = before - len(free)
                queue.sent(demand, sent)
                turn -= sent
                demand = queue.pick_same(eligible) if turn > 0 else None
            if gap:
                break
        return out

    def send_now(self, demand: Demand, now: float) -> bytes | None:
        """The ADUs of a demand, joined, if nothing waits and all of it may go at once; None: `submit` it."""
        count = len(demand.requests)
        if (
            self._queue.size
            or len(self._free) < count
            or not self._connected
            or now < self._not_before
            or self.recycle
            or self._buffer.kept
            or (self._doubtful and self._is_doubted(demand))
        ):
            return None
        if count == 1:
            self._ledger.begin(demand, now)
            demand.next = 1
            self.counters.requests += 1
            return self._launch(demand, 0, now)
        if self.parameters.request_gap or self.parameters.single_adu_segments or demand.is_write:
            return None
        adus = self._launch_volley(demand, count, now)
        if adus is not None:
            self._ledger.begin(demand, now)
        return adus

    def _is_doubted(self, demand: Demand) -> bool:
        """Whether the unit is not asked, or only probed."""
        return self.breakers is not None and self.breakers.state(demand.unit) is not BreakerState.CLOSED

    def _may_ask(self, now: float, demand: Demand) -> bool:
        return self.breakers is None or self.breakers.suspended_for(demand.unit, now) is None

    def _send(self, demand: Demand, now: float, out: list[bytes], *, at_most: int) -> None:
        """Put up to ``at_most`` requests of a demand in flight; those of one demand leave joined."""
        if self._doubtful and self._is_doubted(demand):
            at_most = 1  # it is a probe
        requests = len(demand.requests)
        if requests > 1 and not demand.again and not demand.is_write and not self.parameters.single_adu_segments:
            together = self._launch_volley(demand, min(at_most, requests - demand.next), now)
            if together is not None:
                out.append(together)
                return
        adus = [self._launch(demand, position, now) for position in demand.take(at_most)]
        self.counters.requests += len(adus)
        if len(adus) == 1 or self.parameters.single_adu_segments:
            out += adus
        else:
            out.append(b"".join(adus))

    def _launch_volley(self, demand: Demand, count: int, now: float) -> bytes | None:
        """Put the next ``count`` requests in flight together, one for each free place; None if they can not go so.

        Where others fly by themselves the device answers one by one, or in another order: a volley would only be taken
        apart again.
        """
        if count < 2 or self._pending:
            return None
        if self._launches_apart:
            self._launches_apart -= 1
            return None
        first = demand.next
        plan = plan_of(demand.requests, first, count, demand.unit)
        if not plan.fits:
            return None
        start = self._transaction + _STEP
        stop = start + _STEP * count
        if stop - _STEP <= 0xFFFF:
            transactions = tuple(range(start, stop, _STEP))  # 0.1 µs less for each request than the other way
        else:
            transactions = tuple([one & 0xFFFF for one in range(start, stop, _STEP)])
        if self._expired and not self._expired.keys().isdisjoint(transactions):
            return None
        self._transaction = transactions[-1]
        free = self._free
        self._volleys.append(Volley(demand, first, plan, transactions, free[-count:], now))
        del free[-count:]
        demand.next = first + count
        self.counters.requests += count
        return plan.encode(transactions)

    def _launch(self, demand: Demand, position: int, now: float) -> bytes:
        """Put a request in flight, on a place that is free; its ADU."""
        pending, expired = self._pending, self._expired
        route = route_of(demand.requests[position], demand.unit)
        transaction = self._transaction + _STEP & 0xFFFF
        while transaction in pending or transaction in expired:
            transaction = transaction + _STEP & 0xFFFF
        self._transaction = transaction
        flight = pending[transaction] = self._free.pop()
        flight.demand = demand
        flight.position = position
        flight.route = route
        flight.sent = now
        flight.expires = now + (self._patience(demand, now) if self._doubtful else demand.timeout)
        return transaction.to_bytes(2, "big") + route.tail

    def _patience(self, demand: Demand, now: float) -> float:
        """Seconds to wait for a unit that is watched: fewer for a probe, where it is known what is usual."""
        assert self.breakers is not None
        usual = self._usual(demand.unit)
        return self.breakers.asked(demand.unit, now, demand.timeout, usual or demand.timeout)

    def _usual(self, unit: int) -> float:
        """Seconds that a unit usually takes, or else the slowest of the others; 0 if nobody has answered yet."""
        return self._pace.get(unit) or max(self._pace.values(), default=0.0)

    def _scatter(self) -> None:
        """Take all volleys apart: from here on each of their requests flies by itself."""
        for volley in self._volleys:
            self._pending.update(volley.apart())
        self._volleys.clear()

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Work through the first ``size`` bytes of ``buffer``. Demands that are complete are in ``finished``."""
        if self._buffer.kept:
            joined, size = self._buffer.join(buffer, size)
            data = bytes(joined)
        else:
            data = buffer if isinstance(buffer, bytes) else bytes(memoryview(buffer)[:size])
        pending = self._pending
        free = self._free
        ledger = self._ledger
        doubtful = self._doubtful
        last: Flight | None = None
        at = good = 0
        if self._volleys:
            at = self._receive_volleys(data, size, now)
        # 1.0 µs per reply: one that answers its request is told by the seven bytes behind its transaction, and
        # `Request.take` makes it of its data. All else goes through _odd_frame.
        while size - at >= 8:
            transaction = data[at] << 8 | data[at + 1]
            flight = pending.get(transaction)
            if flight is not None and data[at + 2 : at + 9] == flight.route.head:
                demand, route = flight.demand, flight.route
                end = at + route.reply_size
                if end > size:
                    break
                if demand is not None:
                    del pending[transaction]
                    free.append(flight)
                    good += 1
                    last = flight
                    if doubtful:
                        self._unit_lives(demand.unit)
                    demand.outcomes[flight.position] = route.take(data[at + HEAD_SIZE : end])
                    demand.open -= 1
                    if not demand.open:
                        ledger.finish(demand)
                    at = end
                    continue
            transaction, protocol, length, unit, _ = _unpack(data, at)
            end = at + 6 + length
            if not MIN_LENGTH <= length <= MAX_LENGTH or end > size:
                break
            self._odd_frame(transaction, protocol, unit, data[at:end], now)
            at = end
        if last is not None:
            self._answered(good, now)
            if self.breakers is not None:
                self._learn_pace(last.route.unit, now - last.sent)
        if size - at >= 6:
            length = data[at + 4] << 8 | data[at + 5]
            if not MIN_LENGTH <= length <= MAX_LENGTH:
                self._broken_stream(impossible_length(length), data[at:size], now)
                return
        if at < size:
            self._buffer.keep(data, at, size)

    def _receive_volleys(self, buffer: bytes, size: int, now: float) -> int:
        """Take replies that come in the order of what was asked; where those end that did.

        This is the hot path of `execute_many`: 0.5 µs per reply where all of a volley are there, 0.9 where some are.
        """
        volleys = self._volleys
        at = good = 0
        while volleys and size - at >= HEAD_SIZE:
            volley = volleys[0]
            plan, demand, answered = volley.plan, volley.demand, volley.answered
            end = at + plan.reply_size
            replies = plan.replies(volley.transactions, buffer, at) if not answered and end <= size else None
            if replies is not None:
                demand.outcomes[volley.first : volley.first + len(replies)] = replies
                self._free += volley.places
                volley.answered = len(replies)
            elif volley.expects(buffer, at):
                end = at + plan.reply_sizes[answered]
                if end > size:
                    break
                replies = [plan.takers[answered](buffer[at + HEAD_SIZE : end])]
                demand.outcomes[volley.first + answered] = replies[0]
                self._free.append(volley.places.pop())
                volley.answered += 1
            else:
                self._scatter()
                self._launches_apart = _LAUNCHES_APART
                break
            at = end
            good += len(replies)
            if volley.answered == len(plan.heads):
                volleys.popleft()
            demand.open -= len(replies)
            if self.breakers is not None:
                took, known = now - volley.sent, self._pace.get(demand.unit, 0.0) * _PACE_FORGETS
                self._pace[demand.unit] = took if took > known else known
                if self._doubtful:
                    self._unit_lives(demand.unit)
            if not demand.open:
                self._ledger.finish(demand)
        if good:
            self._answered(good, now)
        return at

    def in_work(self) -> list[Demand]:
        """The demands of several requests of which some are in flight, or are ended while others wait for their turn.

        One may be named more than once, and others that are in flight may be named too.
        """
        if not (self._volleys or self._pending or self._queue.begun):
            return []  # as a rule, where a server answers in one go
        found = [volley.demand for volley in self._volleys]
        found += [flight.demand for flight in self._pending.values() if flight.demand is not None]
        found += self._queue.begun
        return found

    # What time brings.

    def deadline(self) -> float | None:
        """When `tick` has something to do; None for never."""
        times = [flight.expires for flight in self._pending.values()]
        times += [volley.expires for volley in self._volleys]
        if self._ledger.deadlines:
            queued = self._ledger.next_deadline()
            if queued is not None:
                times.append(queued)
            times += [
                flight.demand.deadline
                for flight in self._pending.values()
                if flight.demand is not None and flight.demand.deadline is not None
            ]
            times += [one.demand.deadline for one in self._volleys if one.demand.deadline is not None]
        if self._queue.size and self._connected and self._free and self._not_before:
            times.append(self._not_before)
        return min(times, default=None)

    def tick(self, now: float) -> None:
        """End what has run out of time."""
        self._scatter()
        for transaction, flight in list(self._pending.items()):
            demand = flight.demand
            over = demand is not None and demand.deadline is not None and now >= demand.deadline
            if now >= flight.expires or over:
                del self._pending[transaction]
                self._release(flight)
                self._timed_out(transaction, flight, now, over=over)
        if now >= self._not_before:
            self._not_before = 0.0  # else a link that may not send for another reason would be woken again and again
        if self._ledger.deadlines:
            in_flight = {(id(one.demand), one.position) for one in self._pending.values()}
            self._ledger.expire_queue(now, in_flight)

    def _timed_out(self, transaction: int, flight: Flight, now: float, *, over: bool) -> None:
        """The reply did not come in time: remember the identifier, and repeat or fail."""
        self._remember(transaction, flight.sent)
        kept = self._buffer.kept
        is_given_up = self.breakers is not None and self._unit_is_silent(self.breakers, flight, now)
        if flight.demand is not None:
            self.counters.timeouts += 1
            self._timeouts_in_row += 1
            self._timeouts_since_reply += 1
            error = self._no_reply(flight, kept, now, over=over)
            self._failed(flight, flight.demand, error, now, again=not over and not is_given_up)
        if is_given_up:
            self._fail_suspended(now)
        if kept:
            self._recycle("a frame began and did not end within the timeout")
        elif self._tolerant:
            self._recycle("a timeout where transactions can not be told apart")
        elif self._timeouts_in_row >= self.parameters.recycle_after_timeouts:
            self._recycle(f"{self._timeouts_in_row} timeouts in a row")
        elif self._timeouts_since_reply >= _LATE_FACTOR * self.parameters.recycle_after_timeouts:
            self._recycle(f"{self._timeouts_since_reply} timeouts, and only late replies between them")

    def _unit_is_silent(self, breakers: Breakers, flight: Flight, now: float) -> bool:
        """A unit did not answer; whether it is not asked any more now."""
        unit, waited = flight.route.unit, now - flight.sent
        usual = self._usual(unit)
        if now < flight.expires and not (usual and waited >= max(2 * usual, breakers.parameters.probe_timeout)):
            breakers.not_decided(unit)  # its call had waited for its turn, and ends before the unit could have answered
            return False
        return breakers.timed_out(unit, now)

    def _fail_suspended(self, now: float) -> None:
        """What waits for a unit that is not asked any more does not wait for its probe."""
        breakers = self.breakers
        assert breakers is not None
        in_flight = {(id(one.demand), one.position) for one in self._pending.values()}
        for demand in list(self._queue):
            pause = breakers.suspended_for(demand.unit, now)
            if pause is not None:
                reason = partial(self._ledger.suspended, demand, pause, breakers.parameters.open_after)
                self._ledger.give_up(demand, now, reason, in_flight)

    def _unit_lives(self, unit: int) -> None:
        """A unit has answered, whatever it said."""
        if self.breakers is not None:
            self.breakers.answered(unit)

    def _learn_pace(self, unit: int, seconds: float) -> None:
        """The usual time of a unit is its slowest lately."""
        self._pace[unit] = max(seconds, self._pace.get(unit, 0.0) * _PACE_FORGETS)

    def _no_reply(self, flight: Flight, partial: bytes, now: float, *, over: bool) -> NoReply:
        timeout = flight.expires - flight.sent
        if over and now < flight.expires:
            return NoReply(
                "no answer before the deadline of the call", kind="partial" if partial else "nothing", raw=partial
            )
        if partial:
            return NoReply(f"only a part of a reply came within {timeout:g} s", kind="partial", raw=partial)
        came, delay = self.late_units.get(flight.route.unit, (-_LATE_KNOWN, 0.0))
        if now - came < _LATE_KNOWN:
            return NoReply(
                f"no reply within {timeout:g} s; the unit is slow: its last late reply had taken "
                f"{delay:.3f} s, a longer timeout would take it",
                kind="late",
                observed_delay=delay,
            )
        return NoReply(f"no reply within {timeout:g} s")

    # What does not simply answer.

    def _odd_frame(self, transaction: int, protocol: int, unit: int, adu: bytes, now: float) -> None:
        """Anything but a plainly fitting reply (Messaging on TCP/IP §4.4.1.4)."""
        self._scatter()
        flight = self._pending.get(transaction)
        if flight is None:
            sent = self._expired.pop(transaction, None)
            if sent is not None:
                self.counters.late_replies += 1
                self.late_units[unit] = now, now - sent
                self._timeouts_in_row = 0
                self._unit_lives(unit)
                self.valid_reply = True
                self._start_gap(now)
                return
            flight = self._tolerated(transaction, protocol, unit, adu)
            if flight is None:
                self._foreign(protocol)
                return
            transaction = next(key for key, value in self._pending.items() if value is flight)
        del self._pending[transaction]
        self._free.append(flight)
        if flight.demand is None:
            self._unit_lives(flight.route.unit)
            return  # cancelled: its reply has come, the place is free
        self._confirm(flight, flight.demand, protocol, unit, adu, now)

    def _confirm(self, flight: Flight, demand: Demand, protocol: int, unit: int, adu: bytes, now: float) -> None:
        pdu = adu[7:]
        request = demand.requests[flight.position]
        function = request.wire[0]
        reason = ""
        if protocol:
            self.counters.foreign_protocol += 1
            reason = f"protocol identifier {protocol} where 0 is Modbus"
        elif not self._unit_fits(flight, unit, alone=not self._pending):
            reason = f"unit {unit} answered where {flight.route.unit} was asked"
        elif pdu[0] & 0x7F != function:
            reason = f"function {pdu[0]} answers function {function}"
        if not reason:
            self._unit_lives(demand.unit)
            try:
                self._accept(flight, demand, pdu, now)
                return
            except MalformedPdu as error:
                reason = error.reason
        self.counters.bad_replies += 1
        self._timeouts_in_row = self._timeouts_since_reply = 0
        self._start_gap(now)
        self._failed(flight, demand, BadReply(reason, raw=adu), now, again=False)

    def _accept(self, flight: Flight, demand: Demand, pdu: bytes, now: float) -> None:
        """Take a reply or an exception that belongs to ``flight``. Raises `MalformedPdu` where it is broken."""
        request = demand.requests[flight.position]
        if pdu[0] & 0x80:
            code = decode_exception(pdu).exception
            self.counters.exceptions += 1
            self._answered(0, now)
            error = ExceptionReply(code, raw=pdu)
            if code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND and request.is_write:
                self._failed(flight, demand, error, now, again=False)
            else:
                self._ledger.conclude(demand, flight.position, self._ledger.placed(error, demand, flight.position, now))
            return
        reply = request.accept(pdu)
        self._answered(1, now)
        self._ledger.conclude(demand, flight.position, reply)

    def _tolerated(self, transaction: int, protocol: int, unit: int, adu: bytes) -> Flight | None:
        """The one request in flight, if a reply with a foreign transaction may be taken for its answer."""
        policy = self.parameters.transaction_policy
        if policy is MismatchPolicy.STRICT or len(self._pending) != 1 or protocol or self.recycle:
            # Where the connection is to be made anew after a timeout, it may be the late reply of that one.
            return None
        flight = next(iter(self._pending.values()))
        if policy is MismatchPolicy.AUTOMATIC and (
            flight.demand is None
            or not self._unit_fits(flight, unit, alone=True)
            or not self._fits(flight.demand.requests[flight.position], adu[7:])
        ):
            return None
        self.counters.tolerated_replies += 1
        return flight

    def _fits(self, request: Request, pdu: bytes) -> bool:
        try:
            if pdu[0] == request.wire[0] | 0x80:
                decode_exception(pdu)
            else:
                request.accept(pdu)
        except MalformedPdu:
            return False
        return True

    def _unit_fits(self, flight: Flight, unit: int, *, alone: bool) -> bool:
        """Whether ``unit`` may answer; ``alone`` says that nothing else is in flight."""
        if unit == flight.route.unit or flight.route.unit in (0, TCP_DEVICE_UNIT):
            return True
        policy = self.parameters.unit_policy
        return policy is MismatchPolicy.IGNORE or (policy is MismatchPolicy.AUTOMATIC and alone)

    @property
    def _tolerant(self) -> bool:
        """Whether replies may be taken that do not name their transaction."""
        return self.parameters.transaction_policy is not MismatchPolicy.STRICT

    def _foreign(self, protocol: int) -> None:
        if protocol:
            self.counters.foreign_protocol += 1
        self.counters.foreign_replies += 1
        self._foreign_in_row += 1
        if self._foreign_in_row >= self.parameters.recycle_after_foreign:
            self._recycle(f"{self._foreign_in_row} replies in a row that answer nothing asked here")

    def _broken_stream(self, reason: str, raw: bytes, now: float) -> None:
        """A length that can not be: nothing behind it can be read."""
        self._recycle(reason)
        self._scatter()
        for flight in list(self._pending.values()):
            self._release(flight)
            if flight.demand is not None:
                self.counters.bad_replies += 1
                self._failed(flight, flight.demand, BadReply(reason, raw=raw), now, again=False)
        self._pending.clear()

    # How a request ends.

    def _answered(self, good: int, now: float) -> None:
        self.counters.replies += good
        self._timeouts_in_row = self._timeouts_since_reply = self._foreign_in_row = 0
        self.valid_reply = True
        self._start_gap(now)

    def _start_gap(self, now: float) -> None:
        """The device has just spoken: it wants ``request_gap`` before the next request."""
        if self.parameters.request_gap:
            self._not_before = now + self.parameters.request_gap

    def _failed(self, flight: Flight, demand: Demand, error: ModbusError, now: float, *, again: bool) -> None:
        self._ledger.failed(demand, flight.position, error, now, again=again)

    def _release(self, flight: Flight) -> None:
        self._free.append(flight)

    def _remember(self, transaction: int, sent: float) -> None:
        """Keep an identifier from being used while its late reply may still come."""
        if len(self._expired) >= _EXPIRED_LIMIT:
            del self._expired[next(iter(self._expired))]
        self._expired[transaction] = sent

    def _recycle(self, reason: str) -> None:
        if not self.recycle:
            self.recycle = reason
            self.counters.recycled += 1
