"""The server's side of a serial line: any number of units on one line, which only answer requests; without IO.

Knows the server's state diagram (Serial Line V1.02 §2.4.2) and when to count what (appendix A); knows no port.
RTU and ASCII differ only in the framing that is passed in.

1. Only a request for an own unit is answered; frames for others, requests or replies, are counted as messages of
   the line and nothing else.
2. A damaged frame is never answered and never executed; an error of content is answered.
3. A broadcast is executed by every unit and answered by none; a device with several units executes it once. A broadcast
   that asks for a read, or fails, is only counted. Any broadcast counts as one message of the line, and as one for
   each unit.
4. The answer leaves t3.5 after the last byte on the line at the earliest. If another frame comes before that, or before
   a slow responder is ready, the answer is not sent: the master has given up and may be using the line. So of two
   requests back to back both are executed, and only the last is answered. An answer is counted when it has left.
5. A unit in listen-only mode answers and executes nothing, until a restart that is not answered either. The other
   units of the line are not affected.
6. Function 08/03 is still answered with the old delimiter; the new one applies to all later frames.
7. Over a network, where answers leave at once, valid requests are answered on the fast path (`FastPath`), and RTU
   frames with known reads by their bytes alone. On a wire the line is slower than the generic path, so this would gain
   nothing.
8. A reply that the line gives back (a two-wire port that hears itself) is no message of the line, with any option
   ``echo``: it is counted in ``echoes``, and neither executed nor answered. A master may repeat a write whose reply has
   the same bytes (05, 06, 08, 22): `EchoFilter.is_own_reply` tells the two apart.
"""

import math
from collections.abc import Callable, Container
from dataclasses import dataclass
from struct import Struct

from ..codes import BROADCAST_UNIT, LAST_SERIAL_UNIT, ExceptionCode, FunctionCode
from ..framing.crc import crc_of_words
from ..framing.mbap import HEAD
from ..framing.received import Damaged, Direction, FrameOrDamage, SerialFrame
from ..pdu.exception_response import ExceptionResponse
from ..pdu.message import Message
from ..pdu.message import Request as AnyFunction
from .diagnostic_counters import LineDiagnostics
from .line_framing import LineFraming
from .prepared_frame import PreparedFrame
from .responder import ALONE, LATER, ClientIdentity, Deferral, Forwarding, RequestContext, ResponderAnswer
from .server_pipeline import NO_FAST_PATH, PREPARED, FastPath, RequestPipeline, ResponderFailure
from .tcp_server import Deferred

_READ_SIZE = 8
"""Bytes of an RTU frame with a read: unit, function, address, count and CRC."""
_cut_reads = Struct(f"{_READ_SIZE}s").iter_unpack
_pack_crc = Struct("<H").pack
_pack_key = Struct(">HHBB").pack
"""Packs what `FastPath.functions` is asked for: protocol, length, unit and function code, as on TCP."""
_POLLS = frozenset({FunctionCode.GET_COMM_EVENT_COUNTER, FunctionCode.GET_COMM_EVENT_LOG})


@dataclass(frozen=True, slots=True)
class FrameToSend:
    """A frame that a server sends on its line, and the time from which it may be sent.

    Attributes:
        frame: its bytes.
        not_before: the earliest time at which its first byte may leave, in the clock of ``now``.
    """

    frame: bytes
    not_before: float


@dataclass(frozen=True, slots=True)
class _Answer:
    """A reply of this server that waits to be sent on the line."""

    context: RequestContext
    reply: Message

    def left(self) -> None:
        """Count this reply as sent, for the diagnostics of its unit."""
        _count_answer(self.context, self.reply)

    def lost(self, *, write_failed: bool = False) -> None:
        """Count the request as one without reply, for the diagnostics; a lost exception reply also counts as exception.

        ``write_failed``: True if the port did not accept the reply, False if it was not sent for another reason.
        """
        diagnostics = self.context.diagnostics
        if isinstance(self.reply, ExceptionResponse):
            diagnostics.failed(self.reply.exception)
        diagnostics.kept_silent(write_failed=write_failed)


def _count_answer(context: RequestContext, reply: Message) -> None:
    if isinstance(reply, ExceptionResponse):
        context.diagnostics.answered(exception=reply.exception)
    else:
        context.diagnostics.answered(counts=context.function not in _POLLS)


