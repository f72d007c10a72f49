"""The blocking driver of a link: one client session, one socket, any number of threads, and no thread of its own.

Knows when to connect, send, wait and check timeouts; knows no functions or values.

1. The session is used only under the lock of the link; no wait at a socket and no connecting happens under the lock.
2. One of the threads that wait for replies is the leader: it connects, waits at the socket and passes received bytes to
   the session. When the leader's own call is complete, the next waiting thread becomes the leader.
3. Every waiting thread watches the timeouts of the link itself, so it does not depend on how long the leader waits.
4. Before the first request after a pause the socket is checked: if the peer closed the idle connection, a new one is
   opened without an error. On a line, bytes received since the last call are read before each request: they are late
   replies, or traffic of others.
5. Nothing runs between calls. So a connection that has been unused for the time of ``hold`` is closed only at the next
   call, which opens another one; with ``hold=request`` it is closed at the end of the call.
6. An exception such as ``KeyboardInterrupt`` may end a thread while it holds the lock and has changed only a part of
   the state. `LinkLock.is_torn` shows that to the next thread that takes the lock. That thread closes the connection
   and resets session and driver (`BlockingLinkDriver.begin_again`). Each waiting thread then finds that its call is
   missing in ``_calls``, and gives it to the session again, as after any lost connection.
7. No wait depends on another thread for longer than `_LOOK`. The leader holds the lock ``_lead``, and always releases
   it: CPython raises no KeyboardInterrupt between an exception and the first call of a ``finally`` block.
"""

import contextlib
import logging
import math
import socket
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from ..errors import LinkDown, ModbusError
from ..observe.connection_trace import ConnectionTrace, trace_for
from ..observe.trace import TRACE
from ..session.call import Call
from ..session.connection_life import ConnectionLife
from ..session.reconnect import ConnectionEvent, ConnectionState
from ..session.serial_client import SerialClientSession
from ..session.tcp_client import TcpClientSession
from ..transport.receive_buffer import RECEIVE_SIZE
from ..transport.tcp import link_down, network_reason
from .blocking_connection import BlockingConnection
from .connector import Connector
from .kept_serial_late_replies import KEPT
from .open_connections import LOCAL, LocalConnectionStatus, status_of
from .readiness import PortReadiness, SocketReadiness
from .sessions import ClientSession, reconnect_for
from .settings import LinkSettings
from .shared_limit import ClientScope, LinkLock
from .state_observers import DISCONNECTED, OnState, StateObservers

if TYPE_CHECKING:
    import asyncio

_log = logging.getLogger("busway.client")
_IDLE_SECONDS = 0.05
"""Seconds after which an unused connection is checked before a request is sent on it."""
_BLOCKED: Final = 0.01
"""Seconds until a waiting thread checks again whether the connection accepts more bytes."""
_STARVED: Final = 0.02
"""Longest wait at a socket, in seconds, while requests wait because of the common limit of the client's links."""
_LOOK: Final = 0.25
"""Longest wait of a thread, in seconds, until it checks whether there is still a leader and the link was not reset."""
_DIALLING: Final = 0.01
"""Seconds until `BlockingLinkDriver.connect` checks again whether another thread has opened the connection."""
_SPIN: Final = 0.0003
"""Seconds of busy loop before a frame, with ``precise_timing``: a sleeping thread wakes up about that much late."""


