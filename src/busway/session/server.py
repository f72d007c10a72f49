"""The server's side of one TCP connection: requests in, replies out, in the order of obligations.

Knows the rules of Messaging on TCP/IP V1.0b §4.4.2; knows no socket and no device.

1. A frame with a protocol other than 0 is discarded and the stream goes on; a length that cannot be ends the
   connection (``broken``), after the requests before it were answered.
2. Order of checks: protocol → slot (06) → function (01) → what the handler says. A service that is finished within
   its call holds no slot, and the fast path needs none. In listen-only mode there is no answer of any kind.
3. A function code above 127 is discarded: it would be a reply. Function 0 is answered 80 01.
4. Requests start in order. Replies of deferred requests leave when they are there, each with the unit and the
   transaction it was asked with, and only while the connection lasts.
5. Every request that gets no answer is counted.
6. Reads that the handler hands on (`ReadForwarder`) go together, as far as they are known, and past the generic path.
7. With a share, so many requests are worked through in one call, planned reads aside; what came behind them waits
   (``rest``) until the driver goes on with it.
"""

from collections.abc import Awaitable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from struct import Struct
from typing import Protocol

from ..codes import ExceptionCode, FunctionCode
from ..framing.mbap import HEAD, HEAD_AND_FUNCTION, MAX_LENGTH, MIN_LENGTH, StreamBuffer, impossible_length
from ..pdu.direct import Answer, ReadPlan
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message
from .diagnostics import LineDiagnostics
from .forwarding import READ_SIZE, DeliverTogether, ForwardedReads, ForwardPlans, ReadForwarder, is_read
from .handler import LATER, Deferral, Handler, Outcome, ReadPlanner, Refusal, RequestContext
from .slots import TransactionSlots

_unpack = HEAD_AND_FUNCTION.unpack_from
_pack = HEAD.pack
_cut_reads = Struct("2s10s").iter_unpack
"""A read's transaction, and what it is known by."""
_MEMO_LIMIT = 256
_PLAN_LIMIT = 4096
"""Plans that all connections with the same rights share. A poller of 4096 different ranges is planned whole; whoever
comes when there is no more room takes the fast path, 1.9 µs for 0.7."""
_UNIT = 6
"""Where the unit stands in an ADU."""
_unit_of = itemgetter(_UNIT)
_LENGTHS = frozenset(range(MIN_LENGTH, MAX_LENGTH + 1))
"""What may stand in the length field: one look-up where comparing takes two steps."""
_LEAST_SIZE = 8
"""Bytes of the shortest request."""
_NO_SHARE = 1 << 62
_POLLS = frozenset({FunctionCode.GET_COMM_EVENT_COUNTER, FunctionCode.GET_COMM_EVENT_LOG})


class Deliver(Protocol):
    """Takes the bytes of a late reply to the connection; none where a request gets no answer."""

    def __call__(self, adu: bytes, /) -> None:
        """Send them."""


@dataclass(frozen=True, slots=True)
class Deferred:
    """A reply that somebody has to wait for: the driver awaits it and calls ``context.reply``."""

    context: RequestContext
    awaitable: Awaitable[Message]


@dataclass(frozen=True, slots=True)
class HandlerFailure:
    """A handler raised something that is no refusal; the client was answered 04."""

    context: RequestContext
    error: Exception


