"""Calls of the application, and their requests in flight over TCP, except those of pipelined batches.

A call is one or many requests to one unit, with their outcomes (Messaging on TCP/IP V1.0b §4.4.1: "user application
demand"). Knows its own progress and the layout of an ADU; knows no connection and no queue. Retries and the errors
that end a request are in `call_retries_and_deadlines`; requests that are sent together in `pipelined_batch`.

1. What does not depend on transaction identifiers is computed once and kept with the requests (`Request.memo`): a
   poller sends the same requests again and again.
2. A reply is recognised by its transaction identifier and the seven bytes after it: protocol, length, unit, function,
   byte count.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from functools import lru_cache
from operator import attrgetter
from types import MappingProxyType
from typing import Any, TypedDict

from ..errors import InvalidRequest, ModbusError
from ..options.client import ClientParameters
from ..pdu.message import Message, Request

RequestOutcome = Message | ModbusError

_NO_ATTEMPTS: Mapping[int, int] = MappingProxyType({})
_IS_WRITE = attrgetter("is_write")
_BEHIND = struct.Struct(">HHB")
"""Layout of the five bytes between transaction identifier and function code: protocol, length and unit identifier."""
_NEVER_RECEIVED = 1 << 24
"""A number of bytes that no receive buffer has."""


class CallOptions(TypedDict, total=False):
    """Options that every read and write of a unit accepts, as keyword arguments of one call.

    Without ``timeout``, ``retries`` or ``deadline`` the option of the link applies; so it does if one of them is None,
    or ``timeout`` or ``deadline`` is 0.

    timeout: seconds per attempt, above 0 and at most 3600. retries: further attempts of each read, 0…100, and of each
    write if ``idempotent``. deadline: seconds for the whole call, time in the queue included. idempotent: True if
    executing the write twice does no harm, so that it is repeated like a read; False if left out.
    """

    timeout: float | None
    retries: int | None
    deadline: float | None
    idempotent: bool


class Call:
    """What an application asks in one go: requests to one unit, one or many, that complete together.

    Attributes:
        unit: unit identifier, 0…255.
        requests: the requests, in order.
        caller: identifies the caller; the queue is fair between callers.
        is_priority: whether a gateway makes the call for a priority host; the queue serves those first.
        timeout: seconds per attempt.
        deadline: when the whole call must have ended, in the clock of ``now``; None for no limit.
        retries: most further attempts of each read; of a write only if ``idempotent``.
        idempotent: whether its writes may be executed twice, so that they are repeated like reads.
        is_write: whether one of the requests is a write.
        outcomes: for each request its reply or error; None while it has neither.
        open: how many requests have no outcome yet.
        ended: whether the call is finished or cancelled.
        submitted: when the call was queued, or sent without queueing, in the clock of ``now``; 0 before that.
        owner: an object that the driver stores here to find its caller again.
        next: position of the first request that was never sent; the number of requests if all were sent.
        again: positions of requests that were sent and have to be sent once more.
        attempts: for repeated requests only, by position: the number of the present attempt, 2 or more.
        markers: number of marker requests (`busway.session.serial_late_replies`) that its unit did not answer while
            this call waited.
        repeated: by position, number of repetitions of a read that do not count as retries, because the reply was not
            used: it could have been a late one.
        places: how much of the queue's limit the call uses while it is queued: 1 for an application's call, whatever
            its requests; 1 for each request that waits to be sent if a gateway makes the call for a client.
    """

    # Attributes that most calls never set are class attributes: building a call then takes 0.5 µs, instead of
    # 1.1 µs with sixteen slots to fill. Keyword arguments cost 0.6 µs more than positional ones.
    caller: object = None
    is_priority: bool = False
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
        self.outcomes: list[RequestOutcome | None] = [None] * self.open
        self.deadline = deadline
        if idempotent:
            self.idempotent = True
        if caller is not None:
            self.caller = caller

    @property
    def has_more(self) -> bool:
        """Whether a request of this call has still to be sent, for the first time or again."""
        return self.next < len(self.requests) or bool(self.again)

    @property
    def next_position(self) -> int:
        """Position in the call of the request to be sent next; meaningful only if `has_more` is True."""
        return self.again[0] if self.again else self.next

    def take(self, at_most: int) -> Sequence[int]:
        """Return the positions of up to ``at_most`` requests to send next, and count them as sent.

        Requests to be repeated come first. As long as there are any, only these are returned.
        """
        if self.again:
            taken, self.again = self.again[:at_most], self.again[at_most:]
            return taken
        first = self.next
        self.next = min(first + at_most, len(self.requests))
        return range(first, self.next)

    def repeat(self, position: int) -> None:
        """Arrange that the request at ``position`` of this call is sent once more."""
        self.attempts = {**self.attempts, position: self.attempts.get(position, 1) + 1}
        self.again = (*self.again, position)

    @property
    def error(self) -> ModbusError | None:
        """The first error among the outcomes of the requests; None if no request has failed so far."""
        return next((outcome for outcome in self.outcomes if isinstance(outcome, ModbusError)), None)


def call_for(
    unit: int,
    requests: Sequence[Request],
    defaults: ClientParameters,
    call_options: CallOptions,
    now: float,
    caller: object = None,
) -> Call:
    """Create the `Call` for one use of a unit's method, such as ``read_coils``.

    Args:
        unit: unit identifier, 0…255.
        requests: the requests, one or more, in order.
        defaults: options of the link.
        call_options: the caller's own options; they replace those of the link.
        now: the time; a deadline counts from it.
        caller: identifies the caller for the queue; may be set later.

    Raises:
        InvalidRequest: an unknown option, or a value out of its range; nothing was sent.
    """
    deadline = defaults.deadline
    timeout = defaults.timeout
    retries = defaults.retries
    idempotent = False
    if call_options:
        timeout, retries, deadline, idempotent = _checked(call_options, timeout, retries, deadline)
    return Call(
        unit,
        requests,
        requests[0].is_write if len(requests) == 1 else any(map(_IS_WRITE, requests)),
        timeout,
        retries,
        idempotent,
        caller,
        None if deadline is None else now + deadline,
    )


def _checked(
    call_options: CallOptions, timeout: float, retries: int, deadline: float | None
) -> tuple[float, int, float | None, bool]:
    rest: dict[str, Any] = dict(call_options)
    timeout = rest.pop("timeout", None) or timeout
    own_retries = rest.pop("retries", None)
    retries = retries if own_retries is None else own_retries
    deadline = rest.pop("deadline", None) or deadline
    idempotent = rest.pop("idempotent", False)
    if rest:
        raise InvalidRequest(
            f"unknown option {next(iter(rest))}; a call takes timeout, retries, deadline and idempotent"
        )
    if not _is_time(timeout, 3600):
        raise InvalidRequest(f"timeout must be above 0 and at most 3600 seconds, not {timeout!r}")
    if not (hasattr(retries, "__index__") and 0 <= retries <= 100):
        raise InvalidRequest(f"retries must be 0…100, not {retries!r}")
    if deadline is not None and not _is_time(deadline, math.inf):
        raise InvalidRequest(f"deadline must be above 0 seconds, not {deadline!r}")
    return timeout, retries, deadline, idempotent


def _is_time(seconds: Any, longest: float) -> bool:  # Any: whatever the caller gave
    """Whether a value is a number above 0 and at most ``longest``; NaN is not."""
    try:
        return bool(0 < seconds <= longest)
    except TypeError:
        return False


class EncodedRequest:
    """The bytes of a request to one unit on TCP, and of its expected reply, without transaction identifiers.

    Attributes:
        unit: the unit identifier.
        tail: the ADU of the request without its transaction identifier.
        head: the seven bytes that follow the transaction identifier in the expected reply; empty if they do not suffice
            to recognise the reply.
        reply_size: bytes of the ADU of the expected reply; more than a receive buffer has if ``head`` is empty.
        cut: function that returns ``head`` and data of the expected reply from a buffer, where its header begins after
            the transaction identifier; used only if ``head`` is not empty.
        take: function that builds the reply message from the data bytes; used only if ``head`` is not empty.
        take_all: the same for the data of several replies.
        others: by unit, the `EncodedRequest` of the same request for each unit it was sent to; None if there is only
            one unit.
        packed: the last pipelined batch that began with this request, packed; None without one.
    """

    __slots__ = ("cut", "head", "others", "packed", "reply_size", "tail", "take", "take_all", "unit")

    def __init__(self, request: Request, unit: int) -> None:
        wire = request.prepare()
        size, prefix, take = request.expected_size, request.expected_prefix, request.take
        self.unit: int = unit
        self.tail: bytes = _BEHIND.pack(0, len(wire) + 1, unit) + wire
        self.take: Any = take
        self.take_all: Any = request.take_all
        is_known = take is not None and size > 0 and len(prefix) == 2
        self.reply_size: int = 7 + size if is_known else _NEVER_RECEIVED
        self.cut: Any = _cutter(size - 2) if is_known else None
        self.head: bytes = _BEHIND.pack(0, size + 1, unit) + prefix if is_known else b""
        self.others: dict[int, EncodedRequest] | None = None
        self.packed: Any = None  # Any: a `PackedBatch`, which is built on this class


@lru_cache(maxsize=256)  # more than a reply can have bytes
def _cutter(size: int) -> Any:  # the method of a struct
    """Return a function that cuts a reply with ``size`` bytes of data into the seven bytes before them and the data."""
    return struct.Struct(f">7s{size}s").unpack_from


def encoded_request(request: Request, unit: int) -> EncodedRequest:
    """Return the encoded form of a request to a unit; encoded at the first use, then stored with the request."""
    try:
        encoded: EncodedRequest = request.memo
    except AttributeError:
        encoded = EncodedRequest(request, unit)
    else:
        if encoded.unit == unit:
            return encoded
        encoded = _encoded_for_other_unit(request, unit, encoded)
    request.remember(encoded)
    return encoded


def _encoded_for_other_unit(request: Request, unit: int, known: EncodedRequest) -> EncodedRequest:
    """Return the encoded form of a request for ``unit``; ``known`` is that for another unit.

    It is taken from ``known.others``; if it is not there, it is encoded and added.
    """
    if known.others is None:
        known.others = {known.unit: known}  # not before: most requests have one, and would be a ring of references
    found = known.others.get(unit)
    if found is None:
        found = known.others[unit] = EncodedRequest(request, unit)
        found.others = known.others
    return found


class RequestInFlight:
    """A request that was sent and whose reply is awaited; the object is reused for later requests.

    Attributes:
        call: the call of the request; None if it was cancelled.
        position: position of the request in the call.
        encoded: the bytes of the request and of its expected reply.
        sent, expires: when it was sent and when it times out, in the clock of ``now``.
    """

    __slots__ = ("call", "encoded", "expires", "position", "sent")

    call: Call | None  # None: cancelled
    position: int
    encoded: EncodedRequest
    sent: float
    expires: float


FreeSlots = list[RequestInFlight]
"""Unused `RequestInFlight` objects. Each request in flight takes one, so their number limits the requests in flight."""


def free_slots(count: int) -> FreeSlots:
    """Create a list of ``count`` reusable objects for requests in flight; their number limits the requests in flight.

    The caller passes the list to one session, or to all sessions of a client, which then share the limit.
    """
    return [RequestInFlight() for _ in range(count)]
