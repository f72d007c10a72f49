"""Profiles: named sets of options. ``strict`` meets every must of the documents, where a default of ours does not.

Knows names and values of options, and the clause each stands for; knows no component. What an option means is known
where it is declared.

1. A profile is chosen with ``profile="strict"``, or ``?profile=strict`` in a URL. It sets what is listed here, of what
   the scheme has; everything else stays as it is.
2. An option that is given beside the profile and says something else is refused by name. Where a document leaves the
   figure to the user it is *adaptable*: the profile proposes it, and whoever gives another gets the other.
3. Defaults that meet their clause already are listed too, where an option could switch them off.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

from ..errors import ConfigError
from ..framing.timing import Parity, stop_bits_for
from ..framing.word import Word
from .text import converted

OPTION: Final = "profile"
"""The name of the option that chooses one."""


class Profile(Word):
    """The profiles there are. STANDARD: the defaults. STRICT: every must of the documents."""

    STANDARD = "standard"
    STRICT = "strict"


@dataclass(frozen=True, slots=True)
class Setting:
    """One option of a profile.

    Attributes:
        clause: the clause that asks for it.
        option: its name.
        value: what it is set to; of an enum, the member's value.
        adaptable: whether another value may be given beside the profile.
    """

    clause: str
    option: str
    value: Any  # of whatever type the option has
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
"""What a client's link is set to."""

STRICT_LINE_LISTENERS: Final = _LINE
"""What the URL of a listener on a line is set to."""

STRICT_TLS_LISTENERS: Final = (Setting("M3", "require_purpose", True),)
"""What the URL of a ``tls://`` listener is set to."""

STRICT_SERVERS: Final = (
    Setting("T3", "standard_port", True, adaptable=True),
    Setting("T11", "single_adu_segments", True),
    Setting("T24", "unlisted", "silence"),
    Setting("T27", "scope", "server"),
    Setting("S17", "diagnostics_changes", True),
    *_GUIDE_FIGURES,
)
"""What a server is set to, all its listeners together."""


def profile_of(value: object) -> Profile:
    """The profile that an option names; None names the standard one. Raises `ConfigError`."""
    if value is None:
        return Profile.STANDARD
    if isinstance(value, Profile):
        return value
    try:
        return Profile(value)
    except ValueError:
        allowed = ", ".join(str(one.value) for one in Profile)
        raise ConfigError(f"must be one of {allowed}, not {value!r}", key=OPTION) from None


def with_profile(given: Mapping[str, object], strict: Iterable[Setting], *, takes: Container[str]) -> dict[str, object]:
    """Options without the profile, and with what it sets.

    Args:
        given: options by name, ``profile`` among them or not.
        strict: what the profile ``strict`` sets here.
        takes: the options that the component has; the others are left out.

    Raises:
        ConfigError: there is no such profile, or an option contradicts it.
    """
    options = dict(given)
    if profile_of(options.pop(OPTION, None)) is Profile.STANDARD:
        return options
    for setting in (*strict, *_characters(options, takes)):
        if setting.option not in takes:
            continue
        if setting.option not in options:
            options[setting.option] = setting.value
        elif not setting.adaptable and not _agrees(options[setting.option], setting):
            raise ConfigError(
                f"does not go with the profile strict, which needs {_shown(setting.value)} ({setting.clause})",
                key=setting.option,
            )
    return options


def _characters(options: Mapping[str, object], takes: Container[str]) -> list[Setting]:
    """The characters of a line: seven data bits in ASCII, which has ``upper_case_only``; stop bits by rule.

    The rule depends on the parity (Serial Line V1.02 §2.5.1), so stop bits are judged where they are given.
    """
    found = [Setting("S12", "data_bits", 7)] if "upper_case_only" in takes else []
    if options.get("stop_bits") is not None:
        parity: Any = converted("parity", options.get("parity", Parity.EVEN), Parity)
        found.append(Setting("S7", "stop_bits", stop_bits_for(parity)))
    return found


def _agrees(given: object, setting: Setting) -> bool:
    """Whether a value, or its text, is what the profile sets."""
    if isinstance(given, Enum):
        given = given.value
    return bool(converted(setting.option, given, type(setting.value)) == setting.value)


def _shown(value: object) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)
