"""Reads that are handed on: those of one connection that came together go to where they lead in one step.

Knows how a read and its answer look on TCP, and the slots of a connection; knows no line and no route.

1. A read is known by its ten bytes behind the transaction, as those that a server plans are; what they mean is asked
   of the handler once for all who have the same rights.
2. Each read takes a slot until its answer is there (Messaging on TCP/IP V1.0b §4.4.2). Where none is left, nothing is
   taken here, and the generic path says so.
3. Each read that was taken is answered once, by `answer` or `refuse`, with the unit and the transaction it was asked
   with; or it ends with the connection, and whoever works on it is told.
4. What goes this road gets the same answers, and is counted as, what goes the long one.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from operator import itemgetter
from struct import Struct
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from ..framing.mbap import HEAD
from ..pdu.message import Request

if TYPE_CHECKING:
    from .diagnostics import LineDiagnostics
    from .handler import RequestContext
    from .slots import TransactionSlots

READ_SIZE = 12
"""Bytes of a read of one of the four tables."""
_READ_LENGTH = b"\0\0\0\6"
"""Protocol and length of such a read."""
_UNIT_ASKED = 4
"""Where the unit stands in what a read is known by, and in the head of its answer."""
_UNIT_ANSWERED = 6
"""Where it stands in an ADU."""
_unit_asked, _unit_answered = itemgetter(_UNIT_ASKED), itemgetter(_UNIT_ANSWERED)
_LAST_READ = 4
"""The greatest function code among them."""
_PLAN_LIMIT = 4096
DeliverTogether = Callable[[list[bytes]], None]
"""Takes the bytes of late replies to the connection."""


class UpstreamReads(Protocol):
    """Where reads go."""

    def ask(self, asker: "ForwardedReads", reads: "list[ForwardedRead]") -> None:
        """Ask them. Each is answered by ``asker``, perhaps before this returns."""


class AskedUpstream(Protocol):
    """Something that is asked for a connection."""

    def owed(self, asker: "ForwardedReads") -> "Iterable[ForwardedRead]":
        """Reads of a client that have not been answered."""

    def asker_gone(self, asker: "ForwardedReads") -> None:
        """The client has gone: nobody waits for its reads any more."""


class ForwardPlan:
    """What becomes of one particular read.

    Args:
        way: where it goes.
        unit: as which it was asked.
        request: as it is asked behind, prepared.

    Attributes:
        way, request: as above.
        head: of its answer, what stands between the transaction and the data.
    """

    __slots__ = ("head", "request", "way")

    def __init__(self, way: UpstreamReads, unit: int, request: Request) -> None:
        self.way = way
        self.request = request
        # Behind the head come the data: the answer is as long as the reply that is expected behind.
        self.head = HEAD.pack(0, 0, 1 + request.expected_size, unit)[2:] + request.expected_prefix

    def refusal(self, code: int) -> bytes:
        """What stands behind the transaction of an exception."""
        return b"\0\0\0\3" + self.head[4:5] + bytes((self.head[5] | 0x80, code))


ForwardedRead = tuple[bytes, ForwardPlan]
"""A read that was asked: the two bytes of its transaction, and what becomes of it."""


class ForwardPlans:
    """What is known of reads, by their ten bytes behind the transaction.

    Attributes:
        known: those that are handed on.
        others: those that go the generic path.
        sole_way: the way of all that are known; None where there are several.
    """

    __slots__ = ("known", "others", "sole_way")

    def __init__(self) -> None:
        self.sole_way: UpstreamReads | None = None
        self.known: dict[bytes, ForwardPlan] = {}
        self.others: set[bytes] = set()

    def __contains__(self, key: bytes) -> bool:
        return key in self.known or key in self.others

    def learn(self, key: bytes, plan: ForwardPlan | None) -> None:
        """Keep what becomes of a read; None: it goes the generic path."""
        if plan is None:
            if len(self.others) >= _PLAN_LIMIT:
                self.others.clear()
            self.others.add(key)
        else:
            if len(self.known) >= _PLAN_LIMIT:
                self.known.clear()
            if not self.known:
                self.sole_way = plan.way
            elif plan.way is not self.sole_way:
                self.sole_way = None
            self.known[key] = plan


@runtime_checkable
class ReadForwarder(Protocol):
    """A handler that hands reads on."""

    def forward_plans(self, context: "RequestContext") -> ForwardPlans:
        """What is known for whoever has the rights of ``context``, of all units; shared by all who have the same."""

    def forward_plan(self, context: "RequestContext", pdu: bytes) -> ForwardPlan | None:
        """What becomes of a read; None where it has to go the generic path."""


@lru_cache(maxsize=64)
def _shape(count: int) -> Struct:
    """How so many reads lie: the transaction of each, and what it is known by."""
    return Struct("2s10s" * count)


class ForwardedReads:
    """The reads of one connection that are handed on.

    Attributes:
        peer: ``host:port`` of the client.
        waiting: reads whose answer is still to come.
        works: what is asked for the connection; whoever asks puts it in and takes it out.
    """

    __slots__ = (
        "_deliver",
        "_diagnostics",
        "_is_open",
        "_ready",
        "_slots",
        "peer",
        "plans",
        "waiting",
        "works",
    )

    def __init__(
        self,
        plans: ForwardPlans,
        *,
        peer: str,
        slots: "TransactionSlots",
        diagnostics: "LineDiagnostics",
        deliver: DeliverTogether,
    ) -> None:
        self.plans = plans
        self.peer = peer
        self._slots = slots
        self._diagnostics = diagnostics
        self._deliver = deliver
        self._is_open = True
        self._ready: list[bytes] = []
        self.waiting = 0
        self.works: dict[AskedUpstream, None] = {}

    def take(self, buffer: bytes | bytearray, at: int, size: int) -> int:
        """Take the reads that are known from ``at`` on, as many as there are slots; where the first other begins."""
        slots = self._slots
        count = min((size - at) // READ_SIZE, slots.limit - slots.used)
        if count <= 0:
            return at
        fields = _shape(count).unpack_from(buffer, at)
        keys = fields[1::2]
        try:
            # No step of Python for a single read: a fifth less than the plain loop in `_known_ones`.
            reads = list(zip(fields[0::2], map(self.plans.known.__getitem__, keys), strict=True))
        except KeyError:
            reads = list(self._known_ones(fields))
            count = len(reads)
            if not count:
                return at
            keys = keys[:count]
        slots.used += count
        self.waiting += count
        if count == 1:  # `Counter.update` takes 0.7 µs for one
            self._diagnostics.arrived[keys[0][_UNIT_ASKED]] += 1
        else:
            self._diagnostics.arrived.update(map(_unit_asked, keys))
        way = self.plans.sole_way
        if way is not None:
            way.ask(self, reads)
        else:
            self._ask_each(reads)
        return at + READ_SIZE * count

    def _known_ones(self, fields: tuple[bytes, ...]) -> Iterator[ForwardedRead]:
        """The reads before the first one that is not known."""
        for transaction, key in zip(fields[0::2], fields[1::2], strict=True):
            plan = self.plans.known.get(key)
            if plan is None:
                return
            yield transaction, plan

    def _ask_each(self, reads: list[ForwardedRead]) -> None:
        """Ask reads that go different ways: those of each way together."""
        by_way: dict[UpstreamReads, list[ForwardedRead]] = {}
        for read in reads:
            by_way.setdefault(read[1].way, []).append(read)
        for way, those in by_way.items():
            way.ask(self, those)

    def answer(self, reads: Sequence[ForwardedRead], data: Sequence[bytes]) -> None:
        """The data of some reads have come; what is said to the client leaves with `send`."""
        if self._is_open:
            count = len(reads)
            self.waiting -= count
            self._slots.used -= count
            adus = [transaction + plan.head + one for (transaction, plan), one in zip(reads, data, strict=True)]
            if count == 1:
                self._diagnostics.departed[adus[0][_UNIT_ANSWERED]] += 1
            else:
                self._diagnostics.departed.update(map(_unit_answered, adus))
            self._ready += adus

    def refuse(self, read: ForwardedRead, code: int) -> None:
        """A read is answered with an exception code, which leaves with `send`."""
        if self._is_open:
            self.waiting -= 1
            self._slots.used -= 1
            self._diagnostics.of(read[1].head[_UNIT_ASKED]).answered(exception=code)
            self._ready.append(read[0] + read[1].refusal(code))

    def send(self) -> None:
        """Let go what is ready: what has come together leaves together."""
        ready = self._ready
        if ready:
            self._ready = []
            if self._is_open:
                self._deliver(ready)

    def close(self) -> None:
        """The connection has ended: what still waits gets no answer, and its slots are free."""
        self._is_open = False
        self._slots.used -= self.waiting
        self.waiting = 0
        works, self.works = self.works, {}
        for work in works:
            for _, plan in work.owed(self):
                self._diagnostics.of(plan.head[_UNIT_ASKED]).kept_silent()
            work.asker_gone(self)


def is_read(adu: bytes) -> bool:
    """Whether a frame is a read of one of the four tables."""
    return len(adu) == READ_SIZE and 0 < adu[7] <= _LAST_READ and adu[2:6] == _READ_LENGTH
