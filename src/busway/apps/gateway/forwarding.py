"""Forwarding of requests to an upstream: batches of requests, shared reads, deadlines, and the reply to each client.

Knows upstreams, calls and the clients that wait; knows no route and no listener.

1. The requests that one client sends to one unit at once are one call, a batch: they wait for their turn as one, and
   are sent together as far as the turn allows. If the upstream takes one request at a time, each is its own batch.
2. Each request is answered as soon as its own reply is there. None waits for the others of its batch.
3. A read that is identical to one in flight shares its reply, if no write came between (`shared_reads`, `read_cache`).
   A priority host does not share a read that still waits in the queue for another client: its own read goes first.
4. When a client disconnects, those of its requests that no other client waits for are given up. A write that was sent
   goes on, and until it ends no read of its unit is shared.
5. Clients that share a read have a deadline each; the read goes on for the others.
"""

import asyncio
from collections.abc import Sequence
from itertools import chain
from typing import Any, Final

from ...client.link import AsyncLinkDriver
from ...codes import BROADCAST_UNIT
from ...errors import ModbusError, NoReply, Overloaded
from ...pdu.message import Message
from ...pdu.read_items import ReadBits, ReadRegisters
from ...session.call import RequestOutcome
from ...session.tcp_client import TcpClientSession
from .batch import Batch, ForwardedRequest, ForwardingClient, WaitingClient
from .read_cache import Key, ReadCache, ReadRange
from .shared_reads import share
from .upstream import Upstream
from .upstream_exception_codes import NO_PATH

_GOOD: Final = {bytes}
_REPLIES: Final = (ReadRegisters.Reply, ReadBits.Reply)


class ForwardTarget:
    """A unit of an upstream, as the destination of one listener's requests.

    Args:
        forwarder: the forwarder of the upstream.
        unit: unit identifier on the upstream.
        timeout: seconds to wait for a reply of the unit, per attempt; None for the upstream's own timeout.
        deadline: seconds until clients must be answered, counted from their request; None for no limit.

    Attributes:
        is_broadcast: whether requests go to all units of the upstream: the unit is 0 and the upstream takes broadcasts.
        retries: number of further attempts of a read, after the first.
    """

    __slots__ = ("deadline", "forwarder", "is_broadcast", "retries", "timeout", "unit")

    def __init__(self, forwarder: "Forwarder", unit: int, timeout: float | None, deadline: float | None) -> None:
        self.forwarder: Forwarder = forwarder
        self.unit: int = unit
        self.is_broadcast: bool = unit == BROADCAST_UNIT and forwarder.upstream.takes_broadcasts
        parameters = forwarder.upstream.settings.parameters
        self.timeout: float = timeout or parameters.timeout
        self.retries: int = parameters.retries
        self.deadline: float | None = deadline

    def ask(self, asker: ForwardingClient, tags: Sequence[Any], asked: Sequence[ForwardedRequest]) -> None:
        """Forward requests of one client to the unit, as one batch if possible; never raises for a failed request.

        The client gets each reply or exception code by its own methods, later or before this returns.

        Args:
            asker: the client.
            tags: for each request, the tag that identifies it for the client.
            asked: the requests.
        """
        forwarder = self.forwarder
        upstream = forwarder.upstream
        links = upstream.links
        link = links[0] if len(links) == 1 else upstream.link_for(asker.peer)
        if link is None or (len(tags) > 1 and not upstream.pipelines):
            self._ask_apart(link, asker, tags, asked)
            return
        shared = forwarder.cache.shared(self.unit) if forwarder.share_reads and asked[0].key else None
        twice: Sequence[tuple[Any, ForwardedRequest]] = ()
        keys: Sequence[Key] = ()
        if shared is not None:
            keys = [one.key for one in asked]
            if not shared.keys().isdisjoint(keys) or len(set(keys)) != len(keys):
                tags, asked, twice = share(asker, tags, asked, shared, self.deadline)
                keys = [one.key for one in asked]
        if tags:
            now = link.now()
            batch = Batch(self, link, asker, tags, asked, now)
            # All before it begins: it may end at once, while a connection is made anew.
            forwarder.open[batch] = None
            asker.batches[batch] = None
            if batch.is_write:
                forwarder.cache.write_begins(self.unit)
                upstream.counters.broadcasts += self.is_broadcast
            elif shared is not None:
                batch.shared = shared
                batch.keys = keys
                shared.update(dict.fromkeys(keys, batch))
            if asked[0].place is not None:
                batch.place = asked[0].place
                batch.since, batch.read_at = forwarder.cache.changes(self.unit), upstream.clock()
            try:
                link.begin(batch, now)
                upstream.counters.forwarded += len(tags)
            except ModbusError as error:
                self._not_begun(batch, asker, error)
        for tag, one in twice:  # now the first of those that are alike is in flight
            self.ask(asker, (tag,), (one,))
        if forwarder.answered:
            forwarder.send()

    def _ask_apart(
        self,
        link: AsyncLinkDriver | None,
        asker: ForwardingClient,
        tags: Sequence[Any],
        asked: Sequence[ForwardedRequest],
    ) -> None:
        """Forward requests one by one, each as its own batch; refuse all with 0A if the upstream is closed.

        ``link`` is the link that sends them; None means that the upstream is closed.
        """
        forwarder = self.forwarder
        for tag, one in zip(tags, asked, strict=True):
            if link is not None:
                self.ask(asker, (tag,), (one,))
            else:
                forwarder.upstream.counters.no_path += 1
                forwarder.refuse((asker, tag, one), NO_PATH)
        forwarder.send()

    def _not_begun(self, batch: Batch, asker: ForwardingClient, error: ModbusError) -> None:
        """Answer the requests of a batch that the link did not accept with an exception code.

        If the queue of the link has no room for all requests of the batch, they are forwarded one by one instead.

        Args:
            batch: the batch.
            asker: the client that sent it.
            error: why the link did not accept it.
        """
        forwarder = self.forwarder
        forwarder.leave(batch)
        forwarder.upstream.counters.broadcasts -= batch.is_write and self.is_broadcast
        error.with_traceback(None)  # its frames hold the one that holds it
        if isinstance(error, Overloaded) and len(batch.tags) > 1:
            self._ask_apart(batch.link, asker, batch.tags, batch.asked)
            return
        for tag, one in zip(batch.tags, batch.asked, strict=True):
            forwarder.refuse((asker, tag, one), forwarder.upstream.refused(error))


