"""A UDP listener: one frame per datagram, answered to its sender and to nobody else.

Knows datagrams and peers; knows nothing of what they say.

1. A datagram that is not one whole frame is dropped and counted; nothing of it is executed.
2. Each peer has a conversation of its own, so that a slow answer of one is not given up because of another. There are
   as many as connections may be; the one unused longest makes room.
"""

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Container
from dataclasses import replace
from typing import Any, cast

from ..framing.datagram import WHOLE
from ..observe.ends import Ends
from ..observe.line_trace import Trace, trace_for
from ..observe.trace import TRACE
from ..session.diagnostics import CommunicationState
from ..session.handler import Handler
from ..session.parameters import Scope, ServerParameters
from ..session.server import TcpServerSession, TransactionSlots
from .authorisation import Authorise, everybody
from .connection import answer_later, host_of, peer_name, report_failures
from .connections import ConnectionStatus, ServerCounters
from .diagnosis import Diagnosis
from .framed import FramedSession
from .listener_settings import ListenerSettings
from .parameters import ListenerParameters
from .status import ListenerStatus

_log = logging.getLogger("busway.server")


class UdpListener(asyncio.DatagramProtocol):
    """One bound socket.

    Attributes:
        listener: URL as it is bound.
        diagnostics: counters and mode of the listener.
        diagnosis: for the lamps.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        settings: ListenerSettings,
        handler: Handler,
        units: Container[int],
        *,
        parameters: ListenerParameters,
        session_parameters: ServerParameters,
        counters: ServerCounters,
        slots: TransactionSlots,
        authorise: Authorise = everybody,
    ) -> None:
        self.listener = settings.endpoint.url
        self.diagnostics = CommunicationState(changes_allowed=session_parameters.diagnostics_changes is True)
        self.diagnostics.ascii_delimiter = settings.framing.delimiter
        self.diagnosis = Diagnosis()
        self._loop = loop
        self._authorise = authorise
        self._settings = settings
        self._framing = settings.endpoint.framing
        self._is_whole = WHOLE[self._framing]
        self._handler = handler
        self._units = units
        self._parameters = parameters
        self._session_parameters = session_parameters
        self._counters = counters
        self._slots = slots
        self._transport: asyncio.DatagramTransport | None = None
        self._peers: OrderedDict[Any, _Peer] = OrderedDict()  # by address; the one used last stands last
        self._dropped = 0
        self._closed = loop.create_future()

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Bound."""
        self._transport = cast(asyncio.DatagramTransport, transport)  # uvloop's is of no such class
        self.diagnosis.is_open = True

    def datagram_received(self, data: bytes, addr: Any) -> None:  # Any: of whatever family
        """A datagram has come: answer it."""
        now = time.monotonic()
        self.diagnosis.traffic = now
        if not self._authorise(host_of(addr)):
            self._counters.unauthorised += 1
            return
        if not self._is_whole(data):
            self._dropped += 1
            self._counters.discarded_frames += 1
            self.diagnosis.communication_fault = now
            if self._framing != "mbap":
                self.diagnostics.received_damaged()
            return
        peer = self._peers.get(addr)
        if peer is None:
            peer = self._admit(addr)
        self._peers.move_to_end(addr)
        peer.receive(data, now)

    def error_received(self, exc: Exception) -> None:
        """A peer does not take its answer: it has gone, and others have not."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Closed."""
        self.diagnosis.is_open = False
        for peer in self._peers.values():
            self._leave(peer)
        self._peers.clear()
        if not self._closed.done():
            self._closed.set_result(None)

    # What the server asks.

    def close(self) -> None:
        """Close it; what is still in work gets no answer."""
        if self._transport is not None:
            self._transport.close()

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self._closed

    def status(self) -> list[ConnectionStatus]:
        """The peers, the one unused longest first."""
        now = time.monotonic()
        return [peer.status(self.listener, now) for peer in self._peers.values()]

    def listener_status(self) -> ListenerStatus:
        """The listener itself."""
        return ListenerStatus(
            endpoint=self.listener,
            is_open=self.diagnosis.is_open,
            lamps=self.diagnosis.lamps(time.monotonic(), listen_only=self.diagnostics.listen_only),
            counters=replace(self.diagnostics.counters),
            event_count=self.diagnostics.event_count,
            listen_only=self.diagnostics.listen_only,
            requests=self.diagnostics.counters.server_message_count,
            damaged=self._dropped,
        )

    def sessions(self) -> list[TcpServerSession | FramedSession]:
        """The conversations of the peers."""
        return [peer.session for peer in self._peers.values()]

    # What a peer asks.

    def send(self, adu: bytes, address: Any) -> None:
        """Send an answer."""
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(adu, address)

    def ends(self, address: Any) -> Ends:
        """Both ends of the conversation with a peer."""
        own = None if self._transport is None else self._transport.get_extra_info("sockname")
        return Ends(own, address, is_datagram=True)

    def start(self, deferred: Any) -> "asyncio.Task[None]":
        """Await what a handler promised."""
        return self._loop.create_task(answer_later(deferred))

    def failed(self, peer: str, failures: Any) -> None:
        """Handlers have failed."""
        self._counters.handler_failures += len(failures)
        self.diagnosis.internal_fault = time.monotonic()
        report_failures(peer, failures)

    # Inside.

    def _admit(self, address: Any) -> "_Peer":
        while len(self._peers) >= self._parameters.max_connections:
            _, oldest = self._peers.popitem(last=False)
            self._counters.evicted += 1
            self._leave(oldest)
        self._counters.accepted += 1
        peer = self._peers[address] = _Peer(self, address, self._framing)
        peer.session = self._session_for(peer)
        return peer

    def _session_for(self, peer: "_Peer") -> TcpServerSession | FramedSession:
        if self._framing != "mbap":
            return FramedSession(
                self._loop,
                self._handler,
                self._units,
                framing=self._settings.line_framing(self._units, self._handler.functions),
                diagnostics=self.diagnostics,
                deliver=peer.deliver,
                attend=peer.attend,
                peer=peer.name,
                listener=self.listener,
            )
        slots = self._slots
        if self._session_parameters.scope is Scope.CONNECTION:
            slots = TransactionSlots(self._session_parameters.max_transactions)
        return TcpServerSession(
            self._handler,
            diagnostics=self.diagnostics,
            slots=slots,
            deliver=peer.deliver,
            peer=peer.name,
            listener=self.listener,
        )

    def _leave(self, peer: "_Peer") -> None:
        peer.close()
        self._counters.closed += 1
        self._counters.requests += peer.session.requests
        self._counters.discarded_frames += peer.session.discarded
        self._counters.refused_busy += peer.session.refused_busy


