"""A UDP listener: one frame per datagram; each reply goes to the sender of its request.

Knows datagrams and peers; knows nothing of what the frames mean.

1. A datagram that is not one whole frame is dropped and counted; nothing of it is executed.
2. Each peer has a session of its own, so that a slow answer to one peer is not given up because of another peer. Peers
   take slots by the same limits and rules as connections. The slots belong to this listener alone, because any host can
   forge sender addresses, and must not displace TCP clients by that.
3. For a datagram at most one is sent: the reply to its request. Nothing is sent to a sender that is refused, above its
   rate, or without a slot.
4. No event says when a sender has gone. So if priority hosts have all slots of the other pool, a peer of theirs without
   a request in progress is forgotten for a new sender. It loses nothing, because its next datagram gets a slot again.
   Without this, a priority host that uses a new port for each request would keep all others out for ever.
"""

import asyncio
import contextlib
import socket
import time
from typing import Any, Final, cast

from ..framing.datagram import WHOLE
from ..observe.connection_trace import ConnectionTrace, trace_for
from ..observe.socket_addresses import SocketAddresses
from ..observe.trace import TRACE
from ..options.networks import host_of, peer_name
from ..options.sockets import SocketParameters
from ..transport.tcp import set_buffers
from .bound_sockets import bound_name, listening_sockets
from .connection_slots import ConnectionSlots, SlotLimits, SlotPool
from .listener_context import ListenerContext, add_living
from .responder_failures import begin_late_answers
from .serial_over_network import Session
from .server_counters import ServerCounters
from .status import ConnectionStatus, ListenerStatus, ServedConnectionState

_MOST_AT_ONCE: Final = 16
"""Most datagrams that are answered before the loop looks at other connections."""
_LONGEST: Final = 1024
"""Bytes that are read of a datagram: more than any frame has, so a datagram that is cut off is no whole frame
either.
"""


