"""Routes: which upstream and which unit a request is forwarded to.

Knows requests by unit, function and address range, and upstreams by name only.

1. The first route that fits decides.
2. A route with an address range takes requests wholly within it. A request across the edge of the range is refused with
   02 and goes to no later route: no single device could answer it.
3. The addresses of an unknown function cannot be read: routes with a range never take it.
4. A route that can never be reached is an error.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import Enum

from ...codes import LAST_SERIAL_UNIT, TABLE_SIZE, ExceptionCode, Table
from ...errors import ConfigError
from ...options.declaration import declared
from ...options.gateway import RouteParameters
from ...pdu.message import Request, Span
from ...pdu.unknown_functions import OpaqueRequest
from .address_index import AddressIndex

_FEW = 3
"""Up to this number of routes, trying them one after the other is as quick as an index of addresses."""
ALL_UNITS = frozenset(range(256))
SERIAL_UNITS = frozenset(range(1, LAST_SERIAL_UNIT + 1))


class RouteAction(Enum):
    """What a route does with a request: forward it, refuse it with an exception code, or drop it without a reply."""

    FORWARD = "forward"
    REFUSE = "refuse"
    DROP = "drop"


@dataclass(frozen=True, slots=True)
class AddressRange:
    """A range of a table that a route serves: items ``first`` … ``end - 1``, counted from 0.

    Raises:
        ConfigError: the range is empty, or not within 0…65535.
    """

    table: Table
    first: int
    end: int

    def __post_init__(self) -> None:
        if not 0 <= self.first < self.end <= TABLE_SIZE:
            raise ConfigError(f"addresses are 0…{TABLE_SIZE - 1}, first before last", key="addresses")

    def __str__(self) -> str:
        return f"{self.table.label} {self.first}…{self.end - 1}"


@dataclass(frozen=True, slots=True)
class Route:
    """One route of a gateway: which requests it applies to, and where they are forwarded.

    Attributes:
        upstream: name of the upstream; empty for a route that does not forward.
        listeners: names of the listeners whose requests the route takes; empty for all.
        units: unit identifiers that clients use, 0…255.
        functions: function codes; empty for all.
        addresses: the range in which requests must lie; None for all addresses.
        unit: unit identifier on the upstream, for all requests; None for the client's unit plus ``unit_offset``.
        unit_offset: number that is added to the client's unit; 0 if ``unit`` is set.
        shift: number that is added to every address, and subtracted in replies.
        max_registers, max_bits: most items in one request to the device; longer reads are split. None for no limit.
        split_writes: whether longer writes are split too; their parts are executed one after the other.
        action: whether requests are forwarded, refused with ``code``, or dropped.
        code: exception code of a refusal, 1…255.
        cache: seconds for which a read may be answered with remembered values; None for never.
        timeout: seconds to wait for the device, per attempt; None for the timeout of the upstream.
        name: name of the route in messages; empty for none.

    Raises:
        ConfigError: a value is out of its range, both ``unit`` and ``unit_offset`` are set, or ``upstream`` does not
            fit ``action``: a route that forwards must name an upstream, and no other route may.
    """

    upstream: str = ""
    listeners: frozenset[str] = frozenset()
    units: frozenset[int] = ALL_UNITS
    functions: frozenset[int] = frozenset()
    addresses: AddressRange | None = None
    unit: int | None = None
    unit_offset: int = 0
    shift: int = 0
    max_registers: int | None = None
    max_bits: int | None = None
    split_writes: bool = False
    action: RouteAction = RouteAction.FORWARD
    code: int = ExceptionCode.ILLEGAL_FUNCTION
    cache: float | None = None
    timeout: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        options = declared(RouteParameters)
        for key in ("max_registers", "max_bits", "unit", "cache", "timeout"):
            options[key].check(getattr(self, key))
        if not 1 <= self.code <= 255:
            raise ConfigError(f"must be 1…255, not {self.code}", key="code")
        if not self.units:
            raise ConfigError("a route needs at least one unit", key="units")
        for unit in self.units:
            if not 0 <= unit <= 255:
                raise ConfigError(f"a unit is 0…255, not {unit}", key="units")
            if not 0 <= self.upstream_unit(unit) <= 255:
                raise ConfigError(f"unit {unit} would become {self.upstream_unit(unit)}", key="unit_offset")
        if self.unit is not None and self.unit_offset:
            raise ConfigError("either a unit or an offset, not both", key="unit_offset")
        if (self.action is RouteAction.FORWARD) != bool(self.upstream):
            raise ConfigError("a route names an upstream, or refuses, or drops", key="upstream")

    def upstream_unit(self, unit: int) -> int:
        """Return the unit number on the upstream for a unit number that a client uses."""
        return unit + self.unit_offset if self.unit is None else self.unit

    @property
    def names_no_units(self) -> bool:
        """Whether the route takes all units (at least 1…247), and leaves the unit number of each request as it is."""
        return self.unit is None and not self.unit_offset and self.units >= SERIAL_UNITS

    def covers(self, other: "Route") -> bool:
        """Whether this route takes every request that ``other`` would take, so that ``other`` after it gets none.

        Compares units, listeners, functions and addresses each by itself: False does not prove that ``other`` gets a
        request.
        """
        return other.units <= self.units and self.covers_beside_units(other)

    def covers_beside_units(self, other: "Route") -> bool:
        """Whether this route takes every request that ``other`` would take, regarding only units that both have."""
        return (
            (not self.listeners or (bool(other.listeners) and other.listeners <= self.listeners))
            and (not self.functions or (bool(other.functions) and other.functions <= self.functions))
            and (
                self.addresses is None
                or (
                    other.addresses is not None
                    and other.addresses.table is self.addresses.table
                    and self.addresses.first <= other.addresses.first
                    and other.addresses.end <= self.addresses.end
                )
            )
        )

    @property
    def title(self) -> str:
        """The route's name for messages; if it has none, a text like ``units 1-5 to boiler`` or ``units 7 to drop``."""
        return self.name or f"units {units_text(self.units)} to {self.upstream or self.action.value}"


