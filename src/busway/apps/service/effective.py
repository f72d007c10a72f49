"""Shows the configuration in force as TOML: a file that means the same, with the defaults of all options.

Knows the classes of parameters and TOML; changes nothing.

1. Options of the server, listeners, links, audit log, metrics and control socket are shown with their defaults. Policy
   and units are shown as they stand in the file: a key that is left out there has no value to show.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from datetime import date, time
from enum import Enum
from typing import Any

from ...client.settings import options_of
from ...config.certificates import tls_of
from ...config.links import NamedLink
from ...config.toml_text import toml_key, toml_string
from ...options.accepted_options import SERVERS, AcceptedOptions, options_for
from ...options.declaration import NONE, declared
from ...options.endpoints import parse_endpoint
from ...options.server import ListenerParameters
from ...options.tls import TlsParameters
from ...server.listener import Listener
from .configuration import Configuration


def effective(configuration: Configuration, data: Mapping[str, Any]) -> Iterator[str]:  # Any: what TOML has
    """Yield a configuration as lines of TOML, with all options, defaults included.

    Args:
        configuration: the configuration.
        data: the parsed contents of its file.
    """
    yield "[server]"
    given = {name: value for name, value in configuration.served().items() if name != "tls"}
    chosen = AcceptedOptions.of(*SERVERS).chosen(given)
    for kind in SERVERS:
        without = frozenset(declared(kind)) - frozenset(options_for("server", kind))
        yield from values(chosen.build(kind), without=without)
    for listener in configuration.listeners:
        yield from ["", "[[listener]]", *_listener(listener)]
    for link in configuration.links.values():
        yield from ["", "[[link]]", *_link(link)]
    file = configuration.file
    if file.client.supported_connections is not None:
        yield from ["", "[client]", line("supported_connections", file.client.supported_connections)]
    if file.audit_parameters is not None:
        yield from ["", "[audit]", *values(file.audit_parameters)]
    if file.metrics_address is not None:
        yield from ["", "[metrics]", line("listen", file.metrics_address)]
    yield from ["", "[control]", *values(file.control_parameters)]
    if file.policy is not None:
        policy = data["policy"]
        yield from _table("policy", {"default": policy} if isinstance(policy, str) else policy)
    for unit in data.get("unit", ()):
        yield from _table("unit", unit, brackets=2)


def _table(name: str, table: Mapping[str, Any], brackets: int = 1) -> Iterator[str]:  # Any: what TOML has
    """Yield a table of a file as lines of TOML, its arrays of tables behind its other keys.

    Args:
        name: the table's name, with those of the tables around it: ``unit.point``.
        table: its contents.
        brackets: 1 for a table, 2 for an element of an array of tables.
    """
    inner = {key: value for key, value in table.items() if _is_array_of_tables(value)}
    yield ""
    yield "[" * brackets + name + "]" * brackets
    for key, value in table.items():
        if key not in inner:
            yield line(key, value)
    for key, several in inner.items():
        for each in several:
            yield from _table(f"{name}.{toml_key(key)}", each, brackets=2)


def _is_array_of_tables(value: object) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(each, Mapping) for each in value)


def _listener(listener: Listener) -> Iterator[str]:
    endpoint = parse_endpoint(listener.endpoint)
    others = {name: text for name, text in endpoint.options.items() if name not in declared(TlsParameters)}
    yield line("url", str(replace(endpoint, options=others)))
    access = listener.access
    for name in ("allow", "deny", "secure"):
        if access is not None:
            yield line(name, getattr(access, name))
    if listener.limits is not None:
        limits = declared(ListenerParameters)
        place = ("server", endpoint.framing, endpoint.carrier)
        idle = {name for name, option in limits.items() if not option.has_effect(*place)}
        yield from values(listener.limits, without=frozenset({"shared_slots", *idle}))
    tls = tls_of(listener)
    if tls is not None:
        yield from values(tls, without=frozenset({"server_name", "verify"}))


def _link(link: NamedLink) -> Iterator[str]:
    yield line("name", link.name)
    yield line("url", link.settings.endpoint.url)
    settings, offered = link.settings, options_of(link.settings.endpoint)
    parts: list[Any] = [settings.parameters, settings.sockets, settings.management, settings.security]
    if settings.line is not None:
        found = settings.line
        parts += [found.port, found.conversation, found.breaker, found.framing, found.opening]
    for part in parts:
        if part is not None:
            yield from values(part, without=frozenset(declared(type(part))) - offered)


def values(
    parameters: Any, *, without: frozenset[str] = frozenset()
) -> Iterator[str]:  # Any: classes of no common base
    """Yield a TOML line ``name = value`` for each field of an object with parameters, except those in ``without``."""
    for field in fields(parameters):
        if field.name not in without:
            yield line(field.name, getattr(parameters, field.name))


def line(name: str, value: object) -> str:
    """Return a key and its value as a TOML line, without a line end; None becomes the text ``"none"``."""
    return f"{toml_key(name)} = {_written(value)}"


def _written(value: object) -> str:
    if value is None:
        return f'"{NONE}"'
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Enum):
        return _written(value.value)
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        return toml_string(value)
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(line(str(key), one) for key, one in value.items()) + " }"
    if isinstance(value, Iterable):
        return "[" + ", ".join(_written(one) for one in value) + "]"
    return _written(str(value))
