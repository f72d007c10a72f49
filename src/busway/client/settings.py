"""The settings of a link, read from its URL and from keywords, as checked objects.

Knows which classes of options a link has; what an option means, and for which schemes it exists, is declared in
`busway.options`.
"""

import socket
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError
from ..options.accepted_options import LINKS, AcceptedOptions, canonical
from ..options.client import ClientParameters, ManagementParameters
from ..options.declaration import Mark, declared
from ..options.endpoints import Endpoint, parse_endpoint, require_host
from ..options.lines import BreakerParameters, FramingParameters, SerialClientParameters
from ..options.ports import OpeningParameters, SerialSettings
from ..options.presets import OPTION as PRESET
from ..options.presets import names_set_by
from ..options.sockets import SocketParameters
from ..options.tls import TlsParameters

if TYPE_CHECKING:
    import ssl

CALL_DEFAULTS: Final = tuple(name for name, one in declared(ClientParameters).items() if Mark.PER_CALL in one.marks)
"""Names of the options that each user of a shared link may choose; all others belong to the connection."""


@dataclass(frozen=True, slots=True)
class LineSettings:
    """Settings of a link that only RTU and ASCII framing have.

    Attributes:
        conversation: pauses between requests, and how late replies are treated.
        breaker: after how many timeouts in a row requests to a unit fail at once, and for how long.
        framing: how frames are found in the received bytes.
        port: baud rate, parity and other settings of the serial port; None over a network.
        opening: how long to wait for a missing port, the pauses between attempts to open it, and whether frames are
            timed exactly; ignored over a network.
        assumed: baud rate and parity that the user did not give, as text for errors, such as ``19200 baud and parity
            even``; empty if both were given, and over a network.
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
        endpoint: the device, line or server that the link connects to.
        parameters: options of the client session, such as timeouts and retries.
        sockets: socket options of the connection; ignored on a serial port.
        management: how long connections are kept, when lost ones are replaced, and how many there may be.
        line: settings of the line with RTU or ASCII framing; None with Modbus TCP framing.
        breaker: with Modbus TCP framing, after how many timeouts requests to a unit fail at once; None: that is off.
            With RTU and ASCII framing `LineSettings.breaker` is used, and this is None.
        security: certificates and other settings of TLS; None if the endpoint does not use TLS.
        ssl_context: a context that the program created itself; None to create one from ``security``.
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
        """Return the name of the first connection setting with another value than in ``other``; empty if none has.

        Options that each user of a shared link may choose, such as ``timeout``, are not compared, nor is the endpoint.
        """
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
"""Options of TLS that may be given together with ``ssl_context``, because a context does not decide them."""
_NEVER: Final = BreakerParameters(open_after=0)


def link_settings(
    url: str | Endpoint, options: Mapping[str, object], ssl_context: "ssl.SSLContext | None" = None
) -> LinkSettings:
    """Return the settings of a link, from the options in its URL and from keyword options.

    Where both give the same option, the keyword counts.

    Raises:
        ConfigError: the URL or an option is invalid, or an option has no effect for this endpoint.
    """
    endpoint = parse_endpoint(url)
    require_host(endpoint)
    if ssl_context is not None:
        _check_context(endpoint, {**endpoint.options, **options})
    accepted = AcceptedOptions.at(endpoint, "client", LINKS)
    chosen = accepted.chosen({**canonical(endpoint.options), **canonical(options)}, of=endpoint.url)
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


def with_defaults(
    endpoint: Endpoint, options: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, Any]:  # Any: values of options
    """Return options of a link with a program's defaults for those that neither the user nor the preset sets.

    Args:
        endpoint: where the link goes; options in its URL count as the user's.
        options: keyword options by name.
        defaults: the defaults of the program by name; those that have no effect for this endpoint are left out.
    """
    accepted = AcceptedOptions.at(endpoint, "client", LINKS)
    given = {**endpoint.options, **options}
    settled = given.keys() | names_set_by(given.get(PRESET), accepted.options)
    added = {name: value for name, value in defaults.items() if name in accepted.names and name not in settled}
    return {**added, **options}


def _assumed(port: SerialSettings | None, given: Mapping[str, object]) -> str:
    """Return baud rate and parity of a port as text, without those that the user gave; empty if ``port`` is None.

    ``given`` has the options of the port that the user gave, by name.
    """
    if port is None:
        return ""
    words = {"baud": f"{port.baud} baud", "parity": f"parity {port.parity.value}"}
    return " and ".join(text for name, text in words.items() if name not in given)


def _check_context(endpoint: Endpoint, options: Mapping[str, object]) -> None:
    """Raise `ConfigError` if ``ssl_context`` has no effect for the endpoint, or makes another option ineffective."""
    if endpoint.carrier != "tls":
        raise ConfigError(f"has no effect on {endpoint.scheme}://; it is for tls://", key="ssl_context")
    for name in canonical(options):
        if name in declared(TlsParameters) and name not in BESIDE_CONTEXT:
            raise ConfigError(f"has no effect beside ssl_context; only {', '.join(BESIDE_CONTEXT)} may", key=name)


def options_of(endpoint: Endpoint) -> frozenset[str]:
    """Return the names of the options that have an effect on a link to this endpoint, ``preset`` among them."""
    return AcceptedOptions.at(endpoint, "client", LINKS).names
