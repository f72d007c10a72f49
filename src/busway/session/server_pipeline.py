"""The way of every request through a server: authorizer, responder and observers; or the fast path past them.

Knows the order of the parts, and when the fast path becomes invalid; knows no transport, no device and no rule.

1. Generic path (`RequestPipeline.answer`): listen-only mode, decode, authorizer, responder. The authorizer stands
   beside the responder: it permits or refuses, and answers nothing else.
2. Fast path (`FastPath`): the bytes of a request lead to a function that computes the reply, never to stored data of
   a reply. It is the only cache between request and reply. It is shared by clients with equal rights, contains only
   what these rights permit, and is dropped as a whole when ``generation`` changes.
3. Both paths give the same replies (a property test compares them). What the fast path cannot decide takes the generic
   path, so each refusal is decided, counted and recorded there.
4. Observers see what becomes of requests on both paths, and cannot change it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

from ..codes import ExceptionCode, FunctionCode
from ..pdu.exception_response import ExceptionResponse
from ..pdu.fast_answers import FastAnswer, PreparedAnswer
from ..pdu.functions import STANDARD, AnyRequest, FunctionTable
from ..pdu.message import Message, Request
from .forwarded_reads import PreparedForward, PreparedForwards, ReadForwarder, is_read
from .responder import (
    LATER,
    SILENCE,
    ClientIdentity,
    Deferral,
    Forwarding,
    Refusal,
    RequestContext,
    Responder,
    ResponderAnswer,
    ServedUnit,
)

if TYPE_CHECKING:
    from .prepared_frame import PreparedFrame

_DIAGNOSTICS: Final = int(FunctionCode.DIAGNOSTICS)
_MOST_RIGHTS: Final = 256
"""Number of different rights for which a fast path is kept; above that all fast paths are dropped and built again."""
MOST_READS: Final = 4096
"""Most reads that one fast path knows by all their bytes: enough for a poller of 4096 different ranges. Other reads are
answered by the function for their unit and function code: that takes 1.0 µs instead of 0.4.
"""
PREPARED: Final = frozenset({int(FunctionCode.READ_HOLDING_REGISTERS), int(FunctionCode.READ_INPUT_REGISTERS)})
"""Function codes of the reads that a fast path stores by all their bytes: reads of registers.

Reads of bits are not stored, because their data must be shifted.
"""
_BEFORE_UNIT: Final = 6
"""Bytes of a request on TCP that its length field does not count."""
_MOST_FUNCTIONS: Final = 4096
"""Most answering functions (one for each length, unit and function code) that one fast path keeps."""


class ClientRights(Protocol):
    """Interface of the rights that a policy gives to a client.

    The objects of clients with the same rights are equal.
    """

    def bind(self, unit: int, served: ServedUnit, kind: type[Request]) -> FastAnswer | None:
        """Return a function that answers all requests of the class ``kind`` to a unit from their bytes.

        None if the policy must decide about each request, or the device has no such function; then all of them take the
        generic path.
        """

    def permits_prepared(self, unit: int, served: ServedUnit | None, request: AnyRequest) -> bool:
        """Whether a read is permitted always and without a rate limit, so that repetitions of it need no check."""


class Authorizer(Protocol):
    """Interface of the object that decides which requests a server executes."""

    @property
    def generation(self) -> int:
        """A number that changes when earlier decisions, or earlier results of `rights_of`, are no longer valid."""

    def rights_of(self, client: ClientIdentity) -> ClientRights:
        """Return the rights of a client; the fast path answers only what they permit."""

    def authorize(
        self, context: RequestContext, request: AnyRequest, served: ServedUnit | None
    ) -> ExceptionResponse | None:
        """Return None to permit a request, or the exception reply that refuses it. Sets `RequestContext.judged`.

        ``served`` is what `Responder.serves` returned for the unit asked.
        """


class RequestObserver(Protocol):
    """Observer of requests and their outcomes, without influence on them. Seconds count from a request's arrival."""

    def answered(self, client: ClientIdentity, replies: Sequence[bytes], seconds: float) -> None:
        """Called with replies of the fast path, as Modbus TCP frames, also if the client uses another framing.

        ``seconds``: for forwarded reads the sum of their times; otherwise the time that computing all of them took.
        """

    def unanswered(self, client: ClientIdentity, requests: int) -> None:
        """Called when a client disconnected before its forwarded reads were answered; ``requests`` is their number."""

    def ended(
        self, context: RequestContext, request: AnyRequest, outcome: Message | Deferral | None, seconds: float
    ) -> None:
        """Called with the outcome of a request that the fast path did not answer.

        The outcome is a reply, `SILENCE` if there is none (as for a broadcast), or None if the client disconnected
        before it. Not called for requests with function 0 or above 127, refused with 06 because too many were in
        progress, or answered 04 because decoding failed.
        """


