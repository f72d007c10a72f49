"""Address lists: which hosts may connect; allow and deny lists, and secure mode (Messaging on TCP/IP V1.0b §4.2.3).

Knows hosts; knows no request. A host is checked before a byte of it is parsed.

1. The deny list goes before the allow list, however specific their entries are, so that the two lists can be read one
   by one.
2. In secure mode every host that is not in the allow list is refused. An allow list switches secure mode on, unless
   ``secure=False`` is given too. An empty allow list is an error, unless ``secure`` is given: it could mean that no
   host may connect.
"""

from collections.abc import Callable, Iterable

from ..errors import ConfigError
from ..options.networks import Networks

HostAuthorizer = Callable[[str], bool]
"""Function that takes the numeric address of a client, ``10.0.0.7`` or ``fe80::1``; returns whether it may connect."""


def allow_all(host: str) -> bool:
    """Return True for every host: the host check of a server without an address list."""
    return True


def both(server: HostAuthorizer, listener: HostAuthorizer | None) -> HostAuthorizer:
    """Return a host check that permits a host only if the server's check and the listener's check both permit it.

    If ``listener`` is None, the result is ``server`` itself.
    """
    if listener is None:
        return server
    if server is allow_all:
        return listener
    return lambda host: server(host) and listener(host)


class AddressList:
    """The hosts and networks that may or may not connect to a server, which takes such a list as its ``authorize``.

    Calling it with the numeric address of a host returns whether the host may connect: ``access("10.0.0.7")``.

    Args:
        allow: addresses and networks that may connect, as `Networks` takes them; None: no list.
        deny: addresses and networks that may not connect, even if ``allow`` has them.
        secure: whether a host that is in neither list is refused; None: only if ``allow`` is given.

    Attributes:
        allow, deny, secure: the same; ``secure`` is True or False.

    Raises:
        ConfigError: an entry is no address or network; the error names the entry. Or ``allow`` is empty, and ``secure``
            is None.
    """

    __slots__ = ("allow", "deny", "secure")

    def __init__(
        self,
        allow: Networks | Iterable[str] | None = None,
        deny: Networks | Iterable[str] = (),
        secure: bool | None = None,
    ) -> None:
        is_given = allow is not None
        self.allow: Networks = allow if isinstance(allow, Networks) else Networks(allow or (), key="allow")
        if is_given and not self.allow and secure is None:
            raise ConfigError("is empty: leave it out for all hosts, or add secure = true for none", key="allow")
        self.deny: Networks = deny if isinstance(deny, Networks) else Networks(deny, key="deny")
        self.secure: bool = bool(self.allow) if secure is None else secure

    def __call__(self, host: str) -> bool:
        return host not in self.deny and (not self.secure or host in self.allow)

    def why(self, host: str) -> str:
        """Return in words, for a log, why a host may or may not connect, such as ``denied by 10.0.0.0/8``."""
        denied = self.deny.find(host)
        if denied is not None:
            return f"denied by {denied}"
        allowed = self.allow.find(host)
        if allowed is not None:
            return f"allowed by {allowed}"
        return "not listed, in secure mode" if self.secure else "not denied"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, AddressList) and (self.allow, self.deny, self.secure) == (
            other.allow,
            other.deny,
            other.secure,
        )

    def __hash__(self) -> int:
        return hash((self.allow, self.deny, self.secure))

    def __repr__(self) -> str:
        return f"AddressList(allow={list(self.allow)}, deny={list(self.deny)}, secure={self.secure})"
