"""The status of a server: data classes for the server, its listeners and connections. Times are seconds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from ..session.diagnostic_counters import DiagnosticCounters
from ..transport.network_interfaces import Interface
from .connection_slots import SlotPool
from .server_counters import ServerCounters
from .status_indicators import StatusIndicators


class ServedConnectionState(Enum):
    """States of a connection in the status of a server.

    Attributes:
        IDLE: no request is in progress.
        RECEIVING: a request is received in part.
        BUSY: a request is in progress or waits for its turn, or a reply is unsent.
        PAUSED: nothing is read: the host is above its rate, or does not read its replies, or the server stops.
        CLOSING: the connection is closed as soon as the written replies are sent.
    """

    IDLE = "idle"
    RECEIVING = "receiving"
    BUSY = "busy"
    PAUSED = "paused"
    CLOSING = "closing"


@dataclass(frozen=True, slots=True)
class ConnectionStatus:
    """The status of one connection, or of one peer over UDP.

    Attributes:
        peer: ``host:port`` of the client.
        listener: URL of the listener.
        state: the state of the connection.
        pool: the pool of its connection slot.
        role, subject: of the client's certificate; None and empty without one.
        age: seconds since the connection was accepted.
        idle: seconds since it was last used.
        received, sent: bytes.
        requests: requests so far.
        waiting: requests in progress, without a reply yet.
    """

    peer: str
    listener: str
    state: ServedConnectionState
    pool: SlotPool
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
        not_after: when that certificate expires, in seconds since 1970.
        days_left: days until it expires; negative afterwards.
        reloads: how often the files of certificates were read again since the start.
        handshakes: number of handshakes in progress.
        established: number of completed handshakes.
        resumed: how many of the completed handshakes resumed a session.
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
        endpoint: URL of the listener, with the port that is really bound.
        is_open: whether the listener can be reached: False while its serial port is waited for.
        indicators: the states of its status indicators.
        counters: the diagnostic counters of function 08 (Serial Line V1.02 appendix A). Bus messages, communication
            errors and overruns are those of the line since the start, even if a unit has cleared its own. The others
            are sums over its units, since the last restart or clear of each; a broadcast counts once for each unit.
        event_count: number of successful messages (function 11), the sum over its units.
        listen_only: whether a unit is in listen-only mode: it answers nothing until it is restarted.
        listen_only_units: the units in listen-only mode, in ascending order.
        requests: requests for own units since the start.
        foreign: frames on a serial line that were not for own units; 0 on TCP.
        damaged: on a serial line, damaged frames; on UDP, datagrams that were no whole frame; on TCP, connections whose
            bytes were no valid sequence of frames, or with a frame that did not end in time.
        abandoned: answers on a serial line that were not sent because another frame came first.
        echoes: own answers on a serial line that the port received back, and that the option ``echo`` did not remove.
        priority_connections, other_connections: used connection slots of the two pools.
        interfaces: network interfaces with the addresses that it is bound to, as far as known.
        security: certificate and handshakes of a ``tls://`` listener; None for other listeners.
    """

    endpoint: str
    is_open: bool
    indicators: StatusIndicators
    counters: DiagnosticCounters
    event_count: int
    listen_only: bool
    listen_only_units: tuple[int, ...] = ()
    requests: int = 0
    foreign: int = 0
    damaged: int = 0
    abandoned: int = 0
    echoes: int = 0
    priority_connections: int = 0
    other_connections: int = 0
    interfaces: tuple[Interface, ...] = ()
    security: SecurityStatus | None = None


@dataclass(frozen=True, slots=True)
class ServerStatus:
    """The status of a server: its listeners, connections and counters.

    Attributes:
        running: whether the server is started.
        uptime: seconds since the start; 0 while stopped.
        endpoints: URLs of the listeners with the ports that are really bound.
        connections: open connections and UDP peers, by listener, the oldest of each listener first.
        supported_connections: limit of TCP and TLS connections, all listeners and both pools together.
        remote_connections: number of ``connections``.
        local_connections: number of connections that this program has open towards other devices.
        counters: counts since the server was created or reset.
        listeners: the listeners, with their status indicators and diagnostic counters.
        refusals: number of requests that the policy has refused, by the name of the rule.
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
