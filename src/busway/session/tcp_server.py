"""The server's side of one TCP connection: request bytes in, reply bytes out, without IO.

Knows the rules of Messaging on TCP/IP V1.0b §4.4.2; knows no socket and no device.

1. A frame with a protocol identifier other than 0 is discarded and the stream goes on; an invalid length ends the
   connection (``broken``), after the requests before it were answered.
2. Order of checks: protocol → slot (exception 06) → function (01) → the pipeline's outcome. A request that is answered
   within its call holds no slot, and the fast path needs none. In listen-only mode there is no answer of any kind.
3. A function code above 127 is discarded: it would be a reply. Function 0 is answered 80 01.
4. Requests start in order. Replies to deferred requests leave when they are ready, each with the unit and the
   transaction of its request, and only while the connection lasts.
5. Every request that gets no answer is counted.
6. Known reads that the responder forwards (`ReadForwarder`) are forwarded together and bypass the generic path.
7. With a ``share``, one call of `receive` processes at most that many requests, and the bytes after them wait in
   ``rest`` until the driver calls `go_on`. Known reads that the fast path answers do not count. Consecutive reads that
   are forwarded together are never divided, and do not count at the beginning of bytes that are nothing but reads.
8. `TcpServerSession.receive` has two loops: one for segments of nothing but known reads, one for everything else. In
   the second loop a known read takes 68 instructions instead of 29.
"""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from struct import Struct

from ..codes import ExceptionCode, FunctionCode
from ..framing.mbap import HEAD, HEAD_AND_FUNCTION, MAX_LENGTH, MIN_LENGTH, StreamBuffer, impossible_length
from ..pdu.exception_response import ExceptionResponse
from ..pdu.message import Message
from .diagnostic_counters import LineDiagnostics
from .forwarded_reads import LAST_READ, READ_SIZE, DeliverTogether, ForwardedReads, ReadForwarder
from .responder import ALONE, LATER, ClientIdentity, Deferral, Forwarding, RequestContext
from .server_pipeline import MOST_READS, NO_FAST_PATH, RequestPipeline, ResponderFailure
from .server_transaction_slots import ServerTransactionSlots

_unpack = HEAD_AND_FUNCTION.unpack_from
_pack = HEAD.pack
_pack_reply_header = Struct(">4sHB").pack
"""Packs the header of a reply out of the first four bytes of the request, its own length, and the unit."""
_unpack_length = Struct(">HHH").unpack_from
"""Unpacks the first six bytes of a header: transaction identifier, protocol and length."""
_cut_reads = Struct("2s10s").iter_unpack
"""Splits reads of twelve bytes into the transaction identifier and the ten bytes that identify a known read."""
_UNIT = 6
_FUNCTION = 7
"""Offset of the function code in an ADU; `_UNIT` is that of the unit."""
_unit_of = itemgetter(_UNIT)
_LENGTHS = frozenset(range(MIN_LENGTH, MAX_LENGTH + 1))
"""Valid values of the length field: one look-up is quicker than two comparisons."""
_LEAST_SIZE = 8
"""Bytes of the shortest request: the MBAP header and a function code."""
_NO_SHARE = 1 << 62
_POLLS = frozenset({FunctionCode.GET_COMM_EVENT_COUNTER, FunctionCode.GET_COMM_EVENT_LOG})
Deliver = Callable[[bytes], None]
"""Function that sends the frame of a late reply. It is called with no bytes if a request ends without a reply."""


@dataclass(frozen=True, slots=True)
class Deferred:
    """A responder's reply that is not ready yet: the driver awaits it and passes it to ``context.reply``."""

    context: RequestContext
    awaitable: Awaitable[Message]


