"""One connection of a faulty device, without IO: takes requests, and plans which bytes are sent when.

Knows frames, the faults and ``now``, a time in seconds; knows no socket, no clock and no device. Its driver passes it
the requests and the device's replies.

1. For each request: `strike` decides which faults apply; `asked` returns the reply of a fault that replaces the
   device's, if any; `answered` gets the reply and plans what is sent.
2. Replies are sent in the order of their requests, however late one is. While any is unsent (`has_unsent`), replies
   without a fault wait for it.
3. `FaultyConversation.tick` returns the bytes that are due, one item per write; `deadline` says when more will be.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ..framing.ascii import encode_ascii
from ..framing.mbap import HEAD
from ..framing.rtu import encode_rtu
from .applied_faults import SAME_MOMENT, AppliedFault, Faults
from .fault import Contact, Emission, Exchange

Struck = Sequence[tuple[AppliedFault, Exchange]]
"""The faults that apply to a request, in order, each with the request as that fault sees it."""


def _mbap(transaction: int, unit: int, pdu: bytes, length: int | None) -> bytes:
    return HEAD.pack(transaction, 0, 1 + len(pdu) if length is None else length, unit) + pdu


ENCODERS: Final[Mapping[str, Callable[[int, int, bytes, int | None], bytes]]] = {
    "mbap": _mbap,
    "rtu": lambda transaction, unit, pdu, length: encode_rtu(unit, pdu),
    "ascii": lambda transaction, unit, pdu, length: encode_ascii(unit, pdu),
}
"""By framing (``mbap``, ``rtu``, ``ascii``), the function that returns a frame.

Its arguments are transaction, unit, PDU, and the value of the length field, right or wrong; None for the right one. RTU
and ASCII ignore transaction and length; their CRC or LRC is always right.
"""


@dataclass(frozen=True, slots=True)
class _Due:
    """The bytes of one write, to be sent at the time ``when`` (seconds).

    ``glued``: joined with glued bytes that are due before them. ``closes``: the connection is closed after them.
    """

    when: float
    data: bytes
    glued: bool
    closes: bool


class FaultyConversation:
    """One connection of a device with faults: plans which bytes answer its requests, and when.

    Args:
        faults: the faults to apply.
        contact: the facts about the connection that faults depend on.
        framing: ``mbap``, ``rtu`` or ``ascii``.
        gap: seconds of silence that a serial line needs before a frame: each reply is sent so much later.

    Attributes:
        contact: the facts about the connection; `strike` and `tick` update its times.
        closed: whether the connection is to be closed, after the bytes that `tick` returned have been written.
    """

    def __init__(self, faults: Faults, contact: Contact, framing: str = "mbap", *, gap: float = 0.0) -> None:
        self._faults = faults
        self._encode = ENCODERS[framing]
        self._gap = gap
        self._outbox: deque[_Due] = deque()
        self._last_due = contact.opened
        self.contact = contact
        self.closed: bool = not faults.admit(contact)

    @property
    def has_unsent(self) -> bool:
        """True if planned bytes are not sent yet, so that a later reply must wait for them."""
        return bool(self._outbox)

    # Requests.

    def frame(self, transaction: int, unit: int, pdu: bytes) -> bytes:
        """Return the frame (ADU) of a PDU in the framing of the connection, without any fault."""
        return self._encode(transaction, unit, pdu, None)

    def strike(self, exchange: Exchange) -> Struck:
        """Return the faults that apply to a received request, in the order in which they act; empty if none applies.

        Call it once for each request, because it counts requests for the schedules of faults, and stores the time of
        the request in the conversation's ``contact.last_received``.
        """
        struck = self._faults.strike(exchange)
        self.contact.last_received = exchange.now
        return struck

    @staticmethod
    def asked(struck: Struck) -> bytes | None:
        """Return the PDU with which a fault answers in place of the device; None if the device is to answer.

        `SILENCE`, an empty PDU, if the fault suppresses the reply. The first fault that answers decides; its counter
        ``AppliedFault.struck`` grows by 1. The argument ``struck`` is the result of `strike` for the request.
        """
        for applied, seen in struck:
            asked = applied.fault.asked
            answer = asked(seen) if asked is not None else None
            if answer is not None:
                applied.count(seen)
                return answer
        return None

    def answered(self, exchange: Exchange, struck: Struck, answer: bytes, now: float) -> bool:
        """Plan the bytes to send for a reply, as the faults change it. Returns whether any frame is going to be sent.

        Nothing is sent here; `tick` returns the bytes when they are due.

        Args:
            exchange: the request.
            struck: the result of `strike` for the request.
            answer: the PDU of the reply, of the device or of a fault; empty for none. For a broadcast it is not sent.
            now: the time of the reply, in seconds.
        """
        is_said = answer and not exchange.is_broadcast
        emissions = [Emission(exchange.transaction, exchange.unit, answer)] if is_said else []
        for applied, seen in struck:
            if applied.fault.answered is not None:
                made = applied.fault.answered(seen, emissions)
                if made != emissions:
                    applied.count(seen)
                emissions = made
        for emission in emissions:
            self._plan(emission, now)
        return any(emission.pdu for emission in emissions)

    # Time.

    def tick(self, now: float) -> list[bytes]:
        """Return the bytes to send on the connection at ``now`` (seconds), one item per write, in order.

        Sets ``closed`` if the connection must be closed afterwards.
        """
        writes: list[bytes] = []
        glued = False
        while self._outbox and self._outbox[0].when <= now + SAME_MOMENT and not self.closed:
            due = self._outbox.popleft()
            if due.data:
                if glued and due.glued:
                    writes[-1] += due.data
                else:
                    writes.append(due.data)
                glued = due.glued
            self.closed = due.closes
        if writes:
            self.contact.last_sent = now
        if not self.closed and self._faults.closes(self.contact, now):
            self.closed = True
        return writes

    def deadline(self, now: float) -> float | None:
        """Return the time, in seconds, at which `tick` has something to do next; None for never.

        `tick` then has bytes to send, closes the connection, or finds that a fault which can close it became active.
        """
        closes_at = self._faults.closes_at(self.contact, now)
        due = self._outbox[0].when if self._outbox else None
        return min((when for when in (closes_at, due) if when is not None), default=None)

    # Inside.

    def _plan(self, emission: Emission, now: float) -> None:
        when = max(now + self._gap + emission.delay, self._last_due)
        data = emission.before
        if emission.pdu:
            data += self._encode(emission.transaction, emission.unit, emission.pdu, emission.length) + emission.after
        size = emission.piece or len(data) or 1
        pieces = [data[at : at + size] for at in range(0, len(data), size)] or [b""]
        for number, piece in enumerate(pieces):
            closes = emission.closes and number == len(pieces) - 1
            self._outbox.append(_Due(when + number * emission.pause, piece, emission.glued, closes))
        self._last_due = self._outbox[-1].when
