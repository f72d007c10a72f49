"""Where the devices of ``busway simulate`` come from: a file, a ready-made device, or a register map.

Knows the options and what they read; serves nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError
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
    None, "--watch", metavar="TIME", help="With --clone and --map: watch so long how values change, and do likewise."
)
RANGE = typer.Option(
    None, "--range", metavar="A-B,…", help="With --clone without a map: offsets to search, 0-9999,40000-40999."
)
THOROUGH = typer.Option(False, "--thorough", help="With --clone without a map: search what seems empty, too.")
UNIT = typer.Option(None, "-u", "--unit", metavar="U", help="With --clone or --map: the unit, 0…255.")


@dataclass(frozen=True, slots=True)
class Chosen:
    """The file or ready-made device that ``busway simulate`` simulates.

    Attributes:
        name: the name of the file or device.
        load: reads the source; called at the start and at each reload. Raises `ConfigError`.
    """

    name: str
    load: "Callable[[], SimulationDeclaration]"


def chosen_source(
    file: str | None, device: str | None, map_file: str | None, unit: str | None, changes: dict[str, Any]
) -> Chosen:
    """Return the source of the simulation that the arguments of ``busway simulate`` name; no file is read yet.

    Args:
        file: path of a simulation file.
        device: name of a ready-made device.
        map_file: path of a register map.
        unit: the unit number for the register map.
        changes: options of listeners that replace the file's.

    Raises:
        ConfigError: none is named or more than one, there is no such device, or ``unit`` is given without a register
            map.
    """
    from ..apps.simulator.includes import load_declaration
    from ..config.profiles import PREFIX, ready_made

    named = [key for key, value in (("FILE", file), ("--device", device), ("--map", map_file)) if value is not None]
    if len(named) != 1:
        raise ConfigError("one of FILE, --device and --map is needed", key=named[1] if named else "FILE")
    if unit is not None and map_file is None:
        raise ConfigError("goes with --clone and --map only", key="--unit")
    if map_file is not None:
        path, number = map_file, unit
        return Chosen(path, lambda: _of_map(path, number, changes))
    if device is not None:
        try:
            ready_made(device)
        except ConfigError as error:
            raise ConfigError(error.message, key=f"--device {device}") from None
    name = file if file is not None else f"{PREFIX}{device}"
    return Chosen(name, lambda: load_declaration(name, changes=changes))


def _of_map(path: str, unit: str | None, changes: dict[str, Any]) -> "SimulationDeclaration":
    from ..apps.simulator.device_text import device_text
    from ..apps.simulator.includes import parse_declaration
    from ..apps.simulator.register_map import read_register_map
    from ..config.files.simulation import SimulatedUnitSection
    from .arguments import whole_number

    number = 1 if unit is None else whole_number(unit, "--unit", 0, 255)
    section = SimulatedUnitSection.model_validate({"unit": number, "point": read_register_map(path)})
    return parse_declaration(device_text([section]), path, changes=changes)
