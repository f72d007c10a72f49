"""How an option is declared: as one annotated field of a parameter class, from which everything else is derived.

Knows types, ranges and texts; knows no particular option. ::

    @dataclass(frozen=True, slots=True)
    class ClientParameters:
        timeout: Annotated[float, Range(0.001, 3600), "seconds from the last byte of a request …"] = 1.0

        def __post_init__(self) -> None:
            check(self)

1. The text is the option's help. The other annotations are the marks of this file; all of them may be left out.
2. The value of an option is checked when its parameter object is created, so an object with an invalid value never
   exists.
3. URLs, keywords, keys of files, JSON Schema, help and the tables of the documentation use `declared`.
4. Keys that only files have are fields of their section with the same marks (`busway.config.files.section`).
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from enum import Enum
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Literal, Union, get_args, get_origin, get_type_hints

from ..errors import ConfigError
from ..values.unfit_values import shown

REQUIRED: Final = object()
"""The default of an option that has none, and so must be given."""
NONE: Final = "none"
"""The text that means None for an option that may be None, in files and URLs."""


@dataclass(frozen=True, slots=True)
class Range:
    """Mark of an option that is a number: the range that it must lie in. An end may be infinite.

    Attributes:
        low, high: the ends, which belong to the range, except for ``low`` if ``above``.
        unit: unit of the numbers, for messages.
        words: text that replaces the ends in messages; empty for none.
    """

    low: float
    high: float
    unit: str = ""
    words: str = ""
    above: bool = False
    """Whether ``low`` itself is out of the range: if True, values must be greater than ``low``."""

    def has(self, value: object) -> bool:
        """Whether a value is a number in the range; a bool counts as 0 or 1, and NaN is in no range."""
        if not isinstance(value, int | float):
            return False
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        if not self.words and math.isinf(self.high):
            return f"{'above' if self.above else 'at least'} {_number(self.low)}"
        return self.words or f"{_number(self.low)}…{_number(self.high)}{self.unit and f' {self.unit}'}"


@dataclass(frozen=True, slots=True)
class OneOf:
    """Mark of an option that is a number: the numbers that are allowed."""

    values: tuple[int, ...]

    def has(self, value: object) -> bool:
        """Whether a value is one of the numbers."""
        return value in self.values

    def __str__(self) -> str:
        return " or ".join(map(str, self.values))


@dataclass(frozen=True, slots=True)
class Name:
    """Mark of an option that is a text or list and must not be empty, such as the name of a user.

    Attributes:
        words: what the text is, for errors: ``the name of a link``.
        pattern: a regular expression that the whole text must match; empty for any text.
    """

    words: str
    pattern: str = ""

    def has(self, value: object) -> bool:
        """Whether a value is not empty and, if there is a pattern, is a text that matches it."""
        return bool(value) and (not self.pattern or re.fullmatch(self.pattern, str(value)) is not None)

    def __str__(self) -> str:
        return self.words


@dataclass(frozen=True, slots=True)
class Strict:
    """Mark of an option: what the preset ``strict`` sets it to, and the clause that requires this.

    Attributes:
        clause: number of the clause in the conformance statement: ``T19``.
        value: what the preset sets; for an enum, the member's value.
        adaptable: whether another value may be given beside the preset.
    """

    clause: str
    value: Any  # the type depends on the option
    adaptable: bool = False


@dataclass(frozen=True, slots=True)
class ByFraming:
    """Mark of an option whose default depends on the framing of the endpoint.

    Attributes:
        defaults: the default by framing: ``mbap``, ``rtu``, ``ascii``.
    """

    defaults: Mapping[str, Any]  # the type depends on the option


class On:
    """Mark of an option that says where it has an effect, by role, framing and transport.

    ``On("client", "server rtu")``: for every client, and for servers with RTU. Roles are ``client``, ``server`` and
    ``monitor``, which only listens to a line.

    Args:
        places: one text for each case: words separated by spaces, all of which must fit.
    """

    __slots__ = ("_places",)

    def __init__(self, *places: str) -> None:
        self._places = tuple(frozenset(place.split()) for place in places)

    def fits(self, role: str, framing: str, carrier: str) -> bool:
        """Whether the option has an effect for a role at an endpoint with this framing and transport."""
        return any(place <= {role, framing, carrier} for place in self._places)

    def fits_role(self, role: str) -> bool:
        """Whether the option has an effect for a role at some endpoint."""
        return any(not place & (ROLES - {role}) for place in self._places)


ROLES: Final = frozenset({"client", "server", "monitor"})


@dataclass(frozen=True, slots=True)
class Alias:
    """Mark of an option: another name that users may give it."""

    name: str


@dataclass(frozen=True, slots=True)
class Numbers:
    """Type of options that are lists of numbers, ranges and words, kept as written in a file.

    They are written ``5``, ``"1-10"`` or ``[1, "7-9"]``.

    Attributes:
        written: the value as the file has it.
        written_as: type of ``written``.
    """

    written_as: ClassVar[Any] = int | str | list[int | str]
    written: int | str | list[int | str]


class Mark(Enum):
    """Marks of an option that have no value.

    Attributes:
        PER_CALL: each user of a shared link may choose another value. An option without the mark has one value for the
            connection.
        FILE: the text is the path of a file.
    """

    PER_CALL = "per call"
    FILE = "file"


@dataclass(frozen=True, slots=True)
class Option:
    """One declared option: its name, type, range, default and help.

    Attributes:
        name: its name, in URLs, keywords and files.
        kinds: the types of its values; `NoneType` is not among them.
        is_optional: whether it may be None.
        default: its default, `REQUIRED` if it has none; framings in ``by_framing`` have the default given there.
        help: what it means, in a sentence.
        limits: which values of the type are allowed; None for all.
        strict: the value that the preset ``strict`` sets, with its clause; None if the preset does not set it.
        by_framing: its defaults by framing.
        on: where it has an effect: at endpoints and in roles that fit all of these; everywhere if empty.
        aliases: its other names.
        marks: its further marks (`Mark`).
    """

    name: str
    kinds: tuple[Any, ...]  # types
    is_optional: bool
    default: Any  # of one of its types
    help: str
    limits: Range | OneOf | Name | None
    strict: Strict | None
    by_framing: Mapping[str, Any]
    on: tuple[On, ...]
    aliases: tuple[str, ...]
    marks: frozenset[Mark]

    @property
    def is_in_seconds(self) -> bool:
        """Whether the option is a time in seconds: True if its help or its range contains the word ``seconds``."""
        return "seconds" in f"{self.help} {self.limits}"

    @property
    def choices(self) -> tuple[Any, ...]:
        """The fixed values of the option: literals among its types, and the values of enums' members; empty if none."""
        words = (get_args(kind) if get_origin(kind) is Literal else _members(kind) for kind in self.kinds)
        return tuple(word for each in words for word in each)

    @property
    def expected(self) -> str:
        """Which values the option may have, in words for error messages."""
        numbers = str(self.limits) if self.limits is not None else ""
        words = list(map(str, self.choices))
        if numbers:
            return f"{numbers}, {' or '.join(words)}" if words else numbers
        return " or ".join(words) if len(words) == 2 else f"one of {', '.join(words)}"

    @property
    def values(self) -> str:
        """The possible values as text, for tables and help: a range, fixed values, or else the kind of value."""
        words = [str(self.limits)] if isinstance(self.limits, Range | OneOf) else []
        words += [f"`{one}`" for one in self.choices]
        words = words or list(dict.fromkeys(_kind_words(kind) for kind in self.kinds))
        return ", or ".join([", ".join(words)] + ["none"] * self.is_optional)

    @property
    def default_text(self) -> str:
        """The default as text; where framings differ, each with its framings: ``3 (TCP, TLS, UDP); 1 (RTU, ASCII)``."""
        if not self.by_framing:
            return _shown(self.default)
        names: dict[str, list[str]] = {}
        for framing, default in self.by_framing.items():
            names.setdefault(_shown(default), []).append({"mbap": "TCP, TLS, UDP"}.get(framing, framing.upper()))
        return "; ".join(f"{text} ({', '.join(framings)})" for text, framings in names.items())

    def has_effect(self, role: str, framing: str, carrier: str) -> bool:
        """Whether the option has an effect for a role at an endpoint; True for an option without `On`.

        Args:
            role: ``client``, ``server`` or ``monitor``.
            framing: ``mbap``, ``rtu`` or ``ascii``.
            carrier: ``tcp``, ``tls``, ``udp`` or ``serial``.
        """
        return all(on.fits(role, framing, carrier) for on in self.on)

    def check(self, value: object) -> None:
        """Raise `ConfigError` if a value is out of range or not one of the allowed values; its type is not checked.

        None is valid if the option may be None or has None as its default. A member of an enum is always accepted if
        the option has fixed values. The error has the option's name as key.
        """
        if (value is None and (self.is_optional or self.default is None)) or (self.limits is None and not self.choices):
            return
        if self.choices and (isinstance(value, Enum) or value in self.choices):
            return
        if self.limits is None or not self.limits.has(value):
            said = _number(value) if isinstance(value, int | float) else shown(value)
            raise ConfigError(f"must be {self.expected}, not {said}", key=self.name)

    def check_number(self, value: object) -> None:
        """Raise `ConfigError` if a value is a number that is out of range; other values are not checked."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            self.check(value)


def declared(kind: type[Any]) -> Mapping[str, Option]:  # Any: parameter classes share no base
    """Return the options that a parameter class declares, by name, in the order of the declaration.

    The mapping is the same object for each call, and cannot be changed.
    """
    found = _DECLARED.get(kind)
    if found is None:
        found = _DECLARED[kind] = _declared(kind)
    return found


_DECLARED: Final[dict[type[Any], Mapping[str, Option]]] = {}


def _declared(kind: type[Any]) -> Mapping[str, Option]:
    hints = get_type_hints(kind, include_extras=True)
    on = getattr(kind, "on", None)
    found = {}
    for field in fields(kind):
        default = field.default if field.default_factory is MISSING else field.default_factory()
        default = REQUIRED if default is MISSING else default
        found[field.name] = option_of(field.name, hints[field.name], default, () if on is None else (on,))
    return MappingProxyType(found)


def check(parameters: Any) -> None:
    """Check every option of a parameter object by `Option.check`; called by the ``__post_init__`` of its class.

    Raises:
        ConfigError: an option has an invalid value; the error is about the first one and has its name as key.
    """
    for name, option in declared(type(parameters)).items():
        option.check(getattr(parameters, name))


def option_of(name: str, hint: Any, default: object, on: tuple[On, ...] = ()) -> Option:  # hint: a type as annotated
    """Return the option that an annotated field declares.

    Args:
        name: name of the field.
        hint: its type, with the marks of this file.
        default: its default; `REQUIRED` for none.
        on: marks of where all options of its class have an effect; empty for everywhere.
    """
    marks: tuple[Any, ...] = ()
    if get_origin(hint) is Annotated:
        hint, *rest = get_args(hint)
        marks = tuple(rest)
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return Option(
        name,
        tuple(get_args(kind)[0] if get_origin(kind) is Annotated else kind for kind in kinds if kind is not NoneType),
        NoneType in kinds,
        default,
        help=" ".join(mark for mark in marks if isinstance(mark, str)),
        limits=next((mark for mark in marks if isinstance(mark, Range | OneOf | Name)), None),
        strict=next((mark for mark in marks if isinstance(mark, Strict)), None),
        by_framing=next((mark.defaults for mark in marks if isinstance(mark, ByFraming)), MappingProxyType({})),
        on=(*on, *(mark for mark in marks if isinstance(mark, On))),
        aliases=tuple(mark.name for mark in marks if isinstance(mark, Alias)),
        marks=frozenset(mark for mark in marks if isinstance(mark, Mark)),
    )


def _shown(default: object) -> str:
    if default is REQUIRED:
        return "must be there"
    if isinstance(default, str) and not isinstance(default, Enum):
        return f"`{default}`" if default else "none"
    if default is None or (not isinstance(default, int | float) and hasattr(default, "__len__") and not len(default)):
        return "none"
    if isinstance(default, tuple | list):
        return f"`{list(default)}`".replace("'", '"')
    if isinstance(default, bool):
        return str(default).lower()
    if isinstance(default, Enum):
        return f"`{default.value}`"
    if isinstance(default, float):
        return f"{default:g}"
    return str(default) if isinstance(default, int) else "its defaults"


def _members(kind: Any) -> tuple[Any, ...]:  # a type, and the values of its members
    return tuple(one.value for one in kind) if isinstance(kind, type) and issubclass(kind, Enum) else ()


_KIND_WORDS: Final = {bool: "`true`, `false`", int: "a whole number", float: "a number", str: "a text", bytes: "a text"}


def _kind_words(kind: Any) -> str:  # a type
    """Return how the documentation's tables of options name a type: ``a whole number``, ``a list``, ``a table``."""
    if kind in _KIND_WORDS:
        return _KIND_WORDS[kind]
    origin = get_origin(kind) or kind
    if hasattr(origin, "written_as"):
        return ", ".join(_kind_words(one) for one in get_args(origin.written_as))
    if hasattr(origin, "parse") or origin in (list, tuple, Sequence):
        return "a list"
    return "any" if kind is Any else "a table"


def _number(value: float) -> str:
    return f"{value:g}" if isinstance(value, float) and not value.is_integer() else f"{value:.0f}"
