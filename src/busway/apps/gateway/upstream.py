"""An upstream of a gateway: its connections, their loss and recovery, its counters and its status.

Knows links, and clients by name only; knows no request.

1. If an upstream has several connections to one server, all requests of one client use the same one, so that they
   arrive in the order in which they were asked. The order of clients is that of `busway.session.queue`.
2. A serial port is opened with the upstream, and again whenever it is lost: the log shows what is wrong before a
   client asks. A server on a network is connected at the first request.
3. Connections are made again as by every link: `busway.session.reconnect` decides when, and
   `busway.session.connection_life` what happens to open requests. What a client is answered while an upstream is down:
   `upstream_exception_codes`.
"""

import asyncio
import contextlib
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from ...client.connector import connector_for
from ...client.link import AsyncLinkDriver
from ...client.sessions import ClientSession, client_session_for
from ...client.settings import LinkSettings
from ...codes import ExceptionCode
from ...errors import ConfigError, LinkDown, ModbusError, NoReply
from ...options.gateway import UpstreamParameters
from ...server.status_indicators import StatusIndicator, StatusIndicators
from ...session.client_counters import ClientCounters
from ...session.reconnect import ConnectionEvent
from ...session.serial_client import SerialClientSession
from ...session.unit_breaker import BreakerState
from .upstream_exception_codes import code_for
from .upstream_log import UpstreamLog

_CLIENTS_REMEMBERED = 4096


@dataclass(slots=True)
class UpstreamCounters:
    """Counters of the requests of clients to one upstream of a gateway, since the start or the last reset.

    A request that joins a read in flight is counted in ``shared``, and in no other counter unless its client is
    answered at its own deadline or disconnects.

    Attributes:
        forwarded: requests that a link accepted, to be queued or sent.
        answered: requests with a normal reply of the device, and broadcasts that were sent.
        exceptions: requests that the device refused with an exception code.
        no_path: requests answered 0A: upstream down, queue full, deadline passed in the queue.
        no_answer: requests answered 0B: they were sent and got no valid reply, or their unit does not answer.
        shared: reads that waited for an identical read in flight.
        recalled: reads that were answered with remembered values.
        abandoned: requests whose client disconnected before the reply.
        broadcasts: writes to all units.
    """

    forwarded: int = 0
    answered: int = 0
    exceptions: int = 0
    no_path: int = 0
    no_answer: int = 0
    shared: int = 0
    recalled: int = 0
    abandoned: int = 0
    broadcasts: int = 0


@dataclass(frozen=True, slots=True)
class SuspendedUnit:
    """A unit that gets no requests for now, because its breaker is open after several timeouts in a row.

    Attributes:
        unit: unit identifier on the upstream.
        state: state of the breaker: ``open`` or ``probing``.
        next_probe: seconds until a request may be sent to the unit again, to probe it; 0 if the next request is the
            probe. With the state ``probing``: seconds until the probe that was sent times out.
    """

    unit: int
    state: str
    next_probe: float


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """The status of one connection of an upstream.

    Attributes:
        state: state of the connection: a value of `ConnectionState`.
        in_flight: number of requests in flight; on serial links 0 or 1.
        queued: number of requests in the queue; on serial links number of calls, each of which may be a batch of
            requests.
        counters: counters of the link; the live object, which goes on counting.
        suspended: units that get no requests for now, because of their breaker.
        reason: why the server or port cannot be reached; empty while it can be, and before the first attempt.
        next_attempt: seconds until the next attempt to connect is allowed; None unless the state is ``backing off``.
        in_doubt: units whose reply is overdue and may still come; empty except on serial links, where a late reply
            could be taken for the reply to the next request.
    """

    state: str
    in_flight: int
    queued: int
    counters: ClientCounters
    suspended: tuple[SuspendedUnit, ...] = ()
    reason: str = ""
    next_attempt: float | None = None
    in_doubt: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class UpstreamStatus:
    """The status of an upstream: its connections, counters and indicators.

    Attributes:
        name: name of the upstream in routes.
        endpoint: URL of the upstream.
        links: the status of each connection; empty while the upstream is closed.
        counters: counters of the requests; the live object, which goes on counting.
        indicators: communication is on while replies are awaited. Error flashes while the upstream is closed or one of
            its connections cannot be made; device status is on while error is off.
    """

    name: str
    endpoint: str
    links: tuple[LinkStatus, ...]
    counters: UpstreamCounters
    indicators: StatusIndicators


