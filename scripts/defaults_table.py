"""Writes the tables of docs/reference/defaults.md from the parameter classes. With ``--check``: only compares.

Knows dataclasses and how their docstrings list attributes. Ranges are asked of the classes themselves: a value far
outside is refused with a sentence that names the range.
"""

import inspect
import re
from collections.abc import Mapping
from dataclasses import MISSING, fields
from enum import Enum
from typing import Any, get_args, get_type_hints

from marked import ROOT, replaced, update

from busway.client.management import ManagementParameters
from busway.errors import ConfigError
from busway.server.parameters import ListenerParameters
from busway.session.breaker import OPEN_AFTER_BY_FRAMING, BreakerParameters
from busway.session.line_framing import FramingParameters
from busway.session.parameters import TIMEOUT_BY_FRAMING, ClientParameters, ServerParameters
from busway.session.serial_client import SerialClientParameters
from busway.transport.serial.opening import OpeningParameters
from busway.transport.serial.settings import SerialSettings
from busway.transport.tcp import SocketParameters

TABLES = {
    "client": ClientParameters,
    "management": ManagementParameters,
    "server": ServerParameters,
    "listener": ListenerParameters,
    "sockets": SocketParameters,
    "line": SerialClientParameters,
    "breaker": BreakerParameters,
    "framing": FramingParameters,
    "port": SerialSettings,
    "opening": OpeningParameters,
}
"""The parts of the page and the class that each shows."""
BY_FRAMING: Mapping[tuple[type[Any], str], Mapping[str, float]] = {
    (ClientParameters, "timeout"): TIMEOUT_BY_FRAMING,
    (BreakerParameters, "open_after"): OPEN_AFTER_BY_FRAMING,
}
"""Options whose default depends on the framing of the endpoint."""


def render(kind: type[Any]) -> str:
    """The table of one parameter class."""
    meanings = attribute_meanings(kind)
    hints = get_type_hints(kind)
    lines = ["| option | default | values | meaning |", "| --- | --- | --- | --- |"]
    for field in fields(kind):
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if default is MISSING:
            raise SystemExit(f"{kind.__name__}.{field.name} has no default")
        meaning = meanings[field.name]
        by_framing = BY_FRAMING.get((kind, field.name))
        text = shown(default) if by_framing is None else shown_by_framing(by_framing)
        lines.append(f"| `{field.name}` | {text} | {values(kind, field.name, hints[field.name])} | {meaning} |")
    return "\n".join(lines)


def shown(default: object) -> str:
    """A default as a person writes it."""
    if default is None or (hasattr(default, "parse") and not default):
        return "none"
    if isinstance(default, bool):
        return "on" if default else "off"
    if isinstance(default, Enum):
        return f"`{default.value}`"
    return f"{default:g}" if isinstance(default, float) else str(default)


def shown_by_framing(defaults: Mapping[str, float]) -> str:
    """The defaults, each with the framings that have it."""
    names: dict[float, list[str]] = {}
    for framing, default in defaults.items():
        names.setdefault(default, []).append({"mbap": "TCP, TLS, UDP"}.get(framing, framing.upper()))
    return "; ".join(f"{shown(default)} ({', '.join(framings)})" for default, framings in names.items())


def values(kind: type[Any], name: str, hint: Any) -> str:
    """What the option can be."""
    kinds = [one for one in (get_args(hint) or (hint,)) if one is not type(None)]
    optional = len(get_args(hint)) > len(kinds)
    only = kinds[0]
    if only is bool:
        text = "on, off"
    elif issubclass(only, Enum):
        text = ", ".join(f"`{one.value}`" for one in only)
    elif hasattr(only, "parse"):
        text = "a list"
    elif only in (int, float):
        text = numbers(kind, name)
    else:
        text = "a text"
    return f"{text}, or none" if optional else text


def numbers(kind: type[Any], name: str) -> str:
    """The range of a number, in the words of the refusal of -1."""
    try:
        kind(**{name: -1})
    except ConfigError as error:
        match = re.fullmatch(r"must be (.+?)(?:, not -1)?", error.message)
        if match:
            return match[1]
        raise SystemExit(f"{kind.__name__}.{name}: the refusal does not say its range: {error}") from error
    raise SystemExit(f"{kind.__name__}.{name} takes -1")


def attribute_meanings(kind: type[Any]) -> dict[str, str]:
    """The text of each attribute in the section ``Attributes`` of a docstring; names may share one."""
    text = inspect.getdoc(kind) or ""
    section = text.split("Attributes:\n", 1)[1]
    found: dict[str, str] = {}
    names: list[str] = []
    for line in section.splitlines():
        start = re.match(r" {4}(\w[\w, ]*): (.+)", line)
        if start:
            names = start[1].split(", ")
            found |= dict.fromkeys(names, start[2])
        elif line.strip():
            found |= {name: f"{found[name]} {line.strip()}" for name in names}
        elif names:
            break
    for shared in {meaning for meaning in found.values() if ", and " in meaning}:
        names = [name for name, meaning in found.items() if meaning == shared]
        parts = re.split(r", (?:and )?", shared)
        if len(names) == len(parts) > 1:  # one sentence with a part for each name
            found |= dict(zip(names, (f"{part.rstrip('.')}." for part in parts), strict=True))
    return {name: meaning.replace("``", "`") for name, meaning in found.items()}


if __name__ == "__main__":
    file = ROOT / "docs" / "reference" / "defaults.md"
    page = file.read_text(encoding="utf-8")
    for part, parameters in TABLES.items():
        page = replaced(page, part, render(parameters))
    update(file, page)
