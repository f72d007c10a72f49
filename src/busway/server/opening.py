"""Opens the listeners of a server, each by its kind: TCP and TLS, UDP, serial.

Knows the kinds of listeners and what they are made of; keeps none. Each kind is imported when one is opened.
"""

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..access.addresses import HostAuthorizer, both
from ..codes import LAST_SERIAL_UNIT
from ..errors import ConfigError
from ..options.endpoints import Endpoint
from ..options.server import ListenerParameters, ServerParameters
from ..options.sockets import SocketParameters
from ..session.responder import Responder, SerialUnits
from ..session.server_pipeline import RequestPipeline
from ..session.server_transaction_slots import ServerTransactionSlots
from ..transport.epoll.watcher import EpollSet, epoll_set_for
from ..transport.tcp import network_reason
from .connection_management import ConnectionManagement, ManagedConnection
from .connection_slots import ConnectionSlots, SlotLimits
from .connection_tap import ConnectionTap
from .listener_context import ListenerContext
from .listener_settings import ListenerSettings
from .server_counters import ServerCounters
from .tcp import TcpListener
from .turns import Turns

if TYPE_CHECKING:
    from .serial_listener import SerialListener
    from .udp import UdpListener

_log = logging.getLogger("busway.server")


@dataclass(slots=True)
class Opening:
    """Opens all listeners of a server when it starts; holds what they share.

    Attributes:
        loop: the event loop that the listeners run on.
        pipeline: answers the requests.
        parameters: options of the server's sessions.
        limits: limits and timeouts of connections, for listeners without their own.
        sockets: parameters of sockets.
        counters: the server's counters.
        authorize: called with a client's host; returns whether it may connect.
        tap: is told of opened and closed connections, and can send on them; None without one.
        slots: limit of requests at once, for the whole server; used unless each connection has its own.
        shared_slots: connection slots shared by the listeners that have no limits of their own.
        epoll_set: epoll object that all TCP connections share; None if the event loop cannot use one.
        turns: queue of connections with more requests than one turn of the loop allows.
    """

    loop: asyncio.AbstractEventLoop
    pipeline: RequestPipeline
    parameters: ServerParameters
    limits: ListenerParameters
    sockets: SocketParameters
    counters: ServerCounters
    authorize: HostAuthorizer
    tap: ConnectionTap | None = None
    slots: ServerTransactionSlots = field(init=False)
    shared_slots: ConnectionSlots[ManagedConnection] = field(init=False)
    epoll_set: EpollSet | None = field(init=False)
    turns: Turns = field(init=False)

    def __post_init__(self) -> None:
        self.slots = ServerTransactionSlots(self.parameters.max_transactions)
        self.shared_slots = ConnectionSlots(SlotLimits.of(self.limits))
        self.epoll_set = epoll_set_for(self.loop)
        self.turns = Turns(self.loop)

    async def streams(self, settings: ListenerSettings) -> TcpListener | None:
        """Open a TCP or TLS listener.

        If the listener is optional (``is_optional``) and its sockets cannot be opened, that is logged and None is
        returned.

        Raises:
            OSError: a socket cannot be opened or bound, or the host is not known; not for an optional listener.
            ConfigError: an option cannot be applied, or a certificate file cannot be used.
        """
        limits = settings.limits
        shares = limits.shared_slots and limits is self.limits
        management = ConnectionManagement(
            self._listener_context(settings),
            self.shared_slots if shares else ConnectionSlots(SlotLimits.of(limits)),
            self.sockets,
            self.turns,
        )
        listener = TcpListener(management, settings, self.sockets, self.epoll_set)
        try:
            await listener.open()
        except OSError as error:
            if not settings.is_optional:
                raise
            reason = network_reason(error)
            _log.warning("%s: not listened on beside the other port: %s", settings.endpoint.url, reason)
            return None
        return listener

    async def datagrams(self, settings: ListenerSettings) -> "UdpListener":
        """Open a UDP listener. Raises `OSError` if it cannot be bound, `ConfigError` if an option cannot be applied."""
        from .udp import UdpListener

        listener = UdpListener(self._listener_context(settings), self.sockets)
        await listener.open()
        return listener

    async def line(self, settings: ListenerSettings) -> "SerialListener":
        """Open a listener on a serial port; an absent port is waited for in the background.

        Raises `LinkDown` and `ConfigError` as `SerialListener.open` does.
        """
        from .serial_listener import SerialListener

        line = SerialListener(
            self.loop,
            settings,
            self.pipeline,
            serial_units(self.pipeline.responder, settings.endpoint),
            counters=self.counters,
            changes_allowed=self.parameters.diagnostics_changes is not False,
            tap=self.tap,
        )
        await line.open()
        return line

    def _listener_context(self, settings: ListenerSettings) -> ListenerContext:
        endpoint = settings.endpoint
        return ListenerContext(
            self.loop,
            self.pipeline,
            settings,
            session_parameters=self.parameters,
            counters=self.counters,
            slots=self.slots,
            units=() if endpoint.framing == "mbap" else serial_units(self.pipeline.responder, endpoint),
            authorize=both(self.authorize, settings.access),
            tap=self.tap,
        )


def serial_units(responder: Responder, endpoint: Endpoint) -> SerialUnits:
    """Return the units that a responder answers for on a serial line. Raises `ConfigError` if it has none of 1…247.

    ``endpoint`` is the listener's, for the error.
    """
    units = SerialUnits(responder)
    if not any(unit in units for unit in range(1, LAST_SERIAL_UNIT + 1)):
        raise ConfigError(f"{endpoint.url}: at least one unit 1…{LAST_SERIAL_UNIT} is needed on a line", key="units")
    return units
