"""A handler wrapper that applies faults: the wrapped device answers correctly, and its answers are changed.

Knows requests, faults and faulty connections; knows no socket.

1. While no fault is on, the compiled path and the read plans are those of the wrapped handler, at no cost. Switching
   changes ``generation``, and sessions ask again before their next request.
2. A request that no fault strikes is answered by the wrapped handler directly, unless earlier replies on the same
   connection are delayed: then its reply waits for them.
3. The reply to a request that a fault strikes is sent by its `FaultyConnection`. The session is told `SILENCE`, so its
   counters count no answer.
"""

from collections.abc import Awaitable, Callable, Container, Mapping

from ..pdu.direct import Answer, ReadPlan
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.general import ExceptionResponse
from ..pdu.message import Message, Request
from ..session.handler import (
    LATER,
    SILENCE,
    Deferral,
    Handler,
    ListedUnits,
    Outcome,
    ReadPlanner,
    Refusal,
    RequestContext,
    UnitHolder,
    WriteObserver,
)
from .connections import FaultyConnection, FaultyTap
from .conversation import Struck
from .fault import Exchange, Faults


class FaultyHandler:
    """A handler that applies faults to the answers of another handler.

    Args:
        inner: the wrapped handler, which answers correctly.
        faults: the faults to apply.
        tap: sends the changed replies; the server needs the same tap.
        heard: called with every request; with it, none takes the compiled path.

    Attributes:
        serial_units: that of the wrapped handler, if it has one.
    """

    serial_units: Container[int]
    listed_unit: Callable[[int], int]

    def __init__(
        self, inner: Handler, faults: Faults, tap: FaultyTap, *, heard: Callable[[Exchange], None] | None = None
    ) -> None:
        self.inner = inner
        self._faults = faults
        self._tap = tap
        self._heard = heard
        self._planner = inner if isinstance(inner, ReadPlanner) else None
        self._observer = inner if isinstance(inner, WriteObserver) else None
        # Set only where the wrapped handler has it, so that an isinstance test against `UnitHolder` stays right.
        if isinstance(inner, UnitHolder):
            self.serial_units = inner.serial_units
        if isinstance(inner, ListedUnits):  # or a rule for a unit could be walked around by asking 0 or 255
            self.listed_unit = inner.listed_unit

    @property
    def functions(self) -> FunctionTable:
        """The functions of the wrapped handler."""
        return self.inner.functions

    @property
    def generation(self) -> int:
        """A number that changes with the faults, with the wrapped handler, and when all delayed replies are sent."""
        return self.inner.generation + self._faults.generation + self._tap.drained

    @property
    def _is_aside(self) -> bool:
        return not (self._faults.is_any_on or self._heard or self._tap.has_any_unsent)

    # The compiled path.

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The compiled answers of the wrapped handler; none while a fault is on."""
        return self.inner.direct(context) if self._is_aside else {}

    def plans(self, context: RequestContext) -> dict[bytes, ReadPlan]:
        """The read plans of the wrapped handler; none while a fault is on."""
        return self._planner.plans(context) if self._planner is not None and self._is_aside else {}

    def plan(self, context: RequestContext, pdu: bytes) -> ReadPlan | None:
        """The plan of a read; None while a fault is on."""
        return self._planner.plan(context, pdu) if self._planner is not None and self._is_aside else None

    # The generic path.

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Answer a request, changed by the faults that strike it."""
        return self._answer(context, request, lambda inside: self.inner.handle(inside, request))

    def observe_write(
        self, context: RequestContext, request: Request, see: Callable[[tuple[bytes | None, ...]], None]
    ) -> Outcome:
        """As `WriteObserver.observe_write`; ``see`` is called when the wrapped handler calls it."""
        observer = self._observer
        if observer is None:
            return self.handle(context, request)
        return self._answer(context, request, lambda inside: observer.observe_write(inside, request, see))

    def _answer(
        self, context: RequestContext, request: AnyRequest, perform: Callable[[RequestContext], Outcome]
    ) -> Outcome:
        faulty = self._tap.find(context.listener, context.peer)
        if faulty is None or self._is_aside:
            return perform(context)
        conversation = faulty.conversation
        exchange = _exchange(context, request, faulty)
        if self._heard is not None:
            self._heard(exchange)
        struck = conversation.strike(exchange)
        if not struck and (exchange.is_broadcast or not faulty.has_unsent):
            conversation.contact.last_sent = exchange.now
            return perform(context)
        said = conversation.asked(struck)
        turn = _Turn(faulty, exchange, struck)
        if said is None:
            return turn.take(context, perform)
        turn.say(said)
        return SILENCE


class _Turn:
    """One request whose reply is sent by its `FaultyConnection`."""

    def __init__(self, faulty: FaultyConnection, exchange: Exchange, struck: Struck) -> None:
        self._faulty = faulty
        self._exchange = exchange
        self._struck = struck

    def say(self, answer: bytes) -> None:
        """Plan the bytes to send for a reply PDU; an empty PDU is no reply."""
        faulty = self._faulty
        faulty.conversation.answered(self._exchange, self._struck, answer, faulty.clock.now())
        faulty.pump_soon()

    def take(self, context: RequestContext, perform: Callable[[RequestContext], Outcome]) -> Outcome:
        """Let the wrapped handler answer, now or later, and send its answer through the faulty connection."""
        inside = RequestContext(
            unit=context.unit,
            function=context.function,
            diagnostics=context.diagnostics,
            peer=context.peer,
            listener=context.listener,
            role=context.role,
            is_priority=context.is_priority,
            transaction=context.transaction,
            finish=lambda _, reply: self._later(context, reply),
        )
        inside.executed = context.executed
        try:
            outcome = perform(inside)
        except Refusal as refusal:
            outcome = ExceptionResponse(context.function, refusal.code)
        if inside.replied:
            return SILENCE  # said already, before the handler returned
        if outcome is LATER:
            context.gone = inside.abandon
            return LATER
        if isinstance(outcome, Message | Deferral):
            inside._finish = None
            self.say(outcome.encode() if isinstance(outcome, Message) else b"")
            return SILENCE
        return self._awaited(context, outcome)

    def _later(self, context: RequestContext, reply: Message | Deferral) -> None:
        self.say(reply.encode() if isinstance(reply, Message) else b"")
        context.reply(SILENCE)

    async def _awaited(self, context: RequestContext, awaitable: Awaitable[Message]) -> Message:
        try:
            reply = await awaitable
        except Refusal as refusal:
            reply = ExceptionResponse(context.function, refusal.code)
        self._later(context, reply)
        return reply  # nobody takes it: `SILENCE` was the reply


def _exchange(context: RequestContext, request: AnyRequest, faulty: FaultyConnection) -> Exchange:
    pdu = request.encode()
    is_broadcast = context.executed is not None
    conversation = faulty.conversation
    return Exchange(
        conversation.contact,
        context.transaction,
        context.unit,
        pdu,
        request,
        faulty.clock.now(),
        adu=conversation.frame(context.transaction, context.unit, pdu),
        is_broadcast=is_broadcast,
    )
