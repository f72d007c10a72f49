"""The schema of gateway files: listeners, links to upstreams, and routes between them.

Knows the keys; `busway.apps.gateway.configuration` checks what goes together.
The sections that concern servers ([server], [security], [policy], [audit], [metrics], [control]) have the same keys as
in other configuration files.

An example is in `docs/gateway.md`.

Rules:

1. The first route that fits a request decides. A route without ``units`` is for all units its link can have.
2. A route has exactly one of ``link``, ``refuse`` and ``drop``.
3. A file without routes sends everything to its one link.
"""

from collections.abc import Container, Iterator, Sequence
from typing import Annotated, Any, ClassVar, Final

from pydantic import BeforeValidator, model_validator

from ...access.notation import parse_items, parse_table, parse_units, parse_whole_functions
from ...codes import Table
from ...errors import ConfigError
from ...options.gateway import GatewayListenerParameters, GatewayParameters, RouteParameters, UpstreamParameters
from .device import UnitSection
from .key_lines import KeyPath
from .listeners import ListenerSection, clashes
from .options import OptionSection, with_options_of
from .section import NO_LIST, FileProblems
from .system import LinkSection, SystemFile, twice

NOT_OF_GATEWAYS: Final = {
    "deadline": "client_deadline of a listener says when its clients have given up",
    "max_connections": "connections says how many there are",
}
"""By name, the options of links that have no effect in a gateway, each with the reason for the error message."""


def is_gateway(sections: Container[str]) -> bool:
    """Return True if a file with these top-level keys is a gateway file.

    It is one with ``route`` or ``gateway``, or with ``listen`` or ``listener`` and without ``unit``.
    """
    listens = "listen" in sections or "listener" in sections
    return "route" in sections or "gateway" in sections or (listens and "unit" not in sections)


@with_options_of(GatewayListenerParameters)
class GatewayListenerSection(ListenerSection):
    """``[[listener]]``: where clients reach the gateway."""

    on_lines: ClassVar[frozenset[str]] = frozenset({"url", "name", "client_deadline"})

    name: Annotated[str, "the name of the listener in routes; left out: its URL."] = ""

    @property
    def title(self) -> str:
        """Name of the listener in routes; its URL if the file gives it no name."""
        return self.name or self.url


@with_options_of(UpstreamParameters)
class UpstreamSection(LinkSection):
    """``[[link]]`` of a gateway: a serial line or a server that requests are forwarded to."""

    same_device: Annotated[
        list[list[int]], "units that are one device: a write to one of them makes remembered reads of all old."
    ] = NO_LIST


@with_options_of(RouteParameters)
class RouteSection(OptionSection):
    """``[[route]]``: which requests the route applies to, and where they are forwarded."""

    @property
    def parameters(self) -> RouteParameters:
        """All options of the route; those that the file leaves out have their defaults."""
        return self.built(RouteParameters)

    @model_validator(mode="after")
    def _check(self) -> "RouteSection":
        faults = list(self._faults())
        if faults:
            raise FileProblems(faults)
        return self

    def _faults(self) -> Iterator[tuple[KeyPath, str]]:
        wanted = self.parameters
        ways = [name for name in ("link", "refuse", "drop") if getattr(wanted, name) not in (None, False)]
        if len(ways) != 1:
            yield (), f"needs exactly one of link, refuse and drop, and has {' and '.join(ways) or 'none of them'}"
        if wanted.link is None:
            only_forwarded = {"unit", "unit_offset", "shift", "max_registers", "max_bits", "split_writes", "cache"}
            for name in sorted((only_forwarded | {"timeout", "request_gap"}) & self.model_fields_set):
                yield (name,), "has no effect where nothing is forwarded"
        for key in ("units", "functions", "table", "addresses"):
            try:
                getattr(self, f"asked_{key}")()
            except ConfigError as error:
                yield (key,), error.message

    def asked_units(self) -> frozenset[int] | None:
        """Return the unit numbers that the route applies to; None for all. Raises `ConfigError` if they are wrong."""
        units = self.parameters.units
        return None if units is None else parse_units(units.written)

    def asked_functions(self) -> frozenset[int]:
        """Return the function codes that the route applies to; empty for all.

        Raises:
            ConfigError: a code or name is wrong, or names a sub-function; or the list is empty.
        """
        functions = self.parameters.functions
        if functions is None:
            return frozenset()
        found = parse_whole_functions(functions.written, "a route")
        if not found:
            raise ConfigError("is empty, so the route would take no request; leave it out for all functions")
        return found

    def asked_table(self) -> Table | None:
        """Return the table of the key ``table``, in which plain numbers in ``addresses`` lie; None without the key.

        Raises:
            ConfigError: there is no such table.
        """
        table = self.parameters.table
        return None if table is None else parse_table(table)

    def asked_addresses(self) -> tuple[Table, int, int] | None:
        """Return the addresses that the route applies to: table, first offset, offset after the last; None for all.

        Offsets are 0-based.

        Raises:
            ConfigError: the notation is wrong, names more than one range, or is missing beside a ``table``.
        """
        addresses = self.parameters.addresses
        if addresses is None:
            if self.parameters.table is not None:
                raise ConfigError("is missing: a table is named, and no addresses of it")
            return None
        found = parse_items(addresses.written, self.asked_table())
        if len(found) != 1 or len(next(iter(found.values()))) != 1:
            raise ConfigError("a route has one range of addresses; write another route for another range")
        ((table, ((first, end),)),) = found.items()
        return table, first, end


