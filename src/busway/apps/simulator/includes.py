"""Loads a simulation file with all files that it includes; every error names its line in its own file.

Knows names of files, includes and parameters; the schema (`busway.config.files.simulation`) knows the contents of a
file, and `busway.apps.simulator.builder` builds devices from them.

1. A text that is ``${name}`` alone becomes the parameter's value, with its type; ``${name}`` inside a longer text
   becomes the text of the value. The braces may hold an expression: ``${base + 10 * index}``.
2. ``[parameters]`` of a file gives defaults, and ``required`` lists parameters without any; ``with`` of an include sets
   parameters. ``unit`` is the number of the unit that is being made, ``index`` counts the units of one include from 0.
3. With ``units`` an include makes several units from the one ``[[unit]]`` of its file, each with a memory of its own;
   without ``units`` it adds all units of the file with their own numbers.
4. A file cannot include itself, nor another file that includes it.
5. Paths in a file are relative to its folder; ``device:NAME`` is a device of the package. Included files are regular
   ones, and not reached by a link of another user (`busway.safe_files`).
6. Limits prevent that a few short files need much memory: `MOST_INCLUDES`, and the limits of texts with parameters in
   `busway.config.parameters`.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from ...config.files.file_error import FileError, in_order
from ...config.files.key_lines import KeyPath
from ...config.files.simulation import (
    IncludeSection,
    Parameter,
    ParameterKeys,
    ProfileFile,
    SimulatedUnitSection,
    SimulationFile,
)
from ...config.files.toml_source import Source, read_source, with_unit
from ...config.parameters import OF_UNITS, FilledSource, declared_parameters, own_units
from ...config.paths import within
from ...config.profiles import PREFIX, read_included, read_profile
from ...config.report import ConfigurationReport
from ...errors import ConfigError
from ..service.configuration import Configuration, put_together
from .added_faults import fault_problems

Reader = Callable[[str], str]
"""Function that takes the path of a file and returns its text. Raises `ConfigError` if the file cannot be read."""

MOST_INCLUDES: Final = 1000
"""Most includes of one simulation. A file counts each time that it is included: twenty files that each include the next
one twice would be a million includes.
"""
MOST_LEVELS: Final = 32
"""Most levels of included files below the file of the simulation."""


@dataclass(frozen=True, slots=True)
class DeclaredUnit:
    """A ``[[unit]]`` section with includes and parameters resolved, and the file that it comes from.

    Attributes:
        section: the contents of the section; if it has several unit numbers, each is a device of its own.
        source: the file with the section.
        path: path of the section in that file.
    """

    section: SimulatedUnitSection
    source: Source
    path: KeyPath

    def problem(self, path: KeyPath, sentence: str) -> ConfigError:
        """Return an error about a key of the unit's section, with file, line and key.

        Args:
            path: path of the key in the section.
            sentence: the message.
        """
        return self.source.problem((*self.path, *path), sentence)


@dataclass(frozen=True, slots=True)
class SimulationDeclaration:
    """A simulation file with the units of all files that it includes, checked.

    Attributes:
        configuration: listeners, security, policy and the like; its ``file`` has all units.
        file: the sections of the file, with the units of all includes.
        units: the units, each with its place in its own file.
        state: path of the file in which the values are saved; None if they are not saved.
    """

    configuration: Configuration
    file: SimulationFile
    units: tuple[DeclaredUnit, ...]
    state: str | None


def load_declaration(
    path: str | os.PathLike[str],
    *,
    changes: Mapping[str, Any] | None = None,  # Any: options of several types
    unit: int | None = None,
    preflight: bool = False,
) -> SimulationDeclaration:
    """Load a simulation file with all its includes.

    Args:
        path: path of the file, in TOML. Every device file and every configuration file is a simulation file too.
        changes: options of all listeners, by name, that override those of the file.
        unit: number of the file's only ``[[unit]]`` if the file has none for it.
        preflight: whether to open the files that it names for its server, too, such as certificates.

    Raises:
        ConfigError: a file cannot be read or is invalid; then the error has all ``problems``, each with file, line and
            key.
    """
    name = os.fspath(path)
    return parse_declaration(read_profile(name), name, changes=changes, unit=unit, preflight=preflight)


def parse_declaration(
    text: str,
    name: str,
    *,
    changes: Mapping[str, Any] | None = None,
    read: Reader = read_included,
    unit: int | None = None,
    preflight: bool = False,
) -> SimulationDeclaration:
    """Parse the text of a simulation file, with all its includes.

    Args:
        text: content of the file.
        name: name of the file, for errors; paths in the text are relative to its folder.
        changes: options of all listeners, by name, that override the file's.
        read: returns the text of an included file by its path.
        unit, preflight: as of `load_declaration`.

    Raises:
        FileError: the file or an included one is invalid; the error has all problems, each with file, line and key.
    """
    source = with_unit(read_source(text, name), unit)
    source = replace(source, data=own_units(FilledSource(source, declared_parameters(source, {}, None))))
    file = source.checked(SimulationFile)
    if problems := fault_problems(file.fault, source):
        raise FileError(in_order(problems))
    own = [DeclaredUnit(section, source, ("unit", index)) for index, section in enumerate(file.unit)]
    units = [*own, *_Including(read, (_identity(name),), _Count(MOST_INCLUDES)).all_of(file, source)]
    _refuse_repeated(file, units, source)
    whole = file.model_copy(update={"unit": [each.section for each in units]})
    report = ConfigurationReport(source)
    made = put_together(whole, name, report, preflight=preflight, changes=changes)
    made = replace(made, warnings=report.end())
    state = None if file.simulation.keep is None else within(name, file.simulation.keep)
    return SimulationDeclaration(made, whole, tuple(units), state)


class _Count:
    """Counts the files that one simulation includes, and limits them.

    Args:
        most: most files that may be included.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._left = most

    def take(self) -> None:
        """Count one more included file. Raises `ConfigError` if there are too many."""
        if not self._left:
            raise ConfigError(f"more than {self._most} files would be included, with all that they include")
        self._left -= 1


