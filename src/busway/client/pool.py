"""The links of an event loop: one shared connection for all users of an endpoint (`shared_links` has the rules)."""

import asyncio
from weakref import WeakKeyDictionary

from ..errors import ConfigError
from ..options.client import LinkSelection
from .connector import connector_for
from .link import AsyncLinkDriver
from .scope import ClientScope
from .sessions import client_session_for
from .settings import LinkSettings
from .shared_links import SharedLinks


class LinkPool:
    """All asyncio links of one event loop by endpoint, shared by their users."""

    def __init__(self) -> None:
        self._links: SharedLinks[AsyncLinkDriver] = SharedLinks(_made)

    def acquire(self, settings: LinkSettings, *, shared: bool) -> AsyncLinkDriver:
        """Return the shared link to an endpoint, created if necessary. Raises `ConfigError`, `Overloaded`."""
        return self._links.acquire(settings, shared=shared)

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> AsyncLinkDriver:
        """Choose one of several links to the same endpoint for a request. Raises `LinkDown` if there are none."""
        return self._links.choose(settings, rule)

    async def release(self, settings: LinkSettings, link: AsyncLinkDriver) -> None:
        """Give a link back after use; when its last user does, its connection is closed."""
        if self._links.release(settings, link):
            await link.close()


def _made(settings: LinkSettings, shared: bool, scope: ClientScope | None) -> AsyncLinkDriver:
    session = client_session_for(settings, None if scope is None else scope.slots)
    connector = connector_for(settings, session, user="busway.open on an event loop")
    link = AsyncLinkDriver(connector, session, settings, shared=shared, scope=scope)
    if scope is not None:
        scope.enter(link)
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