@dataclass(frozen=True, slots=True)
class Straddles:
    """Result of the search for a route: the request's addresses are only partly in the range of a route.

    Such a request is refused with exception 02.

    Attributes:
        route: the first route that has some of the addresses.
    """

    route: Route


class ListenerRoutes:
    """The routes for the requests of one listener, arranged by unit so that a request's route is found fast.

    Args:
        routes: the routes of the listener, in their order.
    """

    __slots__ = ("_by_unit", "_indexed")

    def __init__(self, routes: Sequence[Route]) -> None:
        self._by_unit: dict[int, tuple[Route, ...]] = {}
        # The routes of a unit that take a function, with an index of their addresses in a table; made at first use.
        self._indexed: dict[tuple[int, int, Table], tuple[list[Route], AddressIndex]] = {}
        for unit in range(256):
            found: list[Route] = []
            for route in routes:
                if unit in route.units:
                    found.append(route)
                    if not route.functions and route.addresses is None:
                        break  # it takes everything: later routes are never reached
            if found:
                self._by_unit[unit] = tuple(found)

    def find(self, unit: int, request: Request) -> Route | Straddles | None:
        """Return the first route that takes a request; None if no route does.

        Returns a `Straddles` instead if the first route for the request's function and any of its addresses has an
        address range that does not hold all of them.

        Args:
            unit: unit identifier that the client uses.
            request: the request.
        """
        routes = self._by_unit.get(unit, ())
        if len(routes) > _FEW and (touch := _touched_at_once(request)) is not None:
            return self._found_by_address(routes, request, touch)
        return self._looked_through(routes, request)

    def _found_by_address(self, routes: tuple[Route, ...], request: Request, touch: Span) -> Route | Straddles | None:
        """Search the routes of a unit with an index of addresses, which is fast for many routes; returns as `find`.

        ``touch`` is the one address range that the request touches.
        """
        key = id(routes), request.code, touch.table
        indexed = self._indexed.get(key)
        if indexed is None:
            indexed = self._indexed[key] = _indexed(routes, request.code, touch.table)
        taking, index = indexed
        end = touch.address + touch.count
        position = index.first_touched(touch.address, end)
        route = None if position is None else taking[position]
        taken = None if route is None else route.addresses
        if route is None or taken is None or (taken.first <= touch.address and end <= taken.end):
            return route
        return Straddles(route)

    def _looked_through(self, routes: tuple[Route, ...], request: Request) -> Route | Straddles | None:
        """Search the routes of a unit by testing one after the other; returns as `find`."""
        for route in routes:
            if route.functions and function_of(request) not in route.functions:
                continue
            if route.addresses is None:
                return route
            within = _within(route.addresses, request)
            if within:
                return route
            if within is None:
                return Straddles(route)
        return None

    def units_to(self, upstream: str) -> list[int]:
        """Return the units among 1…247, as clients number them, that have a route to the upstream with this name."""
        return [
            unit
            for unit in range(1, LAST_SERIAL_UNIT + 1)
            if any(route.upstream == upstream for route in self._by_unit.get(unit, ()))
        ]

    @property
    def units(self) -> frozenset[int]:
        """The units, as clients number them, that have a route of any kind."""
        return frozenset(self._by_unit)

    @property
    def upstreams(self) -> tuple[str, ...]:
        """The names of the upstreams that the routes forward to, each once: first those of the lowest unit's routes."""
        return tuple(
            dict.fromkeys(route.upstream for routes in self._by_unit.values() for route in routes if route.upstream)
        )


