"""The interface of client sessions that link drivers use, and the choice of the session for an endpoint.

Knows no connection.
"""

import random
from typing import Protocol

from ..errors import ModbusError
from ..framing.character_times import Parity, SerialTiming
from ..framing.echo import Echo
from ..framing.frame_direction import LineRole
from ..options.ports import SerialSettings
from ..session.call import Call, FreeSlots
from ..session.client_counters import ClientCounters
from ..session.queue import RequestQueue
from ..session.reconnect import Reconnect
from ..session.serial_client import SerialClientSession
from ..session.tcp_client import TcpClientSession
from ..session.unit_breaker import Breakers
from .settings import LinkSettings


class ClientSession(Protocol):
    """Interface of a client session, which decides without IO what a link sends, awaits and repeats.

    The driver of the link calls it; ``now`` is always the time in seconds, by one monotonic clock.

    Attributes:
        counters: counters of requests, replies and errors of the link.
        queue: the calls that have requests left to send; its ``size`` is their number.
        finished: calls whose requests all have a reply or an error; the driver wakes their callers, and empties it.
        recycle: why the driver must close the connection and open another; empty while it may stay open.
        valid_reply: whether a reply to a request has come over the present connection; the driver sets it to False
            after a timeout, to see whether another comes.
    """

    counters: ClientCounters
    queue: RequestQueue
    finished: list[Call]
    recycle: str
    valid_reply: bool

    @property
    def breakers(self) -> Breakers | None:
        """The breakers of the units, which make requests to silent units fail at once; None if that is switched off."""

    @property
    def has_gap(self) -> bool:
        """Whether requests wait only for the end of a required pause (``request_gap``, ``connect_delay``)."""

    @property
    def in_flight(self) -> int:
        """Number of requests that were sent and whose reply is awaited."""

    @property
    def queued(self) -> int:
        """Number of calls that have requests left to send.

        On Modbus TCP a call of a gateway counts once for each request that is not sent yet.
        """

    def submit(self, call: Call, now: float) -> None:
        """Put the requests of a call into the queue. Raises `ModbusError` if it is refused; nothing was sent then."""

    def send_now(self, call: Call, now: float) -> bytes | None:
        """Return the bytes of a call that can be sent at once, and count them as sent.

        Returns None if the call has to be queued with `submit`; then nothing has changed.
        """

    def serve_units_in_turn(self) -> None:
        """From now on, take requests unit by unit in rotation, so that a slow unit does not delay the others."""

    def cancel(self, call: Call) -> bool:
        """Cancel a call: no more of its requests are sent. Returns whether any of them is in flight."""

    def connected(self, now: float) -> None:
        """Tell the session that the link has an open connection."""

    def disconnected(self, now: float, reason: str, *, lost: bool = True) -> None:
        """Tell the session that the connection ended; its unanswered requests are repeated or fail.

        ``lost`` is False if the client itself closed the connection on purpose; ``reason`` is in words.
        """

    def begin_again(self) -> None:
        """Forget all calls and the connection, which is closed: an exception may have left them inconsistent."""

    def resume(self, call: Call, now: float) -> None:
        """Queue a call again after `begin_again`: what was sent is repeated or fails as after a lost connection."""

    def unreachable(self, now: float, error: ModbusError, *, keep_repeated: bool = False) -> None:
        """End all waiting calls with ``error``, because no connection could be opened.

        If ``keep_repeated``, a call of which a request is about to be repeated keeps waiting.
        """

    def transmit(self, now: float) -> list[bytes]:
        """Return the frames to send at ``now``, in order, and count them as sent; empty if none is due."""

    def receive(self, buffer: bytes | bytearray, size: int, now: float) -> None:
        """Process the first ``size`` bytes of ``buffer``, which the connection has received."""

    def deadline(self) -> float | None:
        """Return the time at which `tick` or `transmit` has to be called next, by the clock of ``now``; None: never."""

    def tick(self, now: float) -> None:
        """End or repeat requests whose timeout has passed, and end calls whose deadline has passed."""


def client_session_for(
    settings: LinkSettings, shared_slots: FreeSlots | None = None
) -> TcpClientSession | SerialClientSession:
    """Create the client session for an endpoint. Nothing is opened.

    Returns:
        A session for Modbus TCP, or for a serial line (RTU and ASCII framing, also over a network).

    Args:
        settings: the settings of the link.
        shared_slots: with the option ``scope=client``, the list from which all links of a client take the slots for
            their requests in flight; None if the session has its own limit. Ignored for a serial line.

    Raises:
        ConfigError: ``strict_timing`` is set for a line over a network, or ``gap_limit`` is shorter than t3.5.
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
    from ..session.line_framing import line_framing  # here: Modbus TCP does without it

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
    """Return the object that decides when a link connects again, with the pauses of the link's options.

    For a serial port these are the options for reopening (``reopen_first``, ``reopen_most``).
    """
    if settings.line is not None and settings.line.port is not None:
        opening = settings.line.opening
        return Reconnect(random.random, first=opening.reopen_first, most=opening.reopen_most)
    management = settings.management
    return Reconnect(random.random, first=management.reconnect_first, most=management.reconnect_most)


def timing_of(port: SerialSettings | None) -> SerialTiming:
    """Return the character time and the silences (t1.5, t3.5) of a serial port, or of a network if ``port`` is None."""
    if port is None:
        return SerialTiming.of_network()
    return SerialTiming.of_line(
        port.baud, data_bits=port.data_bits, parity=Parity(port.parity.value), stop_bits=port.stop_bits
    )
