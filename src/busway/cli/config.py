"""``busway config``: explains a configuration file or its errors, and lists the options.

1. ``check`` opens what the file names (certificates, the audit log's folder), and no connection. It recognises files of
   collectors, gateways and simulations by their keys, and checks them as what they are.
2. What the file configures goes to stdout; warnings and errors go to stderr, each with file, line and key.
"""

import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import typer

from ..errors import ConfigError
from .exits import ExitCode
from .output import json_text, print_aligned

if TYPE_CHECKING:
    from ..config.files.section import Section
    from ..options.declaration import Option

EXAMPLES = """\b
Examples:
  busway config check plant.toml
  busway config show plant.toml
  busway config schema > busway.schema.json
  busway config schema --collector
  busway config options
  busway config options rtu:///dev/ttyUSB0
"""


_SHOWN_BY = {
    "collector": "busway collect plan {}",
    "gateway": "busway gateway check {}",
    "simulation": "busway simulate {} --check",
}


def config(
    action: str = typer.Argument(..., metavar="ACTION", help="check, show, schema or options."),
    file: str | None = typer.Argument(
        None, metavar="[FILE]", help="The configuration file, for check and show; for options, the URL of a link."
    ),
    device: bool = typer.Option(False, "--device", help="schema: of device files alone."),
    simulation: bool = typer.Option(False, "--simulation", help="schema: of simulation files."),
    gateway: bool = typer.Option(False, "--gateway", help="schema: of gateway files."),
    collector: bool = typer.Option(False, "--collector", help="schema: of collector files."),
) -> int:
    """Check and explain configuration files; list all options."""
    actions: dict[str, Callable[[str], None]] = {"check": _check, "show": _show}
    kinds = {"--device": device, "--simulation": simulation, "--gateway": gateway, "--collector": collector}
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


def _kind_of(file: str) -> str:
    """Return the kind of a configuration file by its keys: ``collector``, ``gateway``, ``simulation`` or ``server``.

    A file with ``[[link]]`` and listeners but no ``[[unit]]`` is a ``gateway``. A file is ``server`` if it has no key
    that only another kind has; also if it is no TOML, which the check of server files then reports.
    """
    from ..config.file_text import read_text
    from ..config.files import collector, gateway, simulation, system
    from ..config.files.section import keys_of

    try:
        data = tomllib.loads(read_text(file))
    except (ValueError, RecursionError):
        return "server"  # whose check says what is wrong with it
    common = keys_of(system.SystemFile).keys()
    for kind, schema in (
        ("collector", collector.CollectorFile),
        ("gateway", gateway.GatewayFile),
        ("simulation", simulation.SimulationFile),
    ):
        if data.keys() & (keys_of(schema).keys() - common):
            return kind
    if "link" in data and "unit" not in data and data.keys() & {"listen", "listener"}:
        return "gateway"
    is_simulated = any(map(simulation.is_only_of_simulations, _unit_keys(data.get("unit"))))
    return "simulation" if is_simulated else "server"


def _unit_keys(units: object) -> Iterator[str]:
    """Yield the path of each key in ``[[unit]]`` tables and in their points, such as ``unit[0].point[2].behaviour``."""
    for number, unit in enumerate(units if isinstance(units, list) else []):
        for key, value in unit.items() if isinstance(unit, dict) else []:
            yield f"unit[{number}].{key}"
            points = value if key == "point" and isinstance(value, list) else []
            for index, point in enumerate(points):
                yield from (
                    f"unit[{number}].point[{index}].{name}" for name in (point if isinstance(point, dict) else ())
                )


def _check(file: str) -> None:
    kind = _kind_of(file)
    if kind == "collector":
        _check_collector(file)
    elif kind == "gateway":
        from .gateway import check_file

        check_file(file)
    elif kind == "simulation":
        from .simulate import check_file as check_simulation

        check_simulation(file)
    else:
        _check_server(file)


