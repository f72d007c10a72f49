"""Blocking links by endpoint: one shared connection for all users in a process (see ``pool`` for the rules)."""

import threading
from dataclasses import dataclass

from .blocking_link import BlockingLink
from .calls import check_same
from .connector import connector_for
from .conversation import conversation_for
from .settings import LinkSettings


@dataclass(slots=True)
class _Shared:
    settings: LinkSettings
    link: BlockingLink
    users: int = 0


class BlockingPool:
    """The blocking links of this process; safe from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._shared: dict[str, _Shared] = {}

    def acquire(self, settings: LinkSettings, *, shared: bool) -> BlockingLink:
        """A link for one more user. Raises `ConfigError`."""
        if not shared:
            return _make(settings)
        name = settings.endpoint.url
        with self._lock:
            entry = self._shared.get(name)
            if entry is None:
                entry = self._shared[name] = _Shared(settings, _make(settings))
            check_same(entry.settings, settings)
            entry.users += 1
            return entry.link

    def release(self, settings: LinkSettings, link: BlockingLink) -> None:
        """A user leaves; the last one closes the connection."""
        name = settings.endpoint.url
        with self._lock:
            entry = self._shared.get(name)
            if entry is not None and entry.link is link:
                entry.users -= 1
                if entry.users:
                    return
                del self._shared[name]
        link.close()


def _make(settings: LinkSettings) -> BlockingLink:
    session = conversation_for(settings)
    connector = connector_for(settings, session, user="busway.connect")
    return BlockingLink(connector, session, settings)


BLOCKING_POOL = BlockingPool()
