"""A handler that wraps another, and counts its answers and their durations.

Knows outcomes; knows nothing of the content of requests, nor of how counts are shown.

1. Every request that the inner handler answers is counted once, when the answer is there: at once, by the compiled
   path, or later. Requests that a session answers without a handler (06 while all slots are taken, function 0) are
   counted by the server.
2. The compiled path stays short: each compiled answer gets a closure around it that counts. Read plans are not offered,
   because their use would not be seen.
3. It changes no outcome.
"""

import time
from collections.abc import Callable, Container, Mapping
from typing import Final

from ...codes import ExceptionCode
from ...pdu.direct import Answer
from ...pdu.functions import AnyRequest, FunctionTable
from ...pdu.general import ExceptionResponse
from ...pdu.message import Message
from ...session.handler import LATER, Deferral, Handler, ListedUnits, Outcome, Refusal, RequestContext, UnitHolder
from .requests import Durations, PeerClass, RequestTally, Series, Unanswered

Classify = Callable[[RequestContext], PeerClass]

_MEMO_LIMIT: Final = 512
_LINES: Final = ("rtu://", "ascii://")


class ClassifyByMark:
    """`PeerClass.PRIORITY` for priority hosts; otherwise as `classify_by_listener`.

    Args:
        is_priority: whether the host of a peer's address has priority at a listener; asked once for each peer.
    """

    def __init__(self, is_priority: Callable[[str, str], bool]) -> None:
        self._is_priority = is_priority
        self._memo: dict[tuple[str, str], PeerClass] = {}

    def __call__(self, context: RequestContext) -> PeerClass:
        """The class of whoever asks."""
        key = context.listener, context.peer.rpartition(":")[0].strip("[]")
        found = self._memo.get(key)
        if found is None:
            if len(self._memo) >= _MEMO_LIMIT:
                self._memo.clear()
            found = PeerClass.PRIORITY if self._is_priority(*key) else classify_by_listener(context)
            self._memo[key] = found
        return found


def classify_by_listener(context: RequestContext) -> PeerClass:
    """`PeerClass.LINE` on serial lines, otherwise `PeerClass.OTHER`."""
    return PeerClass.LINE if context.listener.startswith(_LINES) else PeerClass.OTHER


