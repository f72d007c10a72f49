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
from ..session.call import Call, FreeSlots
from ..session.client import TcpClientSession
from ..session.line_framing import line_framing
from ..session.reconnect import Reconnect
from ..session.retries import ClientCounters
from ..session.serial_client import SerialClientSession
from ..session.unit_breaker import Breakers
from .settings import LinkSettings


class ClientSession(Protocol):
    """Interface of a client session, which decides without IO what a link sends, awaits and repeats.

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
        """The circuit breakers of the units; None if the option is off."""

    @property
    def has_calls(self) -> bool:
        """Whether calls wait that have requests left to send."""

    @property
    def has_gap(self) -> bool:
        """Whether requests wait only because a gap between requests is not over."""

    @property
    def in_flight(self) -> int:
        """Number of requests that were sent and whose reply is awaited."""

    @property
    def queued(self) -> int:
        """Number of calls that have requests left to send."""

    def submit(self, call: Call, now: float) -> None:
        """Queue the requests of a call to be sent. Raises `ModbusError`; nothing was sent then."""

    def send_now(self, call: Call, now: float) -> bytes | None:
        """Return the frame of a call that can be sent at once; None if it has to be queued with `submit`."""

    def serve_units_in_turn(self) -> None:
        """Send requests to the units in turn, not in call order, so that a slow unit does not hold up others."""

    def cancel(self, call: Call) -> bool:
        """Cancel a call. Returns whether requests of it were sent and are unanswered."""

    def connected(self, now: float) -> None:
        """Tell the session that the link has an open connection."""

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """Tell the session that the connection ended; ``lost`` is False if the client itself closed it unused."""

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """End waiting calls because no connection could be opened; ``keep_repeated`` spares those to be repeated."""

    def transmit(self, now: float) -> list[bytes]:
        """Return the frames that are due to be sent at ``now``, in order."""

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Process the first ``size`` bytes of ``buffer``, which the connection has received."""

    def deadline(self) -> float | None:
        """The time at which `tick` or `transmit` has something to do, by the clock of ``now``; None for never."""

    def tick(self, now: float) -> None:
        """End requests and calls whose timeout or deadline has passed."""


def client_session_for(
    settings: LinkSettings, shared_slots: FreeSlots | None = None
) -> TcpClientSession | SerialClientSession:
    """Create the client session for an endpoint, without a connection. Raises `ConfigError`.

    ``shared_slots`` are the slots for requests in flight that all links of a client share with ``scope=client``.
    """
    name = settings.endpoint.url
    if settings.line is None:
        # A random first identifier: a restarted program must not take replies to its predecessor for its own.
        session = TcpClientSession(
            settings.parameters,
            endpoint=name,
            first_transaction=random.getrandbits(16),
            shared_slots=shared_slots,
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
    """Create the object that decides when a link connects again; serial ports have other pauses."""
    if settings.line is not None and settings.line.port is not None:
        opening = settings.line.opening
        return Reconnect(random.random, first=opening.reopen_first, most=opening.reopen_most)
    management = settings.management
    return Reconnect(random.random, first=management.reconnect_first, most=management.reconnect_most)


def timing_of(port: SerialSettings | None) -> SerialTiming:
    """Return the character times for the settings of a serial port; those of a network if ``port`` is None."""
    if port is None:
        return SerialTiming.of_network()
    return SerialTiming.of_line(
        port.baud, data_bits=port.data_bits, parity=Parity(port.parity.value), stop_bits=port.stop_bits
    )