class _Including:
    """Resolves the ``[[include]]`` sections of one file: makes the units that they add.

    Args:
        read: returns the text of a file by its path.
        chain: the real paths of the files from the simulation's own file to this one, each of which includes the next.
        count: counts the included files of the whole simulation.
    """

    def __init__(self, read: Reader, chain: tuple[str, ...], count: _Count) -> None:
        self._read = read
        self._chain = chain
        self._count = count

    def all_of(self, file: ParameterKeys, source: Source) -> Iterator[DeclaredUnit]:
        """Yield the units that all includes of a file add. Raises `FileError` with the problems of one included file.

        Args:
            file: the ``[[include]]`` sections of the file.
            source: the file, for the lines of errors.
        """
        for index, section in enumerate(file.include):
            yield from self._one(section, source, ("include", index))

    def _one(self, section: IncludeSection, parent: Source, at: KeyPath) -> Iterator[DeclaredUnit]:
        name = section.file if section.file.startswith(PREFIX) else within(parent.name, section.file)
        identity = _identity(name)
        if identity in self._chain:
            raise FileError([parent.problem((*at, "file"), f"{name} would include itself")])
        if len(self._chain) > MOST_LEVELS:
            raise FileError([parent.problem((*at, "file"), f"more than {MOST_LEVELS} files would include one another")])
        try:
            self._count.take()
        except ConfigError as error:
            raise FileError([parent.problem((*at, "file"), error.message)]) from None
        try:
            text = self._read(name)
        except ConfigError as error:
            if error.line is not None:
                raise
            raise FileError([parent.problem((*at, "file"), f"{name}: {error.message}")]) from None
        try:
            source = read_source(text, name)
            parameters = declared_parameters(source, section.with_, (parent, at))
            numbers = section.numbers()
            if numbers is None:
                yield from self._whole(source, parameters, identity)
            else:
                yield from self._several(source, parameters, numbers, (parent, (*at, "units")))
        except FileError as error:
            line = parent.problem(at, "").line
            raise FileError([_included(each, name, f"{parent.name}:{line}") for each in error.problems]) from None

    def _whole(self, source: Source, parameters: Mapping[str, Parameter], identity: str) -> Iterator[DeclaredUnit]:
        """Yield all units of an included file with their own numbers, and the units of files that it includes.

        Args:
            source: the included file.
            parameters: the values of the file's parameters.
            identity: real path of the file.
        """
        filled = replace(source, data=own_units(FilledSource(source, parameters)))
        profile = filled.checked(ProfileFile)
        if not profile.unit and not profile.include:
            raise FileError([source.problem(("unit",), "is missing")])
        for index in range(len(profile.unit)):
            yield _checked_unit(filled, index)
        yield from _Including(self._read, (*self._chain, identity), self._count).all_of(profile, filled)

    def _several(
        self, source: Source, parameters: Mapping[str, Parameter], numbers: Sequence[int], asked: tuple[Source, KeyPath]
    ) -> Iterator[DeclaredUnit]:
        """Yield the units that an include with ``units`` makes from its file's single ``[[unit]]`` section.

        There is one for each number, or a single one with all numbers if the section does not depend on ``unit`` or
        ``index``.

        Args:
            source: the included file.
            parameters: the values of the file's parameters.
            numbers: the numbers of the units.
            asked: the including file and the path of its key ``units``, for errors.
        """
        sections = source.data.get("unit")
        if not isinstance(sections, list) or len(sections) != 1 or "include" in source.data:
            parent, at = asked
            raise FileError([parent.problem(at, f"needs a file with one [[unit]] and no [[include]]: {source.name}")])
        for index, number in enumerate(numbers):
            filled = FilledSource(source, {**parameters, "unit": number, "index": index})
            data = filled.filled(source.data, ())
            depends = filled.used & {*OF_UNITS}
            if isinstance(data["unit"][0], dict):
                data["unit"][0]["unit"] = [number] if depends else list(numbers)
            made = replace(source, data=data)
            made.checked(ProfileFile)
            yield _checked_unit(made, 0)
            if not depends:
                return


