"""Requests on their way upstream and back: forwarded in batches, shared, withdrawn, and answered one by one.

Knows upstreams, calls and who asked; knows no route and no listener.

1. What one client asks of one unit at once is one call, a batch of one or more: it waits for its turn as one, and
   leaves together as far as the turn allows. Where the upstream takes one request at a time, each is its own batch.
2. Each request is answered as soon as its own reply is there. None waits for the others of its batch.
3. A read that is identical to one in flight shares its reply, if no write came between (`memory`). A priority host does
   not share what still waits in the queue for others: its own read goes before.
4. A client that disconnects takes those of its requests with it that no other client waits for. A write that was sent
   goes on, and until it ends nothing of its unit is shared.
5. Clients that share a read have a deadline each; the read goes on for the others.
"""

from collections.abc import Iterator, MutableMapping, Sequence
from functools import partial
from typing import Any, Final, Protocol

from ...client.link import AsyncLinkDriver
from ...errors import ModbusError, NoReply, Overloaded
from ...pdu.message import Message, Request
from ...pdu.read_items import ReadBits, ReadRegisters
from ...session.call import Call, Outcome
from ...session.client import TcpClientSession
from .answers import NO_PATH
from .memory import Key, Memory, Place
from .upstream import Upstream
from .waiters import WaiterDeadlines

FOR_EVER: Final = 86_400.0
"""Seconds that a client without a deadline waits for a read that it shares with one that has a deadline."""
_GOOD: Final = {bytes}
_REPLIES: Final = (ReadRegisters.Reply, ReadBits.Reply)


class Asked(Protocol):
    """A client's request as it is asked upstream.

    Attributes:
        requests: what is sent for it; several if it was split, and then it is asked alone.
        key: the bytes by which an identical read is recognised; empty if it must not be shared.
        place: what it reads, if its data are to be remembered; otherwise None.
    """

    # Read-only, so that any object with these attributes fits.

    @property
    def requests(self) -> tuple[Request, ...]: ...
    @property
    def key(self) -> Key: ...
    @property
    def place(self) -> Place | None: ...

    def whole(self, replies: Sequence[Message]) -> Message:
        """The reply to the request as it was before it was split."""


Ticket = tuple[Any, Asked]  # Any: what the asker finds its request by; nobody else looks at it
"""A request of an asker."""


class Asker(Protocol):
    """Who gets the answers to forwarded requests: a connection with its reads, or a single request.

    Attributes:
        peer: ``host:port`` of the client.
        is_priority: whether it is a priority host.
        batches: the batches that work for it; they add and remove themselves.
    """

    @property
    def peer(self) -> str: ...
    @property
    def is_priority(self) -> bool: ...
    @property
    def batches(self) -> dict[Any, None]: ...  # Any: see `ForwardedReads`

    def answer(self, tickets: Sequence[Any], data: Sequence[bytes]) -> None:
        """Answer reads with their data; the answers leave with `send`."""

    def reply(self, ticket: Any, reply: Message) -> None:
        """Answer a request with the reply from upstream."""

    def refuse(self, ticket: Any, code: int) -> None:
        """Answer a request with an exception code."""

    def send(self) -> None:
        """Send the answers that are ready, together."""


