"""What all connections of a network listener, TCP or UDP, share: access list, sessions, connection slots and counters.

Knows listeners and their limits; knows no transport and no request.

1. Whether a host may connect is checked before anything is read from it (Messaging on TCP/IP V1.0b §4.2.3).
2. Each refused connection is counted; those of the same host are logged once a minute at most.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Container, Sequence
from typing import TYPE_CHECKING, Protocol

from ..access.addresses import HostAuthorizer, allow_all
from ..access.rates import Rates
from ..log_limiter import LogLimiter, suppressed_note
from ..options.networks import peer_name
from ..options.server import ListenerParameters, Scope, ServerParameters
from ..session.diagnostic_counters import LineDiagnostics
from ..session.responder import ClientIdentity
from ..session.server_pipeline import RequestPipeline, ResponderFailure
from ..session.server_transaction_slots import ServerTransactionSlots
from ..session.tcp_server import TcpServerSession
from ..transport.network_interfaces import interfaces_with
from .connection_slots import SlotPool
from .connection_tap import ConnectionTap, TappedConnection, do_not_close
from .listener_settings import ListenerSettings
from .responder_failures import report_failures
from .server_counters import ServerCounters
from .status import ConnectionStatus, ListenerStatus, ServedConnectionState
from .status_indicators import Diagnosis

if TYPE_CHECKING:
    from .serial_over_network import SerialOverNetworkSession, Session
    from .status import SecurityStatus

_log = logging.getLogger("busway.server")


class ConnectedPeer(Protocol):
    """Interface of a connection, or of a UDP peer, as its listener uses it.

    Attributes:
        host: the host of the client.
        is_priority: whether the client is a priority host.
        pool: the pool of its connection slot.
        opened, last_used: when it was accepted and last used, in seconds of ``time.monotonic``.
        received, sent: bytes so far.
    """

    host: str
    is_priority: bool
    pool: SlotPool
    opened: float
    last_used: float
    received: int
    sent: int

    @property
    def address(self) -> tuple[object, ...]:
        """The socket address of the client."""

    @property
    def peer(self) -> str:
        """``host:port`` of the client."""

    @property
    def role(self) -> str | None:
        """Role of the client's certificate; None without one."""

    @property
    def subject(self) -> str:
        """Subject of the client's certificate; empty without one."""

    @property
    def session(self) -> "Session | None":
        """The server session of this connection; None before it begins and after it ended."""

    @property
    def state(self) -> ServedConnectionState:
        """The state of the connection, for the server's status."""

    def deliver(self, adu: bytes) -> None:
        """Send the late reply to a request of this client; empty bytes mean that the request ends without a reply."""

    def deliver_together(self, replies: list[bytes]) -> None:
        """Send late replies to several requests of this client at once."""

    def attend(self) -> None:
        """Start tasks for late replies, and log responder failures, that the session has found without new bytes."""

    def close(self) -> None:
        """Close the connection after the replies given so far have been sent."""