class Upstream:
    """One upstream of a gateway: its connections, their log lines, counters and status.

    Args:
        name: name of the upstream in routes.
        settings: settings of the links.
        connections: number of connections to one server; 1 on a serial line.
        broadcast: whether writes to unit 0 are forwarded to the upstream; None: only if its framing is RTU or ASCII.
        clock: returns monotonic seconds, for log lines and the age of remembered values.

    Attributes:
        takes_broadcasts: whether writes to unit 0 are forwarded to the upstream.
        counters: counters of the requests.
        watch: called with the session of a link whenever calls may have ended: after received bytes, a timer, a failed
            attempt to connect, and when the link is closed. Set it before `open`; None for none.
        links: the links to the server or line; empty while the upstream is closed.
        news: writes the log lines about the upstream.
        register_width: number of bytes in a register of the upstream's devices.
        pipelines: whether several requests may be in flight at once: True with Modbus TCP framing.

    Raises:
        ConfigError: an invalid number of connections.
    """

    def __init__(
        self,
        name: str,
        settings: LinkSettings,
        *,
        connections: int = 1,
        broadcast: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        UpstreamParameters(connections=connections)  # checks the number
        if connections > 1 and settings.endpoint.carrier == "serial":
            raise ConfigError("a serial port is opened once", key="connections")
        self.name = name
        self.settings = settings
        self.takes_broadcasts: bool = settings.endpoint.framing != "mbap" if broadcast is None else broadcast
        self.counters: UpstreamCounters = UpstreamCounters()
        self._connections = connections
        self.clock = clock
        self.watch: Callable[[ClientSession], None] | None = None
        self.links: list[AsyncLinkDriver] = []
        self._keeper: asyncio.Task[None] | None = None  # keeps a serial port open
        self._port_gone = asyncio.Event()
        is_port = settings.endpoint.carrier == "serial"
        self.news: UpstreamLog = UpstreamLog(name, settings.endpoint.url, is_waited_for=is_port, clock=clock)
        self._link_of: OrderedDict[str, AsyncLinkDriver] = OrderedDict()  # by client; asked last comes last
        self._users: dict[AsyncLinkDriver, int] = {}  # number of clients of each
        self.register_width: int = settings.parameters.register_width
        self.pipelines: bool = settings.line is None  # whether it takes several requests at once

    # Open and close.

    def open(self) -> None:
        """Create the links of the upstream; does nothing if they exist. Must be called while an event loop runs.

        A task then opens a serial port; a server on a network is connected at the first request.

        Raises:
            ConfigError: the upstream cannot be used as configured.
        """
        if self.links:
            return
        for _ in range(self._connections):
            session = client_session_for(self.settings)
            session.serve_units_in_turn()
            connector = connector_for(self.settings, session, user=f"line {self.name} of a gateway")
            link = AsyncLinkDriver(connector, session, self.settings)
            if self.watch is not None:
                link.watch = partial(self.watch, session)
            link.told = self._told
            self.links.append(link)
            if self.settings.endpoint.carrier == "serial":
                self._keeper = asyncio.get_running_loop().create_task(self._keep_open(link))

    async def _keep_open(self, link: AsyncLinkDriver) -> None:
        """Open the serial port of a link now, and again whenever the port is lost, until cancelled."""
        while True:
            self._port_gone.clear()
            with contextlib.suppress(LinkDown):  # reported by its event
                await link.connect()
            if link.is_connected:
                await self._port_gone.wait()
            else:
                await asyncio.sleep(link.next_attempt or 0.01)

    def _told(self, event: ConnectionEvent, reason: str) -> None:
        """Log that a connection was opened or could not be, or that a serial port was lost; the port is then reopened.

        Args:
            event: what happened to the connection.
            reason: the cause of the event, in words.
        """
        if event is ConnectionEvent.CONNECTED:
            self.news.is_up()
        elif event is ConnectionEvent.FAILED:
            self.news.is_down(reason)
        elif event is ConnectionEvent.LOST and self._keeper is not None:
            self._port_gone.set()
            self.news.is_down(reason)

    def set_unit_gaps(self, unit_gaps: Mapping[int, float]) -> None:
        """Set for each unit the seconds of silence between its reply and the next request to it.

        Has an effect only with RTU and ASCII framing, and only on links that exist: call this after `open`.
        """
        for link in self.links:
            if isinstance(link.session, SerialClientSession):
                link.session.set_unit_gaps(unit_gaps)

    async def close(self) -> None:
        """Close the links of the upstream. Open requests are answered 0A, or 0B if they may have been sent."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            keeper.cancel()
            await asyncio.gather(keeper, return_exceptions=True)
        links, self.links = self.links, []
        self._link_of.clear()
        self._users.clear()
        for link in links:
            link.told = None  # closing is not logged
            await link.close()

    def status(self) -> UpstreamStatus:
        """Return the status of the upstream at this moment."""
        links = tuple(
            LinkStatus(
                link.reconnect.state.value,
                link.session.in_flight,
                link.session.queued,
                link.session.counters,
                _suspended(link),
                link.down_because,
                link.next_attempt,
                _in_doubt(link),
            )
            for link in self.links
        )
        return UpstreamStatus(self.name, self.settings.endpoint.url, links, self.counters, _indicators(links))

    def link_for(self, client: str) -> AsyncLinkDriver | None:
        """Return the link that sends the requests of a client (``host:port``); None while the upstream is closed.

        A new client is assigned to the link with the fewest clients, and stays with it. Of more than 4096 clients the
        one that asked longest ago is forgotten.
        """
        links = self.links
        if len(links) < 2:
            return links[0] if links else None
        link = self._link_of.get(client)
        if link is None:
            if len(self._link_of) >= _CLIENTS_REMEMBERED:
                _, left = self._link_of.popitem(last=False)
                self._users[left] -= 1
            link = min(links, key=lambda one: self._users.get(one, 0))
            self._users[link] = self._users.get(link, 0) + 1
            self._link_of[client] = link
        else:
            self._link_of.move_to_end(client)
        return link

    def refused(self, error: ModbusError) -> int:
        """Return the exception code that a client gets for the error of a forwarded request.

        Also counts the request: in ``no_path`` (code 0A), ``no_answer`` (0B) or ``exceptions`` (any other code). Logs
        0A, and 0B if the unit did not answer; repetitions are left out of the log.
        """
        code = code_for(error)
        counters = self.counters
        if code == ExceptionCode.GATEWAY_PATH_UNAVAILABLE:
            counters.no_path += 1
            cause = error.__cause__  # the log line leaves out the pause until the next attempt, which differs each time
            self.news.no_path(cause.message if isinstance(cause, LinkDown) else error.message)
        elif code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND:
            counters.no_answer += 1
            if isinstance(error, NoReply):
                self.news.no_answer(error.unit, error.message)
        else:
            counters.exceptions += 1
        return code


def _indicators(links: Sequence[LinkStatus]) -> StatusIndicators:
    """Return the status indicators of an upstream with these connections."""
    is_faulty = not links or any(link.reason for link in links)
    return StatusIndicators(
        StatusIndicator.ON if any(link.in_flight for link in links) else StatusIndicator.OFF,
        StatusIndicator.FLASHING if is_faulty else StatusIndicator.OFF,
        StatusIndicator.OFF if is_faulty else StatusIndicator.ON,
    )


def _in_doubt(link: AsyncLinkDriver) -> tuple[int, ...]:
    """Return the units of a serial link whose reply is overdue and may still come; empty for other links."""
    session = link.session
    return tuple(session.late_replies.in_doubt()) if isinstance(session, SerialClientSession) else ()


def _suspended(link: AsyncLinkDriver) -> tuple[SuspendedUnit, ...]:
    """Return the units of a link whose breaker is not closed."""
    session = link.session
    if session.breakers is None:
        return ()
    now = link.now()
    return tuple(
        SuspendedUnit(unit, state.value, session.breakers.suspended_for(unit, now) or 0.0)
        for unit, state in session.breakers.states().items()
        if state is not BreakerState.CLOSED
    )
