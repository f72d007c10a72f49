"""A call of the application: one or many requests to one unit, and their outcomes.

Knows its own progress; knows no connection and no bytes (Messaging on TCP/IP V1.0b §4.4.1: "user application demand").
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from ..errors import ModbusError
from ..pdu.message import Message, Request

Outcome = Message | ModbusError


_NO_ATTEMPTS: Mapping[int, int] = MappingProxyType({})


class Call:
    """One or many requests to one unit that complete together.

    Attributes:
        unit: unit identifier, 0…255.
        requests: the requests, in order.
        caller: identifies the caller; the queue is fair between callers.
        is_priority: whether a gateway asks it for a priority host; the queue serves those first.
        timeout: seconds per attempt.
        deadline: when the whole call must have ended, in the clock of ``now``; None for no limit.
        retries: further attempts of each request.
        idempotent: whether its writes may be executed twice, so that they are repeated like reads.
        is_write: whether one of the requests may change something.
        outcomes: for each request the reply or the error, None while it is open.
        open: how many requests have no outcome yet.
        ended: whether it is finished or cancelled.
        submitted: when the call was made, in the clock of ``now``.
        owner: an object that the driver stores here to find its caller again.
        attempts: attempts begun, by position; only positions that were tried more than once appear.
        markers: marker requests (`busway.session.doubt`) that its unit did not answer while this call waited.
        repeated: by position, further attempts of a read that are no retries: the reply before may have been its own.
        places: how many places of the queue it takes: one for an application's call, whatever its requests; one for
            each request if a gateway makes the call for a client.
    """

    # Attributes that most calls never set are class attributes: building a call then takes 0.5 µs, instead of
    # 1.1 µs with sixteen slots to fill. Keyword arguments cost 0.6 µs more than positional ones.
    caller: object = None
    is_priority: bool = False
    deadline: float | None = None
    idempotent: bool = False
    owner: Any = None  # Any: only the driver that put it in takes it out
    next: int = 0
    again: Sequence[int] = ()
    attempts: Mapping[int, int] = _NO_ATTEMPTS
    submitted: float = 0.0
    ended: bool = False
    places: int = 1
    markers: int = 0
    repeated: Mapping[int, int] = _NO_ATTEMPTS

    def __init__(
        self,
        unit: int,
        requests: Sequence[Request],
        is_write: bool,
        timeout: float,
        retries: int,
        idempotent: bool = False,
        caller: object = None,
        deadline: float | None = None,
    ) -> None:
        self.unit = unit
        self.requests = requests
        self.timeout = timeout
        self.retries = retries
        self.is_write = is_write
        self.open: int = len(requests)
        self.outcomes: list[Outcome | None] = [None] * self.open
        if idempotent:
            self.idempotent = True
        if caller is not None:
            self.caller = caller
        if deadline is not None:
            self.deadline = deadline

    @property
    def has_more(self) -> bool:
        """Whether a request waits to be sent."""
        return self.next < len(self.requests) or bool(self.again)

    @property
    def next_position(self) -> int:
        """Position of the request that is sent next. Valid only while `has_more`."""
        return self.again[0] if self.again else self.next

    def take(self, at_most: int) -> Sequence[int]:
        """Take the positions of up to ``at_most`` next requests to send: first repetitions, then new ones."""
        if self.again:
            taken, self.again = self.again[:at_most], self.again[at_most:]
            return taken
        first = self.next
        self.next = min(first + at_most, len(self.requests))
        return range(first, self.next)

    def repeat(self, position: int) -> None:
        """Queue a request of this call to be sent once more."""
        self.attempts = {**self.attempts, position: self.attempts.get(position, 1) + 1}
        self.again = (*self.again, position)

    @property
    def error(self) -> ModbusError | None:
        """The first error among the outcomes."""
        return next((outcome for outcome in self.outcomes if isinstance(outcome, ModbusError)), None)
