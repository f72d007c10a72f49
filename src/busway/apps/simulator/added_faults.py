"""Adds faults to a simulation from ``[[fault]]`` sections and command-line words, and lists the fault profiles.

Knows the schema and the fault profiles; reads no file.

1. An error names the key by its path in the file, from which the line is found.
"""

from collections.abc import Collection, Iterable, Iterator
from typing import Final

from ...config.files.fault_sections import FaultSection, parse_fault_words
from ...config.files.key_lines import KeyPath
from ...config.files.toml_source import Source
from ...errors import ConfigError
from ...faults.applied_faults import Schedule
from ...faults.fault import Carrier
from ...faults.faulty_connections import carriers_of
from ...faults.profile import FaultProfile, FaultProfileTable
from ...faults.profiles import FAULT_PROFILES
from ...faults.switchboard import FaultStatus, FaultSwitchboard
from ...options.endpoints import parse_endpoint


def fault_problems(
    sections: Iterable[FaultSection], source: Source, fault_profiles: FaultProfileTable = FAULT_PROFILES
) -> list[ConfigError]:
    """Return the errors in ``[[fault]]`` sections that the schema of the file cannot find.

    These are unknown fault profiles, invalid parameters, and names that are used twice. Each error has file, line and
    key; the list is empty if there are none.

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


def _section_problems(section: FaultSection, fault_profiles: FaultProfileTable) -> Iterator[tuple[KeyPath, str]]:
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


def put_on(switchboard: FaultSwitchboard, sections: Iterable[FaultSection]) -> list[str]:
    """Add the faults that a file's ``[[fault]]`` sections declare to a simulation, and return their names.

    A fault without a name gets the name of its fault profile, with a number if that name is taken: ``late-2``.

    Args:
        switchboard: the faults of the simulation.
        sections: the sections.

    Raises:
        ConfigError: a fault is invalid; those before it stay added. `fault_problems` finds such errors beforehand.
    """
    ordered = list(sections)
    named = [one.name for one in ordered if one.name]
    made: list[str] = []
    for one in ordered:
        name, number = one.name, 1
        while not name or (not one.name and name in (*named, *made)):  # a chosen name is kept
            name = one.fault_profile if number == 1 else f"{one.fault_profile}-{number}"
            number += 1
        made.append(_put_on(switchboard, one, name))
    return made


def _put_on(switchboard: FaultSwitchboard, section: FaultSection, name: str) -> str:
    schedule = section.schedule
    return switchboard.add(
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


def put_on_by_words(switchboard: FaultSwitchboard, text: str) -> str:
    """Carry out an option ``--fault``: switch on the fault with that name, or add a fault with parameters.

    Args:
        switchboard: the faults of the simulation.
        text: the name of a fault, such as ``slow meters``; or a fault profile with parameters, such as ``late`` or
            ``late:delay=2,units=1-3``.

    Returns:
        The name of the fault.

    Raises:
        ConfigError: there is no such fault and no such fault profile, or a parameter is invalid.
    """
    if any(one.label == text for one in switchboard.faults):
        switchboard.switch(text, on=True)
        return text
    section = parse_fault_words(text)
    return _put_on(switchboard, section, section.name)


MET_ON: Final = {
    frozenset({Carrier.TCP}): "Modbus TCP, TLS and UDP",
    frozenset({Carrier.SERIAL}): "RTU and ASCII, on a line or over a network",
    frozenset({Carrier.CONNECTION}): "connections over TCP or TLS",
}
"""For a fault that does not strike on all transports: the name of the transports on which it strikes."""


def why_it_never_strikes(status: FaultStatus, endpoints: Iterable[str], units: Collection[int]) -> str:
    """Return a sentence on why a fault cannot strike: no listener, or no unit, of the simulation fits it.

    Empty if a listener and a unit fit. Function codes, addresses, probability and schedule of the fault are not
    regarded: because of them the fault may never strike all the same.

    Args:
        status: the fault.
        endpoints: URLs of the listeners; if there are none, any listener fits.
        units: the units of the simulation. A fault for unit 0 (broadcasts) always fits.

    Raises:
        ConfigError: a URL is invalid.
    """
    carriers = status.carriers
    chosen = status.selection.units
    parsed = [parse_endpoint(one) for one in endpoints]
    if parsed and not any(carriers & carriers_of(one.framing, one.carrier) for one in parsed):
        return f"{status.fault_profile} strikes on {MET_ON[carriers]} only, and no listener is one of them"
    if chosen is not None and not {0, *units}.intersection(chosen):
        wanted = ", ".join(str(one) for one in sorted(chosen)[:8]) + (", …" if len(chosen) > 8 else "")
        there_are = ", ".join(str(one) for one in sorted(units)[:8]) + (", …" if len(units) > 8 else "")
        return f"no unit {wanted} is simulated; there {'is' if len(units) == 1 else 'are'} {there_are}"
    return ""


def fault_details(status: FaultStatus) -> str:
    """Return the parameters, filters and schedule of a fault as text, in words of ``--fault``: ``delay=2, from=14``.

    Left out are parameters without a value, filters and times that the fault does not have, and address ranges.
    """
    selection, schedule = status.selection, status.selection.schedule
    told: dict[str, object] = {name: value for name, value in status.parameters.items() if value is not None}
    told |= {
        key: _runs(numbers)
        for key, numbers in (("units", selection.units), ("functions", selection.functions))
        if numbers is not None
    }
    if selection.probability < 1:
        told["probability"] = selection.probability
    times = {"from": schedule.after, "for": schedule.lasts, "every": schedule.every, "skip": schedule.skip}
    told |= {key: value for key, value in times.items() if value or (key == "for" and value is not None)}
    if schedule.times is not None:
        told["times"] = schedule.times
    return ", ".join(f"{key}={_shown(value)}" for key, value in told.items())


def _runs(numbers: Collection[int]) -> str:
    """Return numbers as text, with consecutive numbers as a range: ``1-3+7`` for 1, 2, 3 and 7."""
    runs: list[list[int]] = []
    for one in sorted(numbers):
        if runs and one == runs[-1][1] + 1:
            runs[-1][1] = one
        else:
            runs.append([one, one])
    return "+".join(str(low) if low == high else f"{low}-{high}" for low, high in runs)


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
