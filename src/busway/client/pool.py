"""The links of an event loop: one shared connection for all users of an endpoint (the rules are in `shared_links`)."""

import asyncio
from weakref import WeakKeyDictionary

from ..errors import ConfigError
from ..options.client import LinkSelection
from .connector import connector_for
from .link import AsyncLinkDriver
from .sessions import client_session_for
from .settings import LinkSettings
from .shared_limit import ClientScope
from .shared_links import SharedLinks


class LinkPool:
    """The asyncio links of one event loop: users of the same endpoint share one link, except with ``shared=False``."""

    def __init__(self) -> None:
        self._links: SharedLinks[AsyncLinkDriver] = SharedLinks(_made)

    def acquire(self, settings: LinkSettings, *, shared: bool) -> AsyncLinkDriver:
        """Return the link that all users of an endpoint share, or, if ``shared`` is False, a new link for the caller.

        The shared link is created for its first user. The caller is a user of the link until it calls `release`.
        Nothing is sent, and no connection opened.

        Raises:
            ConfigError: other users share the link with other connection settings, or a setting cannot be used.
            Overloaded: the endpoint already has ``max_connections`` links that are not shared.
        """
        return self._links.acquire(settings, shared=shared)

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> AsyncLinkDriver:
        """Return one of the links to an endpoint, for one request. Raises `LinkDown` if there is no link to it.

        ``rule`` chooses among the connected links: the one created first, or the one connected longest. If none is
        connected, it is the link created first.
        """
        return self._links.choose(settings, rule)

    async def release(self, settings: LinkSettings, link: AsyncLinkDriver) -> None:
        """Stop using a link that `acquire` returned; if this was its last user, close it and wait for that."""
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
    """Return the pool of links of the running event loop, created at the first call.

    Raises:
        ConfigError: no event loop is running, because the link is used outside a coroutine.
    """
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