class SerialServerSession:
    """State of one serial line on a server, for all units that the server answers for there.

    Attributes:
        deferred: replies that the driver has to await; the driver empties the list.
        failures: failures of the responder to log; the driver empties the list.
        requests: requests for own units so far, broadcasts included.
        foreign: frames on the line so far that were requests to other units, or replies of other stations; after
            `take_no_more` all requests.
        damaged_frames: damaged frames so far.
        abandoned: answers that were not sent because another frame was received first (rule 4).
        echoes: own replies that the line gave back and the option ``echo`` did not remove (rule 8).
        characters_take_time: whether received characters have taken their time on a line. On a pseudo-terminal a frame
            may come at once, and a master may then repeat a write before the computed end of the reply.
    """

    __slots__ = (
        "_client",
        "_deliver",
        "_diagnostics",
        "_fast",
        "_follows_reply",
        "_framing",
        "_generation",
        "_heard_from",
        "_heard_until",
        "_last_byte",
        "_leaving",
        "_pipeline",
        "_receiver",
        "_sends_at_once",
        "_takes_more",
        "_units",
        "_waiting",
        "abandoned",
        "characters_take_time",
        "damaged_frames",
        "deferred",
        "echoes",
        "failures",
        "foreign",
        "requests",
    )

    def __init__(
        self,
        pipeline: RequestPipeline,
        units: Container[int],
        *,
        framing: LineFraming,
        diagnostics: LineDiagnostics,
        deliver: Callable[[FrameToSend], None],
        client: ClientIdentity | None = None,
        sends_at_once: bool = False,
    ) -> None:
        """Create the server's session for a serial line.

        Args:
            pipeline: answers the requests.
            units: the own units, 1…247; a container whose content changes may be given.
            framing: the framing, in the role of a server with the same units.
            diagnostics: counters and modes of the units of the line.
            deliver: called with each answer that is ready only after `process` has returned.
            client: who sends the requests: the master of the line; None if not known.
            sends_at_once: whether every answer leaves as soon as it is ready, as over a network: then the answer counts
                at once, and `answer_left` is not called.
        """
        self._pipeline = pipeline
        self._units = units
        self._client = ClientIdentity() if client is None else client
        self._framing = framing
        self._receiver = framing.receiver
        self._diagnostics = diagnostics
        self._deliver = deliver
        self._generation = pipeline.generation
        self._fast = pipeline.fast_path(self._client)
        self._waiting: RequestContext | None = None
        self._leaving: _Answer | None = None
        self._sends_at_once = sends_at_once
        self._last_byte = 0.0
        self._follows_reply = False
        self._heard_from = self._heard_until = 0.0
        self._takes_more = True
        self.deferred: list[Deferred] = []
        self.failures: list[ResponderFailure] = []
        self.requests: int = 0
        self.foreign: int = 0
        self.damaged_frames: int = 0
        self.abandoned: int = 0
        self.echoes: int = 0
        self.characters_take_time: bool = True

    @property
    def waiting(self) -> int:
        """1 while a request waits for its reply, else 0."""
        return 0 if self._waiting is None else 1

    # Events of the port.

    def receive(self, data: bytes, now: float) -> list[FrameToSend]:
        """Process bytes read at ``now``. Returns the replies to send; at most one if there is a single master."""
        return [*filter(None, map(self.process, self.find(data, now)))]

    def answer_known(self, data: bytes, now: float) -> list[bytes] | None:
        """Return the reply frames to bytes from a network, if these are nothing but RTU frames with known reads.

        Otherwise, or while a request waits for its reply, return None: then nothing was done, and the bytes have to be
        passed to `receive`. Known reads are those that the fast path has stored. ``now`` is when the bytes were read.
        """
        if len(data) % _READ_SIZE or not data or not self._takes_more or self._waiting is not None:
            return None
        known = self._fast_path().frames
        began = self._pipeline.clock()
        try:
            prepared = [known[frame] for (frame,) in _cut_reads(data)]
        except KeyError:
            return None
        if not self._framing.skip_requests(now):
            return None
        self._last_byte = max(self._last_byte, now)
        replies = []
        for read in prepared:
            items = read.block.data[read.part]
            replies.append(read.head + items + _pack_crc(crc_of_words(read.words(items), read.state)))
        self.requests += len(replies)
        self._diagnostics.count_exchanged(data[::_READ_SIZE])
        if self._pipeline.observers:
            self._pipeline.answered(
                self._client, [HEAD.pack(0, 0, len(reply) - 2, reply[0]) + reply[1:-2] for reply in replies], began
            )
        return replies

    def find(self, data: bytes, now: float) -> list[FrameOrDamage]:
        """Return the complete frames, and the damaged bytes, in bytes read at ``now``, in order, for `process`."""
        self._last_byte = max(self._last_byte, now)
        if self._follows_reply:
            self._heard_from = self._heard_from or now
            self._heard_until = now
        return self._receiver.receive(data, now)

    def process(self, frame: FrameOrDamage) -> FrameToSend | None:
        """Process a received frame, or damaged bytes. Returns the reply; None if there is none, or not yet.

        A reply that is ready later is passed to ``deliver``. A request that is still being processed, or whose reply
        has not left, is given up first: the master no longer waits for it (rule 4).
        """
        if self._follows_reply and self._is_own_reply(frame):
            self.echoes += 1
            return None
        self._abandon()
        if isinstance(frame, Damaged):
            self.damaged_frames += 1
            self._diagnostics.received_damaged(overrun=frame.overrun)
            return None
        broadcast = frame.unit == BROADCAST_UNIT
        function = frame.pdu[0]
        is_own = self._takes_more and (broadcast or frame.unit in self._units)
        if frame.direction is Direction.REPLY or function > 0x7F or not is_own:
            self.foreign += 1
            self._diagnostics.received_foreign()
            return None
        self.requests += 1
        if broadcast:
            self._broadcast(frame.pdu)
            return None
        if self._sends_at_once:
            adu = self._answer_from_bytes(frame)
            if adu is not None:
                return FrameToSend(adu, self.clear_at())
        context = self._waiting = self._context(frame.unit, function)
        context.diagnostics.received()
        outcome = self._pipeline.answer(context, frame.pdu, self.failures)
        if isinstance(outcome, Forwarding):
            for target, asked in outcome.asks:
                target.ask(outcome, ALONE, (asked,))
            outcome = LATER
        if context.replied:
            return None  # by ``reply``, before the responder returned; a request has one answer
        if isinstance(outcome, Message):
            self._settle(context)
            return self._answer(context, outcome)
        if outcome is Deferral.SILENCE:
            self._settle(context)
            context.diagnostics.kept_silent()
        elif outcome is not LATER:
            self.deferred.append(Deferred(context, outcome))
        return None

    def receive_damaged(self, data: bytes, now: float, *, overrun: bool = False) -> None:
        """Process bytes of which the port marked one as damaged (parity or framing error), or after which it lost some.

        The frame in progress is discarded, and so is a frame that these bytes complete. ``overrun``: whether characters
        were lost.
        """
        self._last_byte = max(self._last_byte, now)
        marked = [found for found in self._receiver.receive(data, now) if isinstance(found, Damaged)]
        for found in (*marked, *self._receiver.damaged(now, overrun=overrun)):
            self.process(found)

    def clear_at(self) -> float:
        """Return the earliest time at which a reply may be sent: by then the line has been silent long enough."""
        return self._last_byte + self._framing.send_gap

    def tick(self, now: float) -> list[FrameToSend]:
        """Process frames that the silence until ``now`` has ended. Returns the replies to send."""
        return [*filter(None, map(self.process, self._receiver.tick(now)))]

    def deadline(self) -> float | None:
        """Return the time at which to call `tick`, by the clock of ``now``; None for never."""
        return self._receiver.deadline()

    def sent(self, frame: bytes, ends: float) -> None:
        """Record that a frame of this server occupies the line until ``ends``."""
        self._last_byte = max(self._last_byte, ends)
        self._receiver.sent(frame, ends)
        self._follows_reply = True
        self._heard_from = self._heard_until = 0.0

    def answer_left(self) -> None:
        """Count the latest reply as sent: its last character has left."""
        answer, self._leaving = self._leaving, None
        if answer is not None:
            answer.left()

    def answer_lost(self) -> None:
        """Count the latest reply as lost: the port did not accept it."""
        answer, self._leaving = self._leaving, None
        if answer is not None:
            answer.lost(write_failed=True)

    def take_no_more(self) -> None:
        """Execute and answer no more requests; one in progress is still answered, unless another frame comes first."""
        self._takes_more = False

    def close(self) -> None:
        """End the session with its serial port: waiting requests get no reply."""
        leaving, self._leaving = self._leaving, None
        if leaving is not None:
            leaving.lost()
        context, self._waiting = self._waiting, None
        if context is not None:
            context.diagnostics.kept_silent()
            context.abandon()
        self._receiver.flush(self._last_byte)

    # Inside.

    def _fast_path(self) -> FastPath:
        """Return the functions that answer requests from their bytes; none while a unit is in listen-only mode."""
        generation = self._pipeline.generation
        if self._generation != generation:
            self._generation = generation
            self._fast = self._pipeline.fast_path(self._client)
        return NO_FAST_PATH if self._diagnostics.listen_only_units else self._fast

    def _answer_from_bytes(self, frame: SerialFrame) -> bytes | None:
        """Return the reply frame to a request that the fast path can answer; None if it must take the generic path."""
        fast, unit, pdu = self._fast_path(), frame.unit, frame.pdu
        began = self._pipeline.clock()
        key = _pack_key(0, 1 + len(pdu), unit, pdu[0])
        answer = (fast.functions.get(key) or fast.bind(key)).answer
        reply = None if answer is None else answer(pdu, 0, len(pdu), self._client)
        if reply is None:
            return None
        self._diagnostics.exchanged[unit] += 1
        if self._pipeline.observers:
            self._pipeline.answered(self._client, [HEAD.pack(0, 0, len(reply) + 1, unit) + reply], began)
        if pdu[0] in PREPARED and len(frame.raw) == _READ_SIZE:
            fast.learn_frame(frame.raw, PreparedFrame)
        return self._framing.encode(unit, reply)

    def _is_own_reply(self, frame: FrameOrDamage) -> bool:
        """Whether a frame after a reply of this server is that reply, given back by the line (rule 8)."""
        if isinstance(frame, Damaged):
            return False
        took = self._heard_until - self._heard_from
        at_once = not self.characters_take_time and took < len(frame.raw) * self._framing.timing.character / 2
        is_own = self._receiver.echo.is_own_reply(frame.raw, math.inf if at_once else frame.began)
        self._follows_reply = is_own  # a part of it can pass for a frame, and the rest follows
        return is_own

    def _settle(self, context: RequestContext) -> None:
        """Forget the request in progress: it was answered, or will get no reply."""
        self._waiting = None
        context._finish = None

    def _broadcast(self, pdu: bytes) -> None:
        """Execute a broadcast on every unit that is not in listen-only mode; every unit counts the broadcast.

        A broadcast of a request that cannot be broadcast, such as a read, is not executed and counts as failed.
        """
        units = [unit for unit in range(1, LAST_SERIAL_UNIT + 1) if unit in self._units]
        self._diagnostics.received_broadcast(units)
        request = self._pipeline.functions.decode_request(pdu)
        may_be_broadcast = isinstance(request, AnyFunction) and request.broadcast
        executed: set[int] = set()
        for unit in units:
            diagnostics = self._diagnostics.of(unit)
            done = False
            if diagnostics.listen_only:
                pass
            elif may_be_broadcast:
                context = self._context(unit, pdu[0])
                context.executed = executed
                outcome = self._pipeline.answer(context, pdu, self.failures)
                if isinstance(outcome, Forwarding):
                    for target, asked in outcome.asks:
                        target.ask(outcome, ALONE, (asked,))
                done = self._is_executed(context, outcome)
            else:
                diagnostics.failed(ExceptionCode.ILLEGAL_FUNCTION)
            diagnostics.kept_silent(executed=done)

    def _is_executed(self, context: RequestContext, outcome: ResponderAnswer) -> bool:
        """Whether a unit has executed a broadcast, judged by what `RequestPipeline.answer` returned for it.

        An exception is counted. False also if the request was forwarded, or if the responder has not finished yet; an
        awaitable is added to ``deferred``.
        """
        if isinstance(outcome, ExceptionResponse):
            context.diagnostics.failed(outcome.exception)
            return False
        if not isinstance(outcome, Message | Deferral | Forwarding):
            self.deferred.append(Deferred(context, outcome))
            return False
        context._finish = None
        return isinstance(outcome, Message)

    def _context(self, unit: int, function: int) -> RequestContext:
        return RequestContext(
            unit=unit,
            function=function,
            diagnostics=self._diagnostics.of(unit),
            client=self._client,
            finish=self._finish,
        )

    def _finish(self, context: RequestContext, reply: Message | Deferral) -> None:
        """Send a reply that a responder gave later, by `RequestContext.reply`; `SILENCE` ends the request without one.

        Does nothing for a broadcast, or if the request is no longer the one in progress.
        """
        if self._waiting is not context:
            return  # a broadcast, or given up
        self._waiting = None
        if isinstance(reply, Message):
            self._deliver(self._answer(context, reply))
        else:
            context.diagnostics.kept_silent()

    def _abandon(self) -> None:
        """Drop the request in progress or its unsent reply: another frame was received, so the master waits no more."""
        leaving, self._leaving = self._leaving, None
        if leaving is not None:
            self.abandoned += 1
            leaving.lost()
        context, self._waiting = self._waiting, None
        if context is not None:
            self.abandoned += 1
            context.diagnostics.kept_silent()
            context.abandon()

    def _answer(self, context: RequestContext, reply: Message) -> FrameToSend:
        if self._sends_at_once:
            _count_answer(context, reply)
        else:
            self._leaving = _Answer(context, reply)
        frame = self._framing.encode(context.unit, reply.encode())
        if context.function == FunctionCode.DIAGNOSTICS:
            self._framing.delimit_by(self._diagnostics.ascii_delimiter)
        return FrameToSend(frame, self.clear_at())
