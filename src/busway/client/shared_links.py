"""Links by endpoint: who shares one, how many there are, and which link a request takes.

Knows links as the selection rules see them; knows no event loop, lock or request (Messaging on TCP/IP V1.0b §4.2.1).

1. Automatic management: users of one endpoint share its link; the last one to leave closes it.
2. Explicit management: a link that is not shared belongs to its user alone; there may be ``max_connections`` of them.
3. Users with different connection settings cannot share a link: the second gets an error that names the setting.
4. If several links lead to one endpoint, a rule chooses one for each request (§4.2.1.2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic
from weakref import WeakKeyDictionary

from ..options.client import LinkSelection, TransactionScope
from .checks import check_same
from .connection_choice import AnyLink, check_room, chosen
from .scope import ClientScope, same_scope
from .settings import LinkSettings


@dataclass(slots=True)
class _Shared(Generic[AnyLink]):
    settings: LinkSettings
    link: AnyLink
    users: int = 0


class SharedLinks(Generic[AnyLink]):
    """The links of one client by endpoint: one that all its users share, and those that are not shared.

    Args:
        make: makes a link from its settings, whether it is shared, and the scope that counts its transactions where
            ``max_transactions`` is for the whole client; None where it is for each link.
    """

    def __init__(self, make: Callable[[LinkSettings, bool, ClientScope | None], AnyLink]) -> None:
        self._make_link = make
        self._shared: dict[str, _Shared[AnyLink]] = {}
        self._links: dict[str, WeakKeyDictionary[AnyLink, None]] = {}  # in the order they were made
        self._scope: ClientScope | None = None

    def acquire(self, settings: LinkSettings, *, shared: bool) -> AnyLink:
        """Return the shared link to an endpoint, created if necessary. Raises `ConfigError`, `Overloaded`."""
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

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> AnyLink:
        """Choose one of several links to the same endpoint for a request. Raises `LinkDown` if there are none."""
        return chosen(list(self._links.get(settings.endpoint.url, ())), settings, rule)

    def release(self, settings: LinkSettings, link: AnyLink) -> bool:
        """Give a link back after use; returns whether that was the last user, who must close it."""
        name = settings.endpoint.url
        entry = self._shared.get(name)
        if entry is not None and entry.link is link:
            entry.users -= 1
            if entry.users:
                return False
            del self._shared[name]
        self._links[name].pop(link, None)
        if not self._links[name]:
            del self._links[name]
        return True

    def _make(self, settings: LinkSettings, *, shared: bool) -> AnyLink:
        scope = None
        if settings.parameters.scope is TransactionScope.CLIENT:
            scope = self._scope = same_scope(self._scope, settings.parameters.max_transactions)
        link = self._make_link(settings, shared, scope)
        self._links.setdefault(settings.endpoint.url, WeakKeyDictionary())[link] = None
        return link