class Forwarder:
    """All unanswered requests to one upstream, and the reads that several clients share.

    Args:
        upstream: the upstream that gets the requests.
        share_reads: whether a read waits for an identical one in flight instead of being sent.
        same_device: groups of units that are the same device.

    Attributes:
        cache: the reads in flight and the remembered values.
        open: the batches that have not ended; keys only, the values are None.
        answered: clients with answers that `send` has not sent yet; keys only, the values are None.
    """

    def __init__(
        self, upstream: Upstream, *, share_reads: bool = True, same_device: Sequence[frozenset[int]] = ()
    ) -> None:
        self.upstream = upstream
        self.share_reads = share_reads
        self.cache: ReadCache[Batch] = ReadCache(upstream.register_width, same_device)
        self.open: dict[Batch, None] = {}
        self.answered: dict[ForwardingClient, None] = {}
        self._all_answered: asyncio.Event | None = None  # for all calls of `wait_until_answered`
        upstream.watch = self.answer_completed

    @property
    def open_requests(self) -> int:
        """Number of requests forwarded to this upstream that have no answer yet; a shared read counts once."""
        return sum(batch.left for batch in self.open)

    async def wait_until_answered(self) -> None:
        """Wait until no request forwarded to the upstream is without an answer; return at once if there is none."""
        if self.open:
            if self._all_answered is None or self._all_answered.is_set():
                self._all_answered = asyncio.Event()
            await self._all_answered.wait()

    def recall(self, unit: int, place: ReadRange, seconds: float) -> bytes | None:
        """Return remembered data that answer a read, as in a reply, if they are young enough; else None.

        Counts the read in ``recalled`` if they are.

        Args:
            unit: unit identifier on the upstream.
            place: the range to read: table, first address, count.
            seconds: age in seconds from which values are too old.
        """
        data = self.cache.recall(unit, place, self.upstream.clock(), for_seconds=seconds)
        self.upstream.counters.recalled += data is not None
        return data

    # What comes back.

    def answer_completed(self, session: object) -> None:
        """Answer the requests of a link's session that have an outcome by now, and send all answers that are ready.

        On Modbus TCP, requests are answered even if others of their batch have no outcome yet. Batches of other
        sessions end as a whole and are answered then; here their answers are only sent. The link calls this whenever
        calls may have ended: after received bytes, a timer, a failed attempt to connect, and when it is closed.
        """
        if isinstance(session, TcpClientSession):
            for call in session.in_work():
                if (
                    isinstance(call, Batch)
                    and call.owner is not None
                    and len(call.outcomes) - call.open != len(call.told)
                    and len(call.tags) == len(call.outcomes)
                ):
                    self.answer(call)
        if self.answered:
            self.send()

    def send(self) -> None:
        """Send the answers that are ready to the clients, those of one client together."""
        answered, self.answered = self.answered, {}
        for asker in answered:
            asker.send()

    def answer(self, batch: Batch) -> None:
        """Hand the clients the replies or exception codes of a batch's requests that have an outcome.

        `send` sends them. A batch whose requests all have an outcome is then forgotten.
        """
        asker = batch.asker
        data: list[Any] = batch.outcomes  # Any: bytes where the request has asked for them, see `as_bytes`
        if asker is not None and not (batch.told or batch.joined or batch.place):  # as a rule
            is_data = set(map(type, data)) == _GOOD
            if is_data or (len(data) == 1 and isinstance(data[0], Message)):
                self.upstream.counters.answered += len(data)
                self.leave(batch)
                if is_data:
                    asker.answer(batch.tags, batch.asked, data)
                else:
                    asker.reply(batch.tags[0], batch.asked[0], data[0])
                self.answered[asker] = None
                return
        if len(batch.tags) < len(batch.outcomes):
            self._answer_one(batch, 0, batch.outcomes)
        else:
            for position, outcome in enumerate(batch.outcomes):
                if outcome is not None and position not in batch.told:
                    self._answer_one(batch, position, (outcome,))
        if not batch.open:
            self.leave(batch)

    def _answer_one(self, batch: Batch, position: int, outcomes: Sequence[RequestOutcome | bytes | None]) -> None:
        """Answer all clients that wait for one request, whose reply or error is known; `send` sends the answers.

        Args:
            batch: the batch of the request.
            position: position of the request in the batch.
            outcomes: the outcome of the request, or of each of its parts if it was split.
        """
        batch.told = {*batch.told, position}
        if batch.shared is not None and batch.shared.get(batch.keys[position]) is batch:
            del batch.shared[batch.keys[position]]  # no other client may join it any more
        waiters = batch.waiters(position)
        error = next((one for one in outcomes if isinstance(one, ModbusError)), None)
        if error is not None:
            code = self.upstream.refused(error)
            for waiter in waiters:
                self.refuse(waiter, code)
            return
        self.upstream.counters.answered += 1
        reply = outcomes[0]
        if len(outcomes) > 1:
            reply = batch.asked[0].whole([one for one in outcomes if isinstance(one, Message)])
        if batch.place is not None and isinstance(reply, _REPLIES):
            self.cache.remember(batch.unit, batch.place, reply.data, since=batch.since, read_at=batch.read_at)
        for asker, tag, asked in waiters:
            if isinstance(reply, bytes):
                asker.answer((tag,), (asked,), (reply,))
            elif isinstance(reply, Message):
                asker.reply(tag, asked, reply)
            self.answered[asker] = None

    def refuse(self, waiter: WaitingClient, code: int) -> None:
        """Answer a forwarded request of a client with an exception code; `send` sends the answer."""
        asker, tag, asked = waiter
        asker.refuse(tag, asked, code)
        self.answered[asker] = None

    # Clients that wait no longer.

    def give_up_one(self, batch: Batch, waiter: WaitingClient | None) -> None:
        """Answer a client whose deadline has passed, for each request without an answer: 0B if it was sent, else 0A.

        The answers are sent at once. The batch is cancelled if no other client waits for it, except a write that was
        sent. Does nothing if the client has disconnected.

        Args:
            batch: the batch that the client waits for.
            waiter: the client with the read that it shares; None for the client that sent the batch, with all requests.
        """
        asker = batch.asker if waiter is None else waiter[0]
        if asker is None:
            return  # it has disconnected
        if waiter is None:
            late = [
                (at, (asker, tag, one))
                for at, (tag, one) in enumerate(zip(batch.tags, batch.asked, strict=True))
                if at not in batch.told
            ]
            batch.asker = None
        else:
            late = [(at, waiter) for at, others in batch.joined.items() if at not in batch.told and waiter in others]
            batch.joined = {at: [one for one in others if one is not waiter] for at, others in batch.joined.items()}
        for position, one in late:
            error = (
                NoReply("no answer before the deadline of the call", attempt=1)
                if batch.is_sent(position)
                else NoReply("the deadline passed in the queue; nothing was sent")
            )
            self.refuse(one, self.upstream.refused(error))
        if asker is not batch.asker and all(asker is not one[0] for others in batch.joined.values() for one in others):
            asker.batches.pop(batch, None)
        self._withdraw_if_alone(batch)
        self.send()

    def withdraw(self, batch: Batch, asker: ForwardingClient) -> None:
        """Drop the requests of a client that has disconnected; the batch is cancelled if no other client waits for it.

        A write that was sent is not cancelled.
        """
        counters = self.upstream.counters
        if batch.asker is asker:
            batch.asker = None
            counters.abandoned += batch.left
        for position, others in batch.joined.items():
            gone = sum(one[0] is asker for one in others)
            counters.abandoned += 0 if position in batch.told else gone
        batch.joined = {at: [one for one in others if one[0] is not asker] for at, others in batch.joined.items()}
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
        """Forget a batch: its requests are answered, the link did not accept it, or no client waits for it any more."""
        del self.open[batch]
        if batch.is_write:
            self.cache.write_ended(batch.unit)
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
            for asker, _, _ in chain.from_iterable(batch.joined.values()):
                asker.batches.pop(batch, None)
        batch.owner = None  # it is its own owner: else only the collector of garbage would free it
        if self._all_answered is not None and not self.open:
            self._all_answered.set()


__all__ = ["ForwardTarget", "Forwarder"]
