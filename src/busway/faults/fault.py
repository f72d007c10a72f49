"""A fault: what it changes in the requests and replies of a connection.

Knows requests, replies and ``now``, the time in seconds of the driver's clock; knows no socket, no clock and no device.
Which requests a fault applies to, and when, is decided in `busway.faults.applied_faults`.

A `Fault` is up to four functions: whether a connection is admitted, what answers a request in place of the device, how
its reply is changed, and when an idle connection is closed. It acts only on carriers where it exists: faults of
connections on connections, faults of lines on lines.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from random import Random
from typing import Any

from ..pdu.functions import AnyRequest
from ..pdu.message import Request, Span

SILENCE = b""
"""The result of ``Fault.asked`` that suppresses the reply."""


class Carrier(Enum):
    """Kinds of transport on which a fault can occur. A connection can belong to several."""

    TCP = "tcp"
    """Frames of Modbus on TCP/IP, whose header has a transaction identifier; over TCP, TLS or UDP."""
    SERIAL = "serial"
    """Frames of serial lines, RTU and ASCII; on a line, or over a network."""
    CONNECTION = "connection"
    """A connection that can be closed: over TCP or TLS, whatever the frames are."""


EVERYWHERE = frozenset(Carrier)
"""All kinds of transport."""


@dataclass(slots=True, eq=False, weakref_slot=True)
class Contact:
    """Facts about one connection that decide which faults apply. Times are seconds of the clock that times the faults.

    Attributes:
        opened: when the connection was opened.
        others: number of other connections of the server that were open then.
        last_received, last_sent: time of the last complete request and of the last sent bytes; None before the first.
            What was received and sent while all faults were off can be missing; when the first fault is switched on,
            ``last_received`` becomes that time. For a reply that the device itself has
            sent, without a fault, ``last_sent`` is the time of the request.
        carriers: the kinds of transport that the connection belongs to.
    """

    opened: float
    others: int = 0
    last_received: float | None = None
    last_sent: float | None = None
    carriers: frozenset[Carrier] = frozenset({Carrier.TCP, Carrier.CONNECTION})


@dataclass(frozen=True, slots=True)
class Exchange:
    """A request that faults may apply to, with its connection and the time it was received.

    Attributes:
        contact: the connection.
        transaction: transaction identifier, 0…65535; 0 on serial lines, which have none.
        unit: unit identifier, 0…255.
        pdu: the PDU of the request as received.
        request: the decoded request; also one that is malformed or of an unknown function.
        now: the time at which the request was complete, in seconds.
        random: random number generator; a fault's functions get the exchange with the fault's own generator.
        adu: the frame of the request.
        is_broadcast: whether the request went to all units of a line, so that no unit is allowed to answer.
    """

    contact: Contact
    transaction: int
    unit: int
    pdu: bytes
    request: AnyRequest
    now: float
    random: Random = field(default_factory=Random)
    adu: bytes = b""
    is_broadcast: bool = False

    @property
    def function(self) -> int:
        """Function code of the request as received, 0…255."""
        return self.pdu[0]

    @property
    def spans(self) -> tuple[Span, ...]:
        """The ranges of items that the request reads or writes; empty if it is malformed or of an unknown function."""
        return self.request.spans() if isinstance(self.request, Request) else ()

    @property
    def is_write(self) -> bool:
        """Whether the request can change data of the device: False if it is malformed, True for an unknown function."""
        return (isinstance(self.request, Request) and self.request.is_write) or any(one.writes for one in self.spans)


@dataclass(frozen=True, slots=True)
class Emission:
    """A frame that a faulty device is to send to the client, and when; faults change these before they are sent.

    Attributes:
        transaction, unit, pdu: content of the frame. With an empty PDU no frame is sent, only ``before``.
        before, after: further bytes that are sent before and after the frame and belong to no frame.
        length: value of the length field in the MBAP header; None for the right one. Ignored for RTU and ASCII.
        delay: seconds from the reply of the device until the frame is sent; more if an earlier frame is unsent then.
        piece: number of bytes in one write; 0 to send all bytes with one write.
        pause: seconds between two pieces.
        glued: whether the frame leaves in one write with the frame before it, if that is glued too and both are due.
        closes: whether the connection is closed after the frame.
    """

    transaction: int
    unit: int
    pdu: bytes = b""
    before: bytes = b""
    after: bytes = b""
    length: int | None = None
    delay: float = 0.0
    piece: int = 0
    pause: float = 0.0
    glued: bool = False
    closes: bool = False


Admits = Callable[[Contact], bool]
ReplaceAnswer = Callable[[Exchange], bytes | None]
ChangeReply = Callable[[Exchange, list[Emission]], list[Emission]]
ClosesAt = Callable[[Contact], float | None]


@dataclass(frozen=True, slots=True, eq=False)
class Fault:
    """One way to misbehave: functions that replace parts of a device's behaviour; None leaves a part unchanged.

    Args:
        name: the name of the fault profile; empty for none.
        admits: returns whether a new connection may stay open; False closes it at once.
        asked: returns the PDU that answers a request instead of the device; `SILENCE` for no reply; None to let the
            device answer.
        answered: is called with the frames that are to be sent as the reply, and returns those to send instead.
        closes_at: returns the time, in seconds, at which an idle connection is closed; None for never.
        carriers: the kinds of transport on which the fault can occur.
        options: parameters of its fault profile by name, with the values that were given when it was created;
            parameters that were left out, and so have their defaults, are missing.
    """

    name: str = ""
    admits: Admits | None = None
    asked: ReplaceAnswer | None = None
    answered: ChangeReply | None = None
    closes_at: ClosesAt | None = None
    carriers: frozenset[Carrier] = EVERYWHERE
    options: Mapping[str, Any] = field(default_factory=dict)  # Any: of the types that the fault profile declares

    def is_met(self, contact: Contact) -> bool:
        """Whether the fault can occur on this connection: one of its kinds of transport is in ``carriers``."""
        return not self.carriers.isdisjoint(contact.carriers)
