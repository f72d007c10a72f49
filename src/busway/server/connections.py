"""Connection management of a server: who is connected, who may be, and who makes room (Messaging on TCP/IP §4.2).

Knows connections and their limits; knows no request.

1. A newcomer beyond the limit takes the place of the connection that has been unused longest; where all are busy,
   of the oldest.
2. A client that began a frame and fell silent loses its place after ``frame_timeout``.
3. What happens is counted, and can be seen.
"""

import asyncio
import logging
import time
from collections.abc import Container
from dataclasses import dataclass, replace

from ..session.diagnostics import CommunicationState
from ..session.handler import Handler
from ..session.parameters import Scope, ServerParameters
from ..session.server import TcpServerSession, TransactionSlots
from ..transport.tcp import SocketParameters, network_reason
from .authorisation import Authorise, everybody
from .connection import ServerConnection, host_of, peer_name
from .diagnosis import Diagnosis
from .framed import FramedSession
from .listener_settings import ListenerSettings
from .parameters import ListenerParameters
from .status import ListenerStatus

_log = logging.getLogger("busway.server")


@dataclass(slots=True)
class ServerCounters:
    """What happened on a server since it was made; ``requests`` and what follows is complete when a connection ends."""

    accepted: int = 0
    unauthorised: int = 0
    closed: int = 0
    evicted: int = 0
    broken_streams: int = 0
    frame_timeouts: int = 0
    reading_paused: int = 0
    handler_failures: int = 0
    requests: int = 0
    discarded_frames: int = 0
    refused_busy: int = 0


@dataclass(frozen=True, slots=True)
class ConnectionStatus:
    """One connection as a status shows it. Times are seconds, sizes bytes."""

    peer: str
    listener: str
    age: float
    idle: float
    received: int
    sent: int
    requests: int
    waiting: int


