"""Reads that a gateway forwards on the fast path: the reads of one TCP segment are forwarded together.

Knows the layout of a read and its answer on TCP, and the slots of a connection; knows no upstream and no route.

1. A read is recognised by the ten bytes after its transaction identifier, like the known reads of the server's fast
   path. The responder is asked once how such a read is forwarded, for all clients with the same rights.
2. Each read takes a slot until its answer is there (Messaging on TCP/IP V1.0b §4.4.2). If none is left, the read goes
   to the generic path, which answers 06.
3. Each read forwarded here is answered once, by `answer`, `reply` or `refuse`, with the unit and the transaction
   identifier of its request. If the connection ends first, it gets no answer, and the read batch that contains it is
   informed.
4. Answers and counters are the same as on the generic path.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from struct import Struct
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

from ..framing.mbap import HEAD
from ..pdu.message import Message, Request

if TYPE_CHECKING:
    from .diagnostic_counters import LineDiagnostics
    from .responder import ClientIdentity, ForwardingTarget, RequestContext
    from .server_transaction_slots import ServerTransactionSlots

READ_SIZE = 12
"""Bytes of the ADU of a read (functions 01 to 04)."""
_READ_LENGTH = b"\0\0\0\6"
"""Protocol identifier and length field in the MBAP header of a read (functions 01 to 04)."""
_UNIT_ASKED = 4
"""Offset of the unit identifier in the key of a read (its ten bytes after the transaction identifier), and in
`PreparedForward.head`.
"""
LAST_READ = 4
"""The largest function code of the reads that are forwarded together: functions 01 to 04."""
_KNOWN_LIMIT = 4096
DeliverTogether = Callable[[list[bytes]], None]
"""Function that sends the frames of several late replies on the connection."""


class PreparedForward:
    """How a gateway forwards one particular read: to which upstream unit, and with which request.

    Args:
        target: the upstream unit that the read is forwarded to.
        unit: the unit that the client named.
        request: the request to send upstream, prepared; its reply is data bytes, or a message with ``data``.

    Attributes:
        target: as given.
        requests: a tuple of one element, the request.
        key: the PDU of the request; identical reads of one unit have equal keys.
        place: always None: no place in a cache, because the data of the reply are not cached.
        head: the bytes of the client's reply between the transaction identifier and the data.
    """

    __slots__ = ("head", "key", "requests", "target")
    place = None

    def __init__(self, target: "ForwardingTarget", unit: int, request: Request) -> None:
        self.target: ForwardingTarget = target
        self.requests: tuple[Request, ...] = (request,)
        self.key: bytes = request.wire
        # The data follow the head: the answer is as long as the reply that is expected from upstream.
        self.head: bytes = HEAD.pack(0, 0, 1 + request.expected_size, unit)[2:] + request.expected_prefix

    def refusal(self, code: int) -> bytes:
        """Return the frame of an exception reply to the client, without its transaction identifier.

        It is the rest of the MBAP header (protocol identifier, length, the unit that the client named) and the PDU.
        """
        return b"\0\0\0\3" + self.head[4:5] + bytes((self.head[5] | 0x80, code))

    def whole(self, replies: Sequence[Message]) -> Message:
        """Return the client's reply: the only element of ``replies``, because one request was forwarded for it."""
        return replies[0]


class PreparedForwards:
    """Cache of how reads seen before are forwarded, by the ten bytes after the transaction identifier.

    Attributes:
        known: how the reads that are forwarded together are forwarded, by these bytes.
        others: these bytes of the reads that take the generic path.
        sole_target: the target of all reads in ``known``; None if there are several targets, or no reads.
        several_units: whether clients named more than one unit so far.
    """

    __slots__ = ("_first_unit", "known", "others", "several_units", "sole_target")

    def __init__(self) -> None:
        self._first_unit: int | None = None
        self.several_units: bool = False
        self.sole_target: ForwardingTarget | None = None
        self.known: dict[bytes, PreparedForward] = {}
        self.others: set[bytes] = set()

    def __contains__(self, key: bytes) -> bool:
        return key in self.known or key in self.others

    def learn(self, key: bytes, forward: PreparedForward | None) -> None:
        """Store how a read is forwarded; ``forward`` None means that it takes the generic path.

        ``key`` is the ten bytes after the transaction identifier. If 4096 reads of this kind (forwarded together,
        or not) are stored already, they are forgotten first.
        """
        if forward is None:
            if len(self.others) >= _KNOWN_LIMIT:
                self.others.clear()
            self.others.add(key)
        else:
            if len(self.known) >= _KNOWN_LIMIT:
                self.known.clear()
            unit = forward.head[_UNIT_ASKED]
            if self._first_unit is None:
                self._first_unit = unit
            elif unit != self._first_unit:
                self.several_units = True
            if not self.known:
                self.sole_target = forward.target
            elif forward.target is not self.sole_target:
                self.sole_target = None
            self.known[key] = forward


