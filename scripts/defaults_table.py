"""Writes the tables of docs/reference/defaults.md from the declarations of options. With ``--check``: only compares.

Knows declared options.
"""

from typing import Any

from marked import ROOT, replaced, update

from busway.options.client import ClientParameters, ManagementParameters
from busway.options.declaration import Option, declared
from busway.options.gateway import GatewayListenerParameters, GatewayParameters, RouteParameters, UpstreamParameters
from busway.options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from busway.options.ports import OpeningParameters, SerialSettings
from busway.options.presets import strict_settings
from busway.options.server import ListenerParameters, ServerParameters, UnitParameters
from busway.options.service import AuditParameters, ControlParameters, MetricsParameters
from busway.options.sockets import SocketParameters
from busway.options.tls import TlsParameters

TABLES = {
    "client": ClientParameters,
    "management": ManagementParameters,
    "units": UnitParameters,
    "server": ServerParameters,
    "listener": ListenerParameters,
    "sockets": SocketParameters,
    "line": SerialClientParameters,
    "breaker": BreakerParameters,
    "framing": FramingParameters,
    "port": SerialSettings,
    "opening": OpeningParameters,
    "tls": TlsParameters,
    "gateway": GatewayParameters,
    "upstreams": UpstreamParameters,
    "gateway_listeners": GatewayListenerParameters,
    "routes": RouteParameters,
    "audit": AuditParameters,
    "metrics": MetricsParameters,
    "control": ControlParameters,
}
"""The parts of the page and the class that each shows."""
STRICT = {
    "links": (ClientParameters,),
    "servers": (UnitParameters, ServerParameters, ListenerParameters),
    "sockets of both": (SocketParameters,),
    "`tls://` listeners": (TlsParameters,),
    "lines": (FramingParameters, SerialSettings),
}


def render(kind: type[Any]) -> str:
    """The table of one parameter class."""
    lines = ["| option | default | values | meaning |", "| --- | --- | --- | --- |"]
    for option in declared(kind).values():
        values = option.values.replace("|", "\\|")
        lines.append(f"| `{option.name}` | {option.default_text} | {values} | {option.help} |")
    return "\n".join(lines)


def render_strict() -> str:
    """What the preset ``strict`` sets."""
    lines = ["| for | options |", "| --- | --- |"]
    for title, kinds in STRICT.items():
        options = [f"{text}{'*' * one.adaptable}" for text, one in _settings(kinds)]
        lines.append(f"| {title} | {', '.join(options)} |")
    lines[-1] = lines[-1][:-2] + "; ASCII `data_bits=7`; `stop_bits` only as the parity asks |"
    return "\n".join(lines)


def _settings(kinds: tuple[type[Any], ...]) -> list[tuple[str, Any]]:
    options: dict[str, Option] = {name: one for kind in kinds for name, one in declared(kind).items()}
    return [(f"`{name}={_text(one.value)}`", one) for name, one in strict_settings(options).items()]


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    file = ROOT / "docs" / "reference" / "defaults.md"
    page = file.read_text(encoding="utf-8")
    for part, parameters in TABLES.items():
        page = replaced(page, part, render(parameters))
    update(file, replaced(page, "strict", render_strict()))
