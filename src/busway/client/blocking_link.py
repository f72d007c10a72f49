"""A link for blocking programs: one conversation, one socket, any number of threads, and no thread of its own.

Knows when to connect, write, wait and look at the clock; knows nothing of what is asked.

1. The session is touched only under the lock; nothing that may wait happens under it.
2. Of the threads that wait for replies one is the leader: it connects, waits at the socket and feeds the session. When
   its own demand is complete, the next waiting thread takes over.
3. Every waiting thread looks after its own time, so nobody depends on how long the leader waits.
4. Before the first request after a pause the socket is looked at: a peer that closed an idle connection is nothing
   to report, and a new connection is made. On a line, what has come meanwhile is read before each request: it is late,
   or somebody else's.
"""

import contextlib
import logging
import random
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Final

from ..errors import LinkDown
from ..observe.line_trace import Trace, trace_for
from ..observe.trace import TRACE
from ..session.client import TcpClientSession
from ..session.demand import Demand
from ..session.reconnect import ConnectionEvent, Reconnect
from ..session.serial_client import SerialClientSession
from ..transport.buffers import RECEIVE_SIZE
from ..transport.serial.waiting import wait_ready
from ..transport.tcp import network_reason
from .connector import Channel, Connector
from .conversation import Conversation
from .settings import LinkSettings

_log = logging.getLogger("busway.client")
_IDLE_SECONDS = 0.05
"""A connection unused for longer is looked at before it is written to."""
_LONGEST_WAIT: Final = 0.25
"""Seconds at a port without a look around: closing it does not wake a thread that waits there."""
_SPIN: Final = 0.0003
"""Seconds before a frame that ``precise_timing`` waits for in a loop: a sleeping thread is woken about that late."""


