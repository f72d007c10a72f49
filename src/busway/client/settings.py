"""The settings of a link, read from its URL and from keywords, as checked objects.

Knows which parts of a link take which parameter classes; what an option means, and with which schemes, is declared in
`busway.options`.
"""

import socket
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError
from ..options.client import ClientParameters, ManagementParameters
from ..options.declaration import Mark, declared
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from ..options.offer import LINKS, Offer, canonical
from ..options.ports import OpeningParameters, SerialSettings
from ..options.sockets import SocketParameters
from ..options.tls import TlsParameters

if TYPE_CHECKING:
    import ssl

CALL_DEFAULTS: Final = tuple(name for name, one in declared(ClientParameters).items() if Mark.PER_CALL in one.marks)
"""What each user of a shared link may choose; the rest belongs to the connection."""


@dataclass(frozen=True, slots=True)
class LineSettings:
    """Settings of a link that only RTU and ASCII framing have.

    Attributes:
        conversation: turnaround, gaps, drain.
        breaker: when units are given up.
        framing: how frames are found.
        port: what the line is set to; None over a network.
        opening: how the port is opened.
        assumed: rate and parity of the port as far as they are defaults: ``19200 baud and parity even``; or empty.
    """

    conversation: SerialClientParameters
    breaker: BreakerParameters
    framing: FramingParameters
    port: SerialSettings | None
    opening: OpeningParameters
    assumed: str = ""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """All settings of a link, as given to `busway.open` and `busway.connect`.

    Attributes:
        endpoint: where the link leads.
        parameters: the options of the client session.
        sockets: socket options of the connection; without effect on a serial port.
        management: when connections come and go; without effect on a serial port.
        line: settings of the line, if the framing is RTU or ASCII.
        breaker: when units are given up, where the framing is another; None: never.
        security: certificates and what else TLS needs, where the carrier is TLS.
        ssl_context: the program's own, in place of one made from ``security``.
    """

    endpoint: Endpoint
    parameters: ClientParameters
    sockets: SocketParameters
    management: ManagementParameters
    line: LineSettings | None = None
    breaker: BreakerParameters | None = None
    security: TlsParameters | None = None
    ssl_context: "ssl.SSLContext | None" = None

    def differs(self, other: "LinkSettings") -> str:
        """Return the name of the first setting of the connection that differs from ``other``; empty if none does."""
        for mine, theirs in zip(self._parts(), other._parts(), strict=False):
            for name, option in declared(type(mine)).items():
                if Mark.PER_CALL not in option.marks and getattr(mine, name) != getattr(theirs, name):
                    return name
        return "" if self.ssl_context is other.ssl_context else "ssl_context"

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


BESIDE_CONTEXT: Final = ("server_name", "handshake_timeout")
"""Options of TLS that a context does not decide."""
_NEVER: Final = BreakerParameters(open_after=0)


def link_settings(
    url: str | Endpoint, options: Mapping[str, object], ssl_context: "ssl.SSLContext | None" = None
) -> LinkSettings:
    """Create link settings from a URL with options and from keywords, which override them. Raises `ConfigError`."""
    endpoint = parse_endpoint(url)
    if ssl_context is not None:
        _check_context(endpoint, {**endpoint.options, **options})
    offer = Offer.at(endpoint, "client", LINKS)
    chosen = offer.chosen({**canonical(endpoint.options), **canonical(options)}, of=endpoint.url)
    parameters = chosen.build(ClientParameters)
    if endpoint.carrier == "udp" and endpoint.framing == "mbap":
        parameters = replace(parameters, single_adu_segments=True)  # one ADU per datagram
    sockets = chosen.build(SocketParameters)
    management = chosen.build(ManagementParameters)
    if management.interface is not None and not hasattr(socket, "SO_BINDTODEVICE"):
        raise ConfigError("this system cannot bind a connection to an interface", key="interface")
    breaker = chosen.build(BreakerParameters)
    if endpoint.framing == "mbap":
        security = chosen.build(TlsParameters) if endpoint.carrier == "tls" else None
        watched = breaker if breaker.open_after else None
        return LinkSettings(
            endpoint, parameters, sockets, management, breaker=watched, security=security, ssl_context=ssl_context
        )
    port = chosen.serial_settings()
    line = LineSettings(
        chosen.build(SerialClientParameters),
        breaker,
        chosen.build(FramingParameters),
        port,
        chosen.build(OpeningParameters),
        _assumed(port, chosen.values.get(SerialSettings, {})),
    )
    return LinkSettings(endpoint, parameters, sockets, management, line)


def _assumed(port: SerialSettings | None, given: Mapping[str, object]) -> str:
    """Return rate and parity of a port as text, without what is given; empty without a port."""
    if port is None:
        return ""
    words = {"baud": f"{port.baud} baud", "parity": f"parity {port.parity.value}"}
    return " and ".join(text for name, text in words.items() if name not in given)


def _check_context(endpoint: Endpoint, options: Mapping[str, object]) -> None:
    """Raise `ConfigError` if a context has no effect here, or would contradict an option."""
    if endpoint.carrier != "tls":
        raise ConfigError(f"has no effect on {endpoint.scheme}://; it is for tls://", key="ssl_context")
    for name in canonical(options):
        if name in declared(TlsParameters) and name not in BESIDE_CONTEXT:
            raise ConfigError(f"has no effect beside ssl_context; only {', '.join(BESIDE_CONTEXT)} may", key=name)


def options_of(endpoint: Endpoint) -> frozenset[str]:
    """Return the names of the options that have an effect on a link to this endpoint."""
    return Offer.at(endpoint, "client", LINKS).names