class UdpListener:
    """One UDP endpoint of a server with the peers that send to it; it has one socket, or one each for IPv4 and IPv6.

    Attributes:
        listener_context: what all peers of the listener share.
        names: URLs with the addresses and ports that are really bound.
    """

    def __init__(self, listener_context: ListenerContext, sockets: SocketParameters) -> None:
        self.listener_context = listener_context
        self.names: list[str] = []
        self._parameters = sockets
        self._is_whole = WHOLE[listener_context.framing]
        self._sockets: list[_Socket] = []
        self._connection_slots: ConnectionSlots[_Peer] = ConnectionSlots(SlotLimits.of(listener_context.parameters))
        self._peers: dict[Any, _Peer] = {}  # by socket and address
        self._takes_more = True

    async def open(self) -> None:
        """Start listening. Raises `OSError` or `ConfigError`; then nothing is open."""
        listener_context = self.listener_context
        bound = await listening_sockets(listener_context.loop, listener_context.settings)
        with contextlib.ExitStack() as undo:
            for one in bound:
                undo.callback(one.close)
            undo.callback(self.close)
            for one in bound:
                set_buffers(one, self._parameters)
                made = _Socket(self, one)
                await listener_context.loop.create_datagram_endpoint(lambda made=made: made, sock=one)  # type: ignore[misc]
                self._sockets.append(made)
            undo.pop_all()
        self.names = [bound_name(listener_context.settings.endpoint.scheme, one) for one in bound]
        listener_context.bound_as(self.names)
        listener_context.hosts = tuple(str(one.getsockname()[0]) for one in bound)

    # What the server asks.

    def take_no_more(self) -> None:
        """Drop all further datagrams; requests already received are still answered."""
        self._takes_more = False

    def close(self) -> None:
        """Close the listener; requests that are not answered yet get no reply."""
        for one in self._sockets:
            one.close()

    async def wait_closed(self) -> None:
        """Wait until the sockets of the listener are closed."""
        for one in self._sockets:
            await one.closed

    def end_unauthorized(self) -> int:
        """Forget the peers whose hosts may no longer send; returns their number.

        Their pending requests get no answer.
        """
        may_stay = self.listener_context.may_stay
        ended = [one for one in self._peers.values() if not may_stay(one.host, one.peer)]
        for peer in ended:
            self.leave(peer)
        return len(ended)

    def status(self) -> list[ConnectionStatus]:
        """Return the status of each peer that has a slot, in the order of their first datagrams."""
        now = time.monotonic()
        return [self.listener_context.connected_peer_status(peer, now) for peer in self._peers.values()]

    def listener_status(self) -> ListenerStatus:
        """Return the status of this listener: whether it is open, indicators, used slots and counters."""
        return self.listener_context.status(self._connection_slots.count)

    def add_living(self, counters: ServerCounters) -> None:
        """Add the counters of current peers to ``counters``, which already include forgotten peers."""
        for peer in self._peers.values():
            add_living(counters, peer, peer.session)

    # What its sockets tell.

    def peer_of(self, socket: "_Socket", data: bytes, address: Any, now: float) -> "_Peer | None":
        """Return the peer that sent a datagram, created at its first datagram; None if the datagram is dropped.

        It is dropped if its host may not send or is above its rate, if it is no whole frame, if no slot is free, or
        while the server stops.
        """
        if not self._takes_more:
            return None
        listener_context = self.listener_context
        listener_context.diagnosis.traffic = now
        host = host_of(address)
        if not listener_context.welcomes(host, address):
            return None
        if not self._is_whole(data):
            listener_context.broken()
            listener_context.counters.discarded_frames += 1
            if listener_context.framing != "mbap":
                listener_context.diagnostics.received_damaged()
            return None
        if (
            listener_context.rates is not None
            and not listener_context.is_priority(host)
            and not listener_context.rates.allows(host, now)
        ):
            listener_context.counters.rate_limited += 1
            return None
        return self._peers.get((socket, address)) or self._admit(socket, address)

    def closed(self, socket: "_Socket") -> None:
        """Handle the end of one socket of the listener: drop its peers, and show the listener as not open."""
        self.listener_context.diagnosis.is_open = False
        for peer in [one for one in self._peers.values() if one.socket is socket]:
            self.leave(peer)

    def leave(self, peer: "_Peer") -> None:
        """Remove a UDP peer: its host may no longer send, its slot is needed, or its socket was closed."""
        del self._peers[peer.socket, peer.address]
        self._connection_slots.leave(peer)
        peer.close()
        self.listener_context.connection_closed(peer, peer.session)

    def _admit(self, socket: "_Socket", address: Any) -> "_Peer | None":
        peer = _Peer(self.listener_context, socket, address)
        admission = self._connection_slots.admit(peer)
        if not admission.accepted and self._forget_unused():
            admission = self._connection_slots.admit(peer)
        if not admission.accepted:
            self.listener_context.counters.refused_full += 1
            return None
        if admission.evicted is not None:
            self.listener_context.counters.evicted += 1
            self.leave(admission.evicted)
        self._peers[socket, address] = peer
        self.listener_context.connection_opened(peer)
        return peer

    def _forget_unused(self) -> bool:
        """Forget the longest unused peer in the pool `SlotPool.OTHER`, to free its slot. Returns whether there was one.

        Called only if priority hosts have all slots of that pool (rule 4). A peer with a request in progress stays.
        """
        unused = [one for one in self._peers.values() if one.pool is SlotPool.OTHER and not one.is_busy]
        if not unused:
            return False
        self.listener_context.counters.evicted += 1
        self.leave(min(unused, key=lambda one: one.last_used))
        return True


