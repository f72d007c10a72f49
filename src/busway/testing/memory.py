"""Connections in memory: a pair of asyncio transports, where each gets what the other sends.

Knows protocols and ``now``; knows no socket. Without an event loop bytes are delivered only when the test calls
`deliver`, and the test sees every segment.

::

    pair = MemoryPair(client_protocol, server_protocol)
    pair.open()
    pair.deliver()                                # until nothing is on its way any more

1. Segments arrive in the order in which they were written; `Passage` says how they are split and merged.
2. With ``schedule`` (``loop.call_soon``) written bytes arrive without a call; delayed ones wait for `deliver`.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random
from typing import Any


@dataclass(frozen=True, slots=True)
class Passage:
    """How bytes travel in one direction of a connection in memory: delay, loss, splitting and merging.

    Args:
        drop: probability that a segment is lost, 0…1.
        delay: seconds in transit.
        split: bytes of each piece in which a segment arrives; 0 for whole segments.
        merge: whether segments that arrive at the same moment arrive as one.
        seed: seed of random choices.
    """

    drop: float = 0.0
    delay: float = 0.0
    split: int = 0
    merge: bool = False
    seed: int = 0


class MemoryTransport(asyncio.Transport):
    """One end of a connection in memory, as an asyncio transport; created by `MemoryPair`.

    Attributes:
        written: every segment that this end has sent, in order, lost ones included.
        in_transit: segments on their way to the other end, each with the time of its arrival.
    """

    def __init__(self, passage: Passage, extra: Mapping[str, Any]) -> None:  # Any: as asyncio has it
        super().__init__(dict(extra))
        self._passage = passage
        self._random = Random(passage.seed)
        self._protocol: asyncio.BaseProtocol | None = None
        self._closing = False
        self._lost = False
        self._reading = True
        self._pair: MemoryPair | None = None
        self.in_transit: deque[tuple[float, bytes]] = deque()
        self.written: list[bytes] = []

    # What a protocol asks.

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send bytes to the other end of the connection in memory, as one segment; nothing if this end is closed."""
        if self._closing or not data:
            return
        assert self._pair is not None
        segment = bytes(data)
        self.written.append(segment)
        passage = self._passage
        if passage.drop and self._random.random() < passage.drop:
            return
        size = passage.split or len(segment)
        for at in range(0, len(segment), size):
            self.in_transit.append((self._pair.now + passage.delay, segment[at : at + size]))
        self._pair.something_left()

    def close(self) -> None:
        """Close the connection in memory: it ends at both ends once all bytes written at this end have arrived."""
        if not self._closing:
            self._closing = True
            assert self._pair is not None
            self._pair.something_left()

    def abort(self) -> None:
        """Close the connection in memory; segments from this end that are still on their way are dropped."""
        self.in_transit.clear()
        self.close()

    def is_closing(self) -> bool:
        """Whether this end was closed, or the connection in memory has ended because the other end was closed."""
        return self._closing

    def pause_reading(self) -> None:
        """Stop delivering bytes to this end of the connection in memory."""
        self._reading = False

    def resume_reading(self) -> None:
        """Deliver bytes to this end of the connection in memory again."""
        self._reading = True
        if self._pair is not None:
            self._pair.something_left()

    def is_reading(self) -> bool:
        """Whether bytes may be delivered to this end of the connection in memory."""
        return self._reading and not self._closing

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        """Do nothing: bytes on their way through a connection in memory are not limited."""

    def get_write_buffer_size(self) -> int:
        """Return the number of bytes on their way to the other end."""
        return sum(len(data) for _, data in self.in_transit)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """Set the asyncio protocol to which arriving bytes are passed at this end."""
        self._protocol = protocol

    def get_protocol(self) -> asyncio.BaseProtocol:
        """Return the asyncio protocol to which arriving bytes are passed at this end."""
        assert self._protocol is not None
        return self._protocol

    # What the pair asks.

    def join(self, pair: "MemoryPair", protocol: asyncio.BaseProtocol) -> None:
        """Make this transport one end of the connection ``pair``; ``protocol`` gets the bytes that arrive here."""
        self._pair = pair
        self._protocol = protocol

    def due(self, now: float) -> bytes:
        """Remove and return the next segment that has reached the other end at ``now`` (seconds); empty if none has.

        With ``merge`` of the `Passage`, all segments that have reached it, as one.
        """
        if not self.in_transit or self.in_transit[0][0] > now:
            return b""
        data = self.in_transit.popleft()[1]
        while self._passage.merge and self.in_transit and self.in_transit[0][0] <= now:
            data += self.in_transit.popleft()[1]
        return data

    def take(self, data: bytes) -> None:
        """Pass arrived bytes to the asyncio protocol of this end of the connection in memory."""
        protocol = self._protocol
        if isinstance(protocol, asyncio.BufferedProtocol):
            while data and not self._closing:
                room = memoryview(protocol.get_buffer(len(data)))
                size = min(room.nbytes, len(data))
                room[:size] = data[:size]
                room.release()
                protocol.buffer_updated(size)
                data = data[size:]
        elif isinstance(protocol, asyncio.Protocol):
            protocol.data_received(data)

    def lose(self) -> bool:
        """End the connection at this end, and call ``connection_lost`` of its protocol. Returns whether it was open."""
        if self._lost:
            return False
        self._closing = self._lost = True
        assert self._protocol is not None
        self._protocol.connection_lost(None)
        return True

    @property
    def has_ended(self) -> bool:
        """Whether this end of the connection in memory is closed and all that it sent has arrived."""
        return self._closing and not self.in_transit


