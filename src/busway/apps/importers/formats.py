"""Chooses the importer for a device description of another program, by the ending of its name and its contents.

Knows the names of formats, and the endings and first words of their files.
"""

from collections.abc import Mapping
from typing import Final

from ...config.file_text import read_text
from ...errors import ConfigError
from ..simulator.csv_register_map import read_what_fits
from .home_assistant import read_home_assistant
from .imported import ImportedDevice
from .modpoll import is_modpoll, read_modpoll
from .sunspec import FIRST_MODEL, read_sunspec
from .telegraf import read_telegraf

FORMATS: Final = {
    "csv": "a register map in CSV, as manuals have it",
    "telegraf": "inputs.modbus of Telegraf, TOML",
    "home-assistant": "modbus: of Home Assistant, YAML",
    "modpoll": "the CSV of modpoll",
    "sunspec": "a SunSpec model, JSON",
}
_ENDINGS: Final = {
    ".toml": "telegraf", ".conf": "telegraf", ".yaml": "home-assistant", ".yml": "home-assistant", ".json": "sunspec",
    ".csv": "csv", ".txt": "csv", ".tsv": "csv",
}  # fmt: skip


def import_file(
    path: str, *, format: str | None = None, address: int = FIRST_MODEL, counts: Mapping[str, int] | None = None
) -> ImportedDevice:
    """Import the description of a device from a file of another program.

    Args:
        path: the file.
        format: a key of `FORMATS`; None to choose by the ending of the file's name and, for CSV, by its contents.
        address: for SunSpec models only: 0-based address of the model's register ``ID`` in the device.
        counts: for SunSpec models only: how many members a repeated group has, by the name of the group or of the point
            that holds its count.

    Returns:
        The points found, and what could not be carried over.

    Raises:
        ConfigError: the file cannot be read, its format is unknown, its text cannot be parsed in this format, the count
            of a repeated group is missing (SunSpec), or PyYAML is not installed (Home Assistant). A text that can be
            parsed but has no points is no error here, but one of `ImportedDevice.sections`.
    """
    if format is not None and format not in FORMATS:
        raise ConfigError(f"there is no such format, but {', '.join(FORMATS)}", key=format)
    chosen = format or _ENDINGS.get(path[path.rfind(".") :].lower() if "." in path else "")
    if chosen is None:
        read_text(path)  # a file that is not there has no format either
        raise ConfigError("its name says no format; --from says which: " + ", ".join(FORMATS), file=path)
    if chosen == "csv":
        if format is None and is_modpoll(read_text(path)):
            return read_modpoll(read_text(path), path)
        return _register_map(path)
    text = read_text(path)
    if chosen == "sunspec":
        return read_sunspec(text, path, first=address, counts=counts)
    readers = {"telegraf": read_telegraf, "home-assistant": read_home_assistant, "modpoll": read_modpoll}
    return readers[chosen](text, path)


def _register_map(path: str) -> ImportedDevice:
    found = ImportedDevice()
    rows, problems = read_what_fits(path)
    for problem in problems:
        found.omit(f"line {problem.line}", problem.key or "a row", problem.message)
    for line, keys in rows:
        found.add(1, keys, f"line {line}")
    return found
