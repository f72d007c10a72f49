"""Adds faults to a simulation from ``[[fault]]`` sections and command-line words, and lists the fault profiles.

Knows the schema and the fault profiles; reads no file.

1. An error has the path of the key in its section, which the reader of the file turns into a line.
"""

from collections.abc import Iterable, Iterator

from ...config.files.fault_sections import FaultSection, parse_fault_words
from ...config.files.lines import Path
from ...config.files.schema import Source
from ...errors import ConfigError
from ...faults.fault import Schedule
from ...faults.profile import FaultProfile, FaultProfileTable
from ...faults.profiles import FAULT_PROFILES
from ...faults.switchboard import FaultSwitchboard


def fault_problems(
    sections: Iterable[FaultSection], source: Source, fault_profiles: FaultProfileTable = FAULT_PROFILES
) -> list[ConfigError]:
    """Return the errors in ``[[fault]]`` sections that the schema of the file cannot find, each with line and key.

    These are unknown fault profiles, invalid parameters, and names that stand twice.

    Args:
        sections: all sections ``fault`` of the file, in order.
        source: the file, for the lines.
        fault_profiles: the known fault profiles.
    """
    found = []
    taken: set[str] = set()
    for index, section in enumerate(sections):
        for path, sentence in _section_problems(section, fault_profiles):
            found.append(source.problem(("fault", index, *path), sentence))
        if section.name:
            if section.name in taken:
                found.append(source.problem(("fault", index, "name"), "another fault has the same name"))
            taken.add(section.name)
    return found


def _section_problems(section: FaultSection, fault_profiles: FaultProfileTable) -> Iterator[tuple[Path, str]]:
    fault_profile = fault_profiles.get(section.fault_profile)
    if fault_profile is None:
        try:
            fault_profiles.named(section.fault_profile)
        except ConfigError as error:
            yield ("fault_profile",), error.message
        return
    for name, value in section.parameters.items():
        try:
            fault_profile(**{name: value})
        except ConfigError as error:
            yield ("parameters", name), error.message


def put_on(board: FaultSwitchboard, sections: Iterable[FaultSection]) -> list[str]:
    """Add the faults that a file's ``[[fault]]`` sections declare to a simulation, and return their names.

    A fault without a name gets that of its fault profile, with a number if the name is taken.

    Args:
        board: the faults of the simulation.
        sections: the sections.

    Raises:
        ConfigError: a fault is invalid; `fault_problems` finds these errors before.
    """
    ordered = list(sections)
    named = [one.name for one in ordered if one.name]
    made: list[str] = []
    for one in ordered:
        name, number = one.name, 1
        while not name or (not one.name and name in (*named, *made)):  # a chosen name is kept
            name = one.fault_profile if number == 1 else f"{one.fault_profile}-{number}"
            number += 1
        made.append(_put_on(board, one, name))
    return made


def _put_on(board: FaultSwitchboard, section: FaultSection, name: str) -> str:
    schedule = section.schedule
    return board.add(
        section.fault_profile,
        name=name,
        units=section.chosen_units(),
        functions=section.chosen_functions(),
        items=section.chosen_addresses(),
        probability=section.probability,
        schedule=Schedule(schedule.from_, schedule.for_, schedule.every, schedule.skip, schedule.times),
        on=section.on,
        parameters=section.parameters,
    )


def put_on_by_words(board: FaultSwitchboard, text: str) -> str:
    """Carry out an option ``--fault``: switch on the fault with that name, or add a fault with parameters.

    Args:
        board: the faults of the simulation.
        text: the name of a fault, such as ``slow meters``; or a fault profile with parameters, such as ``late`` or
            ``late:delay=2,units=1-3``.

    Returns:
        The name of the fault.

    Raises:
        ConfigError: there is no such fault and no such fault profile, or a parameter is invalid.
    """
    if any(one.label == text for one in board.faults):
        board.switch(text, on=True)
        return text
    section = parse_fault_words(text)
    return _put_on(board, section, section.name)


def fault_profile_lines(fault_profiles: FaultProfileTable = FAULT_PROFILES) -> list[str]:
    """Return the lines that ``--list-faults`` prints: each fault profile with its effect and its parameters."""
    width = max(len(name) for name in fault_profiles)
    lines = []
    for one in fault_profiles.values():
        lines.append(f"{one.name:<{width}}  {one.happens}")
        lines.extend(f"{'':<{width}}    {text}" for text in _parameter_lines(one))
    return lines


def _parameter_lines(fault_profile: FaultProfile) -> Iterator[str]:
    for one in fault_profile.parameters.values():
        given = "" if one.default is None else f"={_shown(one.default)}"
        yield f"{one.name}{given}: {one.help}{f' ({one.limits})' if one.limits else ''}"


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(int(value)) if isinstance(value, int) else str(value)
