"""The client's side of a TCP connection: sends the requests of calls and matches replies to them, without IO.

Knows the rules of Messaging on TCP/IP V1.0b §4.4.1 and of devices that break them; knows no socket and no clock:
times are ``now`` in seconds, and the driver of a session calls `TcpClientSession.tick` at `deadline`.

1. At most ``max_transactions`` requests are in flight; the rest waits in a bounded queue, in the order of `queue`.
2. A reply belongs to the request in flight whose transaction identifier it carries, and must fit that request in unit,
   function, length and echo; otherwise the request ends with `BadReply`. A reply with another identifier is dropped and
   counted, unless ``transaction_policy`` accepts it (rule 5).
3. The identifier of a request that got no reply in time, even a cancelled one, is remembered and not used again on this
   connection (of more than 4096 the oldest is forgotten). Its late reply is dropped, and shows how slow the device is.
4. A read is repeated after a timeout or a lost connection. A write that was sent is repeated only if ``write_retries``
   says so or its call is ``idempotent``; otherwise it ends as `WriteOutcomeUnknown`.
5. Where transactions cannot be told apart (option ``transaction_policy`` automatic or ignore), a timeout ends the
   connection: the next reply could be the late one.
6. A connection that brings only timeouts or late replies is closed, and opened again at the next request.
7. A cancelled request keeps its slot until its reply comes or its time is over: the device is still working on it.
8. With breakers, a unit that does not answer is suspended for a while, and its requests fail with `UnitSuspended`:
   otherwise every request to it would delay the other units of the connection (`unit_breaker`).
9. Reads of one call are sent as a pipelined batch, and their replies are taken together when all come in order. Any
   other event splits all batches first (`_split_batches`), so the other rules only deal with single requests.
"""

import math
from collections import deque
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType

from ..codes import TCP_DEVICE_UNIT, ExceptionCode
from ..errors import BadReply, BadReplyKind, ExceptionReply, LinkDown, ModbusError, NoReply
from ..framing.mbap import HEAD_AND_FUNCTION, MAX_LENGTH, MIN_LENGTH, StreamBuffer, impossible_length
from ..options.client import ClientParameters, MismatchPolicy
from ..pdu.exception_response import decode_exception
from ..pdu.malformed_pdu import MalformedPdu
from ..pdu.message import Request
from ..values.counts import counted
from .call import Call, FreeSlots, RequestInFlight, encoded_request, free_slots
from .call_retries_and_deadlines import CallTracker
from .client_counters import ClientCounters
from .pipelined_batch import HEAD_SIZE, PipelinedBatch, packed_batch
from .queue import BURST, RequestQueue
from .unit_breaker import Breakers, BreakerState

_unpack = HEAD_AND_FUNCTION.unpack_from
_EXPIRED_LIMIT = 4096
_PACE_FORGETS = 0.9
"""Factor that multiplies the usual response time of a unit at each reply that took less; a reply that took longer sets
the usual response time to its own.
"""
_LAUNCHES_APART = 32
"""After a pipelined batch had to be split (replies in another order, or an exception), so many sends are made without
batches: splitting a batch costs a fifth of what its requests cost.
"""
_LATE_FACTOR = 2
"""If late replies come, the device is alive: then the connection is closed only after this multiple of
``recycle_after_timeouts`` timeouts without a reply in time. But if every reply answers the request before the last one
(Growatt_ModbusTCP#317), only a new connection helps.
"""
_LATE_KNOWN = 60.0
"""For so many seconds after a late reply of a unit, the errors of its timeouts say that the unit is slow."""
_NO_DOUBTS: Mapping[int, object] = MappingProxyType({})
_STEP = 1021
"""Step from one transaction identifier to the next; odd, so that all are used. Some devices answer with the identifier
plus 1 (sunsynk#680): with a step of 1 that would be the identifier of another request in flight, and give wrong data.
"""