def _checked_unit(source: Source, index: int) -> DeclaredUnit:
    return DeclaredUnit(source.checked(SimulatedUnitSection, "unit", index), source, ("unit", index))


def _included(error: ConfigError, name: str, where: str) -> ConfigError:
    """Return an error of an included file with a note that names the including file; other errors unchanged.

    Args:
        error: the error.
        name: name of the included file.
        where: name and line of the including file.
    """
    if error.file != name:
        return error
    return ConfigError(f"{error.message} (included by {where})", file=error.file, line=error.line, key=error.key)


def _identity(name: str) -> str:
    return os.path.realpath(name)


def _refuse_repeated(file: SimulationFile, units: Sequence[DeclaredUnit], source: Source) -> None:
    """Raise `FileError` if two files declare the same unit number, or if there are too many devices.

    With the ``unit_policy`` ``any`` there must be only one device. Within one file the schema checks unit numbers.
    """
    owners: dict[int, DeclaredUnit] = {}
    problems: list[ConfigError] = []
    for each in units:
        for number in each.section.unit:
            if number in owners:
                other = owners[number].problem((), "")
                problems.append(each.problem((), f"unit {number} is there already: {other.file}:{other.line}"))
            owners.setdefault(number, each)
    if file.server.options().get("unit_policy") == "any" and len(owners) > 1:
        problems.append(
            source.problem(("server", "unit_policy"), f"any needs exactly one device, but there are {len(owners)}")
        )
    if problems:
        raise FileError(in_order(problems))
