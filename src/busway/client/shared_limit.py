"""One limit of requests in flight for all links of a client: NumberMaxOfClientTransaction with ``scope=client``.

Knows links that wait for a slot, and lets them send in turn; knows nothing of what they send.

1. "Client" means all links of one event loop, or all blocking links of the process
   (Messaging on TCP/IP V1.0b §4.4.1.1 counts per client).
2. The sessions take their slots for requests in flight from one shared list. A link that frees a slot first lets the
   other links send.
3. Blocking links of one client share a lock, so that no slot is taken twice. If a thread is interrupted while it holds
   the lock, slots may be lost, so all these links are reset.
"""

import threading
import weakref
from collections import deque
from typing import Protocol

from ..errors import ConfigError
from ..session.call import FreeSlots, free_slots


class LinkLock:
    """The lock of a blocking link, or of all links of a scope, and whether a thread was interrupted while it held it.

    A thread that takes ``lock`` sets ``is_torn`` and clears it before it releases the lock. If an exception such as
    ``KeyboardInterrupt`` ends it between, ``is_torn`` stays set, and the next thread resets the links.
    """

    __slots__ = ("is_torn", "lock")

    def __init__(self) -> None:
        self.lock: threading.Lock = threading.Lock()
        self.is_torn: bool = False


class ScopedLink(Protocol):
    """Interface of a link whose requests in flight count towards a limit that all links of a client share."""

    def serve(self, now: float) -> None:
        """Send waiting requests of the link, because the common limit may have room for them now."""


class ClientScope:
    """The limit of requests in flight that all links of one client share, with the option ``scope=client``.

    Attributes:
        limit: the most requests in flight on all connections of the client together, 1…16.
        slots: one entry for each further request that may be sent; the sessions take entries and put them back.
        guard: the lock that all blocking links of the client use instead of one of their own.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.slots: FreeSlots = free_slots(limit)
        self.guard: LinkLock = LinkLock()
        self._links: deque[weakref.ref[ScopedLink]] = deque()

    @property
    def is_used(self) -> bool:
        """Whether any open link counts its requests towards this limit."""
        return any(link() is not None for link in self._links)

    def enter(self, link: ScopedLink) -> None:
        """Add a new link, whose requests count towards this limit. Only a weak reference to it is kept."""
        self._links.append(weakref.ref(link))

    def leave(self, link: ScopedLink) -> None:
        """Remove a link that was closed, so that `serve` no longer calls it."""
        self._links = deque(one for one in self._links if one() not in (None, link))

    def links(self) -> list[ScopedLink]:
        """Return the open links that count towards this limit."""
        return [link for one in self._links if (link := one()) is not None]

    def refill(self) -> None:
        """Restore all slots, because no link has a request in flight any more."""
        self.slots[:] = free_slots(self.limit)

    def serve(self, now: float) -> None:
        """Let the links send waiting requests, in turn, until the limit is reached. ``now`` is the time, in seconds."""
        for _ in range(len(self._links)):
            if not self.slots:
                return
            link = self._links[0]()
            self._links.rotate(-1)
            if link is not None:
                link.serve(now)


def same_scope(scope: ClientScope | None, limit: int) -> ClientScope:
    """Return the `ClientScope` for a new link of a client: ``scope``, or a new one if ``scope`` has no open links.

    Args:
        scope: the common limit of the client's links so far; None before the first link.
        limit: the ``max_transactions`` of the new link.

    Raises:
        ConfigError: the open links of the client have another limit.
    """
    if scope is None or not scope.is_used:
        return ClientScope(limit)
    if scope.limit != limit:
        raise ConfigError(
            f"with scope=client all links have one limit, and others are open with {scope.limit}",
            key="max_transactions",
        )
    return scope
