"""Personalities: the ways in which real devices and clients misbehave, each under one name.

Knows what is said of one and how its fault is made; knows no conversation.

1. One name means the same thing in tests, in the simulator, in the options of the client and in the documentation; the
   documentation's table is made from these objects.
2. A table is immutable; a new one with more comes from `PersonalityTable.with_personalities`.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from ..errors import ConfigError
from .faults import Fault


class Carrier(Enum):
    """Where a personality is met."""

    TCP = "tcp"
    SERIAL = "serial"


@dataclass(frozen=True, slots=True)
class Personality:
    """One way to misbehave; calling it with its options makes its fault.

    Attributes:
        name: as the documentation has it.
        happens: what happens, in words.
        seen_in: where it was reported, repository and issue.
        answer: what a client (or server) that is up to it does.
        make: makes the fault; its keyword arguments are the options, each with a default.
        carriers: where it is met.
    """

    name: str
    happens: str
    seen_in: tuple[str, ...]
    answer: str
    make: Callable[..., Fault]
    carriers: frozenset[Carrier] = frozenset(Carrier)

    @property
    def options(self) -> Mapping[str, Any]:  # Any: an option has the type of its default
        """The options with their defaults."""
        return {name: one.default for name, one in inspect.signature(self.make).parameters.items()}

    def __call__(self, **options: Any) -> Fault:  # Any: as `options` says
        """The fault. Raises `ConfigError` for an option that there is not."""
        for name in options:
            if name not in self.options:
                known = ", ".join(self.options) or "none"
                raise ConfigError(f"{self.name} has no such option; there are: {known}", key=name)
        fault = self.make(**options)
        return Fault(self.name, fault.admits, fault.asked, fault.answered, fault.closes_at)


class PersonalityTable(Mapping[str, Personality]):
    """Personalities by name, in the order of the documentation. Raises `ConfigError` for two of one name."""

    __slots__ = ("_by_name",)

    def __init__(self, *personalities: Personality) -> None:
        self._by_name: dict[str, Personality] = {}
        for one in personalities:
            if one.name in self._by_name:
                raise ConfigError(f"there are two personalities {one.name}", key=one.name)
            self._by_name[one.name] = one

    def with_personalities(self, *personalities: Personality) -> "PersonalityTable":
        """A new table that also holds ``personalities``."""
        return PersonalityTable(*self.values(), *personalities)

    def named(self, name: str) -> Personality:
        """The personality of a name. Raises `ConfigError` that lists those there are."""
        found = self._by_name.get(name)
        if found is None:
            raise ConfigError(f"there is no personality {name!r}; there are {', '.join(self._by_name)}", key=name)
        return found

    def __getitem__(self, name: str) -> Personality:
        return self._by_name[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)
