"""Retries of a link's calls, their deadlines, and the outcome of each request: reply, error or `WriteOutcomeUnknown`.

The same for all sessions. Knows the queue, retries and the errors a request ends with; knows no framing, and no reply.

1. A read is repeated after a timeout or a lost connection. A write that was sent is repeated only if ``write_retries``
   says so or its call is ``idempotent``; otherwise it ends as `WriteOutcomeUnknown`.
2. Every request gets exactly one outcome. A call whose requests all have their outcome is in ``finished``.
3. A call may have a deadline; time in the queue counts. Requests in the queue are ended here, requests in flight by the
   session (`tcp_client`, `serial_client`).
"""

from collections.abc import Callable, Collection
from typing import Final

from ..errors import LinkDown, ModbusError, NoReply, Overloaded, UnitSuspended, WriteOutcomeUnknown
from ..options.client import ClientParameters
from ..pdu.message import Message, Request
from .call import Call
from .client_counters import ClientCounters
from .queue import RequestQueue

_INTERRUPTED: Final = "the connection ended before the reply: another call was interrupted"


class CallTracker:
    """The calls of one link: decides about retries and gives every request its outcome.

    Attributes:
        endpoint: URL of the link, for errors.
        parameters: retries and the limit of the queue.
        queue: calls with requests left to send.
        counters: counters of the link.
        finished: calls whose requests all have an outcome; the driver empties the list.
        deadlines: how many open calls have a deadline.
    """

    __slots__ = ("counters", "deadlines", "endpoint", "finished", "parameters", "queue")

    def __init__(self, parameters: ClientParameters, endpoint: str) -> None:
        self.endpoint: str = endpoint
        self.parameters: ClientParameters = parameters
        self.queue: RequestQueue = RequestQueue(parameters.queue)
        self.counters: ClientCounters = ClientCounters()
        self.finished: list[Call] = []
        self.deadlines: int = 0

    def submit(self, call: Call, now: float) -> None:
        """Queue a call and start to track it.

        Raises:
            Overloaded: the queue is full; nothing was sent.
        """
        try:
            self.queue.add(call)
        except Overloaded as error:
            self.counters.overloaded += 1
            error.at(endpoint=self.endpoint or None, unit=call.unit)
            raise
        self.begin(call, now)

    def begin(self, call: Call, now: float) -> None:
        """Start to track a call that is sent without queueing; a queued call is tracked by `submit`."""
        call.submitted = now
        if call.deadline is not None:
            self.deadlines += 1

    def begin_again(self) -> None:
        """Forget all calls: an exception such as KeyboardInterrupt may have left them inconsistent.

        `resume` adds a call again.
        """
        self.queue.clear()
        self.finished.clear()
        self.deadlines = 0

    def resume(self, call: Call, now: float) -> None:
        """Add a call again after `begin_again`, with the outcomes that it has; its connection was lost meanwhile.

        Requests that were sent are repeated or fail as after any lost connection (`failed`). The others are queued,
        even if the queue is full.
        """
        call.open = call.outcomes.count(None)
        if call.deadline is not None:
            self.deadlines += 1
        if not call.open:
            self.finish(call)
            return
        if call.has_more:
            self.queue.add_again(call)
        for position in range(call.next):
            if call.outcomes[position] is None and position not in call.again:
                error = LinkDown(_INTERRUPTED, kind="lost", sent=True)
                self.failed(call, position, error, now, again=True)

    def withdraw(self, call: Call) -> None:
        """Remove a cancelled call from the queue: no more requests of it are sent, and it is never in ``finished``."""
        self.queue.remove(call)
        if call.open and not call.ended:
            self.counters.cancelled += 1
            call.ended = True
            if call.deadline is not None:
                self.deadlines -= 1

    def give_up(
        self,
        call: Call,
        now: float,
        reason: Callable[[], ModbusError],
        in_flight: Collection[tuple[int, int]] = (),
    ) -> None:
        """End all requests of a call that are not in flight, each with an error of its own, created by ``reason``.

        A write that was sent before ends as `WriteOutcomeUnknown`, with that error as its cause. The call leaves the
        queue. Outcomes that it has already stay. ``in_flight`` holds (``id`` of the call, position) of the requests in
        flight; those go on.
        """
        self.queue.remove(call)
        for position, outcome in enumerate(call.outcomes):
            if outcome is None and (id(call), position) not in in_flight:
                self._given_up(call, position, reason(), now)

    def suspended(self, call: Call, pause: float, timeouts: int) -> UnitSuspended:
        """Create the error for a request to a unit whose circuit breaker is open, and count it.

        Args:
            call: the call of the request.
            pause: seconds until the unit may be asked again.
            timeouts: how often in a row the unit did not answer.
        """
        self.counters.suspended += 1
        return UnitSuspended(
            f"not asked: it did not answer {timeouts} times in a row; it may be asked again in {pause:.1f} s",
            next_probe=pause,
            endpoint=self.endpoint or None,
            unit=call.unit,
            function=function_of(call.requests[0]),
        )

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """End every call in the queue, because no connection could be opened.

        Each open request gets a copy of ``error``; a write that was sent before ends as `WriteOutcomeUnknown`. If
        ``keep_repeated``, a call of which a request is about to be repeated stays in the queue.
        """
        kind = error.kind if isinstance(error, LinkDown) else "other"
        for call in list(self.queue):
            if keep_repeated and call.again:
                continue
            self.queue.remove(call)
            for position, outcome in enumerate(call.outcomes):
                if outcome is None:
                    copy = LinkDown(error.message, kind=kind, sent=position in call.attempts)
                    copy.__cause__ = error.__cause__
                    self._given_up(call, position, copy, now)

    def next_deadline(self) -> float | None:
        """Return the earliest deadline among the calls in the queue; None if no queued call has a deadline."""
        if not self.deadlines:
            return None
        return min((one.deadline for one in self.queue if one.deadline is not None), default=None)

    def expire_queue(
        self,
        now: float,
        in_flight: set[tuple[int, int]],
        reason: Callable[[Call], NoReply | None] = lambda call: None,
    ) -> None:
        """End the calls in the queue whose deadline has passed: their requests fail with `NoReply`.

        A write that was sent before ends as `WriteOutcomeUnknown`.

        Args:
            now: the time.
            in_flight: (``id`` of the call, position) of the requests in flight; these are not ended here.
            reason: called with the call for each request that was never sent; returns the error, or None for the usual
                one.
        """
        if not self.deadlines:
            return
        for call in list(self.queue):
            if call.deadline is None or now < call.deadline:
                continue
            self.queue.remove(call)
            for position, outcome in enumerate(call.outcomes):
                if outcome is None and (id(call), position) not in in_flight:
                    tried = call.attempts.get(position)
                    error = (None if tried else reason(call)) or NoReply(
                        "no answer before the deadline of the call"
                        if tried
                        else "the deadline passed in the queue; nothing was sent"
                    )
                    self._given_up(call, position, error, now)

    def _given_up(self, call: Call, position: int, error: ModbusError, now: float) -> None:
        """End a request that will not be sent, or not once more; a write sent before ends as `WriteOutcomeUnknown`."""
        if position in call.attempts:
            error.attempt = call.attempts[position] - 1  # the one after it was never begun
        if error.attempt and call.requests[position].is_write:
            self._unknown(call, position, error, now)
        else:
            self.conclude(call, position, self.placed(error, call, position, now))

    def failed(self, call: Call, position: int, error: ModbusError, now: float, *, again: bool) -> None:
        """Handle a sent request without valid answer: repeat it while attempts are left, else end it with ``error``.

        A read, or an idempotent write, has the call's ``retries``; another write has the link's ``write_retries``.
        ``again`` False forbids a repetition. A write ends as `WriteOutcomeUnknown`, with ``error`` as its cause,
        because it may have been executed.
        """
        request = call.requests[position]
        attempt = call.attempts.get(position, 1)
        guarded = request.is_write and not call.idempotent
        retries = call.repeated.get(position, 0) + (self.parameters.write_retries if guarded else call.retries)
        if again and attempt <= retries and not call.ended:
            self._again(call, position)
            return
        error.attempt = attempt
        if request.is_write:
            self._unknown(call, position, error, now)
        else:
            self.conclude(call, position, self.placed(error, call, position, now))

    def repeat(self, call: Call, position: int) -> None:
        """Repeat a read whose reply was not used, because it may have been a late one.

        The repetition does not use up one of the call's ``retries``, but the link's counter ``retries`` includes it.
        """
        call.repeated = {**call.repeated, position: call.repeated.get(position, 0) + 1}
        self._again(call, position)

    def _again(self, call: Call, position: int) -> None:
        call.repeat(position)
        self.counters.retries += 1
        self.queue.add_again(call)

    def _unknown(self, call: Call, position: int, error: ModbusError, now: float) -> None:
        unknown = WriteOutcomeUnknown(
            "the write was sent and may have been executed; no valid answer came",
            attempt=error.attempt,
            raw=error.raw,
        )
        unknown.__cause__ = self.placed(error, call, position, now)
        self.conclude(call, position, self.placed(unknown, call, position, now))

    def placed(self, error: ModbusError, call: Call, position: int, now: float) -> ModbusError:
        """Add endpoint, unit, function, address, attempt and elapsed time to an error, and return it."""
        request = call.requests[position]
        spans = request.spans()
        return error.at(
            endpoint=self.endpoint or None,
            unit=call.unit,
            function=function_of(request),
            address=spans[0].address if spans else None,
            attempt=call.attempts.get(position),
            elapsed=now - call.submitted,
        )

    def conclude(self, call: Call, position: int, outcome: Message | ModbusError) -> None:
        """Set the outcome of one request.

        If no request of the call is open any more, the call is added to ``finished``.
        """
        call.outcomes[position] = outcome
        call.open -= 1
        if not call.open:
            self.finish(call)

    def finish(self, call: Call) -> None:
        """End a call whose requests all have their outcome: add it to ``finished``. Call once for each call."""
        self.finished.append(call)
        call.ended = True
        if call.deadline is not None:
            self.deadlines -= 1


def function_of(request: Request) -> int:
    """Return the function code of a request; encodes the request if that was not done yet."""
    return request.wire[0] if hasattr(request, "wire") else request.prepare()[0]
