"""The outbox of a collector of a fleet: sends the samples of its store to a stream until all sinks have them.

Knows commits and cursors; `streams` knows the engine.

1. Samples are sent after their commit, in the order of commits. After each start they are sent again from the cursor
   on: the commit up to which every sink has confirmed all samples. So no sample is missing even if the stream loses all
   messages.
2. The cursor is in the manifest of the store. Retention counts the samples after the cursor that it deletes as lost;
   the log and the status say so.
3. If a sink has taken messages of the stream for `AGAIN_AFTER` seconds and its commit for this store has not
   advanced, it lacks samples: all samples after that commit are sent again. Each time without success the wait is twice
   as long. A sink that takes no messages is away: sending again would only fill the stream.
4. Each attempt to send a message has a name that the stream does not know. A stream that recognised the name would
   drop the new message, and might lose the older copy before a sink has it.
5. A stream that is full or away does not stop the collector: samples wait in the store, and the status says so. Sending
   is tried again after ever longer pauses, and at once when the connection to the server is there again. So is reading
   a store that cannot be used now; nothing is sent meanwhile.
6. The commit that a sink says it has counts only if messages of this start have proved it. If an older copy of the
   store was put back, commit numbers are used twice, and the commits that a sink has may be those of the newer copy.
7. A gap of ownership is sent before the samples of the epoch that ended it, in a message of its own, and is sent again
   whenever these samples are. So a sink that has all samples up to a commit has all gaps up to there.
8. A message is no longer than `SampleStream.most_bytes`. A sample that alone is longer is set aside: it stays in the
   store, no sink gets it, and the status counts it.
9. All samples of one link in one commit are in one message. If they are too long for one message, they begin a message
   of their own, and are cut at the same places whenever they are sent again: some sinks write all samples of a device
   in a commit as one document with a key.
10. Samples from before the wall clock was set wait until their times are corrected, as they do for a sink beside the
    store (`ClockWait`): sent before that, they would have another time when they are sent again.
"""

import asyncio
import logging
import secrets
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Final, Protocol

from ...errors import ModbusError
from ...values.counts import counted
from ..collector.sinks.delivery import ClockWait
from ..collector.store.committed_samples import CommitRange, CommitReader, CommittedSample
from ..collector.store.manifest import Manifest
from .epoch import Epoch
from .messages import Chain, SampleMessage, by_link, longest_head, longest_row
from .ownership_gaps import OwnershipGap

OUTBOX: Final = "fleet"
"""The name of the outbox's cursor in the manifest."""
MOST: Final = 20_000
"""Number of samples that are read from the store at once, roughly: always whole commits."""
IDLE: Final = 0.25
"""Seconds between two checks for new commits."""
AGAIN_AFTER: Final = 30.0
AGAIN_LIMIT: Final = 600.0
"""Longest wait in seconds before missing samples are sent again; also the wait if nothing is sent meanwhile."""
PAUSE: Final = 0.5
PAUSE_LIMIT: Final = 15.0
MOST_COUNTED: Final = 10_000
"""Most samples set aside that are remembered as counted; if there are more, some are counted again when sent again."""

_log = logging.getLogger("busway.fleet")


class StreamDown(ModbusError):
    """Error: the stream is away, full, or denies access, so a message was not acknowledged; it may have arrived."""


@dataclass(frozen=True, slots=True)
class SinkPlace:
    """How far one sink of the stream is with the samples of one store.

    Attributes:
        commit: number of the commit up to which the sink has all samples of the store; 0 if it has none.
        sequence: number in the stream of the last message that the sink has taken, from any sender.
        start: `Chain.start` of the messages that proved ``commit``; 0 if none did.
    """

    commit: int
    sequence: int
    start: int = 0


@dataclass(slots=True)
class _Waiting:
    """A sink that has less than was sent, and the wait until it counts as lacking samples (rule 3).

    Attributes:
        place: how far the sink was when the wait began.
        since: when the wait began, in seconds of the clock of the outbox.
        wait: seconds for which the sink may take messages without getting further.
        takes_since: when the sink was first seen to take messages in this wait, by the same clock; None if it has not.
    """

    place: SinkPlace
    since: float
    wait: float = AGAIN_AFTER
    takes_since: float | None = None


class SampleStream(Protocol):
    """Interface of a message stream that takes samples from collectors, and passes them on to sinks."""

    async def publish(self, message: SampleMessage, shard: str) -> None:
        """Send a message with samples to the stream; when this returns, the stream has the message.

        Args:
            message: the message.
            shard: name of the shard (group of links) of the message's link; ``none`` without a link.

        Raises:
            StreamDown: the stream has not acknowledged the message, but may have it.
        """

    async def connected_again(self) -> None:
        """Wait until the connection to the server is a newer one than when the last message was sent."""

    def most_bytes(self) -> int:
        """Return the greatest length of a message that the stream takes, in bytes."""

    def places(self, collector: str, store: str) -> Mapping[str, SinkPlace]:
        """Return for each sink, by name, how far it is with the samples of a store; empty if no sink is known.

        Args:
            collector: name of the collector that has the store.
            store: the word that names the store in messages.
        """


