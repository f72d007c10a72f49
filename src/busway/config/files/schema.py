"""Base of all file schemas, and the wording of their errors: which sentence a wrong key or value gets, at which line.

Knows pydantic and TOML texts; knows no particular file.

1. A file is read as a whole, and one error names everything that is wrong with it.
2. Unknown keys are refused; the sentence names the known ones.
3. Nothing is converted: a text is not a number, and a number with a fraction is not a whole number.
4. A key is one field of its section, annotated with the marks of `busway.options.declaration`: what it may be, and its
   help. Checks, JSON Schema, help and the tables of the documentation ask `keys_of`.
"""

import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import reduce
from inspect import get_annotations
from operator import or_
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, ClassVar, Final, Self, TypeVar, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import PydanticUndefined

from ...errors import ConfigError
from ...options.declaration import REQUIRED, Name, OneOf, Option, Range, option_of
from ...values.counts import counted
from ...values.unfit_values import shown
from .file_error import FileError
from .key_lines import KeyPath, key_lines, line_of


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


File = TypeVar("File", bound=Section)


@dataclass(frozen=True, slots=True)
class Source:
    """A parsed TOML file: its data, and the line of each key.

    Attributes:
        name: the file's name, for messages.
        data: its contents.
        lines: the line of each key, table and array element, 1-based, by path: ``("unit", 0, "point", 3, "type")``.
    """

    name: str
    data: Mapping[str, Any]  # what TOML has: any of its types
    lines: Mapping[KeyPath, int]

    def problem(self, path: KeyPath, sentence: str) -> ConfigError:
        """Return an error about a path of the file, with file name, line and key; it is not raised here.

        If the file does not have the path, the line is that of the nearest key or table around it; 1 if there is none.
        """
        standing = _standing(path, self.lines)
        return ConfigError(sentence, file=self.name, line=line_of(self.lines, standing), key=_written(standing))

    def checked(self, schema: type[File], *at: str | int) -> File:
        """Return the content of the file, or one part of it, as a checked object of a schema class.

        Args:
            schema: the class.
            at: keys and indexes that lead to the part, which must be there; none for the whole file.

        Raises:
            FileError: the content is invalid; has all problems, each with its line.
        """
        part: Any = self.data  # what TOML has
        for key in at:
            part = part[key]
        try:
            return schema.model_validate(part)
        except ValidationError as error:
            found = (self.problem((*at, *path), sentence) for path, sentence in faults_in(error, schema))
            raise FileError(in_order(found)) from None


def read_source(text: str, name: str) -> Source:
    """Parse a TOML text, and return its data with the line of each key. Raises `FileError` if it is no TOML."""
    try:
        return Source(name, tomllib.loads(text), key_lines(text))
    except tomllib.TOMLDecodeError as error:
        raise FileError([_syntax_problem(text, error, name)]) from error
    except (ValueError, RecursionError) as error:
        raise FileError([_exhausting_problem(text, error, name)]) from error


def with_unit(source: Source, unit: int | None) -> Source:
    """Return a copy of a file whose only ``[[unit]]`` gets the number ``unit``, if it has no key ``unit`` itself.

    Otherwise, and if ``unit`` is None, the file is returned unchanged. So a device file with one device can leave its
    number to the command line.
    """
    sections = source.data.get("unit")
    if unit is None or not isinstance(sections, list) or len(sections) != 1:
        return source
    (section,) = sections
    if not isinstance(section, dict) or "unit" in section:
        return source
    return replace(source, data={**source.data, "unit": [{"unit": unit, **section}]})


