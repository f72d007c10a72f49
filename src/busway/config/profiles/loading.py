"""Loads a device file or profile, with its parameters replaced by values, as the description of one unit.

Knows files, parameters and the schema of units; reads no included files and simulates nothing (`busway.apps.simulator`
does).
"""

from collections.abc import Mapping
from dataclasses import replace

from ...errors import ConfigError
from ...values.unfit_values import shown
from ..files.simulation import Parameter, ProfileFile, SimulatedUnitSection
from ..files.toml_source import read_source
from ..parameters import FilledSource, declared_parameters
from . import read_profile


def load_profile(name: str, *, unit: int, parameters: Mapping[str, Parameter] | None = None) -> SimulatedUnitSection:
    """Load the one unit that a file describes, with its parameters replaced by values.

    Args:
        name: path of a file with one ``[[unit]]``, or ``device:NAME``.
        unit: the unit number that the result has, 0…255, whatever the file says.
        parameters: values of the file's parameters; those that are left out have the defaults in the file.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
        ConfigError: the file cannot be read, does not declare a given parameter, requires one that is not given, has an
            ``[[include]]``, or has not exactly one ``[[unit]]``.
    """
    given = dict(parameters or {})
    source = read_source(read_profile(name), name)
    defaults, required = source.data.get("parameters", {}), source.data.get("required", [])
    known: list[str] = []  # the schema will say what is wrong with others
    if isinstance(defaults, dict) and isinstance(required, list):
        known = [*defaults, *(name for name in required if isinstance(name, str))]
    for each in given:
        if each not in known:
            raise ConfigError(f"there is no such parameter in it; there are {', '.join(known) or 'none'}", key=each)
    missing = [each for each in known if each not in given and each not in defaults]
    if missing:
        raise ConfigError(f"needs the parameter {shown(missing[0])}", file=name)
    met = replace(source, data={key: value for key, value in source.data.items() if key != "required"})
    values = {**declared_parameters(met, {}, None), **given, "unit": unit, "index": 0}
    data = FilledSource(source, values).filled(source.data, ())
    sections = data.get("unit")
    if not isinstance(sections, list) or len(sections) != 1 or data.get("include"):
        raise ConfigError("a profile has one [[unit]] and no [[include]]", file=name)
    if isinstance(sections[0], dict):
        sections[0]["unit"] = [unit]
    filled = replace(source, data=data)
    shape = {key: value for key, value in data.items() if key in ProfileFile.model_fields}
    replace(source, data=shape).checked(ProfileFile)
    return filled.checked(SimulatedUnitSection, "unit", 0)
