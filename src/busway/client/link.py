"""The asyncio driver of a link: one client session and its current connection, on an event loop.

Knows when to connect, send and check timeouts; knows no functions or values.

1. The driver connects at the first request, and reconnects at the next request after the connection was lost.
2. It has one timer, set to the earliest time at which something is due. Over TCP it is moved only to an earlier time.
   On a serial port it is an `ExactTimer`: the silence before a frame is shorter than the delay of the loop's timers.
3. Received bytes are processed at once; then the callers of completed calls are woken.
4. A connection whose hold time is limited is closed by that timer, or as soon as no request needs it.
5. On a line every frame is followed by a silence, so the timer is set anew after each step. Times on a line are those
   of ``time.monotonic``, which serial ports use.
"""

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from ..errors import LinkDown
from ..observe.connection_trace import ConnectionTrace, trace_for
from ..observe.trace import TRACE
from ..options.client import ON_STREAMS
from ..session.call import Call
from ..session.connection_life import ConnectionLife
from ..session.reconnect import ConnectionEvent, ConnectionState, Reconnect
from ..session.serial_client import SerialClientSession
from ..session.tcp_client import TcpClientSession
from ..transport.receive_buffer import receive_buffer
from ..transport.tcp import discard_on_close, link_down, network_reason, takes_bytes
from .connector import Connector
from .kept_serial_late_replies import KEPT
from .open_connections import LOCAL, LocalConnectionStatus, status_of
from .permitted_sending import PermittedConnector
from .sessions import ClientSession, reconnect_for
from .settings import LinkSettings
from .shared_limit import ClientScope
from .state_observers import DISCONNECTED, OnState, StateObservers

if TYPE_CHECKING:
    from ..transport.serial.exact_timer import ExactTimer

_log = logging.getLogger("busway.client")

CLOSING_SECONDS: Final = 2.0
"""Most seconds that closing a link waits until its serial port is closed."""
SPIN: Final = 0.0003
"""Seconds of busy loop before a frame, with ``precise_timing``: a sleeping processor wakes up about that much late."""
COARSE_SPIN: Final = 0.0015
"""Seconds of busy loop instead of `SPIN` on systems without exact timers: a loop's timers are up to 1 ms late there."""


class _LinkProtocol(asyncio.BufferedProtocol):
    """The asyncio protocol of one connection of a link.

    Each connection has its own object. The link ignores events from the object of an earlier connection.
    """

    __slots__ = ("_buffer", "_link")

    def __init__(self, link: "AsyncLinkDriver", buffer: bytearray) -> None:
        self._link = link
        self._buffer = buffer

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self._link.received(self, self._buffer, nbytes)

    def eof_received(self) -> bool:
        self._link.peer_ended(self)
        return False

    def arrived(self, data: bytes) -> None:
        self._link.received(self, data, len(data))

    def arrived_damaged(self, data: bytes, overrun: bool) -> None:
        self._link.received_damaged(self, data, overrun=overrun)

    def connection_lost(self, exc: Exception | None) -> None:
        self._link.lost(self, network_reason(exc) if exc else "the peer closed it")

    def pause_writing(self) -> None:
        self._link.pause(self, True)

    def resume_writing(self) -> None:
        self._link.pause(self, False)