def parse_with_source(text: str, schema: type[File], name: str) -> tuple[File, Source]:
    """Parse a TOML text and check it by a schema class; returns the checked file, and the `Source` with its lines.

    Args:
        text: the file's text, in TOML.
        schema: the class that describes the file's sections and keys.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    source = read_source(text, name)
    return source.checked(schema), source


def parse_file(text: str, schema: type[File], name: str) -> File:
    """Parse a TOML text and check it by a schema class; returns the checked file.

    Args:
        text: the file's text, in TOML.
        schema: the class that describes the file's sections and keys.
        name: the file's name, for messages.

    Raises:
        FileError: the file is invalid; has all problems, each with file, line and key.
    """
    return parse_with_source(text, schema, name)[0]


def in_order(problems: Iterable[ConfigError]) -> list[ConfigError]:
    """Return problems of a file sorted by line, those without a line first; equal ones (line, key, message) once."""
    once = {(each.line, each.key, each.message): each for each in problems}
    return sorted(once.values(), key=lambda each: each.line or 0)


def _syntax_problem(text: str, error: tomllib.TOMLDecodeError, name: str) -> ConfigError:
    """Return the error for invalid TOML; ``tomllib`` gives the line in words: ``… (at line 3, column 5)``."""
    message = str(error)
    match = re.search(r" ?\(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    if match is None:
        return ConfigError(message, file=name, line=1)
    line = int(match[1]) if match[1] else max(1, len(text.rstrip("\n").split("\n")))
    place = f" (column {match[2]})" if match[2] else " (at the end of the file)"
    said = message[: match.start()]
    return ConfigError(f"{said[:1].lower()}{said[1:]}{place}", file=name, line=line)


def _exhausting_problem(text: str, error: Exception, name: str) -> ConfigError:
    """Return the error for a TOML text that the parser gives up on: nested too deeply, or with too long a number."""
    if isinstance(error, RecursionError):
        return ConfigError("it is nested too deeply", file=name, line=_densest_line(text))
    longest = _LONG_NUMBER.search(text)
    if longest is None:
        return ConfigError(f"it cannot be read: {error}", file=name, line=_densest_line(text))
    sentence = f"a whole number of {len(longest[0].replace('_', ''))} digits stands there; no value has so many"
    return ConfigError(sentence, file=name, line=1 + text.count("\n", 0, longest.start()))


_LONG_NUMBER = re.compile(r"(?<![\w.])[0-9][0-9_]{4299,}")
"""A number with more digits than Python converts (sys.get_int_max_str_digits)."""


def _densest_line(text: str) -> int:
    """Return the line that probably stops the parser: the one with most brackets, or else the longest."""
    lines = text.split("\n")
    return 1 + max(range(len(lines)), key=lambda at: (lines[at].count("[") + lines[at].count("{"), len(lines[at])))


def read_section(schema: type[File], data: object) -> File:
    """Check a part of a file by a section class that the caller has chosen by its contents, and return it.

    Raises:
        FileProblems: the part is invalid.
    """
    try:
        return schema.model_validate(data)
    except ValidationError as error:
        raise FileProblems(faults_in(error, schema)) from None


def faults_in(error: ValidationError, schema: type[Section]) -> list[tuple[KeyPath, str]]:
    """Return the problems in an error of pydantic: path in the section, and sentence, of each.

    A value that is none of several types is one problem; pydantic reports it once for each type.
    """
    found: list[tuple[KeyPath, str]] = []
    choices: dict[KeyPath, list[Any]] = {}
    for each in error.errors():
        path: KeyPath = tuple(each["loc"])
        if len(path) > 1 and _takes_several_types(schema, path[:-1]):
            choices.setdefault(path[:-1], []).append(each)
        else:
            found += faults_of(each, schema)
    for at, errors in choices.items():
        got = f", not {shown(errors[0]['input'])}"
        parts = [_sentence(each, schema, at).removesuffix(got) for each in errors]
        if "must be a number" in parts:  # which a whole number is too
            parts = [part for part in parts if part != "must be a whole number"]
        rest = [part.removeprefix("must be ") for part in parts[1:]]
        found.append((at, ", or ".join([parts[0], *rest]) + got))
    return found


def _takes_several_types(schema: type[Section], path: KeyPath) -> bool:
    """Whether the value at a path of a section may be of several types that pydantic tries one after the other.

    The last part of the path of its errors is then the name of a type, which is no key of the file.
    """
    hint: Any = schema  # a type as annotations have it
    for key in path:
        hint = _inner(hint, key)
    kinds = _kinds(hint)
    return len(kinds) > 1 and not any(isinstance(each, type) and issubclass(each, Section) for each in kinds)


def _inner(hint: Any, key: str | int) -> Any:  # types as annotations have them
    """Return the type of what a value of a type has at a key or index; None if that is not declared."""
    for kind in _kinds(hint):
        if isinstance(kind, type) and issubclass(kind, Section):
            field = next((one for name, one in kind.model_fields.items() if (one.alias or name) == key), None)
            return None if field is None else field.annotation
        arguments = get_args(kind)
        if arguments:
            return arguments[-1]  # of a list its elements, of a table its values
    return None


def _kinds(hint: Any) -> list[Any]:  # types as annotations have them
    """Return the types that an annotation names, without None and without their marks."""
    if get_origin(hint) is Annotated:
        return _kinds(get_args(hint)[0])
    if get_origin(hint) in (Union, UnionType):
        return [kind for each in get_args(hint) if each is not NoneType for kind in _kinds(each)]
    return [hint]


def faults_of(error: Any, schema: type[Section]) -> Iterator[tuple[KeyPath, str]]:
    """Yield the problems in one error of pydantic: path in the section, and sentence, of each.

    Args:
        error: an entry of ``ValidationError.errors()``, hence Any.
        schema: the class of the section.
    """
    path: KeyPath = tuple(error["loc"])
    raised = error.get("ctx", {}).get("error")
    if isinstance(raised, FileProblems):
        for inner, sentence in raised.faults:
            yield (*path, *inner), sentence
    else:
        yield path, _sentence(error, schema, path)


def _standing(path: KeyPath, lines: Mapping[KeyPath, int]) -> KeyPath:
    """Return the path under which the file has a value, for a path of the checked data.

    A key that takes one value or a list has an index in the path, but not in the file if one value is written there.
    """
    if path in lines:
        return path
    shorter = (path[:at] + path[at + 1 :] for at in reversed(range(len(path))))
    return next((each for each in shorter if each in lines and isinstance(path[-1], int)), path)


def _written(path: KeyPath) -> str | None:
    """Return the path of a key as text: ``unit[0].point[3].type``; None for an empty path."""
    text = ""
    for each in path:
        text += f"[{each}]" if isinstance(each, int) else f".{each}" if text else each
    return text or None


_WORDS = {
    "missing": "is missing",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "float_type": "must be a number",
    "string_type": "must be a text",
    "bool_type": "must be true or false",
    "finite_number": "must be a finite number",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "is_instance_of": "must be a list",  # the only class asked for is Sequence
    "sequence_str": "must be a list",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
}


def _sentence(error: Any, schema: type[Section], path: KeyPath) -> str:
    kind, details = error["type"], error.get("ctx", {})
    got = f", not {shown(error['input'])}"
    if kind == "extra_forbidden":
        return _unknown_key(str(path[-1]), _section_at(schema, path[:-1]))
    if kind in ("value_error", "assertion_error"):
        return str(details.get("error", error["msg"]))
    if kind == "literal_error":
        return f"must be {details['expected']}{got}"
    if kind in ("greater_than_equal", "less_than_equal", "greater_than", "less_than"):
        words = {"greater_than_equal": "ge", "less_than_equal": "le", "greater_than": "gt", "less_than": "lt"}[kind]
        signs = {"ge": "at least", "le": "at most", "gt": "above", "lt": "below"}
        return f"must be {signs[words]} {details[words]:g}{got}"
    if kind in ("too_short", "too_long"):
        bound, number = ("at least", "min_length") if kind == "too_short" else ("at most", "max_length")
        return f"must have {bound} {counted(details[number], 'element')}{got}"
    if kind == "missing":
        return _WORDS[kind]
    if kind in _WORDS:
        return _WORDS[kind] + got
    message = error["msg"]
    return f"{message[:1].lower()}{message[1:]}{got}"


def _unknown_key(key: str, section: type[Section] | None) -> str:
    if section is None:
        return "unknown key"
    if key == "collector":
        return "unknown key here; this is a collector file, which busway collect takes"
    known = list(keys_of(section))
    near = get_close_matches(key, known, 1, cutoff=0.75)  # at 0.6, the default, ``profile`` is like ``file``
    if near:
        return f"unknown key; is it {near[0]}?"
    only = "the only key allowed here is" if len(known) == 1 else "the keys allowed here are"
    return f"unknown key; {only} {', '.join(known)}"


def _section_at(schema: type[Section], path: KeyPath) -> type[Section] | None:
    """Return the schema class of the table at a path; None if a key of the path is unknown or has no schema class."""
    for key in path:
        if isinstance(key, int):
            continue
        field = schema.model_fields.get(key)
        inner = None if field is None else next(_sections_in(field.annotation), None)
        if inner is None:
            return None
        schema = inner
    return schema


def sections_of(schema: type[Section]) -> list[type[Section]]:
    """Return a section class and all section classes inside it, at any depth, each once; the class itself first."""
    found = [schema]
    for section in found:
        for field in section.model_fields.values():
            inner = (each for part in (field.annotation, *field.metadata) for each in _sections_in(part))
            found += [each for each in dict.fromkeys(inner) if each not in found]
    return found


def _sections_in(annotation: Any) -> Iterator[type[Section]]:
    """Yield the section classes in a type annotation: ``A`` and ``B`` for ``list[A | B]``."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    if isinstance(annotation, BeforeValidator):
        yield from _sections_in(annotation.json_schema_input_type)
    for each in get_args(annotation):
        yield from _sections_in(each)


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