class TcpServerSession:
    """State of one TCP connection on a server: turns request bytes into reply bytes.

    Attributes:
        broken: why the stream cannot be decoded any further; empty while it can. The driver then closes the connection.
        deferred: replies that the driver has to await; the driver empties the list.
        failures: failures of the responder to log; the driver empties the list.
        unfinished: number of received bytes of a frame that is not complete yet.
        requests: requests received so far, without ``discarded``.
        discarded: frames so far that were ignored: foreign protocol identifier, or function above 127.
        refused_busy: requests answered 06 because all slots were taken.
        rest: received bytes that are not processed yet, because the share was used up or `put_off` was called. Call
            `go_on` until it is empty before you pass in more.
        spent: requests that the last call of `receive` or `go_on` has processed, known reads not counted. A call
            with nothing but known reads leaves it as it was, so the driver resets it to 0 once it has used it.
    """

    __slots__ = (
        "_buffer",
        "_client",
        "_deliver",
        "_diagnostics",
        "_fast",
        "_forwarder",
        "_generation",
        "_pipeline",
        "_reads",
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
        pipeline: RequestPipeline,
        *,
        diagnostics: LineDiagnostics,
        slots: ServerTransactionSlots,
        deliver: Deliver,
        deliver_together: DeliverTogether | None = None,
        client: ClientIdentity | None = None,
        share: int | None = None,
    ) -> None:
        """Create the server's session for a new TCP connection.

        Args:
            pipeline: answers the requests.
            diagnostics: counters and modes of the units of the listener.
            slots: limit of requests that wait for their reply.
            deliver: called with a reply frame that is ready only after `receive` has returned.
            deliver_together: called with several such frames; if None, ``deliver`` is called for each of them.
            client: who sends the requests; None if not known.
            share: most requests that one call of `receive` processes, known reads not counted; None for no limit.
        """
        self._pipeline = pipeline
        self._client = ClientIdentity() if client is None else client
        self._diagnostics = diagnostics
        self._slots = slots
        self._deliver = deliver
        self._share = _NO_SHARE if share is None else share
        self._generation = pipeline.generation
        self._fast = pipeline.fast_path(self._client)
        responder = pipeline.responder
        self._forwarder = responder if isinstance(responder, ReadForwarder) else None
        self._reads = None
        if self._forwarder is not None:
            self._slots = slots = slots.taken()
            self._reads = ForwardedReads(
                self._fast.forwards,
                client=self._client,
                slots=slots,
                diagnostics=diagnostics,
                deliver=deliver_together or self._deliver_each,
                observed_by=pipeline if pipeline.observers else None,
            )
        # Made when they are needed: most connections never have a deferred request or half a frame.
        self._buffer: StreamBuffer | None = None
        self._waiting: set[RequestContext] | None = None
        self.broken: str = ""
        self.deferred: Sequence[Deferred] = ()  # no lists of 56 bytes in each idle connection
        self.failures: Sequence[ResponderFailure] = ()
        self.unfinished: int = 0
        self.requests: int = 0
        self.discarded: int = 0
        self.refused_busy: int = 0
        self.rest: bytes = b""
        self.spent: int = 0

    @property
    def waiting(self) -> int:
        """Number of received requests that have no reply yet."""
        waiting = len(self._waiting) if self._waiting else 0
        return waiting if self._reads is None else waiting + self._reads.waiting

    def receive(self, buffer: bytes | bytearray, size: int) -> list[bytes]:
        """Process the first ``size`` bytes of ``buffer``. Returns the reply frames that are ready, in order.

        Later replies are passed to ``deliver``. The beginning of an incomplete frame is kept for the next call;
        requests beyond the share are kept in ``rest``. Once ``broken`` is set, bytes are ignored and an empty list is
        returned.
        """
        if self.broken:
            return []
        if self.unfinished:
            buffer, size = self._joined(buffer, size)
        pipeline = self._pipeline
        if self._generation != pipeline.generation:
            self._renew_fast_path()
        muted = self._diagnostics.listen_only_units  # one listen-only unit is enough to turn the fast path off
        fast = NO_FAST_PATH if muted else self._fast
        known = fast.reads
        began = pipeline.clock() if pipeline.observers else None
        if size == READ_SIZE and began is None:  # a client in lock-step
            prepared = known.get(bytes(buffer[2:READ_SIZE]))
            if prepared is not None:
                self.requests += 1
                self._diagnostics.exchanged[buffer[_UNIT]] += 1
                return [bytes(buffer[:2]) + prepared.head + prepared.block.data[prepared.part]]
        reads = None if muted else self._reads
        out: list[bytes] = []
        at = 0
        if size % READ_SIZE:
            pass
        elif known:
            # A poller sends only reads, and repeats them. Cut by one call, without copying the buffer, they take
            # 0.47 µs each, of which 0.2 are for building the answer; by the loop below 0.6.
            for transaction, asked in _cut_reads(memoryview(buffer)[:size]):
                prepared = known.get(asked)
                if prepared is None:
                    break
                out.append(transaction + prepared.head + prepared.block.data[prepared.part])
            else:
                if size:
                    self.requests += size // READ_SIZE
                    self._diagnostics.count_exchanged(buffer[_UNIT:size:READ_SIZE])
                if began is not None:
                    pipeline.answered(self._client, out, began)
                return out
            at = READ_SIZE * len(out)
        elif reads is not None and size and buffer[_FUNCTION] <= LAST_READ:
            at = reads.take(buffer, 0, size)
            self.requests += at // READ_SIZE
            if at == size:
                return out
        if buffer.__class__ is not bytes:
            buffer = bytes(memoryview(buffer)[:size])
        functions = fast.functions
        client = self._client
        learns = len(known) < MOST_READS
        left = self._share
        last = size - _LEAST_SIZE
        counted = 0  # answers of ``out``; those after them are of the fast path, and counted together
        # The loop below is the hot path of a server with mixed requests. One look-up of the six bytes after the
        # transaction checks protocol and length, and finds the size of the request and the compiled answer, whose call
        # is half of the 0.8 to 1.2 µs that a request takes. A read that was asked before needs another look-up instead.
        while at <= last:
            if reads is not None and left and buffer[at + _FUNCTION] <= LAST_READ:
                begin, at = at, reads.take(buffer, at, size)
                if at > begin:
                    taken = (at - begin) // READ_SIZE
                    self.requests += taken
                    left = max(left - taken, 0)
                    continue
            bound = functions.get(buffer[at + 2 : at + 8])
            if bound is None:
                if not left:
                    break
                _, protocol, length = _unpack_length(buffer, at)
                if length not in _LENGTHS:
                    self.broken = impossible_length(length)
                    break
                if protocol:
                    if at + 6 + length > size:
                        break
                    left -= 1
                    self.discarded += 1
                    at += 6 + length
                    continue
                bound = fast.bind(buffer[at + 2 : at + 8])
            if bound.is_learnt:
                prepared = known.get(buffer[at + 2 : at + 12])
                if prepared is not None:
                    out.append(buffer[at : at + 2] + prepared.head + prepared.block.data[prepared.part])
                    at += READ_SIZE
                    continue
            if not left:
                break
            end = at + bound.size
            if end > size:
                break
            left -= 1
            answer = bound.answer
            if answer is not None:
                reply = answer(buffer, at + 7, end, client)
                if reply is not None:
                    if bound.echoes:
                        out.append(buffer[at:end])
                    else:
                        out.append(_pack_reply_header(buffer[at : at + 4], len(reply) + 1, bound.unit) + reply)
                        if learns and bound.is_learnt:
                            learns = fast.learn_read(buffer[at:end])
                    at = end
                    continue
            # Count the answers of the fast path so far: the generic path may read the counters.
            answered = len(out) - counted
            if answered:
                self.requests += answered
                self._diagnostics.count_exchanged(bytes(map(_unit_of, out[counted:])))
                if began is not None:
                    pipeline.answered(client, out[counted:], began)
                counted = len(out)
            transaction, _, _, unit, function = _unpack(buffer, at)
            if reads is not None and function <= LAST_READ and self._can_forward(unit, buffer[at:end]):
                left += 1  # it is taken in the next round
                continue
            adu = self._generic_path(transaction, unit, buffer[at + _FUNCTION : end])
            if adu:
                out.append(adu)
                counted += 1
            at = end
            if began is not None:
                began = pipeline.clock()
            if self._generation != pipeline.generation:  # a hook has replaced the policy, for example
                self._renew_fast_path()
                fast = NO_FAST_PATH if muted else self._fast
                known, functions = fast.reads, fast.functions
            elif function == FunctionCode.DIAGNOSTICS:  # it may have muted a unit, or woken it
                fast = NO_FAST_PATH if muted else self._fast
                known, functions = fast.reads, fast.functions
                reads = None if muted else self._reads
        answered = len(out) - counted
        if answered:
            self.requests += answered
            if at == READ_SIZE * answered:  # nothing but requests of twelve bytes: units by one step
                self._diagnostics.count_exchanged(buffer[_UNIT:at:READ_SIZE])
            else:
                self._diagnostics.count_exchanged(bytes(map(_unit_of, out[counted:])))
            if began is not None:
                pipeline.answered(client, out[counted:], began)
        self.spent = self._share - left
        if not left and at <= last and not self.broken:
            self.rest = buffer[at:size]
            return out
        if not self.broken and size - at >= 6:
            length = buffer[at + 4] << 8 | buffer[at + 5]
            if length not in _LENGTHS:
                self.broken = impossible_length(length)
        if at < size and not self.broken:
            if self._buffer is None:
                self._buffer = StreamBuffer()
            self._buffer.keep(buffer, at, size)
            self.unfinished = size - at
        return out

    def _joined(self, buffer: bytes | bytearray, size: int) -> tuple[bytes | bytearray, int]:
        """Return the kept beginning of a frame followed by the first ``size`` bytes of ``buffer``, and their number."""
        assert self._buffer is not None  # since something is unfinished
        self.unfinished = 0
        return self._buffer.join(buffer, size)

    def put_off(self, buffer: bytes | bytearray, size: int) -> None:
        """Add the first ``size`` bytes of ``buffer`` to ``rest`` unprocessed; `go_on` processes them later."""
        if self.unfinished:
            buffer, size = self._joined(buffer, size)
        self.rest += bytes(memoryview(buffer)[:size])

    def go_on(self) -> list[bytes]:
        """Process the bytes in ``rest``, up to the session's share of requests; the others stay in ``rest``.

        Returns the reply frames that are ready, in order.
        """
        rest, self.rest = self.rest, b""
        return self.receive(rest, len(rest))

    def close(self) -> None:
        """End the session with its connection: waiting requests get no reply, and no longer count towards the limit."""
        self.rest = b""
        if self._reads is not None:
            self._reads.close()
        waiting, self._waiting = self._waiting, None
        for context in waiting or ():
            self._slots.used -= 1
            context.diagnostics.kept_silent()
            context.abandon()

    def _renew_fast_path(self) -> None:
        self._generation = self._pipeline.generation
        self._fast = self._pipeline.fast_path(self._client)
        if self._reads is not None:
            self._reads.forwards = self._fast.forwards

    def _can_forward(self, unit: int, adu: bytes) -> bool:
        assert self._forwarder is not None
        return self._fast.can_forward(self._forwarder, self._context(unit, adu[7], 0), adu)

    def _deliver_each(self, adus: list[bytes]) -> None:
        for adu in adus:
            self._deliver(adu)

    def _context(self, unit: int, function: int, transaction: int) -> RequestContext:
        return RequestContext(
            unit=unit,
            function=function,
            diagnostics=self._diagnostics.of(unit),
            client=self._client,
            transaction=transaction,
            finish=self._finish,
        )

    def _generic_path(self, transaction: int, unit: int, pdu: bytes) -> bytes:
        """Process a request by `RequestPipeline.answer`, and return the frame of the reply.

        Empty if there is no reply, or not yet; a later one is passed to ``deliver``. If no transaction slot is free,
        the reply is exception 06.
        """
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
        failures: list[ResponderFailure] = []
        outcome = self._pipeline.answer(context, pdu, failures)
        if failures:
            self.failures = (*self.failures, *failures)
        if isinstance(outcome, Forwarding):
            for target, asked in outcome.asks:
                target.ask(outcome, ALONE, (asked,))
            outcome = LATER
        if context._finish is None:
            return b""  # by ``reply``, before the responder returned; a request has one answer
        if isinstance(outcome, Message):
            context._finish = None
            return self._encode(context, outcome)
        if outcome is Deferral.SILENCE:
            context._finish = None
            diagnostics.kept_silent()
            return b""
        if self._waiting is None:
            self._waiting = set()
            if self._forwarder is None:
                self._slots = slots = slots.taken()
        slots.used += 1
        self._waiting.add(context)
        if outcome is not LATER:
            self.deferred = (*self.deferred, Deferred(context, outcome))
        return b""

    def _finish(self, context: RequestContext, reply: Message | Deferral) -> None:
        """Send a reply that a responder gave later, by `RequestContext.reply`.

        `SILENCE` ends the request without one.
        """
        if self._waiting and context in self._waiting:
            self._waiting.discard(context)
            self._slots.used -= 1
        if isinstance(reply, Message):
            self._deliver(self._encode(context, reply))
        else:
            context.diagnostics.kept_silent()
            self._deliver(b"")  # sends nothing, but lets the driver close a half-closed connection

    def _encode(self, context: RequestContext, reply: Message) -> bytes:
        diagnostics = context.diagnostics
        if isinstance(reply, ExceptionResponse):
            diagnostics.answered(exception=reply.exception)
        else:
            diagnostics.answered(counts=context.function not in _POLLS)
        pdu = reply.encode()
        return _pack(context.transaction, 0, 1 + len(pdu), context.unit) + pdu