class ConnectionManagement:
    """The connections of one listener.

    Attributes:
        loop: the event loop they live on.
        listener: URL of the listener, as it is bound.
        counters: shared by all listeners of a server.
        framing: ``mbap``, ``rtu`` or ``ascii``.
        diagnostics: communication counters of the listener (functions 08, 11, 12).
        diagnosis: for the lamps.
        authorise: whether a host may connect.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        handler: Handler,
        *,
        listener: str,
        parameters: ListenerParameters,
        session_parameters: ServerParameters,
        sockets: SocketParameters,
        counters: ServerCounters,
        slots: TransactionSlots,
        settings: ListenerSettings,
        units: Container[int] = (),
        authorise: Authorise = everybody,
    ) -> None:
        self.loop = loop
        self.listener = listener
        self.parameters = parameters
        self.counters = counters
        self.framing = settings.endpoint.framing
        self.diagnostics = CommunicationState(changes_allowed=session_parameters.diagnostics_changes is True)
        self.diagnostics.ascii_delimiter = settings.framing.delimiter
        self.diagnosis = Diagnosis()
        self.authorise = authorise
        self._settings = settings
        self._units = units
        self._handler = handler
        self._session_parameters = session_parameters
        self._sockets = sockets
        self._server_slots = slots
        self._connections: dict[ServerConnection, None] = {}  # in the order they came
        self._begun: dict[ServerConnection, float] = {}  # connections with an unfinished frame, and since when
        self._frame_timer: asyncio.TimerHandle | None = None
        self._emptied: asyncio.Event | None = None

    def __len__(self) -> int:
        return len(self._connections)

    def accept(self, transport: asyncio.BaseTransport) -> bool:
        """Whether a newcomer may stay, asked before a byte of it is read; the parameters of its socket are set.

        A refusal is counted and logged; closing is the caller's.
        """
        address = transport.get_extra_info("peername")
        if not self.authorise(host_of(address)):
            self.counters.unauthorised += 1
            _log.warning("%s: closed before anything was read: it is not authorised", peer_name(address))
            return False
        socket = transport.get_extra_info("socket")
        if socket is not None:
            self._sockets.apply(socket)
        return True

    def admit(self, connection: ServerConnection) -> TcpServerSession | FramedSession:
        """Give a newcomer its session, and a place."""
        while len(self._connections) >= self.parameters.max_connections:
            self._evict()
        self._connections[connection] = None
        self.counters.accepted += 1
        if self.framing != "mbap":
            return FramedSession(
                self.loop,
                self._handler,
                self._units,
                framing=self._settings.line_framing(self._units, self._handler.functions),
                diagnostics=self.diagnostics,
                deliver=connection.deliver,
                attend=connection.attend,
                peer=connection.peer,
                listener=self.listener,
            )
        slots = self._server_slots
        if self._session_parameters.scope is Scope.CONNECTION:
            slots = TransactionSlots(self._session_parameters.max_transactions)
        return TcpServerSession(
            self._handler,
            diagnostics=self.diagnostics,
            slots=slots,
            deliver=connection.deliver,
            peer=connection.peer,
            listener=self.listener,
            role=connection.role,
        )

    def leave(
        self, connection: ServerConnection, session: TcpServerSession | FramedSession, error: Exception | None
    ) -> None:
        """A connection has ended."""
        self._connections.pop(connection, None)
        self._begun.pop(connection, None)
        if not self._begun and self._frame_timer is not None:
            self._frame_timer.cancel()
            self._frame_timer = None
        if not self._connections and self._emptied is not None:
            self._emptied.set()
        self.counters.closed += 1
        self.counters.requests += session.requests
        self.counters.discarded_frames += session.discarded
        self.counters.refused_busy += session.refused_busy
        if error is not None:
            _log.info("%s: the connection ended: %s", connection.peer, network_reason(error))

    def _evict(self) -> None:
        """Make room: the connection unused longest goes, or the oldest if all are busy."""
        idle = [one for one in self._connections if not one.is_busy]
        chosen = min(idle, key=lambda one: one.last_used) if idle else next(iter(self._connections))
        self.counters.evicted += 1
        _log.warning("%s: closed to make room, %d connections are the limit", chosen.peer, len(self._connections))
        del self._connections[chosen]
        chosen.abort()

    def watch_frame(self, connection: ServerConnection, *, begun_now: bool) -> None:
        """A connection holds a part of a frame; ``begun_now`` if it came whole out of the last segment."""
        timeout = self.parameters.frame_timeout
        if timeout is None:
            return
        if begun_now:
            self._begun[connection] = self.loop.time()
        if self._frame_timer is None:
            self._frame_timer = self.loop.call_later(timeout, self._look_at_frames)

    def _look_at_frames(self) -> None:
        """Close those whose frame has not ended in time; be back when the next one may be due."""
        self._frame_timer = None
        timeout = self.parameters.frame_timeout
        assert timeout is not None  # or there would be no timer
        now = self.loop.time()
        for connection, since in list(self._begun.items()):
            if connection.session is None or not connection.session.unfinished:
                del self._begun[connection]
            elif now >= since + timeout:
                del self._begun[connection]
                self.counters.frame_timeouts += 1
                _log.warning("%s: closed: a request began and did not end within %g s", connection.peer, timeout)
                connection.abort()
        if self._begun:
            self._frame_timer = self.loop.call_at(min(self._begun.values()) + timeout, self._look_at_frames)

    def status(self) -> list[ConnectionStatus]:
        """The connections, the oldest first."""
        now = time.monotonic()
        return [
            ConnectionStatus(
                peer=one.peer,
                listener=self.listener,
                age=now - one.opened,
                idle=now - one.last_used,
                received=one.received,
                sent=one.sent,
                requests=one.session.requests if one.session else 0,
                waiting=one.session.waiting if one.session else 0,
            )
            for one in self._connections
        ]

    def listener_status(self) -> ListenerStatus:
        """The listener itself."""
        now = time.monotonic()
        self.diagnosis.traffic = max((one.last_used for one in self._connections), default=self.diagnosis.traffic)
        return ListenerStatus(
            endpoint=self.listener,
            is_open=self.diagnosis.is_open,
            lamps=self.diagnosis.lamps(now, listen_only=self.diagnostics.listen_only),
            counters=replace(self.diagnostics.counters),
            event_count=self.diagnostics.event_count,
            listen_only=self.diagnostics.listen_only,
            requests=self.diagnostics.counters.server_message_count,
        )

    def sessions(self) -> list[TcpServerSession | FramedSession]:
        """The conversations of the living connections."""
        return [one.session for one in self._connections if one.session is not None]

    async def wait_until_empty(self) -> None:
        """Wait until no connection is left."""
        if self._connections:
            self._emptied = asyncio.Event()
            await self._emptied.wait()

    def close_all(self, *, at_once: bool = False) -> None:
        """Close every connection, after what is written has gone out or at once."""
        for connection in list(self._connections):
            if at_once:
                connection.abort()
            else:
                connection.close()
