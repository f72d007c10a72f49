"""A batch of forwarded requests: those of one client that go upstream together, and all clients that wait for them.

Knows calls and who waits; what is done with an outcome is decided by `forwarding`.
"""

from collections.abc import Iterator, Mapping, MutableMapping, Sequence, Set
from types import MappingProxyType
from typing import Any, Protocol

from ...client.link import AsyncLinkDriver
from ...session.call import Call
from ...session.forwarded_reads import ForwardedReads
from ...session.responder import Forwarding
from .read_cache import Key, Place
from .upstream import Upstream
from .waiter_deadlines import WaiterDeadlines

ForwardingClient = ForwardedReads | Forwarding
"""Who gets the answers to forwarded requests: a connection with its reads, or a single request."""
ForwardedRequest = Any
"""A `ForwardPlan` of `ForwardedReads`, or a `Translated` of a `Forwarding`; each client gets its own back."""
Waiter = tuple[ForwardingClient, Any, ForwardedRequest]
"""An asker, and which of its requests waits."""
_NO_POSITIONS: frozenset[int] = frozenset()
_NONE_JOINED: Mapping[int, list[Waiter]] = MappingProxyType({})


class BatchForwarder(Protocol):
    """What a batch needs of the forwarder that made it."""

    @property
    def upstream(self) -> Upstream:
        """The upstream that gets the requests."""

    def answer(self, batch: "Batch") -> None:
        """Answer all requests of a batch that have an outcome."""

    def withdraw(self, batch: "Batch", asker: ForwardingClient) -> None:
        """Drop a disconnected client's requests."""

    def give_up_one(self, batch: "Batch", waiter: Waiter | None) -> None:
        """Answer a client whose deadline has passed."""


class BatchTarget(Protocol):
    """What a batch needs to know of the unit of an upstream that it is for."""

    @property
    def forwarder(self) -> BatchForwarder:
        """The forwarder of the upstream."""

    @property
    def unit(self) -> int:
        """The unit as it is asked upstream."""

    @property
    def timeout(self) -> float:
        """Seconds to wait for the unit."""

    @property
    def retries(self) -> int:
        """How often a request is repeated."""

    @property
    def deadline(self) -> float | None:
        """Seconds after which clients have given up; None if that is not known."""


class Batch(Call):
    """Requests of one client that go upstream together, and the other clients that share replies to some of them.

    Attributes:
        asker: the client; None when it has disconnected.
        tags, asked: its requests. Their positions are those of ``requests``, unless a single one was split.
        told: positions that were answered one by one; empty if all are answered together.
        joined: other clients that wait for a read, by its position.
        deadlines: of all that wait, where several do: of one that joined, or of the first with all its requests.
        keys, shared: the keys of its reads, and where they are found, if they may be shared.
        place, since, read_at: what is remembered of a read, and which moment its value is of.
    """

    # What most batches never set is a class attribute until it is set, as in `Call`.
    told: Set[int] = _NO_POSITIONS
    joined: Mapping[int, list[Waiter]] = _NONE_JOINED
    deadlines: WaiterDeadlines[Waiter | None] | None = None
    keys: Sequence[Key] = ()
    shared: MutableMapping[Key, "Batch"] | None = None
    place: Place | None = None
    since: int = 0
    read_at: float = 0.0

    def __init__(
        self,
        target: BatchTarget,
        link: AsyncLinkDriver,
        asker: ForwardingClient,
        tags: Sequence[Any],
        asked: Sequence[ForwardedRequest],
    ) -> None:
        requests = asked[0].requests if len(asked) == 1 else [one.requests[0] for one in asked]
        deadline = None if target.deadline is None else link.now() + target.deadline
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
        """Return False always: a link asks futures this before it calls `set_result`, and treats a
        batch as a future.
        """
        return False

    def set_result(self, result: None) -> None:
        """Answer the clients: the link calls this, as on a future, when all requests of the batch have an outcome."""
        self.forwarder.answer(self)

    def owed(self, asker: ForwardingClient) -> Iterator[ForwardedRequest]:
        """Yield the requests of a client in this batch that have no answer yet."""
        for position in range(len(self.tags)):
            if position not in self.told:
                yield from (asked for waiter, _, asked in self.waiters(position) if waiter is asker)

    def asker_gone(self, asker: ForwardingClient) -> None:
        """Withdraw the requests of the client that sent the batch, because it has disconnected."""
        self.forwarder.withdraw(self, asker)

    def is_sent(self, position: int) -> bool:
        """Whether the request at a position of the batch was sent upstream."""
        return position < self.next or position in self.attempts

    @property
    def left(self) -> int:
        """Number of requests of the batch that have no answer yet."""
        return len(self.tags) - len(self.told)

    def waiters(self, position: int) -> list[Waiter]:
        """Return the clients that wait for the request at a position of the batch."""
        own = [] if self.asker is None else [(self.asker, self.tags[position], self.asked[position])]
        return own + self.joined.get(position, [])


__all__ = ["Batch", "BatchForwarder", "BatchTarget", "ForwardedRequest", "ForwardingClient", "Waiter"]
