"""The server: listeners with one pipeline for requests; start, stop, reset, status (Messaging on TCP/IP §5.1.2).

Knows listeners and their life cycle; knows no request.

1. A server answers only between start and stop. Stopping ends within a second, whatever the clients do.
2. Start, stop and reset succeed or raise. If one listener cannot be opened, those opened before are closed.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from ..access.addresses import HostAuthorizer, allow_all
from ..errors import ConfigError, LinkDown, ModbusError
from ..options.endpoints import Endpoint
from ..options.server import ListenerParameters, ServerParameters
from ..options.sockets import SocketParameters
from ..pdu.functions import FunctionTable
from ..session.responder import Responder
from ..session.server_pipeline import Authorizer, RequestObserver, RequestPipeline
from ..transport.connection_counter import dialled_connections
from ..transport.local_end import interface_problem
from ..transport.tcp import network_kind, network_reason
from .connection_management import ConnectionManagement
from .connection_tap import ConnectionTap
from .exposure import warn_of_exposure
from .listener import Listener, as_listeners
from .listener_settings import ListenerSettings, listener_settings
from .open_files import raise_open_file_limit
from .opening import Opening, serial_units
from .server_counters import ServerCounters
from .standard_port import with_standard_port
from .status import ServerStatus
from .tcp import TcpListener, settle

if TYPE_CHECKING:
    from ..access.audit_log import AuditLog
    from ..access.authorizer import PolicyAuthorizer
    from ..access.rules import Policy
    from ..options.tls import TlsParameters
    from .serial_listener import SerialListener
    from .udp import UdpListener

_STOP_SECONDS: Final = 0.5


class Server:
    """A Modbus server: listeners that share one responder. An asynchronous context manager that starts and stops.

    Args:
        endpoints: URLs to listen on (``tcp://127.0.0.1:5020``), or a `Listener` for an endpoint with settings of its
            own. Port 0 means any free port, an empty host every interface, IPv4 and IPv6.
        responder: answers the requests.
        parameters: options of sessions, `ServerParameters`.
        listener: limits of connections, `ListenerParameters`.
        sockets: options of sockets, `SocketParameters`.
        authorize: called with a client's host before anything is read from it; False closes the connection.
        tls: certificate, key and authorities of the ``tls://`` listeners that have none of their own.
        policy: which requests are permitted; None permits all requests of hosts that may connect.
        audit: the audit log of writes and denied requests.
        authorizer: an object that permits or refuses requests; with it ``policy`` is ignored.
        standard_port: whether to listen on port 502 too, beside each other port of ``tcp://`` (Messaging on TCP/IP
            V1.0b §3.1.3). True: yes, and the start fails if port 502 cannot be opened. False: no. None: yes if other
            hosts can reach the listener and its port is not 0; if port 502 cannot be opened, that is only logged.
        local_connections: returns, for a status, how many connections this program has open towards other devices. None
            counts the connections that this process's links have open.
        tap: observes opened and closed connections and may send on them; for simulated devices that misbehave.

    Attributes:
        authorize: as given; a change takes effect at the next start.
        counters: totals without the requests and bytes of open connections, so after `reset_counters` a number can be
            negative; `status` has the right ones.

    Raises:
        ConfigError: an endpoint that cannot be listened on.
    """

    def __init__(
        self,
        endpoints: Sequence[str | Endpoint | Listener],
        responder: Responder,
        *,
        parameters: ServerParameters | None = None,
        listener: ListenerParameters | None = None,
        sockets: SocketParameters | None = None,
        authorize: HostAuthorizer = allow_all,
        tls: "TlsParameters | None" = None,
        policy: "Policy | None" = None,
        audit: "AuditLog | None" = None,
        authorizer: Authorizer | None = None,
        standard_port: bool | None = None,
        local_connections: Callable[[], int] | None = None,
        tap: ConnectionTap | None = None,
    ) -> None:
        self._limits = listener or ListenerParameters()
        wanted = [listener_settings(one, limits=self._limits, tls=tls) for one in as_listeners(endpoints)]
        self._settings = with_standard_port(wanted, standard_port)
        for settings in self._settings:
            if settings.endpoint.framing != "mbap":
                settings.line_framing(serial_units(responder, settings.endpoint), responder.functions)
        self.authorize = authorize
        self._responder = responder
        self._clock: Callable[[], float] = time.perf_counter
        self._observers: list[RequestObserver] = []
        self._parameters = parameters or ServerParameters()
        self._sockets = sockets or SocketParameters()
        self._streams: list[TcpListener] = []
        self._datagrams: list[UdpListener] = []
        self._lines: list[SerialListener] = []
        self._bound: list[str] = []
        self._started = 0.0
        self._local_connections = local_connections or dialled_connections
        self._tap = tap
        self._policy_authorizer: PolicyAuthorizer | None = None
        self._authorizer = self._authorizer_for(policy, audit) if authorizer is None else authorizer
        if audit is not None:
            from ..access.audit_observer import AuditObserver

            self._observers.append(AuditObserver(audit))
        self.counters: ServerCounters = ServerCounters()

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners with the ports that are really bound; empty while stopped."""
        return list(self._bound)

    @property
    def is_running(self) -> bool:
        """Whether the server has listeners open: it was started, and not stopped since."""
        return bool(self._streams or self._datagrams or self._lines)

    @property
    def functions(self) -> FunctionTable:
        """The table of function codes, with their messages, that the server decodes."""
        return self._responder.functions

    def wrap_responder(self, wrap: Callable[[Responder], Responder]) -> None:
        """Replace the responder by ``wrap(responder)``, which may change or replace replies.

        Allowed only while the server is stopped.

        Raises:
            ConfigError: the server is running, and its sessions use the responder already.
        """
        if self.is_running:
            raise ConfigError("a running server keeps its responder", key="responder")
        self._responder = wrap(self._responder)

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer that is called for each request and its reply. Allowed only while stopped.

        Raises:
            ConfigError: the server is running.
        """
        if self.is_running:
            raise ConfigError("a running server keeps its observers", key="observer")
        self._observers.append(observer)

    def use_tap(self, tap: ConnectionTap) -> None:
        """Set the observer of opened and closed connections, which can also send on them, in place of an earlier one.

        Allowed only while stopped.

        Raises:
            ConfigError: the server is running.
        """
        if self.is_running:
            raise ConfigError("a running server keeps its connection tap", key="tap")
        self._tap = tap

    def replace_policy(self, policy: "Policy") -> None:
        """Use another access policy from the next request on; connections stay open.

        Raises:
            ConfigError: the server was created without a policy and without an audit log, or with an ``authorizer``.
        """
        if self._policy_authorizer is None:
            raise ConfigError("the server was made without a policy", key="policy")
        self._policy_authorizer.replace_policy(policy)

    def reload_security(self) -> None:
        """Read the certificates, keys and authorities of the ``tls://`` listeners again, for new connections.

        Listeners also notice changed files themselves, at the next connection.

        Raises:
            ConfigError: a file cannot be used; names the file. Its listener keeps the old files, the others are
                updated.
        """
        admissions = [each.management.tls_admission for each in self._streams]
        failures: list[ConfigError] = []
        for admission in admissions:
            try:
                if admission is not None:
                    admission.reload()
            except ConfigError as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def end_unauthorized(self) -> int:
        """Check again whether each connected host may connect, and abort the connections of hosts that may not.

        The checks are ``authorize`` as it was at the start, and the listener's own ``access``. Call this after their
        address lists have changed. Replies that were not sent yet are lost; executed writes stay executed. Peers over
        UDP lose their slot, and their next datagram is refused.

        Returns:
            How many connections, TLS handshakes and peers were ended.
        """
        return sum(listener.end_unauthorized() for listener in self._with_peers())

    async def start(self) -> None:
        """Open all listeners; no effect on a running server.

        A serial port that is absent is waited for in the background.

        Raises:
            LinkDown, ConfigError: a listener cannot be opened; then none is open.
        """
        if self.is_running:
            return
        raise_open_file_limit()
        opening = Opening(
            asyncio.get_running_loop(),
            RequestPipeline(self._responder, self._authorizer, self._observers, clock=self._clock),
            self._parameters,
            self._limits,
            self._sockets,
            self.counters,
            self.authorize,
            self._tap,
        )
        try:
            for settings in self._settings:
                await self._open(opening, settings)
        except ModbusError as error:
            await self.stop()
            raise error.at(endpoint=settings.endpoint.url) from error.__cause__
        except OSError as error:
            await self.stop()
            problem = interface_problem(error, settings.limits.interface)
            kind = "local" if problem else network_kind(error)
            words = f"cannot listen: {problem or network_reason(error)}"
            raise LinkDown(words, kind=kind, endpoint=settings.endpoint.url) from error
        except BaseException:
            await self.stop()
            raise
        self._started = time.monotonic()
        has_policy = getattr(self._authorizer, "has_policy", self._authorizer is not None)
        warn_of_exposure(self._bound, authorized=has_policy)

    async def _open(self, opening: Opening, settings: ListenerSettings) -> None:
        carrier = settings.endpoint.carrier
        if carrier == "serial":
            line = await opening.line(settings)
            self._lines.append(line)
            self._bound.append(line.name)
        elif carrier == "udp":
            datagrams = await opening.datagrams(settings)
            self._datagrams.append(datagrams)
            self._bound += datagrams.names
        else:
            streams = await opening.streams(settings)
            if streams is not None:
                self._streams.append(streams)
                self._bound += streams.names

    async def take_no_more(self) -> None:
        """Stop accepting connections and reading requests, for good; replies in progress are still sent.

        It does not wait for them. Call `stop` afterwards.
        """
        for datagrams in self._datagrams:
            datagrams.take_no_more()
        for line in self._lines:
            line.take_no_more()
        for streams in self._streams:
            streams.accept_no_more()
        await settle()
        for streams in self._streams:
            streams.management.pause_all()

    async def stop(self) -> None:
        """Close all listeners and connections; no effect on a stopped server.

        Written replies are still sent, for at most half a second; then late responders, which are cancelled, get at
        most another half second to finish. When it returns, no connection is open.
        """
        streams, self._streams = self._streams, []
        datagrams, self._datagrams = self._datagrams, []
        lines, self._lines = self._lines, []
        self._bound.clear()
        self._started = 0.0
        try:
            for line in lines:
                line.take_no_more()  # what comes while a line is being closed would be executed and not counted
            for each in streams:
                each.accept_no_more()
            await settle()
        finally:
            for each in streams:
                each.close()
            for one in datagrams:
                one.close()
        waits = [each.management.wait_until_empty() for each in streams]
        waits += [one.wait_closed() for one in datagrams]
        waits += [line.close() for line in lines]
        self.counters.requests += sum(line.requests for line in lines)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(*waits), _STOP_SECONDS)
        for each in streams:
            each.management.close_all(at_once=True)
        await settle()
        contexts = [
            *(each.management.listener_context for each in streams),
            *(one.listener_context for one in datagrams),
        ]
        late = {task for context in contexts for task in context.late_answers}
        if late:  # they are cancelled; what responders do then gets as much time as replies
            await asyncio.wait(late, timeout=_STOP_SECONDS)

    async def reset(self) -> None:
        """Stop the server, clear its counters, and start it again. Raises what `start` raises; then it is stopped."""
        await self.stop()
        self.counters = ServerCounters()
        await self.start()

    def reset_counters(self) -> None:
        """Set the ``counters`` of the server's status to zero, with what open connections have counted so far.

        Connections and listeners stay open, and the counters of each keep their values.
        """
        # An open connection adds its counters when it ends; what it has counted until now is subtracted here.
        self.counters.take_off(self._counters_now())

    async def serve_until_cancelled(self) -> None:
        """Start unless running, serve until the task is cancelled, then stop."""
        await self.start()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            await self.stop()

    def status(self) -> ServerStatus:
        """Return the current status of the server: listeners, connections and counters."""
        connections = tuple(one for listener in self._with_peers() for one in listener.status())
        slots = [each.management.connection_slots for each in self._streams]
        limits_of = {id(one): one.limits for one in slots}  # listeners may share them
        return ServerStatus(
            running=self.is_running,
            uptime=time.monotonic() - self._started if self._started else 0.0,
            endpoints=tuple(self._bound),
            connections=connections,
            supported_connections=sum(limits.priority + limits.other for limits in limits_of.values()),
            remote_connections=len(connections),
            local_connections=self._local_connections(),
            counters=self._counters_now(),
            listeners=(
                *(listener.listener_status() for listener in self._with_peers()),
                *(line.status() for line in self._lines),
            ),
            refusals=dict(getattr(self._authorizer, "refusals", {})),
        )

    def is_priority(self, listener: str, host: str) -> bool:
        """Whether a host is a priority host of a network listener; False if there is no such listener.

        Args:
            listener: URL of the listener: the first one that it is bound to, as in `ClientIdentity.listener`.
            host: address of a client, without a port.
        """
        listener_contexts = [each.listener_context for each in self._with_peers()]
        return any(one.is_priority(host) for one in listener_contexts if one.listener == listener)

    def _with_peers(self) -> "list[ConnectionManagement | UdpListener]":
        return [*(each.management for each in self._streams), *self._datagrams]

    def _counters_now(self) -> ServerCounters:
        """Return the counters of the server, with those of open connections added."""
        counters = self.counters.copy()
        counters.requests += sum(line.requests for line in self._lines)
        for listener in self._with_peers():
            listener.add_living(counters)
        return counters

    def _authorizer_for(self, policy: "Policy | None", audit: "AuditLog | None") -> "PolicyAuthorizer | None":
        if policy is None and audit is None:
            return None
        from ..access.authorizer import PolicyAuthorizer

        self._policy_authorizer = PolicyAuthorizer(policy, audit)
        return self._policy_authorizer

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()


__all__ = ["Server", "ServerStatus"]
