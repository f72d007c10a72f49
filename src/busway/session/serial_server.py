"""The servers of a serial line: any number of units on one wire, which never speak unasked.

Knows the server's state diagram (Serial Line V1.02 §2.4.2) and what is counted when (appendix A); knows no port.
RTU and ASCII differ only in the receiver and in the encoding that are handed in.

1. Only a request for an own unit is answered; what passes by for others, request or reply, is counted as a message of
   the line and nothing else.
2. A damaged frame is never answered and never executed; an error of content is answered.
3. A broadcast is executed by every unit and answered by none. One that asks for a read, or fails, is only counted.
4. The answer leaves t3.5 after the last byte on the line at the earliest. If somebody else has spoken before a slow
   handler is ready, its answer is not sent: the master has given up and the line is not ours.
5. In listen-only mode nothing is answered, until a restart that is not answered either.
"""

from collections.abc import Callable
from dataclasses import dataclass

from ..codes import BROADCAST_UNIT, ExceptionCode, FunctionCode
from ..framing.received import Damaged, Direction, SerialFrame, SerialReceiver
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message
from ..pdu.message import Request as AnyFunction
from .diagnostics import CommunicationState
from .handler import LATER, Deferral, Handler, Outcome, Refusal, RequestContext
from .server import Deferred, HandlerFailure

EncodeFrame = Callable[[int, bytes], bytes]
_POLLS = frozenset({FunctionCode.GET_COMM_EVENT_COUNTER, FunctionCode.GET_COMM_EVENT_LOG})


@dataclass(frozen=True, slots=True)
class Emission:
    """A frame to send.

    Attributes:
        frame: its bytes.
        not_before: when its first byte may leave.
    """

    frame: bytes
    not_before: float


