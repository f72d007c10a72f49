"""Converts options given as text (URLs, command line) or keywords into fields of parameter classes.

Knows the types that parameter classes use; knows no particular option. If a type has a method ``parse``, that method
builds its values from a list of texts.
"""

from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any, Final, TypeVar, get_origin

from ..errors import ConfigError
from ..values.durations import duration
from ..values.similar_names import similar_name
from .declaration import NONE, Option, declared

Parameters = TypeVar("Parameters")

_OTHER_WORDS: Final = {"retry": "retries", "speed": "baud", "rate": "baud"}
"""Names that users try for an option and that are too different from its name to be recognised as typing errors."""
_WORDS_FOR_UNIT: Final = frozenset({"unit", "unit_id", "slave", "slave_id", "device_id", "station"})
_NO_ALIASES: Final[Mapping[str, str]] = {}
_NEAR: Final = 0.75
"""Similarity 0…1 of an unknown name and an option from which on the error suggests that option."""
_TRUE = frozenset({"1", "true", "yes", "on"})
_FALSE = frozenset({"0", "false", "no", "off"})


def unknown_option(
    name: str, known: Iterable[str], *, of: str = "", aliases: Mapping[str, str] = _NO_ALIASES
) -> ConfigError:
    """Return the error for an unknown option: it suggests a known option with a similar name, or else lists all.

    For a name such as ``unit`` or ``slave`` it says how a unit is chosen.

    Args:
        name: the unknown option; it becomes the key of the error.
        known: the names of the options that the component has.
        of: name of the component, if the message needs one.
        aliases: other names of options, each with the option's own name.
    """
    there = sorted(known)
    others = {word: option for word, option in {**_OTHER_WORDS, **aliases}.items() if option in there}
    similar = similar_name(name.lower(), [*there, *others], _NEAR)
    if similar is not None:
        hint = f"is it {others.get(similar, similar)}?"
    elif name in _WORDS_FOR_UNIT:
        hint = "a unit is named where it is asked: link.unit(1)"
    else:
        hint = f"there are {', '.join(there) or 'none'}"
    return ConfigError(f"unknown option{of and f' of {of}'}; {hint}", key=name)


def build_parameters(kind: type[Parameters], options: Mapping[str, object], *, framing: str = "") -> Parameters:
    """Build a parameter object of the class ``kind`` from values or their texts; defaults for the other options.

    Args:
        kind: a parameter class.
        options: the given options, by name.
        framing: framing of the endpoint, which some defaults depend on; empty for none.

    Raises:
        ConfigError: an option is invalid, or ``kind`` does not have it; the error has its name as key.
    """
    known = declared(kind)
    values = {name: one.by_framing[framing] for name, one in known.items() if framing in one.by_framing}
    for name, value in options.items():
        option = known.get(name)
        if option is None:
            raise unknown_option(name, known)
        values[name] = option_value(option, value)
    return kind(**values)


def option_value(option: Option, value: object) -> object:
    """Convert an option's value, or its text, to the option's type; the range is not checked.

    The text ``none`` means None if the option may be None. A text with a unit of time, such as ``10s``, is refused; the
    error gives the number of seconds to write instead.

    Raises:
        ConfigError: the value cannot be converted to the type; the error has the option's name as key.
    """
    if option.is_optional and (value is None or value == NONE):
        return None
    try:
        return _of_kinds(option.name, value, option.kinds)
    except ConfigError:
        seconds = duration(value) if isinstance(value, str) and option.is_in_seconds else None
        if seconds is None:
            raise
        raise ConfigError(f"is in seconds: {option.name}={seconds:g}", key=option.name) from None


def converted(name: str, value: object, kind: Any) -> object:  # a type
    """Convert the value of an option, or its text, to the type ``kind``.

    Raises:
        ConfigError: the value cannot be converted; the error has ``name`` as key.
    """
    return _of_kinds(name, value, (kind,))


def _of_kinds(name: str, value: object, kinds: tuple[Any, ...]) -> object:  # types
    problems = []
    for kind in kinds:
        try:
            return _of_kind(name, value, kind)
        except ConfigError as error:
            problems.append(error)
    if len(problems) == 1:
        raise problems[0]
    raise ConfigError(f"must be {' or '.join(_words(one) for one in kinds)}, not {value!r}", key=name)


def _of_kind(name: str, value: object, kind: Any) -> object:  # a type
    if get_origin(kind) is tuple:
        return _texts(name, value)
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
    if hasattr(kind, "written_as"):
        return kind(value)
    if kind is str and hasattr(value, "__fspath__"):
        return str(value.__fspath__())
    if isinstance(value, str) and kind is not str:
        return _from_text(name, value, kind)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    raise ConfigError(f"must be {_words(kind)}, not {value!r}", key=name)


def _parsed(name: str, value: object, kind: Any) -> object:  # a class with ``parse``, which shares no base
    """Build the value of an option by the ``parse`` method of the class ``kind``, which takes a tuple of texts.

    Raises `ConfigError` with ``name`` as key.
    """
    try:
        return kind.parse(_texts(name, value))
    except ConfigError as error:
        raise ConfigError(error.message, key=name) from error


def _texts(name: str, value: object) -> tuple[str, ...]:
    """Return the value of an option as a tuple of texts; a single text is split at commas, and empty parts dropped.

    Raises `ConfigError` if the value is neither a text nor a list or tuple of texts.
    """
    texts = [one.strip() for one in value.split(",") if one.strip()] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(one, str) for one in texts):
        raise ConfigError(f"must be a list of texts, not {value!r}", key=name)
    return tuple(texts)


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


def host_and_port(text: str, key: str, example: str = "127.0.0.1:9502") -> tuple[str, int]:
    """Split ``127.0.0.1:9502`` or ``[::1]:9502`` into host and port, 0…65535.

    Args:
        text: the address.
        key: name of the option with the address, for errors.
        example: an address that errors show.

    Raises:
        ConfigError: the text is no such address: its host or port is missing, an IPv6 address is not in brackets, or
            the port is above 65535.
    """
    host, colon, port = text.rpartition(":")
    is_bare = host.count(":") == 0 or (host.startswith("[") and host.endswith("]"))
    if not (colon and host.strip("[]") and is_bare and port.isascii() and port.isdigit()):
        raise ConfigError(f"an address such as {example} is needed, not {text!r}", key=key)
    if int(port) > 65_535:
        raise ConfigError(f"an address such as {example} is needed; a port is 0…65535, not {port}", key=key)
    return host.strip("[]"), int(port)