class Batch(Call):
    """Requests of one client, and the other clients that share some of them.

    Attributes:
        asker: the client; None when it has disconnected.
        tickets: its requests. Their positions are those of ``requests``, unless a single one was split.
        told: positions that were answered one by one; empty if all are answered together.
        joined: other clients that wait for a read, by its position.
        deadlines: of all that wait, where several do.
        keys, shared: by which its reads are found, and where, if they may be shared.
        place, since, read_at: what is remembered of a read, and which moment its value is of.
    """

    # What most batches never set is a class attribute until it is set, as in `Call`.
    deadlines: WaiterDeadlines[tuple[Asker, Ticket | None]] | None = None
    keys: Sequence[Key] = ()
    shared: MutableMapping[Key, "Batch"] | None = None
    place: Place | None = None
    since: int = 0
    read_at: float = 0.0

    def __init__(
        self,
        target: "ForwardTarget",
        link: AsyncLinkDriver,
        asker: Asker,
        tickets: Sequence[Ticket],
        deadline: float | None,
    ) -> None:
        if len(tickets) == 1:
            requests: Sequence[Request] = tickets[0][1].requests
        else:
            requests = [asked.requests[0] for _, asked in tickets]
        super().__init__(
            target.unit, requests, requests[0].is_write, target.timeout, target.retries, False, asker.peer, deadline
        )
        self.owner = self
        self.places = len(tickets)
        if asker.is_priority:
            self.is_priority = True
        self.forwarder = target.forwarder
        self.link = link
        self.asker: Asker | None = asker
        self.tickets = tickets
        self.told: set[int] = set()
        self.joined: dict[int, list[tuple[Asker, Ticket]]] = {}

    def done(self) -> bool:
        """Never: `set_result` is called once."""
        return False

    def set_result(self, result: None) -> None:
        """All outcomes are there. The link calls it, as it would complete a future."""
        self.forwarder.answer(self)

    def owed(self, asker: Asker) -> Iterator[Ticket]:
        """The requests of a client that have not been answered."""
        for position in range(len(self.tickets)):
            if position not in self.told:
                yield from (ticket for waiter, ticket in self.waiters(position) if waiter is asker)

    def asker_gone(self, asker: Asker) -> None:
        """A client has disconnected."""
        self.forwarder.withdraw(self, asker)

    def is_sent(self, position: int) -> bool:
        """Whether a request was sent."""
        return position < self.next or position in self.attempts

    @property
    def left(self) -> int:
        """How many requests have not been answered."""
        return len(self.tickets) - len(self.told)

    def waiters(self, position: int) -> list[tuple[Asker, Ticket]]:
        """The clients that wait for a request."""
        own = [] if self.asker is None else [(self.asker, self.tickets[position])]
        return own + self.joined.get(position, [])


class ForwardTarget:
    """A unit of an upstream, as one listener reaches it.

    Args:
        forwarder: of the upstream.
        unit: the unit as it is asked upstream.
        timeout: seconds to wait for the unit; None for the upstream's own timeout.
        deadline: seconds after which clients have given up; None if that is not known.
    """

    __slots__ = ("deadline", "forwarder", "retries", "timeout", "unit")

    def __init__(self, forwarder: "Forwarder", unit: int, timeout: float | None, deadline: float | None) -> None:
        self.forwarder = forwarder
        self.unit = unit
        parameters = forwarder.upstream.settings.parameters
        self.timeout = timeout or parameters.timeout
        self.retries = parameters.retries
        self.deadline = deadline

    def ask(self, asker: Asker, tickets: Sequence[Ticket]) -> None:
        """Forward requests of one client; each gets its answer, perhaps before this returns."""
        forwarder = self.forwarder
        link = forwarder.upstream.link_for(asker.peer)
        if link is None:
            forwarder.upstream.counters.no_path += len(tickets)
            for ticket in tickets:
                forwarder.refuse(asker, ticket, NO_PATH)
        elif len(tickets) == 1 or forwarder.upstream.pipelines:
            self._share_or_send(link, asker, tickets)
        else:
            for ticket in tickets:
                self._share_or_send(link, asker, (ticket,))
        if forwarder.answered:
            forwarder.send()

    def _share_or_send(self, link: AsyncLinkDriver, asker: Asker, tickets: Sequence[Ticket]) -> None:
        """Let reads wait for identical ones in flight, and send the others."""
        forwarder = self.forwarder
        keys: Sequence[Key] = ()
        shared = forwarder.memory.shared(self.unit) if forwarder.share_reads else None
        if shared is not None:
            keys = [asked.key for _, asked in tickets]
            if not shared.keys().isdisjoint(keys) or len(set(keys)) < len(keys):
                tickets, twice = self._join(shared, asker, tickets)
                if tickets:
                    self._send(link, asker, tickets, [asked.key for _, asked in tickets], shared)
                if twice:  # now the first of those that are alike is in flight
                    self._share_or_send(link, asker, twice)
                return
        self._send(link, asker, tickets, keys, shared)

    def _send(
        self,
        link: AsyncLinkDriver,
        asker: Asker,
        tickets: Sequence[Ticket],
        keys: Sequence[Key],
        shared: MutableMapping[Key, Batch] | None,
    ) -> None:
        """Hand requests to the link; refuse those that it does not take."""
        forwarder = self.forwarder
        upstream = forwarder.upstream
        now = link.now()
        batch = Batch(self, link, asker, tickets, None if self.deadline is None else now + self.deadline)
        # All before it begins: it may end at once, while a connection is made anew.
        upstream.add_open(len(tickets))
        asker.batches[batch] = None
        if batch.is_write:
            forwarder.memory.write_begins(self.unit)
        elif shared is not None and keys[0]:
            batch.shared = shared
            batch.keys = keys
            shared.update(dict.fromkeys(keys, batch))
        place = tickets[0][1].place
        if place is not None:
            batch.place, batch.since, batch.read_at = place, forwarder.memory.changes(self.unit), upstream.clock()
        try:
            link.begin(batch, now)
        except ModbusError as error:
            forwarder.leave(batch)
            error.with_traceback(None)  # its frames hold the one that holds it
            if isinstance(error, Overloaded) and len(tickets) > 1:  # some of them may have room
                for at, ticket in enumerate(tickets):
                    self._send(link, asker, (ticket,), keys[at : at + 1], shared)
                return
            for ticket in tickets:
                forwarder.refuse(asker, ticket, upstream.refused(error))
        else:
            upstream.counters.forwarded += len(tickets)

    def _join(
        self, shared: MutableMapping[Key, Batch], asker: Asker, tickets: Sequence[Ticket]
    ) -> tuple[list[Ticket], list[Ticket]]:
        """Let reads wait for others in flight; returns what has to be sent, and what is the same as one of those."""
        left: dict[Key, Ticket] = {}
        twice: list[Ticket] = []
        others: list[Ticket] = []
        for ticket in tickets:
            key = ticket[1].key
            batch = shared.get(key)
            if not key:
                others.append(ticket)
            elif batch is not None and (
                not asker.is_priority or batch.is_priority or batch.is_sent(batch.keys.index(key))
            ):
                self._join_one(batch, asker, ticket)
            elif key in left:
                twice.append(ticket)
            else:
                left[key] = ticket
        return [*left.values(), *others], twice

    def _join_one(self, batch: Batch, asker: Asker, ticket: Ticket) -> None:
        self.forwarder.upstream.counters.shared += 1
        batch.joined.setdefault(batch.keys.index(ticket[1].key), []).append((asker, ticket))
        asker.batches[batch] = None
        now, within = batch.link.now(), self.deadline
        if batch.deadlines is None:
            give_up = partial(self.forwarder.give_up_one, batch)
            batch.deadlines = WaiterDeadlines(batch.link.now, batch.link.call_at, give_up)
            if batch.deadline is not None and batch.asker is not None:
                batch.deadlines.add((batch.asker, None), batch.deadline)
        if within is not None:
            batch.deadlines.add((asker, ticket), now + within)
        if batch.deadline is not None:  # the first client may have less time than this one
            batch.deadline = max(batch.deadline, now + (FOR_EVER if within is None else within))