class SerialServerSession:
    """One line's conversation, seen by the servers on it.

    Attributes:
        deferred, failures: as in `TcpServerSession`; the driver empties them.
        requests: requests for own units so far.
        foreign: frames of others that passed by.
        abandoned: answers that came after somebody else had spoken.
    """

    __slots__ = (
        "_broadcast_units",
        "_deliver",
        "_diagnostics",
        "_encode",
        "_handler",
        "_line",
        "_listener",
        "_receiver",
        "_units",
        "_waiting",
        "abandoned",
        "deferred",
        "failures",
        "foreign",
        "requests",
    )

    def __init__(
        self,
        handler: Handler,
        units: Callable[[int], bool],
        broadcast_units: Callable[[], "list[int]"],
        *,
        receiver: SerialReceiver,
        encode: EncodeFrame,
        diagnostics: CommunicationState,
        deliver: Callable[[Emission], None],
        line: str = "",
    ) -> None:
        """A session that has heard nothing yet.

        Args:
            handler: what answers.
            units: whether a unit 1…247 is an own one.
            broadcast_units: the units that execute a broadcast.
            receiver: a receiver in the role of a server.
            encode: unit and PDU → frame.
            diagnostics: counters and mode of the line.
            deliver: takes late answers.
            line: name of the line, for contexts.
        """
        self._handler = handler
        self._units = units
        self._line = line
        self._listener = line
        self._broadcast_units = broadcast_units
        self._receiver = receiver
        self._encode = encode
        self._diagnostics = diagnostics
        self._deliver = deliver
        self._waiting: RequestContext | None = None
        self.deferred: list[Deferred] = []
        self.failures: list[HandlerFailure] = []
        self.requests = 0
        self.foreign = 0
        self.abandoned = 0

    # What the port reports.

    def receive(self, data: bytes, now: float) -> list[Emission]:
        """Work through bytes read at ``now``; the answers to send, at most one on a line where masters keep order."""
        return self._work(self._receiver.receive(data, now))

    def damaged(self, now: float, *, overrun: bool = False) -> list[Emission]:
        """The port marks a parity or framing error, or lost characters, here."""
        return self._work(self._receiver.damaged(now, overrun=overrun))

    def tick(self, now: float) -> list[Emission]:
        """Let the silence until ``now`` take effect."""
        return self._work(self._receiver.tick(now))

    def deadline(self) -> float | None:
        """When `tick` has something to do."""
        return self._receiver.deadline()

    def sent(self, frame: bytes, ends: float) -> None:
        """A frame of ours is on the line until ``ends``."""
        self._receiver.sent(frame, ends)

    def close(self) -> None:
        """The port has gone: what is still waiting gets no answer."""
        context, self._waiting = self._waiting, None
        if context is not None:
            self._diagnostics.kept_silent()
            context._finish = None

    # Inside.

    def _work(self, received: "list[SerialFrame | Damaged]") -> list[Emission]:
        out: list[Emission] = []
        for found in received:
            self._abandon()
            if isinstance(found, Damaged):
                self._diagnostics.received_damaged(overrun=found.overrun)
                continue
            answer = self._frame(found)
            if answer is not None:
                out.append(answer)
        return out

    def _frame(self, frame: SerialFrame) -> Emission | None:
        broadcast = frame.unit == BROADCAST_UNIT
        if frame.direction is Direction.REPLY or not (broadcast or self._units(frame.unit)):
            self.foreign += 1
            self._diagnostics.received_foreign()
            return None
        function = frame.pdu[0]
        if function > 0x7F:
            self.foreign += 1
            self._diagnostics.received_foreign()
            return None
        self.requests += 1
        self._diagnostics.received(broadcast=broadcast)
        if broadcast:
            self._broadcast(frame.pdu)
            return None
        context = self._context(frame.unit, function)
        outcome = self._outcome(context, frame.pdu)
        if isinstance(outcome, Message):
            context._finish = None
            return Emission(self._answer(context, outcome), self._receiver.clear_at())
        if outcome is Deferral.SILENCE:
            context._finish = None
            self._diagnostics.kept_silent()
            return None
        if not context.replied:
            self._waiting = context
            if outcome is not LATER:
                self.deferred.append(Deferred(context, outcome))
        return None

    def _outcome(self, context: RequestContext, pdu: bytes) -> Outcome:
        diagnostics = self._diagnostics
        if diagnostics.listen_only and context.function != FunctionCode.DIAGNOSTICS:
            return Deferral.SILENCE
        if context.function == 0:
            return ExceptionResponse(0, ExceptionCode.ILLEGAL_FUNCTION)
        was_listen_only = diagnostics.listen_only
        outcome = self._ask(context, pdu)
        if was_listen_only or diagnostics.listen_only:
            # 08/04 and the 08/01 that ends it are not answered; nothing else of 08 is, in between.
            return Deferral.SILENCE
        return outcome

    def _broadcast(self, pdu: bytes) -> None:
        """Execute a write on every unit; count what can not be done."""
        diagnostics = self._diagnostics
        diagnostics.kept_silent()
        if diagnostics.listen_only:
            return
        request = self._handler.functions.decode_request(pdu)
        if not isinstance(request, AnyFunction) or not request.broadcast:
            diagnostics.failed(ExceptionCode.ILLEGAL_FUNCTION)
            return
        for unit in self._broadcast_units():
            context = self._context(unit, pdu[0])
            outcome = self._ask(context, pdu)
            if isinstance(outcome, ExceptionResponse):
                diagnostics.failed(outcome.exception)
            elif not isinstance(outcome, Message | Deferral):
                self.deferred.append(Deferred(context, outcome))
            else:
                context._finish = None
                diagnostics.event_count += isinstance(outcome, Message)

    def _ask(self, context: RequestContext, pdu: bytes) -> Outcome:
        handler = self._handler
        try:
            return handler.handle(context, handler.functions.decode_request(pdu))
        except Refusal as refusal:
            return ExceptionResponse(context.function, refusal.code)
        except Exception as error:
            self.failures.append(HandlerFailure(context, error))
            return ExceptionResponse(context.function, ExceptionCode.SERVER_DEVICE_FAILURE)

    def _context(self, unit: int, function: int) -> RequestContext:
        return RequestContext(
            unit=unit,
            function=function,
            diagnostics=self._diagnostics,
            peer=self._line,
            listener=self._listener,
            finish=self._finish,
        )

    def _finish(self, context: RequestContext, reply: Message | Deferral) -> None:
        """A late reply has come, by `RequestContext.reply`."""
        if self._waiting is not context:
            return  # a broadcast, or given up
        self._waiting = None
        if isinstance(reply, Message):
            self._deliver(Emission(self._answer(context, reply), self._receiver.clear_at()))
        else:
            self._diagnostics.kept_silent()

    def _abandon(self) -> None:
        """Somebody speaks while a request is still in work: its master has given up."""
        context, self._waiting = self._waiting, None
        if context is not None:
            self.abandoned += 1
            self._diagnostics.kept_silent()
            context._finish = None

    def _answer(self, context: RequestContext, reply: Message) -> bytes:
        if isinstance(reply, ExceptionResponse):
            self._diagnostics.answered(exception=reply.exception)
        else:
            self._diagnostics.answered(counts=context.function not in _POLLS)
        return self._encode(context.unit, reply.encode())
