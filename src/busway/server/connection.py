"""The asyncio driver of one accepted connection: moves bytes between a transport and a server session.

Knows when bytes arrive and leave; knows nothing of their meaning.

1. Received bytes are processed in one call and answered with one write, up to the share of a turn.
2. Reading pauses while a client does not read its replies (Messaging on TCP/IP V1.0b §4.1), and while its host is
   above its rate.
3. No task, future or timer per request; a task only for a responder that returns an awaitable.
4. Timeouts are watched by connection management, which has one timer for all connections.
5. In one turn of the event loop a connection receives and processes a limited amount. Requests beyond that wait for
   the next turns, behind other connections (`busway.server.turns`), and nothing more is read meanwhile.
"""

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from ..observe.connection_trace import ConnectionTrace, trace_for
from ..observe.trace import TRACE
from ..options.networks import host_of, peer_name
from ..transport.receive_buffer import receive_buffer, receive_window
from ..transport.tcp import peer_has_ended
from .connection_management import ConnectionManagement
from .connection_slots import SlotPool
from .responder_failures import begin_late_answers
from .status import ServedConnectionState

if TYPE_CHECKING:
    from .serial_over_network import Session

_USUAL_REQUEST: Final = 12
"""Bytes of a read request."""
_LONGEST_REQUEST: Final = 260
_BYTES_OF_A_TURN: Final = 17 * _LONGEST_REQUEST // _USUAL_REQUEST * _USUAL_REQUEST
"""Most bytes received in a turn, a whole number of read requests; more than 16 of the longest requests. If they are all
cached reads, which have no other limit, their processing takes a sixth of a millisecond.
"""
_MANY_BYTES: Final = 512
"""Bytes in one turn above which the server checks whether other connections have to wait."""


@dataclass(frozen=True, slots=True)
class Certified:
    """What the certificate of a client says of it after a TLS handshake.

    Attributes:
        role: the role; None if the certificate has none.
        subject: the subject.
    """

    role: str | None
    subject: str


