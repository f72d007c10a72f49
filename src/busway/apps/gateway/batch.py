"""A batch of forwarded requests: those of one client that go upstream together, and all clients that wait for them.

Knows calls and the clients that wait; `forwarding` decides what is done with an outcome.
"""

from collections.abc import Iterator, Mapping, MutableMapping, Sequence, Set
from types import MappingProxyType
from typing import Any, Protocol

from ...client.link import AsyncLinkDriver
from ...session.call import Call
from ...session.forwarded_reads import ForwardedReads
from ...session.responder import Forwarding
from .read_cache import Key, ReadRange
from .shared_read_deadlines import SharedReadDeadlines
from .upstream import Upstream

ForwardingClient = ForwardedReads | Forwarding
"""The client that gets the answers to forwarded requests: a connection with its reads, or a single request."""
ForwardedRequest = Any
"""A request to forward: a `PreparedForward` of a `ForwardedReads`, or a `Translated` of a `Forwarding`.

The client gets the object back with the reply.
"""
WaitingClient = tuple[ForwardingClient, Any, ForwardedRequest]
"""A client, the tag that names its request for the client, and that request."""
_NO_POSITIONS: frozenset[int] = frozenset()
_NONE_JOINED: Mapping[int, list[WaitingClient]] = MappingProxyType({})


class BatchForwarder(Protocol):
    """Interface of the forwarder of an upstream, as a batch uses it."""

    @property
    def upstream(self) -> Upstream:
        """The upstream that gets the requests of the batch."""

    def answer(self, batch: "Batch") -> None:
        """Answer all clients whose requests in a batch have an outcome."""

    def withdraw(self, batch: "Batch", asker: ForwardingClient) -> None:
        """Drop the requests of a client that has disconnected; those that other clients wait for go on."""

    def give_up_one(self, batch: "Batch", waiter: WaitingClient | None) -> None:
        """Answer a client whose deadline has passed with exception code 0A or 0B.

        ``waiter`` is a client that joined a read of the batch; None is the client that sent the batch, with all its
        requests.
        """


class BatchTarget(Protocol):
    """Interface of the destination of a batch: one unit of an upstream, with the timeout and retries for it."""

    @property
    def forwarder(self) -> BatchForwarder:
        """The forwarder of the upstream."""

    @property
    def unit(self) -> int:
        """The unit identifier on the upstream."""

    @property
    def timeout(self) -> float:
        """Seconds to wait for the reply of the unit, per attempt."""

    @property
    def retries(self) -> int:
        """Number of further attempts of a read, after the first."""

    @property
    def deadline(self) -> float | None:
        """Seconds until clients must be answered, counted from their request; None for no limit."""


class Batch(Call):
    """Requests of one client that go upstream together as one call, and the other clients that wait for its reads.

    Args:
        target: the unit of the upstream.
        link: the link that sends the requests.
        asker: the client.
        tags: for each request of the client, the tag that identifies it for the client.
        asked: the client's requests.
        now: the time, by the clock of the link; a deadline counts from it.

    Attributes:
        forwarder: the forwarder of the upstream.
        link: the link that sends the requests.
        asker: the client that sent the batch; None once it has disconnected or was answered at its deadline.
        tags, asked: the client's requests with their tags. ``requests`` (see `Call`) has the requests that go upstream,
            in the same order; a request that is split into several is alone in its batch.
        told: positions of the requests that were answered already while others wait; empty if all are answered at once.
        joined: the other clients that wait for a read's reply, by position of the read.
        deadlines: deadlines of the clients, once several wait; None until then. Waiter None stands for ``asker``.
        keys: if the reads may be shared, the key of each.
        shared: the table in which other clients find the batch by these keys; None if it has no reads to share.
        place: the range of the read whose values are to be remembered; None if none are.
        since: number of changes of the unit (`ReadCache.changes`) when the batch was made; 0 without ``place``.
        read_at: when the batch was made, in monotonic seconds; 0 without ``place``.
    """

    # What most batches never set is a class attribute until it is set, as in `Call`.
    told: Set[int] = _NO_POSITIONS
    joined: Mapping[int, list[WaitingClient]] = _NONE_JOINED
    deadlines: SharedReadDeadlines[WaitingClient | None] | None = None
    keys: Sequence[Key] = ()
    shared: MutableMapping[Key, "Batch"] | None = None
    place: ReadRange | None = None
    since: int = 0
    read_at: float = 0.0

    def __init__(
        self,
        target: BatchTarget,
        link: AsyncLinkDriver,
        asker: ForwardingClient,
        tags: Sequence[Any],
        asked: Sequence[ForwardedRequest],
        now: float,
    ) -> None:
        requests = asked[0].requests if len(asked) == 1 else [one.requests[0] for one in asked]
        deadline = None if target.deadline is None else now + target.deadline
        super().__init__(
            target.unit, requests, requests[0].is_write, target.timeout, target.retries, False, asker.peer, deadline
        )
        self.owner = self
        self.places: int = len(tags)
        if asker.is_priority:
            self.is_priority = True
        self.forwarder: BatchForwarder = target.forwarder
        self.link = link
        self.asker: ForwardingClient | None = asker
        self.tags = tags
        self.asked = asked

    def done(self) -> bool:
        """Return False, always. The link treats a batch like a future, and calls this before `set_result`."""
        return False

    def set_result(self, result: None) -> None:
        """Answer the clients; ``result`` is ignored.

        The link calls this, as on a future, when all requests of the batch have an outcome.
        """
        self.forwarder.answer(self)

    def owed(self, asker: ForwardingClient) -> Iterator[ForwardedRequest]:
        """Yield a client's unanswered requests in this batch: its own, and its reads that join others."""
        for position in range(len(self.tags)):
            if position not in self.told:
                yield from (asked for waiter, _, asked in self.waiters(position) if waiter is asker)

    def asker_gone(self, asker: ForwardingClient) -> None:
        """Withdraw a disconnected client's requests from this batch: its own, and its reads that join others."""
        self.forwarder.withdraw(self, asker)

    def is_sent(self, position: int) -> bool:
        """Whether the request at a position of the batch was sent upstream."""
        return position < self.next or position in self.attempts

    @property
    def left(self) -> int:
        """Number of client requests in the batch that have no answer yet; a shared read counts once."""
        return len(self.tags) - len(self.told)

    def waiters(self, position: int) -> list[WaitingClient]:
        """Return the clients that wait for the request at a position of the batch, each with its tag and request."""
        own = [] if self.asker is None else [(self.asker, self.tags[position], self.asked[position])]
        return own + self.joined.get(position, [])


__all__ = ["Batch", "BatchForwarder", "BatchTarget", "ForwardedRequest", "ForwardingClient", "WaitingClient"]
