"""A server: listeners in front of a handler. Start, stop, reset, status (Messaging on TCP/IP V1.0b §5.1.2).

Knows listeners and their life; knows no request.

1. It answers only between start and stop. Stopping ends within a second, whatever the clients do.
2. Start, stop and reset say what they did, or raise. A listener that can not be opened closes those opened before.
"""

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, fields, replace
from types import TracebackType
from typing import TYPE_CHECKING, Self

from ..codes import LAST_SERIAL_UNIT
from ..config.endpoints import Endpoint
from ..errors import ConfigError, LinkDown, ModbusError
from ..session.handler import Handler, UnitHolder
from ..session.parameters import ServerParameters
from ..session.server import TransactionSlots
from ..transport.tcp import SocketParameters, network_reason
from .authorisation import Authorise, both, everybody
from .connection import ServerConnection
from .connections import ConnectionManagement, ConnectionStatus, ServerCounters
from .limits import raise_open_file_limit
from .line import SerialListener
from .listener import Listener, as_listeners
from .listener_settings import ListenerSettings, listener_settings
from .parameters import ListenerParameters
from .status import ListenerStatus
from .udp import UdpListener

if TYPE_CHECKING:
    from ..transport.tls import TlsParameters

_STOP_SECONDS = 0.5
_TURNS_TO_SETTLE = 4
"""Turns of the loop until a connection that is being accepted stands, and until one that was closed has gone."""


@dataclass(frozen=True, slots=True)
class ServerStatus:
    """A server as a status shows it.

    Attributes:
        running: whether it answers.
        uptime: seconds since the start; 0 while stopped.
        endpoints: URLs of the listeners as they are bound.
        connections: the connections, the oldest first.
        supported_connections: how many there may be, all listeners together.
        counters: what happened since the server was made or reset.
        listeners: the listeners, with their lamps and diagnostic counters.
    """

    running: bool
    uptime: float
    endpoints: tuple[str, ...]
    connections: tuple[ConnectionStatus, ...]
    supported_connections: int
    counters: ServerCounters
    listeners: tuple[ListenerStatus, ...] = ()


