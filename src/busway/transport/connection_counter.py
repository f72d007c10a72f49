"""Counts the connections that this process has opened as a client; a server in the same process reports the number.

Clients and servers do not import each other. Clients register here a function that counts their connections, and
servers ask here for the sum (NbLocalConnection of Messaging on TCP/IP V1.0b §5.1.2).
"""

from collections.abc import Callable

_counts: list[Callable[[], int]] = []


def counted_by(count: Callable[[], int]) -> None:
    """Register a function that returns a number of open client connections, for `dialled_connections`.

    The function must be safe to call from any thread.
    """
    _counts.append(count)


def dialled_connections() -> int:
    """Return the number of open client connections of this process: the sum of what all registered functions return."""
    return sum(count() for count in _counts)
