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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from ...access.addresses import HostAuthorizer, allow_all
from ...access.authorizer import PolicyAuthorizer
from ...access.rates import Rates
from ...access.rules import Policy
from ...client.settings import LinkSettings, link_settings, options_of
from ...codes import DEFAULT_TCP_PORT, LAST_SERIAL_UNIT, TCP_DEVICE_UNIT
from ...errors import ConfigError
from ...options.client import CLIENT_DEADLINE, ClientParameters
from ...options.declaration import declared
from ...options.endpoints import Endpoint, parse_endpoint
from ...options.gateway import GatewayParameters, UpstreamParameters
from ...options.lines import BreakerParameters
from ...options.server import ListenerParameters
from ...options.text import build_parameters
from ...pdu.functions import STANDARD, FunctionTable
from ...server.counters import ServerCounters
from ...server.listener import Listener
from ...server.local import DeviceResponder
from ...server.naming import is_loopback
from ...server.server import Server, ServerStatus
from ...server.status import ConnectionStatus, ListenerStatus
from ...session.pipeline import RequestObserver
from ...session.reconnect import ConnectionState
from ...session.responder import Responder
from .decoded_reads import CachingFunctionTable
from .forwarding import Forwarder
from .own_unit import STATES, own_device
from .router import GatewayListenerCounters, ListenerRouter
from .routes import RoutingTable
from .upstream import Upstream, UpstreamStatus

if TYPE_CHECKING:
    from ...access.audit_log import AuditLog

UPSTREAM_DEFAULTS: Mapping[str, Any] = {  # Any: values of options
    "port_wait": 0.0,
    "timeout": ClientParameters().timeout,
    "open_after": BreakerParameters().open_after,
}
"""Options of links with another default in a gateway: it does not wait for a missing port; on a network, its attempts
end before its clients give up, and a silent unit does not stall the others."""
_CONNECTED = frozenset({ConnectionState.UP.value, ConnectionState.SUSPECT.value})


@dataclass(frozen=True, slots=True)
class GatewayListener:
    """A listener of a gateway.

    Attributes:
        name: its name in routes.
        settings: endpoint, access, certificates and limits.
        deadline: seconds until each request is answered, if necessary with 0A or 0B; None for no limit. Requests
            still queued then are not sent.
        silent_broadcasts: whether a write to unit 0 is not answered.
    """

    name: str
    settings: Listener
    deadline: float | None = CLIENT_DEADLINE
    silent_broadcasts: bool = False


@dataclass(frozen=True, slots=True)
class UpstreamSettings:
    """An upstream of a gateway.

    Attributes:
        name: its name in routes.
        link: endpoint, timeouts and gaps, as for `busway.open`.
        options: connections, shared reads, broadcasts.
        unit_gaps: seconds of silence after a reply, by unit; on serial lines only.
        same_device: groups of units that are the same device: a write to one drops remembered values of the others.
    """

    name: str
    link: LinkSettings
    options: UpstreamParameters = field(default_factory=UpstreamParameters)
    unit_gaps: Mapping[int, float] = field(default_factory=dict)
    same_device: tuple[frozenset[int], ...] = ()

    def __post_init__(self) -> None:
        self._check_same_device()
        if self.unit_gaps and self.link.line is None:
            raise ConfigError("units have gaps of their own on serial lines only", key="unit_gaps")
        if self.options.connections > 1 and self.link.endpoint.carrier == "serial":
            raise ConfigError("a serial port is opened once", key="connections")

    def _check_same_device(self) -> None:
        seen: set[int] = set()
        first, last = (0, 255) if self.link.line is None else (1, LAST_SERIAL_UNIT)
        for group in self.same_device:
            if len(group) < 2:
                raise ConfigError("a group is two units or more: [[1, 2]]", key="same_device")
            wrong = next((unit for unit in sorted(group) if not first <= unit <= last), None)
            if wrong is not None:
                raise ConfigError(f"a unit of this line is {first}…{last}, not {wrong}", key="same_device")
            if group & seen:
                raise ConfigError(f"unit {min(group & seen)} is in two groups", key="same_device")
            seen |= group

    @classmethod
    def of(cls, name: str, url: str | Endpoint, **options: Any) -> Self:
        """Create settings from a URL and options of this class and of links. Raises `ConfigError`.

        A missing port is not waited for, unless ``port_wait`` says so: clients get 0A at once. ``timeout``
        is 1 second, and ``open_after`` 3, for every scheme.
        """
        endpoint = parse_endpoint(url)
        offered = options_of(endpoint)
        for key, value in UPSTREAM_DEFAULTS.items():
            if key in offered and key not in endpoint.options:
                options.setdefault(key, value)
        own = {key: options.pop(key) for key in declared(UpstreamParameters) if key in options}
        rest = {key: options.pop(key) for key in ("unit_gaps", "same_device") if key in options}
        return cls(name, link_settings(url, options), build_parameters(UpstreamParameters, own), **rest)