class AsyncLinkDriver:
    """The asyncio driver of one link: connects, sends, receives and runs the timers of its session.

    Attributes:
        name: URL of the endpoint.
        session: the client session, which decides what is sent and when.
        reconnect: state of the connection, and when a new one may be opened.
        shared: whether all users of the endpoint share the link.
        home: the event loop that the link belongs to.
        watch: function that is called after received bytes or a timer were handled and the callers of completed calls
            were woken; a gateway sets it, to look at its incomplete calls. None: no function is called.
        told: function that is called with each event of the connection and its reason in words, after the state has
            changed. None: no function is called.
        observers: callbacks of the program for new states of the connection; None before the first is added.
        opened: when the last connection was opened, in seconds by the clock `now`; 0 before the first.
        last_used: when the last connection was last used, in seconds by the clock `now`; 0 before the first.
        sent_bytes, received_bytes: number of bytes on all connections of the link so far.
        now: returns the time in seconds; all times of calls and deadlines are by this clock.
    """

    __slots__ = (
        "__weakref__",
        "_clock",
        "_connecting",
        "_connector",
        "_exact_timer",
        "_flush_planned",
        "_frame_leaves",
        "_framing",
        "_held",
        "_hold",
        "_joins",
        "_life",
        "_line",
        "_loop",
        "_minds",
        "_outgoing",
        "_parameters",
        "_paused",
        "_protocol",
        "_scope",
        "_spin",
        "_timer",
        "_timer_at",
        "_trace",
        "_transport",
        "_writes_late",
        "home",
        "last_used",
        "name",
        "now",
        "observers",
        "opened",
        "received_bytes",
        "reconnect",
        "sent_bytes",
        "session",
        "shared",
        "told",
        "watch",
    )

    def __init__(
        self,
        connector: Connector,
        session: TcpClientSession | SerialClientSession,
        settings: LinkSettings,
        *,
        shared: bool = True,
        scope: ClientScope | None = None,
    ) -> None:
        self.name: str = settings.endpoint.url
        self._loop = asyncio.get_running_loop()
        self._connector = connector
        self._parameters = settings.parameters
        self._framing = settings.endpoint.framing
        parameters = settings.parameters
        is_stream = ON_STREAMS.fits("client", self._framing, settings.endpoint.carrier)
        self._joins = is_stream and parameters.max_transactions > 1 and not parameters.single_adu_segments
        self.session: ClientSession = session
        self._line = session if isinstance(session, SerialClientSession) else None
        self._clock = _clock_of(self._loop) if self._line is None else time.monotonic
        self.now: Callable[[], float] = self._clock
        reconnect = reconnect_for(settings)
        self.shared: bool = shared
        self.home: asyncio.AbstractEventLoop | None = self._loop
        self.watch: Callable[[], None] | None = None
        self.told: Callable[[ConnectionEvent, str], None] | None = None
        self.observers: StateObservers | None = None
        self.opened: float = 0.0
        self.last_used: float = 0.0
        self.sent_bytes: int = 0
        self.received_bytes: int = 0
        self._hold = settings.management.hold_seconds
        self._scope = scope
        self._minds = scope is not None or self._hold < math.inf  # whether `_after_use` has something to do
        self._spin = 0.0
        self._exact_timer: ExactTimer | None = None  # where a silence before each frame is kept: on a serial port
        if settings.line is not None and settings.line.port is not None:
            opening = settings.line.opening
            self._exact_timer = _new_exact_timer(self._on_timer)
            if opening.precise_timing:
                self._spin = SPIN if self._exact_timer.exact else COARSE_SPIN
        self._protocol: _LinkProtocol | None = None
        self._transport: Any = None  # an asyncio.Transport, or a connector's own transport
        self._connecting: asyncio.Task[None] | None = None
        self._frame_leaves: Callable[[], None] | None = None  # tells the session when its frame leaves
        self._held: Callable[[], int] | None = None  # how many bytes the transport has that have not left
        self._writes_late = not isinstance(self._loop, asyncio.SelectorEventLoop)  # in the same turn, but not at once
        self._paused = False
        self._timer: asyncio.TimerHandle | ExactTimer | None = None
        self._timer_at = 0.0
        self._flush_planned = False
        self._outgoing: list[bytes] = []
        self._trace: ConnectionTrace | None = None
        self.reconnect: Reconnect = reconnect
        self._life = ConnectionLife(session, reconnect, endpoint=self.name, hold=self._hold, moved=self._moved)
        LOCAL.add(self)

    # Calls of the public interface.

    def send_only_while(self, may_send: Callable[[], bool]) -> None:
        """Let the link send only while ``may_send`` returns True; this takes effect with its next connection.

        ``may_send`` is called before each connection and each write of frames (`PermittedConnector`).
        """
        self._connector = PermittedConnector(self._connector, may_send)

    def start(self, call: Call, now: float) -> "asyncio.Future[None]":
        """Begin a call; return a future that is done when all its requests have a reply or an error.

        The replies and errors are then in ``call.outcomes``; the result of the future is None. A caller that stops
        waiting for the future must call `give_up`.

        Raises:
            Overloaded, LinkDown, UnitSuspended, and on a serial line InvalidRequest: nothing was sent.
        """
        future: asyncio.Future[None] = self._loop.create_future()
        call.owner = future
        self.begin(call, now)
        return future

    def begin(self, call: Call, now: float) -> None:
        """Begin a call; its end is reported to ``call.owner``: a future, or an object with ``done`` and ``set_result``.

        ``call.owner.set_result(None)`` is called at once when the last request has its reply or error, unless
        ``call.owner.done()`` is True.

        Raises:
            Overloaded, LinkDown, UnitSuspended, and on a serial line InvalidRequest: nothing was sent.
        """
        # Usually nothing waits and there is room: then the request bypasses the queue (saves 2 of 12 µs).
        adu = None if self._transport is None or self._paused else self.session.send_now(call, now)
        if adu is not None:
            self.sent_bytes += len(adu)
            if self._joins:
                self._outgoing.append(adu)
                if not self._flush_planned:
                    self._plan_flush()
            else:
                self._transport.write(adu)
            if TRACE.level:
                self._traced().sent(adu)
        else:
            if self._transport is None and (refusal := self._life.refusal(now, call.unit)) is not None:
                raise refusal
            if call.caller is None:
                call.caller = asyncio.current_task()
            self.session.submit(call, now)
            if not self._joins:
                self._pump(now)
            elif not self._flush_planned:
                self._plan_flush()
        if self._line is not None:
            self._rearm()
            return
        soonest = now + call.timeout
        if call.deadline is not None and call.deadline < soonest:
            soonest = call.deadline
        if self._timer is None or soonest < self._timer_at:
            self._arm(soonest)

    def give_up(self, call: Call) -> None:
        """Cancel a call, because its caller no longer waits: no more of its requests are sent.

        If one of its requests is in flight and the transport still has bytes that the system has not accepted, the
        connection is closed.
        """
        self._write_outgoing()
        now = self._clock()
        if self.session.cancel(call):
            self._end_if_stuck()
        self._pump(now)
        if self._minds:
            self._after_use(now)

    def _plan_flush(self) -> None:
        self._flush_planned = True
        self._loop.call_soon(self._flush)

    async def close(self) -> None:
        """Close the link for good. Calls that wait or are under way fail with `LinkDown`.

        Writes that were sent and are not answered fail with `WriteOutcomeUnknown`. Returns when the connection is
        closed; for a serial port it waits at most `CLOSING_SECONDS`.
        """
        self._life.closed = True
        LOCAL.discard(self)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.gather(self._connecting, return_exceptions=True)
        transport = self._transport
        now = self._clock()
        if transport is not None:
            self._release(now, "the link was closed")
        self._life.ended(now)
        self._wake()
        if self._scope is not None:
            self._scope.leave(self)
            self._scope.serve(now)
        # The loop closes a socket in its next turn, and a thread closes a port; `close` returns after that.
        await asyncio.sleep(0)
        wait_closed = getattr(transport, "wait_closed", None)
        if wait_closed is not None:
            with contextlib.suppress(TimeoutError):  # a driver that is stuck holds its port as long as it likes
                await asyncio.wait_for(wait_closed(), CLOSING_SECONDS)
        if self._exact_timer is not None:
            self._exact_timer.close()
        self._connector.release()
        if self._line is not None:
            KEPT.keep(self.name, self._line.late_replies)

    def on_state(self, callback: OnState) -> Callable[[], None]:
        """Register a callback for new states of the connection. Returns a function that removes it."""
        if self.observers is None:
            self.observers = StateObservers(self.reconnect.state)
        return self.observers.add(callback)

    async def disconnect(self) -> None:
        """Close the connection, or end the attempt to open one; the next request opens another one.

        Requests in flight are repeated or fail, as after a lost connection; calls that wait for the attempt fail with
        `LinkDown`. Returns when the connection is closed; for a serial port it waits at most `CLOSING_SECONDS`.
        """
        if self._connecting is not None:
            self._connecting.cancel()
            await asyncio.gather(self._connecting, return_exceptions=True)
        transport = self._transport
        if transport is None:
            return
        now = self._clock()
        if self._is_used() and self._protocol is not None:
            self._abort()
            self.lost(self._protocol, DISCONNECTED)
        else:
            self._release(now, DISCONNECTED)
        await asyncio.sleep(0)  # the loop closes a socket in its next turn, and a thread closes a port
        wait_closed = getattr(transport, "wait_closed", None)
        if wait_closed is not None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(wait_closed(), CLOSING_SECONDS)

    @property
    def is_connected(self) -> bool:
        """Whether the link has an open connection now."""
        return self._transport is not None

    def call_at(self, when: float, callback: Callable[[], None]) -> asyncio.TimerHandle:
        """Let the event loop call ``callback`` at the time ``when``, in seconds by the clock `now`. Returns the timer.

        If that time is over, the loop calls it in its next turn.
        """
        return self._loop.call_later(max(when - self._clock(), 0.0), callback)

    @property
    def down_because(self) -> str:
        """Why the last attempt to connect failed; empty while connected and before the first attempt."""
        return self._life.down_because

    @property
    def next_attempt(self) -> float | None:
        """Seconds until another attempt to connect is allowed; None unless the state is ``backing off``.

        0 if the pause is over and the attempt has not begun yet.
        """
        if self.reconnect.state is not ConnectionState.BACKING_OFF:
            return None
        return max(self.reconnect.not_before - self._clock(), 0.0)

    async def connect(self) -> None:
        """Open the connection now, instead of at the first request.

        Does nothing if the link is connected, or closed for good.

        Raises:
            LinkDown: the attempt failed, or a pause after a failed attempt is not over.
        """
        if self.is_connected or self._life.closed:
            return
        self._ensure_connection(self._clock(), by_name=True)
        if self._connecting is not None:
            await asyncio.shield(self._connecting)
        if not self.is_connected:
            raise self._failure()

    def status(self) -> LocalConnectionStatus:
        """Return state, traffic and counters of the link at this moment."""
        local = None if self._transport is None else self._transport.get_extra_info("sockname")
        return status_of(self, self.session, self._life, self._clock(), local)

    def make_room(self) -> bool:
        """Close the connection if no call uses it, so that another link may open one. Returns whether it was closed."""
        if self._transport is None or self._is_used():
            return False
        self._release(self._clock(), "another connection needed the place")
        return True

    def serve(self, now: float) -> None:
        """Send waiting requests, because the limit that all links of the client share has room again."""
        if self.session.queue.size and self._transport is not None:
            self._pump(now)
            self._rearm()

    # Events of the connection.

    def received(self, protocol: _LinkProtocol, buffer: bytes | bytearray, size: int) -> None:
        """Process the first ``size`` bytes of ``buffer``; ignored if ``protocol`` is that of an earlier connection."""
        if protocol is not self._protocol:
            return
        now = self.last_used = self._clock()
        if TRACE.level:
            self._traced().received(bytes(buffer[:size]))
        self.received_bytes += size
        session = self.session
        session.receive(buffer, size, now)
        if not self.reconnect.is_settled:
            self._life.replied(now)
        if session.finished or self.watch is not None:
            self._wake()
        if session.recycle or (session.queue.size and self._scope is None):
            self._pump(now)
        if self._line is not None:
            self._rearm()
        if self._minds:
            self._after_use(now)

    def received_damaged(self, protocol: _LinkProtocol, data: bytes, *, overrun: bool) -> None:
        """Process received bytes of which some are damaged; ignored if ``protocol`` is that of an earlier connection.

        ``overrun``: whether characters were lost between them, besides errors of parity and framing.
        """
        if protocol is not self._protocol or self._line is None:
            return
        if TRACE.level:
            self._traced().received(data)
        self._line.receive_damaged(data, self._clock(), overrun=overrun)
        self._rearm()

    def peer_ended(self, protocol: _LinkProtocol) -> None:
        """Handle the end of the peer's stream: if bytes are unsent, drop them and close the connection at once.

        The peer would not answer them. Without unsent bytes nothing is done here: asyncio closes the connection.
        Ignored if ``protocol`` is that of an earlier connection.
        """
        if protocol is self._protocol and self._held is not None and self._held():
            self._abort()

    def lost(self, protocol: _LinkProtocol, reason: str) -> None:
        """Handle the end of the connection for ``reason``; ignored if ``protocol`` is that of an earlier connection."""
        if protocol is not self._protocol:
            return
        self._forget_connection()
        now = self._clock()
        session = self.session
        self._life.lost(now, reason)
        self._wake()
        if session.queue.size:
            self._pump(now)
        if self._scope is not None:
            self._scope.serve(now)

    def pause(self, protocol: _LinkProtocol, paused: bool) -> None:
        """Stop sending if ``paused``, because the transport's write buffer is full; otherwise send what waits.

        Ignored if ``protocol`` is that of an earlier connection.
        """
        if protocol is self._protocol:
            self._paused = paused
            if not paused:
                self._pump(self._clock())
                self._rearm()

    # Inside.

    def _flush(self) -> None:
        self._flush_planned = False
        self._write_outgoing()
        if self.session.queue.size:
            self._pump(self._clock())

    def _write_outgoing(self) -> None:
        """Write all frames that were collected during this turn of the event loop with one call."""
        outgoing = self._outgoing
        if outgoing:
            self._transport.write(b"".join(outgoing))
            outgoing.clear()

    def _pump(self, now: float) -> None:
        """Send all requests that are due; without a connection, begin to open one if requests wait.

        Closes the connection instead if the session asks for a new one. Sends nothing while the write buffer is full.
        With ``precise_timing`` ``now`` can be shortly in the future: the frame is prepared at once, and sent at that
        time.
        """
        session = self.session
        if self._transport is None:
            if session.queue.size and not self._life.closed:
                self._ensure_connection(now)
            return
        out = [] if self._paused or not session.queue.size else session.transmit(now)
        if session.recycle:
            self._recycle(now)
        elif out:
            transport = self._transport
            if self._outgoing:
                self._write_outgoing()  # keep the order of the calls
            while self._spin and self._clock() < now:
                pass
            if self._joins:
                out = [b"".join(out)]
            for chunk in out:
                self.sent_bytes += len(chunk)
                transport.write(chunk)
            if TRACE.level:
                self._traced().sent(b"".join(out))
            if session.breakers is not None and session.breakers.doubtful and self._line is None:
                self._rearm()  # a probe waits for less than its call
        else:
            if session.finished:  # a breaker has opened, and calls to its unit have failed
                self._wake()
            if session.has_gap:
                self._rearm()

    def _recycle(self, now: float) -> None:
        """Close the connection, because the session asks for a new one (``recycle``).

        Waiting calls then open another one.
        """
        if self._protocol is not None:
            self._abort()
            self.lost(self._protocol, f"reconnecting after {self.session.recycle}")

    def _end_if_stuck(self) -> None:
        """Close the connection if a call has ended and bytes of it are still unsent: they would be sent later."""
        if self._held is None or not self._held() or self._protocol is None:
            return
        if self._writes_late and takes_bytes(self._transport.get_extra_info("socket")):
            return  # they leave at the end of this turn of the loop
        self._abort()
        self.lost(self._protocol, "a call ended before the connection had taken its request")

    def _close_transport(self) -> None:
        """Close the link's connection without telling the session; bytes that are not sent yet are dropped."""
        transport = self._transport
        if self._held is not None and self._held():
            self._abort()
        else:
            transport.close()
        self._forget_connection()

    def _abort(self) -> None:
        """Close the connection at once and drop the bytes that the transport and the system have not sent."""
        if self._held is not None and self._held():
            discard_on_close(self._transport.get_extra_info("socket"))
        self._transport.abort()

    def _forget_connection(self) -> None:
        """Clear the fields that belong to the ended connection, and its unsent bytes."""
        self._transport = self._protocol = self._frame_leaves = self._held = None
        self._outgoing.clear()
        self._paused = False

    def _after_use(self, now: float) -> None:
        """Let other links of the client send if the common limit has room, and see to the hold time of the connection.

        An unused connection is closed if its hold time is over; otherwise the timer is set to the end of that time.
        """
        if self._scope is not None:
            self._scope.serve(now)
        if self._hold == math.inf or self._transport is None or self._is_used() or self.session.deadline() is not None:
            return
        until = self.last_used + self._hold
        reason = self._life.spent(now, self.last_used)
        if reason:
            self._release(now, reason)
        elif self._timer is None or until < self._timer_at:
            self._arm(until)

    def _is_used(self) -> bool:
        return self.session.queue.size > 0 or self.session.in_flight > 0

    def _release(self, now: float, reason: str) -> None:
        """Close the connection on purpose, for ``reason``; it does not count as lost. The next request opens another.

        Usually no call uses it. Requests in flight, if there are any, are repeated or fail.
        """
        self._close_transport()
        self._life.released(now, reason)

    def _moved(self, event: ConnectionEvent, reason: str, news: str) -> None:
        """Handle an event of the connection: call `told` and the observers, and log the text ``news`` unless empty."""
        if news:
            # With one connection per request (hold=request), opening and closing are no news for an operator.
            _log.log(logging.INFO if self._hold else logging.DEBUG, "%s: %s", self.name, news)
        if self.told is not None:
            self.told(event, reason)
        if self.observers is not None:
            self.observers.notify(self.reconnect.state, reason)

    def _ensure_connection(self, now: float, *, by_name: bool = False) -> None:
        if self._connecting is not None:
            return
        if self._life.may_dial(now):
            self._life.dialled(now)
            self._connecting = self._loop.create_task(self._connect(by_name=by_name))
        elif self.reconnect.state is ConnectionState.BACKING_OFF:
            self._arm(self.reconnect.not_before)

    def _failure(self) -> LinkDown:
        failure = self._life.failure
        if failure is None:
            return LinkDown("no connection", kind="other", endpoint=self.name)
        again = LinkDown(failure.message, kind=failure.kind, endpoint=self.name)
        again.__cause__ = failure
        return again

    async def _connect(self, *, by_name: bool) -> None:
        protocol = _LinkProtocol(self, receive_buffer(self._loop))
        try:
            LOCAL.make_room(self, self.name)
            transport = await self._connector.connect(lambda: protocol)
        except Exception as error:  # usually a `LinkDown`; waiting calls must end with any error
            self._not_connected(error if isinstance(error, LinkDown) else link_down(error, endpoint=self.name))
            return
        except asyncio.CancelledError:
            reason = "the link was closed" if self._life.closed else "no connection: the attempt was cancelled"
            self._not_connected(LinkDown(reason, kind="closed", endpoint=self.name))
            raise
        self._connecting = None
        now = self._clock()
        self._protocol, self._transport = protocol, transport
        self._frame_leaves = getattr(transport, "still_sending", None)
        self._held = getattr(transport, "get_write_buffer_size", None)
        self._trace = None
        self.opened = self.last_used = now
        if self._line is not None:
            KEPT.hand_over(self.name, self._line.late_replies)
        self._life.connected(now)
        if transport.is_closing():
            self.lost(protocol, "the peer closed it at once")
        self._pump(now)
        self._rearm()
        if self._minds and (self._hold or not by_name):  # after `connect` it stays open for the first request
            self._after_use(now)

    def _not_connected(self, failure: LinkDown) -> None:
        """Handle a failed attempt to connect: the calls that waited for a connection fail with ``failure``."""
        self._connecting = None
        self._life.failed(self._clock(), failure)
        self._wake()

    def _wake(self) -> None:
        """Wake the callers of all calls that have ended, and call `watch`."""
        finished = self.session.finished
        while finished:
            owner = finished.pop(0).owner
            if owner is not None and not owner.done():
                owner.set_result(None)
        if self.watch is not None:
            self.watch()

    def _arm(self, when: float) -> None:
        self._timer_at = when
        if self._exact_timer is not None:
            self._exact_timer.set(when - self._spin)
            self._timer = self._exact_timer
            return
        if self._timer is not None:
            self._timer.cancel()
        if self._line is not None:  # the loop's clock may be another one
            when = self._loop.time() + (when - self._clock())
        self._timer = self._loop.call_at(when, self._on_timer)

    def _rearm(self) -> None:
        if self._line is not None and self._line.notes:
            self._trace_notes(self._line.notes)
        deadline = self.session.deadline()
        if self._transport is None and self.reconnect.state is ConnectionState.BACKING_OFF and self.session.queue.size:
            deadline = min(deadline or self.reconnect.not_before, self.reconnect.not_before)
        if deadline is not None:
            if self._timer is None or deadline != self._timer_at:
                self._arm(deadline)
        elif self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _trace_notes(self, notes: list[str]) -> None:
        if TRACE.level:
            for note in notes:
                self._traced().note(note)
        notes.clear()

    def _on_timer(self) -> None:
        self._timer = None
        now = self._clock()
        if self._line is not None:
            now = self._on_line_timer(now)
        timed_out = self._life.tick(now)
        if timed_out:
            self.last_used = now
        if timed_out or self.session.finished:
            self._end_if_stuck()
        self._wake()
        self._pump(now)
        self._rearm()
        if self._minds:
            self._after_use(now)

    def _on_line_timer(self, now: float) -> float:
        """Handle the timer of a link on a line, and return the time afterwards.

        With ``precise_timing``, a frame that is due within 2 × ``_spin`` is prepared now, and sent when it is due,
        after a busy loop; otherwise the caller sends it. While a request is in flight, the session is also told if
        the port still holds characters of the frame.
        """
        if self._spin and now < self._timer_at <= now + 2 * self._spin:
            self._pump(self._timer_at)  # preparing the frame takes a tenth of a millisecond
            now = self._clock()
        if self.session.in_flight and self._frame_leaves is not None:
            self._frame_leaves()
        return now

    def _traced(self) -> ConnectionTrace:
        if self._trace is None:
            self._trace = trace_for(self._framing, self.name, is_server=False, carrier=self._transport)
        return self._trace


def _clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Return the clock of an event loop; ``time.monotonic`` for asyncio's own loops, because it is faster to call."""
    is_plain = getattr(loop.time, "__func__", None) is asyncio.BaseEventLoop.time
    return time.monotonic if is_plain else loop.time


def _new_exact_timer(ring: Callable[[], None]) -> "ExactTimer":
    from ..transport.serial.exact_timer import ExactTimer  # here: links to networks do without it

    return ExactTimer(ring)
