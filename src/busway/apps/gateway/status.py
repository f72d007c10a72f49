"""Data classes for the status of a gateway: its listeners, its upstreams, and totals.

Knows counters and states; knows no connection.
"""

from dataclasses import dataclass, fields

from ...server.server import ServerStatus
from ...server.server_counters import ServerCounters
from ...server.status import ConnectionStatus, ListenerStatus
from ...session.reconnect import ConnectionState
from .own_unit import STATES
from .router import GatewayListenerCounters
from .upstream import UpstreamStatus

_CONNECTED = frozenset({ConnectionState.UP.value, ConnectionState.SUSPECT.value})


@dataclass(frozen=True, slots=True)
class GatewayListenerStatus:
    """Status of one listener of a gateway.

    Attributes:
        name: name of the listener in routes.
        server: status of the listener's server.
        counters: counters of the requests that were not forwarded, and of broadcasts; the live object, which goes on
            counting.
    """

    name: str
    server: ServerStatus
    counters: GatewayListenerCounters


@dataclass(frozen=True, slots=True)
class GatewayStatus:
    """Status of a gateway: its listeners and upstreams, and totals of its listeners.

    Attributes:
        running: whether the gateway is started.
        uptime: seconds since the start; 0 while stopped.
        endpoints: URLs of the listeners, with the ports that they are bound to; empty while stopped.
        gateway_listeners, upstreams: status of each listener and each upstream.
        open_requests: number of forwarded requests that are not answered yet.
    """

    running: bool
    uptime: float
    endpoints: tuple[str, ...]
    gateway_listeners: tuple[GatewayListenerStatus, ...]
    upstreams: tuple[UpstreamStatus, ...]
    open_requests: int

    @property
    def connections(self) -> tuple[ConnectionStatus, ...]:
        """The status of each open client connection, of all listeners."""
        return tuple(one for listener in self.gateway_listeners for one in listener.server.connections)

    @property
    def listeners(self) -> tuple[ListenerStatus, ...]:
        """The status of all listening addresses and ports of the gateway."""
        return tuple(one for listener in self.gateway_listeners for one in listener.server.listeners)

    @property
    def counters(self) -> ServerCounters:
        """The sums of the counters of all listeners of the gateway; a new object at each access."""
        total = ServerCounters()
        for listener in self.gateway_listeners:
            counted = listener.server.counters
            pairs = ((total, counted), (total.priority, counted.priority), (total.other, counted.other))
            for mine, theirs in pairs:
                for one in fields(mine):
                    value = getattr(mine, one.name)
                    if isinstance(value, int):
                        setattr(mine, one.name, value + getattr(theirs, one.name))
        return total

    @property
    def supported_connections(self) -> int:
        """The largest number of client connections that all listeners together accept at the same time."""
        return sum(listener.server.supported_connections for listener in self.gateway_listeners)

    @property
    def remote_connections(self) -> int:
        """The number of open connections from clients."""
        return sum(listener.server.remote_connections for listener in self.gateway_listeners)

    @property
    def local_connections(self) -> int:
        """The number of open connections to upstreams."""
        return sum(link.state in _CONNECTED for upstream in self.upstreams for link in upstream.links)


def upstream_numbers(upstream: UpstreamStatus) -> list[int]:
    """Return the values of an upstream for the status registers of the gateway's own unit.

    Their order is that of `busway.apps.gateway.own_unit.UPSTREAM_REGISTERS`. The first is the position of the state of
    the best connection in `busway.apps.gateway.own_unit.STATES`; 0 without a connection.
    """
    counters = upstream.counters
    return [
        max((STATES.index(one.state) for one in upstream.links), default=0),
        sum(one.in_flight for one in upstream.links),
        sum(one.queued for one in upstream.links),
        sum(len(one.suspended) for one in upstream.links),
        counters.forwarded,
        counters.answered,
        counters.exceptions,
        counters.no_answer,
        counters.no_path,
        counters.shared + counters.recalled,
    ]
