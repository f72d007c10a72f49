"""Presets: named sets of options. ``strict`` meets every "must" of the specifications, which the defaults do not.

Knows names and values of options, and the clause that requires each; knows no component. The meaning of an option is
documented where it is declared.

1. A preset is chosen with ``preset="strict"``, or ``?preset=strict`` in a URL. It sets the options listed here that
   the scheme has, and leaves all others alone.
2. An option given beside the preset with another value is refused by name. Where a specification leaves the figure to
   the user it is *adaptable*: the preset supplies a default, and an explicit value replaces it.
3. Defaults that meet their clause already are listed too if an option could switch them off.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from ..errors import ConfigError
from ..framing.timing import Parity, stop_bits_for
from ..framing.word import Word
from .text import converted

OPTION: Final = "preset"
"""The name of the option that chooses a preset."""


class Preset(Word):
    """The presets. STANDARD: the defaults. STRICT: every "must" of the specifications."""

    STANDARD = "standard"
    STRICT = "strict"


@dataclass(frozen=True, slots=True)
class Setting:
    """One option of a preset.

    Attributes:
        clause: the clause of the specification that requires it.
        option: its name.
        value: the value it is set to; of an enum, the member's value.
        adaptable: whether another value may be given beside the preset.
    """

    clause: str
    option: str
    value: Any  # the type depends on the option
    adaptable: bool = False


_GUIDE_FIGURES: Final = (
    Setting("T19", "keepalive", True),
    Setting("T19", "no_delay", True),
    Setting("T19", "keepalive_idle", 7200, adaptable=True),
    Setting("T19", "keepalive_interval", 75, adaptable=True),
    Setting("T19", "keepalive_count", 8, adaptable=True),
    Setting("T19", "connect_timeout", 75.0, adaptable=True),
)

_LINE: Final = (
    Setting("S10", "strict_timing", True),
    Setting("S12", "character_timeout", 1.0, adaptable=True),
    Setting("S12", "upper_case_only", True),
    Setting("S14", "mark_errors", True),
)

STRICT_LINKS: Final = (
    Setting("T11", "single_adu_segments", True),
    Setting("T23", "scope", "client"),
    Setting("T25", "transaction_policy", "strict"),
    Setting("T25", "unit_policy", "strict"),
    *_GUIDE_FIGURES,
    *_LINE,
)
"""Settings of a client's link under the preset ``strict``."""

STRICT_LINE_LISTENERS: Final = _LINE
"""Settings of a listener on a serial line under the preset ``strict``."""

STRICT_TLS_LISTENERS: Final = (Setting("M3", "require_purpose", True),)
"""Settings of a ``tls://`` listener under the preset ``strict``."""

STRICT_SERVERS: Final = (
    Setting("T3", "standard_port", True, adaptable=True),
    Setting("T11", "single_adu_segments", True),
    Setting("T24", "unlisted", "silence"),
    Setting("T27", "scope", "server"),
    Setting("S17", "diagnostics_changes", True),
    *_GUIDE_FIGURES,
)
"""Settings of a server, for all its listeners, under the preset ``strict``."""


def preset_of(value: object) -> Preset:
    """The preset named by an option's value; None means the standard one. Raises `ConfigError`."""
    if value is None:
        return Preset.STANDARD
    if isinstance(value, Preset):
        return value
    try:
        return Preset(value)
    except ValueError:
        allowed = ", ".join(str(one.value) for one in Preset)
        raise ConfigError(f"must be one of {allowed}, not {value!r}", key=OPTION) from None


def with_preset(given: Mapping[str, object], strict: Iterable[Setting], *, takes: Container[str]) -> dict[str, object]:
    """Replace the option ``preset`` by the options that it sets.

    Args:
        given: options by name, with or without ``preset``.
        strict: the settings of ``strict`` for this component.
        takes: the options that the component has; the others are left out.

    Raises:
        ConfigError: there is no such preset, or an option contradicts it.
    """
    options = dict(given)
    if preset_of(options.pop(OPTION, None)) is Preset.STANDARD:
        return options
    for setting in (*strict, *_characters(options, takes)):
        if setting.option not in takes:
            continue
        if setting.option not in options:
            options[setting.option] = setting.value
        elif not setting.adaptable and not _agrees(options[setting.option], setting):
            raise ConfigError(
                f"does not go with the preset strict, which needs {_shown(setting.value)} ({setting.clause})",
                key=setting.option,
            )
    return options


def _characters(options: Mapping[str, object], takes: Container[str]) -> list[Setting]:
    """Character settings of a serial line: seven data bits in ASCII (recognised by ``upper_case_only``); stop bits.

    The required stop bits depend on the parity (Serial Line V1.02 §2.5.1), so they are set only where given.
    """
    found = [Setting("S12", "data_bits", 7)] if "upper_case_only" in takes else []
    if options.get("stop_bits") is not None:
        parity: Any = converted("parity", options.get("parity", Parity.EVEN), Parity)
        found.append(Setting("S7", "stop_bits", stop_bits_for(parity)))
    return found


def _agrees(given: object, setting: Setting) -> bool:
    """Whether a value, or its text, equals the value of the preset."""
    if isinstance(given, Enum):
        given = given.value
    return bool(converted(setting.option, given, type(setting.value)) == setting.value)


def _shown(value: object) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)
