"""Reads of a client that came together, on their way to a server on TCP and back as one demand.

Knows upstreams, calls and who asked; knows no route.

1. What was asked together, of one unit, is one call, a batch: it waits for its turn and leaves as one, and as many of
   its reads as the turn allows.
2. Each read is answered as soon as its own reply is there. None waits for the others of its batch.
3. A read that is identical to one in flight may share its answer, under the rules of `memory`. Reads in
   batches share among themselves; those on the generic path, because they are split or remembered, share too, and the
   two do not meet.
4. A client that goes away takes those of its reads with it that nobody else waits for.
"""

from collections.abc import Iterator, MutableMapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

from ...client.link import AsyncLinkDriver
from ...errors import ModbusError, NoReply, Overloaded
from ...pdu.message import Message
from ...pdu.read_items import ReadBits, ReadRegisters
from ...session.call import Call, Outcome
from ...session.client import TcpClientSession
from ...session.forwarding import ForwardedRead, ForwardedReads, ForwardPlan
from .answers import NO_PATH
from .memory import Key
from .waiters import WaiterDeadlines

if TYPE_CHECKING:
    from .handler import ListenerHandler
    from .upstream import Upstream

FOR_EVER = 86_400.0
"""Seconds that a client waits who has no deadline, where the one before it has one."""


class ReadTarget:
    """A unit behind an upstream, as a listener reaches it.

    Args:
        listener: whose clients ask.
        upstream: where.
        unit: the unit that is asked behind.
        timeout: seconds to wait for it; None: as the upstream does.
    """

    __slots__ = ("listener", "timeout", "unit", "upstream")

    def __init__(self, listener: "ListenerHandler", upstream: "Upstream", unit: int, timeout: float | None) -> None:
        self.listener = listener
        self.upstream = upstream
        self.unit = unit
        self.timeout = timeout or upstream.settings.parameters.timeout

    def ask(self, asker: ForwardedReads, reads: list[ForwardedRead]) -> None:
        """Ask reads of one client; each gets its answer, or an exception code."""
        self.upstream.batches.ask(self, asker, reads)


def batch_plan(way: ReadTarget, unit: int, asked: ReadRegisters | ReadBits) -> ForwardPlan:
    """What becomes of a read that is asked in batches.

    Args:
        way: where it goes.
        unit: as the client addressed it.
        asked: as it is asked behind.
    """
    request = _as_bytes(type(asked)).decode(asked.encode())
    request.prepare()
    return ForwardPlan(way, unit, request)


class ReadBatch(Call):
    """Reads of one client, and whoever shares some of them. It has the face of a future for `AsyncLinkDriver.begin`.

    Attributes:
        asker: whose they are; None when the client has gone.
        reads: what was asked, in the order of ``requests``.
        told: positions that were answered one by one; empty where all are answered together.
        joined: others who wait for a read, by its position.
        deadlines: of those who wait, where several do.
        keys: what its reads are found by, where they may be shared.
        shared: where they are found.
    """

    # What most never set is shared until it is, as in `Call`.
    deadlines: WaiterDeadlines[tuple[ForwardedReads, ForwardedRead | None]] | None = None
    keys: Sequence[Key] = ()
    shared: MutableMapping[Key, Any] | None = None  # Any: see `Memory`

    def __init__(
        self,
        batches: "ReadBatches",
        link: AsyncLinkDriver,
        way: ReadTarget,
        asker: ForwardedReads,
        reads: list[ForwardedRead],
        deadline: float | None,
    ) -> None:
        upstream = batches.upstream
        requests = [plan.request for _, plan in reads]
        super().__init__(
            way.unit, requests, False, way.timeout, upstream.settings.parameters.retries, False, asker.peer, deadline
        )
        self.owner = self
        self.places = len(reads)
        if asker.is_priority:
            self.is_priority = True
        self.batches = batches
        self.link = link
        self.asker: ForwardedReads | None = asker
        self.reads = reads
        self.told: set[int] = set()
        self.joined: dict[int, list[tuple[ForwardedReads, ForwardedRead]]] = {}

    def done(self) -> bool:
        """Never: `set_result` is called once."""
        return False

    def set_result(self, result: None) -> None:
        """All outcomes are there."""
        self.batches.tell(self)

    def owed(self, asker: ForwardedReads) -> Iterator[ForwardedRead]:
        """Reads of a client that have not been answered."""
        for position in range(len(self.reads)):
            if position not in self.told:
                yield from (read for waiter, read in self.waiters(position) if waiter is asker)

    def asker_gone(self, asker: ForwardedReads) -> None:
        """A client has gone."""
        self.batches.gone(self, asker)

    def is_sent(self, key: Key) -> bool:
        """Whether the read that is found by ``key`` was sent."""
        position = self.keys.index(key)
        return position < self.next or position in self.attempts

    @property
    def left(self) -> int:
        """How many reads have not been answered."""
        return len(self.reads) - len(self.told)

    def waiters(self, position: int) -> list[tuple[ForwardedReads, ForwardedRead]]:
        """Whoever waits for a read."""
        own = [] if self.asker is None else [(self.asker, self.reads[position])]
        return own + self.joined.get(position, [])