@dataclass(frozen=True, slots=True)
class ResponderFailure:
    """An exception other than `Refusal` that decoding, authorizing or answering a request raised.

    The client was answered 04, unless the request is one that gets no reply.
    """

    context: RequestContext
    error: Exception


class RequestPipeline:
    """The processing of every request of a listener: authorizer, then responder; observers are told the outcome.

    Args:
        responder: answers permitted requests.
        authorizer: permits requests; None permits all.
        observers: are told what becomes of requests.
        clock: returns the time in seconds, to measure the durations that observers get.
    """

    def __init__(
        self,
        responder: Responder,
        authorizer: Authorizer | None = None,
        observers: Sequence[RequestObserver] = (),
        clock: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.responder = responder
        self.authorizer = authorizer
        self.observers: tuple[RequestObserver, ...] = tuple(observers)
        self.clock = clock
        self._decode = responder.functions.decode_request
        self._answer = responder.answer
        self._fast: dict[ClientRights | None, FastPath] = {}
        self._fast_of = self.generation

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the responder knows."""
        return self.responder.functions

    @property
    def generation(self) -> int:
        """A number that changes when a fast path returned by `fast_path` is no longer valid."""
        authorizer = self.authorizer
        return self.responder.generation if authorizer is None else self.responder.generation + authorizer.generation

    def fast_path(self, client: ClientIdentity) -> "FastPath":
        """Return the fast path of a client: the functions that answer its requests from their bytes.

        Clients with the same rights share one. A session calls this again when `generation` has changed.
        """
        generation = self.generation
        if self._fast_of != generation or len(self._fast) > _MOST_RIGHTS:
            self._fast, self._fast_of = {}, generation
        rights = None if self.authorizer is None else self.authorizer.rights_of(client)
        found = self._fast.get(rights)
        if found is None:
            found = self._fast[rights] = FastPath(self.responder, rights)
        return found

    def answer(self, context: RequestContext, pdu: bytes, failures: list[ResponderFailure]) -> ResponderAnswer:
        """Decode a request that the fast path did not answer, authorize it, and return the outcome of the responder.

        It is an exception reply if the request is not permitted or the responder raises `Refusal`; 01 for function 0.
        Any other exception is added to ``failures``, and the outcome is exception reply 04. For a unit in listen-only
        mode it is `SILENCE`, also for the request of function 08 that begins or ends this mode.
        """
        function = context.function
        was_listen_only = context.diagnostics.listen_only
        if not function:
            return SILENCE if was_listen_only else ExceptionResponse(0, ExceptionCode.ILLEGAL_FUNCTION)
        try:
            request = self._decode(pdu)
            if self.observers:
                context.watch(partial(self._ended, context, request, self.clock()))
            outcome: ResponderAnswer | None = None
            if was_listen_only and function != _DIAGNOSTICS:
                outcome = SILENCE
            elif self.authorizer is not None:
                outcome = self.authorizer.authorize(context, request, self.responder.serves(context.unit))
            if outcome is None:
                outcome = self._answer(context, request)
        except Refusal as refusal:
            outcome = ExceptionResponse(function, refusal.code)
        except Exception as error:
            failures.append(ResponderFailure(context, error))
            outcome = ExceptionResponse(function, ExceptionCode.SERVER_DEVICE_FAILURE)
        if was_listen_only or (function == _DIAGNOSTICS and context.diagnostics.listen_only):
            # 08 is answered neither when it mutes the unit nor when it wakes it. No device answers a broadcast.
            outcome = outcome if context.executed is not None else SILENCE
        if self.observers:
            if isinstance(outcome, Message) or outcome is SILENCE:
                context.end(outcome)
            elif context.executed is not None and (outcome is LATER or isinstance(outcome, Forwarding)):
                context.end(SILENCE)  # a broadcast: no device replies to it
        return outcome

    def answered(self, client: ClientIdentity, replies: Sequence[bytes], began: float) -> None:
        """Report replies of the fast path to the observers; ``began`` is when their requests arrived, by ``clock``."""
        seconds = self.clock() - began
        for observer in self.observers:
            observer.answered(client, replies, seconds)

    def forwarded(self, client: ClientIdentity, replies: Sequence[bytes], seconds: float) -> None:
        """Report replies to forwarded reads to the observers; each took ``seconds``."""
        together = seconds * len(replies)
        for observer in self.observers:
            observer.answered(client, replies, together)

    def unanswered(self, client: ClientIdentity, requests: int) -> None:
        """Tell the observers that a client disconnected before ``requests`` of its forwarded reads were answered."""
        for observer in self.observers:
            observer.unanswered(client, requests)

    def _ended(
        self, context: RequestContext, request: AnyRequest, began: float, outcome: Message | Deferral | None
    ) -> None:
        for observer in self.observers:
            observer.ended(context, request, outcome, self.clock() - began)


class BoundAnswer:
    """How requests with the same length, unit and function code are answered.

    Args:
        answer: computes the reply PDU (`busway.pdu.fast_answers`); None where all requests take the generic path.
        key: the six bytes of such requests after their transaction: protocol 0, length, unit and function code.
        echoes: whether the reply repeats the request.

    Attributes:
        answer, echoes: as given.
        size: bytes of such a request on TCP, with its header.
        unit: the unit asked.
        is_learnt: whether these are reads of which `FastPath.reads` keeps the answer to each single one.
    """

    __slots__ = ("answer", "echoes", "is_learnt", "size", "unit")

    def __init__(self, answer: FastAnswer | None, key: bytes, *, echoes: bool) -> None:
        self.answer: FastAnswer | None = answer
        self.size: int = _BEFORE_UNIT + int.from_bytes(key[2:4])
        self.unit: int = key[4]
        self.echoes: bool = echoes
        self.is_learnt: bool = answer is not None and key[5] in PREPARED


class FastPath:
    """Cache of functions that answer requests from their bytes, for all clients with the same rights.

    Attributes:
        reads: how reads of registers are answered, by the ten bytes after the transaction identifier: a poller sends
            the same reads again and again.
        functions: how other requests are answered, by the six bytes after the transaction identifier: protocol 0,
            length, unit and function code.
        frames: like ``reads``, for RTU frames over a network, by all their eight bytes: the CRC of a frame found here
            need not be checked.
        forwards: reads that a gateway forwards, by the same ten bytes as ``reads``.
    """

    __slots__ = ("_answers", "_responder", "_rights", "forwards", "frames", "functions", "reads")

    def __init__(self, responder: Responder, rights: ClientRights | None) -> None:
        self._responder = responder
        self._rights = rights
        self._answers: dict[bytes, tuple[FastAnswer | None, bool]] = {}  # by unit and function code, for all lengths
        self.reads: dict[bytes, PreparedAnswer] = {}
        self.frames: dict[bytes, PreparedFrame] = {}
        self.functions: dict[bytes, BoundAnswer] = {}
        self.forwards: PreparedForwards = PreparedForwards()

    def bind(self, key: bytes) -> BoundAnswer:
        """Find out how requests are answered that have the six bytes ``key`` after the transaction; store it.

        ``key`` has protocol 0 and a valid length. If 4096 are stored already, they are forgotten first.
        """
        if len(self.functions) >= _MOST_FUNCTIONS:
            self.functions.clear()
            self._answers.clear()
        whose = key[4:]
        found = self._answers.get(whose)  # one look-up: `NO_FAST_PATH` is shared by the servers of all threads
        if found is None:
            found = self._answers[whose] = self._bound(*whose)
        answer, echoes = found
        bound = self.functions[key] = BoundAnswer(answer, key, echoes=echoes)
        return bound

    def _bound(self, unit: int, function: int) -> tuple[FastAnswer | None, bool]:
        """Return the function that answers a function code of a unit, and whether the reply repeats the request."""
        served, kind = self._direct(unit, function)
        if served is None or served.device is None or kind is None or kind.sub_code is not None:
            return None, False
        answer = kind.direct(served.device) if self._rights is None else self._rights.bind(unit, served, kind)
        return answer, kind.echoes

    def learn_read(self, adu: bytes) -> bool:
        """Store how to answer a read that was just answered by the function for its unit and function code.

        ``adu`` is the whole request on TCP. Next time its bytes alone suffice. Nothing is stored if that is not
        possible, for example because the read is not always permitted. Returns whether there is room for more reads.
        """
        prepared = self._prepared_answer(adu[6], adu[7:])
        if prepared is not None:
            self.reads[adu[2:]] = prepared
        return len(self.reads) < MOST_READS

    def learn_frame(self, frame: bytes, prepare: "Callable[[PreparedAnswer], PreparedFrame]") -> None:
        """Store how to answer an RTU frame of eight bytes, whose read was just answered: next time its bytes suffice.

        ``prepare`` is the class `PreparedFrame`; it is passed in, so that a server without RTU imports no CRC tables.
        Nothing is stored if the read is not always permitted, or if `MOST_READS` frames are stored already.
        """
        if len(self.frames) < MOST_READS:
            prepared = self._prepared_answer(frame[0], frame[1:-2])
            if prepared is not None:
                self.frames[frame] = prepare(prepared)

    def can_forward(self, forwarder: ReadForwarder, context: RequestContext, adu: bytes) -> bool:
        """Find out how a read that is not known yet is forwarded, and store that in ``forwards``.

        Returns True if from now on this read is forwarded on the fast path. False if it takes the generic path, if it
        was known before, or if ``adu`` is no read.
        """
        key = adu[2:]
        if not is_read(adu) or key in self.forwards:
            return False  # a known read comes here if no slot is left, or it needs the generic path
        prepared: PreparedForward | None = None
        if self._permits(context.unit, self._responder.serves(context.unit), adu[7:]):
            prepared = forwarder.prepared_forward(context, adu[7:])
        self.forwards.learn(key, prepared)
        return prepared is not None

    def _prepared_answer(self, unit: int, pdu: bytes) -> PreparedAnswer | None:
        served, kind = self._direct(unit, pdu[0])
        if served is None or served.device is None or kind is None:
            return None
        prepared = kind.prepared_answer(served.device, unit, pdu)
        return prepared if prepared is not None and self._permits(unit, served, pdu) else None

    def _direct(self, unit: int, function: int) -> tuple[ServedUnit | None, type[Request] | None]:
        """Return unit and request class for a function code, if the unit's device can answer it from bytes.

        (None, None) if it cannot; the class alone is None if the function is not in the table.
        """
        served = self._responder.serves(unit)
        if served is None or served.device is None or not served.is_direct or not served.device.enabled(function):
            return None, None
        return served, self._responder.functions.find(bytes((function,)), 0, 1)

    def _permits(self, unit: int, served: ServedUnit | None, pdu: bytes) -> bool:
        if self._rights is None:
            return True
        return self._rights.permits_prepared(unit, served, self._responder.functions.decode_request(pdu))


class _NoUnits:
    """The responder of a server without units; it answers nothing."""

    functions = STANDARD
    generation = 0

    def serves(self, unit: int) -> ServedUnit | None:
        """Return None: there are no units."""
        return None

    def answer(self, context: RequestContext, request: AnyRequest) -> ResponderAnswer:
        """Return `SILENCE`: the request gets no reply."""
        return SILENCE


NO_FAST_PATH: Final = FastPath(_NoUnits(), None)
"""A fast path that answers no request: used while a unit of the listener is in listen-only mode."""
