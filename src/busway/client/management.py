"""Options of connection management: how long a connection is held, pauses between attempts, number of connections.

Knows times and numbers; knows no connection (Messaging on TCP/IP V1.0b §4.2.1).
"""

import math
import socket
from dataclasses import dataclass
from enum import Enum

from ..errors import ConfigError

LONGEST_HOLD = 86_400.0
"""Seconds, one day; for longer use ``forever``."""


class Hold(Enum):
    """Hold times of an unused connection other than a number of seconds.

    Attributes:
        FOREVER: until its last user closes the link, as Messaging on TCP/IP V1.0b §4.2.1.1 advises.
        REQUEST: until no request needs it; for devices that take one client and are shared between programs.
    """

    FOREVER = "forever"
    REQUEST = "request"


class LinkSelection(Enum):
    """Which of several connections to one remote takes a request (Messaging on TCP/IP V1.0b §4.2.1.2).

    Attributes:
        FIRST: the one whose link was made first.
        OLDEST: the one that has been open longest.
    """

    FIRST = "first"
    OLDEST = "oldest"


@dataclass(frozen=True, slots=True)
class ManagementParameters:
    """How the connections of a link are managed (Messaging on TCP/IP V1.0b §4.2.1).

    Attributes:
        hold: seconds that an unused connection is kept; ``forever``, or ``request``: until no request needs
            it.
        reconnect_first, reconnect_most: seconds between attempts to connect to a peer that does not answer: the first
            pause, which doubles, and the longest.
        max_connections: links with a connection of their own (``shared=False``) to one endpoint, on an event loop or,
            blocking, in the process; one more is refused with `Overloaded`.
        interface: name of the network interface to connect through; None leaves it to the routes of the
            system. TCP only, and only on systems that support it (Linux).
    """

    hold: float | Hold = Hold.FOREVER
    reconnect_first: float = 0.1
    reconnect_most: float = 5.0
    max_connections: int = 8
    interface: str | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.hold, Hold) and not 0.01 <= self.hold <= LONGEST_HOLD:
            raise ConfigError(f"must be 0.01…{LONGEST_HOLD:g}, forever or request, not {self.hold:g}", key="hold")
        for key, value in (("reconnect_first", self.reconnect_first), ("reconnect_most", self.reconnect_most)):
            if not 0.001 <= value <= 3600:
                raise ConfigError(f"must be 0.001…3600, not {value:g}", key=key)
        if self.reconnect_first > self.reconnect_most:
            raise ConfigError(
                f"must be at most reconnect_most, {self.reconnect_most:g}, not {self.reconnect_first:g}",
                key="reconnect_first",
            )
        if not 1 <= self.max_connections <= 10_000:
            raise ConfigError(f"must be 1…10000, not {self.max_connections}", key="max_connections")
        if self.interface == "":
            raise ConfigError("must be the name of an interface", key="interface")
        if self.interface is not None and not hasattr(socket, "SO_BINDTODEVICE"):
            raise ConfigError("this system cannot bind a connection to an interface", key="interface")

    @property
    def hold_seconds(self) -> float:
        """Seconds that an unused connection is kept: infinite for ``forever``, 0 for ``request``."""
        if isinstance(self.hold, Hold):
            return math.inf if self.hold is Hold.FOREVER else 0.0
        return self.hold


def selection(name: "str | LinkSelection | None") -> LinkSelection | None:
    """The selection rule of a name, as `busway.open` takes it. Raises `ConfigError`."""
    if name is None or isinstance(name, LinkSelection):
        return name
    try:
        return LinkSelection(name)
    except ValueError:
        raise ConfigError(f"must be first or oldest, not {name!r}", key="select") from None
