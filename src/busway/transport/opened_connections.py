"""Counts the connections that this process has opened as a client, for the status of a server in it.

Knows neither side: clients and servers do not know each other, and meet here in a number (NbLocalConnection of
Messaging on TCP/IP V1.0b §5.1.2).
"""

from collections.abc import Callable

_counts: list[Callable[[], int]] = []


def counted_by(count: Callable[[], int]) -> None:
    """Register a function that returns how many client connections its owner has open; called from any thread."""
    _counts.append(count)


def dialled_connections() -> int:
    """Return the number of client connections that this process has opened and not closed."""
    return sum(count() for count in _counts)