@with_options_of(GatewayParameters)
class GatewaySection(OptionSection):
    """``[gateway]``: options of the whole gateway."""

    def parameters(self) -> GatewayParameters:
        """Return all options of the whole gateway; those that the file leaves out have their defaults."""
        return self.built(GatewayParameters)


def _no_units(value: object) -> object:
    if value:
        raise ValueError("a gateway has no units of its own; serve them, and route to the server")
    return value


class GatewayFile(SystemFile):
    """The checked contents of a gateway file."""

    listener: Annotated[Sequence[GatewayListenerSection], "where clients reach the gateway."] = NO_LIST
    link: Annotated[Sequence[UpstreamSection], "serial lines and servers that requests are forwarded to."] = NO_LIST
    route: Annotated[list[RouteSection], "which requests go where; none: all go to the one link."] = NO_LIST
    gateway: Annotated[GatewaySection, "options of the whole gateway."] = GatewaySection()
    unit: Annotated[list[UnitSection], BeforeValidator(_no_units), "none: a gateway has no units of its own."] = NO_LIST

    @model_validator(mode="before")
    @classmethod
    def _names_in_rules(cls, value: Any) -> Any:  # the value in the file, of any type
        """Replace the names of listeners in the rules of the policy by their URLs.

        Other texts stay, for the rule to check.
        """
        if not isinstance(value, dict) or not isinstance(value.get("policy"), dict):
            return value
        listeners = [one for one in _list(value.get("listener")) if isinstance(one, dict)]
        urls = {one["name"]: one["url"] for one in listeners if isinstance(one.get("name"), str) and "url" in one}
        policy = value["policy"]
        rules = [_with_urls(rule, urls) for rule in _list(policy.get("rule"))]
        return {**value, "policy": {**policy, "rule": rules}} if rules else value

    def _whole_faults(self) -> Iterator[tuple[KeyPath, str]]:
        yield from clashes(self.places())
        if not self.link:
            yield ("link",), "is missing"
        if not self.places():
            yield ("listener",), "is missing"
        for name in ("unit_policy", "unlisted"):
            if name in self.server.model_fields_set:
                yield ("server", name), "has no effect: a gateway has no units of its own"
        if "shared_slots" in self.server.model_fields_set:
            yield ("server", "shared_slots"), "has no effect: each listener of a gateway has slots of its own"
        sections: list[tuple[KeyPath, OptionSection]] = [(("server",), self.server)]
        sections += [(("listener", index), listener) for index, listener in enumerate(self.listener)]
        for at, section in sections:
            if "answer_half_closed" in section.model_fields_set:
                yield (*at, "answer_half_closed"), "has no effect: a client that ends its half has left the gateway"
        if not self.route and len(self.link) > 1:
            yield ("route",), f"is missing: there are {len(self.link)} links"
        for index, link in enumerate(self.link):
            for name, instead in NOT_OF_GATEWAYS.items():
                if name in link.model_fields_set:
                    yield ("link", index, name), f"has no effect on a link of a gateway: {instead}"
        yield from twice("link", [each.name for each in self.link])
        yield from twice("listener", [each.title for each in self.listener])
        names = [each.name for each in self.link]
        titles = [*self.listen, *(each.title for each in self.listener)]
        for index, section in enumerate(self.route):
            route = section.parameters
            if route.link is not None and route.link not in names:
                yield ("route", index, "link"), f"there is no link {route.link!r}, but {', '.join(names)}"
            for place, wanted in enumerate(route.listeners or ()):
                if wanted not in titles:
                    yield (
                        ("route", index, "listeners", place),
                        f"there is no listener {wanted!r}, but {', '.join(titles)}",
                    )


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _with_urls(rule: Any, urls: dict[str, Any]) -> Any:  # the value in the file, of any type
    listeners = rule.get("listeners") if isinstance(rule, dict) else None
    if not isinstance(listeners, list):
        return rule
    return {**rule, "listeners": [urls.get(one, one) if isinstance(one, str) else one for one in listeners]}
