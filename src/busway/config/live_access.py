"""Who may connect and who may do what, while a server runs: rules that can be replaced.

Knows rules and listeners; knows no connection.

1. A listener that the network can reach, and for which no policy was written, is read-only unless writes were allowed
   by name. Serial lines are not concerned, since they have to take broadcast writes; nor are loopback addresses.
2. Until a server is bound nobody knows which listeners those are: until then all network listeners are.
"""

from collections.abc import Iterable, Sequence
from typing import Final

from ..access.addresses import AddressList
from ..access.rules import Action, Policy, Rule
from ..options.endpoints import SCHEMES, parse_endpoint
from ..server.naming import is_loopback

UNASKED: Final = "beyond-loopback"
"""The name of the rule that makes a listener read-only for which nobody wrote a policy."""
NETWORK_SCHEMES: Final = tuple(f"{name}://" for name, scheme in SCHEMES.items() if scheme.carrier != "serial")
_LOCAL_NAMES: Final = frozenset({"localhost"})


class ReloadableAllowList:
    """Whether a host may connect, by lists that can be replaced: what a server asks with ``authorise``.

    Attributes:
        lists: all of them must permit a host.
    """

    def __init__(self, lists: Iterable[AddressList] = ()) -> None:
        self.lists: tuple[AddressList, ...] = tuple(lists)

    def __call__(self, host: str) -> bool:
        return all(permits(host) for permits in self.lists)


def reaches_network(url: str) -> bool:
    """Whether a listener on a URL can be reached by other hosts."""
    endpoint = parse_endpoint(url)
    return endpoint.carrier != "serial" and endpoint.host not in _LOCAL_NAMES and not is_loopback(endpoint.url)


def read_only_for(listeners: Sequence[str]) -> Policy:
    """Everybody may do everything, except by these listeners (URLs, or schemes): there only read."""
    rules = (Rule(name=UNASKED, action=Action.READ_ONLY, listeners=tuple(listeners)),) if listeners else ()
    return Policy(rules, Action.ALLOW)