class _Socket(asyncio.DatagramProtocol):
    """The asyncio protocol of one bound UDP socket of a listener.

    Attributes:
        closed: a future that is done when the socket is closed.
    """

    def __init__(self, listener: UdpListener, bound: socket.socket) -> None:
        self._listener = listener
        self._bound = bound
        self._transport: asyncio.DatagramTransport | None = None
        self._is_full = False
        self.closed: asyncio.Future[None] = listener.listener_context.loop.create_future()

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport of the bound UDP socket, for sending."""
        self._transport = cast(asyncio.DatagramTransport, transport)  # uvloop's is of no such class
        limits: Any = transport  # every transport has them, but the declared type of those for datagrams
        limits.set_write_buffer_limits(high=self._listener.listener_context.parameters.write_buffer)
        self._listener.listener_context.diagnosis.is_open = True

    def datagram_received(self, data: bytes, addr: Any) -> None:  # Any: of whatever family
        """Answer a received datagram and further ones that wait in the socket, together at most 16.

        This saves the event loop from waking up for each of them.
        """
        for left in range(_MOST_AT_ONCE - 1, -1, -1):
            now = time.monotonic()
            peer = self._listener.peer_of(self, data, addr, now)
            if peer is not None:
                peer.heard(data, now)
                for reply in peer.session.receive(data, len(data)):
                    peer.deliver(reply)
                peer.attend()
            if not left or self._transport is None or self._transport.is_closing():
                return
            try:
                data, addr = self._bound.recvfrom(_LONGEST)
            except OSError:
                return  # no more; or an error of one peer, which does not concern the others

    def error_received(self, exc: Exception) -> None:
        """Ignore an error of sending: one peer cannot be reached, and the others share this socket."""

    def pause_writing(self) -> None:
        """Count that the system's send buffer is full, and drop replies from now on, which is allowed over UDP."""
        self._is_full = True
        self._listener.listener_context.counters.reading_paused += 1

    def resume_writing(self) -> None:
        """Send replies again, because the system's send buffer has room."""
        self._is_full = False

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the end of this UDP socket to the listener."""
        self._listener.closed(self)
        if not self.closed.done():
            self.closed.set_result(None)

    # What others ask.

    def send(self, adu: bytes, address: Any) -> None:
        """Send a reply to a UDP peer; dropped if the socket is closing or its buffer is full."""
        if self._transport is not None and not self._is_full and not self._transport.is_closing():
            self._transport.sendto(adu, address)

    def addresses(self, address: Any) -> SocketAddresses:
        """Return the local and remote socket address of datagrams from and to a peer."""
        own = None if self._transport is None else self._transport.get_extra_info("sockname")
        return SocketAddresses(own, address, is_datagram=True)

    def close(self) -> None:
        """Close the UDP socket, whose peers are dropped."""
        if self._transport is not None:
            self._transport.close()
        elif not self.closed.done():
            self.closed.set_result(None)


class _Peer:
    """One sender of datagrams to a UDP listener, with its session; a `ConnectedPeer`."""

    session: Session

    def __init__(self, listener_context: ListenerContext, socket: _Socket, address: Any) -> None:
        self.socket = socket
        self.address = address
        self.peer: str = peer_name(address)
        self.host: str = host_of(address)
        self.role: str | None = None
        self.subject = ""
        self.is_priority: bool = listener_context.is_priority(self.host)
        self.pool = SlotPool.OTHER
        self.opened: float = time.monotonic()
        self.last_used: float = self.opened
        self.received: int = 0
        self.sent: int = 0
        self._listener_context = listener_context
        self._tasks: set[asyncio.Task[None]] = set()
        self._trace: ConnectionTrace | None = None
        self.session = listener_context.session_for(self)

    def heard(self, data: bytes, now: float) -> None:
        """Count a datagram that this peer has sent, and write it to the trace."""
        self.last_used = now
        self.received += len(data)
        if TRACE.level:
            self._traced().received(data)

    def attend(self) -> None:
        """Start tasks for late replies, and log failures of responders, that the session has reported."""
        session = self.session
        if session.deferred:
            deferred, session.deferred = session.deferred, []
            context = self._listener_context
            begin_late_answers(deferred, context.loop, self._tasks, context.late_answers)
        if session.failures:
            failures, session.failures = session.failures, ()
            self._listener_context.failed(self.peer, failures)

    def deliver(self, adu: bytes) -> None:
        """Send one reply to this UDP peer; nothing for empty bytes, which mean that there is no reply."""
        if adu:
            self.sent += len(adu)
            self.socket.send(adu, self.address)
            if TRACE.level:
                self._traced().sent(adu)

    def deliver_together(self, replies: list[bytes]) -> None:
        """Send several replies to this UDP peer, each in a datagram of its own."""
        for reply in replies:
            self.deliver(reply)

    def close(self) -> None:
        """End the session of this UDP peer; requests in progress get no reply."""
        for task in self._tasks:
            task.cancel()
        self.session.close()

    @property
    def is_busy(self) -> bool:
        """Whether a request of this UDP peer is in progress."""
        return bool(self.session.waiting)

    @property
    def has_ended(self) -> bool:
        """Always False: UDP does not tell when a sender has gone."""
        return False

    @property
    def state(self) -> ServedConnectionState:
        """The state of this UDP peer for the status: busy while a request is in progress, else idle."""
        return ServedConnectionState.BUSY if self.is_busy else ServedConnectionState.IDLE

    def _traced(self) -> ConnectionTrace:
        if self._trace is None:
            self._trace = trace_for(
                self._listener_context.framing, self.peer, is_server=True, carrier=self.socket.addresses(self.address)
            )
        return self._trace