class MeteredHandler:
    """A handler that counts for another one, and passes everything else through.

    Args:
        inner: the handler that answers.
        tally: the counts; by default new ones for the inner handler's functions.
        classify: returns the class of a client.
        clock: seconds, of which only differences count.
    """

    listed_unit: Callable[[int], int]

    def __init__(
        self,
        inner: Handler,
        tally: RequestTally | None = None,
        *,
        classify: Classify = classify_by_listener,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.inner = inner
        if isinstance(inner, ListedUnits):  # set only where the handler inside has it
            self.listed_unit = inner.listed_unit
        self.tally: RequestTally = tally or RequestTally(inner.functions.codes())
        self._classify = classify
        self._clock = clock
        self._generation = inner.generation
        self._memo: dict[tuple[PeerClass, int, int], tuple[Mapping[int, Answer], Mapping[int, Answer]]] = {}

    @property
    def functions(self) -> FunctionTable:
        """Of the inner handler."""
        return self.inner.functions

    @property
    def generation(self) -> int:
        """Of the inner handler."""
        return self.inner.generation

    def direct(self, context: RequestContext) -> Mapping[int, Answer]:
        """The inner handler's compiled path, each answer with a counter around it."""
        if self._generation != self.inner.generation or len(self._memo) >= _MEMO_LIMIT:
            self._generation = self.inner.generation
            self._memo.clear()
        answers = self.inner.direct(context)
        if not answers:
            return answers
        peer_class = self._classify(context)
        key = (peer_class, context.unit, id(answers))
        known = self._memo.get(key)
        if known is None:  # ``answers`` is kept, so that no other mapping takes its id
            counted = {code: self._counted(answer, peer_class, context.unit, code) for code, answer in answers.items()}
            known = self._memo[key] = answers, counted
        return known[1]

    def handle(self, context: RequestContext, request: AnyRequest) -> Outcome:
        """Have the inner handler answer; count when it has."""
        if context.executed is not None:  # a broadcast: each unit executes it, and none answers
            self.tally.unanswered(Unanswered.BROADCAST)
            return self.inner.handle(context, request)
        waiting = _Waiting(self, context)
        context.watch(waiting.finished)
        try:
            outcome = self.inner.handle(context, request)
        except Refusal as refusal:
            waiting.answered(refusal.code)
            raise
        except Exception:
            waiting.answered(ExceptionCode.SERVER_DEVICE_FAILURE)
            raise
        if isinstance(outcome, Message | Deferral) and outcome is not LATER:
            waiting.finished(outcome)
        else:
            waiting.watch_departure()
        return outcome

    def _counted(self, answer: Answer, peer_class: PeerClass, unit: int, function: int) -> Answer:
        tally, clock = self.tally, self._clock
        series: Series | None = None  # made when the first answer is there: most functions of a unit are never asked
        durations: Durations | None = None

        def counted(buffer: bytes | bytearray, at: int, end: int) -> bytes | None:
            nonlocal series, durations
            began = clock()
            reply = answer(buffer, at, end)
            if reply is None:
                return None
            if series is None or durations is None:
                series, durations = tally.series(peer_class, unit, function), tally.durations(function)
            durations.add(clock() - began)
            if reply[0] < 0x80:
                series.count += 1
            else:
                tally.series(peer_class, unit, function, reply[1]).count += 1
            return reply

        return counted


class MeteredUnitHolder(MeteredHandler):
    """A `MeteredHandler` around a handler with a list of units, which a serial line needs."""

    @property
    def serial_units(self) -> Container[int]:
        """Of the inner handler."""
        assert isinstance(self.inner, UnitHolder)
        return self.inner.serial_units


def metered(
    inner: Handler, tally: RequestTally | None = None, *, classify: Classify = classify_by_listener
) -> MeteredHandler:
    """A `MeteredHandler` that offers a serial line what the inner handler offers."""
    kind = MeteredUnitHolder if isinstance(inner, UnitHolder) else MeteredHandler
    return kind(inner, tally, classify=classify)


class _Waiting:
    """A request from the call of the handler until it has been counted, once."""

    __slots__ = ("_began", "_context", "_is_counted", "_metered", "_was_muted")

    def __init__(self, metered: MeteredHandler, context: RequestContext) -> None:
        self._metered = metered
        self._context = context
        self._was_muted = _is_muted(context)
        self._is_counted = False
        self._began = metered._clock()

    def finished(self, reply: Message | Deferral) -> None:
        """Count the request, now that its outcome is known."""
        if not isinstance(reply, Message):
            self._unanswered(Unanswered.SILENT)
        else:
            self.answered(reply.exception if isinstance(reply, ExceptionResponse) else None)

    def answered(self, exception: int | None) -> None:
        """The answer is there, whether an exception or none; in listen-only mode it does not leave."""
        context = self._context
        if self._was_muted or _is_muted(context):
            self._unanswered(Unanswered.SILENT)
        elif not self._is_counted:
            self._is_counted = True
            tally = self._metered.tally
            peer_class = self._metered._classify(context)
            tally.series(peer_class, context.unit, context.function, exception).count += 1
            tally.durations(context.function).add(self._metered._clock() - self._began)

    def watch_departure(self) -> None:
        """The answer comes later, unless the client goes away."""
        if self._is_counted:
            return  # the handler has replied before it returned
        before = self._context.gone

        def gone() -> None:
            self._unanswered(Unanswered.GONE)
            if before is not None:
                before()

        self._context.gone = gone

    def _unanswered(self, why: Unanswered) -> None:
        if not self._is_counted:
            self._is_counted = True
            self._metered.tally.unanswered(why)


def _is_muted(context: RequestContext) -> bool:
    """Whether the unit asked is in listen-only mode."""
    return context.diagnostics.listen_only