@dataclass(frozen=True, slots=True)
class GatewayListenerStatus:
    """Status of a listener."""

    name: str
    server: ServerStatus
    counters: GatewayListenerCounters


@dataclass(frozen=True, slots=True)
class GatewayStatus:
    """Status of a gateway, also as the sum of its servers.

    Attributes:
        running: whether it is started.
        uptime: seconds since the start; 0 while stopped.
        endpoints: URLs of the listeners, with the ports that they are bound to.
        gateway_listeners, upstreams: status of each.
        open_requests: requests that are not answered yet.
    """

    running: bool
    uptime: float
    endpoints: tuple[str, ...]
    gateway_listeners: tuple[GatewayListenerStatus, ...]
    upstreams: tuple[UpstreamStatus, ...]
    open_requests: int

    @property
    def connections(self) -> tuple[ConnectionStatus, ...]:
        """The connections of all listeners."""
        return tuple(one for listener in self.gateway_listeners for one in listener.server.connections)

    @property
    def listeners(self) -> tuple[ListenerStatus, ...]:
        """The status of all listeners."""
        return tuple(one for listener in self.gateway_listeners for one in listener.server.listeners)

    @property
    def counters(self) -> ServerCounters:
        """The counters of all listeners, added up."""
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
        """Most connections that all listeners accept together."""
        return sum(listener.server.supported_connections for listener in self.gateway_listeners)

    @property
    def remote_connections(self) -> int:
        """Number of clients' connections."""
        return sum(listener.server.remote_connections for listener in self.gateway_listeners)

    @property
    def local_connections(self) -> int:
        """Number of open connections to upstreams."""
        return sum(link.state in _CONNECTED for upstream in self.upstreams for link in upstream.links)


@dataclass(slots=True)
class _RunningListener:
    listener: GatewayListener
    responder: ListenerRouter
    authorizer: PolicyAuthorizer | None
    server: Server

    def follow(self, listener: GatewayListener) -> None:
        """Apply changed options that need no new server; connections stay."""
        self.listener = listener
        self.responder.deadline = listener.deadline
        self.responder.silent_broadcasts = listener.silent_broadcasts


@dataclass(frozen=True)
class GatewayPlan:
    """The configuration of a gateway, checked as a whole.

    Attributes:
        listeners, upstreams: each with a unique name.
        table: the routes between them.
        own_unit: unit identifier of the gateway itself; None: it answers as no unit.
        own_registers: whether its own unit has input registers with its status.
        functions: the table of functions; other functions are forwarded unread.
        server: options of `Server` for all listeners (parameters, limits, sockets, policy, audit …).
    """

    listeners: tuple[GatewayListener, ...]
    upstreams: tuple[UpstreamSettings, ...]
    table: RoutingTable
    own_unit: int | None = TCP_DEVICE_UNIT
    own_registers: bool = False
    functions: FunctionTable = STANDARD
    server: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.listeners:
            raise ConfigError("a gateway needs at least one listener to listen on", key="listener")
        for key, names in (
            ("listener", [one.name for one in self.listeners]),
            ("link", [one.name for one in self.upstreams]),
        ):
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ConfigError(f"the name {twice!r} stands twice", key=key)
        upstreams = {one.name for one in self.upstreams}
        listeners = {one.name for one in self.listeners}
        for route in self.table.routes:
            if route.upstream and route.upstream not in upstreams:
                raise ConfigError(
                    f"there is no line {route.upstream!r}, but {', '.join(sorted(upstreams)) or 'none at all'}",
                    key="route.upstream",
                )
            unknown = sorted(route.listeners - listeners)
            if unknown:
                raise ConfigError(
                    f"there is no listener {unknown[0]!r}, but {', '.join(sorted(listeners))}", key="route.listeners"
                )


