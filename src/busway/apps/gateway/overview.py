"""The contents of a gateway file as rows of text: listeners, upstreams, and the routing table.

Knows configurations of gateways; checks nothing.
"""

from collections.abc import Iterator, Sequence

from ...client.sessions import timing_of
from ...codes import BROADCAST_UNIT, exception_meaning
from ...values.counts import counted
from ..service.overview import OverviewRow, overview
from .configuration import GatewayConfiguration
from .file_routes import PlacedRoute
from .gateway_plan import GatewayListener, GatewayPlan, UpstreamSettings
from .route_checks import worst_case
from .routes import ALL_UNITS, Route, RouteAction, units_text

RoutingRow = tuple[str, str, str, str, str, str]
"""One route as text: listeners, units, functions, addresses, where its requests go, further options."""
ROUTING_HEADINGS: RoutingRow = ("listener", "units", "functions", "addresses", "to", "")
_OF_GATEWAYS = frozenset({"listener", "policy", "server"})
"""Kinds of rows that the overview of a gateway takes from the overview of a server."""


def gateway_rows(configuration: GatewayConfiguration) -> Iterator[OverviewRow]:
    """Yield a row of text for each part of a gateway's configuration: its kind, name and description."""
    plan = configuration.plan
    known = {kind: [row for row in overview(configuration.common) if row[0] == kind] for kind in _OF_GATEWAYS}
    for listener, row in zip(plan.listeners, known["listener"], strict=True):
        yield "listener", listener.name, "; ".join(_listener(listener, row))
    for upstream in plan.upstreams:
        yield "link", upstream.name, "; ".join(_upstream(upstream, configuration.routes))
    yield "own unit", "none" if plan.own_unit is None else str(plan.own_unit), _own_unit(plan)
    yield from known["policy"]
    yield from known["server"]


def routing_rows(configuration: GatewayConfiguration) -> Iterator[RoutingRow]:
    """Yield each route of a gateway's configuration as a row of text, in the order in which routes are tried.

    `ROUTING_HEADINGS` has the headings of the columns.
    """
    names = [listener.name for listener in configuration.plan.listeners]
    for placed in configuration.routes:
        route = placed.route
        yield (
            ", ".join(name for name in names if name in route.listeners) if route.listeners else "all",
            "all" if route.units == ALL_UNITS else units_text(route.units),
            ", ".join(f"{code:02}" for code in sorted(route.functions)) or "all",
            "all" if route.addresses is None else str(route.addresses),
            _target(route),
            "; ".join(_details(route, placed.gap)),
        )


def _listener(listener: GatewayListener, row: OverviewRow) -> Iterator[str]:
    if listener.name != row[1]:
        yield row[1]
    yield row[2]
    if listener.deadline is not None:
        yield f"answers within {listener.deadline:g} s"
    if listener.silent_broadcasts:
        yield "broadcasts get no answer"


def _upstream(upstream: UpstreamSettings, routes: Sequence[PlacedRoute]) -> Iterator[str]:
    endpoint, parameters = upstream.link.endpoint, upstream.link.parameters
    yield endpoint.url
    if upstream.link.line is not None and upstream.link.line.port is not None:
        port = upstream.link.line.port
        timing = timing_of(port)
        yield f"{port.baud} baud, {timing.character * 1000:.3g} ms a character"
    yield f"timeout {parameters.timeout:g} s, {counted(parameters.retries, 'retry')}"
    cases = [worst_case(upstream, one.route, one.gap) for one in routes if one.route.upstream == upstream.name]
    if cases:
        yield f"{max(case.seconds for case in cases):.3g} s at most"
    if upstream.options.connections > 1:
        yield counted(upstream.options.connections, "connection")
    if not upstream.options.share_reads:
        yield "reads are not shared"
    for group in upstream.same_device:
        yield f"units {units_text(group)} are the same device"


def _own_unit(plan: GatewayPlan) -> str:
    if plan.own_unit is None:
        return "the gateway itself is no device"
    hiding = [
        route
        for route in plan.table.routes
        if plan.own_unit in route.units and not route.functions and route.addresses is None
    ]
    if hiding:
        return f"not reached: {hiding[0].title} takes it"
    return f"the gateway itself, also by unit {BROADCAST_UNIT}"


def _target(route: Route) -> str:
    if route.action is RouteAction.REFUSE:
        return f"refused: {route.code:02X} {exception_meaning(route.code).partition(':')[0]}"
    return "dropped" if route.action is RouteAction.DROP else route.upstream


def _details(route: Route, gap: float) -> Iterator[str]:
    if route.unit is not None:
        yield f"as unit {route.unit}"
    if route.unit_offset:
        first, last = min(route.units), max(route.units)
        yield (
            f"as units {route.upstream_unit(first)}…{route.upstream_unit(last)}"
            if first != last
            else (f"as unit {route.upstream_unit(first)}")
        )
    if route.shift:
        yield f"addresses {route.shift:+d}"
    if route.max_registers is not None:
        yield f"at most {counted(route.max_registers, 'register')} at once"
    if route.max_bits is not None:
        yield f"at most {counted(route.max_bits, 'bit')} at once"
    if route.split_writes:
        yield "writes are split too"
    if route.timeout is not None:
        yield f"timeout {route.timeout:g} s"
    if gap:
        yield f"left alone for {gap:g} s"
    if route.cache is not None:
        yield f"remembered for {route.cache:g} s"


__all__ = ["ROUTING_HEADINGS", "gateway_rows", "routing_rows"]
