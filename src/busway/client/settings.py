"""What `busway.open` and `busway.connect` can be told, scheme by scheme.

Knows which parameter classes go with which scheme; each class knows what its fields mean.

1. An option that has no effect with a scheme is refused there: it would be believed to work.
2. The error for an unknown option lists those of the scheme.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from ..options.endpoints import Endpoint, parse_endpoint
from ..options.presets import OPTION, STRICT_LINKS, with_preset
from ..options.text import build_parameters, canonical, option_names, unknown_option
from ..session.breaker import OPEN_AFTER_BY_FRAMING, BreakerParameters
from ..session.line_framing import FramingParameters
from ..session.parameters import TIMEOUT_BY_FRAMING, ClientParameters
from ..session.serial_client import SerialClientParameters
from ..transport.serial.opening import OpeningParameters
from ..transport.serial.settings import SerialSettings
from ..transport.tcp import SocketParameters
from ..transport.tls.parameters import OF_SERVERS, TlsParameters, tls_parameters
from .management import ManagementParameters

CALL_DEFAULTS = ("timeout", "retries", "deadline", "register_width")
"""What each user of a shared link may choose for himself; the rest belongs to the connection."""

_ONE_AT_A_TIME: Final = frozenset(
    {
        "max_transactions",
        "scope",
        "transaction_policy",
        "unit_policy",
        "recycle_after_foreign",
        "join",
        "single_adu_segments",
    }
)
"""What has no meaning where transactions have no identifiers and follow each other."""
_OF_STREAMS: Final = frozenset({"keepalive", "keepalive_idle", "keepalive_interval", "keepalive_count", "no_delay"})
_NOT_ON_UDP: Final = _OF_STREAMS | {"user_timeout", "join", "single_adu_segments", "interface"}
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
        management: when connections come and go; without effect on a serial port.
        line: of the line, where the framing is RTU or ASCII.
        breaker: when units are given up, where the framing is another; None: never.
        security: certificates and what else TLS needs, where the carrier is TLS.
    """

    endpoint: Endpoint
    parameters: ClientParameters
    sockets: SocketParameters
    management: ManagementParameters
    line: LineSettings | None = None
    breaker: BreakerParameters | None = None
    security: TlsParameters | None = None

    def differs(self, other: "LinkSettings") -> str:
        """Name of the first connection setting that differs from ``other``; empty if none does."""
        for mine, theirs in zip(self._parts(), other._parts(), strict=False):
            for name in option_names(type(mine)):
                if name not in CALL_DEFAULTS and getattr(mine, name) != getattr(theirs, name):
                    return name
        return ""

    def _parts(self) -> list[Any]:  # parameter classes share no base
        parts: list[Any] = [self.parameters, self.sockets, self.management]
        if self.security is not None:
            parts.append(self.security)
        if self.line is None:
            parts.append(self.breaker or _NEVER)
        else:
            parts += [self.line.conversation, self.line.breaker, self.line.framing, self.line.opening]
            if self.line.port is not None:
                parts.append(self.line.port)
        return parts


_NEVER: Final = BreakerParameters(open_after=0)


def link_settings(url: str | Endpoint, options: Mapping[str, object]) -> LinkSettings:
    """Settings from a URL with its options, and from keywords, which go before them. Raises `ConfigError`."""
    endpoint = parse_endpoint(url)
    offered = _offered(endpoint)
    chosen: dict[type[Any], dict[str, object]] = {kind: {} for kind in offered}
    given = {**canonical(endpoint.options), **canonical(options)}
    for name, value in with_preset(given, STRICT_LINKS, takes=_names_of(offered)).items():
        kind = next((kind for kind, names in offered.items() if name in names), None)
        if kind is None:
            raise unknown_option(name, options_of(endpoint), of=endpoint.url)
        chosen[kind][name] = value
    chosen[ClientParameters].setdefault("timeout", TIMEOUT_BY_FRAMING[endpoint.framing])
    parameters = build_parameters(ClientParameters, chosen[ClientParameters])
    if endpoint.carrier == "udp" and endpoint.framing == "mbap":
        parameters = replace(parameters, single_adu_segments=True)  # one ADU per datagram
    sockets = build_parameters(SocketParameters, chosen.get(SocketParameters, {}))
    management = build_parameters(ManagementParameters, chosen.get(ManagementParameters, {}))
    chosen[BreakerParameters].setdefault("open_after", OPEN_AFTER_BY_FRAMING[endpoint.framing])
    breaker = build_parameters(BreakerParameters, chosen[BreakerParameters])
    if endpoint.framing == "mbap":
        security = tls_parameters(chosen[TlsParameters]) if TlsParameters in chosen else None
        watched = breaker if breaker.open_after else None
        return LinkSettings(endpoint, parameters, sockets, management, breaker=watched, security=security)
    port = None
    if endpoint.carrier == "serial":
        port = SerialSettings.from_options(chosen[SerialSettings], binary=endpoint.framing == "rtu")
    line = LineSettings(
        build_parameters(SerialClientParameters, chosen[SerialClientParameters]),
        breaker,
        build_parameters(FramingParameters, chosen[FramingParameters]),
        port,
        build_parameters(OpeningParameters, chosen.get(OpeningParameters, {})),
    )
    return LinkSettings(endpoint, parameters, sockets, management, line)


def options_of(endpoint: Endpoint) -> frozenset[str]:
    """The options that a link to an endpoint may have; the others have no effect with its scheme."""
    return _names_of(_offered(endpoint)) | {OPTION}


def _names_of(offered: Mapping[type[Any], list[str]]) -> frozenset[str]:
    return frozenset(name for names in offered.values() for name in names)


def _offered(endpoint: Endpoint) -> dict[type[Any], list[str]]:
    """The options of a scheme, by the class that takes them."""
    kinds: list[type[Any]] = [ClientParameters, BreakerParameters]
    without: frozenset[str] = frozenset()
    if endpoint.carrier != "serial":
        kinds += [SocketParameters, ManagementParameters]
    if endpoint.carrier == "udp":
        without |= _NOT_ON_UDP
    if endpoint.carrier == "tls":
        kinds.append(TlsParameters)
        without |= OF_SERVERS | {"interface"}
    if endpoint.framing != "mbap":
        kinds += [SerialClientParameters, FramingParameters]
        without |= _ONE_AT_A_TIME | (_ONLY_ASCII if endpoint.framing == "rtu" else _ONLY_RTU)
        if endpoint.carrier == "serial":
            kinds += [SerialSettings, OpeningParameters]
            without |= {"recycle_after_timeouts"}
        else:
            without |= {"strict_timing"}
    return {kind: [name for name in option_names(kind) if name not in without] for kind in kinds}
