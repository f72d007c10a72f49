"""Connection management of a TCP or TLS listener: admits, limits and closes connections (Messaging on TCP/IP §4.2).

Knows connections and their limits; knows no request.

1. Whether a host may connect is checked before another connection is closed for it.
2. `busway.server.connection_slots` decides which connection is closed for a new one, `busway.server.deadlines` what is
   overdue.
3. No timeout, rate or new connection closes or slows a connection of a priority host, nor does the user timeout of its
   socket. It ends with an error, with the server, or when the system finds that its peer has gone.
4. There is one timer for all connections of a listener.
5. Every refusal and every closed connection is counted; the status shows the counts.
"""

import asyncio
import logging
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Protocol

from ..access.rates import Rates
from ..options.networks import host_of
from ..options.server import ListenerParameters
from ..options.sockets import SocketParameters
from ..transport.tcp import configure, network_reason
from .connection_slots import ConnectionSlots, SlotHolder
from .deadlines import Deadlines, Overdue, Timed
from .listener_context import ConnectedPeer, ListenerContext, add_living
from .server_counters import ServerCounters
from .status import ConnectionStatus, ListenerStatus, SecurityStatus
from .status_indicators import Diagnosis
from .turns import Turns

if TYPE_CHECKING:
    from .serial_over_network import Session

_log = logging.getLogger("busway.server")

_SENTENCES: Final = {
    Overdue.HEADER: "closed: the header of a request began and did not end within %g s",
    Overdue.FRAME: "closed: a request began and did not end within %g s",
    Overdue.WRITE: "closed: it has taken none of its replies for %g s",
    Overdue.IDLE: "closed: it was not used for %g s",
}
REQUESTS_OF_A_TURN: Final = 16
"""Most requests of one connection processed in a turn: 16 pipelined requests are answered at once, and 16 of the most
expensive kind take a millisecond or two. Reads that the fast path knows by all their bytes are not counted.
"""
_COUNTED_AS: Final = {one: f"{one.value}s" for one in _SENTENCES}


class ManagedConnection(ConnectedPeer, SlotHolder, Timed, Protocol):
    """Interface of a server connection that a listener's connection management admits and closes.

    Attributes:
        charged: number of its requests that have been counted against its host's rate so far.
    """

    charged: int

    def pause_reading(self) -> None:
        """Stop reading from the client until `go_on` is called."""

    def go_on(self) -> None:
        """Read from the client again after a pause, unless there is another reason for a pause."""

    def abort(self) -> None:
        """Close the connection at once; unsent replies are lost."""

    def make_room(self) -> None:
        """Close the connection at once, because a new connection gets its slot; unsent replies are lost."""


class HandshakeAdmission(Protocol):
    """Interface of the TLS admission of a listener, as connection management uses it."""

    def end_unauthorized(self) -> int:
        """Abort the handshakes of hosts that may no longer connect; returns their number."""

    def status(self) -> SecurityStatus:
        """Return the listener's TLS status: its certificate and counts of handshakes."""

    def reload(self) -> None:
        """Read the listener's certificate, key and authorities again.

        Raises `ConfigError`; then the old ones stay in use.
        """

    def close(self) -> None:
        """Abort all TLS handshakes that are not complete."""