class BlockingLinkDriver:
    """The blocking driver of one link: one of the threads that wait for replies sends and receives for all.

    Attributes:
        name: URL of the endpoint.
        session: the client session, which decides what is sent and when; used only under the lock of the link.
        reconnect: state of the connection, and when a new one may be opened.
        shared: whether all users of the endpoint share the link.
        home: always None: the link belongs to no event loop.
        now: returns the time in seconds, by the clock in which deadlines of calls are given (``time.monotonic``).
        opened: when the last connection was opened, in seconds by ``time.monotonic``; 0 before the first.
        last_used: when the last connection was last used, in seconds by ``time.monotonic``; 0 before the first.
        sent_bytes, received_bytes: number of bytes on all connections of the link so far.
        observers: callbacks of the program for new states of the connection, called under the lock of the link; None
            before the first is added.
    """

    home: "asyncio.AbstractEventLoop | None" = None
    now: Callable[[], float] = staticmethod(time.monotonic)

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
        self._connector = connector
        self._framing = settings.endpoint.framing
        self.session: ClientSession = session
        self._line = session if isinstance(session, SerialClientSession) else None
        reconnect = reconnect_for(settings)
        self.shared = shared
        self.opened: float = 0.0
        self.last_used: float = 0.0
        self.sent_bytes: int = 0
        self.received_bytes: int = 0
        self._hold = settings.management.hold_seconds
        self._scope = scope
        self._spin = 0.0
        if settings.line is not None and settings.line.port is not None:
            self._spin = _SPIN if settings.line.opening.precise_timing else 0.0
        self._guard = LinkLock() if scope is None else scope.guard
        self._lock = self._guard.lock
        self._calls: set[Call] = set()  # those that the session has; none when the link has begun again (rule 6)
        self._given_up: list[Call] = []  # calls of interrupted threads, until they are cancelled
        self._lead = threading.Lock()
        self._waiters: dict[Call, threading.Lock] = {}  # released when the thread of the call has to look
        self._connection: BlockingConnection | None = None
        self._buffer = bytearray(RECEIVE_SIZE)
        self.reconnect = reconnect
        self.observers: StateObservers | None = None
        self._life = ConnectionLife(session, reconnect, endpoint=self.name, hold=self._hold, moved=self._moved)
        self._trace: ConnectionTrace | None = None
        LOCAL.add(self)

    # Calls of the public interface.

    @property
    def is_connected(self) -> bool:
        """Whether the link has an open connection now."""
        return self._connection is not None

    def run(self, call: Call) -> None:
        """Run a call; return when each of its requests has a reply or an error, stored in ``call.outcomes``.

        If an exception such as ``KeyboardInterrupt`` ends the wait, the call is cancelled.

        Raises:
            Overloaded, LinkDown, UnitSuspended, and on a serial line InvalidRequest: nothing was sent.
        """
        guard = self._guard
        connected, pause = None, 0.0
        try:
            with self._lock:
                if guard.is_torn:
                    self._repair()
                guard.is_torn = True
                try:
                    self._begin(call)
                except ModbusError:
                    guard.is_torn = False
                    raise
                if call.owner is not None and self._line is None:  # it can wait at once, without a section before
                    connected = self._connection
                    pause = self._pause(call.submitted)
                guard.is_torn = False
            if connected is not None and pause > 0:
                self._head(call, connected, pause)
            while not call.ended:
                if call.owner is None:
                    self._follow(call)
                else:
                    self._head(call)
        except BaseException:
            if call.submitted and not call.ended:
                self._given_up.append(call)  # first: a second interrupt must not let it be sent later
                self._cancel(call)
            raise
        finally:
            if call.owner is not None:
                call.owner.release()

    def connect(self) -> None:
        """Open the connection now, instead of at the first request. Returns when it is open.

        Does nothing if the link is connected, or closed for good. If another thread is connecting, waits for that.

        Raises:
            LinkDown: the attempt failed, or a pause after a failed attempt is not over.
        """
        guard = self._guard
        lead: threading.Lock | None = None
        try:
            while True:
                with self._lock:
                    self._begin_section()
                    is_done = self._connection is not None or self._life.closed
                    if lead is None and not is_done and self._lead.acquire(blocking=False):
                        lead = self._lead
                    is_old = lead is not None and lead is not self._lead  # the link has begun again
                    now = time.monotonic()
                    pause = _DIALLING if lead is None or is_old else self._pause(now)
                    refusal = None if is_done else self._life.refusal(now)
                    guard.is_torn = False
                if is_done:
                    return
                if refusal is not None:
                    raise refusal
                if is_old and lead is not None:
                    lead.release()
                    lead = None
                elif pause:
                    time.sleep(min(pause, _DIALLING))
                elif (failure := self._make_connection(lead)) is not None:
                    raise failure
        finally:
            if lead is not None:
                lead.release()
                with self._lock:
                    self._wake_all()  # one of those that wait is the leader now

    def on_state(self, callback: OnState) -> Callable[[], None]:
        """Register a callback for new states of the connection. Returns a function that removes it."""
        with self._lock:  # nothing of the session changes here
            if self.observers is None:
                self.observers = StateObservers(self.reconnect.state)
            return self.observers.add(callback)

    def disconnect(self) -> None:
        """Close the connection; the next request opens another one.

        Requests in flight are repeated or fail, as after a lost connection.
        """
        with self._lock:
            self._begin_section()
            if self._connection is not None:
                now = time.monotonic()
                if self._is_used():
                    self._drop(now, DISCONNECTED)
                else:
                    self._release(now, DISCONNECTED)
            self._wake_all()
            self._guard.is_torn = False

    def close(self) -> None:
        """Close the link for good. Calls that wait or are under way fail with `LinkDown`.

        Writes that were sent and are not answered fail with `WriteOutcomeUnknown`.
        """
        try:
            self._keep_doubts()
            self._close()
        finally:
            self._keep_doubts()  # also after an interrupt: the next link to the line must know what is owed

    def _keep_doubts(self) -> None:
        if self._line is not None:
            KEPT.keep(self.name, self._line.late_replies)

    def _close(self) -> None:
        with self._lock:
            self._begin_section()
            closed_before, self._life.closed = self._life.closed, True
            LOCAL.discard(self)
            now = time.monotonic()
            if self._connection is not None:
                self._release(now, "the link was closed")
            self._connector.release()
            self._life.ended(now)
            self._done()
            self._wake_all()
            if self._scope is not None and not closed_before:
                self._scope.leave(self)
                self._scope.serve(now)
            self._guard.is_torn = False

    def status(self) -> LocalConnectionStatus:
        """Return state, traffic and counters of the link at this moment."""
        guard = self._guard
        if guard.is_torn and not self._lock.locked():  # a callback for new states may ask under the lock
            with self._lock:
                if guard.is_torn:
                    self._repair()
                    guard.is_torn = False
        connection = self._connection
        local = None
        if connection is not None and isinstance(connection.channel, socket.socket):
            with contextlib.suppress(OSError):  # another thread may be closing it
                local = connection.channel.getsockname()
        return status_of(self, self.session, self._life, time.monotonic(), local)

    def make_room(self) -> bool:
        """Close the connection if no call uses it, so that another link may open one. Returns whether it was closed.

        Returns False at once if a thread holds the lock of the link.
        """
        if self._lock.locked():
            return False  # a thread is using it
        with self._lock:
            self._begin_section()
            is_free = self._connection is not None and not self._is_used()
            if is_free:
                self._release(time.monotonic(), "another connection needed the place")
            self._guard.is_torn = False
            return is_free

    def enter(self, scope: ClientScope) -> None:
        """Count the requests in flight of this link towards the limit of ``scope``, from now on."""
        with self._lock:
            self._begin_section()
            scope.enter(self)
            self._guard.is_torn = False

    def serve(self, now: float) -> None:
        """Send waiting requests, because the limit that all links of the client share has room again.

        Call it with the lock held.
        """
        if self.session.queue.size and self._connection is not None:
            self._transmit(now)

    # After an interrupt.

    def _begin_section(self) -> None:
        """Begin a change of the state under the lock: set ``is_torn``, which the caller clears at the end (rule 6).

        If it is set already, a thread was interrupted during its change, and the link is reset first. The hot methods
        `run`, `_follow` and `_head` have this code inline.
        """
        if self._guard.is_torn:
            self._repair()
        self._guard.is_torn = True

    def _repair(self) -> None:
        """Reset the link, or all links of its scope: a thread was interrupted while it held the lock (rule 6)."""
        if self._scope is None:
            self.begin_again()
            return
        for link in self._scope.links():
            if isinstance(link, BlockingLinkDriver):
                link.begin_again()
        self._scope.refill()

    def begin_again(self) -> None:
        """Close the connection and forget all calls; each waiting thread gives its call to the session again (rule 6).

        Call it with the lock held.
        """
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._life.begin_again()
        self._lead = threading.Lock()
        self._calls.clear()
        self._given_up.clear()
        self._wake_all()
        self._waiters.clear()

    def _resume(self, call: Call, now: float) -> None:
        """Give the call of this thread to the session again, because the link was reset (rule 6)."""
        self.session.resume(call, now)
        self._calls.add(call)
        if self._life.closed:
            self._life.ended(now)
        self._transmit(now)  # another thread may have connected already
        self._done()

    # Turns.

    def _begin(self, call: Call) -> None:
        """Give a new call to the session, send what can be sent at once, and become the leader if there is none."""
        if self._given_up:
            self._cancel_given_up()
        now = time.monotonic()
        if 0 < self._hold < math.inf:  # held per request it ends with the call, and one made by name begins with it
            self._let_go(now)
        may_have_ended = now - self.last_used > _IDLE_SECONDS and self._line is None
        if may_have_ended and self._connection is not None and not self.session.in_flight:
            # Before the session has the call: a connection that ends here fails no call.
            self._look_at_idle_connection(self._connection, now)
        if self._connection is None or self._life.closed:
            self._refuse_while_down(call, now)
        connection = self._connection
        adu = None if connection is None or connection.unsent else self.session.send_now(call, now)
        if adu is None:
            self.session.submit(call, now)
        self._calls.add(call)
        if connection is not None:
            if adu is not None:
                if self._send(connection, adu, now):
                    self.last_used = now
            else:
                if self._line is not None:
                    self._look_at_line()
                self._transmit(now)
        if call.ended:
            self._used()
        elif self._lead.acquire(blocking=False):
            call.owner = self._lead

    def _follow(self, call: Call) -> None:
        """Wait until the call is complete, or this thread becomes the leader.

        If it becomes the leader, ``call.owner`` is the leader's lock; otherwise None.
        """
        guard = self._guard
        is_late = False  # whether this thread has waited, so that something may be due
        while True:
            with self._lock:
                if guard.is_torn:
                    self._repair()
                guard.is_torn = True
                now = time.monotonic()
                if self._given_up:
                    self._cancel_given_up()
                if call not in self._calls and not call.ended:
                    self._resume(call, now)
                elif is_late:
                    self._tick(now)
                if call.ended:
                    self._used()
                elif self._lead.acquire(blocking=False):
                    call.owner = self._lead
                if call.ended or call.owner is not None:
                    self._waiters.pop(call, None)
                    guard.is_torn = False
                    return
                deadline = self.session.deadline()
                pause = _LOOK if deadline is None else min(max(deadline - now, 0.0), _LOOK)
                if self._connection is not None and self._connection.unsent:  # perhaps the leader waits for no room
                    pause = min(pause, _BLOCKED)
                waiter = self._waiter(call)
                guard.is_torn = False
            waiter.acquire(timeout=pause)
            is_late = True

    def _head(self, call: Call, connected: BlockingConnection | None = None, pause: float = 0.0) -> None:
        """Be the leader of the link: connect, send and receive for all threads, until ``call`` is complete.

        Returns early if the link was reset: then this thread is no longer the leader. First it waits at ``connected``
        for at most ``pause`` seconds; without it, it looks at once what is to be done.
        """
        guard = self._guard
        ready: bool | None = None  # how the last wait at the connection ended: False by time; None: there was none
        if connected is not None:
            ready = connected.wait(pause if pause < _LOOK else _LOOK)
        while True:
            with self._lock:
                if guard.is_torn:
                    self._repair()
                guard.is_torn = True
                if self._given_up:
                    self._cancel_given_up()
                if call not in self._calls and not call.ended:
                    self._stand_down(call)
                    self._resume(call, time.monotonic())
                    guard.is_torn = False
                    return
                if ready and connected is not None and connected is self._connection:
                    self._receive(connected)
                ended, pause = call.ended, 0.0
                if not ended:
                    now = time.monotonic()
                    pause = self._pause(now)
                    if not pause or ready is False or self._connection is None or self._line is not None:
                        self._tick(now)
                        if self._scope is not None and self.session.queue.size:
                            self._tick_others(self._scope, now)
                        ended = call.ended
                        pause = self._pause(now)
                if ended:
                    self._stand_down(call)
                    self._used()
                    guard.is_torn = False
                    return
                connected = self._connection
                if connected is not None and 0 < pause <= self._spin:
                    self._transmit(now + pause)  # finding out what to send takes a tenth of a millisecond
                    pause = self._pause(time.monotonic())
                if pause > _LOOK:
                    pause = _LOOK  # also for a socket: the number of a closed one may be that of the next
                if connected is None and pause > 0:
                    waiter = self._waiter(call)
                guard.is_torn = False
            ready = None
            if connected is not None:
                ready = connected.wait(pause)
            elif pause > 0:
                waiter.acquire(timeout=pause)
            else:
                self._make_connection(call.owner)

    def _stand_down(self, call: Call) -> None:
        """Release the leader's lock if this thread holds it, and wake the next waiting thread.

        Call it with the lock held.
        """
        lead = call.owner
        if lead is not None:
            call.owner = None
            lead.release()
        if self._waiters:
            self._waiters.pop(call, None)
            for other in self._waiters:
                waiter = self._waiters.pop(other)
                if waiter.locked():
                    waiter.release()
                break

    def _waiter(self, call: Call) -> threading.Lock:
        """Return the lock at which the thread of a call waits, created if needed; releasing it wakes that thread."""
        waiter = self._waiters.get(call)
        if waiter is None:
            waiter = threading.Lock()
            waiter.acquire()
            self._waiters[call] = waiter
        return waiter

    def _wake_all(self) -> None:
        for waiter in self._waiters.values():
            if waiter.locked():
                waiter.release()

    def _pause(self, now: float) -> float:
        """Return the seconds until a request, a timeout or an attempt to connect is due; 0 if one is due now.

        At most 60 seconds while connected, and at most `_STARVED` while requests wait for the common limit of the
        client's links. Call it with the lock held.
        """
        deadline = self.session.deadline()
        if self._connection is None:
            if self.reconnect.state is ConnectionState.CONNECTING:
                self._life.interrupted(now)  # another leader's attempt: only leaders connect
            if self._life.may_dial(now):
                return 0.0
            due = self.reconnect.not_before
            return max(min(due, deadline) if deadline is not None else due, now) - now or 0.001
        pause = 60.0 if deadline is None else max(deadline - now, 0.0)
        if self._scope is not None and self.session.queue.size and pause > _STARVED:
            return _STARVED
        return pause

    # Under the lock.

    def _is_used(self) -> bool:
        """Whether a thread waits for a reply of this link, or for its connection."""
        return self._lead.locked() or bool(self._waiters)

    def _used(self) -> None:
        """Do what is due when a call has ended: let other links of the client send if the common limit has room.

        With ``hold=request`` an unused connection is closed. Call it with the lock held.
        """
        if self._scope is not None:
            self._scope.serve(time.monotonic())
        if not self._hold:
            self._let_go(time.monotonic())

    def _let_go(self, now: float) -> None:
        """Close the connection if no call uses it and it was unused for the time of the option ``hold``."""
        if self._connection is not None and not self._is_used():
            reason = self._life.spent(now, self.last_used)
            if reason:
                self._release(now, reason)

    def _transmit(self, now: float) -> None:
        """Send all requests that are due at ``now``, if there is a connection and it has no unsent bytes.

        With ``precise_timing`` ``now`` can be shortly in the future: the frame is prepared at once, and sent then.
        """
        if self.session.recycle:
            self._recycle(now)
        connection = self._connection
        if connection is None or connection.unsent:
            return
        out = self.session.transmit(now)
        if self.session.recycle:
            self._recycle(now)
            return
        while out and time.monotonic() < now:
            pass
        for frame in out:
            if not self._send(connection, frame, now):
                return  # what is left of ``out`` has ended with its connection
        if out:
            self.last_used = now

    def _send(self, connection: BlockingConnection, frame: bytes, now: float) -> bool:
        """Send one frame. Returns False if the connection has ended.

        It is closed then, and its requests are repeated or fail.
        """
        self.sent_bytes += len(frame)
        if TRACE.level:
            self._traced().sent(frame)
        try:
            connection.send(frame)
        except OSError as error:
            self._drop(now, network_reason(error))
            return False
        return True

    def _flush(self, now: float) -> None:
        """Send the frames that the system did not accept before, as far as it accepts them now.

        If the connection has ended, it is closed, and its requests are repeated or fail.
        """
        connection = self._connection
        if connection is not None and connection.unsent:
            try:
                connection.flush()
            except OSError as error:
                self._drop(now, network_reason(error))

    def _cancel(self, call: Call) -> None:
        """Cancel the call of this thread, which an exception has interrupted.

        The next waiting thread becomes the leader.
        """
        with self._lock:
            self._begin_section()
            self._cancel_given_up()
            self._stand_down(call)
            self._used()
            self._guard.is_torn = False

    def _cancel_given_up(self) -> None:
        """Cancel the calls of interrupted threads that the session still has. Call it with the lock held."""
        while self._given_up:
            call = self._given_up[0]
            if call in self._calls:
                if self.session.cancel(call):
                    self._end_if_stuck(time.monotonic())
                self._calls.discard(call)
            self._waiters.pop(call, None)
            del self._given_up[0]

    def _end_if_stuck(self, now: float) -> None:
        """Close the connection if a call has ended and bytes of it are still unsent: they would be sent later."""
        if self._connection is not None and self._connection.unsent:
            self._drop(now, "a call ended before the connection had taken its request")

    def _receive(self, connection: BlockingConnection) -> None:
        now = time.monotonic()
        if connection.unsent:
            self._flush(now)
            if self._connection is not connection:
                return
        try:
            size = connection.channel.recv_into(self._buffer)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(now, network_reason(error))
            return
        if not size:
            self._drop(now, "the peer closed it")
            return
        self.last_used = now
        self.received_bytes += size
        if TRACE.level:
            self._traced().received(bytes(self._buffer[:size]))
        session = self.session
        session.receive(self._buffer, size, now)
        if not self.reconnect.is_settled:
            self._life.replied(now)
        self._done()
        if self._scope is not None:
            self._scope.serve(now)
        if session.queue.size or session.recycle:
            self._transmit(now)

    def _tick(self, now: float) -> None:
        connection, session = self._connection, self.session
        if connection is not None:
            if connection.frame_leaves is not None and session.in_flight:
                connection.frame_leaves()
            if connection.unsent:
                self._flush(now)
        timed_out = self._life.tick(now)
        if timed_out:
            self.last_used = now
        if timed_out or session.finished:
            self._end_if_stuck(now)
        if session.recycle or session.queue.size:
            self._transmit(now)
        self._done()

    def _tick_others(self, scope: ClientScope, now: float) -> None:
        """Handle the timeouts of other links of the scope, and close those with requests for which no thread waits."""
        for link in scope.links():
            if link is not self and isinstance(link, BlockingLinkDriver) and link.session.in_flight:
                link._tick(now)
                if link.session.in_flight and not link._calls:
                    link._release(now, "another link needed the slot of its cancelled request")
        scope.serve(now)

    def _done(self) -> None:
        """Remove the calls that have ended from ``_calls``, and wake their threads."""
        if self._line is not None and self._line.notes:
            self._trace_notes(self._line.notes)
        finished = self.session.finished
        if finished:
            for call in finished:
                self._calls.discard(call)
                waiter = self._waiters.pop(call, None)
                if waiter is not None and waiter.locked():
                    waiter.release()
            finished.clear()

    def _look_at_line(self) -> None:
        """Process the bytes received on a serial line since the last call, and the silence after them.

        Does nothing if there is a leader, which receives them itself.
        """
        if not self._lead.locked() and self._connection is not None:
            self._receive(self._connection)
            self._tick(time.monotonic())

    def _look_at_idle_connection(self, connection: BlockingConnection, now: float) -> None:
        channel = connection.channel
        if not isinstance(channel, socket.socket):
            self._receive(connection)
            return
        try:
            if not channel.recv(1, socket.MSG_PEEK):
                self._drop(now, "the peer closed it while idle")
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(now, network_reason(error))

    def _recycle(self, now: float) -> None:
        if self._connection is not None:
            self._drop(now, f"reconnecting after {self.session.recycle}")

    def _drop(self, now: float, reason: str) -> None:
        """Close the connection because it failed or must be replaced; its requests are repeated or fail."""
        self._close_connection()
        self._life.lost(now, reason)
        self._done()

    def _release(self, now: float, reason: str) -> None:
        """Close the connection on purpose, for ``reason``; it does not count as lost. The next request opens another.

        Usually no call uses it. Requests in flight, if there are any, are repeated or fail.
        """
        self._close_connection()
        self._life.released(now, reason)
        self._done()

    def _moved(self, event: ConnectionEvent, reason: str, news: str) -> None:
        """Handle an event of the connection: log the text ``news`` unless it is empty, and call the observers."""
        if news:
            # With one connection per request (hold=request), opening and closing are no news for an operator.
            _log.log(logging.INFO if self._hold else logging.DEBUG, "%s: %s", self.name, news)
        if self.observers is not None:
            self.observers.notify(self.reconnect.state, reason)

    def _close_connection(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _refuse_while_down(self, call: Call, now: float) -> None:
        """Raise `LinkDown` if the link is closed, or during the pause after a failed attempt to connect.

        During that pause nothing is raised if there is a leader: then ``call`` waits with the other calls.
        """
        if self._life.closed or not self._lead.locked():
            refusal = self._life.refusal(now, call.unit)
            if refusal is not None:
                raise refusal

    def _trace_notes(self, notes: list[str]) -> None:
        if TRACE.level:
            for note in notes:
                self._traced().note(note)
        notes.clear()

    def _traced(self) -> ConnectionTrace:
        if self._trace is None:
            carrier = None if self._connection is None else self._connection.channel
            self._trace = trace_for(self._framing, self.name, is_server=False, carrier=carrier)
        return self._trace

    # By the leader, without the lock where it waits.

    def _make_connection(self, lead: "threading.Lock | None") -> LinkDown | None:
        """Open a connection and send what is due. Returns None, or the error if that failed or the link was closed.

        With an error all waiting calls have ended. ``lead`` is the leader's lock: if the link was reset meanwhile (rule
        6), this thread is no longer the leader; then the new connection is closed, and the result is None.
        """
        guard = self._guard
        failure: LinkDown | None = None
        connection: BlockingConnection | None = None
        try:
            with self._lock:
                self._begin_section()
                is_leader = lead is self._lead
                if is_leader:
                    self._life.dialled(time.monotonic())
                guard.is_torn = False
            if not is_leader:
                return None
            try:
                LOCAL.make_room(self, self.name)
                connection = self._new_connection()
            except (OSError, ValueError) as error:  # usually a `LinkDown`
                failure = error if isinstance(error, LinkDown) else link_down(error, endpoint=self.name)
            with self._lock:
                self._begin_section()
                if lead is not self._lead:
                    failure = None
                elif connection is None:
                    assert failure is not None
                    self._life.failed(time.monotonic(), failure)
                    self._done()
                elif self._life.closed:
                    failure = LinkDown("the link was closed", kind="closed", endpoint=self.name)
                else:
                    self._use(connection, time.monotonic())
                    connection = None
                guard.is_torn = False
        except BaseException:  # an interrupt of the program: the next caller dials again
            self._dial_was_interrupted(lead)
            raise
        finally:
            if connection is not None and connection is not self._connection:
                connection.close()
        return failure

    def _use(self, connection: BlockingConnection, now: float) -> None:
        """Use a new connection as the one of this link, and send on it what is due."""
        self._connection = connection
        self.opened = self.last_used = now
        self._trace = None
        if self._line is not None:
            KEPT.hand_over(self.name, self._line.late_replies)
        self._life.connected(now)
        self._transmit(now)

    def _dial_was_interrupted(self, lead: "threading.Lock | None") -> None:
        with self._lock:
            self._begin_section()
            if lead is self._lead and self._connection is None:
                self._life.interrupted(time.monotonic())
            self._guard.is_torn = False

    def _new_connection(self) -> BlockingConnection:
        channel = self._connector.dial()
        try:
            return BlockingConnection(
                channel, PortReadiness(self._spin) if self._line is not None else SocketReadiness(channel)
            )
        except BaseException:
            channel.close()
            raise
