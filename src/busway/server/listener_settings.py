"""What a URL to listen on can say beside the address, scheme by scheme.

Knows which parameter classes go with which scheme; each class knows what its fields mean. An option that has no effect
with a scheme is refused there.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any, Final

from ..framing.conversation import Role
from ..framing.echo import Echo
from ..framing.timing import SerialTiming
from ..options.endpoints import Endpoint, parse_endpoint
from ..options.presets import OPTION, STRICT_LINE_LISTENERS, STRICT_TLS_LISTENERS, with_preset
from ..options.text import build_parameters, canonical, option_names, unknown_option
from ..pdu.functions import FunctionTable
from ..session.line_framing import FramingParameters, LineFraming, line_framing
from ..transport.serial.opening import OpeningParameters
from ..transport.serial.settings import SerialSettings
from ..transport.tls.parameters import OF_CLIENTS, TlsParameters, tls_parameters
from .authorisation import Authorise
from .listener import Listener
from .parameters import ListenerParameters

_ONLY_RTU: Final = frozenset({"strict_timing", "gap_limit"})
_ONLY_ASCII: Final = frozenset({"character_timeout", "delimiter", "upper_case_only"})
_OF_CLIENTS: Final = frozenset({"port_wait"})


@dataclass(frozen=True, slots=True)
class ListenerSettings:
    """An endpoint to listen on, with its options.

    Attributes:
        endpoint: where.
        framing: how frames are found, where the framing is RTU or ASCII.
        port: what the line is set to; None over a network.
        opening: how the port is opened.
        limits: of its connections.
        access: who may connect, beside the server's own question; None leaves it to that.
        tls: certificate, key and authorities; None where the carrier is not TLS.
        is_optional: whether the others go on where it cannot be had.
    """

    endpoint: Endpoint
    framing: FramingParameters
    port: SerialSettings | None
    opening: OpeningParameters
    limits: ListenerParameters
    access: Authorise | None
    tls: TlsParameters | None
    is_optional: bool = False

    def line_framing(
        self, units: Container[int], functions: FunctionTable, *, started: float | None = None
    ) -> LineFraming:
        """A framing in the role of a server with ``units``, for one port or connection. Raises `ConfigError`."""
        port = self.port
        timing = SerialTiming.of_network() if port is None else port.timing
        return line_framing(
            self.endpoint.framing,
            Role.SERVER,
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
    """The settings of a listener; ``limits`` and ``tls`` are the server's, for those that have none of their own.

    Raises:
        ConfigError: the URL cannot be listened on, with the options of its scheme.
    """
    endpoint = parse_endpoint(listener.endpoint)
    offered = _offered(endpoint)
    chosen: dict[type[Any], dict[str, object]] = {kind: {} for kind in offered}
    given: Mapping[str, object] = canonical(endpoint.options)
    strict = STRICT_TLS_LISTENERS if endpoint.carrier == "tls" else STRICT_LINE_LISTENERS
    if endpoint.carrier == "tls" or endpoint.framing != "mbap":
        given = with_preset(given, strict, takes={name for names in offered.values() for name in names})
    for name, value in given.items():
        kind = next((kind for kind, names in offered.items() if name in names), None)
        if kind is None:
            names_there = {name for names in offered.values() for name in names}
            known = {*names_there, OPTION} if names_there else ()
            raise unknown_option(name, known, of=f"a listener on {endpoint.url}")
        chosen[kind][name] = value
    port = None
    if endpoint.carrier == "serial":
        port = SerialSettings.from_options(chosen[SerialSettings], binary=endpoint.framing == "rtu")
    return ListenerSettings(
        endpoint,
        build_parameters(FramingParameters, chosen.get(FramingParameters, {})),
        port,
        build_parameters(OpeningParameters, chosen.get(OpeningParameters, {})),
        listener.limits or limits,
        listener.access,
        _security(listener.tls or tls, chosen[TlsParameters]) if endpoint.carrier == "tls" else None,
    )


def _security(parameters: TlsParameters | None, options: dict[str, object]) -> TlsParameters:
    """The parameters of TLS; what stands in the URL goes before the rest. Raises `ConfigError`."""
    chosen = tls_parameters({**({} if parameters is None else _fields(parameters)), **options})
    chosen.check_server()
    return chosen


def _fields(parameters: TlsParameters) -> dict[str, object]:
    return {name: getattr(parameters, name) for name in option_names(TlsParameters)}


def _offered(endpoint: Endpoint) -> dict[type[Any], list[str]]:
    """The options of a scheme, by the class that takes them."""
    kinds: list[type[Any]] = []
    without = _OF_CLIENTS
    if endpoint.framing != "mbap":
        kinds.append(FramingParameters)
        without |= _ONLY_ASCII if endpoint.framing == "rtu" else _ONLY_RTU
        if endpoint.carrier == "serial":
            kinds += [SerialSettings, OpeningParameters]
        else:
            without |= {"strict_timing"}
    if endpoint.carrier == "tls":
        kinds.append(TlsParameters)
        without |= OF_CLIENTS
    return {kind: [name for name in option_names(kind) if name not in without] for kind in kinds}
