"""The routes and listeners of a gateway file, each with its path in the file, so that errors can name the key.

Knows sections and routes; does not check whether routes fit together. A route without units is for all units that its
upstream can have.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from ...codes import ExceptionCode
from ...config.files.gateway import GatewayFile, RouteSection
from ...config.files.key_lines import KeyPath
from ...config.report import ConfigurationReport
from ...errors import ConfigError
from ...options.endpoints import Endpoint
from ...options.gateway import RouteParameters
from .gateway_plan import UpstreamSettings
from .routes import ALL_UNITS, SERIAL_UNITS, AddressRange, Route, RouteAction

SAME = "name", "unit", "unit_offset", "shift", "max_registers", "max_bits", "split_writes", "cache", "timeout"
"""Names of the route options that a `Route` gets from the file unchanged."""


@dataclass(frozen=True, slots=True)
class PlacedRoute:
    """A route with its path in the gateway file, for messages about the file.

    Attributes:
        route: the route.
        place: path of its section in the file.
        section: its section; None for the default route of a file without routes.
    """

    route: Route
    place: KeyPath
    section: RouteSection | None

    @property
    def title(self) -> str:
        """The route in messages about the file: ``route[0]``, then its name in brackets if it has one.

        For the default route of a file without routes it is ``link[0]``.
        """
        return f"{self.place[0]}[{self.place[1]}]" + (f" ({self.route.name})" if self.route.name else "")

    @property
    def names_units(self) -> bool:
        """Whether the route has units in the file; False if it is for all units of its upstream by default."""
        return self.section is not None and self.section.parameters.units is not None

    @property
    def gap(self) -> float:
        """Seconds of silence that the route wants between a unit's reply and the next request to it; 0 for none."""
        return (self.section.parameters.request_gap or 0.0) if self.section is not None else 0.0

    def key(self, *names: str) -> KeyPath:
        """Return the path in the file of the first of these keys that the route's section has.

        Returns the path of the section if it has none of them.
        """
        written = set() if self.section is None else self.section.model_fields_set
        return next(((*self.place, name) for name in names if name in written), self.place)


@dataclass(frozen=True, slots=True)
class PlacedListener:
    """A listener with the path of its URL in the gateway file, for messages about the file.

    Attributes:
        name: name of the listener in routes.
        endpoint: the URL of the listener, parsed.
        place: path of the URL or section in the file.
        deadline: seconds until each request is answered; None for no limit.
        is_chosen: whether the user has set the deadline; False if it is the default.
    """

    name: str
    endpoint: Endpoint
    place: KeyPath
    deadline: float | None
    is_chosen: bool = False

    @property
    def is_serial(self) -> bool:
        """Whether the framing is RTU or ASCII, on a line or over a network, so that clients use units 1…247 only."""
        return self.endpoint.framing != "mbap"


def placed_routes(
    file: GatewayFile, upstreams: Mapping[str, UpstreamSettings], report: ConfigurationReport
) -> list[PlacedRoute]:
    """Return the routes of a gateway file with their paths in it; invalid routes are reported and left out.

    For a file without routes, returns one route to each upstream, for all units of the upstream. A route to an upstream
    that is missing or invalid is left out without a report, because the check of the upstreams reports that.

    Args:
        file: the sections of the file.
        upstreams: the valid upstreams by name.
        report: gets the errors of invalid routes.
    """
    if not file.route:
        return [
            PlacedRoute(Route(upstream=link.name, units=upstream_units(upstreams[link.name])), ("link", index), None)
            for index, link in enumerate(file.link)
            if link.name in upstreams
        ]
    found = []
    for index, section in enumerate(file.route):
        at: KeyPath = ("route", index)
        link = section.parameters.link
        if link is not None and link not in upstreams:
            continue  # reported with the section of the upstream
        made = report.make(partial(_route, section, upstreams), partial(_key_of, section, at))
        if made is not None:
            found.append(PlacedRoute(made, at, section))
    return found


def _key_of(section: RouteSection, at: KeyPath, key: str | None) -> KeyPath:
    return (*at, key) if key is not None and key in section.model_fields_set else at


def _route(section: RouteSection, upstreams: Mapping[str, UpstreamSettings]) -> Route:
    wanted = section.parameters
    upstream = None if wanted.link is None else upstreams[wanted.link]
    asked = section.asked_units()
    addresses = section.asked_addresses()
    action = RouteAction.FORWARD if upstream is not None else RouteAction.DROP if wanted.drop else RouteAction.REFUSE
    return Route(
        upstream=wanted.link or "",
        listeners=frozenset(wanted.listeners or ()),
        units=_default_units(wanted, upstream) if asked is None else asked,
        functions=section.asked_functions(),
        addresses=None if addresses is None else AddressRange(*addresses),
        action=action,
        code=wanted.refuse or ExceptionCode.ILLEGAL_FUNCTION,
        **{name: getattr(wanted, name) for name in SAME},
    )


def _default_units(wanted: RouteParameters, upstream: UpstreamSettings | None) -> frozenset[int]:
    """Return the units of a route that names none, as clients number them: all for which its upstream can have a unit.

    A route without an upstream (``upstream`` None) gets all units 0…255. A route with ``unit``, which sends every
    request to that one unit, gets the numbers that its upstream can have.

    Raises:
        ConfigError: the offset of the route leaves no unit.
    """
    if upstream is None:
        return ALL_UNITS
    there = upstream_units(upstream)
    if wanted.unit is not None:
        return there
    units = frozenset(unit for unit in ALL_UNITS if unit + wanted.unit_offset in there)
    if not units:
        raise ConfigError(f"leaves no unit that {wanted.link!r} has", key="unit_offset")
    return units


def upstream_units(upstream: UpstreamSettings) -> frozenset[int]:
    """Return the unit numbers that an upstream can have: 0…255 with MBAP framing, 1…247 with RTU and ASCII."""
    return ALL_UNITS if upstream.link.endpoint.framing == "mbap" else SERIAL_UNITS


def unit_gaps(routes: Sequence[PlacedRoute], upstream: str) -> dict[int, float]:
    """Return for each unit on an upstream the longest silence after a reply, in seconds, that any route wants.

    Units for which no route wants a silence are left out.

    Args:
        routes: all routes.
        upstream: name of the upstream.
    """
    found: dict[int, float] = {}
    for placed in routes:
        if placed.gap and placed.route.upstream == upstream:
            for unit in placed.route.units:
                there = placed.route.upstream_unit(unit)
                found[there] = max(placed.gap, found.get(there, 0.0))
    return found