class ReadBatches:
    """The batches of one upstream."""

    __slots__ = ("_answered", "upstream")

    def __init__(self, upstream: "Upstream") -> None:
        self.upstream = upstream
        self._answered: dict[ForwardedReads, None] = {}  # who has answers that have not left yet

    def ask(self, way: ReadTarget, asker: ForwardedReads, reads: list[ForwardedRead]) -> None:
        """Ask reads of one client."""
        self._ask_or_share(way, asker, reads)
        if self._answered:
            self._send()

    def _ask_or_share(self, way: ReadTarget, asker: ForwardedReads, reads: list[ForwardedRead]) -> None:
        upstream = self.upstream
        link = upstream.link_for(asker.peer)
        if link is None:
            self._refuse(asker, reads, NO_PATH)
            upstream.counters.no_path += len(reads)
            return
        again: list[ForwardedRead] = []
        if upstream.share_reads:
            reads, again = self._share(way, asker, reads)
        if reads:
            self._ask(way, link, asker, reads)
        if again:
            self._ask_or_share(way, asker, again)  # now the first of those that are alike is in flight

    def _ask(self, way: ReadTarget, link: AsyncLinkDriver, asker: ForwardedReads, reads: list[ForwardedRead]) -> None:
        error = self._begin(way, link, asker, reads)
        if error is None:
            return
        if isinstance(error, Overloaded) and len(reads) > 1:  # some of them may have room
            for read in reads:
                self._ask(way, link, asker, [read])
        else:
            for read in reads:
                self._refuse(asker, [read], self.upstream.refused(error))

    def _begin(
        self, way: ReadTarget, link: AsyncLinkDriver, asker: ForwardedReads, reads: list[ForwardedRead]
    ) -> ModbusError | None:
        """Hand reads to the link; the error if they were not taken."""
        upstream = self.upstream
        now = link.now()
        within = way.listener.deadline
        batch = ReadBatch(self, link, way, asker, reads, None if within is None else now + within)
        # All before it begins: it may end at once, while a connection is made anew.
        upstream.add_open(len(reads))
        asker.works[batch] = None
        shared = upstream.memory.shared(way.unit) if upstream.share_reads else None
        if shared is not None:
            batch.shared = shared
            batch.keys = [plan.request.wire for _, plan in reads]
            shared.update(dict.fromkeys(batch.keys, batch))
        try:
            link.begin(batch, now)
        except ModbusError as error:
            self._leave(batch)
            return error.with_traceback(None)  # its frames hold the one that holds it
        upstream.counters.forwarded += len(reads)
        return None

    def _refuse(self, asker: ForwardedReads, reads: list[ForwardedRead], code: int) -> None:
        for read in reads:
            asker.refuse(read, code)
        self._answered[asker] = None

    # Sharing.

    def _share(
        self, way: ReadTarget, asker: ForwardedReads, reads: list[ForwardedRead]
    ) -> tuple[list[ForwardedRead], list[ForwardedRead]]:
        """Let reads wait for others that are in flight; what has to be asked, and what is the same as one of those."""
        shared = self.upstream.memory.shared(way.unit)
        keys = [plan.request.wire for _, plan in reads]
        if shared is None or (shared.keys().isdisjoint(keys) and len(set(keys)) == len(keys)):
            return reads, []
        left: list[ForwardedRead] = []
        again: list[ForwardedRead] = []
        asked: set[Key] = set()
        for read in reads:
            key = read[1].request.wire
            batch = shared.get(key)
            assert batch is None or isinstance(batch, ReadBatch)  # by its key
            # What waits in the queue for others is no way for a priority host: its own read goes before.
            if batch is not None and (not asker.is_priority or batch.is_priority or batch.is_sent(key)):
                self._join(batch, way, asker, read, key)
            elif key in asked:
                again.append(read)
            else:
                asked.add(key)
                left.append(read)
        return left, again

    def _join(self, batch: ReadBatch, way: ReadTarget, asker: ForwardedReads, read: ForwardedRead, key: Key) -> None:
        self.upstream.counters.shared += 1
        batch.joined.setdefault(batch.keys.index(key), []).append((asker, read))
        asker.works[batch] = None
        now, within = batch.link.now(), way.listener.deadline
        if batch.deadlines is None:
            batch.deadlines = WaiterDeadlines(batch.link.now, batch.link.call_at, partial(self._time_is_over, batch))
            if batch.deadline is not None and batch.asker is not None:
                batch.deadlines.add((batch.asker, None), batch.deadline)
        if within is not None:
            batch.deadlines.add((asker, read), now + within)
        if batch.deadline is not None:  # whoever came first may have less time than who comes now
            batch.deadline = max(batch.deadline, now + (FOR_EVER if within is None else within))

    def _time_is_over(self, batch: ReadBatch, waiter: tuple[ForwardedReads, ForwardedRead | None]) -> None:
        """One of those who share reads waits no longer: for one that he joined, or for those that are his own."""
        asker, read = waiter
        late: list[tuple[int, ForwardedRead]] = []
        if read is None:
            if batch.asker is asker:
                late = [(at, one) for at, one in enumerate(batch.reads) if at not in batch.told]
                batch.asker = None
        else:
            for position, others in batch.joined.items():
                if position not in batch.told and waiter in others:
                    others.remove(waiter)
                    late = [(position, read)]
        for position, one in late:
            is_sent = position < batch.next or position in batch.attempts
            error = (
                NoReply("no answer before the deadline of the call", attempt=1)
                if is_sent
                else NoReply("the deadline passed in the queue; nothing was sent")
            )
            asker.refuse(one, self.upstream.refused(error))
            self._answered[asker] = None
        if asker is not batch.asker and all(
            asker is not other for others in batch.joined.values() for other, _ in others
        ):
            asker.works.pop(batch, None)
        self._forget_if_alone(batch)
        self._send()

    # What comes back.

    def _send(self) -> None:
        """Let the answers go: those of one client together."""
        answered, self._answered = self._answered, {}
        for asker in answered:
            asker.send()

    def look(self, session: TcpClientSession) -> None:
        """Something has come: answer what is there of batches that are not complete."""
        for call in session.in_work():
            if (
                isinstance(call, ReadBatch)
                and call.owner is not None
                and len(call.outcomes) - call.open != len(call.told)
            ):
                self.tell(call)
        if self._answered:
            self._send()

    def tell(self, batch: ReadBatch) -> None:
        """Answer what has an outcome."""
        asker = batch.asker
        if asker is not None and not (batch.open or batch.told or batch.joined):
            data: list[Any] = batch.outcomes  # Any: bytes, see `_as_bytes`
            if set(map(type, data)) == _GOOD:
                self.upstream.counters.answered += len(data)
                self._leave(batch)
                asker.answer(batch.reads, data)
                self._answered[asker] = None
                return
        for position, outcome in enumerate(batch.outcomes):
            if outcome is not None and position not in batch.told:
                self._tell_one(batch, position, outcome)
        if not batch.open:
            self._leave(batch)

    def _tell_one(self, batch: ReadBatch, position: int, outcome: Outcome | bytes) -> None:
        batch.told.add(position)
        self._left(batch, position)
        waiters = batch.waiters(position)
        if isinstance(outcome, Message):  # it did not come in its turn
            assert isinstance(outcome, _REPLIES)  # the session has seen that it answers a read
            outcome = outcome.data
        if isinstance(outcome, bytes):
            self.upstream.counters.answered += 1
            for asker, read in waiters:
                asker.answer((read,), (outcome,))
                self._answered[asker] = None
        else:
            code = self.upstream.refused(outcome)
            for asker, read in waiters:
                asker.refuse(read, code)
                self._answered[asker] = None

    def gone(self, batch: ReadBatch, asker: ForwardedReads) -> None:
        """A client has gone: what nobody else waits for is taken back as far as it can be."""
        counters = self.upstream.counters
        if batch.asker is asker:
            batch.asker = None
            counters.abandoned += batch.left
        for position, others in list(batch.joined.items()):
            staying = [one for one in others if one[0] is not asker]
            counters.abandoned += 0 if position in batch.told else len(others) - len(staying)
            batch.joined[position] = staying
        self._forget_if_alone(batch)

    def _forget_if_alone(self, batch: ReadBatch) -> None:
        """Take a batch back for which nobody waits any more, as far as it can be."""
        batch.joined = {position: others for position, others in batch.joined.items() if others}
        if batch.asker is None and not batch.ended and batch.joined.keys() <= batch.told:
            self._leave(batch)
            batch.link.give_up(batch)

    def _leave(self, batch: ReadBatch) -> None:
        """Nobody waits for a batch any more."""
        self.upstream.add_open(-batch.left)
        if batch.deadlines is not None:
            batch.deadlines.close()
            batch.deadlines = None  # its timer's callback holds the batch
        shared = batch.shared
        if shared is not None:
            for key in batch.keys:
                if shared.get(key) is batch:
                    del shared[key]
        if batch.asker is not None:
            batch.asker.works.pop(batch, None)
        if batch.joined:
            for others in batch.joined.values():
                for asker, _ in others:
                    asker.works.pop(batch, None)
        batch.owner = None  # it is its own owner: else only the collector of garbage would free it

    def _left(self, batch: ReadBatch, position: int) -> None:
        """A single read has its answer."""
        self.upstream.add_open(-1)
        if batch.keys:
            self.upstream.memory.read_ended(batch.unit, batch.keys[position], batch)  # nobody may join it any more


@lru_cache(maxsize=32)
def _as_bytes(kind: type[ReadRegisters] | type[ReadBits]) -> Any:  # Any: a class of the same kind
    """The same read, whose reply is its data as it came: a message around it would be taken off again (0.4 µs)."""
    return type(kind.__name__, (kind,), {"take": staticmethod(bytes), "__doc__": kind.__doc__})


_GOOD = {bytes}
_REPLIES = (ReadRegisters.Reply, ReadBits.Reply)
