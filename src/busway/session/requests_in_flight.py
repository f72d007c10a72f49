"""Requests on their way over TCP: one by one, or together in a volley that is answered in its order.

Knows how ADUs lie one behind the other; knows no connection, no queue, and no reply that does not simply fit: whoever
meets one takes the volley apart (`PipelinedBatch.apart`) and looks at each request by itself.

1. What does not depend on transactions is made once and kept with the requests (`Request.memo`): a poller asks the same
   again and again.
2. A reply is known by its transaction and by the seven bytes behind it: protocol, length, unit, function, byte count.
3. While a volley is in flight nothing that was sent after it has ended: who takes another reply takes it apart before.
   So its identifiers are the latest ones, and need not be looked for among those of later requests.
"""

import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

from ..pdu.message import Message, Request
from .call import Call

_BEHIND = struct.Struct(">HHB")
"""What stands behind the transaction: protocol, length, unit."""
HEAD_SIZE = 9
"""Bytes of a reply by which it is known: transaction and the seven behind it."""


class EncodedRequest:
    """What a request to a unit looks like on TCP but for its transaction.

    Attributes:
        unit: which unit.
        tail: the ADU of the request without its transaction.
        head: the seven bytes behind the transaction of a reply that fits. Empty where they do not tell whether it does.
        reply_size: bytes of the ADU of a reply that fits.
        take: what makes that reply of its data.
        others: the routes of the same request to all units, if it was sent to more than one.
        plan: of the last volley that this request was the first of.
    """

    __slots__ = ("head", "others", "plan", "reply_size", "tail", "take", "unit")

    def __init__(self, request: Request, unit: int) -> None:
        wire = request.prepare()
        size, prefix, take = request.expected_size, request.expected_prefix, request.take
        self.unit = unit
        self.tail = _BEHIND.pack(0, len(wire) + 1, unit) + wire
        self.reply_size = 7 + size
        self.take = take
        is_known = take is not None and size > 0 and len(prefix) == 2
        self.head = _BEHIND.pack(0, size + 1, unit) + prefix if is_known else b""
        self.others: dict[int, EncodedRequest] | None = None
        self.plan: BatchPlan | None = None


def route_of(request: Request, unit: int) -> EncodedRequest:
    """The route of a request to a unit; made when it is first asked for, and kept with the request."""
    try:
        route: EncodedRequest = request.memo
    except AttributeError:
        route = EncodedRequest(request, unit)
    else:
        if route.unit == unit:
            return route
        route = _other_route(request, unit, route)
    request.remember(route)
    return route


def _other_route(request: Request, unit: int, known: EncodedRequest) -> EncodedRequest:
    """The route to a unit where another one is kept already; from now on each finds the others."""
    if known.others is None:
        known.others = {known.unit: known}  # not before: most requests have one, and would be a ring of references
    found = known.others.get(unit)
    if found is None:
        found = known.others[unit] = EncodedRequest(request, unit)
        found.others = known.others
    return found


class RequestInFlight:
    """One place among the requests in flight; the same few objects serve a connection for ever."""

    __slots__ = ("call", "expires", "position", "route", "sent")

    call: Call | None  # None: cancelled
    position: int
    route: EncodedRequest
    sent: float
    expires: float


Places = list[RequestInFlight]
"""Places for requests in flight that are free."""


def places(count: int) -> Places:
    """So many places, all free: of one session, or shared by the sessions of a client."""
    return [RequestInFlight() for _ in range(count)]