class TcpServerSession:
    """One connection's conversation.

    Attributes:
        broken: why the stream cannot be followed any more; empty while it can. The driver closes the connection.
        deferred: what the driver has to await; it empties the list.
        failures: failures of handlers to log; the driver empties the list.
        unfinished: bytes of a frame that has begun and not ended.
        requests: requests received so far.
        discarded: frames that got no answer: foreign protocol, function above 127.
        refused_busy: requests answered 06 because all slots were taken.
        rest: what came and was not worked through, because the share was used up, or `put_off` was called; at most as
            much as was handed in. Nothing more may be handed in until `go_on` has left none.
        spent: requests that the last call worked through, planned reads aside; the driver sets it back to 0.
    """

    __slots__ = (
        "_buffer",
        "_deliver",
        "_diagnostics",
        "_generation",
        "_handler",
        "_listener",
        "_memo",
        "_peer",
        "_planner",
        "_plans",
        "_reads",
        "_role",
        "_share",
        "_slots",
        "_waiting",
        "broken",
        "deferred",
        "discarded",
        "failures",
        "refused_busy",
        "requests",
        "rest",
        "spent",
        "unfinished",
    )

    def __init__(
        self,
        handler: Handler,
        *,
        diagnostics: LineDiagnostics,
        slots: TransactionSlots,
        deliver: Deliver,
        deliver_together: DeliverTogether | None = None,
        peer: str = "",
        listener: str = "",
        role: str | None = None,
        share: int | None = None,
    ) -> None:
        """A conversation that has not begun.

        Args:
            handler: what answers.
            diagnostics: counters and mode of the listener.
            slots: of requests in work.
            deliver, deliver_together: take late replies to the connection.
            peer, listener, role: for the contexts of requests.
            share: requests that one call works through, planned reads aside; None for all that came.
        """
        self._handler = handler
        self._diagnostics = diagnostics
        self._slots = slots
        self._deliver = deliver
        self._peer = peer
        self._listener = listener
        self._role = role
        self._share = _NO_SHARE if share is None else share
        self._buffer = StreamBuffer()
        self._memo: dict[int, Mapping[int, Answer]] = {}
        self._generation = handler.generation
        self._planner = handler if isinstance(handler, ReadPlanner) else None
        self._plans = self._planned()
        self._reads = None
        if isinstance(handler, ReadForwarder):
            self._reads = ForwardedReads(
                self._forwarded(handler),
                peer=peer,
                slots=slots,
                diagnostics=diagnostics,
                deliver=deliver_together or self._deliver_each,
            )
        # Made at the first deferred request: most connections never have one, and a set costs 216 bytes.
        self._waiting: set[RequestContext] | None = None
        self.broken = ""
        self.deferred: list[Deferred] = []
        self.failures: list[HandlerFailure] = []
        self.unfinished = 0
        self.requests = 0
        self.discarded = 0
        self.refused_busy = 0
        self.rest = b""
        self.spent = 0

    @property
    def waiting(self) -> int:
        """Requests whose reply is still to come."""
        waiting = len(self._waiting) if self._waiting else 0
        return waiting if self._reads is None else waiting + self._reads.waiting

    def receive(self, buffer: bytes | bytearray, size: int) -> list[bytes]:
        """Work through the first ``size`` bytes of ``buffer``; the ADUs to send, in order."""
        if self.broken:
            return []
        if self.unfinished:
            buffer, size = self._buffer.join(buffer, size)
            self.unfinished = 0
        if self._generation != self._handler.generation:
            self._generation = self._handler.generation
            self._memo.clear()
            self._plans = self._planned()
            if self._reads is not None and isinstance(self._handler, ReadForwarder):
                self._reads.plans = self._forwarded(self._handler)
        diagnostics = self._diagnostics
        muted = diagnostics.listen_only_units  # one is enough: what is silent has no fast path
        plans = self._plans if not muted else {}
        out: list[bytes] = []
        at = 0
        if plans and not size % READ_SIZE:
            # What a poller sends: reads alone, and those that were asked before. Cut by one call, without a copy of
            # what came, they take 0.47 µs each, of which 0.2 are the answer put together; by the loop below 0.6.
            for transaction, asked in _cut_reads(memoryview(buffer)[:size]):
                plan = plans.get(asked)
                if plan is None:
                    break
                out.append(transaction + plan.head + plan.block.data[plan.part])
            at = READ_SIZE * len(out)
            if at == size:
                if size:
                    self._count(buffer[_UNIT:size:READ_SIZE])
                return out
        reads = self._reads if not muted else None
        if reads is not None and not (out or size % READ_SIZE):
            # What a poller sends to a gateway.
            at = reads.take(buffer, 0, size)
            self.requests += at // READ_SIZE
            if at == size:
                return out
        if buffer.__class__ is not bytes:
            buffer = bytes(memoryview(buffer)[:size])
        memo = self._memo if not muted else {}
        learns = self._planner is not None and len(self._plans) < _PLAN_LIMIT
        left = self._share
        last = size - _LEAST_SIZE
        counted = 0  # of ``out``; those behind are the fast path's, and counted together
        # The loop below is the hot path of a server whose clients ask in many ways. A read that was asked before needs
        # one look-up of its ten bytes behind the transaction. Another request of the fast path takes 1.0 µs, of which
        # the call of the compiled answer is the half.
        while at <= last:
            plan = plans.get(buffer[at + 2 : at + 12])
            if plan is not None:
                out.append(buffer[at : at + 2] + plan.head + plan.block.data[plan.part])
                at += 12
                continue
            if not left:
                break
            if reads is not None:
                begin, at = at, reads.take(buffer, at, size)
                if at > begin:
                    taken = (at - begin) // READ_SIZE
                    self.requests += taken
                    left = max(left - taken, 0)
                    continue
            transaction, protocol, length, unit, function = _unpack(buffer, at)
            end = at + 6 + length
            if length not in _LENGTHS:
                self.broken = impossible_length(length)
                break
            if end > size:
                break
            left -= 1
            if not protocol:
                answers = memo.get(unit)
                if answers is None:
                    answers = self._offers(unit)
                answer = answers.get(function)
                if answer is not None:
                    reply = answer(buffer, at + 7, end)
                    if reply is not None:
                        out.append(_pack(transaction, 0, len(reply) + 1, unit) + reply)
                        if function <= 4 and learns and length == 6:
                            learns = self._learn(unit, buffer[at:end])
                        at = end
                        continue
                # What went the fast path so far counts before the generic path looks at the counters.
                if len(out) > counted:
                    self._count(bytes(map(_unit_of, out[counted:])))
                    counted = len(out)
                if reads is not None and self._can_forward(reads, unit, buffer[at:end]):
                    left += 1  # it is taken in the next round
                    continue
                adu = self._generic_path(transaction, unit, bytes(buffer[at + 7 : end]))
                if adu:
                    out.append(adu)
                    counted += 1
                # Function 08 may have muted a unit, or woken it.
                memo = self._memo if not muted else {}
                plans = self._plans if not muted else {}
                reads = self._reads if not muted else None
            else:
                self.discarded += 1
            at = end
        if len(out) > counted:
            if at == READ_SIZE * (len(out) - counted):  # nothing but requests of twelve bytes: units by one step
                self._count(buffer[_UNIT:at:READ_SIZE])
            else:
                self._count(bytes(map(_unit_of, out[counted:])))
        self.spent = self._share - left
        if not left and at <= last and not self.broken:
            self.rest = buffer[at:size]
            return out
        if not self.broken and size - at >= 6:
            length = buffer[at + 4] << 8 | buffer[at + 5]
            if length not in _LENGTHS:
                self.broken = impossible_length(length)
        if at < size and not self.broken:
            self._buffer.keep(buffer, at, size)
            self.unfinished = size - at
        return out

    def put_off(self, buffer: bytes | bytearray, size: int) -> None:
        """Take the first ``size`` bytes of ``buffer``, and work through none of them before `go_on`."""
        if self.unfinished:
            buffer, size = self._buffer.join(buffer, size)
            self.unfinished = 0
        self.rest += bytes(memoryview(buffer)[:size])

    def go_on(self) -> list[bytes]:
        """Work through the rest, as far as a share goes; the ADUs to send, in order."""
        rest, self.rest = self.rest, b""
        return self.receive(rest, len(rest))

    def close(self) -> None:
        """The connection has ended: what is still waiting gets no reply, and its slots are free."""
        self.rest = b""
        if self._reads is not None:
            self._reads.close()
        waiting, self._waiting = self._waiting, None
        for context in waiting or ():
            self._slots.used -= 1
            context.diagnostics.kept_silent()
            context.abandon()

    def _offers(self, unit: int) -> Mapping[int, Answer]:
        if self._diagnostics.listen_only_units:
            return {}
        if len(self._memo) >= _MEMO_LIMIT:
            self._memo.clear()
        context = self._context(unit, 0, 0)
        offers = self._memo[unit] = self._handler.direct(context)
        return offers

    def _planned(self) -> dict[bytes, ReadPlan]:
        """The plans that hold for this connection."""
        return {} if self._planner is None else self._planner.plans(self._context(0, 0, 0))

    def _learn(self, unit: int, adu: bytes) -> bool:
        """Plan a read that was answered, for the next time it is asked; whether there is room for another."""
        assert self._planner is not None
        plan = self._planner.plan(self._context(unit, adu[7], 0), adu[7:])
        if plan is not None:
            self._plans[adu[2:]] = plan
        return len(self._plans) < _PLAN_LIMIT

    def _forwarded(self, handler: ReadForwarder) -> ForwardPlans:
        """What is known of reads that a handler hands on."""
        return handler.forward_plans(self._context(0, 0, 0))

    def _can_forward(self, reads: ForwardedReads, unit: int, adu: bytes) -> bool:
        """Ask, once, what becomes of a read: whether it is handed on from now on."""
        key = adu[2:]
        if not is_read(adu) or key in reads.plans or not isinstance(self._handler, ReadForwarder):
            return False  # where it is known, no slot is left, or it has to go the generic path
        plan = self._handler.forward_plan(self._context(unit, adu[7], 0), adu[7:])
        reads.plans.learn(key, plan)
        return plan is not None

    def _deliver_each(self, adus: list[bytes]) -> None:
        for adu in adus:
            self._deliver(adu)

    def _count(self, units: bytes | bytearray) -> None:
        """Count requests that the fast path has answered: the unit of each."""
        direct = len(units)
        self.requests += direct
        exchanged = self._diagnostics.exchanged
        first = units[0]
        if direct == 1 or units.count(first) == direct:
            exchanged[first] += direct
        else:
            for unit in units:
                exchanged[unit] += 1

    def _context(self, unit: int, function: int, transaction: int) -> RequestContext:
        return RequestContext(
            unit=unit,
            function=function,
            diagnostics=self._diagnostics.of(unit),
            peer=self._peer,
            listener=self._listener,
            role=self._role,
            transaction=transaction,
            finish=self._finish,
        )

    def _generic_path(self, transaction: int, unit: int, pdu: bytes) -> bytes:
        """Decode, hand to the handler, encode. Empty where there is no answer, or not yet."""
        function = pdu[0]
        if function > 0x7F:
            self.discarded += 1
            return b""
        self.requests += 1
        context = self._context(unit, function, transaction)
        diagnostics = context.diagnostics
        diagnostics.received()
        slots = self._slots
        if slots.used >= slots.limit and not diagnostics.listen_only:
            self.refused_busy += 1
            return self._encode(context, ExceptionResponse(function, ExceptionCode.SERVER_DEVICE_BUSY))
        outcome: Outcome
        if diagnostics.listen_only and function != FunctionCode.DIAGNOSTICS:
            outcome = Deferral.SILENCE
        elif function == 0:
            outcome = ExceptionResponse(0, ExceptionCode.ILLEGAL_FUNCTION)
        else:
            was_listen_only = diagnostics.listen_only
            outcome = self._ask(context, pdu)
            if was_listen_only or diagnostics.listen_only:
                # Function 08 itself is answered neither when it mutes the unit nor when it wakes it.
                outcome = Deferral.SILENCE
        if context.replied:
            return b""  # by ``reply``, before the handler returned; a request has one answer
        if isinstance(outcome, Message):
            context._finish = None
            return self._encode(context, outcome)
        if outcome is Deferral.SILENCE:
            context._finish = None
            diagnostics.kept_silent()
            return b""
        slots.used += 1
        if self._waiting is None:
            self._waiting = set()
        self._waiting.add(context)
        if outcome is not LATER:
            self.deferred.append(Deferred(context, outcome))
        return b""

    def _ask(self, context: RequestContext, pdu: bytes) -> Outcome:
        handler = self._handler
        try:
            return handler.handle(context, handler.functions.decode_request(pdu))
        except Refusal as refusal:
            return ExceptionResponse(context.function, refusal.code)
        except Exception as error:
            self.failures.append(HandlerFailure(context, error))
            return ExceptionResponse(context.function, ExceptionCode.SERVER_DEVICE_FAILURE)

    def _finish(self, context: RequestContext, reply: Message | Deferral) -> None:
        """A late reply has come, by `RequestContext.reply`."""
        if self._waiting and context in self._waiting:
            self._waiting.discard(context)
            self._slots.used -= 1
        if isinstance(reply, Message):
            self._deliver(self._encode(context, reply))
        else:
            context.diagnostics.kept_silent()
            self._deliver(b"")  # nothing is sent, but a client that has closed its half may wait for nothing else

    def _encode(self, context: RequestContext, reply: Message) -> bytes:
        diagnostics = context.diagnostics
        if isinstance(reply, ExceptionResponse):
            diagnostics.answered(exception=reply.exception)
        else:
            diagnostics.answered(counts=context.function not in _POLLS)
        pdu = reply.encode()
        return _pack(context.transaction, 0, 1 + len(pdu), context.unit) + pdu
