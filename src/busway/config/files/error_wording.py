"""The wording of errors in files: which sentence a wrong key or value gets, with a hint such as "is it …?".

Knows the errors of pydantic and of ``tomllib``; reads no file, and knows no particular one.

1. The sentence about an unknown key names the key that was probably meant, or else the known ones.
2. A value that is none of several types is one problem.
"""

import re
import tomllib
from collections.abc import Iterator
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import ValidationError

from ...errors import ConfigError
from ...values.counts import counted
from ...values.similar_names import similar_name
from ...values.unfit_values import shown
from .key_lines import KeyPath
from .section import FileProblems, Section, keys_of, sections_in


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
            found += _faults_of(each, schema)
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


def _faults_of(error: Any, schema: type[Section]) -> Iterator[tuple[KeyPath, str]]:
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
_BOUNDS = {
    "greater_than_equal": ("at least", "ge"),
    "less_than_equal": ("at most", "le"),
    "greater_than": ("above", "gt"),
    "less_than": ("below", "lt"),
}
_LENGTHS = {"too_short": ("at least", "min_length"), "too_long": ("at most", "max_length")}
"""Of errors about a bound: its words, and the key of the bound in the context that pydantic gives."""


def _sentence(error: Any, schema: type[Section], path: KeyPath) -> str:
    kind, details = error["type"], error.get("ctx", {})
    got = f", not {shown(error['input'])}"
    if kind == "extra_forbidden":
        return _unknown_key(str(path[-1]), _section_at(schema, path[:-1]))
    if kind in ("value_error", "assertion_error"):
        return str(details.get("error", error["msg"]))
    if kind == "literal_error":
        return f"must be {details['expected']}{got}"
    if kind in _BOUNDS:
        words, number = _BOUNDS[kind]
        return f"must be {words} {details[number]:g}{got}"
    if kind in _LENGTHS:
        words, number = _LENGTHS[kind]
        return f"must have {words} {counted(details[number], 'element')}{got}"
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
    similar = similar_name(key, known, 0.75)  # at 0.6, the default, ``profile`` is like ``file``
    if similar is not None:
        return f"unknown key; is it {similar}?"
    only = "the only key allowed here is" if len(known) == 1 else "the keys allowed here are"
    return f"unknown key; {only} {', '.join(known)}"


def _section_at(schema: type[Section], path: KeyPath) -> type[Section] | None:
    """Return the schema class of the table at a path; None if a key of the path is unknown or has no schema class."""
    for key in path:
        if isinstance(key, int):
            continue
        field = schema.model_fields.get(key)
        inner = None if field is None else next(sections_in(field.annotation), None)
        if inner is None:
            return None
        schema = inner
    return schema


def syntax_problem(text: str, error: tomllib.TOMLDecodeError, name: str) -> ConfigError:
    """Return the error for invalid TOML; ``tomllib`` gives the line in words: ``… (at line 3, column 5)``."""
    message = str(error)
    match = re.search(r" ?\(at (?:line (\d+), column (\d+)|end of document)\)$", message)
    if match is None:
        return ConfigError(message, file=name, line=1)
    line = int(match[1]) if match[1] else max(1, len(text.rstrip("\n").split("\n")))
    place = f" (column {match[2]})" if match[2] else " (at the end of the file)"
    said = message[: match.start()]
    return ConfigError(f"{said[:1].lower()}{said[1:]}{place}", file=name, line=line)


def exhausting_problem(text: str, error: Exception, name: str) -> ConfigError:
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
