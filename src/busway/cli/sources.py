"""Where the devices of ``busway simulate`` come from: a file, a ready-made device, or a register map.

Knows the options and what is read for them; serves nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
from .arguments import hint_at_unit, refuse_other_unit, unit_number
from .exits import ExitCode

if TYPE_CHECKING:
    from ..apps.simulator.includes import SimulationDeclaration

FILE_HELP = "A simulation file, in TOML; every device file is one."


def _list_devices(wanted: bool) -> None:
    if wanted:
        from ..config.profiles import DEVICES
        from .output import print_aligned

        print_aligned([[name, sentence] for name, sentence in DEVICES.items()])
        raise typer.Exit(ExitCode.DONE)


DEVICE = typer.Option(None, "--device", metavar="NAME", help="Simulate a ready-made device: meter, inverter, drive…")
LIST_DEVICES = typer.Option(
    False, "--list-devices", help="List the ready-made devices.", is_eager=True, callback=_list_devices
)
MAP = typer.Option(
    None,
    "--map",
    metavar="CSV",
    help="Simulate the points of a register map; with --clone, read these from the device.",
)
CLONE = typer.Option(
    None, "--clone", metavar="URL", help="Simulate nothing, but record a live device into a simulation file."
)
OUT = typer.Option(None, "--out", metavar="FILE", help="With --clone: where the file goes, instead of stdout.")
FORCE = typer.Option(False, "--force", help="With --out: write over a file that is there.")
WATCH = typer.Option(
    None,
    "--watch",
    metavar="TIME",
    help="With --clone and --map: watch for this time how values change, and imitate it.",
)
RANGE = typer.Option(
    None, "--range", metavar="A-B,…", help="With --clone without a map: offsets to search, 0-9999,40000-40999."
)
THOROUGH = typer.Option(False, "--thorough", help="With --clone without a map: search what seems empty, too.")
UNIT = typer.Option(
    None, "-u", "--unit", metavar="U", help="The unit of --clone or --map, or of a FILE that does not say it: 0…255."
)


@dataclass(frozen=True, slots=True)
class Chosen:
    """What ``busway simulate`` simulates: a file, a ready-made device or a register map.

    Attributes:
        name: path of the file or map; ``device:NAME`` for a ready-made device.
        load: function that reads and checks the source; called at the start and at each reload. Raises `ConfigError`.
    """

    name: str
    load: "Callable[[], SimulationDeclaration]"


def chosen_source(
    file: str | None,
    device: str | None,
    map_file: str | None,
    unit: str | None,
    changes: dict[str, Any],  # Any: of different types
    *,
    preflight: bool = False,
) -> Chosen:
    """Return the source that the arguments of ``busway simulate`` name; it is not read yet.

    Args:
        file: path of a simulation file; None if not given, like the next two.
        device: name of a ready-made device.
        map_file: path of a register map.
        unit: text of ``--unit``: number for the register map, or for a file whose only unit has none. None if not
            given.
        changes: options of listeners that override those of the file.
        preflight: whether loading opens the files that a simulation file names for its server, such as certificates.

    Raises:
        ConfigError: none of the three sources is named or several are, there is no such device, ``unit`` is given with
            ``device``, or it is no number 0…255 (with ``map_file`` that error comes from `Chosen.load`).
    """
    from ..config.profiles import PREFIX, ready_made

    named = [key for key, value in (("FILE", file), ("--device", device), ("--map", map_file)) if value is not None]
    if len(named) != 1:
        raise ConfigError("one of FILE, --device and --map is needed", key=named[1] if named else "FILE")
    if unit is not None and device is not None:
        raise ConfigError("does not go with --device", key="--unit")
    if map_file is not None:
        path, number = map_file, unit
        return Chosen(path, lambda: _of_map(path, number, changes))
    if device is not None:
        try:
            ready_made(device)
        except ConfigError as error:
            raise ConfigError(error.message, key=f"--device {device}") from None
    name = file if file is not None else f"{PREFIX}{device}"
    asked = unit_number(unit)
    return Chosen(name, lambda: _of_file(name, asked, changes, preflight))


def _of_file(name: str, unit: int | None, changes: dict[str, Any], preflight: bool) -> "SimulationDeclaration":
    from ..apps.simulator.includes import load_declaration

    with hint_at_unit():
        found = load_declaration(name, changes=changes, unit=unit, preflight=preflight)
    refuse_other_unit(name, unit, (number for each in found.units for number in each.section.unit))
    return found


def _of_map(path: str, unit: str | None, changes: dict[str, Any]) -> "SimulationDeclaration":
    from ..apps.simulator.csv_register_map import read_register_map
    from ..apps.simulator.device_text import device_text
    from ..apps.simulator.includes import parse_declaration
    from ..config.files.simulation import SimulatedUnitSection

    number = unit_number(unit)
    section = SimulatedUnitSection.model_validate(
        {"unit": 1 if number is None else number, "point": read_register_map(path)}
    )
    return parse_declaration(device_text([section]), path, changes=changes)
