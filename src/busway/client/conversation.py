"""What a link drives: a conversation, whatever its framing.

Knows the shape of a session, and which one an endpoint needs; knows no connection.
"""

import random
from typing import Protocol

from ..errors import ModbusError
from ..framing.conversation import Role
from ..framing.echo import Echo
from ..framing.timing import Parity, SerialTiming
from ..session.breaker import Breakers
from ..session.call import Call
from ..session.call_tracker import ClientCounters
from ..session.client import TcpClientSession
from ..session.line_framing import line_framing
from ..session.requests_in_flight import Places
from ..session.serial_client import SerialClientSession
from ..transport.serial.settings import SerialSettings
from .settings import LineSettings, LinkSettings


class ClientSession(Protocol):
    """The client's side of one conversation: `TcpClientSession` or `SerialClientSession`.

    Attributes:
        counters: what happened.
        finished: calls that have all their outcomes; the driver empties the list.
        recycle: why the connection must be made anew; empty while it need not.
        valid_reply: whether this connection has brought a reply that answers a request.
    """

    counters: ClientCounters
    finished: list[Call]
    recycle: str
    valid_reply: bool

    @property
    def breakers(self) -> Breakers | None:
        """Which units are not asked; None where units are not watched."""

    @property
    def has_calls(self) -> bool:
        """Whether something waits to be sent."""

    @property
    def has_gap(self) -> bool:
        """Whether what waits may be sent only later."""

    @property
    def in_flight(self) -> int:
        """Requests whose reply is awaited."""

    @property
    def queued(self) -> int:
        """Calls with something left to send."""

    def submit(self, call: Call, now: float) -> None:
        """Take a call. Raises `ModbusError`; nothing was sent then."""

    def send_now(self, call: Call, now: float) -> bytes | None:
        """The frame of a call that need not queue; None: `submit` it."""

    def serve_units_in_turn(self) -> None:
        """Serve the units of each caller in turn."""

    def cancel(self, call: Call) -> bool:
        """Nobody waits for it any more. Returns whether something of it is in flight."""

    def connected(self, now: float) -> None:
        """A connection stands."""

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """It has ended; ``lost``: by itself."""

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """None can be had: everything that waits fails, but for what is about to be repeated if that is to stay."""

    def transmit(self, now: float) -> list[bytes]:
        """What to send now."""

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Work through what was received."""

    def deadline(self) -> float | None:
        """When `tick` or `transmit` has something to do."""

    def tick(self, now: float) -> None:
        """Let time take effect."""


def conversation_for(
    settings: LinkSettings, shared_places: Places | None = None
) -> TcpClientSession | SerialClientSession:
    """The conversation that an endpoint needs, without a connection. Raises `ConfigError`.

    ``shared_places`` are those that it has in common with the others of its client, if its limit is the client's.
    """
    name = settings.endpoint.url
    if settings.line is None:
        # A random first identifier keeps a program that starts anew from meeting replies to its predecessor.
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
        Role.MASTER,
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


def timing_of(port: SerialSettings | None) -> SerialTiming:
    """The times of a line that is set so; of a network where there is none."""
    if port is None:
        return SerialTiming.of_network()
    return SerialTiming.of_line(
        port.baud, data_bits=port.data_bits, parity=Parity(port.parity.value), stop_bits=port.stop_bits
    )


__all__ = ["ClientSession", "LineSettings", "conversation_for", "timing_of"]
