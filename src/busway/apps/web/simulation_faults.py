"""Faults of a simulation as its HTTP API shows and changes them.

Knows the faults of a simulation (`PageFaults`) and the fault profiles that they are made of; knows no HTTP.
"""

from dataclasses import fields
from typing import Any

from ...errors import ConfigError
from ...faults.applied_faults import Schedule, Selection
from ...faults.profile import FaultProfile
from .messages import plain_value
from .simulation_messages import FaultAnswer, FaultyAnswer, NewFault, ParameterAnswer, plain_values
from .simulation_subject import PageFaults


def all_faults(switchboard: PageFaults) -> list[FaultAnswer]:
    """Return all faults that were added to a simulation, in the order in which they are applied."""
    return [_fault(one) for one in switchboard.list()]


def all_fault_profiles(switchboard: PageFaults) -> list[FaultyAnswer]:
    """Return all fault profiles from which faults can be created for a simulation."""
    return [_fault_profile(one) for one in switchboard.fault_profiles.values()]


def fault_named(switchboard: PageFaults, name: str) -> FaultAnswer:
    """Return the fault with this name. Raises `ConfigError` for an unknown name."""
    return _fault(switchboard.status(name))


def add_fault_to(switchboard: PageFaults, wanted: NewFault) -> FaultAnswer:
    """Add a fault to a simulation, and return it. Raises `ConfigError` for an invalid name, parameter or address."""
    name = switchboard.add(
        wanted.fault_profile,
        name=wanted.name,
        units=None if wanted.units is None else frozenset(wanted.units),
        functions=None if wanted.functions is None else frozenset(wanted.functions),
        addresses=_addresses(wanted.first, wanted.last),
        probability=wanted.probability,
        schedule=Schedule(**wanted.schedule.model_dump()),
        on=wanted.on,
        parameters=wanted.parameters,
    )
    return fault_named(switchboard, name)


# Inside.


def _fault(status: Any) -> FaultAnswer:
    return FaultAnswer(
        name=status.name,
        fault_profile=status.fault_profile,
        happens=status.happens,
        on=status.is_on,
        struck=status.struck,
        parameters=plain_values(status.parameters),
        selection=_selection(status.selection),
    )


def _addresses(first: int | None, last: int | None) -> range | None:
    if first is None and last is None:
        return None
    low, high = first or 0, 65535 if last is None else last
    if low > high:
        raise ConfigError(f"must be at least first, {low}, not {high}", key="last")
    return range(low, high + 1)


def _selection(selection: Selection) -> dict[str, Any]:  # Any: values of several types
    """Return the filters and the schedule of a fault as a JSON object; keys that have their default are left out."""
    shown: dict[str, Any] = {}
    if selection.units is not None:
        shown["units"] = sorted(selection.units)
    if selection.functions is not None:
        shown["functions"] = sorted(selection.functions)
    if selection.addresses is not None:
        shown["first"], shown["last"] = selection.addresses.start, selection.addresses.stop - 1
    items = getattr(selection, "items", None)
    if items:
        shown["items"] = {table.value: [list(one) for one in ranges] for table, ranges in items.items()}
    if selection.probability < 1:
        shown["probability"] = selection.probability
    usual = Schedule()
    for one in fields(Schedule):
        value = getattr(selection.schedule, one.name)
        if value != getattr(usual, one.name):
            shown[one.name] = value
    return shown


def _fault_profile(fault_profile: FaultProfile) -> FaultyAnswer:
    return FaultyAnswer(
        name=fault_profile.name,
        happens=fault_profile.happens,
        answer=fault_profile.answer,
        carriers=sorted(one.value for one in fault_profile.carriers),
        parameters=[
            ParameterAnswer(
                name=one.name,
                default=plain_value(one.default),
                kind="" if one.kinds == (Any,) else one.kinds[0].__name__,
                meaning=one.help,
                range=str(one.limits or ""),
            )
            for one in fault_profile.parameters.values()
        ],
    )