class ConnectionManagement:
    """All connections of one listener: admission, limits, timeouts and closing.

    Args:
        listener_context: access list, limits and counters of the listener.
        connection_slots: connection slots, its own or shared with other listeners.
        sockets: parameters of the sockets of new connections.
        turns: queue of connections with more requests than one turn allows; None creates one for this listener alone.

    Attributes:
        tls_admission: runs the TLS handshake of new connections before they are admitted; None without TLS.
    """

    def __init__(
        self,
        listener_context: ListenerContext,
        connection_slots: ConnectionSlots[ManagedConnection],
        sockets: SocketParameters,
        turns: Turns | None = None,
    ) -> None:
        self.listener_context = listener_context
        self.connection_slots = connection_slots
        self.turns: Turns = turns or Turns(listener_context.loop)
        self._sockets = sockets
        self._sockets_of_priority_hosts = replace(sockets, user_timeout=None)
        self._connections: dict[ManagedConnection, None] = {}  # in the order they came
        self._deadlines: Deadlines[ManagedConnection] = Deadlines(listener_context.parameters)
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._emptied: asyncio.Event | None = None
        self._is_draining = False
        self.tls_admission: HandshakeAdmission | None = None

    def __len__(self) -> int:
        return len(self._connections)

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The event loop on which the listener's connections run."""
        return self.listener_context.loop

    @property
    def listener(self) -> str:
        """URL of the listener with the address and port that it is bound to."""
        return self.listener_context.listener

    @property
    def parameters(self) -> ListenerParameters:
        """Options of the listener: limits and timeouts of its connections."""
        return self.listener_context.parameters

    @property
    def counters(self) -> ServerCounters:
        """Counters of connections and requests, shared by all listeners of a server."""
        return self.listener_context.counters

    @property
    def framing(self) -> str:
        """Framing of the connections: ``mbap``, ``rtu`` or ``ascii``."""
        return self.listener_context.framing

    @property
    def diagnosis(self) -> Diagnosis:
        """When the listener last had traffic and faults; its status indicators follow from that."""
        return self.listener_context.diagnosis

    @property
    def rates(self) -> Rates | None:
        """Limits of requests per second by client host; None without a limit."""
        return self.listener_context.rates

    # Coming and going.

    def accept(self, transport: asyncio.BaseTransport) -> bool:
        """Check whether the host of a new connection may connect, before a byte is read, and set the socket options.

        Returns whether it may. A refusal is counted and logged; the caller closes the connection.
        """
        address = transport.get_extra_info("peername")
        host = host_of(address)
        if not self.listener_context.welcomes(host, address):
            return False
        socket = transport.get_extra_info("socket")
        if socket is not None:
            parameters = self._sockets_of_priority_hosts if self.listener_context.is_priority(host) else self._sockets
            configure(socket, parameters)
        return True

    def admit(self, connection: ManagedConnection) -> "Session | None":
        """Give a new connection a slot, and return its server session; None if no slot is free or can be freed.

        Sets ``is_priority`` and ``pool`` of the connection. Another connection may be closed for it. A refusal is
        counted and logged; the caller closes the refused connection.
        """
        listener_context = self.listener_context
        connection.is_priority = listener_context.is_priority(connection.host)
        admission = self.connection_slots.admit(connection)
        if not admission.accepted:
            self.counters.refused_full += 1
            if connection.has_ended:
                return None  # it was closed by its client before it was admitted
            listener_context.say(
                logging.WARNING,
                connection.host,
                "%s: refused: all %d connection slots are taken by priority hosts",
                connection.peer,
                len(self.connection_slots),
            )
            return None
        if admission.evicted is not None:
            admission.evicted.make_room()
        self._connections[connection] = None
        listener_context.connection_opened(connection)
        if self.parameters.idle_timeout is not None and self._timer is None:
            self._set_timer(time.monotonic())
        return listener_context.session_for(connection, share=REQUESTS_OF_A_TURN)

    def evict(self, connection: ManagedConnection) -> None:
        """Close a connection at once, because a new connection gets its slot. That is counted and logged."""
        self.counters.evicted += 1
        self.listener_context.say(
            logging.WARNING,
            "",
            "%s: closed to make room for a new connection; there are %d now",
            connection.peer,
            len(self.connection_slots),
        )
        self._connections.pop(connection, None)
        connection.abort()

    def leave(self, connection: ManagedConnection, session: "Session", error: Exception | None) -> None:
        """Remove a connection that has ended and free its slot.

        ``error``: the error with which it ended, for the log; None for a normal end.
        """
        self.connection_slots.leave(connection)
        self._connections.pop(connection, None)
        self._deadlines.forget(connection)
        if not self._connections:
            self._stop_timer()
            if self._emptied is not None:
                self._emptied.set()
        self.listener_context.connection_closed(connection, session)
        if error is not None:
            _log.info("%s: the connection ended: %s", connection.peer, network_reason(error))

    def broken(self, connection: ManagedConnection, reason: str) -> None:
        """Count and log a connection that sent bytes which are no valid sequence of frames; the caller closes it."""
        self.counters.broken_streams += 1
        self.listener_context.broken()
        self.listener_context.say(logging.WARNING, connection.host, "%s: closed: %s", connection.peer, reason)

    def end_unauthorized(self) -> int:
        """Abort connections and TLS handshakes of hosts that may no longer connect. Returns how many were aborted.

        Each is counted and logged.
        """
        ended = [one for one in self._connections if not self.listener_context.may_stay(one.host, one.peer)]
        for connection in ended:
            connection.abort()
        return len(ended) + (0 if self.tls_admission is None else self.tls_admission.end_unauthorized())

    # Limits while they last.

    def watch_frame(self, connection: ManagedConnection, *, begun_now: bool) -> None:
        """Start the timeout of an incomplete frame on a connection; not for a priority host.

        ``begun_now``: False if the frame may have begun earlier, so that a running timeout goes on.
        """
        if connection.is_priority:
            return
        now = time.monotonic()
        self._set_timer_by(self._deadlines.frame_begun(connection, now, anew=begun_now), now)

    def stuck(self, connection: ManagedConnection) -> None:
        """Count that a client has stopped reading its replies, and start the write timeout of its connection.

        The timeout is not started for a priority host.
        """
        self.counters.reading_paused += 1
        if not connection.is_priority:
            now = time.monotonic()
            self._set_timer_by(self._deadlines.stuck(connection, now), now)

    def taken(self, connection: ManagedConnection) -> None:
        """Stop the write timeout of a connection, because its client reads its replies again."""
        self._deadlines.taken(connection)

    def charge(self, connection: ManagedConnection, session: "Session") -> None:
        """Count the new requests of a connection against its host's rate; above the rate, pause reading from it.

        Reading goes on by itself as soon as the host is within its rate again.
        """
        assert self.rates is not None  # or this is not called
        now = time.monotonic()
        requests, connection.charged = session.requests - connection.charged, session.requests
        wait = self.rates.charge(connection.host, requests, now)
        if wait:
            self.counters.rate_limited += 1
            self.listener_context.say(
                logging.INFO,
                connection.host,
                "%s: reading is paused, its rate is %g requests a second",
                connection.peer,
                self.rates.rate,
            )
            connection.pause_reading()
            self._set_timer_by(self._deadlines.pause(connection, now + wait), now)

    def is_paused(self, connection: ManagedConnection) -> bool:
        """Whether reading from a connection is paused: its host is above its rate, or `pause_all` was called."""
        return self._is_draining or self._deadlines.is_paused(connection)

    def _set_timer(self, now: float) -> None:
        self._set_timer_by(self._deadlines.next_due(now, has_connections=bool(self._connections)), now)

    def _set_timer_by(self, due: float | None, now: float) -> None:
        """Set the timer for the next timeout of a connection to ``due``, unless it is set to an earlier time."""
        if due is None or (self._timer is not None and self._timer_at <= due):
            return
        self._stop_timer()
        self._timer_at = due
        self._timer = self.loop.call_later(max(due - now, 0.0), self._look)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _look(self) -> None:
        """Close connections whose timeout is over, end pauses that are over, and set the timer for the next one."""
        self._timer = None
        now = time.monotonic()
        for connection, what in self._deadlines.due(self._connections, now):
            if what is Overdue.PAUSE:
                connection.go_on()
            elif connection.session is not None:
                self._close_overdue(connection, what)
        self._set_timer(now)

    def _close_overdue(self, connection: ManagedConnection, what: Overdue) -> None:
        counted = _COUNTED_AS[what]
        setattr(self.counters, counted, getattr(self.counters, counted) + 1)
        level = logging.WARNING
        if what is Overdue.IDLE:
            level = logging.INFO
        elif what is not Overdue.WRITE:
            self.listener_context.broken()
        seconds = getattr(self.parameters, what.value) or self.parameters.frame_timeout
        self.listener_context.say(level, connection.host, f"%s: {_SENTENCES[what]}", connection.peer, seconds)
        connection.abort()

    # What is shown.

    def status(self) -> list[ConnectionStatus]:
        """Return the status of each open connection, the oldest first."""
        now = time.monotonic()
        return [self.listener_context.connected_peer_status(one, now) for one in self._connections]

    def listener_status(self) -> ListenerStatus:
        """Return the status of the listener: indicators, counters, numbers of connections by pool, and TLS status."""
        diagnosis = self.diagnosis
        diagnosis.traffic = max((one.last_used for one in self._connections), default=diagnosis.traffic)
        connection_slots = [one.pool for one in self._connections]
        security = self.tls_admission.status() if self.tls_admission is not None else None
        return self.listener_context.status(connection_slots.count, security=security)

    def add_living(self, counters: ServerCounters) -> None:
        """Add the counters of open connections to ``counters``, which already include closed connections."""
        for one in self._connections:
            if one.session is not None:
                add_living(counters, one, one.session)

    # The end.

    def pause_all(self) -> None:
        """Stop reading from all connections, for good; requests in progress are still answered."""
        self._is_draining = True
        for connection in self._connections:
            connection.pause_reading()

    async def wait_until_empty(self) -> None:
        """Wait until all connections of the listener have ended."""
        if self._connections:
            if self._emptied is None or self._emptied.is_set():
                self._emptied = asyncio.Event()
            await self._emptied.wait()

    def close_all(self, *, at_once: bool = False) -> None:
        """Close every connection after its written replies are sent; ``at_once`` closes at once and loses them."""
        for connection in list(self._connections):
            if at_once:
                connection.abort()
            else:
                connection.close()
