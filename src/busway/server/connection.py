"""One accepted connection: the only place where a server session meets a transport.

Knows when bytes come and go; knows nothing of what they say.

1. What arrived is worked through in one call and answered with one write.
2. While a client does not take its replies, nothing more is read from it (Messaging on TCP/IP V1.0b §4.1).
3. No task, future or timer per request; a task only for a handler's awaitable.
4. A frame that was begun is watched by connection management, which has one timer for all of them.
"""

import asyncio
import logging
import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ..codes import ExceptionCode
from ..errors import ModbusError
from ..observe.line_trace import Trace, trace_for
from ..observe.trace import TRACE
from ..pdu.message import Message
from ..session.handler import Refusal
from ..session.server import Deferred, HandlerFailure, TcpServerSession
from ..transport.buffers import receive_buffer

if TYPE_CHECKING:
    from .connections import ConnectionManagement
    from .framed import FramedSession

_log = logging.getLogger("busway.server")


class ServerConnection(asyncio.BufferedProtocol):
    """The driver of one connection.

    Args:
        management: where its place and its session come from.
        role: of the client's certificate, where a secure transport has found one.
        accepted: whether a gate before it has asked `ConnectionManagement.accept` already.

    Attributes:
        session: its conversation; None until the connection is made.
        peer: ``host:port`` of the client.
        role: of its certificate; None without one.
        opened, last_used: monotonic seconds.
        received, sent: bytes so far.
    """

    __slots__ = (
        "_accepted",
        "_buffer",
        "_half_closed",
        "_management",
        "_parameters",
        "_tasks",
        "_trace",
        "_transport",
        "_window",
        "last_used",
        "opened",
        "peer",
        "received",
        "role",
        "sent",
        "session",
    )

    def __init__(self, management: "ConnectionManagement", *, role: str | None = None, accepted: bool = False) -> None:
        self.role = role
        self._accepted = accepted
        self._management = management
        self._parameters = management.parameters
        self._buffer = receive_buffer(management.loop)
        # The TLS of asyncio slices what it is given and fills the slice: of a bytearray, that would be a copy.
        self._window: bytearray | memoryview = memoryview(self._buffer) if accepted else self._buffer
        self._transport: Any = None  # asyncio.Transport; the annotation would cost an isinstance at every write
        self._tasks: set[asyncio.Task[None]] | None = None
        self._trace: Trace | None = None
        self._half_closed = False
        self.session: TcpServerSession | FramedSession | None = None
        self.peer = ""
        self.opened = self.last_used = 0.0
        self.received = self.sent = 0

    # What the event loop calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Accepted: ask connection management for a place."""
        self._transport = transport
        self.peer = peer_name(transport.get_extra_info("peername"))
        self.opened = self.last_used = time.monotonic()
        if not self._accepted and not self._management.accept(transport):
            self._transport.abort()
            return
        self._transport.set_write_buffer_limits(high=self._parameters.write_buffer)
        self.session = self._management.admit(self)

    def get_buffer(self, sizehint: int) -> bytearray | memoryview:
        """Where the event loop receives into."""
        return self._window

    def buffer_updated(self, nbytes: int) -> None:
        """Bytes have come: answer all of them."""
        session = self.session
        if session is None:
            return
        self.received += nbytes
        if TRACE.level:
            self._traced().received(bytes(self._buffer[:nbytes]))
        replies = session.receive(self._buffer, nbytes)
        if replies:
            self._write(replies)
        if session.deferred:
            self._start_waiting(session)
        if session.failures:
            self._report(session)
        if session.unfinished:
            # More than came now: it began with an earlier segment, and its time goes on.
            self._management.watch_frame(self, begun_now=session.unfinished <= nbytes)
        if session.broken:
            _log.warning("%s: closed: %s", self.peer, session.broken)
            self._management.counters.broken_streams += 1
            self._transport.close()

    def eof_received(self) -> bool:
        """The client sends no more; replies that are still to come go out first."""
        self._half_closed = self.session is not None and self.session.waiting > 0
        return self._half_closed

    def pause_writing(self) -> None:
        """The client does not take its replies: stop reading."""
        self._management.counters.reading_paused += 1
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """It takes them again."""
        if not self._transport.is_closing():
            self._transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended, whoever ended it."""
        session, self.session = self.session, None
        for task in self._tasks or ():
            task.cancel()
        if session is not None:
            session.close()
            self._management.leave(self, session, exc)

    # What connection management and the session ask.

    def deliver(self, adu: bytes) -> None:
        """Send a late reply; an empty one says that there is none to wait for any more."""
        if self.session is not None and not self._transport.is_closing():
            if adu:
                self._write([adu])
            if self._half_closed and not self.session.waiting:
                self._transport.close()

    def close(self) -> None:
        """Close after what is written has gone out."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    @property
    def is_busy(self) -> bool:
        """Whether a request is in work or a reply still on its way."""
        if self.session is None:
            return False
        return bool(self.session.waiting or self._transport.get_write_buffer_size())

    def _write(self, replies: list[bytes]) -> None:
        self.last_used = time.monotonic()
        if self._parameters.single_adu_segments:
            for reply in replies:
                self._transport.write(reply)
                self.sent += len(reply)
        else:
            data = replies[0] if len(replies) == 1 else b"".join(replies)
            self._transport.write(data)
            self.sent += len(data)
        if TRACE.level:
            self._traced().sent(b"".join(replies))

    def _traced(self) -> Trace:
        if self._trace is None:
            self._trace = trace_for(self._management.framing, self.peer, is_server=True, carrier=self._transport)
        return self._trace

    def attend(self) -> None:
        """The session has come to something by itself, after a silence."""
        session = self.session
        if session is not None and session.deferred:
            self._start_waiting(session)
        if session is not None and session.failures:
            self._report(session)

    def _start_waiting(self, session: "TcpServerSession | FramedSession") -> None:
        deferred, session.deferred = session.deferred, []
        if self._tasks is None:
            self._tasks = set()
        for one in deferred:
            task = self._management.loop.create_task(answer_later(one))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    def _report(self, session: "TcpServerSession | FramedSession") -> None:
        failures, session.failures = session.failures, []
        self._management.counters.handler_failures += len(failures)
        self._management.diagnosis.internal_fault = time.monotonic()
        report_failures(self.peer, failures)