class BatchPlan:
    """What requests to a unit look like together but for their transactions.

    Attributes:
        following: the requests behind the first, which keeps the plan and is not kept by it: a batch that is made for
            one call would else be a ring of references.
        fits: whether all their replies can be known by their first bytes; if not, there is no volley of them.
        heads: of each reply, the seven bytes behind its transaction.
        reply_sizes, reply_size: bytes of the ADUs of each reply, and of all.
        takers: what makes each reply of its data.
    """

    __slots__ = (
        "_fields",
        "_is_plain",
        "_pack",
        "_unpack_from",
        "fits",
        "following",
        "heads",
        "reply_size",
        "reply_sizes",
        "takers",
    )

    def __init__(self, first: EncodedRequest, following: tuple[Request, ...]) -> None:
        routes = [first, *[route_of(request, first.unit) for request in following]]
        self.following = following
        self.fits = all(route.head for route in routes)
        self.heads = tuple(route.head for route in routes)
        self.reply_sizes = tuple(route.reply_size for route in routes)
        self.reply_size = sum(self.reply_sizes)
        self.takers = tuple(route.take for route in routes)
        self._is_plain = set(self.takers) == {bytes}  # whoever asks wants the data as they came (a gateway)
        self._fields: list[Any] = [part for route in routes for part in (0, route.tail)]  # Any: numbers and bytes
        if self.fits:
            out, back = _shapes(tuple(len(route.tail) for route in routes), self.reply_sizes)
            self._pack, self._unpack_from = out.pack, back.unpack_from

    def encode(self, transactions: Sequence[int]) -> bytes:
        """The ADUs, joined."""
        fields = self._fields.copy()  # another thread may be at the same plan
        fields[0::2] = transactions
        return self._pack(*fields)

    def replies(self, transactions: tuple[int, ...], buffer: bytes, at: int) -> list[Message] | None:
        """All the replies, if ``buffer`` from ``at`` on begins with them in the order of the requests."""
        fields = self._unpack_from(buffer, at)
        if fields[0::3] != transactions or fields[1::3] != self.heads:
            return None
        if self._is_plain:
            return list(fields[2::3])
        return [take(data) for take, data in zip(self.takers, fields[2::3], strict=True)]


@lru_cache(maxsize=256)
def _shapes(tails: tuple[int, ...], replies: tuple[int, ...]) -> tuple[struct.Struct, struct.Struct]:
    """How the requests and the replies of a volley lie; ``tails`` and ``replies`` are numbers of bytes."""
    out = "".join(f"H{size}s" for size in tails)
    back = "".join(f"H7s{size - HEAD_SIZE}s" for size in replies)
    return struct.Struct(">" + out), struct.Struct(">" + back)


def plan_of(requests: Sequence[Request], first: int, count: int, unit: int) -> BatchPlan:
    """The plan of ``count`` of ``requests`` from ``first`` on, to a unit; kept with the first of them."""
    route = route_of(requests[first], unit)
    following = tuple(requests[first + 1 : first + count])
    plan = route.plan
    if plan is None or plan.following != following:  # as a rule the very same objects, so this is no work
        plan = route.plan = BatchPlan(route, following)
    return plan


class PipelinedBatch:
    """Requests of one demand that are in flight, and whose replies are expected in their order.

    Attributes:
        call: whose.
        first: position of the first request in the demand.
        plan: how they look.
        transactions: their identifiers.
        places: those that they take, one for each request that still wants its reply.
        answered: how many of them have their reply; the first ones.
        sent, expires: as of each request.
    """

    __slots__ = ("answered", "call", "expires", "first", "places", "plan", "sent", "transactions")

    def __init__(
        self,
        call: Call,
        first: int,
        plan: BatchPlan,
        transactions: tuple[int, ...],
        places: Places,
        sent: float,
    ) -> None:
        self.call = call
        self.first = first
        self.plan = plan
        self.transactions = transactions
        self.places = places
        self.answered = 0
        self.sent = sent
        self.expires = sent + call.timeout

    def expects(self, buffer: bytes, at: int) -> bool:
        """Whether the frame that begins at ``at`` is the reply that is next."""
        following = self.answered
        return (
            buffer[at + 2 : at + HEAD_SIZE] == self.plan.heads[following]
            and buffer[at] << 8 | buffer[at + 1] == self.transactions[following]
        )

    def apart(self) -> Iterator[tuple[int, RequestInFlight]]:
        """Each request that still wants its reply as one by itself, with its transaction."""
        call = self.call
        for index in range(self.answered, len(self.transactions)):
            awaited = self.places.pop()
            awaited.call = call
            awaited.position = self.first + index
            awaited.route = route_of(call.requests[awaited.position], call.unit)
            awaited.sent = self.sent
            awaited.expires = self.expires
            yield self.transactions[index], awaited
