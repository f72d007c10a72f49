"""The status of a server: data classes for the server, its listeners and connections. Times are seconds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from ..session.diagnostics import Counters
from ..transport.interfaces import Interface
from .connection_slots import Pool
from .counters import ServerCounters
from .status_indicators import StatusIndicators


class ServedConnectionState(Enum):
    """States of a connection in the status of a server, such as closing or held back.

    Attributes:
        IDLE: no request is in progress.
        RECEIVING: a request is received in part.
        BUSY: a request is in progress, or a reply is unsent.
        HELD: reading is paused: its host is above its rate, or it does not read its replies.
        CLOSING: it is closed as soon as the written replies are sent.
    """

    IDLE = "idle"
    RECEIVING = "receiving"
    BUSY = "busy"
    HELD = "held"
    CLOSING = "closing"


@dataclass(frozen=True, slots=True)
class ConnectionStatus:
    """The status of one connection, or of one peer over UDP.

    Attributes:
        peer: ``host:port``.
        listener: URL of the listener.
        state: the state of the connection.
        pool: where it has its place.
        role, subject: of the client's certificate; None and empty without one.
        age: since it was accepted.
        idle: since it was used last.
        received, sent: bytes.
        requests: transactions so far.
        waiting: transactions in work.
    """

    peer: str
    listener: str
    state: ServedConnectionState
    pool: Pool
    role: str | None
    subject: str
    age: float
    idle: float
    received: int
    sent: int
    requests: int
    waiting: int


@dataclass(frozen=True, slots=True)
class SecurityStatus:
    """The TLS status of a listener: its certificate, and counts of handshakes and refusals.

    Attributes:
        subject: the subject of the listener's own certificate.
        not_after: when it expires, seconds since 1970.
        days_left: days until then; negative after it.
        reloads: how often the files were read again since the start.
        handshakes: number of pending handshakes.
        established: number of completed handshakes.
        resumed: how many of these resumed a session.
        refused: number of refusals by reason, such as "expired" or "no certificate".
        without_role: number of completed handshakes with a certificate without a role.
    """

    subject: str
    not_after: float
    days_left: float
    reloads: int
    handshakes: int
    established: int
    resumed: int
    refused: dict[str, int]
    without_role: int


@dataclass(frozen=True, slots=True)
class ListenerStatus:
    """The status of one listener: its URL, indicators, connections and counters.

    Attributes:
        endpoint: its URL, as it is bound.
        is_open: whether it can be reached: False while a port is waited for.
        indicators: the states of its status indicators.
        counters: the diagnostic counters of function 08 (Serial Line V1.02 appendix A). Bus messages, communication
            errors and overruns are those of the line since the start, whatever a unit has cleared. The others are sums
            over its units, since the last restart or clear of each; a broadcast counts once for each unit.
        event_count: successful messages (function 11), the sum over its units.
        listen_only: whether a unit answers nothing until it is restarted.
        listen_only_units: the units of which that is so, in ascending order.
        requests: requests for own units since the start.
        foreign: frames of others that passed by; 0 on TCP.
        damaged: disturbances; on UDP, datagrams that were no whole frame; on TCP, streams that could not be followed.
        abandoned: answers that did not leave because another station had spoken.
        priority_connections, other_connections: places of both pools that are taken.
        interfaces: what the system says of the addresses it is bound to, as far as it is known here.
        security: certificate and handshakes of a ``tls://`` listener; None for others.
    """

    endpoint: str
    is_open: bool
    indicators: StatusIndicators
    counters: Counters
    event_count: int
    listen_only: bool
    listen_only_units: tuple[int, ...] = ()
    requests: int = 0
    foreign: int = 0
    damaged: int = 0
    abandoned: int = 0
    priority_connections: int = 0
    other_connections: int = 0
    interfaces: tuple[Interface, ...] = ()
    security: SecurityStatus | None = None


@dataclass(frozen=True, slots=True)
class ServerStatus:
    """The status of a server: its listeners, connections and counters.

    Attributes:
        running: whether it answers.
        uptime: seconds since the start; 0 while stopped.
        endpoints: URLs of the listeners as they are bound.
        connections: the connections, the oldest first.
        supported_connections: how many there may be, all listeners and both pools together.
        remote_connections: how many there are.
        local_connections: how many this program has itself towards others.
        counters: what happened since the server was made or reset.
        listeners: the listeners, with their status indicators and diagnostic counters.
        refusals: requests that the policy has refused, by the name of the rule.
    """

    running: bool
    uptime: float
    endpoints: tuple[str, ...]
    connections: tuple[ConnectionStatus, ...]
    supported_connections: int
    remote_connections: int
    local_connections: int
    counters: ServerCounters
    listeners: tuple[ListenerStatus, ...] = ()
    refusals: Mapping[str, int] = field(default_factory=dict)
