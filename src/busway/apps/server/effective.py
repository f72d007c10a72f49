"""Shows the configuration in force, defaults included, as TOML.

Knows the classes of parameters and TOML; changes nothing.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from enum import Enum
from typing import Any

from ...client.settings import options_of
from ...config.links import NamedLink
from ...options.declaration import NONE, declared
from ...options.endpoints import parse_endpoint
from ...options.offer import SERVERS, Offer, options_for
from ...options.server import ListenerParameters
from ...server.listener import Listener
from .configuration import Configuration


def effective(configuration: Configuration) -> Iterator[str]:
    """Yield server, listeners and links of a configuration as lines of TOML, with all options, defaults included."""
    yield "[server]"
    given = {name: value for name, value in configuration.served().items() if name != "tls"}
    chosen = Offer.of(*SERVERS).chosen(given)
    for kind in SERVERS:
        without = frozenset(declared(kind)) - frozenset(options_for("server", kind))
        yield from values(chosen.build(kind), without=without)
    for listener in configuration.listeners:
        yield from ["", "[[listener]]", *_listener(listener)]
    for link in configuration.links.values():
        yield from ["", "[[link]]", *_link(link)]


def _listener(listener: Listener) -> Iterator[str]:
    yield line("url", str(listener.endpoint))
    access = listener.access
    for name in ("allow", "deny", "secure"):
        if access is not None:
            yield line(name, getattr(access, name))
    if listener.limits is not None:
        endpoint, limits = parse_endpoint(listener.endpoint), declared(ListenerParameters)
        place = ("server", endpoint.framing, endpoint.carrier)
        idle = {name for name, option in limits.items() if not option.has_effect(*place)}
        yield from values(listener.limits, without=frozenset({"shared_slots", *idle}))
    if listener.tls is not None:
        yield from values(listener.tls, without=frozenset({"server_name", "verify"}))


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
    return f"{name} = {_written(value)}"


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
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, Mapping):
        return "{ " + ", ".join(line(str(key), one) for key, one in value.items()) + " }"
    if isinstance(value, Iterable):
        return "[" + ", ".join(_written(one) for one in value) + "]"
    return _written(str(value))
