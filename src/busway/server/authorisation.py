"""Whether a client may connect at all: a question that is asked before a byte of it is parsed.

Knows hosts; knows no request (Messaging on TCP/IP V1.0b §4.2.3, "IsConnectionAuthorized").
"""

from collections.abc import Callable

Authorise = Callable[[str], bool]
"""Takes the numeric address of a client, ``10.0.0.7`` or ``fe80::1``, and says whether it may connect."""


def allow_all(host: str) -> bool:
    """Nobody is refused."""
    return True


def both(server: Authorise, listener: Authorise | None) -> Authorise:
    """The question of a server, and that of one of its listeners beside it: both must say yes."""
    if listener is None:
        return server
    if server is allow_all:
        return listener
    return lambda host: server(host) and listener(host)
