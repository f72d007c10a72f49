"""An upstream of a gateway: its links, and the requests that wait for them.

Knows links and calls; knows no listener beyond the context of a request.

1. Each request ends exactly once: with the device's answer, with its exception, or with 0A or 0B.
2. The order on the upstream is that of its scheduler: round robin over the connections in front, see
   `busway.session.queue`.
3. A client that goes away takes its queued requests with it; the one on the wire finishes, and its answer is dropped.
4. Where an upstream has several connections to one server, all requests of one client use the same one, so that they
   arrive in the order in which they were asked.
5. A serial port is opened when the upstream is, and again whenever it has gone: its operator knows what is wrong with
   it before a client does. A server on a network is dialled at the first need.
"""

import asyncio
import contextlib
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from ...client.connector import connector_for
from ...client.conversation import conversation_for
from ...client.link import AsyncLinkDriver
from ...client.settings import LinkSettings
from ...codes import ExceptionCode
from ...errors import ConfigError, InvalidRequest, LinkDown, ModbusError, NoReply
from ...pdu.general import ExceptionResponse
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...pdu.wide import MAX_DATA, NARROW, wide
from ...server.diagnosis import StatusIndicator, StatusIndicators
from ...session.breaker import BreakerState
from ...session.call import Call
from ...session.call_tracker import ClientCounters
from ...session.client import TcpClientSession
from ...session.handler import LATER, Deferral, RequestContext
from ...session.reconnect import ConnectionEvent
from ...session.serial_client import SerialClientSession
from .answers import code_for
from .memory import Key, Memory, Place
from .news import UpstreamNews
from .read_batches import FOR_EVER, ReadBatch, ReadBatches
from .routes import Route
from .translation import client_reply, upstream_requests
from .waiters import WaiterDeadlines

MAX_CONNECTIONS = 16
_READS = (ReadRegisters, ReadBits)  # a union would be made anew at every look: 0.15 µs
_CLIENTS_REMEMBERED = 4096


@dataclass(slots=True)
class UpstreamCounters:
    """What happened to the requests of an upstream.

    Attributes:
        forwarded: requests that were handed to a link.
        answered: requests that got the device's answer.
        exceptions: requests that the device refused.
        no_path: requests answered 0A: upstream down, queue full, or not to be asked so.
        no_answer: requests answered 0B.
        shared: reads that were answered by another's read in flight.
        recalled: reads that were answered from memory.
        abandoned: requests whose client had gone.
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
    """A unit that is not asked, because it did not answer.

    Attributes:
        unit: the unit, as it is behind.
        state: ``open`` or ``probing``.
        next_probe: seconds until a request may ask it again; 0: the next one does.
    """

    unit: int
    state: str
    next_probe: float


@dataclass(frozen=True, slots=True)
class LinkStatus:
    """One connection of an upstream.

    Attributes:
        state: where it stands.
        in_flight: requests whose reply is awaited.
        queued: requests that wait for their turn.
        counters: what happened on it.
        suspended: units that are not asked now.
        reason: why it cannot be reached; empty while it can be, and before the first attempt.
        next_attempt: seconds until it is tried again at the earliest; None where the next request tries it.
        in_doubt: units that owe replies, on links without transaction numbers.
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
    """An upstream as a status shows it.

    Attributes:
        name, endpoint: what routes call it, and where it leads.
        links: its connections.
        counters: what happened to its requests.
        indicators: communication is on while replies are awaited, error flashes while it cannot be reached.
    """

    name: str
    endpoint: str
    links: tuple[LinkStatus, ...]
    counters: UpstreamCounters
    indicators: StatusIndicators


