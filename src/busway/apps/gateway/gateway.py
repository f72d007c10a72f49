"""The gateway: starts, drains, reloads and stops listeners and upstreams (Messaging on TCP/IP V1.0b §4.4.2; T24, T32).

Knows servers, routes and upstreams; knows no file.

1. Each listener is a server of its own, so that one can be opened, closed or changed while the others go on.
2. Draining ends when all earlier requests are answered, or at its deadline. Meanwhile no connection is accepted, and
   nothing more is read.
3. A change of configuration keeps unchanged listeners and upstreams with their connections. New routes hold for all
   from the next request on.
4. All listeners share the policy, the audit log, and the counts of rules with rates.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import TracebackType
from typing import TYPE_CHECKING, Self

from ...access.addresses import HostAuthorizer, allow_all
from ...access.authorizer import PolicyAuthorizer
from ...access.rates import Rates
from ...access.rules import Policy
from ...codes import DEFAULT_TCP_PORT, TCP_DEVICE_UNIT
from ...errors import ConfigError
from ...options.endpoints import parse_endpoint
from ...options.gateway import GatewayParameters
from ...options.server import ListenerParameters
from ...pdu.functions import FunctionTable
from ...server.bound_sockets import is_loopback
from ...server.device_responder import DeviceResponder
from ...server.server import Server
from ...session.responder import Responder
from ...session.server_pipeline import RequestObserver
from .decoded_reads import CachingFunctionTable
from .forwarding import Forwarder
from .gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from .own_unit import own_device
from .router import ListenerRouter
from .status import GatewayListenerStatus, GatewayStatus, upstream_numbers
from .upstream import Upstream

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from ...access.audit_log import AuditLog


@dataclass(slots=True)
class _RunningListener:
    """A listener of a gateway with its settings (``listener``), its server, responder and authorizer.

    The authorizer is None if the gateway was created without a policy and without an audit log.
    """

    listener: GatewayListener
    responder: ListenerRouter
    authorizer: PolicyAuthorizer | None
    server: Server

    def follow(self, listener: GatewayListener) -> None:
        """Use the deadline and the option ``silent_broadcasts`` of changed settings at once; connections stay open."""
        self.listener = listener
        self.responder.deadline = listener.deadline
        self.responder.silent_broadcasts = listener.silent_broadcasts


class Gateway:
    """A gateway: forwards requests from its listeners to its upstreams while the ``async with`` block lasts.

    Args:
        plan: the configuration: listeners, upstreams and routes.
        authorize: called with the host of each new client at any listener; returns whether the client may connect.
        policy: rules for the requests at all listeners; None permits all requests.
        audit: the audit log for denied requests and writes; None for none.
        observers: objects that see the requests of all listeners (metrics, for example).

    Attributes:
        plan: the configuration in force.
    """

    def __init__(
        self,
        plan: GatewayPlan,
        *,
        authorize: HostAuthorizer = allow_all,
        policy: Policy | None = None,
        audit: "AuditLog | None" = None,
        observers: Iterable[RequestObserver] = (),
    ) -> None:
        self.plan: GatewayPlan = plan
        self._authorize = authorize
        self._policy = policy
        self._audit = audit
        self._rates: dict[str, Rates] = {}
        self._observers = list(observers)
        self._listeners: dict[str, _RunningListener] = {}
        self._opening: list[_RunningListener] = []  # those that a change adds, until they are among the others
        self._forwarders: dict[str, Forwarder] = {}  # by the name of their upstream
        self._started = 0.0
        self._functions: FunctionTable = CachingFunctionTable(plan.functions)
        self._own: Responder | None = None
        if plan.own_unit is not None:
            self._own = DeviceResponder({plan.own_unit: own_device(self._numbers, registers=plan.own_registers)})
        self._running = {listener.name: self._made(listener, plan, {}, policy) for listener in plan.listeners}

    # Start and stop.

    @property
    def is_running(self) -> bool:
        """Whether the gateway was started and not stopped."""
        return bool(self._listeners)

    @property
    def endpoints(self) -> list[str]:
        """The URLs of the open listeners, with the ports that they are bound to; empty while the gateway is stopped."""
        return [url for each in self._listeners.values() for url in each.server.endpoints]

    async def start(self) -> None:
        """Open all listeners of the gateway; does nothing while the gateway runs.

        Does not wait for the upstreams: their serial ports are opened in the background, again and again until that
        succeeds, and servers on networks are connected at the first request.

        Raises:
            LinkDown: a listener cannot be opened; the gateway is stopped.
            ConfigError: a listener or upstream cannot be used as configured; the gateway is stopped.
        """
        if self.is_running:
            return
        try:
            for one in self.plan.upstreams:  # one by one: after an error `stop` closes those that are open
                self._forwarders[one.name] = _opened(one)
            self._follow(self._running.values())
            for name, each in self._running.items():
                await each.server.start()
                self._listeners[name] = each
        except BaseException:
            await self.stop()
            raise
        self._started = time.monotonic()

    async def stop(self) -> None:
        """Close all listeners, then all upstreams, without waiting for forwarded requests, which get no reply any more.

        Replies that are ready are still sent, as by `Server.stop`. `start` may be called again.
        """
        listeners, self._listeners = self._listeners, {}
        for each in listeners.values():
            await each.server.stop()
        forwarders, self._forwarders = self._forwarders, {}
        for forwarder in forwarders.values():
            await forwarder.upstream.close()
        self._started = 0.0

    async def drain(self, seconds: float = GatewayParameters().drain) -> int:
        """Accept no connection or request any more, wait until open requests are answered, then stop the gateway.

        Returns the number of forwarded requests that had no answer when the gateway was stopped; 0 if all had one.

        Args:
            seconds: longest wait for answers; by default 5, as for the option ``drain``.
        """
        for each in self._listeners.values():
            await each.server.take_no_more()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                for forwarder in self._forwarders.values():
                    await forwarder.wait_until_answered()
        left = self.open_requests
        await self.stop()
        return left

    async def change(
        self,
        plan: GatewayPlan,
        *,
        policy: Policy | None = None,
        when_applied: Callable[[Sequence[str]], None] = lambda said: None,
    ) -> list[str]:
        """Apply another configuration while the gateway runs, and return what changed: one text for each part.

        Unchanged listeners and upstreams keep their connections. After an error the old configuration is in force
        again, but listeners and serial ports that were to change have lost their connections.

        Args:
            plan: the new configuration; own unit, functions and options of servers must be the same as before.
            policy: the policy of new listeners until `replace_policy`; None for the policy of the existing listeners.
            when_applied: called with the result, in the step in which the routes change, so that no request is answered
                between: to replace the policy that goes with them.

        Raises:
            LinkDown: a new listener cannot be opened.
            ConfigError: a new listener or upstream cannot be used as configured, or a part differs that only a restart
                can change; or there is a policy, and the gateway was created without one and without an audit log.
        """
        if policy is not None:
            self._check_guarded()
        if _until_restart(plan) != _until_restart(self.plan):
            raise ConfigError(
                "own unit, functions and the options of servers change with a restart only", key="gateway"
            )
        old_upstreams = {one.name: one for one in self.plan.upstreams}
        old_listeners = {one.name: one for one in self.plan.listeners}
        same_upstreams = {
            one.name: self._forwarders[one.name] for one in plan.upstreams if old_upstreams.get(one.name) == one
        }
        same_listeners = {
            one.name: self._listeners[one.name]
            for one in plan.listeners
            if one.name in self._listeners and old_listeners[one.name].settings == one.settings
        }
        closing = [each.upstream for name, each in self._forwarders.items() if name not in same_upstreams]
        forwarders, listeners = await self._exchanged(plan, same_upstreams, same_listeners, policy)
        said = [*_changes("listener", old_listeners, plan.listeners), *_changes("link", old_upstreams, plan.upstreams)]
        if plan.table != self.plan.table:
            said.append(f"{len(plan.table.routes)} routes")
        self.plan = plan
        self._forwarders = {one.name: forwarders[one.name] for one in plan.upstreams}
        self._listeners = {one.name: listeners[one.name] for one in plan.listeners}
        self._running = dict(self._listeners)
        self._opening.clear()
        for listener in plan.listeners:
            listeners[listener.name].follow(listener)
        self._follow(self._listeners.values())
        when_applied(said)
        for upstream in closing:
            await upstream.close()
        return said

    async def _exchanged(
        self,
        plan: GatewayPlan,
        same_upstreams: Mapping[str, Forwarder],
        same_listeners: Mapping[str, _RunningListener],
        policy: Policy | None,
    ) -> tuple[dict[str, Forwarder], dict[str, _RunningListener]]:
        """Close changed or removed listeners and serial ports, then open the new ones; after an error, undo all that.

        Closing comes first, because old listeners may hold ports that new ones need. Upstreams on networks that
        change or end are left open; the caller closes them.

        Args:
            plan: the new configuration.
            same_upstreams: by name, the forwarders of upstreams that do not change.
            same_listeners: by name, the listeners that do not change.
            policy: the policy of new listeners; None for that of the gateway.

        Returns:
            The forwarders of all upstreams of the new configuration, and all its listeners, each by name.
        """
        old_upstreams = {one.name: one for one in self.plan.upstreams}
        forwarders, listeners = dict(same_upstreams), dict(same_listeners)
        async with contextlib.AsyncExitStack() as unless_opened:
            for name, each in self._listeners.items():
                if name not in same_listeners:
                    unless_opened.push_async_callback(each.server.start)
                    await each.server.stop()
            for name, old in self._forwarders.items():
                if name not in same_upstreams and old.upstream.settings.endpoint.carrier == "serial":
                    unless_opened.callback(_open, old.upstream, old_upstreams[name])
                    await old.upstream.close()
            for settings in plan.upstreams:
                if settings.name not in forwarders:
                    forwarders[settings.name] = new = _opened(settings)
                    unless_opened.push_async_callback(new.upstream.close)
            for listener in plan.listeners:
                if listener.name not in listeners:
                    made = self._made(listener, plan, forwarders, policy or self._policy)
                    listeners[listener.name] = made
                    self._opening.append(made)
                    unless_opened.callback(self._opening.clear)
                    unless_opened.push_async_callback(made.server.stop)
                    await made.server.start()
            unless_opened.pop_all()
        return forwarders, listeners

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    # Policy, security, counters.

    @property
    def functions(self) -> FunctionTable:
        """The table of the functions that the gateway decodes; requests with other functions are forwarded unread."""
        return self._functions

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of the requests of all listeners; possible only while the gateway is stopped.

        Raises:
            ConfigError: the gateway runs.
        """
        if self.is_running:
            raise ConfigError("a running gateway keeps its observers", key="observer")
        self._observers.append(observer)
        for each in self._running.values():
            each.server.observe(observer)

    def replace_policy(self, policy: Policy) -> None:
        """Use another access policy on all listeners, from the next request on.

        Raises:
            ConfigError: the gateway was created without a policy and without an audit log, or ``policy`` is no
                `Policy`; the one before holds.
        """
        self._check_guarded()
        for each in (*self._running.values(), *self._opening):
            if each.authorizer is not None:
                each.authorizer.replace_policy(policy)
        self._policy = policy

    def reload_security(self) -> None:
        """Read the certificate files of all listeners again, for new connections (`Server.reload_security`).

        Raises:
            ConfigError: a file cannot be used; names the file. Its listener keeps the old files, the others are
                updated.
        """
        failures: list[ConfigError] = []
        for each in self._running.values():
            try:
                each.server.reload_security()
            except ConfigError as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def end_unauthorized(self) -> int:
        """Abort the connections of hosts that may no longer connect to their listener.

        Returns the number of connections, TLS handshakes and UDP peers that were ended.
        """
        return sum(each.server.end_unauthorized() for each in self._running.values())

    def is_priority(self, listener: str, host: str) -> bool:
        """Whether a host is a priority host of the listener with this URL; False if no listener has the URL.

        Args:
            listener: a URL as in `endpoints`.
            host: the client's host.
        """
        return any(each.server.is_priority(listener, host) for each in self._running.values())

    def reset_counters(self) -> None:
        """Set the counters of listeners and upstreams to zero, except those of each link (`LinkStatus.counters`)."""
        for each in self._running.values():
            each.server.reset_counters()
            _to_zero(each.responder.counters)
        for upstream in self._upstreams:
            _to_zero(upstream.counters)

    # Status.

    @property
    def open_requests(self) -> int:
        """Number of requests forwarded to any upstream that have no answer yet."""
        return sum(forwarder.open_requests for forwarder in self._forwarders.values())

    @property
    def servers(self) -> list[Server]:
        """The servers of the gateway, one for each listener, in the order of the listeners."""
        return [each.server for each in self._running.values()]

    def status(self) -> GatewayStatus:
        """Return the status of the gateway at this moment: listeners, upstreams and counters."""
        return GatewayStatus(
            running=self.is_running,
            uptime=time.monotonic() - self._started if self._started else 0.0,
            endpoints=tuple(self.endpoints),
            gateway_listeners=tuple(
                GatewayListenerStatus(name, each.server.status(), each.responder.counters)
                for name, each in self._running.items()
            ),
            upstreams=tuple(upstream.status() for upstream in self._upstreams),
            open_requests=self.open_requests,
        )

    def _numbers(self) -> tuple[list[int], list[list[int]]]:
        """Return the values for the own unit's status registers.

        First those of the gateway, in the order of `own_unit.REGISTERS`; then a list for each upstream, in the order of
        `own_unit.UPSTREAM_REGISTERS`.
        """
        status = self.status()
        own = [
            int(status.uptime),
            len(status.gateway_listeners),
            len(status.upstreams),
            sum(len(listener.server.connections) for listener in status.gateway_listeners),
            sum(listener.server.counters.requests for listener in status.gateway_listeners),
            sum(listener.counters.no_route for listener in status.gateway_listeners),
        ]
        return own, [upstream_numbers(upstream) for upstream in status.upstreams]

    # Inside.

    @property
    def _upstreams(self) -> list[Upstream]:
        return [each.upstream for each in self._forwarders.values()]

    @property
    def _is_guarded(self) -> bool:
        return self._policy is not None or self._audit is not None

    def _check_guarded(self) -> None:
        if not self._is_guarded:
            raise ConfigError("the gateway was made without a policy", key="policy")

    def _made(
        self, listener: GatewayListener, plan: GatewayPlan, forwarders: Mapping[str, Forwarder], policy: Policy | None
    ) -> _RunningListener:
        responder = ListenerRouter(
            listener.name,
            self._functions,
            own=self._own,
            own_unit=TCP_DEVICE_UNIT if plan.own_unit is None else plan.own_unit,
            deadline=listener.deadline,
            silent_broadcasts=listener.silent_broadcasts,
        )
        responder.follow(plan.table.of_listener(listener.name), forwarders)
        authorizer = None
        if self._is_guarded:
            authorizer = PolicyAuthorizer(policy, self._audit, rates=self._rates)
            responder.refusal_of = authorizer.refusal_of
        # A client that half-closes has left: its requests must not keep a serial line busy.
        limits = listener.settings.limits or plan.server.get("listener") or ListenerParameters()
        settings = replace(listener.settings, limits=replace(limits, answer_half_closed=False))
        options = {**plan.server, "standard_port": _standard_port(listener, plan)}
        server = Server(
            (settings,), responder, authorize=self._authorize, authorizer=authorizer, audit=self._audit, **options
        )
        for observer in self._observers:
            server.observe(observer)
        return _RunningListener(listener, responder, authorizer, server)

    def _follow(self, listeners: Iterable[_RunningListener]) -> None:
        for each in listeners:
            each.responder.follow(self.plan.table.of_listener(each.listener.name), self._forwarders)


