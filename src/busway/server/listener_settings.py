"""Settings of a listener, read from its URL, whichever scheme it has.

Knows which parts of a listener take which parameter classes. What an option means, and which schemes have it, is
declared in `busway.options`.
"""

from collections.abc import Container
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..access.addresses import HostAuthorizer
from ..framing.character_times import SerialTiming
from ..framing.echo import Echo
from ..options.accepted_options import LISTENERS, AcceptedOptions
from ..options.declaration import declared
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.lines import FramingParameters
from ..options.ports import OpeningParameters, SerialSettings
from ..options.server import ListenerParameters
from ..options.text import build_parameters
from ..options.tls import TlsParameters
from ..pdu.functions import FunctionTable
from .listener import Listener

if TYPE_CHECKING:
    from ..session.line_framing import LineFraming


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """The checked settings of a listener: its endpoint and all its options.

    Attributes:
        endpoint: the endpoint to listen on.
        framing: options of RTU or ASCII framing; without effect for MBAP.
        port: settings of the serial line; None over a network.
        opening: how the serial port is opened.
        limits: limits and timeouts of its connections.
        access: which hosts may connect here; the server's own check must allow them too. None: only the server's check.
        tls: certificate, key and authorities; None if the carrier is not TLS.
        is_optional: whether the server starts without this listener if it cannot be opened.
        beside: URL of the configured listener that this one was opened for in addition (port 502): access rules that
            name that URL hold here too. Empty for a configured listener.
    """

    endpoint: Endpoint
    framing: FramingParameters
    port: SerialSettings | None
    opening: OpeningParameters
    limits: ListenerParameters
    access: HostAuthorizer | None
    tls: TlsParameters | None
    is_optional: bool = False
    beside: str = ""

    def line_framing(
        self, units: Container[int], functions: FunctionTable, *, started: float | None = None
    ) -> "LineFraming":
        """Return the RTU or ASCII framing of one port or connection of a server.

        ``started`` is the time in seconds at which the port was opened, by the clock of its frames; None if the line is
        known to be idle. Raises `ConfigError` for wrong options.
        """
        from ..framing.frame_direction import LineRole
        from ..session.line_framing import line_framing

        port = self.port
        timing = SerialTiming.of_network() if port is None else port.timing
        return line_framing(
            self.endpoint.framing,
            LineRole.SERVER,
            timing,
            self.framing,
            functions=functions,
            units=units,
            echo=Echo.OFF if port is None else port.echo,
            strip_parity=port is not None and port.data_bits == 8,
            started=started,
        )


def listener_settings(
    listener: Listener, *, limits: ListenerParameters, tls: TlsParameters | None = None
) -> ListenerSettings:
    """Read the settings of a listener from its URL; ``limits`` and ``tls`` of the server are the defaults.

    Raises:
        ConfigError: the URL is no endpoint of a server, or has an option that its scheme does not take or that is
            wrong.
    """
    endpoint = parse_endpoint(listener.endpoint)
    chosen = AcceptedOptions.at(endpoint, "server", LISTENERS).chosen(
        endpoint.options, of=f"a listener on {endpoint.url}"
    )
    return ListenerSettings(
        endpoint,
        chosen.build(FramingParameters),
        chosen.serial_settings(),
        chosen.build(OpeningParameters),
        listener.limits or limits,
        listener.access,
        _security(listener.tls or tls, chosen.values[TlsParameters]) if endpoint.carrier == "tls" else None,
    )


def _security(parameters: TlsParameters | None, options: dict[str, object]) -> TlsParameters:
    """Return the TLS parameters of a listener. Raises `ConfigError`.

    ``options``, those of its URL, override ``parameters``; with None only ``options`` count.
    """
    general = {} if parameters is None else {name: getattr(parameters, name) for name in declared(TlsParameters)}
    chosen = build_parameters(TlsParameters, general | options)
    chosen.check_server()
    return chosen
