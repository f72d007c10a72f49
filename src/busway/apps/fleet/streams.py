"""The stream of a zone on NATS JetStream, into which collectors send samples and from which sinks get them.

Knows streams, subjects and consumers; the protocol is nats-py's (``busway[fleet]``). Works with nats-server 2.9.

1. Subjects are ``busway.<zone>.samples.<shard>``, with the shard of the link; one stream has them all. It drops the
   oldest messages when it is full: collectors still have the samples that not all sinks have, and send them again.
2. A sink is a durable consumer with explicit acknowledgement. An entry in the coordinator's table, its cursor, says how
   far it is; the cursor is written after the sink has accepted the samples.
3. A message that was sent and not acknowledged may be in the stream. Sent again, it has another ``Nats-Msg-Id``
   (`outbox`), and sinks replace samples with the same device, point and time.
"""

import asyncio
import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final, Protocol, runtime_checkable

from ...errors import ConfigError
from ..collector.cancellation import end_if_cancelled, end_tasks
from ..collector.sinks.interface import Sink, SinkDown, SinkRefused
from ..collector.store.committed_samples import CommittedSample
from .coordinator import (
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    Coordinator,
    CoordinatorDown,
    Entry,
    OutcomeUnknown,
    RevisionConflict,
)
from .coordinators.nats import NOT_YET, asked, refused_subject
from .coordinators.opening import until_up
from .lease_driver import keep_following
from .messages import MOST_BYTES, SampleMessage, UnreadableMessage, decode_message
from .outbox import SinkPlace, StreamDown
from .ownership_gaps import OwnershipGap
from .table_records import decode_list, integer_of

