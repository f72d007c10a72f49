"""Keys of sections ``[[fault]]`` in simulation files: which requests a fault strikes, and when it is active.

Knows the keys that all faults have. The parameters of one fault profile are declared where it is, in
`busway.faults.profiles`; a section passes them on unread, and `busway.apps.simulator.added_faults` has them checked.

An example is in `docs/simulator.md`.
"""

import math
import re
from typing import Annotated, Any, Final

from pydantic import BeforeValidator, Field, model_validator

from ...access.notation import NumberRange, merged, parse_items, parse_units, parse_whole_functions
from ...codes import Table
from ...errors import ConfigError
from ...options.declaration import Name, Range
from ...values.unfit_values import shown
from .key_lines import KeyPath
from .policy import NumbersField
from .section import NO_TABLE, FileProblems, Section, keys_of
from .toml_source import Source

_MOST_SECONDS: Final = 366 * 86_400.0
_OFFSETS: Final = re.compile(r"\s*[0-9]{1,4}\s*((\.\.|…|-)\s*[0-9]{1,5}\s*)?")
"""Matches a number or range of items without a table. One that begins with five digits is an address: ``40001``."""


def _as_parameter(value: object) -> object:
    if not isinstance(value, bool | int | float):
        raise ValueError(f"must be a number, true or false, not {shown(value)}")
    return value


ParameterValue = Annotated[
    bool | int | float, BeforeValidator(_as_parameter, json_schema_input_type=bool | int | float)
]


class ScheduleSection(Section):
    """``schedule``: when a fault is active, counted from the time it was switched on."""

    from_: Annotated[float, Range(0, _MOST_SECONDS), "seconds before it begins."] = Field(default=0.0, alias="from")
    for_: Annotated[float | None, Range(0, _MOST_SECONDS), "seconds that it lasts; None: for ever."] = Field(
        default=None, alias="for"
    )
    every: Annotated[
        float | None, Range(0, _MOST_SECONDS, above=True), "seconds after which it begins again; at least `for`."
    ] = None
    skip: Annotated[int, Range(0, math.inf), "requests that pass first."] = 0
    times: Annotated[int | None, Range(0, math.inf), "requests after which it ends; None: never."] = None

    @model_validator(mode="after")
    def _check(self) -> "ScheduleSection":
        if self.every is not None and (self.for_ is None or self.every < self.for_):
            raise FileProblems([(("every",), "must be at least as long as for, which it needs")])
        return self


class FaultSection(Section):
    """``[[fault]]``: one fault; keys that are left out match every request."""

    name: Annotated[str, "what it is switched by; left out: the fault profile."] = ""
    fault_profile: Annotated[str, Name("the name of a fault profile"), "what goes wrong."]
    units: Annotated[NumbersField | None, 'units, `"1-3"`; None: all.'] = None
    functions: Annotated[NumbersField | None, "codes and names of functions; None: all."] = None
    addresses: Annotated[
        NumbersField | None, 'items, `"4x101-4x110"`; a number without a table: the items of every table; None: all.'
    ] = None
    probability: Annotated[float, Range(0, 1), "the part of the requests that it strikes."] = 1.0
    schedule: Annotated[ScheduleSection, "when it is active, counted from the time it was switched on."] = (
        ScheduleSection()
    )
    on: Annotated[bool, "whether it is switched on at the start."] = True
    parameters: Annotated[dict[str, ParameterValue], "parameters of the fault profile."] = NO_TABLE

    @model_validator(mode="after")
    def _check(self) -> "FaultSection":
        faults: list[tuple[KeyPath, str]] = []
        for key in ("units", "functions", "addresses"):
            try:
                getattr(self, f"chosen_{key}")()
            except ConfigError as error:
                faults.append(((key,), error.message))
        if faults:
            raise FileProblems(faults)
        return self

    def chosen_units(self) -> frozenset[int] | None:
        """Return the units, 0…255, that the fault applies to; None for all."""
        return None if self.units is None else parse_units(self.units)

    def chosen_functions(self) -> frozenset[int] | None:
        """Return the function codes, 1…127, that the fault applies to; None for all."""
        return None if self.functions is None else parse_whole_functions(self.functions, "a fault")

    def chosen_addresses(self) -> dict[Table, tuple[NumberRange, ...]] | None:
        """Return the item ranges that the fault applies to, by table; None for all.

        Each range is its first item, 0-based, and the item after its last.
        """
        if self.addresses is None:
            return None
        found: dict[Table, list[NumberRange]] = {}
        for each in self.addresses:
            for part in each.split(",") if isinstance(each, str) else [each]:
                for table, ranges in _items(part).items():
                    found.setdefault(table, []).extend(ranges)
        return {table: merged(ranges) for table, ranges in found.items()}


def _items(part: str | int) -> dict[Table, tuple[NumberRange, ...]]:
    if isinstance(part, str) and not _OFFSETS.fullmatch(part):
        return parse_items(part, None)
    return {table: ranges for table in Table for _, ranges in parse_items(part, table).items()}


def parse_fault_words(text: str) -> FaultSection:
    """Parse the argument of ``--fault`` on the command line: ``late``, or ``late:delay=2,units=1-3,for=10``.

    Args:
        text: the fault profile; after a colon, keys of ``[[fault]]`` and its schedule, and parameters of the profile,
            each as ``NAME=VALUE``, separated by commas.

    Raises:
        ConfigError: a key or value is invalid; ``key`` of the error is that key. Whether the fault profile exists, and
            its parameters, are not checked.
    """
    fault_profile, _, rest = text.partition(":")
    section: dict[str, Any] = {"fault_profile": fault_profile.strip()}  # Any: values of several types
    for word in rest.split(",") if rest.strip() else []:
        key, sign, value = (each.strip() for each in word.partition("="))
        if not sign or not key:
            raise ConfigError(f"must be NAME=VALUE, not {word.strip()!r}", key=key or text)
        _put(section, key, value)
    return _checked(section, text)


def _put(section: dict[str, Any], key: str, value: str) -> None:
    keys = keys_of(FaultSection)
    if key in keys:
        section[key] = _plain(key, value) if {bool, float}.intersection(keys[key].kinds) else value
    elif key in keys_of(ScheduleSection):
        section.setdefault("schedule", {})[key] = _plain(key, value)
    elif f"{key}s" in keys:
        raise ConfigError(f"unknown key; is it {key}s?", key=key)
    else:
        section.setdefault("parameters", {})[key] = _plain(key, value)


def _plain(key: str, value: str) -> bool | int | float:
    words = {"true": True, "false": False, "yes": True, "no": False}
    if value.lower() in words:
        return words[value.lower()]
    for kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            pass
    raise ConfigError(f"must be a number, true or false, not {value!r}", key=key)


def _checked(section: dict[str, Any], text: str) -> FaultSection:
    class Words(Section):
        fault: FaultSection

    try:
        return Source(text, {"fault": section}, {}).checked(Words).fault
    except ConfigError as error:
        raise ConfigError(error.message, key=(error.key or text).removeprefix("fault.")) from None


__all__ = ["FaultSection", "ScheduleSection", "parse_fault_words"]
