"""Warnings in the log for listeners that other hosts can reach.

Knows bound URLs and whether requests are authorized; changes nothing.

1. A listener on every address of the host (``0.0.0.0``, ``::``) is opened, and logged (Messaging V1.0b §4.3.3).
2. A server that accepts writes from every host that can reach it logs that once, with how to change it.
"""

import logging
from collections.abc import Sequence

from .bound_sockets import is_everywhere, is_loopback

_log = logging.getLogger("busway.server")


def warn_of_exposure(bound: Sequence[str], *, authorized: bool) -> None:
    """Log which listeners other hosts can reach, in at most two warnings.

    One names the listeners on all addresses of this host; the other, without a policy, all that are not on a loopback
    address, because every host may write there. Serial ports are left out.

    Args:
        bound: URLs of the bound listeners.
        authorized: whether a policy checks requests.
    """
    network = [url for url in bound if not url.split("://", 1)[1].startswith("/")]
    everywhere = [url for url in network if is_everywhere(url)]
    if everywhere:
        _log.warning("%s: every address of this host; name one to listen there alone", ", ".join(everywhere))
    reachable = [url for url in network if not is_loopback(url)]
    if reachable and not authorized:
        _log.warning(
            "%s: takes writes from every host that reaches it; "
            "policy=busway.Policy.read_only(), or a policy of your own, changes that",
            ", ".join(reachable),
        )
