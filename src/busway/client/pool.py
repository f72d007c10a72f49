"""Links by endpoint: one shared connection for all users on an event loop (Messaging on TCP/IP V1.0b §4.2.1).

Knows who uses which link; knows nothing of what is asked.

1. Automatic management: users of one endpoint share its link; the last one to leave closes it.
2. Explicit management: a link that is not shared belongs to its user alone.
3. Two users who want different connections can not share one: the second is told which setting differs.
"""

import asyncio
from dataclasses import dataclass
from weakref import WeakKeyDictionary

from ..errors import ConfigError
from .calls import check_same
from .connector import connector_for
from .conversation import conversation_for
from .link import Link
from .settings import LinkSettings


@dataclass(slots=True)
class _Shared:
    settings: LinkSettings
    link: Link
    users: int = 0


class LinkPool:
    """The links of one event loop."""

    def __init__(self) -> None:
        self._shared: dict[str, _Shared] = {}

    def acquire(self, settings: LinkSettings, *, shared: bool) -> Link:
        """A link for one more user. Raises `ConfigError`."""
        name = settings.endpoint.url
        if not shared:
            return _make(settings)
        entry = self._shared.get(name)
        if entry is None:
            entry = self._shared[name] = _Shared(settings, _make(settings))
        check_same(entry.settings, settings)
        entry.users += 1
        return entry.link

    async def release(self, settings: LinkSettings, link: Link) -> None:
        """A user leaves."""
        name = settings.endpoint.url
        entry = self._shared.get(name)
        if entry is not None and entry.link is link:
            entry.users -= 1
            if entry.users:
                return
            del self._shared[name]
        await link.close()


def _make(settings: LinkSettings) -> Link:
    session = conversation_for(settings)
    connector = connector_for(settings, session, user="busway.open on an event loop")
    return Link(connector, session, settings)


_pools: "WeakKeyDictionary[asyncio.AbstractEventLoop, LinkPool]" = WeakKeyDictionary()


def pool_of_running_loop() -> LinkPool:
    """The pool of the running event loop."""
    try:
        loop = asyncio.get_running_loop()
    except RuntimeError:
        raise ConfigError(
            "a link of busway.open is used in coroutines; busway.connect is for blocking programs"
        ) from None
    return _pools.setdefault(loop, LinkPool())