class TcpClientSession:
    """State of one link over TCP on the client: queue, requests in flight, replies. It survives reconnections.

    Attributes:
        counters: counters of the link.
        queue: calls with requests left to send.
        finished: calls whose requests all have an outcome; the driver empties the list.
        recycle: why the driver must close the connection and open another; empty if it need not.
        late_units: by unit: the time of its last late reply, and the seconds from request to that reply.
        valid_reply: whether this connection has brought a reply that answers a request, in time or late; the driver
            sets it to False after a timeout, to see whether another comes.
        breakers: the circuit breakers of the units; None if the link uses none.
    """

    __slots__ = (
        "_batches",
        "_buffer",
        "_connected",
        "_doubtful",
        "_expired",
        "_foreign_in_row",
        "_free",
        "_launches_apart",
        "_not_before",
        "_own_slots",
        "_pace",
        "_pending",
        "_timeouts_in_row",
        "_timeouts_since_reply",
        "_tracker",
        "_transaction",
        "breakers",
        "counters",
        "finished",
        "late_units",
        "parameters",
        "queue",
        "recycle",
        "valid_reply",
    )

    def __init__(
        self,
        parameters: ClientParameters,
        *,
        endpoint: str = "",
        first_transaction: int = 0,
        shared_slots: FreeSlots | None = None,
    ) -> None:
        self.parameters: ClientParameters = parameters
        self._tracker = CallTracker(parameters, endpoint)
        self.counters: ClientCounters = self._tracker.counters
        self.finished: list[Call] = self._tracker.finished
        self.recycle: str = ""
        self.late_units: dict[int, tuple[float, float]] = {}
        self.valid_reply: bool = False
        self.queue: RequestQueue = self._tracker.queue
        self._pending: dict[int, RequestInFlight] = {}
        self._batches: deque[PipelinedBatch] = deque()
        self._own_slots = shared_slots is None
        self._free = free_slots(parameters.max_transactions) if shared_slots is None else shared_slots
        self._expired: dict[int, float] = {}
        self._transaction = first_transaction & 0xFFFF
        self._buffer = StreamBuffer()
        self._connected = False
        self._not_before = 0.0
        self._timeouts_in_row = 0
        self._timeouts_since_reply = 0
        self._foreign_in_row = 0
        self._launches_apart = 0  # how many more sends go without batches
        self.breakers: Breakers | None = None
        self._doubtful: Mapping[int, object] = _NO_DOUBTS  # units that timed out and have not answered since
        self._pace: dict[int, float] = {}  # seconds that each unit usually takes; kept only with breakers

    def watch_units(self, breakers: Breakers) -> None:
        """Use these circuit breakers for the units of this link; a link on which this is never called has none."""
        self.breakers = breakers
        self._doubtful = breakers.doubtful

    # Calls of the application.

    def submit(self, call: Call, now: float) -> None:
        """Queue the requests of a call; `transmit` sends them.

        Raises:
            Overloaded: the queue is full; nothing was sent.
            UnitSuspended: the circuit breaker of the unit is open; nothing was sent.
        """
        if self.breakers is not None:
            pause = self.breakers.suspended_for(call.unit, now)
            if pause is not None:
                raise self._tracker.suspended(call, pause, self.breakers.parameters.open_after)
        self._tracker.submit(call, now)

    def cancel(self, call: Call) -> bool:
        """Cancel a call: no more requests of it are sent, and replies to those in flight are dropped.

        Returns:
            Whether some of its requests are in flight.
        """
        self._split_batches()
        requests_in_flight = [awaited for awaited in self._pending.values() if awaited.call is call]
        for awaited in requests_in_flight:
            awaited.call = None
        self._tracker.withdraw(call)
        return bool(requests_in_flight)

    def serve_units_in_turn(self) -> None:
        """From now on, take the requests of one caller unit by unit in rotation, and not in the order of its calls.

        A caller may then also send up to `BURST` requests in its turn. For a gateway's upstream links, where one client
        may flood one unit.
        """
        self.queue.units_in_turn = True
        self.queue.burst = BURST

    @property
    def has_gap(self) -> bool:
        """Whether a pause, after connecting or between requests, may still hold back requests.

        `deadline` then gives its end, if requests wait for it.
        """
        return self._connected and self._not_before > 0.0

    @property
    def queued(self) -> int:
        """Number of calls that wait to be sent; each request of a gateway's call counts as one."""
        return self.queue.waiting

    @property
    def in_flight(self) -> int:
        """Number of requests that were sent and neither answered nor timed out, cancelled ones included."""
        return len(self._pending) + sum(len(batch.slots) for batch in self._batches)

    # Events of the connection.

    def connected(self, now: float) -> None:
        """Tell the session that a new connection is open: from now on `transmit` returns requests to send.

        With the option ``connect_delay`` it does so only after that many seconds.
        """
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
        """Repeat or end the requests in flight, because the connection ended; queued calls stay queued.

        ``lost`` is False if the client itself closed an unused connection.
        """
        if self._connected and lost:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        self._split_batches()
        for awaited in list(self._pending.values()):
            self._release(awaited)
            if self.breakers is not None:
                self.breakers.not_decided(awaited.encoded.unit)
            if awaited.call is not None:
                error = LinkDown(f"the connection ended before the reply: {reason}", kind="lost", sent=True)
                self._failed(awaited, awaited.call, error, now, again=True)
        self._pending.clear()

    def begin_again(self) -> None:
        """Forget all calls and the connection: an exception such as KeyboardInterrupt may have left them inconsistent.

        The driver has closed the connection, and then passes its calls to `resume`. Slots shared with other sessions
        are not freed.
        """
        if self._connected:
            self.counters.lost_connections += 1
        self._connected = False
        self.recycle = ""
        self._buffer = StreamBuffer()
        self._batches.clear()
        self._pending.clear()
        if self._own_slots:
            self._free[:] = free_slots(self.parameters.max_transactions)
        self._tracker.begin_again()
        if self.breakers is not None:
            self.breakers.none_decided()

    def resume(self, call: Call, now: float) -> None:
        """Queue a call again after `begin_again`: what was sent is repeated or fails as after a lost connection."""
        self._tracker.resume(call, now)

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """End all queued calls, because no connection could be opened: each open request gets a copy of ``error``.

        A write that was sent before ends as `WriteOutcomeUnknown`. If ``keep_repeated``, a call of which a request is
        about to be repeated stays in the queue.
        """
        self._tracker.unreachable(now, error, keep_repeated=keep_repeated)

    # Sending and receiving.

    def transmit(self, now: float) -> list[bytes]:
        """Return what to send now, in order; it counts as sent at ``now``. Empty if nothing is to be sent.

        Each element is one frame, or several joined frames unless the option ``single_adu_segments`` is on. If bytes of
        an unfinished frame were received and no request is in flight, it sends nothing and sets ``recycle``.
        """
        out: list[bytes] = []
        queue = self.queue
        if not queue.size or not self._connected or self.recycle or not self._free:
            return out
        if self._buffer.kept and not self._pending and not self._batches:
            # The buffer holds bytes of an unfinished frame: the next reply would be read as their continuation.
            self._recycle(f"{counted(len(self._buffer.kept), 'byte')} of an unfinished frame before the request")
            return out
        if now < self._not_before:
            return out
        self._not_before = 0.0
        free = self._free
        gap = self.parameters.request_gap
        room = len(free)
        eligible = partial(self._may_ask, now) if self._doubtful else None
        while free and (call := queue.pick(eligible)) is not None:
            turn = 1 if gap else min(len(free), queue.share(room))
            while call is not None:
                before = len(free)
                # A unit that is doubted gets one request: a probe.
                at_most = 1 if self._doubtful and self._is_doubted(call) else turn
                adus = self._next_batch(call, at_most, now)
                if not adus:
                    for position in call.take(at_most):
                        adus.append(self._launch(call, position, now))
                    self.counters.requests += len(adus)
                if len(adus) == 1 or self.parameters.single_adu_segments:
                    out += adus
                else:
                    out.append(b"".join(adus))
                sent = before - len(free)
                queue.sent(call, sent)
                turn -= sent
                call = queue.pick_same(eligible) if turn > 0 else None
            if gap:
                break
        return out

    def send_now(self, call: Call, now: float) -> bytes | None:
        """Count all requests of a call as sent and return their joined frames, if all of them can be sent at ``now``.

        Otherwise return None: nothing was sent, and the call has to be queued with `submit`.
        """
        count = call.open
        if (
            self.queue.size
            or len(self._free) < count
            or not self._connected
            or now < self._not_before
            or self.recycle
            or self._buffer.kept
            or (self._doubtful and self._is_doubted(call))
        ):
            return None
        if count == 1:
            call.next = 1
            self.counters.requests += 1
            adus: bytes | None = self._launch(call, 0, now)
        elif self.parameters.request_gap or self.parameters.single_adu_segments or call.is_write:
            return None
        else:
            adus = self._send_batch(call, count, now)
        if adus is not None:
            self._tracker.begin(call, now)
        return adus

    def _is_doubted(self, call: Call) -> bool:
        """Whether the circuit breaker of the call's unit is open or probing: then only one request may be sent."""
        return self.breakers is not None and self.breakers.state(call.unit) is not BreakerState.CLOSED

    def _may_ask(self, now: float, call: Call) -> bool:
        return self.breakers is None or self.breakers.suspended_for(call.unit, now) is None

    def _next_batch(self, call: Call, at_most: int, now: float) -> list[bytes]:
        """Make up to ``at_most`` requests of a call a pipelined batch in flight; return a list with the joined frames.

        The list is empty if they cannot be batched; then they have to be sent singly.
        """
        requests = len(call.requests)
        if requests == 1 or call.again or call.is_write or self.parameters.single_adu_segments:
            return []
        together = self._send_batch(call, min(at_most, requests - call.next), now)
        return [] if together is None else [together]

    def _send_batch(self, call: Call, count: int, now: float) -> bytes | None:
        """Make the next ``count`` requests of a call a pipelined batch in flight, and return their joined frames.

        None if they cannot be batched; then nothing is in flight. There is no batch while single requests are in
        flight: their replies would come between and split it.
        """
        if count < 2 or self._pending:
            return None
        if self._launches_apart:
            self._launches_apart -= 1
            return None
        first = call.next
        packed = packed_batch(call.requests, first, count, call.unit)
        if not packed.fits:
            return None
        start = self._transaction + _STEP
        stop = start + _STEP * count
        if stop - _STEP <= 0xFFFF:
            transactions = tuple(range(start, stop, _STEP))  # 0.1 µs quicker for each request than the slow path below
        else:
            transactions = tuple([one & 0xFFFF for one in range(start, stop, _STEP)])
        if self._expired and not self._expired.keys().isdisjoint(transactions):
            return None
        self._transaction = transactions[-1]
        free = self._free
        self._batches.append(PipelinedBatch(call, first, packed, transactions, free[-count:], now))
        del free[-count:]
        call.next = first + count
        self.counters.requests += count
        return packed.encode(transactions)

    def _launch(self, call: Call, position: int, now: float) -> bytes:
        """Make one request a request in flight, and return its frame."""
        pending, expired = self._pending, self._expired
        encoded = encoded_request(call.requests[position], call.unit)
        transaction = self._transaction + _STEP & 0xFFFF
        while transaction in pending or transaction in expired:
            transaction = transaction + _STEP & 0xFFFF
        self._transaction = transaction
        awaited = pending[transaction] = self._free.pop()
        awaited.call = call
        awaited.position = position
        awaited.encoded = encoded
        awaited.sent = now
        awaited.expires = now + (self._timeout_of(call, now) if self._doubtful else call.timeout)
        return transaction.to_bytes(2, "big") + encoded.tail

    def _timeout_of(self, call: Call, now: float) -> float:
        """Return the timeout in seconds for a request that is sent while some unit of the link does not answer.

        It is that of the call. If the request is the probe of a suspended unit, it can be shorter (`Breakers.asked`),
        and the state of the unit's circuit breaker becomes PROBING.
        """
        assert self.breakers is not None
        usual = self._usual(call.unit)
        return self.breakers.asked(call.unit, now, call.timeout, usual or call.timeout)

    def _usual(self, unit: int) -> float:
        """Return the seconds that a unit usually takes to answer.

        For a unit that has not answered yet it is the time of the slowest unit of the link; 0 if no unit has answered,
        and on a link without circuit breakers.
        """
        return self._pace.get(unit) or max(self._pace.values(), default=0.0)

    def _split_batches(self) -> None:
        """Replace all pipelined batches by single requests in flight, in the order in which they were sent."""
        if self._batches:
            in_flight = list(self._pending.items())
            for batch in self._batches:
                in_flight += batch.apart()
            self._batches.clear()
            in_flight.sort(key=lambda one: (one[1].sent, one[1].position))
            self._pending.clear()
            self._pending.update(in_flight)

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Process the first ``size`` bytes of ``buffer``: replies from the server, received at ``now``.

        Calls that they complete are added to ``finished``. The beginning of an incomplete frame is kept for the next
        call.
        """
        if self._buffer.kept:
            buffer, size = self._buffer.join(buffer, size)
        at = good = 0
        if self._batches:
            at = self._receive_batches(buffer, size, now)
            if at == size:
                return
        pending = self._pending
        last: RequestInFlight | None = None
        # 0.7 µs per reply: a fitting reply is recognised by the seven bytes after its transaction, and
        # `Request.take` builds it from its data. Everything else goes through _odd_frame.
        while size - at >= 8:
            transaction = buffer[at] << 8 | buffer[at + 1]
            awaited = pending.get(transaction)
            if awaited is not None:
                encoded, call = awaited.encoded, awaited.call
                end = at + encoded.reply_size
                if end <= size and call is not None:
                    head, data = encoded.cut(buffer, at + 2)
                    if head == encoded.head:
                        del pending[transaction]
                        self._free.append(awaited)
                        good += 1
                        last = awaited
                        if self._doubtful:
                            self._unit_lives(call.unit)
                        call.outcomes[awaited.position] = encoded.take(data)
                        call.open -= 1
                        if not call.open:
                            self._tracker.finish(call)
                        at = end
                        continue
            transaction, protocol, length, unit, _ = _unpack(buffer, at)
            end = at + 6 + length
            if not MIN_LENGTH <= length <= MAX_LENGTH or end > size:
                break
            self._odd_frame(transaction, protocol, unit, bytes(buffer[at:end]), now)
            at = end
        if last is not None:
            self._answered(good, now)
            if self.breakers is not None:
                self._learn_pace(last.encoded.unit, now - last.sent)
        if at == size:
            return
        if size - at >= 6:
            length = buffer[at + 4] << 8 | buffer[at + 5]
            if not MIN_LENGTH <= length <= MAX_LENGTH:
                self._broken_stream(impossible_length(length), bytes(buffer[at:size]), now)
                return
        self._buffer.keep(buffer, at, size)

    def _receive_batches(self, buffer: bytes | bytearray, size: int, now: float) -> int:
        """Match replies to pipelined batches as long as they come in order. Returns the offset after the last match.

        At the first frame that is not the expected reply, all batches are split into single requests in flight. This is
        the hot path of `execute_many`: 0.5 µs per reply if all of a batch have arrived, 0.9 if only some have.
        """
        batches = self._batches
        at = good = 0
        while batches and size - at >= HEAD_SIZE:
            batch = batches[0]
            packed, call, answered = batch.packed, batch.call, batch.answered
            end = at + packed.reply_size
            replies = packed.replies(batch.transactions, buffer, at) if not answered and end <= size else None
            if replies is not None:
                taken = len(replies)
                call.outcomes[batch.first : batch.first + taken] = replies
                self._free += batch.slots
                batches.popleft()
            elif batch.expects(buffer, at):
                end = at + packed.reply_sizes[answered]
                if end > size:
                    break
                taken = 1
                call.outcomes[batch.first + answered] = packed.takers[answered](bytes(buffer[at + HEAD_SIZE : end]))
                self._free.append(batch.slots.pop())
                batch.answered += 1
                if not batch.slots:
                    batches.popleft()
            else:
                self._split_batches()
                self._launches_apart = _LAUNCHES_APART
                break
            at = end
            good += taken
            call.open -= taken
            if self.breakers is not None:
                took, known = now - batch.sent, self._pace.get(call.unit, 0.0) * _PACE_FORGETS
                self._pace[call.unit] = took if took > known else known
                if self._doubtful:
                    self._unit_lives(call.unit)
            if not call.open:
                self._tracker.finish(call)
        if good:
            self._answered(good, now)
        return at

    def in_work(self) -> list[Call]:
        """Return all calls that have a request in flight, and those of which some requests were sent and others wait.

        The list can hold a call more than once. The second kind is known only after `serve_units_in_turn`.
        """
        if not (self._batches or self._pending or self.queue.begun):
            return []  # the usual case: a server answers all at once
        found = [batch.call for batch in self._batches]
        found += [awaited.call for awaited in self._pending.values() if awaited.call is not None]
        found += self.queue.begun
        return found

    # Timeouts.

    def deadline(self) -> float | None:
        """Return the time at which to call `tick` and `transmit`, by the clock of ``now``; None for never.

        It is the next timeout, deadline, or end of a pause before requests.
        """
        soonest = math.inf
        for awaited in self._pending.values():  # a loop, because a comprehension is a call, and usually there is one
            if awaited.expires < soonest:
                soonest = awaited.expires
        for batch in self._batches:
            if batch.expires < soonest:
                soonest = batch.expires
        if self._tracker.deadlines:
            soonest = min(soonest, self._next_call_deadline())
        if self.queue.size and self._connected and self._free and 0.0 < self._not_before < soonest:
            soonest = self._not_before
        return None if soonest == math.inf else soonest

    def _next_call_deadline(self) -> float:
        """Return the earliest deadline of the open calls; infinity if none has one."""
        calls = [awaited.call for awaited in self._pending.values()] + [batch.call for batch in self._batches]
        times = [call.deadline for call in calls if call is not None and call.deadline is not None]
        queued = self._tracker.next_deadline()
        if queued is not None:
            times.append(queued)
        return min(times, default=math.inf)

    def tick(self, now: float) -> None:
        """End or repeat requests whose timeout has passed, and end calls whose deadline has passed."""
        self._split_batches()
        for transaction, awaited in list(self._pending.items()):
            call = awaited.call
            over = call is not None and call.deadline is not None and now >= call.deadline
            if now >= awaited.expires or over:
                del self._pending[transaction]
                self._release(awaited)
                self._timed_out(transaction, awaited, now, over=over)
        if now >= self._not_before:
            self._not_before = 0.0  # else a link that may not send for another reason would be woken again and again
        if self._tracker.deadlines:
            in_flight = {(id(one.call), one.position) for one in self._pending.values()}
            self._tracker.expire_queue(now, in_flight)

    def _timed_out(self, transaction: int, awaited: RequestInFlight, now: float, *, over: bool) -> None:
        """Handle a request without reply: block its transaction identifier, then repeat or fail the request.

        ``over``: whether the deadline of its call has passed.
        """
        self._remember(transaction, awaited.sent)
        kept = self._buffer.kept
        is_given_up = self.breakers is not None and self._unit_is_silent(self.breakers, awaited, now)
        if awaited.call is not None:
            self.counters.timeouts += 1
            self._timeouts_in_row += 1
            self._timeouts_since_reply += 1
            error = self._no_reply(awaited, kept, now, over=over)
            self._failed(awaited, awaited.call, error, now, again=not over and not is_given_up)
        if is_given_up:
            self._fail_suspended(now)
        if kept:
            self._recycle("a frame began and did not end within the timeout")
        elif self._tolerant:
            self._recycle("a timeout where transactions cannot be told apart")
        elif self._timeouts_in_row >= self.parameters.recycle_after_timeouts:
            self._recycle(f"{self._timeouts_in_row} timeouts in a row")
        elif self._timeouts_since_reply >= _LATE_FACTOR * self.parameters.recycle_after_timeouts:
            self._recycle(f"{self._timeouts_since_reply} timeouts, and only late replies between them")

    def _unit_is_silent(self, breakers: Breakers, awaited: RequestInFlight, now: float) -> bool:
        """Report a timeout to the unit's circuit breaker. Returns whether the breaker is open now.

        If the call's deadline ended the request before the unit had time to answer, this does not count as a timeout.
        """
        unit, waited = awaited.encoded.unit, now - awaited.sent
        usual = self._usual(unit)
        if now < awaited.expires and not (usual and waited >= max(2 * usual, breakers.parameters.probe_timeout)):
            breakers.not_decided(unit)  # its call had waited for its turn, and ends before the unit could have answered
            return False
        return breakers.timed_out(unit, now)

    def _fail_suspended(self, now: float) -> None:
        """Fail the queued calls of units whose circuit breaker has opened, instead of letting them wait for a probe."""
        breakers = self.breakers
        assert breakers is not None
        in_flight = {(id(one.call), one.position) for one in self._pending.values()}
        for call in list(self.queue):
            pause = breakers.suspended_for(call.unit, now)
            if pause is not None:
                reason = partial(self._tracker.suspended, call, pause, breakers.parameters.open_after)
                self._tracker.give_up(call, now, reason, in_flight)

    def _unit_lives(self, unit: int) -> None:
        """Close the unit's circuit breaker, because the unit has answered, even if only with an exception."""
        if self.breakers is not None:
            self.breakers.answered(unit)

    def _learn_pace(self, unit: int, seconds: float) -> None:
        """Set the usual response time of a unit to ``seconds``, or to 0.9 of its old value if that is longer."""
        self._pace[unit] = max(seconds, self._pace.get(unit, 0.0) * _PACE_FORGETS)

    def _no_reply(self, awaited: RequestInFlight, partial: bytes, now: float, *, over: bool) -> NoReply:
        timeout = awaited.expires - awaited.sent
        if over and now < awaited.expires:
            return NoReply(
                "no answer before the deadline of the call", kind="partial" if partial else "nothing", raw=partial
            )
        if partial:
            return NoReply(f"only a part of a reply came within {timeout:g} s", kind="partial", raw=partial)
        came, delay = self.late_units.get(awaited.encoded.unit, (-_LATE_KNOWN, 0.0))
        if now - came < _LATE_KNOWN:
            return NoReply(
                f"no reply within {timeout:g} s; the unit is slow: its last late reply had taken "
                f"{delay:.3f} s, a longer timeout would take it",
                kind="late",
                observed_delay=delay,
            )
        return NoReply(f"no reply within {timeout:g} s")

    # Replies that do not fit plainly.

    def _odd_frame(self, transaction: int, protocol: int, unit: int, adu: bytes, now: float) -> None:
        """Handle a received frame that is not plainly the reply to a request in flight (TCP/IP §4.4.1.4).

        It can be an exception reply, a late reply, the reply to a cancelled request, one that does not fit its request,
        or one with a foreign transaction identifier.
        """
        self._split_batches()
        awaited = self._pending.get(transaction)
        if awaited is None:
            sent = self._expired.pop(transaction, None)
            if sent is not None:
                self.counters.late_replies += 1
                self.late_units[unit] = now, now - sent
                self._timeouts_in_row = 0
                self._unit_lives(unit)
                self.valid_reply = True
                self._start_gap(now)
                return
            awaited = self._tolerated(transaction, protocol, unit, adu)
            if awaited is None:
                self._foreign(protocol)
                return
            transaction = next(key for key, value in self._pending.items() if value is awaited)
        del self._pending[transaction]
        self._free.append(awaited)
        if awaited.call is None:
            self._unit_lives(awaited.encoded.unit)
            return  # cancelled: its reply has come, the slot is free
        self._confirm(awaited, awaited.call, protocol, unit, adu, now)

    def _confirm(self, awaited: RequestInFlight, call: Call, protocol: int, unit: int, adu: bytes, now: float) -> None:
        pdu = adu[7:]
        request = call.requests[awaited.position]
        function = request.wire[0]
        reason = ""
        kind: BadReplyKind = "content"
        if protocol:
            self.counters.foreign_protocol += 1
            reason, kind = f"protocol identifier {protocol} where 0 is Modbus", "protocol"
        elif not self._unit_fits(awaited, unit, alone=not self._pending):
            reason, kind = f"unit {unit} answered where {awaited.encoded.unit} was asked", "unit"
        elif pdu[0] & 0x7F != function:
            reason, kind = f"function {pdu[0]} answers function {function}", "function"
        if not reason:
            self._unit_lives(call.unit)
            try:
                self._accept(awaited, call, pdu, now)
                return
            except MalformedPdu as error:
                reason = error.reason
        self.counters.bad_replies += 1
        self._timeouts_in_row = self._timeouts_since_reply = 0
        self._start_gap(now)
        self._failed(awaited, call, BadReply(reason, kind=kind, raw=adu), now, again=False)

    def _accept(self, awaited: RequestInFlight, call: Call, pdu: bytes, now: float) -> None:
        """End the request ``awaited`` with the reply or exception in ``pdu``. Raises `MalformedPdu` if it is broken."""
        request = call.requests[awaited.position]
        if pdu[0] & 0x80:
            code = decode_exception(pdu).exception
            self.counters.exceptions += 1
            self._answered(0, now)
            error = ExceptionReply(code, raw=pdu)
            if code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND and request.is_write:
                self._failed(awaited, call, error, now, again=False)
            else:
                self._tracker.conclude(call, awaited.position, self._tracker.placed(error, call, awaited.position, now))
            return
        reply = request.accept(pdu)
        self._answered(1, now)
        self._tracker.conclude(call, awaited.position, reply)

    def _tolerated(self, transaction: int, protocol: int, unit: int, adu: bytes) -> RequestInFlight | None:
        """Return the request in flight that accepts a reply with another transaction identifier; None if none does.

        It must be the only one in flight, and ``protocol`` must be 0. With ``transaction_policy`` strict no such reply
        is accepted; with automatic the reply must fit the request in unit and content; with ignore it need not.
        """
        policy = self.parameters.transaction_policy
        if policy is MismatchPolicy.STRICT or len(self._pending) != 1 or protocol or self.recycle:
            # After a timeout that ends the connection, this may be the late reply to that request.
            return None
        awaited = next(iter(self._pending.values()))
        if policy is MismatchPolicy.AUTOMATIC and (
            awaited.call is None
            or not self._unit_fits(awaited, unit, alone=True)
            or not self._fits(awaited.call.requests[awaited.position], adu[7:])
        ):
            return None
        self.counters.tolerated_replies += 1
        return awaited

    def _fits(self, request: Request, pdu: bytes) -> bool:
        try:
            if pdu[0] == request.wire[0] | 0x80:
                decode_exception(pdu)
            else:
                request.accept(pdu)
        except MalformedPdu:
            return False
        return True

    def _unit_fits(self, awaited: RequestInFlight, unit: int, *, alone: bool) -> bool:
        """Whether a reply of ``unit`` is accepted for a request: it is the unit asked, or ``unit_policy`` allows any.

        For a request to unit 0 or 255 every unit is accepted. ``alone``: whether no other request is in flight.
        """
        if unit == awaited.encoded.unit or awaited.encoded.unit in (0, TCP_DEVICE_UNIT):
            return True
        policy = self.parameters.unit_policy
        return policy is MismatchPolicy.IGNORE or (policy is MismatchPolicy.AUTOMATIC and alone)

    @property
    def _tolerant(self) -> bool:
        """Whether the option ``transaction_policy`` accepts replies with another transaction identifier."""
        return self.parameters.transaction_policy is not MismatchPolicy.STRICT

    def _foreign(self, protocol: int) -> None:
        if protocol:
            self.counters.foreign_protocol += 1
        self.counters.foreign_replies += 1
        self._foreign_in_row += 1
        if self._foreign_in_row >= self.parameters.recycle_after_foreign:
            self._recycle(f"{self._foreign_in_row} replies in a row that answer nothing asked here")

    def _broken_stream(self, reason: str, raw: bytes, now: float) -> None:
        """Ask for a new connection after an invalid length field, because nothing after it can be decoded.

        All requests in flight fail with `BadReply`; writes with `WriteOutcomeUnknown`.
        """
        self._recycle(reason)
        self._split_batches()
        for awaited in list(self._pending.values()):
            self._release(awaited)
            if awaited.call is not None:
                self.counters.bad_replies += 1
                self._failed(awaited, awaited.call, BadReply(reason, kind="stream", raw=raw), now, again=False)
        self._pending.clear()

    # Ends of requests.

    def _answered(self, good: int, now: float) -> None:
        self.counters.replies += good
        self._timeouts_in_row = self._timeouts_since_reply = self._foreign_in_row = 0
        self.valid_reply = True
        if self.parameters.request_gap:
            self._start_gap(now)

    def _start_gap(self, now: float) -> None:
        """Start the pause that the device needs between its reply and the next request (``request_gap``)."""
        if self.parameters.request_gap:
            self._not_before = now + self.parameters.request_gap

    def _failed(self, awaited: RequestInFlight, call: Call, error: ModbusError, now: float, *, again: bool) -> None:
        self._tracker.failed(call, awaited.position, error, now, again=again)

    def _release(self, awaited: RequestInFlight) -> None:
        self._free.append(awaited)

    def _remember(self, transaction: int, sent: float) -> None:
        """Block a transaction identifier until its late reply comes or the connection ends; at most 4096 at once."""
        if len(self._expired) >= _EXPIRED_LIMIT:
            del self._expired[next(iter(self._expired))]
        self._expired[transaction] = sent

    def _recycle(self, reason: str) -> None:
        if not self.recycle:
            self.recycle = reason
            self.counters.recycled += 1