@dataclass(frozen=True, slots=True)
class OutboxStatus:
    """How far the sending of stored samples to the message stream has come, and what is wrong.

    Attributes:
        sent: number of the commit up to which the stream has acknowledged all samples. It goes back when samples are
            sent again.
        kept: number of the commit up to which all sinks have all samples.
        messages: number of messages acknowledged since the start.
        set_aside: number of samples since the start that no sink gets, because they are too long for a message.
        error: why no samples are sent now: the stream takes none, or the store cannot be used; None while they are.
        lost: number of samples that retention has deleted before all sinks had them; some sinks may have them.
    """

    sent: int
    kept: int
    messages: int
    set_aside: int
    error: str | None
    lost: int = 0


class Outbox:
    """Sends the samples of a collector's store to the message stream of its fleet until all sinks have them.

    A new object puts its cursor into the manifest of the store, if it is not there yet.

    Args:
        folder, manifest: folder and manifest of the store.
        stream: the message stream that gets the samples.
        collector: name of the collector in the messages.
        store: the word that names the store in the messages.
        link_of: returns the names of the links of all devices, by name of the device; called before each batch.
        shard_of: returns the name of a link's shard (group of links); called for each message with a link.
        epoch_of: returns the epoch in which a link's samples of a commit were taken; None for no epoch.
        revision_of: returns the revision of the configuration with which a commit's samples were taken.
        gaps_of: returns the gaps of ownership that belong to the commits after one number up to another; called in
            another thread.
        now: returns the time in seconds, by a clock that is never set.
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        stream: SampleStream,
        *,
        collector: str,
        store: str,
        link_of: Callable[[], Mapping[str, str]],
        shard_of: Callable[[str], str],
        epoch_of: Callable[[str, int], Epoch | None],
        revision_of: Callable[[int], int] = lambda commit: 0,
        gaps_of: Callable[[int, int], Sequence[OwnershipGap]] = lambda after, last: (),
        now: Callable[[], float],
    ) -> None:
        self._manifest, self._stream = manifest, stream
        self._collector, self._store = collector, store
        self._link_of, self._epoch_of, self._revision_of, self._now = link_of, epoch_of, revision_of, now
        self._shard_of = shard_of
        self._gaps_of = gaps_of
        self._reader = CommitReader(folder, manifest)
        self._clock = ClockWait(now)
        self._kept, self._lost = manifest.cursors().get(OUTBOX, (0, 0))
        manifest.set_cursor(OUTBOX, self._kept, self._lost)
        self._sent = self._kept
        self._told = -1
        self._waiting: dict[str, _Waiting] = {}
        self._published_at = now()
        self._messages = 0
        self._start, self._number, self._acknowledged = secrets.randbits(48), 0, 0
        self._error: str | None = None
        self._aside = 0
        self._counted: dict[tuple[str, str, int, int], None] = {}
        """The samples set aside that were counted last, as (device, point, commit, time); the values mean nothing.

        At most `MOST_COUNTED`. When such a sample is read again to be sent again, it is not counted a second time.
        """
        self._too_long: set[tuple[str, str]] = set()

    def status(self) -> OutboxStatus:
        """Return how far the sending of stored samples to the message stream has come."""
        return OutboxStatus(self._sent, self._kept, self._messages, self._aside, self._error, self._lost)

    async def run(self) -> None:
        """Send stored samples to the message stream until cancelled.

        If the stream is away or full, or the store cannot be used now, try again.
        """
        wait = PAUSE
        while True:
            try:
                more = await self.step()
            except StreamDown as error:
                self._note_error(str(error))
                wait = PAUSE if await self._is_connected_again(wait) else min(2 * wait, PAUSE_LIMIT)
                continue
            except (sqlite3.Error, OSError) as error:
                self._note_error(f"the store cannot be used now: {error}")
                await asyncio.sleep(wait)
                wait = min(2 * wait, PAUSE_LIMIT)
                continue
            if self._error is not None:
                _log.info("samples are sent again")
            self._error, wait = None, PAUSE
            if not more:
                await asyncio.sleep(IDLE)

    def _note_error(self, error: str) -> None:
        if self._error is None:
            _log.warning("samples wait in the store: %s", error)
        self._error = error

    async def _is_connected_again(self, seconds: float) -> bool:
        """Wait until the stream has a new connection to its server; return True, or False if none came in time."""
        try:
            async with asyncio.timeout(seconds):
                await self._stream.connected_again()
        except TimeoutError:
            return False
        return True

    async def step(self) -> bool:
        """Send the next batch of stored samples to the stream; return True if more samples are probably waiting.

        First the cursor is moved to the commit that all sinks have. If a sink lacks samples, the batch begins after the
        commit that this sink has. False if there was nothing to send, if the samples wait for their times to be
        corrected (rule 10), or if the batch had less than `MOST` samples.

        Raises:
            StreamDown: the stream has not acknowledged the whole batch; the next call sends it again.
            sqlite3.Error, OSError: the store cannot be used now. The next call goes on from the same commit.
        """
        await self._take_kept()
        found = await asyncio.to_thread(self._next)
        if found is None or self._clock.must_wait(found):
            await self._publish_complete()
            return False
        # A batch without samples gets a message too: a sink believes the next one only if it has seen where this began.
        gaps = await asyncio.to_thread(self._gaps_of, self._sent, found.last)
        is_first = True
        for message in self._messages_of(found.samples, gaps) or [self._message("", [])]:
            await self._publish(message, is_first=is_first)
            is_first = False
        self._sent = found.last
        return len(found.samples) >= MOST

    def _next(self) -> CommitRange | None:
        """Return the next commits to be sent; None if there are none.

        Also count and log the samples that retention has deleted since the last call. To be called in another thread
        than the event loop's, because it reads files.
        """
        self._note_lost()
        if self._clock.waits:  # to look again costs little
            found = self._reader.read(self._sent, 1)
            if found is None or self._clock.must_wait(found):
                return found
        return self._reader.read(self._sent, MOST)

    def _move(self, kept: int) -> None:
        self._note_lost()
        self._manifest.set_cursor(OUTBOX, kept, self._lost)
        self._kept = kept  # not before: what could not be saved is tried again

    def _note_lost(self) -> None:
        lost = self._manifest.cursors().get(OUTBOX, (0, 0))[1]
        if lost > self._lost:
            told = counted(lost - self._lost, "sample", "was")
            _log.warning("%s deleted before all sinks of the stream had them", told)
            self._lost = lost

    async def _publish(self, message: SampleMessage, *, is_first: bool) -> None:
        self._number += 1
        number = self._number
        chain = Chain(self._start, number, self._acknowledged, is_first)
        shard = self._shard_of(message.link) if message.link else "none"
        await self._stream.publish(replace(message, chain=chain), shard)
        self._acknowledged = number
        self._published_at = self._now()
        self._messages += 1

    async def _take_kept(self) -> None:
        """Move the cursor in the store's manifest to the commit up to which all sinks have the samples.

        If a sink lacks samples that were sent, the next batch begins after the commit that it has (rules 1 and 3).
        """
        places = {
            name: place if place.start == self._start else replace(place, commit=0)  # rule 6
            for name, place in self._stream.places(self._collector, self._store).items()
        }
        kept = min((each.commit for each in places.values()), default=0)
        if kept > self._kept:
            await asyncio.to_thread(self._move, min(kept, self._sent))
        self._waiting = {name: each for name, each in self._waiting.items() if name in places}
        lacking = {name: place.commit for name, place in places.items() if self._lacks(name, place)}
        if lacking:
            begin = max(self._kept, min(lacking.values()))
            _log.warning("%s did not get all: sent again from commit %d on", ", ".join(sorted(lacking)), begin)
            self._sent, self._told = begin, -1

    def _lacks(self, name: str, place: SinkPlace) -> bool:
        """Whether a sink lacks samples that were sent: it has not got further for the whole wait (rule 3).

        To be called at each step: each call notes how far the sink is. After True a new wait begins, twice as long.
        """
        now, waiting = self._now(), self._waiting.get(name)
        if waiting is None or place.commit > waiting.place.commit or place.commit >= self._sent:
            self._waiting[name] = _Waiting(place, now)
            return False
        if waiting.takes_since is None and place.sequence != waiting.place.sequence:  # a new stream counts from 1
            waiting.takes_since = now
        has_taken = waiting.takes_since is not None and now >= waiting.takes_since + waiting.wait
        is_idle = now >= max(waiting.since, self._published_at) + AGAIN_LIMIT
        if not has_taken and not is_idle:
            return False
        self._waiting[name] = _Waiting(place, now, min(2 * waiting.wait, AGAIN_LIMIT))
        return True

    async def _publish_complete(self) -> None:
        """Send a message without samples that says that all stored samples were sent, unless it was sent already.

        By it the positions of sinks reach the last commit.
        """
        if self._told < self._sent:
            await self._publish(self._message("", []), is_first=True)
            self._told = self._sent

    def _messages_of(self, samples: list[CommittedSample], gaps: Sequence[OwnershipGap]) -> list[SampleMessage]:
        samples_of = dict(by_link(samples, dict(self._link_of())))
        gaps_of: dict[str, list[OwnershipGap]] = {}
        for gap in gaps:
            gaps_of.setdefault(gap.link, []).append(gap)
        found: list[SampleMessage] = []
        for link in sorted({*samples_of, *gaps_of}):
            waiting = gaps_of.get(link, [])
            for epoch, rows in self._cut(link, samples_of.get(link, [])):
                while waiting and waiting[0].commit <= rows[0].commit:
                    found += self._of_gap(waiting.pop(0))
                found.append(self._message(link, rows, epoch))
            for gap in waiting:
                found += self._of_gap(gap)
        return found

    def _of_gap(self, gap: OwnershipGap) -> Iterator[SampleMessage]:
        """Yield a gap of ownership as messages that are not too long: each for some of its devices (rules 7 and 8)."""
        most = self._stream.most_bytes()
        message = replace(self._message(gap.link, [], gap.epoch), revision=self._revision_of(gap.commit))
        head, none = longest_head(self._collector, self._store, gap.link), longest_head()
        devices: list[str] = []
        length = head
        for device in gap.devices:
            added = longest_head(device) - none
            if devices and length + added > most:
                yield replace(message, gap=replace(gap, devices=tuple(devices)))
                devices, length = [], head
            devices.append(device)
            length += added
        yield replace(message, gap=replace(gap, devices=tuple(devices)))

    def _cut(self, link: str, group: list[CommittedSample]) -> Iterator[tuple[Epoch | None, list[CommittedSample]]]:
        """Yield samples of one link for one message each: of one epoch and revision, and not too long (rule 8).

        A sample that alone is too long is set aside.

        Args:
            link: name of the link.
            group: the samples, in the order of their commits.
        """
        head, most = longest_head(self._collector, self._store, link), self._stream.most_bytes()
        for epoch, rows in self._of_one_epoch(link, group):
            waiting, length, known = list[CommittedSample](), head, set[str]()
            for _, found in groupby(rows, key=lambda row: row.commit):
                commit = list(found)
                added = sum(longest_row(row, known) for row in commit)
                if length + added > most:
                    if waiting:
                        yield epoch, waiting
                    waiting, length, known = [], head, set()
                    added = sum(longest_row(row, known) for row in commit)
                if length + added > most:
                    known = set()
                    for piece in self._pieces(commit, head, most):
                        yield epoch, piece
                    continue
                waiting += commit
                length += added
            if waiting:
                yield epoch, waiting

    def _pieces(self, commit: list[CommittedSample], head: int, most: int) -> Iterator[list[CommittedSample]]:
        """Yield one link's samples of one commit, too many for one message, in pieces for one message each (rule 9).

        A sample that alone is too long is set aside.

        Args:
            commit: the samples.
            head: bytes of a message without samples.
            most: most bytes of a message.
        """
        piece, length, known = list[CommittedSample](), head, set[str]()
        for row in commit:
            alone = head + longest_row(row, set())
            if alone > most:
                self._set_aside(row, alone, most)
                continue
            added = longest_row(row, known)
            if length + added > most:
                yield piece
                piece, length, known = [], head, set()
                added = longest_row(row, known)
            piece.append(row)
            length += added
        if piece:
            yield piece

    def _of_one_epoch(
        self, link: str, group: list[CommittedSample]
    ) -> Iterator[tuple[Epoch | None, list[CommittedSample]]]:
        """Yield the samples of one link in groups of one epoch and one configuration revision, each with its epoch."""
        for (epoch, _), rows in groupby(
            group, key=lambda row: (self._epoch_of(link, row.commit), self._revision_of(row.commit))
        ):
            yield epoch, list(rows)

    def _set_aside(self, sample: CommittedSample, length: int, most: int) -> None:
        """Note that a sample is too long for a message: no sink gets it. Logged once for each point."""
        point = sample.device, sample.point
        counted = (*point, sample.commit, sample.time)
        if counted not in self._counted:
            self._aside += 1
            self._counted[counted] = None
            if len(self._counted) > MOST_COUNTED:
                del self._counted[next(iter(self._counted))]
        if point not in self._too_long:
            self._too_long.add(point)
            _log.error(
                "a sample of %s/%s has %d bytes, and a message at most %d: it stays in the store, and no sink gets it",
                *point,
                length,
                most,
            )

    def _message(self, link: str, samples: list[CommittedSample], epoch: Epoch | None = None) -> SampleMessage:
        return SampleMessage(
            self._collector,
            self._store,
            link,
            epoch,
            self._revision_of(samples[0].commit if samples else self._sent),
            self._sent,
            self._kept,
            samples,
        )
