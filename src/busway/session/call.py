"""What a user application asks for: one request or many of one unit, and what became of them.

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
    """Requests of one unit, asked for in one call; they complete together.

    Attributes:
        unit: unit identifier, 0…255.
        requests: what is asked, in order.
        caller: whoever asks; the queue is fair between callers.
        timeout: seconds per attempt.
        deadline: when the whole must have ended, in the clock of ``now``; None for never.
        retries: further attempts of each request.
        idempotent: whether its writes may be executed twice, so that they are repeated like reads.
        is_write: whether one of the requests may change something.
        outcomes: for each request the reply or the error, None while it is open.
        open: how many requests have no outcome yet.
        ended: whether it is finished or cancelled.
        submitted: when it was asked for.
        owner: whatever the driver wants to find here again.
        attempts: attempts begun, by position; only positions that were tried more than once appear.
        markers: requests of the session's own that its unit did not answer while this call waited for it.
        repeated: further attempts that were no retries: the reply before them may have been the right one.
        places: how many places of the queue it takes. A call takes one, whatever it asks; what a gateway asks for a
            client takes one for each request.
    """

    # What most calls never set are class attributes, shared until they are: building a demand takes 0.5 µs so, and
    # 1.1 µs with sixteen slots to fill. Named arguments of a class cost Python 0.6 µs more than those by position.
    caller: object = None
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
    repeated: int = 0

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
        self.open = len(requests)
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
        """Position of the request that is sent next. Only while there is one."""
        return self.again[0] if self.again else self.next

    def take(self, at_most: int) -> Sequence[int]:
        """Positions of the next requests to send, ``at_most`` of them: first what is repeated, then what is new."""
        if self.again:
            taken, self.again = self.again[:at_most], self.again[at_most:]
            return taken
        first = self.next
        self.next = min(first + at_most, len(self.requests))
        return range(first, self.next)

    def repeat(self, position: int) -> None:
        """Let a request be sent once more."""
        self.attempts = {**self.attempts, position: self.attempts.get(position, 1) + 1}
        self.again = (*self.again, position)

    @property
    def error(self) -> ModbusError | None:
        """The first error among the outcomes."""
        return next((outcome for outcome in self.outcomes if isinstance(outcome, ModbusError)), None)
