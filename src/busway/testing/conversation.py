"""One connection of a server that misbehaves: bytes in, writes out, faults between.

Knows MBAP frames, the faults and ``now``; knows no socket and no clock. What the device says comes from a server
session of the real kind, so everything that no fault touches is as right as it is elsewhere.

1. Replies leave in the order of their requests, however late one is.
2. What is due is given by `FaultyConversation.tick`, one item per write; ``deadline`` says when there will be more.
"""

from collections import deque
from dataclasses import dataclass

from ..framing.mbap import HEAD, FrameKind, MbapFrame, MbapReceiver, encode_mbap
from ..pdu.functions import FunctionTable
from ..session.server import TcpServerSession
from .faults import Contact, Emission, Exchange, Faults

_HIGHEST_FUNCTION = 0x7F
"""Beyond it a frame would be a reply: every server discards it, and no fault has anything to say about it."""
_SAME_MOMENT = 1e-6
"""Seconds. Sums of times that mean the same moment differ in their last bits."""


@dataclass(frozen=True, slots=True)
class _Due:
    when: float
    data: bytes
    glued: bool
    closes: bool


class FaultyConversation:
    """What is said on one connection.

    Args:
        session: answers for the device.
        faults: what goes wrong.
        contact: the connection, as faults see it.
        functions: the table of functions, for faults that look at addresses.

    Attributes:
        closed: whether the connection is to be closed, after what `tick` gave has been written.
        exchanges: requests that came since this list was emptied; whoever wants them takes them.
    """

    def __init__(self, session: TcpServerSession, faults: Faults, contact: Contact, functions: FunctionTable) -> None:
        self._session = session
        self._faults = faults
        self._contact = contact
        self._functions = functions
        self._receiver = MbapReceiver()
        self._outbox: deque[_Due] = deque()
        self._last_due = contact.opened
        self.exchanges: list[Exchange] = []
        self.closed = not faults.admit(contact)

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes of the client."""
        for frame in self._receiver.receive(data):
            if frame.kind is FrameKind.FRAME and frame.pdu[0] <= _HIGHEST_FUNCTION:
                self._take(frame, now)
            elif frame.kind is FrameKind.BROKEN:
                self._plan(Emission(0, 0, closes=True), now)

    def tick(self, now: float) -> list[bytes]:
        """What is to be written now, each item by itself."""
        writes: list[bytes] = []
        glued = False
        while self._outbox and self._outbox[0].when <= now + _SAME_MOMENT and not self.closed:
            due = self._outbox.popleft()
            if due.data:
                if glued and due.glued:
                    writes[-1] += due.data
                else:
                    writes.append(due.data)
                glued = due.glued
            self.closed = due.closes
        if writes:
            self._contact.last_sent = now
        closes_at = self._faults.closes_at(self._contact, now)
        if closes_at is not None and closes_at <= now + _SAME_MOMENT:
            self.closed = True
        return writes

    def deadline(self, now: float) -> float | None:
        """When `tick` has something to do; None while only the client can change that."""
        closes_at = self._faults.closes_at(self._contact, now)
        due = self._outbox[0].when if self._outbox else None
        return min((when for when in (closes_at, due) if when is not None), default=None)

    def _take(self, frame: MbapFrame, now: float) -> None:
        exchange = Exchange(
            self._contact,
            frame.transaction,
            frame.unit,
            frame.pdu,
            self._functions.decode_request(frame.pdu),
            now,
        )
        self.exchanges.append(exchange)
        struck = self._faults.strike(exchange)
        self._contact.last_received = now
        for fault, seen in struck:
            answer = fault.asked(seen) if fault.asked is not None else None
            if answer is not None:
                break
        else:
            answer = self._device_says(frame)
        emissions = [Emission(frame.transaction, frame.unit, answer)] if answer else []
        for fault, seen in struck:
            if fault.answered is not None:
                emissions = fault.answered(seen, emissions)
        for emission in emissions:
            self._plan(emission, now)

    def _device_says(self, frame: MbapFrame) -> bytes:
        adu = encode_mbap(frame.transaction, frame.unit, frame.pdu)
        replies = self._session.receive(adu, len(adu))
        return replies[0][7:] if replies else b""

    def _plan(self, emission: Emission, now: float) -> None:
        when = max(now + emission.delay, self._last_due)
        data = _encoded(emission)
        size = emission.piece or len(data) or 1
        pieces = [data[at : at + size] for at in range(0, len(data), size)] or [b""]
        for number, piece in enumerate(pieces):
            closes = emission.closes and number == len(pieces) - 1
            self._outbox.append(_Due(when + number * emission.pause, piece, emission.glued, closes))
        self._last_due = self._outbox[-1].when


def _encoded(emission: Emission) -> bytes:
    if not emission.pdu:
        return b""
    length = 1 + len(emission.pdu) if emission.length is None else emission.length
    return HEAD.pack(emission.transaction, 0, length, emission.unit) + emission.pdu
