"""Ready-made device profiles: simulation files that come with the package, each with its parameters.

Knows their names and texts; knows nothing of how they are simulated. The register maps in the documentation are
generated from these files (``scripts/register_maps.py``).
"""

from dataclasses import dataclass
from importlib.resources import files
from typing import Final

from ...errors import ConfigError
from ..file_text import read_named_text, read_text

PREFIX: Final = "device:"
"""Prefix of a name that means a ready-made device instead of a file: ``device:meter``."""

DEVICES: Final = {
    "meter": "An energy meter for three phases: float32 values, uint32 counters.",
    "inverter": "A three-phase photovoltaic inverter with SunSpec models 1, 103 and 120.",
    "drive": "A variable-speed drive: control and status word, speed set point with lag, faults.",
    "io": "An IO block of a PLC: coils, inputs, counters, a watchdog.",
    "thermostat": "A temperature controller on a serial line: set point, process value, alarms.",
    "sdm630": "Eastron SDM630, an energy meter for three phases: float32.",
    "sdm120": "Eastron SDM120, an energy meter for one phase: float32.",
    "iem3155": "Schneider Electric iEM3000 series, energy meters for three phases: float32, int64.",
    "abb_b23": "ABB B23 and A43, energy meters for three phases: whole numbers with patterns for no value.",
    "umg96rm": "Janitza UMG 96RM, a power analyser: float32.",
    "em24": "Carlo Gavazzi EM24, an energy meter for three phases: whole numbers, low word first.",
    "em340": "Carlo Gavazzi EM330, EM340, ET330, ET340, energy meters: whole numbers, low word first.",
    "pac2200": "Siemens SENTRON PAC2200, a power monitoring device: float32, float64.",
    "dtsu666": "Chint DTSU666, an energy meter for three phases: float32 with scales.",
    "wago879": "WAGO 879-3000, an energy meter for three phases: float32.",
    "sma": "SMA Sunny Boy and Sunny Tripower, photovoltaic inverters with SMA Modbus.",
    "sun2000": "Huawei SUN2000, a photovoltaic inverter: whole numbers with gains, texts.",
    "vlt_fc": "Danfoss VLT FC series, variable-speed drives: control and status word in coils, parameters.",
    "wago750": "WAGO 750 fieldbus couplers: process image, constants, what the coupler says of itself.",
    "logo8": "Siemens LOGO! 8, a logic module: inputs, outputs, flags, variable memory.",
}
"""The ready-made devices by name, each with its description for people, in the order of the documentation."""


@dataclass(frozen=True, slots=True)
class ReadyMade:
    """A device profile that comes with the package.

    Attributes:
        name: its name, as ``busway simulate --device`` takes it: ``meter``.
        file: the name of its file, without a folder, for messages: ``meter.toml``.
        text: the text of the simulation file.
    """

    name: str
    file: str
    text: str


def ready_made(name: str) -> ReadyMade:
    """Return the ready-made device with this name, such as ``meter``.

    Raises:
        ConfigError: there is no such device; the message lists all names, and ``key`` is the wrong one.
    """
    if name not in DEVICES:
        raise ConfigError(f"there is no such device, but {', '.join(DEVICES)}", key=name)
    file = f"{name}.toml"
    return ReadyMade(name, file, files(__name__).joinpath(file).read_text(encoding="utf-8"))


def read_profile(name: str) -> str:
    """Return the text of a simulation file that the command line or the program names, by its path or ``device:NAME``.

    Raises:
        ConfigError: there is no such device, or `read_text` cannot read the file; ``file`` of the error is ``name``.
    """
    return _ready_made_text(name) if name.startswith(PREFIX) else read_text(name)


def read_included(name: str) -> str:
    """Return the text of a file that a simulation file names, by its path or ``device:NAME``.

    Raises:
        ConfigError: there is no such device, or `read_named_text` refuses the file; ``file`` of the error is ``name``.
    """
    return _ready_made_text(name) if name.startswith(PREFIX) else read_named_text(name)


def _ready_made_text(name: str) -> str:
    try:
        return ready_made(name.removeprefix(PREFIX)).text
    except ConfigError as error:
        raise ConfigError(error.message, file=name) from error