class Gateway:
    """A gateway; as an asynchronous context manager it starts and stops.

    Args:
        plan: its configuration.
        authorize: called at every listener with the host of a new client; decides whether it may connect.
        policy: rules for the requests at every listener; None permits all.
        audit: where denied requests and writes are recorded.
        observers: see the requests of all listeners (metrics, for example).

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
        """Whether it is started."""
        return bool(self._listeners)

    @property
    def endpoints(self) -> list[str]:
        """URLs of the listeners, with the ports that they are bound to; empty while stopped."""
        return [url for each in self._listeners.values() for url in each.server.endpoints]

    async def start(self) -> None:
        """Open all listeners; upstreams connect at the first request. Raises `LinkDown`, `ConfigError`."""
        if self.is_running:
            return
        try:
            self._forwarders = {one.name: _opened(one) for one in self.plan.upstreams}
            self._follow(self._running.values())
            for name, each in self._running.items():
                await each.server.start()
                self._listeners[name] = each
        except BaseException:
            await self.stop()
            raise
        self._started = time.monotonic()

    async def stop(self) -> None:
        """Close listeners and upstreams at once. Open requests get no reply."""
        listeners, self._listeners = self._listeners, {}
        for each in listeners.values():
            await each.server.stop()
        forwarders, self._forwarders = self._forwarders, {}
        for forwarder in forwarders.values():
            await forwarder.upstream.close()
        self._started = 0.0

    async def drain(self, seconds: float = GatewayParameters().drain) -> int:
        """Accept nothing new, wait until open requests are answered, then stop. Returns how many were not answered.

        Args:
            seconds: longest time to wait.
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

    async def change(self, plan: GatewayPlan, *, policy: Policy | None = None) -> list[str]:
        """Apply another configuration. Returns what changed, in words.

        Unchanged listeners and upstreams keep their connections. If a new listener cannot be opened, the error is
        raised and everything is as before, but clients of listeners that were to change have lost their connections.

        Args:
            plan: the new plan.
            policy: the policy of new listeners until `replace_policy`; None: that of the others.

        Raises:
            LinkDown, ConfigError: a new listener or upstream cannot be opened.
        """
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
        ports = [upstream for upstream in closing if upstream.settings.endpoint.carrier == "serial"]
        going = [each for name, each in self._listeners.items() if name not in same_listeners]
        forwarders, listeners = dict(same_upstreams), dict(same_listeners)
        try:
            # They may hold ports that new ones need.
            for each in going:
                await each.server.stop()
            for upstream in ports:
                await upstream.close()
            for settings in plan.upstreams:
                if settings.name not in forwarders:
                    forwarders[settings.name] = _opened(settings)
            for listener in plan.listeners:
                if listener.name not in listeners:
                    listeners[listener.name] = made = self._made(listener, plan, forwarders, policy or self._policy)
                    await made.server.start()
        except BaseException:
            for name in listeners.keys() - same_listeners.keys():
                await listeners[name].server.stop()
            for name in forwarders.keys() - same_upstreams.keys():
                await forwarders[name].upstream.close()
            for upstream in ports:
                _open(upstream, old_upstreams[upstream.name])
            for each in going:
                await each.server.start()
            raise
        said = [*_changes("listener", old_listeners, plan.listeners), *_changes("link", old_upstreams, plan.upstreams)]
        if plan.table != self.plan.table:
            said.append(f"{len(plan.table.routes)} routes")
        self.plan = plan
        self._forwarders = {one.name: forwarders[one.name] for one in plan.upstreams}
        self._listeners = {one.name: listeners[one.name] for one in plan.listeners}
        self._running = dict(self._listeners)
        for listener in plan.listeners:
            listeners[listener.name].follow(listener)
        self._follow(self._listeners.values())
        for upstream in closing:
            await upstream.close()
        return said

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
        """The functions that it decodes."""
        return self._functions

    def observe(self, observer: RequestObserver) -> None:
        """Register an observer of the requests of all listeners. Only while stopped.

        Raises:
            ConfigError: it is running.
        """
        if self.is_running:
            raise ConfigError("a running gateway keeps its observers", key="observer")
        self._observers.append(observer)
        for each in self._running.values():
            each.server.observe(observer)

    def replace_policy(self, policy: Policy) -> None:
        """Replace the policy of all listeners, from the next request on.

        Raises:
            ConfigError: the gateway was made without one.
        """
        if not self._is_guarded:
            raise ConfigError("the gateway was made without a policy", key="policy")
        self._policy = policy
        for each in self._running.values():
            if each.authorizer is not None:
                each.authorizer.replace_policy(policy)

    def reload_security(self) -> None:
        """As `Server.reload_security`, for every listener."""
        for each in self._running.values():
            each.server.reload_security()

    def end_unauthorized(self) -> int:
        """As `Server.end_unauthorized`, for every listener."""
        return sum(each.server.end_unauthorized() for each in self._running.values())

    def is_priority(self, listener: str, host: str) -> bool:
        """Whether a host is a priority host of the listener with a URL, as in ``endpoints``."""
        return any(each.server.is_priority(listener, host) for each in self._running.values())

    def reset_counters(self) -> None:
        """Set the counters of listeners and upstreams to zero."""
        for each in self._running.values():
            each.server.reset_counters()
            _to_zero(each.responder.counters)
        for upstream in self._upstreams:
            _to_zero(upstream.counters)

    # Status.

    @property
    def open_requests(self) -> int:
        """Number of requests that are not answered yet."""
        return sum(forwarder.open_requests for forwarder in self._forwarders.values())

    @property
    def servers(self) -> list[Server]:
        """The servers of the listeners."""
        return [each.server for each in self._running.values()]

    def status(self) -> GatewayStatus:
        """A snapshot of its status."""
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
        """The values of the own unit's registers."""
        status = self.status()
        own = [
            int(status.uptime),
            len(status.gateway_listeners),
            len(status.upstreams),
            sum(len(listener.server.connections) for listener in status.gateway_listeners),
            sum(listener.server.counters.requests for listener in status.gateway_listeners),
            sum(listener.counters.no_route for listener in status.gateway_listeners),
        ]
        return own, [_upstream_numbers(upstream) for upstream in status.upstreams]

    # Inside.

    @property
    def _upstreams(self) -> list[Upstream]:
        return [each.upstream for each in self._forwarders.values()]

    @property
    def _is_guarded(self) -> bool:
        return self._policy is not None or self._audit is not None

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
            authorizer = PolicyAuthorizer(policy or Policy.allow_all(), self._audit, rates=self._rates)
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
    """The parts of a plan that change only with a restart."""
    return plan.own_unit, plan.own_registers, plan.functions, plan.server


