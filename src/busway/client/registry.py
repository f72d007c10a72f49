"""The local connections of this process: which there are, how they do, and how many there may be.

Knows links by what they say of themselves; keeps none alive and asks nothing of a peer.

1. A connection is local where this process opened it (Messaging on TCP/IP V1.0b §4.2.1): those of asyncio and of
   blocking links count alike.
2. Past the limit the unused shared connection whose last use is longest ago makes room; its link connects again at
   the next need. A connection of explicit management is its user's, and is never closed for another.
3. A connection of an event loop is closed by that loop alone.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol
from weakref import WeakSet

from ..errors import ConfigError, LinkDown
from ..session.call_tracker import ClientCounters
from ..transport.dialled import counted_by

if TYPE_CHECKING:
    import asyncio  # only its name: blocking programs do without it

DEFAULT_LIMIT: Final = 10_000
"""Local connections of a process: more than any plant has devices, fewer than there are ports to leave from."""


@dataclass(frozen=True, slots=True)
class LocalConnectionStatus:
    """One link of this process and the connection it has at the moment.

    Attributes:
        endpoint: URL of the peer, without options.
        kind: ``asyncio`` or ``blocking``.
        shared: whether all users share it (automatic management), or it belongs to one (explicit management).
        state: ``down``, ``connecting``, ``up``, ``suspect`` or ``backing off``.
        local: address and port that the connection leaves from; empty where none stands, and on a serial port.
        age: seconds that the connection has stood; None where none stands.
        idle: seconds since it was last used, 0 while a reply is awaited; None where none stands.
        sent_bytes, received_bytes: of all connections of the link so far.
        transactions: requests that were sent.
        failures: requests without a reply or with a broken one, and connections that were lost.
        connections: how many connections the link has had.
        in_flight: requests whose reply is awaited.
        queued: calls that wait.
        reason: why no connection stands; empty where one does, or where none was needed yet.
        late_replies: replies that came when nobody waited for them any more; all were dropped.
        in_doubt: units that owe replies, on links without transaction numbers.
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
    """What the registry knows of a link.

    Attributes:
        home: the event loop it lives on; None of a blocking link.
        shared: whether it is managed automatically.
        last_used: when the connection was last used, in the clock of the link.
    """

    home: "asyncio.AbstractEventLoop | None"
    shared: bool
    last_used: float

    @property
    def is_connected(self) -> bool:
        """Whether a connection stands."""

    def status(self) -> LocalConnectionStatus:
        """How it does."""

    def make_room(self) -> bool:
        """Close the connection if nobody uses it; whether it was closed. Called on the loop it lives on."""


class LocalConnections:
    """The links of a process; safe from any thread.

    Attributes:
        supported: how many connections there may be at once.
    """

    def __init__(self, supported: int = DEFAULT_LIMIT) -> None:
        self.supported = supported
        self._links: WeakSet[LocalLink] = WeakSet()
        self._lock = threading.Lock()

    def add(self, link: LocalLink) -> None:
        """A link was made."""
        with self._lock:
            self._links.add(link)

    def discard(self, link: LocalLink) -> None:
        """A link was closed."""
        with self._lock:
            self._links.discard(link)

    def links(self) -> list[LocalLink]:
        """The links that are open, but for those whose event loop has ended."""
        with self._lock:
            links = list(self._links)
        return [link for link in links if link.home is None or not link.home.is_closed()]

    def count(self) -> int:
        """How many connections stand now."""
        return sum(link.is_connected for link in self.links())

    def limit(self, supported: int) -> None:
        """Set how many connections there may be. Raises `ConfigError` outside 1…65535."""
        if not 1 <= supported <= 65_535:
            raise ConfigError(f"must be 1…65535, not {supported}", key="supported")
        self.supported = supported

    def make_room(self, newcomer: LocalLink, endpoint: str) -> None:
        """See that ``newcomer`` may connect. Raises `LinkDown` where all connections are in use."""
        if len(self._links) <= self.supported:
            return
        standing = [link for link in self.links() if link.is_connected and link is not newcomer]
        if len(standing) < self.supported:
            return
        candidates = [link for link in standing if link.shared and link.home in (None, newcomer.home)]
        candidates.sort(key=lambda link: link.last_used)
        if not any(link.make_room() for link in candidates):
            raise LinkDown(f"no connection: all {self.supported} of this process are in use", endpoint=endpoint)


LOCAL: Final = LocalConnections()
"""Those of this process."""

counted_by(LOCAL.count)


def local_connections() -> tuple[LocalConnectionStatus, ...]:
    """How the links of this process do, asyncio and blocking, in the order of their endpoints.

    Nothing is sent. Links that were closed are not listed. Numbers that change meanwhile are those of about one moment.
    """
    return tuple(sorted((link.status() for link in LOCAL.links()), key=lambda one: (one.endpoint, one.kind)))


def limit_local_connections(supported: int) -> None:
    """Set how many connections this process may have opened at once: 10 000 at first.

    Past the limit the unused shared connection whose last use is longest ago is closed; where all are in use, a request
    that needs a new one ends as `LinkDown` (Messaging on TCP/IP V1.0b §4.2.1.1). What stands already is left alone.

    Args:
        supported: connections, 1…65535.

    Raises:
        ConfigError: the number is out of range.
    """
    LOCAL.limit(supported)


def status_of(
    link: LocalLink,
    *,
    endpoint: str,
    state: str,
    counters: ClientCounters,
    now: float,
    opened: float,
    local: object,
    traffic: tuple[int, int],
    waiting: tuple[int, int],
    reason: str,
    in_doubt: Sequence[int] = (),
) -> LocalConnectionStatus:
    """The status of a link from what its driver holds.

    Args:
        link: whose.
        endpoint: its URL.
        state: of its connection.
        counters: what happened on it.
        now: in its clock.
        opened: when the connection was made, in its clock.
        local: socket address that it leaves from; None where there is none.
        traffic: bytes sent and received.
        waiting: requests in flight, and calls in the queue.
        reason: why no connection stands.
        in_doubt: units that owe replies.
    """
    stands = link.is_connected
    return LocalConnectionStatus(
        endpoint=endpoint,
        kind="blocking" if link.home is None else "asyncio",
        shared=link.shared,
        state=state,
        local=_address(local) if stands else "",
        age=now - opened if stands else None,
        idle=(0.0 if waiting[0] else max(now - link.last_used, 0.0)) if stands else None,
        sent_bytes=traffic[0],
        received_bytes=traffic[1],
        transactions=counters.requests,
        failures=counters.timeouts + counters.bad_replies + counters.lost_connections,
        connections=counters.connections,
        in_flight=waiting[0],
        queued=waiting[1],
        reason="" if stands else reason,
        late_replies=counters.late_replies,
        in_doubt=tuple(in_doubt),
    )


def _address(name: object) -> str:
    """A socket address in the form of URLs."""
    if not isinstance(name, tuple) or len(name) < 2:
        return ""
    host = f"[{name[0]}]" if ":" in str(name[0]) else name[0]
    return f"{host}:{name[1]}"