class Server:
    """Listeners in front of one handler; an asynchronous context manager that starts and stops.

    Args:
        endpoints: URLs to listen on (``tcp://127.0.0.1:5020``), or `Listener` where one has settings of its own; port 0
            takes a free one, an empty host every interface, IPv4 and IPv6.
        handler: what answers.
        parameters: of the conversation, `ServerParameters`.
        listener: of connections, `ListenerParameters`.
        sockets: of sockets, `SocketParameters`.
        authorise: asked with a client's host before anything of it is read; False closes the connection.
        tls: certificate, key and authorities of the ``tls://`` listeners that have none of their own.

    Raises:
        ConfigError: an endpoint that can not be listened on.
    """

    def __init__(
        self,
        endpoints: Sequence[str | Endpoint | Listener],
        handler: Handler,
        *,
        parameters: ServerParameters | None = None,
        listener: ListenerParameters | None = None,
        sockets: SocketParameters | None = None,
        authorise: Authorise = everybody,
        tls: "TlsParameters | None" = None,
    ) -> None:
        limits = listener or ListenerParameters()
        self._settings = [listener_settings(one, limits=limits, tls=tls) for one in as_listeners(endpoints)]
        for settings in self._settings:
            if settings.endpoint.carrier == "tls" and settings.tls is None:
                raise ConfigError(f"{settings.endpoint}: a certificate and its key are needed", key="tls")
            if settings.endpoint.framing != "mbap":
                settings.line_framing(_serial_units(handler, settings.endpoint), handler.functions)
        self.authorise = authorise
        self._handler = handler
        self._parameters = parameters or ServerParameters()
        self._sockets = sockets or SocketParameters()
        self._listeners: list[asyncio.Server] = []
        self._datagrams: list[UdpListener] = []
        self._lines: list[SerialListener] = []
        self._managements: list[ConnectionManagement] = []
        self._bound: list[str] = []
        self._started = 0.0
        self.counters = ServerCounters()

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners as they are bound, with the real ports; empty while stopped."""
        return list(self._bound)

    @property
    def is_running(self) -> bool:
        """Whether it answers."""
        return bool(self._listeners or self._datagrams or self._lines)

    def wrap_handler(self, wrap: Callable[[Handler], Handler]) -> None:
        """Put a handler around the one that answers: to count, to record, to decide. Only while stopped.

        Raises:
            ConfigError: it is running, and conversations hold the handler already.
        """
        if self.is_running:
            raise ConfigError("a running server keeps its handler", key="handler")
        self._handler = wrap(self._handler)

    async def start(self) -> None:
        """Open all listeners. A serial port that is not there is waited for.

        Raises:
            LinkDown, ConfigError: a listener can not be had; then none is open.
        """
        if self.is_running:
            return
        raise_open_file_limit()
        loop = asyncio.get_running_loop()
        slots = TransactionSlots(self._parameters.max_transactions)
        self._managements.clear()
        try:
            for settings in self._settings:
                endpoint = settings.endpoint
                if endpoint.carrier == "serial":
                    await self._open_line(loop, settings)
                elif endpoint.carrier == "udp":
                    await self._open_datagram(loop, settings, slots)
                else:
                    await self._open(loop, settings, slots)
        except ModbusError as error:
            await self.stop()
            raise error.at(endpoint=endpoint.url) from error.__cause__
        except OSError as error:
            await self.stop()
            down = LinkDown(f"can not listen: {network_reason(error)}", endpoint=endpoint.url)
            raise down from error
        self._started = time.monotonic()

    async def _open_line(self, loop: asyncio.AbstractEventLoop, settings: ListenerSettings) -> None:
        line = SerialListener(
            loop,
            settings,
            self._handler,
            _serial_units(self._handler, settings.endpoint),
            counters=self.counters,
            changes_allowed=self._parameters.diagnostics_changes is not False,
        )
        await line.open()
        self._lines.append(line)
        self._bound.append(line.name)

    async def _open_datagram(
        self, loop: asyncio.AbstractEventLoop, settings: ListenerSettings, slots: TransactionSlots
    ) -> None:
        endpoint = settings.endpoint
        listener = UdpListener(
            loop,
            settings,
            self._handler,
            () if endpoint.framing == "mbap" else _serial_units(self._handler, endpoint),
            parameters=settings.limits,
            session_parameters=self._parameters,
            counters=self.counters,
            slots=slots,
            authorise=both(self.authorise, settings.access),
        )
        transport, _ = await loop.create_datagram_endpoint(
            lambda: listener, local_addr=(endpoint.host or "0.0.0.0", endpoint.port or 0)
        )
        self._datagrams.append(listener)
        bound = transport.get_extra_info("socket")
        self._sockets.apply_buffers(bound)
        listener.listener = _bound_name(endpoint.scheme, bound)
        self._bound.append(listener.listener)

    async def _open(self, loop: asyncio.AbstractEventLoop, settings: ListenerSettings, slots: TransactionSlots) -> None:
        endpoint = settings.endpoint
        management = ConnectionManagement(
            loop,
            self._handler,
            listener=endpoint.url,
            parameters=settings.limits,
            session_parameters=self._parameters,
            sockets=self._sockets,
            counters=self.counters,
            slots=slots,
            settings=settings,
            units=() if endpoint.framing == "mbap" else _serial_units(self._handler, endpoint),
            authorise=both(self.authorise, settings.access),
        )
        listener = await loop.create_server(
            _protocols(management, settings),
            endpoint.host or None,
            endpoint.port or 0,
            backlog=settings.limits.backlog,
            reuse_address=True,
        )
        self._listeners.append(listener)
        self._managements.append(management)
        for bound in listener.sockets:
            self._sockets.apply_buffers(bound)
        names = [_bound_name(endpoint.scheme, one) for one in listener.sockets]
        management.listener = names[0]
        management.diagnosis.is_open = True
        self._bound += names

    async def stop(self) -> None:
        """Close all listeners and connections. Replies that are written go out; after half a second nothing waits."""
        listeners, self._listeners = self._listeners, []
        self._bound.clear()
        try:
            await _accept_no_more(listeners)
        finally:
            for listener in listeners:
                listener.close()
        for management in self._managements:
            management.close_all()
        for management in self._managements:
            management.diagnosis.is_open = False
        datagrams, self._datagrams = self._datagrams, []
        for each in datagrams:
            each.close()
        lines, self._lines = self._lines, []
        waits = [management.wait_until_empty() for management in self._managements]
        waits += [each.wait_closed() for each in datagrams]
        waits += [line.close() for line in lines]
        self.counters.requests += sum(line.requests for line in lines)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*waits), _STOP_SECONDS)
        for management in self._managements:
            management.close_all(at_once=True)
        await _settle()
        self._started = 0.0

    async def reset(self) -> None:
        """Stop, clear the counters, start again."""
        await self.stop()
        self.counters = ServerCounters()
        await self.start()

    def reset_counters(self) -> None:
        """Set the counters to zero, of the living connections too; connections and listeners stay as they are."""
        now = self._counters_now()
        for field in fields(ServerCounters):
            kept = getattr(self.counters, field.name)
            # What a connection still holds is handed over when it ends, and must not count again then.
            setattr(self.counters, field.name, kept - getattr(now, field.name))

    async def serve_until_cancelled(self) -> None:
        """Start if need be, and serve until the task is cancelled; then stop."""
        await self.start()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self.stop()

    def status(self) -> ServerStatus:
        """How it stands now."""
        return ServerStatus(
            running=self.is_running,
            uptime=time.monotonic() - self._started if self._started else 0.0,
            endpoints=tuple(self._bound),
            connections=tuple(one for listener in self._with_peers() for one in listener.status()),
            supported_connections=sum(one.parameters.max_connections for one in self._managements),
            counters=self._counters_now(),
            listeners=(
                *(management.listener_status() for management in self._managements),
                *(listener.listener_status() for listener in self._datagrams),
                *(line.status() for line in self._lines),
            ),
        )

    def _with_peers(self) -> "list[ConnectionManagement | UdpListener]":
        return [*self._managements, *self._datagrams]

    def _counters_now(self) -> ServerCounters:
        """The counters, with what the living connections have not handed over yet."""
        living = [one for listener in self._with_peers() for one in listener.sessions()]
        return replace(
            self.counters,
            requests=self.counters.requests
            + sum(session.requests for session in living)
            + sum(line.requests for line in self._lines),
            discarded_frames=self.counters.discarded_frames + sum(session.discarded for session in living),
            refused_busy=self.counters.refused_busy + sum(session.refused_busy for session in living),
        )

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()


def _protocols(management: ConnectionManagement, settings: ListenerSettings) -> Callable[[], asyncio.BaseProtocol]:
    """What makes the protocol of each newcomer: over TLS, a gate that lets it in after the handshake."""
    if settings.tls is None:
        return lambda: ServerConnection(management)
    from .secure import gate

    return gate(management, settings.tls)


async def _accept_no_more(listeners: Sequence[asyncio.Server]) -> None:
    """Take no newcomer, and let those that are being accepted arrive.

    asyncio forgets a connection whose acceptance has begun when its listener is closed: it would stay open, in nobody's
    hands, until the garbage collection finds it.
    """
    loop = asyncio.get_running_loop()
    for listener in listeners:
        for bound in listener.sockets:
            with contextlib.suppress(NotImplementedError):  # loops that do not accept by readiness
                loop.remove_reader(bound.fileno())
    await _settle()


async def _settle() -> None:
    for _ in range(_TURNS_TO_SETTLE):
        await asyncio.sleep(0)


def _serial_units(handler: Handler, endpoint: Endpoint) -> Container[int]:
    """The units that a handler answers for on a line. Raises `ConfigError` where it does not say, or has none."""
    if not isinstance(handler, UnitHolder):
        raise ConfigError(f"{endpoint.url}: on a line this handler must say its units (serial_units)", key="handler")
    if not any(unit in handler.serial_units for unit in range(1, LAST_SERIAL_UNIT + 1)):
        raise ConfigError(f"{endpoint.url}: at least one unit 1…{LAST_SERIAL_UNIT} is needed on a line", key="units")
    return handler.serial_units


def _bound_name(scheme: str, bound: socket.socket) -> str:
    host, port = bound.getsockname()[:2]
    return f"{scheme}://[{host}]:{port}" if bound.family == socket.AF_INET6 else f"{scheme}://{host}:{port}"
