"""Blocking links by endpoint: one shared connection for all users in a process (see ``pool`` for the rules)."""

import threading
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from ..options.client import LinkSelection, TransactionScope
from .blocking_link import BlockingLinkDriver
from .checks import check_same
from .connection_choice import check_room, chosen
from .connector import connector_for
from .scope import ClientScope, same_scope
from .sessions import client_session_for
from .settings import LinkSettings


@dataclass(slots=True)
class _Shared:
    settings: LinkSettings
    link: BlockingLinkDriver
    users: int = 0


class BlockingPool:
    """The blocking links of this process by endpoint; safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shared: dict[str, _Shared] = {}
        self._links: dict[str, WeakKeyDictionary[BlockingLinkDriver, None]] = {}  # in the order they were made
        self._scope: ClientScope | None = None

    def acquire(self, settings: LinkSettings, *, shared: bool) -> BlockingLinkDriver:
        """Get the link for one more user of an endpoint. Raises `ConfigError`, `Overloaded`."""
        name = settings.endpoint.url
        with self._lock:
            if not shared:
                check_room(list(self._links.get(name, ())), settings)
                return self._make(settings, shared=False)
            entry = self._shared.get(name)
            if entry is None:
                entry = self._shared[name] = _Shared(settings, self._make(settings, shared=True))
            check_same(entry.settings, settings)
            entry.users += 1
            return entry.link

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> BlockingLinkDriver:
        """Choose one of the open links to an endpoint for a request. Raises `LinkDown` if there are none."""
        with self._lock:
            return chosen(list(self._links.get(settings.endpoint.url, ())), settings, rule)

    def release(self, settings: LinkSettings, link: BlockingLinkDriver) -> None:
        """Give a link back; the last user closes its connection."""
        name = settings.endpoint.url
        with self._lock:
            entry = self._shared.get(name)
            if entry is not None and entry.link is link:
                entry.users -= 1
                if entry.users:
                    return
                del self._shared[name]
            self._links[name].pop(link, None)
            if not self._links[name]:
                del self._links[name]
        link.close()

    def _make(self, settings: LinkSettings, *, shared: bool) -> BlockingLinkDriver:
        scope = None
        if settings.parameters.scope is TransactionScope.CLIENT:
            scope = self._scope = same_scope(self._scope, settings.parameters.max_transactions)
        session = client_session_for(settings, None if scope is None else scope.places)
        connector = connector_for(settings, session, user="busway.connect")
        link = BlockingLinkDriver(connector, session, settings, shared=shared, scope=scope)
        if scope is not None:
            with scope.lock:
                scope.enter(link)
        self._links.setdefault(settings.endpoint.url, WeakKeyDictionary())[link] = None
        return link


BLOCKING_POOL = BlockingPool()
