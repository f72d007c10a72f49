"""The interface of client sessions that link drivers use, and the choice of the session for an endpoint.

Knows no connection.
"""

import random
from typing import Protocol

from ..errors import ModbusError
from ..framing.echo import Echo
from ..framing.frame_direction import LineRole
from ..framing.timing import Parity, SerialTiming
from ..options.ports import SerialSettings
from ..session.call import Call, Places
from ..session.client import TcpClientSession
from ..session.line_framing import line_framing
from ..session.reconnect import Reconnect
from ..session.retries import ClientCounters
from ..session.serial_client import SerialClientSession
from ..session.unit_breaker import Breakers
from .settings import LinkSettings


class ClientSession(Protocol):
    """Interface of a client session: `TcpClientSession` or `SerialClientSession`.

    Attributes:
        counters: counters of the link.
        finished: calls that have all their outcomes; the driver empties the list.
        recycle: why the driver must close the connection and open another; empty while it need not.
        valid_reply: whether this connection has brought a reply that answers a request.
    """

    counters: ClientCounters
    finished: list[Call]
    recycle: str
    valid_reply: bool

    @property
    def breakers(self) -> Breakers | None:
        """The circuit breakers of the units; None without breakers."""

    @property
    def has_calls(self) -> bool:
        """Whether calls wait to be sent."""

    @property
    def has_gap(self) -> bool:
        """Whether waiting calls may be sent only later, after a gap."""

    @property
    def in_flight(self) -> int:
        """Number of requests whose reply is awaited."""

    @property
    def queued(self) -> int:
        """Number of calls with something left to send."""

    def submit(self, call: Call, now: float) -> None:
        """Queue a call. Raises `ModbusError`; nothing was sent then."""

    def send_now(self, call: Call, now: float) -> bytes | None:
        """Send a call at once and return its frame; None if it has to be queued with `submit`."""

    def serve_units_in_turn(self) -> None:
        """Serve the units of each caller in turn, instead of its calls in order."""

    def cancel(self, call: Call) -> bool:
        """Cancel a call. Returns whether some of its requests are in flight."""

    def connected(self, now: float) -> None:
        """Report that a connection is open."""

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """Report the end of the connection; ``lost`` is False if the client itself closed an unused one."""

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """Report that no connection could be opened: waiting calls fail; ``keep_repeated`` spares those about to be
        repeated.
        """

    def transmit(self, now: float) -> list[bytes]:
        """The frames to send now, in order."""

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Process the received first ``size`` bytes of ``buffer``."""

    def deadline(self) -> float | None:
        """When `tick` or `transmit` has something to do, in the clock of ``now``; None for never."""

    def tick(self, now: float) -> None:
        """Handle timeouts and deadlines that have passed."""


def client_session_for(
    settings: LinkSettings, shared_places: Places | None = None
) -> TcpClientSession | SerialClientSession:
    """Create the client session for an endpoint, without a connection. Raises `ConfigError`.

    ``shared_places`` are the slots for requests in flight that all links of a client share with ``scope=client``.
    """
    name = settings.endpoint.url
    if settings.line is None:
        # A random first identifier: a restarted program must not take replies to its predecessor for its own.
        session = TcpClientSession(
            settings.parameters,
            endpoint=name,
            first_transaction=random.getrandbits(16),
            shared_places=shared_places,
        )
        if settings.breaker is not None:
            session.watch_units(Breakers(settings.breaker, random.random))
        return session
    line = settings.line
    port = line.port
    framing = line_framing(
        settings.endpoint.framing,
        LineRole.MASTER,
        timing_of(port),
        line.framing,
        echo=Echo.OFF if port is None else Echo(port.echo.value),
        strip_parity=port is not None and port.data_bits == 8,
    )
    return SerialClientSession(
        settings.parameters,
        framing=framing,
        jitter=random.random,
        serial=line.conversation,
        breaker=line.breaker,
        endpoint=name,
    )


def reconnect_for(settings: LinkSettings) -> Reconnect:
    """Create the reconnecting state of a link with its pauses; a serial port has pauses of its own."""
    if settings.line is not None and settings.line.port is not None:
        opening = settings.line.opening
        return Reconnect(random.random, first=opening.reopen_first, most=opening.reopen_most)
    management = settings.management
    return Reconnect(random.random, first=management.reconnect_first, most=management.reconnect_most)


def timing_of(port: SerialSettings | None) -> SerialTiming:
    """Character times for the settings of a port; those of a network if ``port`` is None."""
    if port is None:
        return SerialTiming.of_network()
    return SerialTiming.of_line(
        port.baud, data_bits=port.data_bits, parity=Parity(port.parity.value), stop_bits=port.stop_bits
    )
