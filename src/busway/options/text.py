"""Options given as text (URLs, command line) or as keywords, turned into the fields of a parameter class.

Knows the types that parameter classes use; knows no particular parameter. A type of its own is made by its ``parse``,
from a list of texts.
"""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Final, TypeVar, get_args, get_type_hints

from ..errors import ConfigError

Parameters = TypeVar("Parameters")

NONE = "none"
"""The text for no value, where an option may have none: files and URLs have no other word for it."""
ALIASES: Final = {"baudrate": "baud", "bytesize": "data_bits", "stopbits": "stop_bits"}
"""Other names of options: those that pyserial gave them, by which most programs know them."""
_OTHER_WORDS: Final = {"retry": "retries", "speed": "baud", "rate": "baud"}
"""Words for an option that are too far from its name to be taken for a slip of the pen."""
_WORDS_FOR_UNIT: Final = frozenset({"unit", "unit_id", "slave", "slave_id", "device_id", "station"})
_NEAR: Final = 0.75
"""How alike a name and an option are, of 1, for the option to be what was meant."""
_TRUE = frozenset({"1", "true", "yes", "on"})
_FALSE = frozenset({"0", "false", "no", "off"})


def option_names(kind: type[Any]) -> tuple[str, ...]:  # any parameter class, which share no base
    """The options that a parameter class takes."""
    return tuple(field.name for field in fields(kind))


def canonical(options: Mapping[str, object]) -> dict[str, object]:
    """Options by their own names, where some stand under another (`ALIASES`).

    Raises:
        ConfigError: one stands there under both of its names.
    """
    found: dict[str, object] = {}
    for given, value in options.items():
        name = ALIASES.get(given, given)
        if name in found:
            raise ConfigError(f"is another name of {name}, which is given too", key=given if given != name else name)
        found[name] = value
    return found


def unknown_option(name: str, known: Iterable[str], *, of: str = "") -> ConfigError:
    """The error for an option that a component does not have: with the one that may be meant, else with all there are.

    Args:
        name: the option.
        known: those that the component has.
        of: what has them, if it needs a name.
    """
    from difflib import get_close_matches  # here: it is needed for this sentence alone

    there = sorted(known)
    near = get_close_matches(name.lower(), there, 1, _NEAR)
    other = _OTHER_WORDS.get(name)
    if near or other in there:
        hint = f"is it {near[0] if near else other}?"
    elif name in _WORDS_FOR_UNIT:
        hint = "a unit is named where it is asked: link.unit(1)"
    else:
        hint = f"there are {', '.join(there) or 'none'}"
    return ConfigError(f"unknown option{of and f' of {of}'}; {hint}", key=name)


def build_parameters(kind: type[Parameters], options: Mapping[str, object]) -> Parameters:
    """An instance of the frozen dataclass ``kind`` from values or their texts. Raises `ConfigError` with the key.

    An option that ``kind`` does not have is an error that lists those it has.
    """
    hints = get_type_hints(kind)
    known = option_names(kind)
    values: dict[str, object] = {}
    for name, value in options.items():
        if name not in known:
            raise unknown_option(name, known)
        values[name] = converted(name, value, hints[name])
    return kind(**values)


def converted(name: str, value: object, wanted: Any) -> object:  # a type, or a union of types
    """A value, or its text, as the type that an option has. Raises `ConfigError` with the option as its key."""
    kinds = get_args(wanted) if isinstance(wanted, UnionType) else (wanted,)
    if NoneType in kinds and (value is None or value == NONE):
        return None
    problems = []
    for kind in kinds:
        if kind is not NoneType:
            try:
                return _of_kind(name, value, kind)
            except ConfigError as error:
                problems.append(error)
    if len(problems) == 1:
        raise problems[0]
    raise ConfigError(f"must be {' or '.join(_words(one) for one in kinds)}, not {value!r}", key=name)


def _of_kind(name: str, value: object, kind: Any) -> object:  # a type
    if isinstance(value, kind) and not (isinstance(value, bool) and kind is not bool):
        return value
    if isinstance(kind, type) and issubclass(kind, Enum):
        try:
            return kind(value)
        except ValueError:
            allowed = ", ".join(str(one.value) for one in kind)
            raise ConfigError(f"must be one of {allowed}, not {value!r}", key=name) from None
    if hasattr(kind, "parse"):
        return _parsed(name, value, kind)
    if isinstance(value, str) and kind is not str:
        return _from_text(name, value, kind)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    raise ConfigError(f"must be {_words(kind)}, not {value!r}", key=name)


def _parsed(name: str, value: object, kind: Any) -> object:  # a class with ``parse``, which shares no base
    """A list of texts, or one text with commas between them, for a class that is made of such a list."""
    texts = [one.strip() for one in value.split(",") if one.strip()] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(one, str) for one in texts):
        raise ConfigError(f"must be a list of texts, not {value!r}", key=name)
    try:
        return kind.parse(texts)
    except ConfigError as error:
        raise ConfigError(error.message, key=name) from error


def _from_text(name: str, text: str, kind: type) -> object:
    try:
        if kind is bool:
            if text.lower() in _TRUE | _FALSE:
                return text.lower() in _TRUE
        elif kind is int:
            return int(text)
        elif kind is float:
            return float(text)
    except ValueError:
        pass
    raise ConfigError(f"must be {_words(kind)}, not {text!r}", key=name)


def _words(kind: type) -> str:
    if issubclass(kind, Enum):
        return " or ".join(str(one.value) for one in kind)
    return {bool: "on or off", int: "a whole number", float: "a number", str: "a text"}.get(kind, kind.__name__)
