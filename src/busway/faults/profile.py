"""Fault profiles: named ways in which real devices misbehave, and the options that each has.

Knows the description of a profile and how to make its fault; knows no connection.

1. A name means the same in tests, in the simulator, in the options of the client and in the documentation; the
   documentation's table is generated from these objects.
2. A table is immutable; `FaultProfileTable.with_fault_profiles` makes a larger one.
3. An option is declared once, in the signature of the function that makes the fault: type, default, and by `Says` its
   meaning and range. Checks, documentation and the HTTP API are derived from it.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import UnionType
from typing import Annotated, Any, get_args, get_origin

from ..errors import ConfigError
from ..values.refusal import shown
from .fault import EVERYWHERE, Carrier, Fault

LONGEST = 86_400.0
"""Seconds, the largest time in an option of a fault profile: a day."""


@dataclass(frozen=True, slots=True)
class Says:
    """Annotation of an option of a fault profile: says its meaning and range.

    Attributes:
        meaning: in words, with the unit of measure.
        least, most: the range, both included; None for no end.
    """

    meaning: str
    least: float | None = None
    most: float | None = None


def in_seconds(meaning: str) -> Says:
    """Return the annotation of an option that is a time of 0 s to a day; ``meaning`` follows the word seconds."""
    return Says(f"seconds {meaning}", 0.0, LONGEST)


_TYPE_WORDS = {float: "a number", int: "a whole number", bool: "true or false"}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One option of a fault profile with its type, default and range.

    Attributes:
        name, default: from the signature.
        kind: ``float``, ``int`` or ``bool``; None without a declared type, and then any value is accepted.
        is_optional: whether None is a valid value.
        says: meaning and range.
    """

    name: str
    default: Any  # of the declared type
    kind: type | None
    is_optional: bool
    says: Says

    @property
    def range_text(self) -> str:
        """The range of the option as text: ``0…86400``, ``at least 1``; empty without a range."""
        least, most = self.says.least, self.says.most
        if least is None:
            return ""
        return f"at least {least:g}" if most is None else f"{least:g}…{most:.6g}"

    def check(self, value: Any) -> None:  # Any: user input
        """Raise `ConfigError`, with the option's name as key, for a value of a wrong type or outside the range."""
        if self.kind is None or (value is None and self.is_optional):
            return
        fits = isinstance(value, self.kind) or (self.kind is float and isinstance(value, int))
        if not fits or (isinstance(value, bool) and self.kind is not bool):
            raise ConfigError(f"must be {_TYPE_WORDS[self.kind]}, not {shown(value)}", key=self.name)
        least, most = self.says.least, self.says.most
        # Asked so that what is no number at all (nan) is in no range.
        is_within = (least is None or value >= least) and (most is None or value <= most)
        if self.kind is not bool and not is_within:
            raise ConfigError(f"must be {self.range_text}, not {shown(value)}", key=self.name)


def _parameter(declared: inspect.Parameter) -> Parameter:
    annotation, says = declared.annotation, Says("")
    if get_origin(annotation) is Annotated:
        annotation, says = get_args(annotation)[0], annotation.__metadata__[0]
    kinds = get_args(annotation) if get_origin(annotation) is UnionType or isinstance(annotation, UnionType) else ()
    kind = next((one for one in kinds or (annotation,) if one in _TYPE_WORDS), None)
    return Parameter(declared.name, declared.default, kind, type(None) in kinds, says)


@dataclass(frozen=True, slots=True)
class FaultProfile:
    """A named way in which devices misbehave; called with its options it creates the fault.

    Attributes:
        name: as in the documentation.
        happens: what the device does, in words.
        seen_in: where it was reported, repository and issue.
        answer: how a client that copes with it reacts.
        make: makes the fault; its keyword arguments are the options, each with a default.
        carriers: where it can occur.
    """

    name: str
    happens: str
    seen_in: tuple[str, ...]
    answer: str
    make: Callable[..., Fault]
    carriers: frozenset[Carrier] = EVERYWHERE

    @property
    def options(self) -> Mapping[str, Any]:  # Any: an option has the type of its default
        """Return the options of the profile with their defaults."""
        return {name: one.default for name, one in self.parameters.items()}

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The declarations of the profile's options, by name."""
        return {name: _parameter(one) for name, one in inspect.signature(self.make).parameters.items()}

    def __call__(self, **options: Any) -> Fault:  # Any: as `options` says
        """Create the fault with these options. Raises `ConfigError` for an unknown option or an invalid value."""
        parameters = self.parameters
        for name, value in options.items():
            if name not in parameters:
                known = ", ".join(parameters) or "none"
                raise ConfigError(f"{self.name} has no such option; there are: {known}", key=name)
            parameters[name].check(value)
        fault = self.make(**options)
        return Fault(self.name, fault.admits, fault.asked, fault.answered, fault.closes_at, self.carriers, options)


class FaultProfileTable(Mapping[str, FaultProfile]):
    """A table of fault profiles by name, in the order of the documentation. Raises `ConfigError` for equal names."""

    __slots__ = ("_by_name",)

    def __init__(self, *fault_profiles: FaultProfile) -> None:
        self._by_name: dict[str, FaultProfile] = {}
        for one in fault_profiles:
            if one.name in self._by_name:
                raise ConfigError(f"there are two fault profiles {one.name}", key=one.name)
            self._by_name[one.name] = one

    def with_fault_profiles(self, *fault_profiles: FaultProfile) -> "FaultProfileTable":
        """Return a new table with further fault profiles."""
        return FaultProfileTable(*self.values(), *fault_profiles)

    def named(self, name: str) -> FaultProfile:
        """Return the fault profile with this name. Raises `ConfigError` that lists the known ones."""
        found = self._by_name.get(name)
        if found is None:
            raise ConfigError(f"there is no fault profile {name!r}; there are {', '.join(self._by_name)}", key=name)
        return found

    def __getitem__(self, name: str) -> FaultProfile:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)


__all__ = ["Carrier", "FaultProfile", "FaultProfileTable", "Parameter", "Says", "in_seconds"]