class ServerConnection(asyncio.BufferedProtocol):
    """The asyncio driver of one accepted connection: an `asyncio` protocol that feeds a server session.

    Args:
        management: gives the connection a slot and a session.
        certified: role and subject of the client's certificate, after a TLS handshake, whose acceptor has called
            `ConnectionManagement.accept` already; None without TLS.

    Attributes:
        session: the server session of the connection; None until the connection has a slot, and after its end.
        host: the host of the client.
        is_priority: whether the client is a priority host: no limit of the server closes or slows its connection.
        pool: the pool of the connection's slot.
        is_greedy: whether the client sends more than is processed in one turn.
        opened, last_used: when it was accepted, and when it was last used, in seconds of ``time.monotonic``: when
            replies were sent, or a request came or ended without one; before the first when it was accepted.
        received, sent: bytes so far.
        charged: number of its requests that have been counted against its host's rate so far.
    """

    __slots__ = (
        "_buffer",
        "_certified",
        "_end_waits",
        "_half_closed",
        "_is_queued",
        "_is_rated",
        "_is_single",
        "_is_stuck",
        "_late",
        "_management",
        "_tasks",
        "_trace",
        "_transport",
        "_window",
        "charged",
        "host",
        "is_greedy",
        "is_priority",
        "last_used",
        "opened",
        "pool",
        "received",
        "sent",
        "session",
    )

    def __init__(self, management: ConnectionManagement, *, certified: Certified | None = None) -> None:
        self._management = management
        self._certified = certified
        self._buffer = receive_buffer(management.loop)
        self._window = receive_window(self._buffer, _BYTES_OF_A_TURN)
        self._transport: Any = None  # asyncio.Transport; the annotation would cost an isinstance at every write
        self._tasks: set[asyncio.Task[None]] | None = None
        self._trace: ConnectionTrace | None = None
        self._end_waits = False  # the client sends no more, behind what still waits
        self._half_closed = False
        self._is_queued = False  # it waits for its turn
        self._is_rated = False
        self._is_single = management.parameters.single_adu_segments
        self._is_stuck = False
        self._late: list[bytes] | None = None  # late replies that leave at the end of this turn
        self.session: Session | None = None
        self.host: str = ""
        self.is_priority: bool = False
        self.pool: SlotPool = SlotPool.OTHER
        self.is_greedy: bool = False
        self.opened: float = 0.0
        self.last_used: float = 0.0
        self.received: int = 0
        self.sent: int = 0
        self.charged: int = 0

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Give a new connection a slot and a session; close it at once if that is not possible.

        It is closed if its host may not connect, or if no slot is free or can be freed.
        """
        self._transport = transport
        self.host = host_of(transport.get_extra_info("peername"))
        self.opened = self.last_used = time.monotonic()
        if self._certified is not None or self._management.accept(transport):
            self._transport.set_write_buffer_limits(high=self._management.parameters.write_buffer)
            self.session = self._management.admit(self)
            self._limit_receiving()
        if self.session is None:
            self._transport.abort()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the buffer into which the event loop or the TLS layer writes received bytes."""
        return self._window

    def buffer_updated(self, nbytes: int) -> None:
        """Process received bytes and send the replies, up to the connection's share of a turn.

        ``nbytes``: how many bytes were written into the buffer that `get_buffer` returned.
        """
        session = self.session
        if session is None:
            return
        self.received += nbytes
        if TRACE.level:
            self._traced().received(bytes(self._buffer[:nbytes]))
        if self._management.turns.is_crowded and self._must_wait(session, nbytes):
            return
        replies = session.receive(self._buffer, nbytes)
        if replies:
            self._write(replies)
        elif not session.unfinished:
            self.last_used = time.monotonic()  # a late reply follows, or none, as with a broadcast
        if session.deferred or session.failures or session.unfinished or session.broken or self._is_rated:
            self._finish(session, nbytes)
        if session.spent > 1 or nbytes > _MANY_BYTES:
            self._look_at_share(session, nbytes)

    def _finish(self, session: "Session", size: int) -> None:
        """Finish the handling of received bytes, once the replies that were ready are sent.

        Starts a task for each late reply and the timeout of an incomplete frame, logs failures of responders, and
        closes the connection if its bytes are no valid sequence of frames.
        """
        if session.deferred:
            self._start_waiting(session)
        if session.failures:
            self._report(session)
        if session.unfinished:
            # More than came now: it began with an earlier segment, and its time goes on.
            self._management.watch_frame(self, begun_now=session.unfinished <= size)
        if session.broken:
            self._management.broken(self, session.broken)
            self.close()
        elif self._is_rated:
            self._management.charge(self, session)

    def eof_received(self) -> bool:
        """Handle that the client has closed its sending side. Returns whether the connection stays open for now.

        It does while received requests wait for their turn, and, with the option ``answer_half_closed``, until the late
        replies are sent. Otherwise asyncio closes it, and late replies are lost.
        """
        session = self.session
        if session is not None and session.rest:
            self._end_waits = True
            return True
        # A reply that was given in this very turn has not left yet, and is no longer waited for.
        is_owed = session is not None and (session.waiting > 0 or bool(self._late))
        self._half_closed = is_owed and self._management.parameters.answer_half_closed
        return self._half_closed

    def pause_writing(self) -> None:
        """Stop reading from the client, because it does not read its replies and the write buffer is full."""
        self._is_stuck = True
        self._transport.pause_reading()
        self._management.stuck(self)

    def resume_writing(self) -> None:
        """Read from the client again, because it reads its replies again."""
        self._is_stuck = False
        self._management.taken(self)
        self.go_on()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the tasks of the ended connection, close its session and free its slot."""
        session, self.session = self.session, None
        for task in self._tasks or ():
            task.cancel()
        if session is not None:
            session.close()
            self._management.leave(self, session, exc)

    # Turns.

    def _must_wait(self, session: "Session", nbytes: int) -> bool:
        """Put received requests off to a later turn if other connections come first; returns whether it did.

        Other connections come first if this one is greedy, or if no time is left in this turn of the event loop.
        Requests of a priority host are never put off.
        """
        if self.is_priority or not (self.is_greedy or not self._management.turns.has_time):
            return False
        session.put_off(self._buffer, nbytes)
        self._wait_for_turn()
        self.is_greedy = nbytes == len(self._window)
        return True

    def _look_at_share(self, session: "Session", nbytes: int) -> None:
        """Queue the connection for another turn, and pause reading, if it has used up its share of this turn."""
        session.spent = 0
        self._management.turns.worked()
        self.is_greedy = bool(session.rest) or nbytes == len(self._window)
        if self.is_greedy and not self._transport.is_closing():
            self._wait_for_turn()

    def _wait_for_turn(self) -> None:
        self._transport.pause_reading()
        if not self._is_queued:
            self._is_queued = True
            self._management.turns.wait(self)

    def take_turn(self) -> bool:
        """Process requests that wait, for one share of a turn. Returns whether the connection needs another turn.

        It needs none if nothing waits, if it is closed or closing, or while the client does not read its replies;
        `resume_writing` queues it again then. An exception inside is reported to the event loop, and closes the
        connection.
        """
        try:
            more = self._work_on()
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            # As a transport does with one whose `buffer_updated` fails.
            context = {"message": "what a client asked could not be worked through", "exception": error}
            self._management.loop.call_exception_handler(context)
            self._is_queued = False
            self.abort()
            return False
        if not more:
            self._is_queued = False
            self.go_on()
        return more

    def _work_on(self) -> bool:
        session = self.session
        if session is None or self._is_stuck or self._transport.is_closing():
            return False
        if session.rest:
            size = len(session.rest)
            replies = session.go_on()
            if replies:
                self._write(replies)
            elif not session.unfinished:
                self.last_used = time.monotonic()
            self._finish(session, size)
            session.spent = 0
        self.is_greedy = self.is_greedy or bool(session.rest)
        return bool(session.rest) and not (self._is_stuck or self._transport.is_closing())

    # What connection management and the session ask.

    def deliver(self, adu: bytes) -> None:
        """Send the late reply to a request; empty bytes mean that the request ends without a reply.

        The replies of one turn of the event loop are sent together: a gateway gets many at once from its upstream, and
        a TCP segment for each of them would cost more than all other steps.
        """
        if self._late is None:
            self._late = []
            self._management.loop.call_soon(self._send_late)
        if adu:
            self._late.append(adu)

    def _send_late(self) -> None:
        late, self._late = self._late, None
        self.deliver_together(late or [])

    def deliver_together(self, late: list[bytes]) -> None:
        """Send the late replies to several requests in one write, or one by one with ``single_adu_segments``."""
        if self.session is not None and not self._transport.is_closing():
            if late:
                self._write(late)
            else:
                self.last_used = time.monotonic()  # a request has ended without a reply
            if self._half_closed and not self.session.waiting:
                self._transport.close()

    def attend(self) -> None:
        """Start tasks for late replies, and log failures of responders, that the session has found without new bytes.

        The session calls it, for example after its own timer.
        """
        session = self.session
        if session is not None and session.deferred:
            self._start_waiting(session)
        if session is not None and session.failures:
            self._report(session)

    def pause_reading(self) -> None:
        """Stop reading from the client until `go_on` is called."""
        self._transport.pause_reading()

    def go_on(self) -> None:
        """Read from the client again after a pause, unless there is another reason for a pause.

        Requests that were put off are queued for a turn first. If the client has closed its sending side meanwhile, the
        connection is closed as by `eof_received`.
        """
        if self._is_stuck or self._is_queued or self._transport.is_closing():
            return
        if self.session is not None and self.session.rest:
            self._wait_for_turn()
        elif self._end_waits:
            self._end_waits = False
            if not self.eof_received():
                self._transport.close()
        elif not self._management.is_paused(self):
            self._transport.resume_reading()

    def close(self) -> None:
        """Close the connection after all replies given so far have been sent."""
        if self._late:
            self._send_late()
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close the connection at once; unsent replies are lost."""
        if self._transport is not None:
            self._transport.abort()

    def make_room(self) -> None:
        """Close the connection at once, because a new connection gets its slot; unsent replies are lost."""
        self._management.evict(self)

    @property
    def address(self) -> tuple[object, ...]:
        """The socket address of the client; empty if the transport does not know it."""
        return self._transport.get_extra_info("peername") or ()

    @property
    def peer(self) -> str:
        """``host:port`` of the client; a text that is made each time, because most connections never need it."""
        return peer_name(self._transport.get_extra_info("peername"))

    @property
    def role(self) -> str | None:
        """Role of the client's certificate; None without one."""
        return None if self._certified is None else self._certified.role

    @property
    def subject(self) -> str:
        """Subject of the client's certificate; empty without one."""
        return "" if self._certified is None else self._certified.subject

    @property
    def is_busy(self) -> bool:
        """Whether a request of the client is in progress or waits for its turn, or a reply is unsent.

        False for a connection without a session. An incomplete request does not count.
        """
        if self.session is None:
            return False
        return bool(self.session.waiting or self.session.rest or self.unsent or self._late)

    @property
    def has_ended(self) -> bool:
        """Whether the connection is closing, or the client is known to have closed it with nothing left to read."""
        return self._transport.is_closing() or peer_has_ended(self._transport.get_extra_info("socket"))

    @property
    def is_idle(self) -> bool:
        """Whether the idle timeout, once it is over, may close the connection.

        It may not while a request is incomplete or in progress, a reply is unsent, or reading is paused; never if the
        client is a priority host.
        """
        return not (self.is_priority or self.is_busy or self.unfinished or self._management.is_paused(self))

    @property
    def unfinished(self) -> int:
        """Number of received bytes that belong to an incomplete request; always 0 with RTU or ASCII framing."""
        return self.session.unfinished if self.session is not None else 0

    @property
    def unsent(self) -> int:
        """Number of reply bytes that the socket has not taken yet."""
        return int(self._transport.get_write_buffer_size())

    @property
    def state(self) -> ServedConnectionState:
        """Return the state of the connection for the server's status, such as closing or paused."""
        if self.session is None or self._transport.is_closing():
            return ServedConnectionState.CLOSING
        if self._is_stuck or self._management.is_paused(self):
            return ServedConnectionState.PAUSED
        if self.is_busy:
            return ServedConnectionState.BUSY
        return ServedConnectionState.RECEIVING if self.unfinished else ServedConnectionState.IDLE

    # Inside.

    def _limit_receiving(self) -> None:
        """If the listener has a request rate, receive at most about the requests of one second at once.

        At least one request of any length. Without effect for a priority host.
        """
        rates = self._management.rates
        if rates is not None and not self.is_priority:
            self._is_rated = True
            self._window = self._window[: max(int(rates.rate) * _USUAL_REQUEST, _LONGEST_REQUEST)]

    def _write(self, replies: list[bytes]) -> None:
        self.last_used = time.monotonic()
        if self._is_single:
            for reply in replies:
                self._transport.write(reply)
                self.sent += len(reply)
        else:
            data = b"".join(replies)  # of one reply it is that object itself
            self._transport.write(data)
            self.sent += len(data)
        if TRACE.level:
            self._traced().sent(b"".join(replies))

    def _traced(self) -> ConnectionTrace:
        if self._trace is None:
            self._trace = trace_for(self._management.framing, self.peer, is_server=True, carrier=self._transport)
        return self._trace

    def _start_waiting(self, session: "Session") -> None:
        deferred, session.deferred = session.deferred, []
        if self._tasks is None:
            self._tasks = set()
        management = self._management
        begin_late_answers(deferred, management.loop, self._tasks, management.listener_context.late_answers)

    def _report(self, session: "Session") -> None:
        failures, session.failures = session.failures, ()
        self._management.listener_context.failed(self.peer, failures)
