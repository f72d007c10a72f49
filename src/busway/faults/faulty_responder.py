"""A responder that wraps another one and applies faults to its replies.

Knows requests, faults and faulty connections; knows no socket.

1. While no fault is on, requests take the fast path as without faults, at no cost. Switching a fault changes
   ``generation``; sessions then call `FaultyResponder.serves` again before their next request.
2. A request to which no fault applies is answered by the wrapped responder directly, unless earlier replies on the same
   connection are delayed: then its reply waits for them.
3. The reply to a request to which a fault applies is sent by its `FaultyConnection`. The session gets `SILENCE`, so its
   counters count no answer. Observers get the reply, unless a fault suppresses it.
"""

from collections.abc import Awaitable, Callable
from dataclasses import replace

from ..pdu.exception_response import ExceptionResponse
from ..pdu.functions import AnyRequest, FunctionTable
from ..pdu.message import Message
from ..session.responder import (
    ALONE,
    LATER,
    SILENCE,
    Deferral,
    Forwarding,
    Refusal,
    RequestContext,
    Responder,
    ResponderAnswer,
    ServedUnit,
)
from .applied_faults import Faults
from .fault import Exchange
from .faulty_connections import FaultyConnection, FaultyTap
from .faulty_conversation import Struck


class FaultyResponder:
    """Responder that lets another responder answer the requests, and applies faults to its replies.

    Args:
        inner: the wrapped responder, which answers correctly.
        faults: the faults to apply.
        tap: sends the changed replies; the same object has to be the ``tap`` of the server.
        heard: called with the `Exchange` of every request, before it is answered. If it is given, no request takes the
            fast path. None: not called.
    """

    def __init__(
        self, inner: Responder, faults: Faults, tap: FaultyTap, *, heard: Callable[[Exchange], None] | None = None
    ) -> None:
        self.inner = inner
        self._faults = faults
        self._tap = tap
        self._heard = heard

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, of the wrapped responder."""
        return self.inner.functions

    @property
    def generation(self) -> int:
        """A number that changes when earlier results of `serves` are no longer right.

        It changes with the faults, with the wrapped responder, and when a connection has no more delayed replies.
        """
        return self.inner.generation + self._faults.generation + self._tap.drained

    @property
    def _is_aside(self) -> bool:
        return not (self._faults.is_any_on or self._heard or self._tap.has_any_unsent)

    def serves(self, unit: int) -> ServedUnit | None:
        """Return the wrapped responder's entry for a unit; None if the unit is not served.

        ``is_direct`` is False, so that requests do not take the fast path, while a fault is on or a reply is delayed,
        and always if ``heard`` was given.
        """
        served = self.inner.serves(unit)
        return served if served is None or self._is_aside else replace(served, is_direct=False)

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Answer a request, with the faults that apply to it.

        Returns the wrapped responder's outcome, or raises its `Refusal`, if no fault applies to the request and no
        earlier reply on the connection is delayed. Otherwise the tap sends the reply, and the session is told that
        there is none: this method returns `SILENCE`. If the wrapped responder answers later, it returns `LATER` or an
        awaitable, and the session gets `SILENCE` when that has answered.
        """
        faulty = self._tap.find(context.listener, context.peer)
        if faulty is None or self._is_aside:
            return self.inner.answer(context, request)
        conversation = faulty.conversation
        exchange = _exchange(context, request, faulty)
        if self._heard is not None:
            self._heard(exchange)
        struck = conversation.strike(exchange)
        if not struck and (exchange.is_broadcast or not faulty.has_unsent):
            conversation.contact.last_sent = exchange.now
            return self.inner.answer(context, request)
        said = conversation.asked(struck)
        turn = _Turn(faulty, exchange, struck)
        if said is None:
            return turn.take(context, lambda inside: self.inner.answer(inside, request))
        refused = ExceptionResponse(context.function, said[1]) if len(said) == 2 and said[0] & 0x80 else None
        turn.say(context, said, refused)
        return SILENCE


class _Turn:
    """One request to a faulty device; its reply is planned and sent by the `FaultyConnection`."""

    def __init__(self, faulty: FaultyConnection, exchange: Exchange, struck: Struck) -> None:
        self._faulty = faulty
        self._exchange = exchange
        self._struck = struck

    def say(self, context: RequestContext, answer: bytes, outcome: Message | None) -> None:
        """Plan the bytes to send for a reply PDU (empty for no reply), and report the outcome to the observers.

        They get ``outcome``, or `SILENCE` if it is None or no frame is going to be sent.
        """
        faulty = self._faulty
        is_sent = faulty.conversation.answered(self._exchange, self._struck, answer, faulty.clock.now())
        context.end(outcome if is_sent and outcome is not None else SILENCE)
        faulty.pump_soon()

    def take(self, context: RequestContext, perform: Callable[[RequestContext], ResponderAnswer]) -> ResponderAnswer:
        """Let the wrapped responder answer a request, now or later, and send its reply through the faulty connection.

        ``perform`` calls the wrapped responder with the context that it is given. The result is the outcome for the
        session, as of `FaultyResponder.answer`.
        """
        inside = context.inside(lambda _, reply: self._later(context, reply))
        try:
            outcome = perform(inside)
        except Refusal as refusal:
            outcome = ExceptionResponse(context.function, refusal.code)
        if isinstance(outcome, Forwarding):
            for target, asked in outcome.asks:
                target.ask(outcome, ALONE, (asked,))
            outcome = LATER
        if inside.replied:
            return SILENCE  # said already, before the responder returned
        if outcome is LATER:
            context.gone = inside.abandon
            return LATER
        if isinstance(outcome, Message | Deferral):
            inside._finish = None
            self._say_reply(context, outcome)
            return SILENCE
        return self._awaited(context, outcome)

    def _later(self, context: RequestContext, reply: Message | Deferral) -> None:
        self._say_reply(context, reply)
        context.reply(SILENCE)

    def _say_reply(self, context: RequestContext, reply: Message | Deferral) -> None:
        if isinstance(reply, Message):
            self.say(context, reply.encode(), reply)
        else:
            self.say(context, b"", None)

    async def _awaited(self, context: RequestContext, awaitable: Awaitable[Message]) -> Message:
        try:
            reply = await awaitable
        except Refusal as refusal:
            reply = ExceptionResponse(context.function, refusal.code)
        self._later(context, reply)
        return reply  # it is not sent: `SILENCE` was the reply


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