def _standard_port(listener: GatewayListener, plan: GatewayPlan) -> bool | None:
    """Whether a listener listens on 502 too; one of several listeners does."""
    choice: bool | None = plan.server.get("standard_port")
    places = {one.name: parse_endpoint(one.settings.endpoint) for one in plan.listeners}
    plain = {name: place for name, place in places.items() if place.scheme == "tcp"}
    if choice is False or any(place.port == DEFAULT_TCP_PORT for place in plain.values()):
        return False
    reachable = [name for name, place in plain.items() if place.port and not is_loopback(place.url)]
    return choice if listener.name in (reachable or list(plain))[:1] else False


def _to_zero(counters: object) -> None:
    """Set the numbers of a dataclass to zero."""
    for one in fields(counters):  # type: ignore[arg-type]  # a dataclass of any kind
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
    upstream.leave_alone(settings.unit_gaps)


def _changes(
    what: str, old: Mapping[str, GatewayListener | UpstreamSettings], new: Iterable[GatewayListener | UpstreamSettings]
) -> Iterator[str]:
    """Added, changed and closed listeners or upstreams, in words."""
    names = set()
    for one in new:
        names.add(one.name)
        if old.get(one.name) != one:
            yield f"{what} {one.name} {'changed' if one.name in old else 'added'}"
    yield from (f"{what} {name} closed" for name in old if name not in names)


def _upstream_numbers(upstream: UpstreamStatus) -> list[int]:
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


def simple_plan(
    listeners: Sequence[str | Endpoint | Listener], upstream: str | Endpoint, **options: Any
) -> GatewayPlan:
    """The common case: every unit of every listener to one upstream.

    Args:
        listeners: URLs to listen on.
        upstream: URL of the upstream.
        options: of the upstream, as for `UpstreamSettings.of`.
    """
    from .routes import ALL_UNITS, Route

    endpoint = parse_endpoint(upstream)
    units = ALL_UNITS if endpoint.framing == "mbap" else frozenset(range(1, 248))
    wanted = [one if isinstance(one, Listener) else Listener(one) for one in listeners]
    return GatewayPlan(
        listeners=tuple(GatewayListener(parse_endpoint(one.endpoint).url, one) for one in wanted),
        upstreams=(UpstreamSettings.of("line", upstream, **options),),
        table=RoutingTable((Route(upstream="line", units=units),)),
    )