class ReadObserver(Protocol):
    """Observer of forwarded reads, such as metrics; it is called with their replies. A `RequestPipeline` is one."""

    @property
    def clock(self) -> Callable[[], float]:
        """The clock that ``began`` is measured with, in seconds."""

    def forwarded(self, client: "ClientIdentity", replies: Sequence[bytes], seconds: float) -> None:
        """Report the replies, as ADUs, to reads that arrived together; each took ``seconds``."""

    def unanswered(self, client: "ClientIdentity", requests: int) -> None:
        """Report that a client disconnected before ``requests`` of its reads were answered."""


@runtime_checkable
class ReadForwarder(Protocol):
    """Interface of a gateway's responder that can forward several reads together."""

    def prepared_forward(self, context: "RequestContext", pdu: bytes) -> PreparedForward | None:
        """Return how the read in ``pdu`` is forwarded on the fast path; None if it must take the generic path."""


@lru_cache(maxsize=64)
def _shape(count: int) -> Struct:
    """Return the `struct` layout of ``count`` consecutive reads: transaction identifier and remaining bytes of each."""
    return Struct("2s10s" * count)


class ForwardedReads:
    """The reads of one client connection that a gateway has forwarded, and their replies until they are sent.

    Attributes:
        forwards: how known reads are forwarded; the session replaces the object when rights change.
        peer: ``host:port`` of the client.
        is_priority: whether the client is a priority host.
        waiting: number of forwarded reads that are not answered yet.
        batches: the read batches that contain reads of this connection; they add and remove themselves.
    """

    __slots__ = (
        "_began",
        "_client",
        "_deliver",
        "_diagnostics",
        "_is_open",
        "_observed_by",
        "_ready",
        "_slots",
        "batches",
        "forwards",
        "is_priority",
        "peer",
        "waiting",
    )

    def __init__(
        self,
        forwards: PreparedForwards,
        *,
        client: "ClientIdentity",
        slots: "ServerTransactionSlots",
        diagnostics: "LineDiagnostics",
        deliver: DeliverTogether,
        observed_by: "ReadObserver | None" = None,
    ) -> None:
        self.forwards: PreparedForwards = forwards
        self.peer: str = client.peer
        self.is_priority: bool = client.is_priority
        self._client = client
        self._observed_by = observed_by
        self._began: dict[bytes, float] = {}  # by transaction, of the reads that wait; only with an observer
        self._slots = slots
        self._diagnostics = diagnostics
        self._deliver = deliver
        self._is_open = True
        self._ready: list[bytes] = []
        self.waiting: int = 0
        self.batches: dict[Any, None] = {}  # Any: batches are the gateway's

    def take(self, buffer: bytes | bytearray, at: int, size: int) -> int:
        """Forward consecutive reads in ``buffer``, up to the first that is incomplete or not in ``forwards.known``.

        Each takes a transaction slot until it is answered; no more are forwarded than there are free slots.

        Args:
            buffer: received bytes.
            at: offset of the first read.
            size: number of valid bytes in ``buffer``.

        Returns:
            The offset after the last read that was forwarded; ``at`` if none was.
        """
        slots = self._slots
        count = min((size - at) // READ_SIZE, slots.limit - slots.used)
        if count <= 0:
            return at
        known = self.forwards.known
        end = at + READ_SIZE * count
        if count == 1:  # quicker than the steps for several: 0.4 µs
            forward = known.get(bytes(buffer[at + 2 : end]))
            if forward is None:
                return at
            transactions: Sequence[bytes] = (bytes(buffer[at : at + 2]),)
            forwards: Sequence[PreparedForward] = (forward,)
        else:
            fields = _shape(count).unpack_from(buffer, at)
            transactions = fields[0::2]
            try:
                forwards = list(map(known.__getitem__, fields[1::2]))
            except KeyError:
                forwards = list(self._known_ones(fields[1::2]))
                count = len(forwards)
                if not count:
                    return at
                transactions = transactions[:count]
                end = at + READ_SIZE * count
        slots.used += count
        self.waiting += count
        if self._observed_by is not None:
            now = self._observed_by.clock()
            for transaction in transactions:
                self._began[transaction] = now
        if count == 1 or not self.forwards.several_units:
            self._diagnostics.arrived[forwards[0].head[_UNIT_ASKED]] += count
        else:
            self._diagnostics.arrived.update([forward.head[_UNIT_ASKED] for forward in forwards])
        target = self.forwards.sole_target
        if target is not None:
            target.ask(self, transactions, forwards)
        else:
            self._ask_each(transactions, forwards)
        return end

    def _known_ones(self, keys: Sequence[bytes]) -> Iterator[PreparedForward]:
        """Yield how each read in ``keys`` is forwarded, up to the first that is not in ``forwards.known``."""
        for key in keys:
            forward = self.forwards.known.get(key)
            if forward is None:
                return
            yield forward

    def _ask_each(self, transactions: Sequence[bytes], forwards: Sequence[PreparedForward]) -> None:
        """Forward reads whose upstream units differ: all reads for the same upstream unit together."""
        by_target: dict[ForwardingTarget, tuple[list[bytes], list[PreparedForward]]] = {}
        for transaction, forward in zip(transactions, forwards, strict=True):
            those = by_target.setdefault(forward.target, ([], []))
            those[0].append(transaction)
            those[1].append(forward)
        for target, (some, their_forwards) in by_target.items():
            target.ask(self, some, their_forwards)

    def answer(self, transactions: Sequence[bytes], forwards: Sequence[PreparedForward], data: Sequence[bytes]) -> None:
        """Answer reads with the data that their upstream unit sent; `send` transmits the replies.

        The three sequences have one element for each read, in the same order. Does nothing after `close`.
        """
        if self._is_open:
            count = len(forwards)
            self.waiting -= count
            self._slots.used -= count
            if count == 1 or not self.forwards.several_units:
                self._diagnostics.departed[forwards[0].head[_UNIT_ASKED]] += count
            else:
                self._diagnostics.departed.update([forward.head[_UNIT_ASKED] for forward in forwards])
            if count == 1:  # 0.4 µs less than the loop
                self._ready.append(transactions[0] + forwards[0].head + data[0])
            else:
                reads = zip(transactions, forwards, data, strict=True)
                self._ready += [transaction + forward.head + one for transaction, forward, one in reads]

    def reply(self, transaction: bytes, forward: PreparedForward, reply: Any) -> None:  # Any: a message with ``data``
        """Answer one read with the decoded reply of its upstream unit; `send` transmits it. Nothing after `close`."""
        self.answer((transaction,), (forward,), (reply.data,))

    def refuse(self, transaction: bytes, forward: PreparedForward, code: int) -> None:
        """Answer one read with the exception code ``code``; `send` transmits it. Does nothing after `close`."""
        if self._is_open:
            self.waiting -= 1
            self._slots.used -= 1
            self._diagnostics.of(forward.head[_UNIT_ASKED]).answered(exception=code)
            self._ready.append(transaction + forward.refusal(code))

    def send(self) -> None:
        """Transmit to the client all replies that are ready, together. After `close` they are dropped."""
        ready = self._ready
        if ready:
            self._ready = []
            if self._is_open:
                if self._observed_by is not None:
                    self._observe(ready, self._observed_by)
                self._deliver(ready)

    def _observe(self, adus: list[bytes], observer: "ReadObserver") -> None:
        began, now = self._began, observer.clock()
        if len(adus) == 1:
            observer.forwarded(self._client, adus, now - began.pop(adus[0][:2], now))
            return
        groups: dict[float, list[bytes]] = {}  # by arrival: those of one segment mostly come back together
        for adu in adus:
            groups.setdefault(began.pop(adu[:2], now), []).append(adu)
        for arrived, replies in groups.items():
            observer.forwarded(self._client, replies, now - arrived)

    def close(self) -> None:
        """Give up all unanswered reads, because the client's connection ended: they get no reply and free their slots.

        The observer and the read batches that contain them are informed.
        """
        self._is_open = False
        if self._observed_by is not None and self.waiting:
            self._observed_by.unanswered(self._client, self.waiting)
        self._slots.used -= self.waiting
        self.waiting = 0
        batches, self.batches = self.batches, {}
        for batch in batches:
            for forward in batch.owed(self):
                self._diagnostics.of(forward.head[_UNIT_ASKED]).kept_silent()
            batch.asker_gone(self)


def is_read(adu: bytes) -> bool:
    """Whether an ADU is a read of one of the four tables (functions 01 to 04)."""
    return len(adu) == READ_SIZE and 0 < adu[7] <= LAST_READ and adu[2:6] == _READ_LENGTH