class MemoryPair:
    """A connection in memory: two asyncio transports with their protocols.

    Args:
        first, second: the protocols at its ends.
        forth: how bytes travel from the first to the second; at once and whole by default.
        back: how bytes travel from the second to the first.
        schedule: calls a function soon (``loop.call_soon``); None: bytes arrive only in `deliver`.
        extra: the names and values that ``get_extra_info`` of both transports returns.

    Attributes:
        first, second: the transports of the ends.
        now: the time in seconds; moved by `deliver`.
    """

    def __init__(
        self,
        first: asyncio.BaseProtocol,
        second: asyncio.BaseProtocol,
        *,
        forth: Passage | None = None,
        back: Passage | None = None,
        schedule: Callable[[Callable[[], None]], object] | None = None,
        extra: Mapping[str, Any] | None = None,  # Any: as asyncio has it
    ) -> None:
        self.now: float = 0.0
        self.first: MemoryTransport = MemoryTransport(forth or Passage(), extra or {})
        self.second: MemoryTransport = MemoryTransport(back or Passage(), extra or {})
        self._schedule = schedule
        self._scheduled = False
        self._protocols = (first, second)
        self.first.join(self, first)
        self.second.join(self, second)

    def open(self) -> None:
        """Call ``connection_made`` of both protocols; of the second one first, because a server accepts first."""
        self._protocols[1].connection_made(self.second)
        self._protocols[0].connection_made(self.first)

    def something_left(self) -> None:
        """Schedule a delivery if ``schedule`` was given; called by a transport after it has sent or closed."""
        if self._schedule is not None and not self._scheduled:
            self._scheduled = True
            self._schedule(self._deliver_scheduled)

    def _deliver_scheduled(self) -> None:
        self._scheduled = False
        self.deliver()

    def deliver(self, seconds: float = 0.0) -> None:
        """Move the time forward by ``seconds``; deliver all bytes that arrive by then, and those sent in response."""
        self.now += seconds
        while self._step(self.first, self.second) or self._step(self.second, self.first):
            pass

    def _step(self, sender: MemoryTransport, receiver: MemoryTransport) -> bool:
        """Deliver one segment from sender to receiver, or the end of the connection. Returns whether there was one."""
        if receiver.is_reading():
            data = sender.due(self.now)
            if data:
                receiver.take(data)
                return True
        if sender.has_ended or (sender.is_closing() and receiver.is_closing()):
            ended = sender.lose()
            return receiver.lose() or ended
        return False
