"""Links by endpoint: one shared connection for all users on an event loop (Messaging on TCP/IP V1.0b §4.2.1).

Knows the users of each link; knows no requests.

1. Automatic management: users of one endpoint share its link; the last one to leave closes it.
2. Explicit management: a link that is not shared belongs to its user alone; there may be ``max_connections`` of them.
3. Users with different connection settings cannot share a link: the second gets an error that names the setting.
4. If several links lead to one endpoint, a rule chooses one for each request (§4.2.1.2).
"""

import asyncio
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from ..errors import ConfigError
from ..options.client import LinkSelection, TransactionScope
from .checks import check_same
from .connection_choice import check_room, chosen
from .connector import connector_for
from .link import AsyncLinkDriver
from .scope import ClientScope, same_scope
from .sessions import client_session_for
from .settings import LinkSettings


@dataclass(slots=True)
class _Shared:
    settings: LinkSettings
    link: AsyncLinkDriver
    users: int = 0


class LinkPool:
    """The links of one event loop, by endpoint."""

    def __init__(self) -> None:
        self._shared: dict[str, _Shared] = {}
        self._links: dict[str, WeakKeyDictionary[AsyncLinkDriver, None]] = {}  # in the order they were made
        self._scope: ClientScope | None = None

    def acquire(self, settings: LinkSettings, *, shared: bool) -> AsyncLinkDriver:
        """Get the link for one more user of an endpoint. Raises `ConfigError`, `Overloaded`."""
        name = settings.endpoint.url
        if not shared:
            check_room(list(self._links.get(name, ())), settings)
            return self._make(settings, shared=False)
        entry = self._shared.get(name)
        if entry is None:
            entry = self._shared[name] = _Shared(settings, self._make(settings, shared=True))
        check_same(entry.settings, settings)
        entry.users += 1
        return entry.link

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> AsyncLinkDriver:
        """Choose one of the open links to an endpoint for a request. Raises `LinkDown` if there are none."""
        return chosen(list(self._links.get(settings.endpoint.url, ())), settings, rule)

    async def release(self, settings: LinkSettings, link: AsyncLinkDriver) -> None:
        """Give a link back; the last user closes its connection."""
        name = settings.endpoint.url
        entry = self._shared.get(name)
        if entry is not None and entry.link is link:
            entry.users -= 1
            if entry.users:
                return
            del self._shared[name]
        self._links[name].pop(link, None)
        if not self._links[name]:
            del self._links[name]
        await link.close()

    def _make(self, settings: LinkSettings, *, shared: bool) -> AsyncLinkDriver:
        scope = None
        if settings.parameters.scope is TransactionScope.CLIENT:
            scope = self._scope = same_scope(self._scope, settings.parameters.max_transactions)
        session = client_session_for(settings, None if scope is None else scope.places)
        connector = connector_for(settings, session, user="busway.open on an event loop")
        link = AsyncLinkDriver(connector, session, settings, shared=shared, scope=scope)
        if scope is not None:
            scope.enter(link)
        self._links.setdefault(settings.endpoint.url, WeakKeyDictionary())[link] = None
        return link


_pools: "WeakKeyDictionary[asyncio.AbstractEventLoop, LinkPool]" = WeakKeyDictionary()


def pool_of_running_loop() -> LinkPool:
    """The pool of links that belongs to the running event loop."""
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        raise ConfigError(
            "a link of busway.open is used in coroutines; busway.connect is for blocking programs"
        ) from None
    pool = _pools.get(loop)
    if pool is None:
        for ended in [one for one in _pools if one.is_closed()]:
            del _pools[ended]  # links that were never closed refer to their loop, and would keep it alive here
        pool = _pools[loop] = LinkPool()
    return pool
