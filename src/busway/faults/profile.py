"""The class of fault profiles (named ways in which real devices misbehave), and the check of their parameters.

Knows the description of a profile and how to create its fault; knows no connection.

1. A name means the same in tests, in the simulator, in the command line and in the documentation; the
   documentation's table is generated from these objects.
2. A table is immutable; `FaultProfileTable.with_fault_profiles` creates a larger one.
3. A parameter is declared once, in the signature of the function that creates the fault (`profiles`), with the marks of
   `busway.options.declaration`. Checks, documentation and the HTTP API are derived from it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from inspect import signature
from typing import Any, Final

from ..errors import ConfigError
from ..options.declaration import Option, Range, option_of
from ..values.unfit_values import shown
from .fault import EVERYWHERE, Carrier, Fault

_TYPE_WORDS: Final = {float: "a number", int: "a whole number", bool: "true or false"}
SECONDS: Final = Range(0, 86_400)
"""Range of parameters that are times: 0 seconds to a day."""


@dataclass(frozen=True, slots=True)
class FaultProfile:
    """A named way in which devices misbehave; called with parameters, it creates the fault.

    Attributes:
        name: name of the profile, as in the documentation.
        happens: what the device does, in words.
        seen_in: repositories and issues where such a device was reported.
        answer: the right reaction of a client, in words.
        make: function that creates the fault; its keyword arguments are the parameters, each with a default.
        carriers: the kinds of transport on which the fault can occur.
    """

    name: str
    happens: str
    seen_in: tuple[str, ...]
    answer: str
    make: Callable[..., Fault]
    carriers: frozenset[Carrier] = EVERYWHERE

    @property
    def options(self) -> Mapping[str, Any]:  # Any: a parameter has the type of its default
        """The default of each parameter of the profile, by name."""
        return {name: one.default for name, one in self.parameters.items()}

    @property
    def parameters(self) -> Mapping[str, Option]:
        """The declaration of each parameter of the profile (type, range, help), by name."""
        declared = signature(self.make).parameters.values()
        return {
            one.name: option_of(one.name, Any if one.annotation is one.empty else one.annotation, one.default)
            for one in declared
        }

    def __call__(self, **options: Any) -> Fault:  # Any: as `options` says
        """Create a fault of this profile; parameters that are left out have their defaults.

        Raises:
            ConfigError: a parameter is unknown, or its value has a wrong type or is out of range; has its name as key.
        """
        parameters = self.parameters
        for name, value in options.items():
            if name not in parameters:
                known = ", ".join(parameters) or "none"
                raise ConfigError(f"{self.name} has no such option; there are: {known}", key=name)
            _check(parameters[name], value)
        fault = self.make(**options)
        return Fault(self.name, fault.admits, fault.asked, fault.answered, fault.closes_at, self.carriers, options)


def _check(option: Option, value: object) -> None:
    """Raise `ConfigError`, with the parameter's name as key, for a value of a wrong type or out of range."""
    kinds = tuple(kind for kind in option.kinds if kind in _TYPE_WORDS)
    if not kinds or (value is None and option.is_optional):  # without a declared type any value is accepted
        return
    fits = isinstance(value, kinds) or (float in kinds and isinstance(value, int))
    if not fits or (isinstance(value, bool) and bool not in kinds):
        raise ConfigError(f"must be {_TYPE_WORDS[kinds[0]]}, not {shown(value)}", key=option.name)
    option.check(value)


class FaultProfileTable(Mapping[str, FaultProfile]):
    """An immutable table of fault profiles by name, in the order of the documentation.

    Raises:
        ConfigError: two profiles have the same name.
    """

    __slots__ = ("_by_name",)

    def __init__(self, *fault_profiles: FaultProfile) -> None:
        self._by_name: dict[str, FaultProfile] = {}
        for one in fault_profiles:
            if one.name in self._by_name:
                raise ConfigError(f"there are two fault profiles {one.name}", key=one.name)
            self._by_name[one.name] = one

    def with_fault_profiles(self, *fault_profiles: FaultProfile) -> "FaultProfileTable":
        """Return a new table with the profiles of this one and more. Raises `ConfigError` if a name is taken."""
        return FaultProfileTable(*self.values(), *fault_profiles)

    def named(self, name: str) -> FaultProfile:
        """Return the fault profile with this name. Raises `ConfigError`, which lists the names, if there is none."""
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


__all__ = ["Carrier", "FaultProfile", "FaultProfileTable"]