class Forwarder:
    """All requests to one upstream that have not been answered, and what may be shared of them.

    Args:
        upstream: where they go.
        share_reads: whether identical reads in flight are asked once.
        same_device: units that are the same device, group by group.

    Attributes:
        memory: reads in flight and remembered values.
        answered: clients with answers that have not been sent yet.
    """

    def __init__(
        self, upstream: Upstream, *, share_reads: bool = True, same_device: Sequence[frozenset[int]] = ()
    ) -> None:
        self.upstream = upstream
        self.share_reads = share_reads
        self.memory: Memory[Batch] = Memory(upstream.register_width, same_device)
        self.answered: dict[Asker, None] = {}
        upstream.watch = self.look

    def recall(self, unit: int, place: Place, seconds: float) -> bytes | None:
        """The data of a read, if they are remembered and not older than ``seconds``."""
        data = self.memory.recall(unit, place, self.upstream.clock(), for_seconds=seconds)
        self.upstream.counters.recalled += data is not None
        return data

    # What comes back.

    def look(self, session: object) -> None:
        """Bytes came or time has passed: answer what is there of batches that are not complete; send the answers."""
        if isinstance(session, TcpClientSession):
            for call in session.in_work():
                if (
                    isinstance(call, Batch)
                    and call.owner is not None
                    and len(call.outcomes) - call.open != len(call.told)
                    and len(call.tickets) == len(call.outcomes)
                ):
                    self.answer(call)
        if self.answered:
            self.send()

    def send(self) -> None:
        """Send the answers: those of one client together."""
        answered, self.answered = self.answered, {}
        for asker in answered:
            asker.send()

    def answer(self, batch: Batch) -> None:
        """Answer what has an outcome."""
        asker = batch.asker
        if not (batch.open or batch.told or batch.joined or asker is None):
            data: list[Any] = batch.outcomes  # Any: bytes where the request has asked for them, see `as_bytes`
            if set(map(type, data)) == _GOOD:
                self.upstream.counters.answered += len(data)
                self.leave(batch)
                asker.answer(batch.tickets, data)
                self.answered[asker] = None
                return
        if len(batch.tickets) < len(batch.outcomes):
            self._answer_one(batch, 0, batch.outcomes)
        else:
            for position, outcome in enumerate(batch.outcomes):
                if outcome is not None and position not in batch.told:
                    self._answer_one(batch, position, (outcome,))
        if not batch.open:
            self.leave(batch)

    def _answer_one(self, batch: Batch, position: int, outcomes: Sequence[Outcome | bytes | None]) -> None:
        """Answer all clients that wait for a request, of which all outcomes are there."""
        batch.told.add(position)
        self._left(batch, position)
        waiters = batch.waiters(position)
        error = next((one for one in outcomes if isinstance(one, ModbusError)), None)
        if error is not None:
            code = self.upstream.refused(error)
            for asker, ticket in waiters:
                self.refuse(asker, ticket, code)
            return
        self.upstream.counters.answered += 1
        reply = outcomes[0]
        if len(outcomes) > 1:
            reply = batch.tickets[0][1].whole([one for one in outcomes if isinstance(one, Message)])
        if batch.place is not None and isinstance(reply, _REPLIES):
            self.memory.remember(batch.unit, batch.place, reply.data, since=batch.since, read_at=batch.read_at)
        for asker, ticket in waiters:
            if isinstance(reply, bytes):
                asker.answer((ticket,), (reply,))
            elif isinstance(reply, Message):
                asker.reply(ticket, reply)
            self.answered[asker] = None

    def refuse(self, asker: Asker, ticket: Ticket, code: int) -> None:
        """Answer a request with an exception code."""
        asker.refuse(ticket, code)
        self.answered[asker] = None

    def _left(self, batch: Batch, position: int) -> None:
        """A single request has its answer: no other may join it any more."""
        self.upstream.add_open(-1)
        if batch.shared is not None and batch.shared.get(batch.keys[position]) is batch:
            del batch.shared[batch.keys[position]]

    # Clients that wait no longer.

    def give_up_one(self, batch: Batch, waiter: tuple[Asker, Ticket | None]) -> None:
        """The deadline of a client that shares has passed: for a read that it joined, or for all that are its own."""
        asker, ticket = waiter
        late: list[tuple[int, Ticket]] = []
        if ticket is None:
            if batch.asker is asker:
                late = [(at, one) for at, one in enumerate(batch.tickets) if at not in batch.told]
                batch.asker = None
        else:
            for position, others in batch.joined.items():
                if position not in batch.told and waiter in others:
                    others.remove((asker, ticket))
                    late = [(position, ticket)]
        for position, one in late:
            error = (
                NoReply("no answer before the deadline of the call", attempt=1)
                if batch.is_sent(position)
                else NoReply("the deadline passed in the queue; nothing was sent")
            )
            self.refuse(asker, one, self.upstream.refused(error))
        if asker is not batch.asker and all(
            asker is not other for others in batch.joined.values() for other, _ in others
        ):
            asker.batches.pop(batch, None)
        self._withdraw_if_alone(batch)
        self.send()

    def withdraw(self, batch: Batch, asker: Asker) -> None:
        """A client has disconnected: what no other waits for is taken back as far as it can be."""
        counters = self.upstream.counters
        if batch.asker is asker:
            batch.asker = None
            counters.abandoned += batch.left
        for position, others in list(batch.joined.items()):
            staying = [one for one in others if one[0] is not asker]
            counters.abandoned += 0 if position in batch.told else len(others) - len(staying)
            batch.joined[position] = staying
        self._withdraw_if_alone(batch)

    def _withdraw_if_alone(self, batch: Batch) -> None:
        batch.joined = {position: others for position, others in batch.joined.items() if others}
        if batch.asker is not None or batch.ended or not batch.joined.keys() <= batch.told:
            return
        if batch.is_write and batch.is_sent(0):
            return  # it is on the wire: no read of the unit may be shared or remembered until it has ended
        self.leave(batch)
        batch.link.give_up(batch)

    def leave(self, batch: Batch) -> None:
        """A batch has ended, or no client waits for it any more."""
        self.upstream.add_open(-batch.left)
        if batch.is_write:
            self.memory.write_ended(batch.unit)
        if batch.deadlines is not None:
            batch.deadlines.close()
            batch.deadlines = None  # its timer's callback holds the batch
        shared = batch.shared
        if shared is not None:
            for key in batch.keys:
                if shared.get(key) is batch:
                    del shared[key]
        if batch.asker is not None:
            batch.asker.batches.pop(batch, None)
        if batch.joined:
            for others in batch.joined.values():
                for asker, _ in others:
                    asker.batches.pop(batch, None)
        batch.owner = None  # it is its own owner: else only the collector of garbage would free it


__all__ = ["Asked", "Asker", "Batch", "ForwardTarget", "Forwarder", "Ticket"]
