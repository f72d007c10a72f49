"""The open client connections of this process: shows their status and limits their number.

Holds weak references to links; sends nothing.

1. A local connection is one that this process has opened (Messaging on TCP/IP V1.0b §4.2.1), by an asyncio or a
   blocking link.
2. At the limit the unused shared connection whose last use is longest ago is closed; its link reconnects at the next
   request. The connection of a link with ``shared=False`` is never closed for another one.
3. A connection of an asyncio link is closed only on its own event loop.
"""

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol
from weakref import WeakSet

from ..errors import ConfigError, LinkDown
from ..session.connection_life import ConnectionLife
from ..session.serial_client import SerialClientSession
from ..transport.connection_counter import counted_by
from .sessions import ClientSession

if TYPE_CHECKING:
    import asyncio  # for annotations only: blocking programs do not load it

DEFAULT_LIMIT: Final = 10_000
"""Default limit of open connections: more than any plant has devices, fewer than a system has local ports."""


@dataclass(frozen=True, slots=True)
class LocalConnectionStatus:
    """Status of one link of this process and of the connection that it has now.

    Attributes:
        endpoint: URL of the peer, without options.
        kind: ``asyncio`` or ``blocking``.
        shared: whether all users of the endpoint share the link; False: it belongs to one user (``shared=False``).
        state: ``down``, ``connecting``, ``up``, ``suspect`` (open, after a timeout) or ``backing off`` (a pause before
            an attempt to connect).
        local: local address and port of the connection; empty while not connected, and on a serial port.
        age: seconds since the connection was opened; None while not connected.
        idle: seconds since the connection was last used, 0 while a reply is awaited; None while not connected.
        sent_bytes, received_bytes: bytes on all connections of the link so far.
        transactions: number of requests sent.
        failures: number of timeouts, invalid replies and lost connections together.
        connections: how many connections the link has had, the present one included.
        in_flight: number of requests whose reply is awaited.
        queued: number of calls that have requests left to send.
        reason: why the last attempt to connect failed; empty while connected, and before the first failure.
        late_replies: number of replies received after their timeout; all were dropped.
        in_doubt: units that may still send late replies, ascending; always empty with Modbus TCP framing, where
            transaction identifiers show which replies are late.
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
    """Interface of an asyncio or blocking link for the registry of the links of this process.

    Attributes:
        home: the event loop that the link belongs to; None for a blocking link.
        shared: whether all users of the endpoint share the link.
        opened: when the last connection was opened, in seconds by the clock of the link.
        last_used: when the last connection was last used, in seconds by the clock of the link.
        sent_bytes, received_bytes: number of bytes on all connections of the link so far.
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
        """Close the link's connection if no call uses it. Returns whether it was closed.

        For an asyncio link it is called only on its own event loop.
        """


class LocalConnections:
    """The registry of all links of a process; safe to use from any thread.

    Attributes:
        supported: how many connections may be open at once.
    """

    def __init__(self, supported: int = DEFAULT_LIMIT) -> None:
        self.supported: int = supported
        self._links: WeakSet[LocalLink] = WeakSet()
        self._lock = threading.Lock()

    def add(self, link: LocalLink) -> None:
        """Add a new link to the registry, which refers to it only weakly."""
        with self._lock:
            self._links.add(link)

    def discard(self, link: LocalLink) -> None:
        """Remove a closed link from the registry of this process's links."""
        with self._lock:
            self._links.discard(link)

    def links(self) -> list[LocalLink]:
        """Return the links that are not closed, connected or not, except those whose event loop is closed."""
        with self._lock:
            links = list(self._links)
        return [link for link in links if link.home is None or not link.home.is_closed()]

    def count(self) -> int:
        """Return the number of client connections that the process has open."""
        return sum(link.is_connected for link in self.links())

    def limit(self, supported: int) -> None:
        """Set how many client connections may be open at once. Raises `ConfigError` if the number is not 1…65535."""
        if not 1 <= supported <= 65_535:
            raise ConfigError(f"must be 1…65535, not {supported}", key="supported")
        self.supported = supported

    def make_room(self, connecting: LocalLink, endpoint: str) -> None:
        """Close an unused connection if the process is at its limit; called before a link connects.

        Of the shared connections that no call uses, the one whose last use is longest ago is closed. Only connections
        of the same event loop and of blocking links are closed; for a blocking link, only those of blocking links.

        Args:
            connecting: the link that is about to connect.
            endpoint: URL of its peer, for the error.

        Raises:
            LinkDown: the process is at its limit, and no connection can be closed: they are in use, not shared, or of
                another event loop.
        """
        if len(self._links) <= self.supported:
            return
        standing = [link for link in self.links() if link.is_connected and link is not connecting]
        if len(standing) < self.supported:
            return
        candidates = [link for link in standing if link.shared and link.home in (None, connecting.home)]
        candidates.sort(key=lambda link: link.last_used)
        if not any(link.make_room() for link in candidates):
            raise LinkDown(
                f"no connection: all {self.supported} of this process are in use", kind="local", endpoint=endpoint
            )


LOCAL: Final = LocalConnections()
"""The registry of all links of this process."""

counted_by(LOCAL.count)


def local_connections() -> tuple[LocalConnectionStatus, ...]:
    """Return the status of every link of this process that is not closed, asyncio and blocking.

    They are sorted by endpoint, then by kind. Links that are not connected are in the list as well; links whose event
    loop is closed are not. Nothing is sent. Links in use on other threads can change while the list is made.
    """
    return tuple(sorted((link.status() for link in LOCAL.links()), key=lambda one: (one.endpoint, one.kind)))


def limit_local_connections(supported: int) -> None:
    """Set how many connections this process may have open at once; 10 000 by default.

    At the limit the unused shared connection whose last use is longest ago is closed for a new one; if all are in use,
    a request that needs a new connection fails with `LinkDown` (Messaging on TCP/IP V1.0b §4.2.1.1). A lower limit
    does not close connections that are open.

    Args:
        supported: the most connections that may be open, 1…65535.

    Raises:
        ConfigError: the number is out of range.
    """
    LOCAL.limit(supported)


def status_of(
    link: LocalLink, session: ClientSession, life: ConnectionLife, now: float, local: object
) -> LocalConnectionStatus:
    """Return the status of a link, collected from its driver, session and connections.

    Args:
        link: the driver of the link.
        session: the client session of the link.
        life: the state of the link's connections.
        now: the time in seconds, by the clock of the driver.
        local: local socket address, as ``getsockname`` returns it; None while not connected, and on a serial port.
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
        in_doubt=tuple(session.late_replies.in_doubt()) if isinstance(session, SerialClientSession) else (),
    )


def _address(name: object) -> str:
    """Return a socket address (host, port) as ``host:port``, IPv6 in brackets; empty for any other value."""
    if not isinstance(name, tuple) or len(name) < 2:
        return ""
    host = f"[{name[0]}]" if ":" in str(name[0]) else name[0]
    return f"{host}:{name[1]}"
