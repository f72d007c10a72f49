"""Base class of the sections of all files: each field is a key, with its type, range and help.

Knows pydantic; knows no TOML text and no particular file. `error_wording` words what is wrong with a section.

1. Unknown keys are refused.
2. Nothing is converted: a text is not a number, and a number with a fraction is not a whole number.
3. A key is one field of its section, annotated with the marks of `busway.options.declaration`: what it may be, and its
   help. Checks, JSON Schema, help and the tables of the documentation ask `keys_of`.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from inspect import get_annotations
from operator import or_
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Self, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticUndefined

from ...errors import ConfigError
from ...options.declaration import REQUIRED, Name, OneOf, Option, Range, option_of
from .key_lines import KeyPath


def _describe(schema: dict[str, Any], section: "type[Section]") -> None:  # what JSON has
    """Add help and range of each declared key to ``schema``, the JSON Schema of a section, in place."""
    for name, option in keys_of(section).items():
        found = schema.get("properties", {}).get(name)
        if found is not None:
            found |= {"description": option.help} if option.help else {}
            found |= _json_limits(option)


def _json_limits(option: Option) -> dict[str, Any]:
    limits = option.limits
    if isinstance(limits, Range):
        low = {"exclusiveMinimum" if limits.above else "minimum": limits.low}
        ends = low | {"maximum": limits.high}
        return {name: end for name, end in ends.items() if math.isfinite(end)}
    if isinstance(limits, Name):
        is_text = str in option.kinds
        return {"pattern": f"^{limits.pattern}$"} if limits.pattern else {"minLength" if is_text else "minItems": 1}
    return {}


class Section(BaseModel):
    """Base class of the classes that describe a table in a file: each field is a key.

    Unknown keys and values of another type are refused, and objects are immutable.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid",
        strict=True,
        frozen=True,
        arbitrary_types_allowed=True,
        json_schema_extra=_describe,
        defer_build=True,  # a file needs the checks of its own sections, not those of every kind of file
    )

    def __init_subclass__(cls, **kwargs: Any) -> None:  # Any: as pydantic has it
        super().__init_subclass__(**kwargs)
        own = get_annotations(cls)
        for name, hint in own.items():
            if any(isinstance(mark, Range | OneOf | Name) for mark in getattr(hint, "__metadata__", ())):
                own[name] = Annotated[hint, AfterValidator(_limited(option_of(name, hint, None)))]
        cls.__annotations__ = own

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:  # Any: as pydantic has it
        return self  # it is frozen; pydantic would copy the defaults of a section for each section of a file


def _limited(option: Option) -> Callable[[object], object]:
    """Return a validator that raises `ValueError` for values outside the declared range of a key."""

    def checked(value: object) -> object:
        try:
            option.check(value)
        except ConfigError as error:
            raise ValueError(error.message) from None
        return value

    return checked


_KEYS: Final[dict[type[Section], Mapping[str, Option]]] = {}


def keys_of(section: type[Section]) -> Mapping[str, Option]:
    """Return the keys that a section class declares, by their name in the file, in the order of the declaration."""
    found = _KEYS.get(section)
    if found is None:
        options = (_option(field.alias or name, field) for name, field in section.model_fields.items())
        found = _KEYS[section] = MappingProxyType({option.name: option for option in options})
    return found


def _option(name: str, field: Any) -> Option:  # as pydantic has it
    """Return the declaration of a key as an option: name, type, range, default, help."""
    made = next((mark for mark in field.metadata if isinstance(mark, Option)), None)
    if made is not None:
        return made
    default = REQUIRED if field.is_required() else field.get_default(call_default_factory=True)
    return option_of(name, Annotated[_written_as(field.annotation, field.metadata), None, *field.metadata], default)


def _written_as(annotation: Any, marks: Sequence[Any]) -> Any:  # types as annotations have them
    """Return the type of a key's value as it is written in the file; a validator may turn it into another type."""
    for mark in marks:
        if isinstance(mark, BeforeValidator) and mark.json_schema_input_type is not PydanticUndefined:
            return _written_as(mark.json_schema_input_type, ())
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _written_as(inner[0], inner[1:])
    if origin in (Union, UnionType):
        return reduce(or_, (_written_as(each, ()) for each in inner if each is not NoneType))
    return annotation


NO_LIST: Final[Any] = Field(default_factory=list)
"""The default of a key that is a list: a new empty list for each object."""
NO_TABLE: Final[Any] = Field(default_factory=dict)
"""The default of a key that is a table of the user's own keys: a new empty table for each object."""


class FileProblems(ValueError):
    """Error raised by the check of a section, with all problems inside the section.

    pydantic reports an error of a whole section at the section; this error has the paths of the wrong keys.

    Attributes:
        faults: path in the section, and sentence, of each problem.
    """

    def __init__(self, faults: Sequence[tuple[KeyPath, str]]) -> None:
        super().__init__("; ".join(sentence for _, sentence in faults))
        self.faults: tuple[tuple[KeyPath, str], ...] = tuple(faults)


def sections_of(schema: type[Section]) -> list[type[Section]]:
    """Return a section class and all section classes inside it, at any depth, each once; the class itself first."""
    found = [schema]
    for section in found:
        for field in section.model_fields.values():
            inner = (each for part in (field.annotation, *field.metadata) for each in sections_in(part))
            found += [each for each in dict.fromkeys(inner) if each not in found]
    return found


def sections_in(annotation: Any) -> Iterator[type[Section]]:
    """Yield the section classes in a type annotation: ``A`` and ``B`` for ``list[A | B]``."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    if isinstance(annotation, BeforeValidator):
        yield from sections_in(annotation.json_schema_input_type)
    for each in get_args(annotation):
        yield from sections_in(each)


def json_schema(schema: type[Section], title: str) -> dict[str, Any]:  # Any: what JSON has
    """Return the JSON Schema (draft 2020-12) of a file, for editors and other programs.

    It has names, types and simple ranges; which keys go together is only checked when a file is read.
    """
    document = schema.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **_plain(document), "title": title}


def _plain(node: Any) -> Any:
    """Return a part of a JSON Schema without titles, which only repeat names, and without defaults None and ``{}``."""
    if isinstance(node, list):
        return [_plain(each) for each in node]
    if not isinstance(node, dict):
        return node
    kept = {}
    for key, value in node.items():
        if key == "properties" or key == "$defs":
            kept[key] = {name: _plain(each) for name, each in value.items()}
        elif not (key == "title" and isinstance(value, str)) and not (key == "default" and value in (None, {})):
            kept[key] = _plain(value)
    return kept