class _Exchange:
    """One call to an upstream, and all clients that wait for it; a completion callback of `AsyncLinkDriver.begin`."""

    # Most are one client's, and neither shared nor remembered: those have no slot to fill (1 of 15 µs).
    key: Key | None = None
    deadlines: WaiterDeadlines[RequestContext] | None = None  # where several wait
    since: int = 0
    began: float = 0.0
    call: Call

    def __init__(
        self, upstream: "Upstream", link: AsyncLinkDriver, unit: int, waiter: tuple[RequestContext, Request, Route]
    ) -> None:
        self.upstream = upstream
        self.link = link
        self.unit = unit
        self.waiters = [waiter]
        self.is_write = waiter[1].is_write
        waiter[0].gone = self.asker_gone

    def asker_gone(self) -> None:
        """The client that asked first has gone."""
        self.upstream.gone(self, self.waiters[0][0])

    def done(self) -> bool:
        """Never: `set_result` is called once."""
        return False

    def set_result(self, result: None) -> None:
        """All outcomes are there."""
        self.upstream.ended(self)

    @property
    def is_sent(self) -> bool:
        """Whether something of it was sent."""
        return bool(self.call.next or self.call.attempts)


class Upstream:
    """One upstream: where routes lead.

    Args:
        name: what routes call it.
        settings: of its links.
        connections: how many there are to one server; 1 on a serial line.
        share_reads: whether identical reads in flight are asked once.
        broadcast: whether a write to unit 0 goes there; None: where the framing is that of a serial line.
        same_device: units that are the same device, group by group.
        clock: seconds, by which values that are remembered grow old.
    """

    def __init__(
        self,
        name: str,
        settings: LinkSettings,
        *,
        connections: int = 1,
        share_reads: bool = True,
        broadcast: bool | None = None,
        same_device: Iterable[Collection[int]] = (),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not 1 <= connections <= MAX_CONNECTIONS:
            raise ConfigError(f"must be 1…{MAX_CONNECTIONS}, not {connections}", key="connections")
        if connections > 1 and settings.endpoint.carrier == "serial":
            raise ConfigError("a serial port is opened once", key="connections")
        self.name = name
        self.settings = settings
        self.share_reads = share_reads
        self.takes_broadcasts = settings.endpoint.framing != "mbap" if broadcast is None else broadcast
        self.counters = UpstreamCounters()
        self._connections = connections
        self._clock = clock
        self._links: list[AsyncLinkDriver] = []
        self._keeper: asyncio.Task[None] | None = None  # of a serial port
        self._port_gone = asyncio.Event()
        is_port = settings.endpoint.carrier == "serial"
        self.news = UpstreamNews(name, settings.endpoint.url, is_waited_for=is_port, clock=clock)
        self._link_of: OrderedDict[str, AsyncLinkDriver] = OrderedDict()  # by client; who asked last comes last
        self._users: dict[AsyncLinkDriver, int] = {}  # how many of them each has
        self._width = settings.parameters.register_width
        self.memory: Memory[_Exchange | ReadBatch] = Memory(self._width, same_device)
        self.batches = ReadBatches(self)
        self._open = 0
        self._answered: asyncio.Event | None = None  # where somebody waits until nothing is open

    # Its life.

    def open(self) -> None:
        """Make the links; a port is opened soon, the others connect at need. In a coroutine. Raises `ConfigError`."""
        if self._links:
            return
        for _ in range(self._connections):
            session = conversation_for(self.settings)
            session.serve_units_in_turn()
            connector = connector_for(self.settings, session, user=f"line {self.name} of a gateway")
            link = AsyncLinkDriver(connector, session, self.settings)
            if isinstance(session, TcpClientSession):
                link.watch = partial(self.batches.look, session)
            link.told = self._told
            self._links.append(link)
            if self.settings.endpoint.carrier == "serial":
                self._keeper = asyncio.get_running_loop().create_task(self._keep_open(link))

    async def _keep_open(self, link: AsyncLinkDriver) -> None:
        """Have the port open, now and whenever it has gone."""
        while True:
            self._port_gone.clear()
            with contextlib.suppress(LinkDown):  # it is told by its event
                await link.connect()
            if link.is_connected:
                await self._port_gone.wait()
            else:
                await asyncio.sleep(link.next_attempt or 0.01)

    def _told(self, event: ConnectionEvent, reason: str) -> None:
        """Something has happened to a connection."""
        if event is ConnectionEvent.CONNECTED:
            self.news.is_up()
        elif event is ConnectionEvent.FAILED:
            self.news.is_down(reason)
        elif event is ConnectionEvent.LOST and self._keeper is not None:
            self._port_gone.set()
            self.news.is_down(reason)

    def leave_alone(self, unit_gaps: Mapping[int, float]) -> None:
        """Leave units alone for so many seconds after their replies; on serial lines only."""
        for link in self._links:
            if isinstance(link.session, SerialClientSession):
                link.session.leave_alone(unit_gaps)

    async def close(self) -> None:
        """Close the links. What still waits is answered 0A."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            keeper.cancel()
            await asyncio.gather(keeper, return_exceptions=True)
        links, self._links = self._links, []
        self._link_of.clear()
        self._users.clear()
        for link in links:
            link.told = None  # that we close it is no news
            await link.close()

    async def wait_until_answered(self) -> None:
        """Wait until no request is open."""
        if self._open:
            self._answered = asyncio.Event()
            await self._answered.wait()

    def add_open(self, count: int) -> None:
        """So many requests more are open; fewer, if the number is negative."""
        self._open += count
        if not self._open and self._answered is not None:
            self._answered.set()

    @property
    def takes_batches(self) -> bool:
        """Whether reads that are asked together may go there together."""
        return self.settings.line is None and self._width == NARROW

    @property
    def open_requests(self) -> int:
        """Requests that are not answered yet."""
        return self._open

    def status(self) -> UpstreamStatus:
        """How it stands."""
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
            for link in self._links
        )
        return UpstreamStatus(self.name, self.settings.endpoint.url, links, self.counters, _indicators(links))

    # Requests.

    def forward(
        self, context: RequestContext, request: Request, route: Route, *, deadline: float | None
    ) -> Message | Deferral:
        """Ask a device for a client.

        Args:
            context: who asks; it gets the answer.
            request: what the client asks.
            route: what becomes of it.
            deadline: seconds after which the client has given up; None if that is not known.
        """
        unit = route.upstream_unit(context.unit)
        key = None
        if isinstance(request, _READS):
            if self._width != NARROW and isinstance(request, ReadRegisters) and request.count * self._width > MAX_DATA:
                return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_DATA_VALUE)
            if route.cache is not None:
                data = self.memory.recall(unit, _place(request, route), self._clock(), for_seconds=route.cache)
                if data is not None:
                    self.counters.recalled += 1
                    return self._recalled(request, data)
            limit = route.max_bits if isinstance(request, ReadBits) else route.max_registers
            if self.share_reads or route.cache is not None:
                key = (request.code, request.address + route.shift, request.count, limit or 0)
            exchange = self.memory.reading(unit, key) if self.share_reads and key is not None else None
            assert exchange is None or isinstance(exchange, _Exchange)  # by its key
            # What waits in the queue for others is no way for a priority host: its own read goes before.
            if exchange is not None and (not context.is_priority or exchange.call.is_priority or exchange.is_sent):
                self._share(exchange, (context, request, route), deadline)
                return LATER
        try:
            sent = upstream_requests(request, route, self._width)
        except InvalidRequest:
            return ExceptionResponse(context.function, ExceptionCode.ILLEGAL_DATA_ADDRESS)
        link = self.link_for(context.peer)
        if link is None:
            self.counters.no_path += 1
            return ExceptionResponse(context.function, ExceptionCode.GATEWAY_PATH_UNAVAILABLE)
        exchange = _Exchange(self, link, unit, (context, request, route))
        exchange.key = key
        error = self._begin(exchange, sent, route, deadline, context)
        if error is not None:
            return ExceptionResponse(context.function, self.refused(error))
        return LATER

    def broadcast(
        self, context: RequestContext, request: Request, route: Route, *, deadline: float | None
    ) -> Message | Deferral:
        """Send a write to all units of the upstream, and answer when it was sent. Arguments: as those of `forward`."""
        outcome = self.forward(context, request, route, deadline=deadline)
        self.counters.broadcasts += outcome is LATER
        return outcome

    def _recalled(self, request: ReadRegisters | ReadBits, data: bytes) -> Message:
        if isinstance(request, ReadRegisters):
            return wide(type(request), self._width).Reply(data)
        return request.Reply(data)

    def _share(
        self, exchange: _Exchange, waiter: tuple[RequestContext, Request, Route], deadline: float | None
    ) -> None:
        """Wait for a read that another client has asked."""
        self.counters.shared += 1
        exchange.waiters.append(waiter)
        waiter[0].gone = partial(self.gone, exchange, waiter[0])
        call, now = exchange.call, exchange.link.now()
        if exchange.deadlines is None:
            exchange.deadlines = WaiterDeadlines(
                exchange.link.now, exchange.link.call_at, partial(self._time_is_over, exchange)
            )
            if call.deadline is not None:
                for context, _, _ in exchange.waiters[:-1]:
                    exchange.deadlines.add(context, call.deadline)
        if deadline is not None:
            exchange.deadlines.add(waiter[0], now + deadline)
        if call.deadline is not None:  # whoever came first may have less time than who comes now
            call.deadline = max(call.deadline, now + (FOR_EVER if deadline is None else deadline))

    def _time_is_over(self, exchange: _Exchange, context: RequestContext) -> None:
        """One of those who share a read waits no longer; the others do."""
        if not any(one[0] is context for one in exchange.waiters):
            return  # he has gone
        self._withdraw(exchange, context)
        if exchange.is_sent:
            error = NoReply("no answer before the deadline of the call", attempt=1)
        else:
            error = NoReply("the deadline passed in the queue; nothing was sent")
        context.refuse(self.refused(error))

    def _begin(
        self,
        exchange: _Exchange,
        sent: tuple[Request, ...],
        route: Route,
        deadline: float | None,
        context: RequestContext,
    ) -> ModbusError | None:
        """Hand the requests to the link; the error if they were not taken."""
        parameters = self.settings.parameters
        link = exchange.link
        now = link.now()
        is_write = exchange.is_write
        call = exchange.call = Call(
            exchange.unit,
            sent,
            is_write=is_write,
            timeout=route.timeout or parameters.timeout,
            retries=parameters.retries,
            deadline=None if deadline is None else now + deadline,
            caller=context.peer,
        )
        if context.is_priority:
            call.is_priority = True
        call.owner = exchange
        # All before it begins: it may end at once, while a connection is made anew.
        self.add_open(1)
        if is_write:
            self.memory.write_begins(exchange.unit)
        elif exchange.key is not None:
            exchange.since = self.memory.read_begins(exchange.unit, exchange.key, exchange)
            if route.cache is not None:
                exchange.began = self._clock()
        try:
            link.begin(call, now)
        except ModbusError as error:
            self._leave(exchange)
            return error.with_traceback(None)  # its frames hold the one that holds it
        self.counters.forwarded += 1
        return None

    def link_for(self, client: str) -> AsyncLinkDriver | None:
        """The connection that the requests of a client (``host:port``) use; None while the upstream is closed."""
        links = self._links
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

    # What comes back.

    def ended(self, exchange: _Exchange) -> None:
        """A demand has all its outcomes: answer everybody who waits for it."""
        self._leave(exchange)
        call = exchange.call
        replies: list[Message] = []
        for outcome in call.outcomes:
            if isinstance(outcome, Message):
                replies.append(outcome)
            elif outcome is not None:
                code = self.refused(outcome)
                for context, _, _ in exchange.waiters:
                    context.refuse(code)
                return
        self.counters.answered += 1
        for context, request, route in exchange.waiters:
            reply = client_reply(request, route, call.requests, replies)
            if route.cache is not None and exchange.began:
                self._remember(exchange, request, route, reply)
            context.reply(reply)

    def _remember(self, exchange: _Exchange, request: Request, route: Route, reply: Message) -> None:
        if isinstance(request, ReadRegisters | ReadBits):
            assert isinstance(reply, ReadRegisters.Reply | ReadBits.Reply)
            place = _place(request, route)
            self.memory.remember(exchange.unit, place, reply.data, since=exchange.since, read_at=exchange.began)

    def refused(self, error: ModbusError) -> int:
        """The exception code for an error, counted."""
        code = code_for(error)
        counters = self.counters
        if code == ExceptionCode.GATEWAY_PATH_UNAVAILABLE:
            counters.no_path += 1
            cause = error.__cause__  # without the pause until the next attempt, which differs each time
            self.news.no_path(cause.message if isinstance(cause, LinkDown) else error.message)
        elif code == ExceptionCode.GATEWAY_TARGET_FAILED_TO_RESPOND:
            counters.no_answer += 1
        else:
            counters.exceptions += 1
        return code

    def gone(self, exchange: _Exchange, context: RequestContext) -> None:
        """A client has gone: when nobody is left who waits, the request is taken back as far as it can be."""
        self.counters.abandoned += 1
        self._withdraw(exchange, context)

    def _withdraw(self, exchange: _Exchange, context: RequestContext) -> None:
        """One of those who wait does not any more."""
        exchange.waiters = [one for one in exchange.waiters if one[0] is not context]
        call = exchange.call
        if not exchange.waiters and not call.ended:
            if call.is_write and (call.next or call.attempts):
                return  # it is on the wire: nobody may share or recall a read until it has ended
            self._leave(exchange)
            exchange.link.give_up(call)

    def _leave(self, exchange: _Exchange) -> None:
        self.add_open(-1)
        if exchange.deadlines is not None:
            exchange.deadlines.close()
            exchange.deadlines = None  # its timer's callback holds the exchange
        if exchange.is_write:
            self.memory.write_ended(exchange.unit)
        elif exchange.key is not None:
            self.memory.read_ended(exchange.unit, exchange.key, exchange)
        # Else each request would be left to the collector of garbage, whose pauses are 20 ms under a flood.
        exchange.call.owner = None
        for context, _, _ in exchange.waiters:
            context.gone = None


def _indicators(links: Sequence[LinkStatus]) -> StatusIndicators:
    """What the status indicators of an upstream show."""
    is_faulty = not links or any(link.reason for link in links)
    return StatusIndicators(
        StatusIndicator.ON if any(link.in_flight for link in links) else StatusIndicator.OFF,
        StatusIndicator.FLASHING if is_faulty else StatusIndicator.OFF,
        StatusIndicator.OFF if is_faulty else StatusIndicator.ON,
    )


def _in_doubt(link: AsyncLinkDriver) -> tuple[int, ...]:
    """The units that owe replies."""
    session = link.session
    return tuple(session.doubts.in_doubt()) if isinstance(session, SerialClientSession) else ()


def _suspended(link: AsyncLinkDriver) -> tuple[SuspendedUnit, ...]:
    """The units that are not asked now."""
    session = link.session
    if session.breakers is None:
        return ()
    now = link.now()
    return tuple(
        SuspendedUnit(unit, state.value, session.breakers.suspended_for(unit, now) or 0.0)
        for unit, state in session.breakers.states().items()
        if state is not BreakerState.CLOSED
    )


def _place(request: ReadRegisters | ReadBits, route: Route) -> Place:
    """What a read in front touches behind."""
    assert request.reads is not None
    return request.reads.table, request.address + route.shift, request.count