class ListenerContext:
    """What all connections of one network listener share: access list, sessions, counters, log.

    Attributes:
        loop: the event loop that the listener runs on.
        listener: URL of the listener with the address and port that are really bound.
        listener_names: further URLs that access rules may use for the listener.
        hosts: numeric addresses that the listener is bound to; the listener sets them when it is opened.
        settings, parameters: all settings of the listener, and its limits and timeouts.
        counters: counters shared by all listeners of a server.
        diagnostics: communication counters of the listener and its units (functions 08, 11, 12).
        diagnosis: when the listener last had traffic and faults; its status indicators follow from that.
        rates: limits of requests per second by host; None without a limit.
        damaged: number of TCP connections whose bytes were no valid frames or with a frame that did not end in time,
            and of UDP datagrams that were no whole frame.
        late_answers: tasks that await responders; also cancelled tasks of ended connections until they have finished.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        pipeline: RequestPipeline,
        settings: ListenerSettings,
        *,
        session_parameters: ServerParameters,
        counters: ServerCounters,
        slots: ServerTransactionSlots,
        units: Container[int] = (),
        authorize: HostAuthorizer = allow_all,
        tap: ConnectionTap | None = None,
    ) -> None:
        self.loop = loop
        self._pipeline = pipeline
        self.listener: str = settings.endpoint.url
        self.listener_names: tuple[str, ...] = ()
        self.hosts: tuple[str, ...] = ()
        self.settings = settings
        self.parameters: ListenerParameters = settings.limits
        self.counters = counters
        self.diagnostics: LineDiagnostics = LineDiagnostics(
            changes_allowed=session_parameters.diagnostics_changes is True,
            listed_unit=self._listed_unit,
        )
        self.diagnostics.ascii_delimiter = settings.framing.delimiter
        self.diagnosis: Diagnosis = Diagnosis()
        self.rates: Rates | None = None if self.parameters.request_rate is None else Rates(self.parameters.request_rate)
        self.damaged: int = 0
        self.late_answers: set[asyncio.Task[None]] = set()
        self._units = units
        self._session_parameters = session_parameters
        self._slots = slots
        if session_parameters.scope is Scope.CONNECTION:
            self._slots = ServerTransactionSlots(session_parameters.max_transactions, of_each_connection=True)
        self._framed_session = None if self.framing == "mbap" else _framed_session()
        self._authorize = authorize
        self._log_limiter = LogLimiter()
        self._tap = tap
        self._tapped_connections: dict[ConnectedPeer, TappedConnection] = {}

    def bound_as(self, names: Sequence[str]) -> None:
        """Store the URLs of the bound sockets (one or more) in ``listener`` and ``listener_names``.

        Access rules may name the listener by any of these URLs, or by the configured one.
        """
        configured = (self.settings.endpoint.url, self.settings.beside)
        self.listener = names[0]
        self.listener_names = tuple(dict.fromkeys(name for name in (*configured, *names[1:]) if name))

    @property
    def framing(self) -> str:
        """Framing of the listener: ``mbap``, ``rtu`` or ``ascii``."""
        return self.settings.endpoint.framing

    def welcomes(self, host: str, address: object) -> bool:
        """Whether a client may connect. A refusal is counted and logged.

        ``address`` is the socket address, for the log.
        """
        if self._authorize(host):
            return True
        self.counters.unauthorized += 1
        sentence = "%s: refused before anything was read: it is not authorized"
        self.say(logging.WARNING, host, sentence, peer_name(address))
        return False

    def may_stay(self, host: str, peer: str) -> bool:
        """Whether a client may stay connected, or go on with its handshake, after the address lists have changed.

        If not, that is counted and logged. ``peer`` is ``host:port``, for the log.
        """
        if self._authorize(host):
            return True
        self.counters.no_longer_authorized += 1
        self.say(logging.WARNING, host, "%s: ended: it is no longer authorized", peer)
        return False

    def is_priority(self, host: str) -> bool:
        """Whether a host is a priority host of this listener."""
        return host in self.parameters.priority

    def session_for(self, connected_peer: ConnectedPeer, *, share: int | None = None) -> "Session":
        """Create the server session of a new connection or UDP peer.

        ``share``: most requests that one call of the session processes (MBAP only); None: no limit.
        """
        client = ClientIdentity(
            connected_peer.address, self.listener, connected_peer.role, connected_peer.is_priority, self.listener_names
        )
        if self._framed_session is not None:
            return self._framed_session(
                self.loop,
                self._pipeline,
                self._units,
                framing=self.settings.line_framing(self._units, self._pipeline.functions),
                diagnostics=self.diagnostics,
                deliver=connected_peer.deliver,
                attend=connected_peer.attend,
                client=client,
            )
        return TcpServerSession(
            self._pipeline,
            diagnostics=self.diagnostics,
            slots=self._slots,
            deliver=connected_peer.deliver,
            deliver_together=connected_peer.deliver_together,
            client=client,
            share=share,
        )

    def _listed_unit(self, unit: int) -> int:
        """Return the unit under which the device that answers for ``unit`` is configured, such as 1 for 255.

        ``unit`` itself if no device answers for it.
        """
        served = self._pipeline.responder.serves(unit)
        return unit if served is None else served.unit

    # What is counted.

    def connection_opened(self, connected_peer: ConnectedPeer) -> None:
        """Count a new connection and report it to the connection tap."""
        self.counters.accepted += 1
        self.counters.of_class(is_priority=connected_peer.is_priority).accepted += 1
        if self._tap is not None:
            carrier = self.settings.endpoint.carrier
            close = do_not_close if carrier == "udp" else connected_peer.close
            connection = TappedConnection(
                self.listener, connected_peer.peer, self.framing, carrier, 0.0, connected_peer.deliver, close
            )
            self._tapped_connections[connected_peer] = connection
            self._tap.connection_opened(connection)

    def connection_closed(self, connected_peer: ConnectedPeer, session: "Session") -> None:
        """Count an ended connection, add its requests and bytes to the totals, and tell the connection tap."""
        counters = self.counters
        counters.closed += 1
        counters.of_class(is_priority=connected_peer.is_priority).closed += 1
        add_living(counters, connected_peer, session)
        connection = self._tapped_connections.pop(connected_peer, None)
        if connection is not None and self._tap is not None:
            self._tap.connection_closed(connection)

    def broken(self) -> None:
        """Count a byte stream or datagram that is no valid frame, or a frame that did not end in time."""
        self.damaged += 1
        self.diagnosis.communication_fault = time.monotonic()

    def failed(self, peer: str, failures: Sequence[ResponderFailure]) -> None:
        """Count and log exceptions that responders raised instead of answering."""
        self.counters.responder_failures += len(failures)
        self.diagnosis.internal_fault = time.monotonic()
        report_failures(peer, failures)

    def say(self, level: int, about: str, message: str, *arguments: object) -> None:
        """Log a message, at most once a minute for the same ``about`` and text.

        The next line that is logged says how many were suppressed.

        Args:
            level: level of the log line.
            about: what the message is about, such as a host.
            message, arguments: the message with its ``%`` arguments.
        """
        repeated = self._log_limiter.admit(f"{about} {message}", time.monotonic())
        if repeated is not None:
            _log.log(level, f"{message}%s", *arguments, suppressed_note(repeated))

    # What is shown.

    def connected_peer_status(self, connected_peer: ConnectedPeer, now: float) -> ConnectionStatus:
        """Return the status of one TCP connection or UDP peer of the listener."""
        session = connected_peer.session
        return ConnectionStatus(
            peer=connected_peer.peer,
            listener=self.listener,
            state=connected_peer.state,
            pool=connected_peer.pool,
            role=connected_peer.role,
            subject=connected_peer.subject,
            age=now - connected_peer.opened,
            idle=now - connected_peer.last_used,
            received=connected_peer.received,
            sent=connected_peer.sent,
            requests=session.requests if session else 0,
            waiting=session.waiting if session else 0,
        )

    def status(self, count: Callable[[SlotPool], int], *, security: "SecurityStatus | None" = None) -> ListenerStatus:
        """Return the status of the listener.

        Args:
            count: returns the number of used slots of a pool.
            security: the TLS status; None without TLS.
        """
        diagnostics = self.diagnostics
        return ListenerStatus(
            endpoint=self.listener,
            is_open=self.diagnosis.is_open,
            indicators=self.diagnosis.indicators(time.monotonic(), listen_only=diagnostics.listen_only),
            counters=diagnostics.counters,
            event_count=diagnostics.event_count,
            listen_only=diagnostics.listen_only,
            listen_only_units=tuple(sorted(diagnostics.listen_only_units)),
            requests=diagnostics.requests,
            damaged=self.damaged,
            priority_connections=count(SlotPool.PRIORITY),
            other_connections=count(SlotPool.OTHER),
            interfaces=tuple(one for host in self.hosts for one in interfaces_with(host)),
            security=security,
        )


def _framed_session() -> "type[SerialOverNetworkSession]":
    """Return the class of sessions for RTU and ASCII frames, imported before the first client needs it."""
    from .serial_over_network import SerialOverNetworkSession

    return SerialOverNetworkSession


def add_living(counters: ServerCounters, connected_peer: ConnectedPeer, session: "Session") -> None:
    """Add the requests and bytes of one connection to ``counters``: at its end, or to a copy for a status."""
    counters.requests += session.requests
    counters.discarded_frames += session.discarded
    counters.refused_busy += session.refused_busy
    of_class = counters.of_class(is_priority=connected_peer.is_priority)
    of_class.requests += session.requests
    of_class.received += connected_peer.received
    of_class.sent += connected_peer.sent
