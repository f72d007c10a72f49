"""``busway config``: explains a configuration file or its errors, and lists the options.

1. ``check`` opens what the file names (certificates, the audit log's folder), and no connection.
2. What was understood goes to stdout; what is odd, or wrong, to stderr, each with file, line and key.
"""

import sys
from collections.abc import Callable

import typer

from ..errors import ConfigError
from .exits import ExitCode
from .output import json_text, print_aligned

EXAMPLES = """\b
Examples:
  busway config check plant.toml
  busway config show plant.toml
  busway config schema > busway.schema.json
  busway config schema --simulation
  busway config options
  busway config options rtu:///dev/ttyUSB0
"""


def config(
    action: str = typer.Argument(..., metavar="ACTION", help="check, show, schema or options."),
    file: str | None = typer.Argument(
        None, metavar="[FILE]", help="The configuration file, for check and show; for options, the URL of a link."
    ),
    device: bool = typer.Option(False, "--device", help="schema: of device files alone."),
    simulation: bool = typer.Option(False, "--simulation", help="schema: of simulation files."),
    gateway: bool = typer.Option(False, "--gateway", help="schema: of gateway files."),
) -> int:
    """Check and explain configuration files; list the options of links and servers."""
    actions: dict[str, Callable[[str], None]] = {"check": _check, "show": _show}
    kinds = {"--device": device, "--simulation": simulation, "--gateway": gateway}
    if action == "schema":
        if file is not None:
            raise ConfigError("schema takes no file", key=file)
        _print_schema([name for name, is_given in kinds.items() if is_given])
    elif action in actions or action == "options":
        for name, is_given in kinds.items():
            if is_given:
                raise ConfigError("is for schema", key=name)
        if action == "options":
            _print_options(file)
            return ExitCode.DONE
        if file is None:
            raise ConfigError(f"{action} needs a file", key="FILE")
        actions[action](file)
    else:
        raise ConfigError(f"must be check, show, schema or options, not {action!r}", key="ACTION")
    return ExitCode.DONE


def _check(file: str) -> None:
    from ..apps.server.configuration import load_configuration
    from ..apps.server.overview import overview

    configuration = load_configuration(file, preflight=True)
    print_aligned(list(overview(configuration)))
    for warning in configuration.warnings:
        print(warning, file=sys.stderr)


def _show(file: str) -> None:
    from ..apps.server.configuration import load_configuration
    from ..apps.server.effective import effective

    for line in effective(load_configuration(file)):
        print(line)


def _print_options(url: str | None) -> None:
    """Print name, default, values and meaning of each option: of a link to a URL, or of all that files configure."""
    from ..options import gateway, service
    from ..options.endpoints import parse_endpoint
    from ..options.offer import LINKS, SERVERS, Offer

    if url is None:
        offers = {
            "of links:": Offer.of(*LINKS, role="client"),
            "of servers:": Offer.of(*SERVERS, role="server"),
            "[audit]": Offer.of(service.AuditParameters),
            "[metrics]": Offer.of(service.MetricsParameters),
            "[control]": Offer.of(service.ControlParameters),
            "[gateway]": Offer.of(gateway.GatewayParameters),
            "[[listener]] of a gateway:": Offer.of(gateway.GatewayListenerParameters),
            "[[link]] of a gateway:": Offer.of(gateway.UpstreamParameters),
            "[[route]] of a gateway:": Offer.of(gateway.RouteParameters),
        }
    else:
        endpoint = parse_endpoint(url)
        offers = {f"of a link to {endpoint.url}:": Offer.at(endpoint, "client", LINKS)}
    for title, offer in offers.items():
        print(title)
        rows = [[one.name, one.default_text, one.values, one.help] for one in offer.options.values()]
        print_aligned([["  " + name, *(cell.replace("`", "") for cell in cells)] for name, *cells in rows])


def _print_schema(kinds: list[str]) -> None:
    from ..config.files import device, gateway, simulation, system
    from ..config.files.schema import Section, json_schema

    schemas: dict[str, type[Section]] = {
        "--device": device.DeviceFile,
        "--simulation": simulation.SimulationFile,
        "--gateway": gateway.GatewayFile,
    }
    if len(kinds) > 1:
        raise ConfigError(f"goes without {kinds[0]}", key=kinds[1])
    schema = schemas[kinds[0]] if kinds else system.SystemFile
    if kinds == ["--simulation"]:
        document = simulation.simulation_schema("busway simulation file")
        print(json_text(document, indent=2))
        return
    title = f"busway {kinds[0].removeprefix('--')} file" if kinds else "busway configuration"
    print(json_text(json_schema(schema, title), indent=2))