class _Peer:
    """One sender and its conversation."""

    session: TcpServerSession | FramedSession

    def __init__(self, listener: UdpListener, address: Any, framing: str) -> None:
        self.name = peer_name(address)
        self._listener = listener
        self._address = address
        self._framing = framing
        self._tasks: set[asyncio.Task[None]] = set()
        self._trace: Trace | None = None
        self._opened = self._used = time.monotonic()
        self._received = self._sent = 0

    def receive(self, data: bytes, now: float) -> None:
        self._used = now
        self._received += len(data)
        if TRACE.level:
            self._traced().received(data)
        for reply in self.session.receive(data, len(data)):
            self.deliver(reply)
        self.attend()

    def attend(self) -> None:
        session = self.session
        if session.deferred:
            deferred, session.deferred = session.deferred, []
            for one in deferred:
                task = self._listener.start(one)
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
        if session.failures:
            failures, session.failures = session.failures, []
            self._listener.failed(self.name, failures)

    def deliver(self, adu: bytes) -> None:
        if adu:
            self._sent += len(adu)
            self._listener.send(adu, self._address)
            if TRACE.level:
                self._traced().sent(adu)

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        self.session.close()

    def status(self, listener: str, now: float) -> ConnectionStatus:
        return ConnectionStatus(
            peer=self.name,
            listener=listener,
            age=now - self._opened,
            idle=now - self._used,
            received=self._received,
            sent=self._sent,
            requests=self.session.requests,
            waiting=self.session.waiting,
        )

    def _traced(self) -> Trace:
        if self._trace is None:
            self._trace = trace_for(
                self._framing, self.name, is_server=True, carrier=self._listener.ends(self._address)
            )
        return self._trace
