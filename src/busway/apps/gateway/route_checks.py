"""Checks the routes of a gateway file before the gateway runs.

Knows the sections, and what upstreams and listeners can do; opens nothing (Messaging on TCP/IP V1.0b §4.4.2,
T32).

1. Errors: a route that is never reached, a unit that an upstream or a listener cannot have, a client deadline shorter
   than the upstream may take, an upstream that leads back to a listener.
2. Warnings, for example: units that an earlier route takes, an upstream without a route, a route that evades a rule of
   the policy.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ...access.rules import Policy
from ...client.sessions import timing_of
from ...codes import LAST_SERIAL_UNIT
from ...config.files.gateway import GatewayFile
from ...config.files.key_lines import KeyPath
from ...config.report import ConfigurationReport
from ...options.endpoints import EVERY_ADDRESS, Endpoint
from ...pdu.functions import STANDARD
from ...server.bound_sockets import is_loopback
from ...values.counts import counted
from .file_routes import PlacedListener, PlacedRoute, upstream_units
from .gateway_plan import UpstreamSettings
from .policy_gaps import policy_gaps
from .routes import SERIAL_UNITS, AddressRange, Route, RouteAction, taken_before, units_text

_SAME = {"localhost": "127.0.0.1"}
_REQUEST_CHARACTERS = {"rtu": (8, 256), "ascii": (17, 513)}
"""By framing: number of characters of a read request, and of the longest request (Serial Line V1.02 §2.5)."""
_MOST_REGISTERS = 125
_MOST_BITS = 2000


@dataclass(frozen=True, slots=True)
class WorstCase:
    """The longest time that an upstream may need for one request, until the last attempt has failed.

    It begins when the request is sent; or, with the option ``connect_delay``, when the link has connected for it.

    Attributes:
        seconds: the time in seconds.
        sum: how the time adds up from attempts, timeouts, frames, pieces and the delay, as text for messages.
    """

    seconds: float
    sum: str


# What cannot work.


def check_routes(
    file: GatewayFile,
    routes: Sequence[PlacedRoute],
    listeners: Sequence[PlacedListener],
    upstreams: Mapping[str, UpstreamSettings],
    policy: Policy | None,
    report: ConfigurationReport,
) -> None:
    """Find errors and warnings in the routes of a gateway file, and add them to a report; raises nothing.

    Args:
        file: the sections of the file.
        routes: the routes, with their paths in the file.
        listeners: the listeners, with their paths in the file.
        upstreams: the upstreams by name.
        policy: the access rules; None without any.
        report: gets the errors and warnings.
    """
    for at, sentence in (
        *_unreached(routes),
        *_hidden_refusals(routes),
        *_impossible_units(routes, listeners, upstreams),
        *_impossible_addresses(routes),
        *_gaps_on_networks(routes, upstreams),
        *_impatient_clients(routes, listeners, upstreams),
        *_listeners_without_units(file, routes, listeners),
        *_loops(file, listeners, upstreams),
    ):
        report.refuse(at, sentence)
    for at, sentence in (
        *_overlaps(routes),
        *_idle_upstreams(file, routes, upstreams),
        *_hidden_own_unit(file, routes),
        *_idle_listeners(routes, listeners),
        *_upstreams_slower_than_the_default(routes, listeners, upstreams),
        *(
            ()
            if policy is None
            else policy_gaps(policy, routes, {name: each.same_device for name, each in upstreams.items()})
        ),
        *_same_servers(file, upstreams),
    ):
        report.warn(at, sentence)


PlacedWarnings = Iterator[tuple[KeyPath, str]]


def _unreached(routes: Sequence[PlacedRoute]) -> PlacedWarnings:
    plain = [one.route for one in routes]
    for position, placed in enumerate(routes):
        takers, left = taken_before(plain, position)
        if not left:
            named = " and ".join(_titled(routes, one) for one in takers)
            yield (
                placed.place,
                f"is never reached: {named} before it {'takes' if len(takers) == 1 else 'take'} all its requests",
            )


def _overlaps(routes: Sequence[PlacedRoute]) -> PlacedWarnings:
    plain = [one.route for one in routes]
    for position, placed in enumerate(routes):
        route = placed.route
        is_rest = not placed.names_units
        if is_rest and (route.action is RouteAction.FORWARD or not (route.functions or route.addresses)):
            continue  # it is meant for what other routes leave
        takers, left = taken_before(plain, position)
        if left and takers and route.action is not RouteAction.REFUSE:
            taken = units_text(placed.route.units - left)
            named = " and ".join(_titled(routes, one) for one in takers)
            yield placed.key("units"), f"{named} before it {'takes' if len(takers) == 1 else 'take'} units {taken}"


def _hidden_refusals(routes: Sequence[PlacedRoute]) -> PlacedWarnings:
    """Yield an error for each refusing route if an earlier route forwards or drops a part of the requests to refuse.

    A refusing route without units, functions and addresses gets no error: it refuses what other routes do not take.
    """
    for position, placed in enumerate(routes):
        refusal = placed.route
        if refusal.action is not RouteAction.REFUSE:
            continue
        for earlier in routes[:position]:
            if earlier.route.covers(refusal):
                break  # it is never reached, which is reported elsewhere
            part = "" if earlier.route.action is RouteAction.REFUSE else _hidden_part(placed, earlier.route)
            if part:
                yield (
                    placed.place,
                    f"{earlier.title} before it takes {part}, which it is to refuse; a refusal stands before "
                    "what it is an exception of",
                )
                break


def _hidden_part(placed: PlacedRoute, earlier: Route) -> str:
    """Return in words which requests of a refusing route an earlier route takes: units, functions or addresses.

    Empty if it takes none, or only a part that functions and addresses together describe; and empty for a refusing
    route that names no units, functions and addresses.

    Args:
        placed: the refusing route.
        earlier: a route before it that forwards or drops.
    """
    refusal = placed.route
    wider = replace(refusal, units=refusal.units & earlier.units or refusal.units)
    is_for_all = not refusal.listeners and bool(earlier.listeners)
    if is_for_all or (earlier.listeners and not refusal.listeners <= earlier.listeners):
        wider = replace(wider, listeners=(refusal.listeners & earlier.listeners) or earlier.listeners)
        if refusal.listeners and not refusal.listeners & earlier.listeners:
            return ""
    if not wider.units <= earlier.units:
        return ""
    says_units = placed.names_units
    if earlier.covers(wider):
        is_rest = not (says_units or refusal.functions or refusal.addresses)
        return "" if is_rest else f"units {units_text(wider.units)}"
    codes = refusal.functions & earlier.functions
    if codes and earlier.covers(replace(wider, functions=codes)):
        return f"functions {', '.join(map(str, sorted(codes)))}"
    if refusal.addresses is None or earlier.addresses is None or refusal.addresses.table is not earlier.addresses.table:
        return ""
    first = max(refusal.addresses.first, earlier.addresses.first)
    end = min(refusal.addresses.end, earlier.addresses.end)
    if first < end and earlier.covers(replace(wider, addresses=AddressRange(refusal.addresses.table, first, end))):
        return str(AddressRange(refusal.addresses.table, first, end))
    return ""


def _titled(routes: Sequence[PlacedRoute], route: Route) -> str:
    return next(one.title for one in routes if one.route is route)


def _impossible_units(
    routes: Sequence[PlacedRoute], listeners: Sequence[PlacedListener], upstreams: Mapping[str, UpstreamSettings]
) -> PlacedWarnings:
    for placed in routes:
        route = placed.route
        if route.upstream and upstream_units(upstreams[route.upstream]) is SERIAL_UNITS:
            wrong = sorted(unit for unit in route.units if route.upstream_unit(unit) not in SERIAL_UNITS)
            if wrong:
                yield placed.key("unit", "unit_offset", "units"), _no_upstream_unit(route, wrong[0])
        if not placed.names_units:
            continue
        at = [one for one in listeners if not route.listeners or one.name in route.listeners]
        serial = [one for one in at if one.is_serial]
        wrong = sorted(route.units - SERIAL_UNITS)
        if wrong and serial and (route.listeners or len(serial) == len(at)):
            yield (
                placed.key("units"),
                f"clients of {serial[0].name} cannot ask unit {wrong[0]}: a serial line has units 1…{LAST_SERIAL_UNIT}",
            )


def _no_upstream_unit(route: Route, unit: int) -> str:
    there = route.upstream_unit(unit)
    if there == 0:
        return (
            f"unit {unit} would be 0 on {route.upstream!r}, where no unit answers; "
            "a broadcast goes to all lines by itself"
        )
    return f"unit {unit} would be {there} on {route.upstream!r}, a serial line, which has units 1…{LAST_SERIAL_UNIT}"


def _impossible_addresses(routes: Sequence[PlacedRoute]) -> PlacedWarnings:
    for placed in routes:
        route = placed.route
        if route.addresses is None:
            continue
        first, last = route.addresses.first + route.shift, route.addresses.end - 1 + route.shift
        if route.shift and not (first >= 0 and last <= 0xFFFF):
            yield placed.key("shift"), f"{route.addresses} would become {first}…{last}, which do not exist"
        if route.functions and not any(_touches(code, route.addresses) for code in route.functions):
            yield placed.key("functions"), f"none of them reads or writes {route.addresses.table.label}s"


def _gaps_on_networks(routes: Sequence[PlacedRoute], upstreams: Mapping[str, UpstreamSettings]) -> PlacedWarnings:
    for placed in routes:
        if placed.gap and placed.route.upstream and upstreams[placed.route.upstream].link.line is None:
            yield placed.key("request_gap"), "is an option of the link where that is no serial line"


def _touches(code: int, addresses: AddressRange) -> bool:
    kinds = [one for one in STANDARD if one.code == code]
    touched = {touch.table for kind in kinds for touch in (kind.reads, kind.writes) if touch is not None}
    return not kinds or addresses.table in touched


def _impatient_clients(
    routes: Sequence[PlacedRoute], listeners: Sequence[PlacedListener], upstreams: Mapping[str, UpstreamSettings]
) -> PlacedWarnings:
    for listener in listeners:
        if listener.deadline is None or not listener.is_chosen:
            continue
        cases = [
            (worst_case(upstreams[one.route.upstream], one.route, one.gap), one.route.upstream)
            for one in routes
            if one.route.upstream and (not one.route.listeners or listener.name in one.route.listeners)
        ]
        if not cases:
            continue
        case, upstream = max(cases, key=lambda each: each[0].seconds)
        if listener.deadline < case.seconds:
            yield (
                (*listener.place[:2], "client_deadline"),
                f"{listener.deadline:g} s is less than link {upstream!r} may take: {case.seconds:.3g} s = {case.sum}",
            )


def _upstreams_slower_than_the_default(
    routes: Sequence[PlacedRoute], listeners: Sequence[PlacedListener], upstreams: Mapping[str, UpstreamSettings]
) -> PlacedWarnings:
    """Yield warnings about upstreams slower than the default ``client_deadline`` of their listeners."""
    deadline = next((one.deadline for one in listeners if one.deadline is not None and not one.is_chosen), None)
    if deadline is None:
        return
    told: set[str] = set()
    for one in routes:
        route = one.route
        is_asked = any(
            not listener.is_chosen and (not route.listeners or listener.name in route.listeners)
            for listener in listeners
        )
        if not route.upstream or route.upstream in told or not is_asked:
            continue
        case = worst_case(upstreams[route.upstream], replace(route, max_registers=None, max_bits=None), one.gap)
        if case.seconds > deadline:
            told.add(route.upstream)
            yield (
                one.key("timeout"),
                f"link {route.upstream!r} may take {case.seconds:.3g} s = {case.sum}, and clients are answered 0B "
                f"after {deadline:g} s; set client_deadline of the listener (beside URLs: --client-deadline) to what "
                "its clients wait, or a shorter timeout",
            )


def worst_case(upstream: UpstreamSettings, route: Route, gap: float = 0.0) -> WorstCase:
    """Return the longest time that an upstream may need for a request of a route.

    Args:
        upstream: the upstream of the route.
        route: the route, whose limits may split the request.
        gap: seconds of silence that the route wants before a request; counts only with RTU and ASCII framing.
    """
    parameters = upstream.link.parameters
    timeout = route.timeout or parameters.timeout
    reading = writing = parameters.request_gap
    if upstream.link.line is not None:
        timing = timing_of(upstream.link.line.port)
        serial = upstream.link.line.conversation
        pause = max(parameters.request_gap, serial.unit_switch_gap, serial.quiet_window, timing.t3_5)
        short, long = _REQUEST_CHARACTERS[upstream.link.endpoint.framing]
        pause = max(pause, gap)
        reading, writing = pause + timing.duration(short), pause + timing.duration(long)
    pieces = max(_pieces(_MOST_REGISTERS, route.max_registers), _pieces(_MOST_BITS, route.max_bits))
    read = _attempts(parameters.retries, timeout, reading, pieces)
    write = _attempts(parameters.write_retries, timeout, writing, pieces if route.split_writes else 1)
    longest = max(read, write, key=lambda each: each.seconds)
    delay = parameters.connect_delay
    return WorstCase(longest.seconds + delay, f"{longest.sum} + {delay:g} s connect_delay") if delay else longest


def _pieces(most: int, limit: int | None) -> int:
    return 1 if limit is None else -(-most // limit)


def _attempts(retries: int, timeout: float, beside: float, pieces: int) -> WorstCase:
    text = f"(1 + {counted(retries, 'retry')}) × ({timeout:g} s timeout"
    text += f" + {beside:.3g} s for frames and silence)" if beside else ")"
    text += f" × {pieces} pieces" if pieces > 1 else ""
    return WorstCase((1 + retries) * (timeout + beside) * pieces, text)


def _listeners_without_units(
    file: GatewayFile, routes: Sequence[PlacedRoute], listeners: Sequence[PlacedListener]
) -> PlacedWarnings:
    own = file.gateway.parameters().own_unit
    for listener in listeners:
        units = {unit for one in _of_listener(routes, listener) for unit in one.route.units}
        units |= set() if own is None else {own}
        if listener.is_serial and not units & SERIAL_UNITS:
            yield (
                listener.place,
                f"no route has a unit that can be asked here: a serial line has units 1…{LAST_SERIAL_UNIT}",
            )


def _idle_listeners(routes: Sequence[PlacedRoute], listeners: Sequence[PlacedListener]) -> PlacedWarnings:
    for listener in listeners:
        if not listener.is_serial and not any(one.route.upstream for one in _of_listener(routes, listener)):
            yield listener.place, "no route leads from here to a link"


def _of_listener(routes: Sequence[PlacedRoute], listener: PlacedListener) -> list[PlacedRoute]:
    return [one for one in routes if not one.route.listeners or listener.name in one.route.listeners]


def _loops(
    file: GatewayFile, listeners: Sequence[PlacedListener], upstreams: Mapping[str, UpstreamSettings]
) -> PlacedWarnings:
    """Yield errors for upstreams that lead back to a listener of the gateway, and for serial ports used twice."""
    owners: dict[str, str] = {}
    for listener in listeners:
        if listener.endpoint.carrier == "serial":
            owners[os.path.realpath(listener.endpoint.path)] = f"listener {listener.name}"
    for index, section in enumerate(file.link):
        upstream = upstreams.get(section.name)
        if upstream is None:
            continue
        endpoint = upstream.link.endpoint
        place: KeyPath = ("link", index, "url")
        if endpoint.carrier == "serial":
            port = os.path.realpath(endpoint.path)
            if port in owners:
                yield place, f"{endpoint.path} is taken by {owners[port]}"
            owners.setdefault(port, f"link {section.name!r}")
            continue
        own = next((listener for listener in listeners if _is_same(listener.endpoint, endpoint)), None)
        if own is not None:
            yield place, f"leads back to the gateway itself, to listener {own.name}"


def _is_same(listener: Endpoint, upstream: Endpoint) -> bool:
    if listener.carrier == "serial" or listener.port != upstream.port or not listener.port:
        return False
    if (listener.carrier == "udp") != (upstream.carrier == "udp"):
        return False
    listener_host, upstream_host = (_SAME.get(host, host) for host in (listener.host, upstream.host))
    return listener_host == upstream_host or (
        listener_host in EVERY_ADDRESS and is_loopback(f"tcp://{_bracketed(upstream_host)}")
    )


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _idle_upstreams(
    file: GatewayFile, routes: Sequence[PlacedRoute], upstreams: Mapping[str, UpstreamSettings]
) -> PlacedWarnings:
    used = {one.route.upstream for one in routes}
    for index, section in enumerate(file.link):
        if section.name in upstreams and section.name not in used:
            yield ("link", index, "name"), f"no route leads to {section.name!r}"


def _same_servers(file: GatewayFile, upstreams: Mapping[str, UpstreamSettings]) -> PlacedWarnings:
    seen: dict[tuple[str, str, int | None], str] = {}
    for index, section in enumerate(file.link):
        upstream = upstreams.get(section.name)
        if upstream is None or upstream.link.endpoint.carrier == "serial":
            continue
        endpoint = upstream.link.endpoint
        server = ("udp" if endpoint.carrier == "udp" else "tcp", endpoint.host, endpoint.port)
        if server in seen:
            yield (
                ("link", index, "url"),
                f"{endpoint.url} is the server of link {seen[server]!r} too: each has connections of its own",
            )
        seen.setdefault(server, section.name)


def _hidden_own_unit(file: GatewayFile, routes: Sequence[PlacedRoute]) -> PlacedWarnings:
    own = file.gateway.parameters().own_unit
    if own is None:
        return
    is_written = "own_unit" in file.gateway.model_fields_set
    for placed in routes:
        route = placed.route
        is_all = not route.functions and route.addresses is None
        if own in route.units and is_all and (is_written or placed.names_units):
            yield placed.key("units"), f"takes unit {own}, which could be the gateway's own"
            return
