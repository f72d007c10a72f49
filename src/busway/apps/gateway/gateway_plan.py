"""What a gateway is made of, as checked objects: its listeners, upstreams and routes, checked together.

Knows what a gateway needs; knows no file (`configuration` makes a plan from one), and runs nothing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from ...client.settings import LinkSettings, link_settings, with_defaults
from ...codes import LAST_SERIAL_UNIT, TCP_DEVICE_UNIT
from ...errors import ConfigError
from ...options.client import CLIENT_DEADLINE, ClientParameters
from ...options.declaration import declared
from ...options.endpoints import Endpoint, parse_endpoint
from ...options.gateway import UpstreamParameters
from ...options.lines import BreakerParameters
from ...options.text import build_parameters
from ...pdu.functions import STANDARD, FunctionTable
from ...server.listener import Listener
from .routes import ALL_UNITS, SERIAL_UNITS, Route, RoutingTable

UPSTREAM_DEFAULTS: Mapping[str, Any] = {  # Any: values of options
    "port_wait": 0.0,
    "timeout": ClientParameters().timeout,
    "open_after": BreakerParameters().open_after,
}
"""Options of links whose default in a gateway differs from that of `busway.open`: the gateway's default by name.

A gateway does not wait for a missing port. On a network its attempts end before its clients give up, and a silent unit
does not stall the others.
"""


@dataclass(frozen=True, slots=True)
class GatewayListener:
    """A listener of a gateway with its options.

    Attributes:
        name: name of the listener in routes.
        settings: endpoint, access, certificates and limits.
        deadline: seconds until each request is answered, if necessary with 0A or 0B; None for no limit. Requests
            still queued then are not sent.
        silent_broadcasts: whether a write to unit 0 gets no reply.
    """

    name: str
    settings: Listener
    deadline: float | None = CLIENT_DEADLINE
    silent_broadcasts: bool = False


@dataclass(frozen=True, slots=True)
class UpstreamSettings:
    """The settings of one upstream: its name, link and options.

    Attributes:
        name: name of the upstream in routes.
        link: endpoint, timeouts and gaps, as for `busway.open`.
        options: number of connections, whether reads are shared, whether broadcasts are forwarded.
        unit_gaps: for each unit, seconds of silence after its reply before it gets the next request; only with RTU and
            ASCII framing.
        same_device: groups of units that are the same device: a write to one drops remembered values of the others.

    Raises:
        ConfigError: ``unit_gaps`` with Modbus TCP framing, several connections to a serial port, or an invalid group.
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
        """Create the settings of an upstream from a URL and options. Raises `ConfigError` if one of them is invalid.

        The gateway does not wait for a missing port unless ``port_wait`` says so: clients get 0A at once. By default
        ``timeout`` is 1 second and ``open_after`` 3, for every scheme. What a preset sets has priority over these.

        Args:
            name: name of the upstream in routes.
            url: URL of the line or server.
            options: options of links, of `UpstreamParameters`, and ``unit_gaps`` and ``same_device`` of this class.
        """
        endpoint = parse_endpoint(url)
        own = {key: options.pop(key) for key in declared(UpstreamParameters) if key in options}
        rest = {key: options.pop(key) for key in ("unit_gaps", "same_device") if key in options}
        return cls(
            name,
            link_settings(url, with_defaults(endpoint, options, UPSTREAM_DEFAULTS)),
            build_parameters(UpstreamParameters, own),
            **rest,
        )


@dataclass(frozen=True)
class GatewayPlan:
    """The complete configuration of a gateway (listeners, upstreams, routes) as objects, checked as a whole.

    Attributes:
        listeners: the listeners, each with a unique name.
        upstreams: the upstreams, each with a unique name.
        table: the routes between them.
        own_unit: unit identifier of the gateway itself, 0…255; None if the gateway has no unit of its own.
        own_registers: whether the own unit has input registers with the gateway's status.
        functions: the table of functions; requests with other functions are forwarded unread.
        server: keyword arguments of `Server` for all listeners (parameters, limits, sockets, TLS …).

    Raises:
        ConfigError: there is no listener, two listeners or two upstreams have the same name, or a route names an
            upstream or listener that does not exist.
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


def simple_plan(
    listeners: Sequence[str | Endpoint | Listener], upstream: str | Endpoint, **options: Any
) -> GatewayPlan:
    """Return the configuration of a gateway that forwards all units of all listeners to one upstream.

    All units are 0…255, or 1…247 if the upstream has RTU or ASCII framing.

    Args:
        listeners: URLs to listen on, or listeners; a URL is also the name of its listener.
        upstream: URL of the upstream, which gets the name ``line``.
        options: options of the upstream, as for `UpstreamSettings.of`.

    Raises:
        ConfigError: an invalid URL or option.
    """
    endpoint = parse_endpoint(upstream)
    units = ALL_UNITS if endpoint.framing == "mbap" else SERIAL_UNITS
    wanted = [one if isinstance(one, Listener) else Listener(one) for one in listeners]
    return GatewayPlan(
        listeners=tuple(GatewayListener(parse_endpoint(one.endpoint).url, one) for one in wanted),
        upstreams=(UpstreamSettings.of("line", upstream, **options),),
        table=RoutingTable((Route(upstream="line", units=units),)),
    )
