"""Presets: named sets of options. ``strict`` meets every "must" of the specifications, which the defaults do not.

``passive`` is for a client whose caller decides everything: no request is repeated, no unit suspended, no connection
recycled before 1000 timeouts, and the pause between attempts to connect is only 1 ms, or 10 ms for a serial port.

Knows how a preset and options go together; what ``strict`` sets an option to is declared with the option (`Strict`).

1. A preset is chosen with ``preset="strict"``, or ``?preset=strict`` in a URL. It sets the options that are declared
   with a value for it, as far as the scheme has them, and no others.
2. An option given beside the preset with another value is refused by name. Where a specification leaves the figure to
   the user it is *adaptable*: the preset supplies a default, and an explicit value replaces it.
3. All options that ``passive`` sets are adaptable. It is refused where there are no options of a link, so by every
   server.
4. An option whose default meets its clause is declared with that value too, if users could choose another one.
"""

from collections.abc import Mapping
from enum import Enum
from typing import Any, Final

from ..errors import ConfigError
from ..framing.character_times import Parity, stop_bits_for
from ..values.caseless_enum import CaselessEnum
from .declaration import Option, Strict
from .text import converted

OPTION: Final = "preset"
"""The name of the option that chooses a preset."""


class Preset(CaselessEnum):
    """Values of the option ``preset``, which sets several options at once.

    Attributes:
        STANDARD: sets nothing; the defaults stay.
        STRICT: meets every "must" of the specifications.
        PASSIVE: clients only: no retries, no breaker, hardly a pause between attempts to connect (1 ms, or 10 ms for a
            serial port), no wait for a missing serial port, and connections recycled only after 1000 timeouts.
    """

    STANDARD = "standard"
    STRICT = "strict"
    PASSIVE = "passive"


_PASSIVE_PAUSE: Final = 0.001
"""Longest pause between two attempts of a passive link to connect over a network, in seconds."""
_PASSIVE_PORT_PAUSE: Final = 0.01
"""Longest pause between two attempts of a passive link to open a serial port, in seconds."""
PASSIVE_SETTINGS: Final[Mapping[str, object]] = {
    "retries": 0,
    "write_retries": 0,
    "open_after": 0,
    "port_wait": 0.0,
    "reopen_first": _PASSIVE_PORT_PAUSE,
    "reopen_most": _PASSIVE_PORT_PAUSE,
    "reconnect_first": _PASSIVE_PAUSE,
    "reconnect_most": _PASSIVE_PAUSE,
    "recycle_after_timeouts": 1000,
    "recycle_after_foreign": 1000,
    "max_connections": 10_000,
}
"""What the preset ``passive`` sets; options that an endpoint does not have are left out."""
_OF_LINKS: Final = "retries"
"""Name of an option that every link has, and no server."""


def preset_of(value: object) -> Preset:
    """Return the preset for a value of the option ``preset``; `Preset.STANDARD` for None.

    Raises:
        ConfigError: there is no such preset.
    """
    if value is None:
        return Preset.STANDARD
    if isinstance(value, Preset):
        return value
    try:
        return Preset(value)
    except ValueError:
        allowed = ", ".join(str(one.value) for one in Preset)
        raise ConfigError(f"must be one of {allowed}, not {value!r}", key=OPTION) from None


def with_preset(given: Mapping[str, object], options: Mapping[str, Option]) -> dict[str, object]:
    """Return a copy of options with ``preset`` replaced by the options that the preset sets; given ones stay unchanged.

    A given option keeps its value. With ``strict`` the value must equal that of the preset unless the option is
    adaptable; with ``passive`` any value is allowed.

    Args:
        given: values by name, with or without ``preset``.
        options: the options that the component has, by name; others that the preset could set are left out.

    Raises:
        ConfigError: there is no such preset; ``strict`` does not allow the value of an option, or the value cannot be
            converted; or the preset is ``passive`` and the component is no link.
    """
    values = dict(given)
    preset = preset_of(values.pop(OPTION, None))
    if preset is Preset.STANDARD:
        return values
    if preset is Preset.PASSIVE:
        if _OF_LINKS not in options:
            raise ConfigError("passive is a preset of clients; standard and strict are allowed here", key=OPTION)
        return {name: value for name, value in PASSIVE_SETTINGS.items() if name in options} | values
    for name, strict in (*strict_settings(options).items(), *_characters(values, options).items()):
        if name not in options:
            continue
        if name not in values:
            values[name] = strict.value
        elif not strict.adaptable and not _agrees(name, values[name], strict.value):
            raise ConfigError(
                f"does not go with the preset strict, which needs {_shown(strict.value)} ({strict.clause})", key=name
            )
    return values


def names_set_by(preset: object, options: Mapping[str, Option]) -> frozenset[str]:
    """Return the names of those options that a preset sets; none for an unknown preset, which `with_preset` refuses.

    Args:
        preset: value of the option ``preset``.
        options: the options that the component has, by name.
    """
    try:
        chosen = preset_of(preset)
    except ConfigError:
        return frozenset()
    if chosen is Preset.STANDARD:
        return frozenset()
    return frozenset(PASSIVE_SETTINGS if chosen is Preset.PASSIVE else strict_settings(options)) & frozenset(options)


def strict_settings(options: Mapping[str, Option]) -> dict[str, Strict]:
    """Return, by name, what the preset ``strict`` sets each of the options to; other options are left out."""
    return {name: option.strict for name, option in options.items() if option.strict is not None}


def _characters(given: Mapping[str, object], options: Mapping[str, Option]) -> dict[str, Strict]:
    """Return what ``strict`` sets for the characters of a serial line: data bits of ASCII, and stop bits.

    The required stop bits depend on the parity (Serial Line V1.02 §2.5.1). They are in the result only if the user
    gives stop bits, which must then agree; the default agrees always.
    """
    found = {"data_bits": Strict("S12", 7)} if "upper_case_only" in options else {}
    if given.get("stop_bits") is not None:
        parity: Any = converted("parity", given.get("parity", Parity.EVEN), Parity)
        found["stop_bits"] = Strict("S7", stop_bits_for(parity))
    return found


def _agrees(name: str, given: object, wanted: object) -> bool:
    """Whether a value that a user gave, as text or as it is, equals the value that the preset sets.

    Raises:
        ConfigError: the value cannot be converted to the type of the preset's value; the error has ``name`` as key.
    """
    if isinstance(given, Enum):
        given = given.value
    return bool(converted(name, given, type(wanted)) == wanted)


def _shown(value: object) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)