def _until_restart(plan: GatewayPlan) -> tuple[object, ...]:
    """Return the parts of a configuration that only a restart can change: own unit, functions, server options."""
    return plan.own_unit, plan.own_registers, plan.functions, plan.server


def _standard_port(listener: GatewayListener, plan: GatewayPlan) -> bool | None:
    """Return the option ``standard_port`` for a listener's server: whether it also listens on port 502.

    At most one listener gets the value of the gateway's own option (True, or None for an attempt that may fail): the
    first ``tcp://`` listener with a fixed port that other hosts can reach, or without such a listener the first
    ``tcp://`` one. All others get False. All get False if the option is False, or if one of them has port 502 anyway.

    Args:
        listener: the listener.
        plan: the gateway's configuration, with all listeners.
    """
    choice: bool | None = plan.server.get("standard_port")
    places = {one.name: parse_endpoint(one.settings.endpoint) for one in plan.listeners}
    plain = {name: place for name, place in places.items() if place.scheme == "tcp"}
    if choice is False or any(place.port == DEFAULT_TCP_PORT for place in plain.values()):
        return False
    reachable = [name for name, place in plain.items() if place.port and not is_loopback(place.url)]
    return choice if listener.name in (reachable or list(plain))[:1] else False


def _to_zero(counters: "DataclassInstance") -> None:
    """Set every counter in a dataclass of counters to zero."""
    for one in fields(counters):
        setattr(counters, one.name, 0)


def _opened(settings: UpstreamSettings) -> Forwarder:
    upstream = Upstream(
        settings.name, settings.link, connections=settings.options.connections, broadcast=settings.options.broadcast
    )
    forwarder = Forwarder(upstream, share_reads=settings.options.share_reads, same_device=settings.same_device)
    _open(upstream, settings)
    return forwarder


def _open(upstream: Upstream, settings: UpstreamSettings) -> None:
    upstream.open()
    upstream.set_unit_gaps(settings.unit_gaps)


def _changes(
    what: str, old: Mapping[str, GatewayListener | UpstreamSettings], new: Iterable[GatewayListener | UpstreamSettings]
) -> Iterator[str]:
    """Yield a text for each listener or upstream that was added, changed or closed.

    Args:
        what: the first word of each text: ``listener`` or ``link``.
        old: the listeners or upstreams before the change, by name.
        new: the listeners or upstreams after the change.
    """
    names = set()
    for one in new:
        names.add(one.name)
        if old.get(one.name) != one:
            yield f"{what} {one.name} {'changed' if one.name in old else 'added'}"
    yield from (f"{what} {name} closed" for name in old if name not in names)
