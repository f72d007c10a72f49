"""How many connections this process has opened itself: told by who opens them, asked by who shows them.

Knows neither side: clients and servers do not know each other, and meet here in a number (NbLocalConnection of
Messaging on TCP/IP V1.0b §5.1.2).
"""

from collections.abc import Callable

_counts: list[Callable[[], int]] = []


def counted_by(count: Callable[[], int]) -> None:
    """Have ``count`` say how many of its connections stand; it is called from any thread."""
    _counts.append(count)


def dialled_connections() -> int:
    """How many connections this process has opened and not closed."""
    return sum(count() for count in _counts)
