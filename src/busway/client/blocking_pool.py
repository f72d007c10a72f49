"""Blocking links by endpoint: one shared connection for all users in a process (the rules are in `shared_links`)."""

import threading

from ..options.client import LinkSelection
from .blocking_link import BlockingLinkDriver
from .connector import connector_for
from .sessions import client_session_for
from .settings import LinkSettings
from .shared_limit import ClientScope
from .shared_links import SharedLinks


class BlockingPool:
    """The blocking links of this process: users of the same endpoint share one link, except with ``shared=False``.

    Safe to use from any thread.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._links: SharedLinks[BlockingLinkDriver] = SharedLinks(_made)

    def acquire(self, settings: LinkSettings, *, shared: bool) -> BlockingLinkDriver:
        """Return the link that all users of an endpoint share, or, if ``shared`` is False, a new link for the caller.

        The shared link is created for its first user. The caller is a user of the link until it calls `release`.
        Nothing is sent, and no connection opened.

        Raises:
            ConfigError: other users share the link with other connection settings, or a setting cannot be used.
            Overloaded: the endpoint already has ``max_connections`` links that are not shared.
        """
        with self._lock:
            return self._links.acquire(settings, shared=shared)

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> BlockingLinkDriver:
        """Return one of the links to an endpoint, for one request. Raises `LinkDown` if there is no link to it.

        ``rule`` chooses among the connected links: the one created first, or the one connected longest. If none is
        connected, it is the link created first.
        """
        with self._lock:
            return self._links.choose(settings, rule)

    def release(self, settings: LinkSettings, link: BlockingLinkDriver) -> None:
        """Stop using a link that `acquire` returned; close it if this was its last user."""
        with self._lock:
            is_last = self._links.release(settings, link)
        if is_last:
            link.close()


def _made(settings: LinkSettings, shared: bool, scope: ClientScope | None) -> BlockingLinkDriver:
    session = client_session_for(settings, None if scope is None else scope.slots)
    connector = connector_for(settings, session, user="busway.connect")
    link = BlockingLinkDriver(connector, session, settings, shared=shared, scope=scope)
    if scope is not None:
        link.enter(scope)
    return link


BLOCKING_POOL = BlockingPool()
