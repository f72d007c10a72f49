"""Links by endpoint: who shares one, how many there are, and which link a request takes.

Knows of links only what the rules need; knows no event loop, lock or request (Messaging on TCP/IP V1.0b §4.2.1).

1. Automatic management: users of one endpoint share its link; when the last of them releases it, it is closed.
2. Explicit management: a link that is not shared belongs to its user alone; an endpoint may have ``max_connections``
   such links.
3. Users with different connection settings cannot share a link: the second gets an error that names the setting.
4. If there are several links to one endpoint, a rule chooses one for each request (§4.2.1.2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic
from weakref import WeakKeyDictionary

from ..errors import ConfigError
from ..options.client import LinkSelection, TransactionScope
from .connection_choice import AnyLink, check_room, chosen
from .settings import LinkSettings
from .shared_limit import ClientScope, same_scope


@dataclass(slots=True)
class _Shared(Generic[AnyLink]):
    """The link that the users of one endpoint share.

    Attributes:
        settings: the settings of the first user; the connection settings of further users must be equal.
        users: number of present users of the link.
    """

    settings: LinkSettings
    link: AnyLink
    users: int = 0


class SharedLinks(Generic[AnyLink]):
    """The links of one client: for each endpoint at most one shared link, and any number of links with one user.

    Args:
        make: creates a link; called as ``make(settings, shared, scope)``. ``shared``: whether the link may have several
            users. ``scope``: the limit of requests in flight that all links of the client share, with the option
            ``scope=client``; None if ``max_transactions`` limits each link by itself.
    """

    def __init__(self, make: Callable[[LinkSettings, bool, ClientScope | None], AnyLink]) -> None:
        self._make_link = make
        self._shared: dict[str, _Shared[AnyLink]] = {}
        self._links: dict[str, WeakKeyDictionary[AnyLink, None]] = {}  # in the order they were made
        self._scope: ClientScope | None = None

    def acquire(self, settings: LinkSettings, *, shared: bool) -> AnyLink:
        """Return the link that all users of an endpoint share, or, if ``shared`` is False, a new link for the caller.

        The shared link is created for its first user. The caller counts as a user of the link until it calls `release`.

        Raises:
            ConfigError: other users share the link with other connection settings, or a setting cannot be used.
            Overloaded: the endpoint already has ``max_connections`` links that are not shared.
        """
        name = settings.endpoint.url
        if not shared:
            check_room(list(self._links.get(name, ())), settings)
            return self._make(settings, shared=False)
        entry = self._shared.get(name)
        if entry is None:
            entry = self._shared[name] = _Shared(settings, self._make(settings, shared=True))
        _check_same(entry.settings, settings)
        entry.users += 1
        return entry.link

    def choose(self, settings: LinkSettings, rule: LinkSelection) -> AnyLink:
        """Return one of the links to an endpoint, for one request. Raises `LinkDown` if there is no link to it.

        ``rule`` chooses among the connected links: the one created first, or the one connected longest. If none is
        connected, it is the link created first.
        """
        return chosen(list(self._links.get(settings.endpoint.url, ())), settings, rule)

    def release(self, settings: LinkSettings, link: AnyLink) -> bool:
        """Remove one user from a link. Returns True if no user is left; then the caller must close the link.

        A link that is not shared has one user, so the result is always True for it.
        """
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


def _check_same(held: LinkSettings, wanted: LinkSettings) -> None:
    """Raise `ConfigError` if a further user of a shared link asks for connection settings that the link does not have.

    ``held``: the settings of the link; ``wanted``: those of the further user.
    """
    different = held.differs(wanted)
    if different:
        raise ConfigError(
            f"{held.endpoint.url} is open already with another {different}; shared=False gives a connection of its own",
            key=different,
        )