CURSORS: Final = "cursor."
MOST_HEADERS: Final = 1024
"""Bytes kept free for the header of a message, with its name: a server counts it in the length of a message."""
FETCH: Final = 64
"""Most messages that a sink asks of the stream at once."""
AUDIT_AGE: Final = 366 * 86_400.0
ACK_SECONDS: Final = 10.0
"""Seconds after which a message that a sink has not acknowledged is given to it again."""
LOOK_EVERY: Final = 5.0
"""Seconds without messages after which a sink checks whether the stream still has its consumer.

A server that has lost its disk does not answer a request for messages of a consumer that it does not know.
"""
MISSING_SECONDS: Final = 4 * ACK_SECONDS
"""Seconds for which a sink waits for a missing message, while the stream gives it later ones."""
_log = logging.getLogger("busway.fleet")


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Options of a new stream that carries samples from collectors to sinks: its size, age and number of copies.

    Attributes:
        replicas: number of servers that keep each message, 1…5.
        max_bytes: most bytes of the stream on each server; beyond them the oldest messages are dropped.
        max_age: seconds after which a message is dropped.
        duplicate_window: seconds for which the server remembers the name of a message, and drops another message with
            that name; ``max_age`` if that is shorter.
        source: JetStream domain of the edge site whose stream is copied into the new one; None for a stream that
            collectors publish to.
    """

    replicas: int = 1
    max_bytes: int = 1 << 30
    max_age: float = 86_400.0
    duplicate_window: float = 120.0
    source: str | None = None


async def make_stream(client: Any, zone: str, options: StreamOptions | None = None, *, start: float = 30.0) -> str:
    """Find or create the message stream for a zone's samples, and return its name.

    With `StreamOptions.source` the stream of the edge site is found or created first.

    Args:
        client: connected client of nats-py.
        zone: name of the zone.
        options: options for a stream that is created; a stream that exists must have at least its ``replicas``. None
            for the defaults.
        start: seconds for which a server that does not answer is asked again; 0 to ask once.

    Raises:
        ConfigError: the stream cannot be created or used, or has too few replicas.
        StreamDown: no server has answered for ``start`` seconds, or the stream cannot be used yet.
    """
    return await until_up(lambda: _made_stream(client, zone, options or StreamOptions()), StreamDown, start)


async def _made_stream(client: Any, zone: str, options: StreamOptions) -> str:
    api = import_module("nats.js.api")
    config = api.StreamConfig(
        name=f"busway-samples-{zone}",
        subjects=[f"busway.{zone}.samples.>"],
        storage=api.StorageType.FILE,
        num_replicas=options.replicas,
        max_bytes=options.max_bytes,
        max_age=options.max_age,
        discard=api.DiscardPolicy.OLD,
        duplicate_window=min(options.duplicate_window, options.max_age),
    )
    if options.source:
        await found_or_made(client, config.evolve(num_replicas=1), options.source)
        there = api.ExternalStream(api=f"$JS.{options.source}.API", deliver=None)
        config = config.evolve(subjects=None, sources=[api.StreamSource(name=config.name, external=there)])
    await found_or_made(client, config)
    return str(config.name)


async def make_audit_stream(
    client: Any, zone: str, replicas: int, *, domain: str | None = None, start: float = 30.0
) -> None:
    """Find or create the message stream for the lines of a zone's audit log.

    Args:
        client: connected client of nats-py.
        zone: name of the zone.
        replicas: number of servers that keep each message, 1…5; a stream that exists must have at least as many.
        domain: JetStream domain of the edge site that has the stream; None for the server that ``client`` is
            connected to.
        start: seconds for which a server that does not answer is asked again; 0 to ask once.

    Raises:
        ConfigError: the stream cannot be created or used, or has too few replicas.
        StreamDown: no server has answered for ``start`` seconds, or the stream cannot be used yet.
    """
    api = import_module("nats.js.api")
    config = api.StreamConfig(
        name=f"busway-audit-{zone}",
        subjects=[f"busway.{zone}.audit"],
        storage=api.StorageType.FILE,
        num_replicas=replicas,
        max_age=AUDIT_AGE,
        deny_delete=True,
    )
    await until_up(lambda: found_or_made(client, config, domain), StreamDown, start)


async def found_or_made(client: Any, config: Any, domain: str | None = None) -> Any:
    """Find or create a message stream of NATS, and return its configuration as the server has it.

    Args:
        client: connected client of nats-py.
        config: ``StreamConfig`` of nats-py. A stream with its name is used as it is if it exists; else one is created
            by this configuration.
        domain: JetStream domain of the edge site that has the stream, asked through the centre; None for the server
            that ``client`` is connected to.

    Raises:
        ConfigError: the stream cannot be created or used, or has fewer replicas than ``config`` asks for.
        StreamDown: the server does not answer, or cannot use the stream yet.
    """
    found = await _found_or_made(client, config, domain)
    if (found.num_replicas or 1) < (config.num_replicas or 1):
        raise ConfigError(
            f"the stream {config.name} has {found.num_replicas} replicas, and {config.num_replicas} are asked for: "
            f"'nats stream edit {config.name} --replicas {config.num_replicas}', or ask for fewer",
            key="replicas",
        )
    return found


async def _found_or_made(client: Any, config: Any, domain: str | None) -> Any:
    nats, errors = import_module("nats"), import_module("nats.js.errors")
    jetstream = client.jetstream(timeout=10.0, domain=domain)
    calls = f"$JS.{domain}.API.STREAM" if domain else "$JS.API.STREAM"
    try:
        try:
            looking = jetstream.stream_info(config.name)
            return (await asked(client, f"{calls}.INFO.{config.name}", looking)).config
        except errors.NotFoundError:
            request = jetstream.add_stream(config)
            return (await asked(client, f"{calls}.CREATE.{config.name}", request)).config
    except errors.APIError as error:
        if error.err_code in NOT_YET:
            raise StreamDown(f"the stream {config.name} cannot be used yet: {error.description}") from error
        if domain and isinstance(error, errors.ServiceUnavailableError):
            raise StreamDown(f"no server of site {domain} answers through the centre") from error
        raise ConfigError(f"the stream {config.name} cannot be used: {error.description}", key="coordinator") from error
    except (nats.errors.Error, OSError, TimeoutError) as error:
        if refused := refused_subject(client, f"{calls}.CREATE.{config.name}"):
            raise ConfigError(
                f"the stream {config.name} is not there yet, and the credentials do not permit to make it: an operator "
                f"makes it by busway fleet apply ({refused})",
                key="coordinator",
            ) from error
        if refused := refused_subject(client, f"{calls}.INFO.{config.name}"):
            raise ConfigError(
                f"the credentials do not permit the stream {config.name}: {refused}", key="coordinator"
            ) from error
        raise StreamDown(f"the stream {config.name} does not answer: {str(error) or type(error).__name__}") from error


class NatsStream:
    """Sends the samples of one collector into the zone's message stream, and follows how far each sink has come.

    Args:
        client: client of `connect_nats`, connected.
        zone: name of the collector's zone.
        timeout: seconds to wait for the acknowledgement of a message.
    """

    def __init__(self, client: Any, zone: str, *, timeout: float = 5.0) -> None:
        self._client, self._zone = client, zone
        self._jetstream = client.jetstream(timeout=timeout)
        self._cursors = CursorBook()
        self._again: asyncio.Event = client.again

    async def publish(self, message: SampleMessage, shard: str) -> None:
        """Send a message with samples to the stream; when this returns, the stream has the message.

        Args:
            message: the message.
            shard: name of the shard (group of links) of the message's link, the end of the subject.

        Raises:
            StreamDown: the connection is lost, or no acknowledgement came; the message may be in the stream.
        """
        nats = import_module("nats")
        self._again = self._client.again
        if not self._client.is_connected:
            raise StreamDown("the connection to the server is lost")
        try:
            await self._jetstream.publish(
                f"busway.{self._zone}.samples.{shard}", message.encode(), headers={"Nats-Msg-Id": message.name}
            )
        except (nats.errors.Error, OSError, TimeoutError) as error:
            raise StreamDown(f"the stream does not acknowledge: {str(error) or type(error).__name__}") from error

    async def connected_again(self) -> None:
        """Wait until the connection to the server is a newer one than when the last message was sent."""
        await self._again.wait()

    def most_bytes(self) -> int:
        """Return the greatest length of a message, in bytes: `MOST_BYTES`, or less if the server permits only less."""
        return min(MOST_BYTES, int(self._client.max_payload) - MOST_HEADERS)

    def places(self, collector: str, store: str) -> Mapping[str, SinkPlace]:
        """Return for each sink, by name, how far it is with the samples of a store; empty if no sink is known.

        Empty too until `watch_cursors` has read the table to its end once.

        Args:
            collector: name of the collector that has the store.
            store: the word that names the store in messages.
        """
        return self._cursors.places(collector, store)

    async def watch_cursors(self, coordinator: Coordinator) -> None:
        """Follow the positions of all sinks in the shared table until cancelled, for the answers of `places`.

        Raises:
            ConfigError: the table can never be read.
        """
        await self._cursors.watch(coordinator)


@dataclass(frozen=True, slots=True)
class SinkCursors:
    """How far one sink has come in a zone's stream, and up to which commit it has the samples of each collector.

    Attributes:
        sequence: number of the last message of the stream that the sink has taken; 0 before the first.
        commits: by ``collector/store``, number of the commit up to which the sink has all samples of that store.
        proved: by ``collector/store``, start and number (`Chain`) of the last message that proved this commit; messages
            after a missing one prove nothing (`SinkProgress`).
    """

    sequence: int
    commits: dict[str, int]
    proved: dict[str, tuple[int, int]] = field(default_factory=dict)

    def encode(self) -> bytes:
        """Return the positions of a sink as bytes for the shared table."""
        return json.dumps([self.sequence, self.commits, self.proved], separators=(",", ":")).encode()


class CursorBook:
    """The positions of all sinks of a zone in the shared table: which samples of which collector each sink has."""

    def __init__(self) -> None:
        self._cursors: dict[str, SinkCursors] = {}
        self._revisions: dict[str, int] = {}
        self._shown_again: set[str] = set()
        self._is_complete = False

    def begin_snapshot(self) -> None:
        """Prepare to receive all entries of the shared table once more.

        The first entry of each sink after this call replaces the known one, even if its revision is lower.
        """
        self._shown_again = set(self._revisions)

    def end_snapshot(self) -> None:
        """Record that all existing entries of the shared table were passed to `take`; later entries are changes.

        If the table has lost the entry of a known sink, the sink keeps its position here, but its revision becomes 0.
        """
        for sink in self._shown_again:
            del self._revisions[sink]
        self._shown_again = set()
        self._is_complete = True

    def take(self, entry: Entry) -> None:
        """Take over an entry of the shared table if it is a sink's position and newer than the known one.

        Other entries are ignored. The first entry of a sink after `begin_snapshot` need not be newer. An empty value
        removes the sink. An entry that cannot be read counts as position 0: the sink has nothing.
        """
        if not entry.key.startswith(CURSORS):
            return
        sink = entry.key[len(CURSORS) :]
        if sink not in self._shown_again and entry.revision <= self._revisions.get(sink, 0):
            return
        self._shown_again.discard(sink)
        self._revisions[sink] = entry.revision
        self._cursors.pop(sink, None)
        if entry.value:
            try:
                sequence, commits, proved = decode_list(entry.value)
                numbers = {str(name): integer_of(number) for name, number in commits.items()}
                taken = {str(name): (integer_of(start), integer_of(number)) for name, (start, number) in proved.items()}
                found = SinkCursors(integer_of(sequence), numbers, taken)
            except (ValueError, TypeError, AttributeError):
                found = SinkCursors(0, {})  # it keeps nothing, as far as can be said
            self._cursors[sink] = found

    def places(self, collector: str, store: str) -> dict[str, SinkPlace]:
        """Return for each sink, by name, how far it is with the samples of a store: commit 0 if it has none of them.

        Empty until the table has been read to its end once, so that no samples are deleted which a sink not yet seen
        still needs.

        Args:
            collector: name of the collector that has the store.
            store: the word that names the store in messages.
        """
        if not self._is_complete:
            return {}
        place = f"{collector}/{store}"
        return {
            name: SinkPlace(each.commits.get(place, 0), each.sequence, each.proved.get(place, (0, 0))[0])
            for name, each in self._cursors.items()
        }

    def of(self, sink: str) -> tuple[SinkCursors | None, int]:
        """Return the position of one sink and the revision of its table entry; None and 0 if the sink is not known.

        The revision is also 0 if the sink is known but the table has lost its entry (`end_snapshot`).
        """
        return self._cursors.get(sink), self._revisions.get(sink, 0)

    def positions(self) -> dict[str, int]:
        """Return by name of each sink the number of the last message that the sink has taken from the stream."""
        return {name: each.sequence for name, each in sorted(self._cursors.items())}

    async def watch(self, coordinator: Coordinator, told: Callable[[], None] = lambda: None) -> None:
        """Follow the positions of sinks in the shared table until cancelled.

        Args:
            coordinator: the coordinator of the zone.
            told: called in the event loop each time that all existing entries are known.

        Raises:
            ConfigError: the table can never be read.
        """

        async def follow() -> None:
            async with contextlib.aclosing(coordinator.watch(CURSORS)) as entries:
                async for entry in entries:
                    if entry is SNAPSHOT_BEGINS:
                        self.begin_snapshot()
                    elif entry is SNAPSHOT_ENDS:
                        self.end_snapshot()
                        told()
                    self.take(entry)

        await keep_following(follow, "the table of cursors", self.begin_snapshot)


@dataclass(frozen=True, slots=True)
class SinkLag:
    """How far one sink is behind the newest message of its zone's stream.

    Attributes:
        messages: number of messages in the stream that the sink has not taken.
        seconds: age of the oldest of these messages, by the clocks of the server and of this machine; 0 if the sink has
            taken all messages. None if the age is not known: the credentials do not permit reading the stream, or the
            stream has dropped the message.
    """

    messages: int
    seconds: float | None


async def sink_lags(
    client: Any, coordinator: Coordinator, zone: str, now: Callable[[], float] = time.time
) -> dict[str, SinkLag]:
    """Return by name of each sink how far the sink is behind the zone's stream; empty if the zone has no stream.

    Args:
        client: connected client of nats-py.
        coordinator: the coordinator of the zone.
        zone: name of the zone.
        now: returns the time in seconds since 1970 UTC.

    Raises:
        StreamDown: the server does not answer.
        ConfigError: the table of the coordinator can never be read.
    """
    nats, errors = import_module("nats"), import_module("nats.js.errors")
    stream = f"busway-samples-{zone}"
    try:
        info = await client.jetstream(timeout=10.0).stream_info(stream)
    except errors.NotFoundError:
        return {}
    except (nats.errors.Error, OSError, TimeoutError) as error:
        raise StreamDown(f"the stream of the zone does not answer: {str(error) or type(error).__name__}") from error
    book = CursorBook()
    async with contextlib.aclosing(coordinator.watch(CURSORS)) as entries:
        async for entry in entries:
            if entry is SNAPSHOT_ENDS:
                break
            book.take(entry)
    first, newest = int(info.state.first_seq), int(info.state.last_seq)
    times: dict[int, float | None] = {}
    found: dict[str, SinkLag] = {}
    for name, sequence in book.positions().items():
        behind, oldest = max(0, newest - sequence), max(first, sequence + 1)
        if behind and oldest not in times:
            times[oldest] = await _stored_at(client, stream, oldest)
        at = times.get(oldest)
        age = None if at is None else max(0.0, now() - at)
        found[name] = SinkLag(behind, age if behind else 0.0)
    return found


async def _stored_at(client: Any, stream: str, sequence: int) -> float | None:
    """Return when a stream has stored a message, in seconds since 1970 UTC; None if the server does not tell.

    Args:
        client: connected client of nats-py.
        stream: name of the stream.
        sequence: number of the message in the stream.
    """
    nats = import_module("nats")
    subject = f"$JS.API.STREAM.MSG.GET.{stream}"
    try:
        message = await asked(client, subject, client.jetstream(timeout=5.0).get_msg(stream, sequence))
    except (nats.errors.Error, OSError, TimeoutError):
        return None
    return None if message.time is None else float(message.time.timestamp())


class SinkProgress:
    """Computes up to which commits a sink has all samples, from the messages of the stream that the sink has taken.

    1. While no message of a sender is missing, each message proves that the sink has all samples of that sender up to
       the commit `SampleMessage.complete`. A message is missing if the sink has not taken the one that `Chain.after`
       names. The numbers of the stream do not show that: a server that ends can lose messages that it has acknowledged,
       and use their numbers again.
    2. After a missing message nothing is proved for the sender until it sends again from an earlier commit: until the
       first message of a batch whose ``complete`` is not above the commit that the sink is known to have, here or by
       `SampleMessage.kept`.
    3. When a sender has started anew, its commits count from the ``complete`` of its messages, even if its earlier
       start proved more: an older copy of its store may have been put back, and then equal commit numbers mean
       different commits.

    Args:
        cursors: the position of the sink as it was saved last; None for a new sink.
    """

    def __init__(self, cursors: SinkCursors | None) -> None:
        self._sequence = 0 if cursors is None else cursors.sequence
        self._commits = {} if cursors is None else dict(cursors.commits)
        self._proved = dict[str, tuple[int, int]]() if cursors is None else dict(cursors.proved)

    @property
    def cursors(self) -> SinkCursors:
        """The present position of the sink, to be saved in the shared table."""
        return SinkCursors(self._sequence, dict(self._commits), dict(self._proved))

    def set_newest(self, sequence: int) -> None:
        """Lower the sink's position to the newest message of the stream, if it is above that; else change nothing.

        It is above if the stream was made anew, or has lost its last messages: their numbers are used again.

        Args:
            sequence: number of the newest message in the stream.
        """
        self._sequence = min(sequence, self._sequence)

    def take(self, sequence: int, message: SampleMessage | None) -> None:
        """Count a message of the stream as taken by the sink; a message that was counted before changes nothing.

        Args:
            sequence: number of the message in the stream.
            message: the decoded message; None if it could not be decoded.
        """
        self._sequence = max(sequence, self._sequence)
        if message is None:
            return
        place, chain = f"{message.collector}/{message.store}", message.chain
        start, number = self._proved.get(place, (-1, -1))
        is_same = start == chain.start
        if is_same and number >= chain.number:
            return  # it came again
        known = self._commits.get(place, 0) if is_same else 0
        follows = is_same and number >= chain.after
        if follows or (chain.is_first and message.complete <= max(known, message.kept)):
            self._proved[place] = chain.start, chain.number
            self._commits[place] = max(known, message.complete)


@runtime_checkable
class OwnershipGapSink(Protocol):
    """Interface of a sink that takes gaps of ownership beside samples."""

    async def send_gap(self, gap: OwnershipGap) -> list[CommittedSample]:
        """Send a gap of ownership to the receiver, or return samples that the caller is to send instead of it.

        The result is empty if the gap was sent, or if there is nothing to send.

        Raises:
            SinkDown: the gap may have arrived; give it again later.
            SinkRefused: the receiver refuses the gap, and would refuse it again.
        """


class StreamSink:
    """Passes the samples in a zone's message stream on to one sink, each at least once.

    Args:
        client: connected client of nats-py.
        coordinator: the coordinator of the zone, which keeps the position of the sink.
        zone: name of the zone.
        name: name of the sink; a sink started again under its name goes on where it was in the stream.
        sink: the sink that gets the samples.
        set_aside: called with each sample that the sink refuses for good, and the reason.
        options: options for the stream, which is created if missing; None for the defaults.

    Attributes:
        taken: number of samples that the sink has accepted since the start, repetitions included.
        refused: number of samples that the sink has refused for good.
        unreadable: number of messages that could not be decoded, and were left out.
        dropped: number of messages that a full stream has dropped before this sink took them; collectors send their
            samples again.
        error: why no samples are passed on now; None while they are.
    """

    def __init__(
        self,
        client: Any,
        coordinator: Coordinator,
        zone: str,
        name: str,
        sink: Sink,
        set_aside: Callable[[CommittedSample, str], None] = lambda sample, error: None,
        options: StreamOptions | None = None,
    ) -> None:
        self.taken = self.refused = self.unreadable = self.dropped = 0
        self.error: str | None = None
        self._client, self._coordinator, self._zone, self._name = client, coordinator, zone, name
        self._sink, self._set_aside, self._options = sink, set_aside, options
        self._progress = SinkProgress(None)
        self._book = CursorBook()
        self._is_open = False
        self._missing: dict[int, float] = {}
        """By number of the first message of a gap in the numbers, since when it is missing, by `time.monotonic`."""
        self._came = set[int]()
        """Numbers of messages behind the first gap: they were given back to the stream, which delivers them again."""

    async def run(self) -> None:
        """Pass samples on to the sink until cancelled; after a failure try again every half second.

        Raises:
            ConfigError: the stream cannot be created or used, or the table of the zone can never be read.
        """
        nats = import_module("nats")
        known = asyncio.Event()
        watch = asyncio.create_task(self._book.watch(self._coordinator, known.set), name="busway fleet cursors")
        watch.add_done_callback(lambda _: known.set())
        try:
            await known.wait()
            self._progress = SinkProgress(self._book.of(self._name)[0])
            while True:
                if watch.done():
                    watch.result()
                try:
                    await self._write_cursors()  # collectors wait for this sink before any sample reaches it
                    await self._hand_on()
                except RevisionConflict:
                    self._down("its cursor was written by another process of the same name")
                except (SinkDown, StreamDown, CoordinatorDown, OutcomeUnknown) as error:
                    self._down(str(error))
                except (nats.errors.Error, OSError, TimeoutError) as error:
                    self._down(f"the stream cannot be read: {str(error) or type(error).__name__}")
                await self._sink.close()
                self._is_open = False
                await asyncio.sleep(0.5)
                end_if_cancelled()
        finally:
            await end_tasks([watch])
            await self._sink.close()

    def _down(self, error: str) -> None:
        if self.error is None:
            _log.warning("sink %s: %s; it is tried again", self._name, error)
        self.error = error

    async def _hand_on(self) -> None:
        api, errors = import_module("nats.js.api"), import_module("nats.errors")
        stream = await make_stream(self._client, self._zone, self._options, start=0.0)
        jetstream = self._client.jetstream(timeout=10.0)
        self._progress.set_newest(int((await jetstream.stream_info(stream)).state.last_seq))
        subscription = await jetstream.pull_subscribe(
            f"busway.{self._zone}.samples.>",
            durable=f"sink-{self._name}",
            stream=stream,
            config=api.ConsumerConfig(
                ack_policy=api.AckPolicy.EXPLICIT, ack_wait=ACK_SECONDS, max_ack_pending=4 * FETCH
            ),
        )
        looked = time.monotonic()
        try:
            while True:
                end_if_cancelled()
                try:
                    found = await subscription.fetch(FETCH, timeout=1.0)
                except (TimeoutError, errors.TimeoutError):
                    if time.monotonic() > looked + LOOK_EVERY:
                        looked = time.monotonic()
                        await subscription.consumer_info()  # an error if it is gone
                        self.error = None
                    continue
                await self._take(jetstream, stream, found)
                self.error = None
        finally:
            with contextlib.suppress(errors.Error, OSError, TimeoutError):
                await subscription.unsubscribe()

    async def _take(self, jetstream: Any, stream: str, found: Iterable[Any]) -> None:
        """Send messages to the sink, save its position in the shared table, then acknowledge the messages.

        If the sink or the table fails, all messages are given back to the stream, which delivers them again. Messages
        after a gap in the numbers are given back too (`_following`).

        Args:
            jetstream: JetStream context of nats-py.
            stream: name of the stream.
            found: messages of nats-py, in any order.
        """
        messages = sorted(found, key=lambda each: int(each.metadata.sequence.stream))
        ready = await self._following(jetstream, stream, messages)
        try:
            read = [(each, self._read(each)) for each in ready]
            await self._send_all([each for _, each in read if each is not None])
            for message, each in read:
                self._progress.take(message.metadata.sequence.stream, each)
            await self._write_cursors()
        except BaseException:
            await self._give_back(messages)
            raise
        for message in ready[:-1]:
            await message.ack()
        for message in ready[-1:]:  # the next fetch would bring again what the server does not know to be taken
            await message.ack_sync(timeout=5)
        await self._give_back(messages[len(ready) :])
        await self._client.flush(timeout=5)

    async def _following(self, jetstream: Any, stream: str, messages: list[Any]) -> list[Any]:
        """Return the messages that may be sent to the sink now; the caller gives the others back to the stream.

        These are the messages before the first gap in the numbers, counted from the last message that the sink has
        taken; the list can be empty. A gap at the begin is left out once its messages will not come any more: the
        stream has dropped them (counted in ``dropped``), or has not delivered them for `MISSING_SECONDS`. Then the
        messages up to the next gap are returned.

        Args:
            jetstream: JetStream context of nats-py.
            stream: name of the stream.
            messages: messages of nats-py, in the order of their numbers in the stream.
        """
        expected = self._progress.cursors.sequence + 1
        place = 0
        for message in messages:
            if int(message.metadata.sequence.stream) > expected:
                break
            expected = max(expected, int(message.metadata.sequence.stream) + 1)
            place += 1
        if place or not messages:
            return messages[:place]
        first = int((await jetstream.stream_info(stream)).state.first_seq)
        self._note_missing(expected, [int(each.metadata.sequence.stream) for each in messages])
        following = min(number for number in self._came if number > expected)
        if first > expected:
            following = min(first, following)  # what the stream still has behind those that it has dropped comes
            dropped = following - expected
            self.dropped += dropped
            _log.warning(
                "sink %s: the stream was full and has dropped %d messages that were not taken;"
                " collectors send them again",
                self._name,
                dropped,
            )
        elif time.monotonic() > self._missing[expected] + MISSING_SECONDS:
            _log.warning(
                "sink %s: the stream does not give message %d for %g s: it is left out; collectors send it again",
                self._name,
                expected,
                MISSING_SECONDS,
            )
        else:
            return []
        self._progress.take(following - 1, None)
        return await self._following(jetstream, stream, messages)

    def _note_missing(self, expected: int, numbers: list[int]) -> None:
        """Note which messages have come, and since when those before them are missing.

        Servers of a cluster can differ in which message has a number, so some may never come.

        Args:
            expected: number of the first message that is missing.
            numbers: numbers of the messages that the stream gives now, all above that.
        """
        now = time.monotonic()
        self._came = {number for number in (*self._came, *numbers) if number >= expected}
        behind = {number + 1 for number in self._came} - self._came - {max(self._came) + 1}
        self._missing = {begin: self._missing.get(begin, now) for begin in (expected, *behind)}

    async def _give_back(self, messages: Iterable[Any]) -> None:
        """Give messages back to the stream, which delivers them again after 0.2 s; errors are ignored."""
        errors = import_module("nats.errors")
        with contextlib.suppress(errors.Error, OSError, TimeoutError):
            for message in messages:
                await message.nak(delay=0.2)

    def _read(self, message: Any) -> SampleMessage | None:
        try:
            return decode_message(message.data)
        except UnreadableMessage as error:
            if not self.unreadable:
                _log.error("a message on %s is left out: %s", message.subject, error)
            self.unreadable += 1
            return None

    async def _send_all(self, messages: list[SampleMessage]) -> None:
        """Send the samples and gaps of messages to the sink in order, the samples of many messages at once.

        Samples of one device from two messages are sent together only if those of the later message have higher commit
        numbers. Of those with the same number a sink can make one document with a key, which must be the same at a
        repetition; and a sink sorts by these numbers, which of two collectors' stores mean nothing.
        """
        waiting: list[CommittedSample] = []
        newest: dict[str, int] = {}
        for each in messages:
            if each.gap is not None and isinstance(self._sink, OwnershipGapSink):
                await self._send(waiting)  # a gap begins after what was there before it
                waiting, newest = [], {}
                await self._send_gap(self._sink, each.gap, each.revision)
            if any(sample.commit <= newest.get(sample.device, 0) for sample in each.samples):
                await self._send(waiting)
                waiting, newest = [], {}
            newest |= {sample.device: sample.commit for sample in each.samples}  # the last one is the highest
            waiting.extend(sample._replace(revision=each.revision) for sample in each.samples)
        await self._send(waiting)

    async def _send_gap(self, sink: OwnershipGapSink, gap: OwnershipGap, revision: int) -> None:
        await self._open()
        try:
            await self._send([sample._replace(revision=revision) for sample in await sink.send_gap(gap)])
        except SinkRefused as error:
            _log.error("sink %s: the gap of link %s before epoch %s: %s", self._name, gap.link, gap.epoch, error)

    async def _open(self) -> None:
        if not self._is_open:
            await self._sink.open()
            self._is_open = True

    async def _send(self, samples: list[CommittedSample]) -> None:
        if not samples:
            return
        await self._open()
        try:
            await self._sink.send(samples)
            self.taken += len(samples)
        except SinkRefused as error:
            if len(samples) > 1:
                middle = len(samples) // 2
                await self._send(samples[:middle])
                await self._send(samples[middle:])
                return
            self.refused += 1
            self._set_aside(samples[0], str(error))

    async def _write_cursors(self) -> None:
        key, value = f"{CURSORS}{self._name}", self._progress.cursors.encode()
        known, revision = self._book.of(self._name)
        if revision and known is not None and known.encode() == value:
            return
        if revision:
            made = await self._coordinator.replace(key, value, revision)
        else:
            made = await self._coordinator.create(key, value)
        self._book.take(Entry(key, value, made))
