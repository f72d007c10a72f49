"""Registry of the client connections of this process: shows their status and limits their number.

Holds links weakly and asks only them, never a peer.

1. A connection is local where this process opened it (Messaging on TCP/IP V1.0b §4.2.1): those of asyncio and of
   blocking links count alike.
2. At the limit the unused shared connection whose last use is longest ago is closed; its link reconnects at the next
   request. A connection of explicit management (``shared=False``) is never closed for another.
3. A connection of an event loop is closed by that loop alone.
"""

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol
from weakref import WeakSet

from ..errors import ConfigError, LinkDown
from ..session.connection_life import ConnectionLife
from ..session.serial_client import SerialClientSession
from ..transport.opened_connections import counted_by
from .sessions import ClientSession

if TYPE_CHECKING:
    import asyncio  # for annotations only: blocking programs do not load it

DEFAULT_LIMIT: Final = 10_000
"""Default limit of connections: more than any plant has devices, fewer than there are local ports."""


@dataclass(frozen=True, slots=True)
class LocalConnectionStatus:
    """Status of one link of this process and of the connection that it has now.

    Attributes:
        endpoint: URL of the peer, without options.
        kind: ``asyncio`` or ``blocking``.
        shared: whether all users share it (automatic management), or it belongs to one (explicit management).
        state: ``down``, ``connecting``, ``up``, ``suspect`` or ``backing off``.
        local: local address and port of the connection; empty while not connected, and on a serial port.
        age: seconds since the connection was opened; None while not connected.
        idle: seconds since it was last used, 0 while a reply is awaited; None while not connected.
        sent_bytes, received_bytes: of all connections of the link so far.
        transactions: number of requests sent.
        failures: requests without a reply or with a broken one, and connections that were lost.
        connections: how many connections the link has had.
        in_flight: requests whose reply is awaited.
        queued: calls that wait.
        reason: why it is not connected; empty while connected, or if no connection was needed yet.
        late_replies: replies that came after their timeout; all were dropped.
        in_doubt: units that may still send late replies, on links without transaction numbers.
    """

    endpoint: str
    kind: str
    shared: bool
    state: str
    local: str
    age: float | None
    idle: float | None
    sent_bytes: int
    received_bytes: int
    transactions: int
    failures: int
    connections: int
    in_flight: int
    queued: int
    reason: str
    late_replies: int = 0
    in_doubt: tuple[int, ...] = ()


class LocalLink(Protocol):
    """Interface of a link as the registry of the process's links uses it.

    Attributes:
        home: the event loop it lives on; None of a blocking link.
        shared: whether it is managed automatically.
        opened, last_used: when the connection was made, and last used, in the clock of the link.
        sent_bytes, received_bytes: of all its connections.
    """

    home: "asyncio.AbstractEventLoop | None"
    shared: bool
    opened: float
    last_used: float
    sent_bytes: int
    received_bytes: int

    @property
    def is_connected(self) -> bool:
        """Whether the link has an open connection now."""

    def status(self) -> LocalConnectionStatus:
        """Return state, traffic and counters of the link at this moment."""

    def make_room(self) -> bool:
        """Close the link's connection unless a call uses it; returns whether it did. Called on the link's own event
        loop.
        """


class LocalConnections:
    """The registry of all links of a process; safe from any thread.

    Attributes:
        supported: how many connections there may be at once.
    """

    def __init__(self, supported: int = DEFAULT_LIMIT) -> None:
        self.supported: int = supported
        self._links: WeakSet[LocalLink] = WeakSet()
        self._lock = threading.Lock()

    def add(self, link: LocalLink) -> None:
        """Add a new link to the registry of this process's links."""
        with self._lock:
            self._links.add(link)

    def discard(self, link: LocalLink) -> None:
        """Remove a closed link from the registry of this process's links."""
        with self._lock:
            self._links.discard(link)

    def links(self) -> list[LocalLink]:
        """The open links, except those whose event loop has ended."""
        with self._lock:
            links = list(self._links)
        return [link for link in links if link.home is None or not link.home.is_closed()]

    def count(self) -> int:
        """Number of client connections that the process has open."""
        return sum(link.is_connected for link in self.links())

    def limit(self, supported: int) -> None:
        """Set the limit of open client connections of the process. Raises `ConfigError` outside 1…65535."""
        if not 1 <= supported <= 65_535:
            raise ConfigError(f"must be 1…65535, not {supported}", key="supported")
        self.supported = supported

    def make_room(self, newcomer: LocalLink, endpoint: str) -> None:
        """Close an unused connection if the process is at its limit. Raises `LinkDown` if all are in use."""
        if len(self._links) <= self.supported:
            return
        standing = [link for link in self.links() if link.is_connected and link is not newcomer]
        if len(standing) < self.supported:
            return
        candidates = [link for link in standing if link.shared and link.home in (None, newcomer.home)]
        candidates.sort(key=lambda link: link.last_used)
        if not any(link.make_room() for link in candidates):
            raise LinkDown(
                f"no connection: all {self.supported} of this process are in use", kind="local", endpoint=endpoint
            )


LOCAL: Final = LocalConnections()
"""The registry of this process."""

counted_by(LOCAL.count)


def local_connections() -> tuple[LocalConnectionStatus, ...]:
    """Status of every open link of this process, asyncio and blocking, sorted by endpoint.

    Nothing is sent. Closed links are not listed. Links at work on other threads may change while the list is made.
    """
    return tuple(sorted((link.status() for link in LOCAL.links()), key=lambda one: (one.endpoint, one.kind)))


def limit_local_connections(supported: int) -> None:
    """Set how many connections this process may have open at once; 10 000 by default.

    At the limit the unused shared connection whose last use is longest ago is closed; if all are in use, a request
    that needs a new one ends as `LinkDown` (Messaging on TCP/IP V1.0b §4.2.1.1). Open connections stay open.

    Args:
        supported: connections, 1…65535.

    Raises:
        ConfigError: the number is out of range.
    """
    LOCAL.limit(supported)


def status_of(
    link: LocalLink, session: ClientSession, life: ConnectionLife, now: float, local: object
) -> LocalConnectionStatus:
    """Return the status of a link, put together from its session and connection.

    Args:
        link, session, life: the driver, its session, and the life of its connections.
        now: the time, in the clock of the driver.
        local: local socket address; None if there is none.
    """
    stands = link.is_connected
    counters, in_flight = session.counters, session.in_flight
    return LocalConnectionStatus(
        endpoint=life.endpoint,
        kind="blocking" if link.home is None else "asyncio",
        shared=link.shared,
        state=life.reconnect.state.value,
        local=_address(local) if stands else "",
        age=now - link.opened if stands else None,
        idle=(0.0 if in_flight else max(now - link.last_used, 0.0)) if stands else None,
        sent_bytes=link.sent_bytes,
        received_bytes=link.received_bytes,
        transactions=counters.requests,
        failures=counters.timeouts + counters.bad_replies + counters.lost_connections,
        connections=counters.connections,
        in_flight=in_flight,
        queued=session.queued,
        reason="" if stands else life.down_because,
        late_replies=counters.late_replies,
        in_doubt=tuple(session.doubts.in_doubt()) if isinstance(session, SerialClientSession) else (),
    )


def _address(name: object) -> str:
    """Return a socket address as text: ``host:port``, IPv6 in brackets."""
    if not isinstance(name, tuple) or len(name) < 2:
        return ""
    host = f"[{name[0]}]" if ":" in str(name[0]) else name[0]
    return f"{host}:{name[1]}"
