"""The routes and listeners of a gateway file, each with its path in the file, so that errors can name the key.

Knows sections and routes; checks nothing. A route without units is for all units that its upstream can have.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from ...codes import ExceptionCode
from ...config.files.gateway import GatewayFile, RouteSection
from ...config.files.lines import Path as Place
from ...config.report import ConfigurationReport
from ...errors import ConfigError
from ...options.endpoints import Endpoint
from ...options.gateway import RouteParameters
from .routes import ALL_UNITS, SERIAL_UNITS, AddressRange, Route, RouteAction
from .settings import UpstreamSettings

SAME = "name", "unit", "unit_offset", "shift", "max_registers", "max_bits", "split_writes", "cache", "timeout"
"""Options of a route in a file that a route in memory has as they are."""


@dataclass(frozen=True, slots=True)
class PlacedRoute:
    """A route with its path in the gateway file, for messages about the file.

    Attributes:
        route: the route.
        place: path of its section in the file.
        section: its section; None for the default route of a file without routes.
    """

    route: Route
    place: Place
    section: RouteSection | None

    @property
    def title(self) -> str:
        """The name of the route in messages about the file."""
        return f"{self.place[0]}[{self.place[1]}]" + (f" ({self.route.name})" if self.route.name else "")

    @property
    def names_units(self) -> bool:
        """Whether the file says which units the route is for."""
        return self.section is not None and self.section.parameters.units is not None

    @property
    def gap(self) -> float:
        """Seconds of silence that the route wants between a unit's reply and the next request."""
        return (self.section.parameters.request_gap or 0.0) if self.section is not None else 0.0

    def key(self, *names: str) -> Place:
        """Return the path in the file of the first of some keys that the route sets.

        The route's own path if it sets none.
        """
        written = set() if self.section is None else self.section.model_fields_set
        return next(((*self.place, name) for name in names if name in written), self.place)


@dataclass(frozen=True, slots=True)
class PlacedListener:
    """A listener with the path of its URL in the gateway file, for messages about the file.

    Attributes:
        name: name of the listener in routes.
        endpoint: its URL.
        place: path of the URL or section in the file.
        deadline: seconds until each request is answered; None for no limit.
        is_chosen: whether the deadline was set, and is not the default.
    """

    name: str
    endpoint: Endpoint
    place: Place
    deadline: float | None
    is_chosen: bool = False

    @property
    def is_serial(self) -> bool:
        """Whether the framing is RTU or ASCII, on a line or a network: clients use units 1…247 only."""
        return self.endpoint.framing != "mbap"


def placed_routes(
    file: GatewayFile, upstreams: Mapping[str, UpstreamSettings], report: ConfigurationReport
) -> list[PlacedRoute]:
    """Return the routes of a gateway file with their paths in it; invalid ones are left out.

    A file without routes has one route to each upstream, for all its units.

    Args:
        file: the sections of the file.
        upstreams: the valid upstreams by name.
        report: gets the errors of invalid routes.
    """
    if not file.route:
        return [
            PlacedRoute(Route(upstream=name, units=upstream_units(upstream)), ("link", 0), None)
            for name, upstream in upstreams.items()
        ]
    found = []
    for index, section in enumerate(file.route):
        at: Place = ("route", index)
        link = section.parameters.link
        if link is not None and link not in upstreams:
            continue  # reported with the section of the upstream
        made = report.make(partial(_route, section, upstreams), partial(_key_of, section, at))
        if made is not None:
            found.append(PlacedRoute(made, at, section))
    return found


def _key_of(section: RouteSection, at: Place, key: str | None) -> Place:
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
    """Return the units of a route that names none, as clients number them: all that its upstream can have.

    Raises:
        ConfigError: with its offset the route has no unit left.
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
    """Return for each unit of an upstream the longest silence after a reply, in seconds, that any route needs."""
    found: dict[int, float] = {}
    for placed in routes:
        if placed.gap and placed.route.upstream == upstream:
            for unit in placed.route.units:
                there = placed.route.upstream_unit(unit)
                found[there] = max(placed.gap, found.get(there, 0.0))
    return found
