"""Which options a client, server or other part accepts, and the parameter objects built from given ones.

Knows the parameter classes; knows no component. An option that has no effect with the scheme of a URL is refused,
because users would believe that it works.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, TypeVar

from ..errors import ConfigError
from .client import ClientParameters, ManagementParameters
from .declaration import Option, declared
from .endpoints import Endpoint
from .lines import BreakerParameters, FramingParameters, SerialClientParameters
from .ports import OpeningParameters, SerialSettings
from .presets import OPTION, with_preset
from .server import ListenerParameters, ServerParameters, UnitParameters
from .sockets import SocketParameters
from .text import build_parameters, unknown_option
from .tls import TlsParameters

Parameters = TypeVar("Parameters")
Kinds = tuple[type[Any], ...]  # parameter classes, which share no base

LINKS: Final[Kinds] = (
    ClientParameters,
    SocketParameters,
    ManagementParameters,
    TlsParameters,
    SerialClientParameters,
    BreakerParameters,
    FramingParameters,
    SerialSettings,
    OpeningParameters,
)
"""Parameter classes with the options of links; which of them a link has depends on its scheme."""
LISTENERS: Final[Kinds] = (FramingParameters, SerialSettings, OpeningParameters, TlsParameters)
"""Parameter classes with the options that URLs to listen on may have."""
MONITORS: Final[Kinds] = (FramingParameters, SerialSettings, OpeningParameters, SocketParameters)
"""Parameter classes with the options of lines that are only listened to."""
SERVERS: Final[Kinds] = (UnitParameters, ServerParameters, ListenerParameters, SocketParameters)
"""Parameter classes with the options of a whole server."""


@dataclass(frozen=True, slots=True)
class AcceptedOptions:
    """The options that a part of busway, such as a link or a listener, accepts, by the parameter class that has them.

    Attributes:
        kinds: by parameter class, the options that are accepted, by name.
        framing: the framing of the endpoint, which some defaults depend on; empty without an endpoint.
    """

    kinds: Mapping[type[Any], Mapping[str, Option]]
    framing: str = ""

    @classmethod
    def at(cls, endpoint: Endpoint, role: str, kinds: Kinds) -> "AcceptedOptions":
        """Return all options that have an effect at an endpoint.

        Args:
            endpoint: the endpoint.
            role: ``client``, ``server``, or ``monitor``, which only listens to a line.
            kinds: the parameter classes to choose from.
        """
        words = (role, endpoint.framing, endpoint.carrier)
        found = {}
        for kind in kinds:
            options = {name: one for name, one in declared(kind).items() if one.has_effect(*words)}
            if options:
                found[kind] = options
        return cls(found, endpoint.framing)

    @classmethod
    def of(cls, *kinds: type[Any], role: str = "") -> "AcceptedOptions":
        """Return the options of these parameter classes.

        With a ``role`` (``client``, ``server`` or ``monitor``), only those that have an effect for it at some endpoint.
        """
        return cls({kind: options_for(role, kind) for kind in kinds})

    @property
    def options(self) -> dict[str, Option]:
        """All options that this part of busway accepts, by name."""
        return {name: option for options in self.kinds.values() for name, option in options.items()}

    @property
    def names(self) -> frozenset[str]:
        """The names of the accepted options, and ``preset``; empty if no option is accepted."""
        names = frozenset(self.options)
        return names | {OPTION} if names else names

    def chosen(self, given: Mapping[str, object], *, of: str = "") -> "ChosenOptions":
        """Return the options that a user gave, sorted by their parameter class, with those that a preset sets.

        Values are not checked before `ChosenOptions.build`.

        Args:
            given: values or their texts by name; ``preset`` may be among them.
            of: name of the part that has the options, for the error about an unknown one.

        Raises:
            ConfigError: there is no such option or preset, or an option contradicts the preset.
        """
        values: dict[type[Any], dict[str, object]] = {kind: {} for kind in self.kinds}
        own_names = canonical(given)
        for name, value in (with_preset(own_names, self.options) if self.options else own_names).items():
            kind = next((kind for kind, options in self.kinds.items() if name in options), None)
            if kind is None:
                raise unknown_option(name, self.names, of=of, aliases=aliases())
            values[kind][name] = value
        return ChosenOptions(self, values)


@dataclass(frozen=True, slots=True)
class ChosenOptions:
    """The options that a user gave, sorted by the parameter class that has them.

    Attributes:
        accepted: the options that could be given.
        values: by parameter class, the given values or their texts by name.
    """

    accepted: AcceptedOptions
    values: Mapping[type[Any], dict[str, object]]

    def build(self, kind: type[Parameters]) -> Parameters:
        """Return the parameter object of a class with the given options, and defaults for the others.

        Raises:
            ConfigError: an option has an invalid value; the error has its name as key.
        """
        return build_parameters(kind, self.values.get(kind, {}), framing=self.accepted.framing)

    def serial_settings(self) -> SerialSettings | None:
        """Return the settings of the serial line, built from the given options; None if the endpoint is no serial port.

        Raises:
            ConfigError: an option has an invalid value; the error has its name as key.
        """
        given = self.values.get(SerialSettings)
        return None if given is None else SerialSettings.from_options(given, binary=self.accepted.framing == "rtu")


def canonical(options: Mapping[str, object]) -> dict[str, object]:
    """Return a copy of options with alternative names, such as ``baudrate``, replaced by the options' own (``baud``).

    Raises:
        ConfigError: an option is given under its own and an alternative name.
    """
    found: dict[str, object] = {}
    for given, value in options.items():
        name = aliases().get(given, given)
        if name in found:
            raise ConfigError(f"is another name of {name}, which is given too", key=given if given != name else name)
        found[name] = value
    return found


def options_for(role: str, kind: type[Any]) -> dict[str, Option]:
    """Return the options of a parameter class by name.

    Args:
        role: ``client``, ``server`` or ``monitor``: only options that have an effect for it at some endpoint; empty for
            all options.
        kind: the parameter class.
    """
    options = declared(kind).items()
    return {name: one for name, one in options if not role or all(on.fits_role(role) for on in one.on)}


@cache
def aliases() -> Mapping[str, str]:
    """Return all alternative names of options of links, such as ``baudrate``, each with the option's own name."""
    options = (option for kind in LINKS for option in declared(kind).values())
    return {alias: option.name for option in options for alias in option.aliases}
