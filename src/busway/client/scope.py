"""One limit of transactions for all links of a client: NumberMaxOfClientTransaction with ``scope=client``.

Knows links that wait for a place, and serves them in turn; knows nothing of what they send.

1. A client is what shares its links: an event loop, or for blocking links the process
   (Messaging on TCP/IP V1.0b §4.4.1.1 counts per client).
2. The sessions take their places from one list, so nothing is counted twice; a link whose place is free again lets the
   others go first.
3. Blocking links of one client share a lock, so that no place is taken twice.
"""

import threading
import weakref
from collections import deque
from typing import Protocol

from ..errors import ConfigError
from ..session.requests_in_flight import Places, places


class ScopedLink(Protocol):
    """A link that takes its places from a scope."""

    def serve(self, now: float) -> None:
        """Send what waits for a place."""


class ClientScope:
    """The places of one client.

    Attributes:
        limit: requests in flight on all its connections together, 1…16.
        places: those that are free.
        lock: that of its blocking links.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.places: Places = places(limit)
        self.lock = threading.Lock()
        self._links: deque[weakref.ref[ScopedLink]] = deque()

    @property
    def is_used(self) -> bool:
        """Whether a link takes its places from here."""
        return any(link() is not None for link in self._links)

    def enter(self, link: ScopedLink) -> None:
        """A link was made."""
        self._links.append(weakref.ref(link))

    def leave(self, link: ScopedLink) -> None:
        """A link was closed; its places are free already."""
        self._links = deque(one for one in self._links if one() not in (None, link))

    def serve(self, now: float) -> None:
        """Give free places to the links that wait, in turn."""
        for _ in range(len(self._links)):
            if not self.places:
                return
            link = self._links[0]()
            self._links.rotate(-1)
            if link is not None:
                link.serve(now)


def same_scope(scope: ClientScope | None, limit: int) -> ClientScope:
    """The scope of a client for one more link; a new one where it has none in use.

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