def _check_collector(file: str) -> None:
    from ..apps.collector.configuration import load_collector
    from ..apps.collector.knowledge import Knowledge
    from ..values.counts import counted

    found = load_collector(file)
    rows = [("collector", "", f"store {found.store}; page {found.file.collector.page}")]
    rows += [("link", link.name, link.url) for link in found.links.values()]
    rows += [
        ("device", each.name, f"link {each.link}; unit {each.unit}; {counted(len(each.points), 'point')}")
        for each in found.devices.values()
    ]
    rows += [("sink", each.name, str(each.url).partition(":")[0]) for each in found.file.sink]
    print_aligned(rows)
    for warning in found.common.warnings:
        print(warning, file=sys.stderr)
    for load in found.loads(Knowledge()):
        for problem in load.problems:
            print(f"{file}: warning: link {load.link}: {problem}", file=sys.stderr)


def _check_server(file: str) -> None:
    from ..apps.service.configuration import load_configuration
    from ..apps.service.overview import overview

    configuration = load_configuration(file, preflight=True)
    print_aligned(list(overview(configuration)))
    for warning in configuration.warnings:
        print(warning, file=sys.stderr)


def _show(file: str) -> None:
    kind = _kind_of(file)
    if kind != "server":
        raise ConfigError(f"this is a file of a {kind}, which is shown by: {_SHOWN_BY[kind].format(file)}", file=file)
    from ..apps.service.configuration import parse_configuration
    from ..apps.service.effective import effective
    from ..config.file_text import read_text

    text = read_text(file)
    for line in effective(parse_configuration(text, file), tomllib.loads(text)):
        print(line)


def _print_options(url: str | None) -> None:
    """Print name, default, values and meaning of the options of a link to ``url``; with None, of all options."""
    from ..options.accepted_options import LINKS, AcceptedOptions
    from ..options.endpoints import parse_endpoint

    if url is not None:
        endpoint = parse_endpoint(url)
        _print_keys(f"of a link to {endpoint.url}:", AcceptedOptions.at(endpoint, "client", LINKS).options.values())
        return
    for title, options in _all_options():
        _print_keys(title, options)


def _all_options() -> Iterator[tuple[str, list["Option"]]]:
    """Yield all options in groups, as (title, options): of links, of servers, and of each section of files.

    An option that an earlier group has is left out.
    """
    from ..config.files.section import keys_of, sections_of
    from ..options.accepted_options import LINKS, SERVERS, AcceptedOptions

    of_links = list(AcceptedOptions.of(*LINKS, role="client").options.values())
    of_servers = list(AcceptedOptions.of(*SERVERS, role="server").options.values())
    yield "of links:", of_links
    yield "of servers:", of_servers
    told = [*of_links, *of_servers]
    for section in dict.fromkeys(each for schema in _schemas().values() for each in sections_of(schema)):
        new = [option for option in keys_of(section).values() if option not in told]
        told += new
        if new:
            title = (section.__doc__ or "").partition("\n\n")[0].replace("``", "")
            yield " ".join(title.split()), new


def _print_keys(title: str, options: Iterable["Option"]) -> None:
    print(title)
    rows = [[one.name, one.default_text, one.values, one.help] for one in options]
    print_aligned([["  " + name, *(cell.replace("`", "") for cell in cells)] for name, *cells in rows])


def _schemas() -> dict[str, type["Section"]]:
    """Return the class that describes a kind of file, by the option of ``busway config schema`` that selects the kind.

    The key ``""`` (no option) has the class of configuration files.
    """
    from ..config.files import collector, device, gateway, simulation, system

    return {
        "": system.SystemFile,
        "--device": device.DeviceFile,
        "--simulation": simulation.SimulationFile,
        "--gateway": gateway.GatewayFile,
        "--collector": collector.CollectorFile,
    }


def _print_schema(kinds: list[str]) -> None:
    from ..config.files.section import json_schema
    from ..config.files.simulation import simulation_schema

    if len(kinds) > 1:
        raise ConfigError(f"goes without {kinds[0]}", key=kinds[1])
    kind = kinds[0] if kinds else ""
    title = f"busway {kind.removeprefix('--')} file" if kind else "busway configuration"
    is_simulation = kind == "--simulation"
    print(json_text(simulation_schema(title) if is_simulation else json_schema(_schemas()[kind], title), indent=2))