class BlockingLink:
    """The blocking driver of one client conversation. Made by `busway.client.blocking_pool`."""

    def __init__(
        self, connector: Connector, session: TcpClientSession | SerialClientSession, settings: LinkSettings
    ) -> None:
        self.name = settings.endpoint.url
        self._connector = connector
        self._framing = settings.endpoint.framing
        self.session: Conversation = session
        self._is_line = isinstance(session, SerialClientSession)
        self.reconnect = Reconnect(random.random)
        self._spin = 0.0
        if settings.line is not None and settings.line.port is not None:
            opening = settings.line.opening
            self.reconnect = Reconnect(random.random, first=opening.reopen_first, most=opening.reopen_most)
            self._spin = _SPIN if opening.precise_timing else 0.0
        self._turn = threading.Condition(threading.Lock())
        self._leading = False
        self._waiting = 0
        self._socket: Channel | None = None
        self._poll: Poll | ExactPoll | None = None
        self._frame_leaves: Callable[[], None] | None = None  # tells the session when its frame leaves
        self._buffer = bytearray(RECEIVE_SIZE)
        self._unsent = b""
        self._last_used = 0.0
        self._closed = False
        self._last_failure: LinkDown | None = None
        self._trace: Trace | None = None

    # What the interface asks.

    @staticmethod
    def now() -> float:
        """The clock of demands."""
        return time.monotonic()

    @property
    def is_connected(self) -> bool:
        """Whether a connection stands."""
        return self._socket is not None

    def run(self, demand: Demand) -> None:
        """Bring a demand to its end; its outcomes are then in it. Raises `Overloaded`, `LinkDown`."""
        with self._turn:
            now = time.monotonic()
            self._refuse_while_down(demand, now)
            self.session.submit(demand, now)
            if self._socket is not None:
                if self._is_line:
                    self._look_at_line()
                elif now - self._last_used > _IDLE_SECONDS and not self.session.in_flight:
                    self._look_at_idle_socket(now)
                self._transmit(now)
            try:
                leads = self._wait_for_turn(demand)
            except BaseException:
                self.session.cancel(demand)
                raise
        if leads:
            try:
                self._lead(demand)
            finally:
                with self._turn:
                    self._leading = False
                    if not demand.ended:
                        self.session.cancel(demand)
                    if self._waiting:
                        self._turn.notify_all()

    def connect(self) -> None:
        """Connect now, instead of at the first need. Raises `LinkDown`."""
        with self._turn:
            while self._leading:
                self._turn.wait()
            if self._socket is not None or self._closed:
                return
            self._leading = True
        try:
            failure = self._make_connection()
            if failure is not None:
                raise failure
        finally:
            with self._turn:
                self._leading = False
                self._turn.notify_all()

    def close(self) -> None:
        """Close the connection. What is still waiting ends as `LinkDown`."""
        with self._turn:
            self._closed = True
            now = time.monotonic()
            if self._socket is not None:
                self._drop(now, "the link was closed")
            self._connector.release()
            self.session.unreachable(now, LinkDown("the link was closed"))
            self._done()
            self._turn.notify_all()

    # Turns.

    def _wait_for_turn(self, demand: Demand) -> bool:
        """Wait until the demand is complete, or until this thread is to lead; the lock is held."""
        while not demand.ended:
            if not self._leading:
                self._leading = True
                return True
            deadline = self.session.deadline()
            now = time.monotonic()
            self._waiting += 1
            self._turn.wait(None if deadline is None else max(deadline - now, 0.0))
            self._waiting -= 1
            self._tick(time.monotonic())
        return False

    def _lead(self, demand: Demand) -> None:
        """Connect, send and receive until ``demand`` is complete."""
        while True:
            with self._turn:
                now = time.monotonic()
                self._tick(now)
                if demand.ended:
                    return
                connected = self._socket
                pause = self._pause(now)
                if connected is not None and 0 < pause <= self._spin:
                    self._transmit(now + pause)  # finding out what to send takes a tenth of a millisecond
                    pause = self._pause(time.monotonic())
            if connected is None:
                if pause > 0:
                    with self._turn:
                        self._turn.wait(pause)
                    continue
                self._make_connection()
                continue
            poll = self._poll
            if poll is not None and poll.wait(connected, pause, bool(self._unsent)):
                with self._turn:
                    if self._socket is connected:
                        self._receive(connected)

    def _pause(self, now: float) -> float:
        """Seconds until something is due; the lock is held."""
        deadline = self.session.deadline()
        if self._socket is None:
            if self.reconnect.may_dial(now):
                return 0.0
            due = self.reconnect.not_before
            return max(min(due, deadline) if deadline is not None else due, now) - now or 0.001
        return 60.0 if deadline is None else max(deadline - now, 0.0)

    # Under the lock.

    def _transmit(self, now: float) -> None:
        """Send what may be sent now; or, with ``precise_timing``, some moments ahead, at that time."""
        if self.session.recycle:
            self._recycle(now)
        if self._socket is None or self._unsent:
            return
        out = self.session.transmit(now)
        if self.session.recycle:
            self._recycle(now)
            return
        while out and time.monotonic() < now:
            pass
        for chunk in out:
            self._unsent += chunk
            if TRACE.level:
                self._traced().sent(chunk)
            self._send(now)

    def _send(self, now: float) -> None:
        assert self._socket is not None
        try:
            sent = self._socket.send(self._unsent)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(now, network_reason(error))
            return
        self._unsent = self._unsent[sent:]
        self._last_used = now

    def _receive(self, connection: Channel) -> None:
        now = time.monotonic()
        if self._unsent:
            self._send(now)
            if self._socket is None:
                return
        try:
            size = connection.recv_into(self._buffer)
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(now, network_reason(error))
            return
        if not size:
            self._drop(now, "the peer closed it")
            return
        self._last_used = now
        if TRACE.level:
            self._traced().received(bytes(self._buffer[:size]))
        session = self.session
        session.receive(self._buffer, size, now)
        if session.valid_reply:
            self.reconnect.move(ConnectionEvent.VALID_REPLY, now)
        self._done()
        if session.has_demands or session.recycle:
            self._transmit(now)

    def _tick(self, now: float) -> None:
        timeouts = self.session.counters.timeouts
        if self._frame_leaves is not None and self.session.in_flight:
            self._frame_leaves()
        self.session.tick(now)
        if self.session.counters.timeouts != timeouts:
            self.reconnect.move(ConnectionEvent.TIMEOUT, now)
        if self.session.recycle or self.session.has_demands:
            self._transmit(now)
        self._done()

    def _done(self) -> None:
        """Wake the threads whose demands are complete."""
        if self.session.finished:
            self.session.finished.clear()
            if self._waiting:
                self._turn.notify_all()

    def _look_at_line(self) -> None:
        """Read what has come while nobody waited, and let the silence since then take effect."""
        if not self._leading and self._socket is not None:
            self._receive(self._socket)
            self._tick(time.monotonic())

    def _look_at_idle_socket(self, now: float) -> None:
        assert self._socket is not None
        if not isinstance(self._socket, socket.socket):
            self._receive(self._socket)
            return
        try:
            if not self._socket.recv(1, socket.MSG_PEEK):
                self._drop(now, "the peer closed it while idle")
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(now, network_reason(error))

    def _recycle(self, now: float) -> None:
        reason = self.session.recycle
        _log.warning("%s: connection made anew: %s", self.name, reason)
        if self._socket is not None:
            self._drop(now, reason)

    def _drop(self, now: float, reason: str) -> None:
        """The connection has ended."""
        connection, self._socket = self._socket, None
        self._poll = self._frame_leaves = None
        self._unsent = b""
        if connection is not None:
            if isinstance(connection, socket.socket):
                with contextlib.suppress(OSError):
                    # Closing alone does not wake a thread that waits at the socket.
                    connection.shutdown(socket.SHUT_RDWR)
            connection.close()
        self.reconnect.move(ConnectionEvent.LOST, now, had_reply=self.session.valid_reply)
        _log.info("%s: connection ended: %s", self.name, reason)
        self.session.disconnected(now, reason)
        self._done()

    def _refuse_while_down(self, demand: Demand, now: float) -> None:
        """Fail fast while the peer is known to be unreachable."""
        if self._closed:
            raise LinkDown("the link is closed", endpoint=self.name, unit=demand.unit)
        failure = self._last_failure
        if self._socket is None and failure is not None and not self._leading and not self.reconnect.may_dial(now):
            pause = self.reconnect.not_before - now
            raise LinkDown(
                f"{failure.message}; the next attempt is made in {pause:.1f} s at the earliest",
                endpoint=self.name,
                unit=demand.unit,
            ) from failure

    def _traced(self) -> Trace:
        if self._trace is None:
            self._trace = trace_for(self._framing, self.name, is_server=False, carrier=self._socket)
        return self._trace

    # By the leader, without the lock where it waits.

    def _make_connection(self) -> LinkDown | None:
        """Connect; the failure, which has ended everything that waited, or None."""
        with self._turn:
            self.reconnect.may_dial(time.monotonic())
            self.reconnect.move(ConnectionEvent.DIALLED, time.monotonic())
        try:
            connection = self._connector.dial()
        except LinkDown as error:
            with self._turn:
                now = time.monotonic()
                self._last_failure = error
                self.reconnect.move(ConnectionEvent.FAILED, now)
                _log.info("%s: %s", self.name, error.message)
                self.session.unreachable(now, error)
                self._done()
            return error
        except BaseException:  # an interrupt of the program: the next caller dials again
            with self._turn:
                self.reconnect.move(ConnectionEvent.FAILED, time.monotonic())
            raise
        with self._turn:
            now = time.monotonic()
            self._last_failure = None
            if self._closed:
                connection.close()
                return LinkDown("the link was closed", endpoint=self.name)
            self._socket = connection
            self._poll = ExactPoll(self._spin) if self._is_line else Poll(connection)
            self._frame_leaves = getattr(connection, "still_sending", None)
            self._last_used = now
            self._trace = None
            self.reconnect.move(ConnectionEvent.CONNECTED, now)
            _log.info("%s: connected", self.name)
            self.session.connected(now)
            self._transmit(now)
        return None


