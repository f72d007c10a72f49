"""What `busway.open` and `busway.connect` can be told, scheme by scheme.

Knows which parameter classes go with which scheme; each class knows what its fields mean.

1. An option that has no effect with a scheme is refused there: it would be believed to work.
2. The error for an unknown option lists those of the scheme.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from ..config.endpoints import Endpoint, parse_endpoint
from ..config.options import build_parameters, option_names
from ..errors import ConfigError
from ..session.breaker import BreakerParameters
from ..session.line_framing import FramingParameters
from ..session.parameters import ClientParameters
from ..session.serial_client import SerialClientParameters
from ..transport.serial.opening import OpeningParameters
from ..transport.serial.settings import SerialSettings
from ..transport.tcp import SocketParameters

CALL_DEFAULTS = ("timeout", "retries", "deadline")
"""What each user of a shared link may choose for himself; the rest belongs to the connection."""

_ONE_AT_A_TIME: Final = frozenset(
    {
        "max_transactions",
        "transaction_policy",
        "unit_policy",
        "recycle_after_foreign",
        "join",
        "single_adu_segments",
    }
)
"""What has no meaning where transactions have no identifiers and follow each other."""
_OF_STREAMS: Final = frozenset({"keepalive", "keepalive_idle", "keepalive_interval", "keepalive_count", "no_delay"})
_NOT_ON_UDP: Final = _OF_STREAMS | {"user_timeout", "join", "single_adu_segments"}
_ONLY_RTU: Final = frozenset({"strict_timing", "gap_limit"})
_ONLY_ASCII: Final = frozenset({"character_timeout", "delimiter", "upper_case_only"})


@dataclass(frozen=True, slots=True)
class LineSettings:
    """What a link has besides where the framing is that of a serial line.

    Attributes:
        conversation: turnaround, gaps, drain.
        breaker: when units are given up.
        framing: how frames are found.
        port: what the line is set to; None over a network.
        opening: how the port is opened.
    """

    conversation: SerialClientParameters
    breaker: BreakerParameters
    framing: FramingParameters
    port: SerialSettings | None
    opening: OpeningParameters


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Everything that `busway.open` and `busway.connect` were told.

    Attributes:
        endpoint: where the link leads.
        parameters: of the conversation.
        sockets: of the connection; without effect on a serial port.
        line: of the line, where the framing is RTU or ASCII.
    """

    endpoint: Endpoint
    parameters: ClientParameters
    sockets: SocketParameters
    line: LineSettings | None = None

    def differs(self, other: "LinkSettings") -> str:
        """The first setting of the connection that differs, or an empty string."""
        for mine, theirs in zip(self._parts(), other._parts(), strict=False):
            for name in option_names(type(mine)):
                if name not in CALL_DEFAULTS and getattr(mine, name) != getattr(theirs, name):
                    return name
        return ""

    def _parts(self) -> list[Any]:  # parameter classes share no base
        parts: list[Any] = [self.parameters, self.sockets]
        if self.line is not None:
            parts += [self.line.conversation, self.line.breaker, self.line.framing, self.line.opening]
            if self.line.port is not None:
                parts.append(self.line.port)
        return parts


def link_settings(url: str | Endpoint, options: Mapping[str, object]) -> LinkSettings:
    """Settings from a URL with its options, and from keywords, which go before them. Raises `ConfigError`."""
    endpoint = parse_endpoint(url)
    offered = _offered(endpoint)
    chosen: dict[type[Any], dict[str, object]] = {kind: {} for kind in offered}
    for name, value in {**endpoint.options, **options}.items():
        kind = next((kind for kind, names in offered.items() if name in names), None)
        if kind is None:
            known = sorted(name for names in offered.values() for name in names)
            raise ConfigError(f"unknown option of {endpoint.url}; there are {', '.join(known)}", key=name)
        chosen[kind][name] = value
    parameters = build_parameters(ClientParameters, chosen[ClientParameters])
    if endpoint.carrier == "udp" and endpoint.framing == "mbap":
        parameters = replace(parameters, single_adu_segments=True)  # one ADU per datagram
    sockets = build_parameters(SocketParameters, chosen.get(SocketParameters, {}))
    if endpoint.framing == "mbap":
        return LinkSettings(endpoint, parameters, sockets)
    port = None
    if endpoint.carrier == "serial":
        port = SerialSettings.from_options(chosen[SerialSettings], binary=endpoint.framing == "rtu")
    line = LineSettings(
        build_parameters(SerialClientParameters, chosen[SerialClientParameters]),
        build_parameters(BreakerParameters, chosen[BreakerParameters]),
        build_parameters(FramingParameters, chosen[FramingParameters]),
        port,
        build_parameters(OpeningParameters, chosen.get(OpeningParameters, {})),
    )
    return LinkSettings(endpoint, parameters, sockets, line)


def options_of(endpoint: Endpoint) -> frozenset[str]:
    """The options that a link to an endpoint may have; the others have no effect with its scheme."""
    return frozenset(name for names in _offered(endpoint).values() for name in names)


def _offered(endpoint: Endpoint) -> dict[type[Any], list[str]]:
    """The options of a scheme, by the class that takes them."""
    kinds: list[type[Any]] = [ClientParameters]
    without: frozenset[str] = frozenset()
    if endpoint.carrier != "serial":
        kinds.append(SocketParameters)
    if endpoint.carrier == "udp":
        without |= _NOT_ON_UDP
    if endpoint.framing != "mbap":
        kinds += [SerialClientParameters, BreakerParameters, FramingParameters]
        without |= _ONE_AT_A_TIME | (_ONLY_ASCII if endpoint.framing == "rtu" else _ONLY_RTU)
        if endpoint.carrier == "serial":
            kinds += [SerialSettings, OpeningParameters]
            without |= {"recycle_after_timeouts"}
        else:
            without |= {"strict_timing"}
    return {kind: [name for name in option_names(kind) if name not in without] for kind in kinds}
