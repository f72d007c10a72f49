"""One limit of requests in flight for all links of a client: NumberMaxOfClientTransaction with ``scope=client``.

Knows links that wait for a slot, and serves them in turn; knows nothing of what they send.

1. "Client" means all links of one event loop, or all blocking links of the process
   (Messaging on TCP/IP V1.0b §4.4.1.1 counts per client).
2. The sessions take their slots for requests in flight from one shared list; a link that frees a slot lets the others
   go first.
3. Blocking links of one client share a lock, so that no slot is taken twice.
"""

import threading
import weakref
from collections import deque
from typing import Protocol

from ..errors import ConfigError
from ..session.call import FreeSlots, free_slots


class ScopedLink(Protocol):
    """Interface of a link whose requests in flight count towards a limit that several links share."""

    def serve(self, now: float) -> None:
        """Send waiting requests of the link, because the common limit has room for them."""


class ClientScope:
    """The limit of requests in flight that the links of one client share.

    Attributes:
        limit: requests in flight on all its connections together, 1…16.
        slots: the free slots.
        lock: the lock of its blocking links.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.slots: FreeSlots = free_slots(limit)
        self.lock: threading.Lock = threading.Lock()
        self._links: deque[weakref.ref[ScopedLink]] = deque()

    @property
    def is_used(self) -> bool:
        """Whether any link still counts its requests towards this common limit."""
        return any(link() is not None for link in self._links)

    def enter(self, link: ScopedLink) -> None:
        """Add a new link to those whose requests count towards this common limit."""
        self._links.append(weakref.ref(link))

    def leave(self, link: ScopedLink) -> None:
        """Remove a closed link from those whose requests count towards this common limit."""
        self._links = deque(one for one in self._links if one() not in (None, link))

    def serve(self, now: float) -> None:
        """Let the links send waiting requests, in turn, as far as the common limit allows."""
        for _ in range(len(self._links)):
            if not self.slots:
                return
            link = self._links[0]()
            self._links.rotate(-1)
            if link is not None:
                link.serve(now)


def same_scope(scope: ClientScope | None, limit: int) -> ClientScope:
    """Return the common limit for one more link of a client; a new one if no link of it is open.

    Raises:
        ConfigError: its other links have another limit.
    """
    if scope is None or not scope.is_used:
        return ClientScope(limit)
    if scope.limit != limit:
        raise ConfigError(
            f"with scope=client all links have one limit, and others are open with {scope.limit}",
            key="max_transactions",
        )
    return scope