class ExactPoll:
    """Waits at one port as exactly as the system can, and wakes up ``spin`` seconds before the time is over."""

    def __init__(self, spin: float) -> None:
        self._spin = spin

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """As `Poll.wait`."""
        if seconds > self._spin:
            seconds -= self._spin
        try:
            descriptor = connection.fileno()
            return bool(wait_ready([descriptor], [descriptor] if writes else [], min(seconds, _LONGEST_WAIT)))
        except (OSError, ValueError):
            return False  # another thread closed the port while this one was about to wait


class Poll:
    """Waits at one socket: by ``poll`` where the system has it, which knows no limit of descriptors."""

    def __init__(self, connection: Channel) -> None:
        self._poll = select.poll() if hasattr(select, "poll") else None
        self._writes = False
        if self._poll is not None:
            self._poll.register(connection, select.POLLIN)

    def wait(self, connection: Channel, seconds: float, writes: bool) -> bool:
        """Whether there is something to receive (or room to send, if ``writes``) within ``seconds``."""
        if self._poll is None:
            readable, writable, _ = select.select([connection], [connection] if writes else [], [], seconds)
            return bool(readable or writable)
        try:
            if writes != self._writes:
                self._writes = writes
                self._poll.modify(connection, select.POLLIN | (select.POLLOUT if writes else 0))
            return bool(self._poll.poll(seconds * 1000 + 0.5))
        except (OSError, ValueError):
            return False  # another thread closed the socket while this one was about to wait
