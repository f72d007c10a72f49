"""Writes the tables of options and keys of files in the documentation from their declarations. ``--check``: compares.

Knows declared options, the sections of files, and which part of which page shows them.
"""

from collections.abc import Mapping
from typing import Any

from marked import ROOT, replaced, update

from busway.config.files import behaviours, collector, device, fault_sections, points, policy, simulation, sinks, system
from busway.config.files.listeners import ListenerSection
from busway.config.files.options import OptionSection
from busway.config.files.section import Section, keys_of
from busway.options import sinks as sink_options
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

Kind = type[Any]  # a parameter class or a section, which share no base

PAGES: Mapping[str, Mapping[str, tuple[Kind, ...]]] = {
    "reference/defaults.md": {
        "client": (ClientParameters,),
        "management": (ManagementParameters,),
        "units": (UnitParameters,),
        "server": (ServerParameters,),
        "listener": (ListenerParameters,),
        "sockets": (SocketParameters,),
        "line": (SerialClientParameters,),
        "breaker": (BreakerParameters,),
        "framing": (FramingParameters,),
        "port": (SerialSettings,),
        "opening": (OpeningParameters,),
        "tls": (TlsParameters,),
        "gateway": (GatewayParameters,),
        "upstreams": (UpstreamParameters,),
        "gateway_listeners": (GatewayListenerParameters,),
        "routes": (RouteParameters,),
        "audit": (AuditParameters,),
        "metrics": (MetricsParameters,),
        "control": (ControlParameters,),
    },
    "reference/configuration.md": {
        "file": (system.SystemFile,),
        "listener": (ListenerSection,),
        "policy": (policy.PolicySection,),
        "link": (system.LinkSection,),
        "client": (system.ClientSection,),
    },
    "reference/device-file.md": {
        "file": (device.DeviceFile,),
        "server": (device.ServerSection, UnitParameters, ServerParameters),
        "unit": (device.UnitSection,),
        "file_records": (device.FileSection,),
        "fifo": (device.FifoSection,),
        "table": (device.TableSection,),
        "point": (points.PointSection,),
        "linear": (points.LinearSection,),
        "group": (device.GroupSection,),
        "read": (device.ReadSection,),
        "write": (points.WriteSection,),
        "report": (points.ReportSection,),
        "alarm": (points.AlarmSection,),
    },
    "reference/collector-file.md": {
        "collector": (collector.CollectorSection,),
        "page_access": (collector.PageAccessSection,),
        "poll_class": (collector.PollClassSection,),
        "link": (collector.CollectedLinkSection,),
        "device": (collector.CollectedDeviceSection,),
    },
    "how-to/send-samples-on.md": {
        "every": (sinks.SentSection, sink_options.DeliveryOptions),
        "password": (sink_options.PasswordOptions, sink_options.TokenOptions, sink_options.CertificateOptions),
        "mqtt": (sink_options.MqttOptions,),
        "sparkplug": (sink_options.SparkplugOptions,),
        "postgresql": (sink_options.PostgresqlOptions,),
        "influxdb": (sink_options.InfluxOptions,),
        "nats": (sink_options.NatsOptions,),
        "file": (sink_options.FileOptions,),
        "prometheus": (sinks.PrometheusSinkSection,),
    },
    "how-to/write-through-the-collector.md": {
        "commands": (sinks.MqttCommandsSection, sinks.NatsCommandsSection),
    },
    "security.md": {
        "rule": (policy.RuleSection,),
        "values": (policy.ValuesSection,),
    },
    "simulator.md": {
        "simulation": (simulation.SimulationSection,),
        "include": (simulation.IncludeSection,),
        "profile": (simulation.ParameterKeys,),
        "fault": (fault_sections.FaultSection,),
        "schedule": (fault_sections.ScheduleSection,),
        "behaviour": (behaviours.BehaviourSection,),
    },
}
"""The pages, their parts, and the classes whose options each part shows."""
STRICT = {
    "links": (ClientParameters,),
    "servers": (UnitParameters, ServerParameters, ListenerParameters),
    "sockets of both": (SocketParameters,),
    "`tls://` listeners": (TlsParameters,),
    "lines": (FramingParameters, SerialSettings),
}


def render(*kinds: Kind) -> str:
    """The table of one parameter class or section, or of several; what stands in several is there once."""
    options: dict[str, Option] = {name: one for kind in kinds for name, one in own_options(kind).items()}
    return "\n".join(
        ["| option | default | values | meaning |", "| --- | --- | --- | --- |", *map(row, options.values())]
    )


def row(option: Option) -> str:
    """The row of one option."""
    values = option.values.replace("|", "\\|")
    return f"| `{option.name}` | {option.default_text} | {values} | {option.help} |"


def render_behaviours() -> str:
    """The keys of each kind of behaviour."""
    lines = ["| kind | key | default | values | meaning |", "| --- | --- | --- | --- | --- |"]
    for name, kind in behaviours.KINDS.items():
        own = [key for key in keys_of(kind) if key != "kind" and key not in keys_of(behaviours.BehaviourSection)]
        lines += [f"| {f'`{name}`' if key is own[0] else ''} {row(keys_of(kind)[key])}" for key in own]
    return "\n".join(lines)


def own_options(kind: Kind) -> dict[str, Option]:
    """The options that a class declares; of a section only its own keys, not those of components or of all kinds."""
    if not issubclass(kind, Section):
        return dict(declared(kind))
    others: set[str] = set()
    if issubclass(kind, OptionSection):
        others |= {name for each in kind.kinds for name in declared(each)}
    return {name: option for name, option in keys_of(kind).items() if name not in others}


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
    for path, parts in PAGES.items():
        file = ROOT / "docs" / path
        texts = {part: render(*kinds) for part, kinds in parts.items()}
        texts |= {"strict": render_strict()} if path.endswith("defaults.md") else {}
        texts |= {"behaviours": render_behaviours()} if path == "simulator.md" else {}
        page = file.read_text(encoding="utf-8")
        for part, text in texts.items():
            page = replaced(page, part, text)
        update(file, page)