def report_failures(peer: str, failures: Iterable[HandlerFailure]) -> None:
    """Log what handlers raised."""
    for failure in failures:
        _log.error(
            "%s: unit %s, function %s: the handler failed and the client was answered 04",
            peer,
            failure.context.unit,
            failure.context.function,
            exc_info=failure.error,
        )


async def answer_later(deferred: Deferred) -> None:
    """Await what a handler promised, and reply."""
    context = deferred.context
    try:
        reply: Message = await deferred.awaitable
    except Refusal as refusal:
        context.refuse(refusal.code)
    except asyncio.CancelledError:
        if not context.replied:
            context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
        raise
    except ModbusError as error:
        _log.error("%s: unit %s: the handler failed: %s", context.peer, context.unit, error)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    except Exception:
        _log.exception("%s: unit %s, function %s: the handler failed", context.peer, context.unit, context.function)
        context.refuse(ExceptionCode.SERVER_DEVICE_FAILURE)
    else:
        context.reply(reply)


def host_of(address: object) -> str:
    """The host of a socket address, without port; the text of anything else."""
    return str(address[0]) if isinstance(address, tuple) and address else str(address or "")


def peer_name(address: object) -> str:
    """``host:port`` of a socket address, ``[host]:port`` for IPv6."""
    if isinstance(address, tuple) and len(address) >= 2:
        host, port = address[0], address[1]
        return f"[{host}]:{port}" if ":" in str(host) else f"{host}:{port}"
    return str(address or "?")
