"""Listeners without a policy: those that the network can reach are read-only.

Knows rules and the URLs of listeners; knows no connection, and not which policy is in force.

1. A listener that the network can reach, and for which no policy was written, is read-only unless writes were allowed
   explicitly. This does not concern serial lines, which have to take broadcast writes, nor loopback addresses.
2. Which listeners the network can reach is only known when the server is bound: until then all network listeners are
   read-only.
"""

from collections.abc import Sequence
from typing import Final

from ...access.rules import Action, Policy, Rule
from ...options.endpoints import SCHEMES, parse_endpoint
from ...server.bound_sockets import is_loopback

UNASKED: Final = "beyond-loopback"
"""Name of the rule that makes a listener without a policy read-only."""
NETWORK_SCHEMES: Final = tuple(f"{name}://" for name, scheme in SCHEMES.items() if scheme.carrier != "serial")
_LOCAL_NAMES: Final = frozenset({"localhost"})


def reaches_network(url: str) -> bool:
    """Return True if other hosts can reach a listener with this URL, False if only this host can.

    False for ``localhost``, numeric loopback addresses and serial lines; True for all others, also for other host
    names, which are not resolved. Raises `ConfigError` for an invalid URL.
    """
    endpoint = parse_endpoint(url)
    return endpoint.carrier != "serial" and endpoint.host not in _LOCAL_NAMES and not is_loopback(endpoint.url)


def read_only_for(listeners: Sequence[str]) -> Policy:
    """Return a policy that makes some listeners read-only and allows everything else.

    Args:
        listeners: URLs of the listeners, or schemes such as ``tcp://`` for all listeners of a scheme. If it is empty,
            the policy allows everything.
    """
    rules = (Rule(name=UNASKED, action=Action.READ_ONLY, listeners=tuple(listeners)),) if listeners else ()
    return Policy(rules, Action.ALLOW)