def _indexed(routes: Sequence[Route], function: int, table: Table) -> tuple[list[Route], AddressIndex]:
    """Return the routes that may take requests of a function to a table, and an index of their address ranges."""
    taking = [
        one
        for one in routes
        if (not one.functions or function in one.functions) and (one.addresses is None or one.addresses.table is table)
    ]
    ranges = [None if one.addresses is None else (one.addresses.first, one.addresses.end) for one in taking]
    return taking, AddressIndex(ranges)


def _touched_at_once(request: Request) -> Span | None:
    """Return the one address range that a request touches; None if there are none or several, or it is unknown."""
    if isinstance(request, OpaqueRequest):
        return None
    spans = request.spans()
    return spans[0] if len(spans) == 1 and spans[0].count > 0 else None


def _within(wanted: AddressRange, request: Request) -> bool | None:
    """Return whether a request lies in an address range: True for wholly, False for not at all, None for partly.

    False also for a request with an unknown function, whose addresses cannot be read.
    """
    if isinstance(request, OpaqueRequest):
        return False
    spans = request.spans()
    inside = touched = 0
    for span in spans:
        if span.table is not wanted.table:
            continue
        end = span.address + span.count
        inside += wanted.first <= span.address and end <= wanted.end
        touched += span.address < wanted.end and wanted.first < end
    if not touched:
        return False
    return True if inside == len(spans) else None


@dataclass(frozen=True)
class RoutingTable:
    """All routes of a gateway, in order; the first that fits gets a request.

    Attributes:
        routes: the routes in their order.

    Raises:
        ConfigError: a route is never reached.
    """

    routes: tuple[Route, ...]
    _of_listener: dict[str, ListenerRoutes] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for position, sentence in self.faults():
            raise ConfigError(sentence, key=f"route[{position}]")

    def faults(self) -> Iterator[tuple[int, str]]:
        """Yield position and message for each route that no request can reach, because earlier routes take them all."""
        for position in range(len(self.routes)):
            takers, left = taken_before(self.routes, position)
            if not left:
                named = " and ".join(repr(one.title) for one in takers)
                yield (
                    position,
                    f"never reached: {named} before it {'takes' if len(takers) == 1 else 'take'} all its requests",
                )

    def of_listener(self, listener: str) -> ListenerRoutes:
        """Return the routes for the requests of one listener."""
        found = self._of_listener.get(listener)
        if found is None:
            found = ListenerRoutes([one for one in self.routes if not one.listeners or listener in one.listeners])
            self._of_listener[listener] = found
        return found


def taken_before(routes: Sequence[Route], position: int) -> tuple[list[Route], frozenset[int]]:
    """Return the earlier routes that take all requests of a route for some of its units, and the units left to it.

    If one earlier route takes all requests of the route for all its units, only that one is returned. No unit is left
    to a route that is never reached.

    Args:
        routes: all routes in their order.
        position: position of the route.
    """
    route = routes[position]
    whole = next((one for one in routes[:position] if one.covers(route)), None)
    if whole is not None:
        return [whole], frozenset()
    left, takers = route.units, []
    for earlier in routes[:position]:
        if left & earlier.units and earlier.covers_beside_units(route):
            left -= earlier.units
            takers.append(earlier)
    return takers, left


def function_of(request: Request) -> int:
    """Return the function code of a request, also of one with an unknown function."""
    return request.function if isinstance(request, OpaqueRequest) else request.code


def units_text(units: frozenset[int]) -> str:
    """Return unit numbers as text: ``1-5, 7``."""
    parts: list[str] = []
    ordered = sorted(units)
    start = 0
    for at in range(1, len(ordered) + 1):
        if at == len(ordered) or ordered[at] != ordered[at - 1] + 1:
            first, last = ordered[start], ordered[at - 1]
            parts.append(str(first) if first == last else f"{first}-{last}")
            start = at
    return ", ".join(parts)
