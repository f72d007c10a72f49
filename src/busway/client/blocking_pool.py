"""Blocking links by endpoint: one shared connection for all users in a process (`shared_links` has the rules)."""

import threading

from ..options.client import LinkSelection
from .blocking_link import BlockingLinkDriver
from .connector import connector_for
from .scope import ClientScope
from .sessions import client_session_for
from .settings import LinkSettings
from .shared_links import SharedLinks


class BlockingPool:
    """All blocking links of this process by endpoint, shared by their users; safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._links: SharedLinks[BlockingLinkDriver] = SharedLinks(_made)

    def acquire(self, settings: LinkSettings, *, shared: bool) -> BlockingLinkDriver:
        """Return the shared link to an endpoint, created if necessary. Raises `ConfigError`, `Overloaded`."""
        with self._lock:
            return self._links.acquire(settings, shared=shared)

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> BlockingLinkDriver:
        """Choose one of several links to the same endpoint for a request. Raises `LinkDown` if there are none."""
        with self._lock:
            return self._links.choose(settings, rule)

    def release(self, settings: LinkSettings, link: BlockingLinkDriver) -> None:
        """Give a link back after use; when its last user does, its connection is closed."""
        with self._lock:
            is_last = self._links.release(settings, link)
        if is_last:
            link.close()


def _made(settings: LinkSettings, shared: bool, scope: ClientScope | None) -> BlockingLinkDriver:
    session = client_session_for(settings, None if scope is None else scope.slots)
    connector = connector_for(settings, session, user="busway.connect")
    link = BlockingLinkDriver(connector, session, settings, shared=shared, scope=scope)
    if scope is not None:
        with scope.lock:
            scope.enter(link)
    return link


BLOCKING_POOL = BlockingPool()
