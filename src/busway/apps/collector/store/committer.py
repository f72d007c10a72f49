"""The committer: a thread that writes samples, queued by an event loop, to the store several times a second.

Knows when to commit, and what to do while that fails; knows nothing of segments.

1. A sample is committed at most `INTERVAL` seconds after it was added, while the disk keeps up. Then subscribers are
   called.
2. While commits fail (a full disk), samples wait in memory, up to a limit. Beyond it the oldest are dropped and
   counted, and the next commit that succeeds records the time of the dropped samples as a gap, with their number.
   Polling never waits.
3. A second thread seals and drops parts, so that no sample waits for that.
4. Without samples there is an empty commit every `ALIVE` seconds, which shows how long the collector was running.
5. With ``durability = process`` the write-ahead log is synced at most `SYNC` seconds after the first commit that is not
   synced yet: a power failure loses the commits of at most that time. If a sync fails, that is logged, and it is tried
   again; no commit is repeated.
6. Names and descriptions of points change between two commits: samples that were added before are stored under the
   names of that time.
7. If report rules drop some samples, this is decided at the commit. Reads of which no sample is kept make no commit
   before one is due by rule 4; subscribers are called with them at once, because they show that the earlier values
   still hold.
8. Last values come from commits. `Committer.is_behind` says when they are out of date, because commits fail or hang.
"""

import logging
import math
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from ..alarms.events import AlarmEvent
from ..sample_clock import ClockCorrection
from ..samples import Gap, PointDescription, Reason, SampleBatch, StateInterval
from .kept_samples import KeptSamples, StoreRules
from .writer import Commit, StoreWriter

INTERVAL: Final = 0.2
ALIVE: Final = 5.0
SYNC: Final = 5.0
UPKEEP: Final = 10.0
"""Seconds between two searches for finished segments to seal, and for files to delete by retention."""
BEHIND: Final = 5.0
"""Seconds that samples may wait to be committed before last values count as out of date."""
RETRY: Final = 1.0
"""Seconds between two attempts at a store that cannot be written."""
AT_ONCE: Final = 50_000
"""Number of queued values from which on they are committed without waiting for the interval."""
MOST_WAITING: Final = 1_000_000
"""Most values that wait for a store that cannot be written: some 100 MB."""
MOST_INTERVALS: Final = 100_000
"""Most intervals that wait for a store that cannot be written; beyond it the older half of those that have ended is
dropped.
"""
MOST_ALARMS: Final = 10_000
"""Most alarm events that wait for a store that cannot be written; beyond it the oldest are dropped."""

_log = logging.getLogger("busway.store")


@dataclass(frozen=True, slots=True)
class StoreStatus:
    """The status of writing to a store: commits, waiting and lost samples, and what is wrong.

    Attributes:
        commits, samples: numbers of commits and of samples that were stored since the start.
        waiting: number of samples that are queued and not committed yet.
        lost: number of samples dropped since the start, before they were stored, because the store could not be
            written.
        error: why the store cannot be written; None while it can.
        upkeep_error: the last error of sealing or deleting parts, of making commits durable, or of correcting times;
            None if each of them succeeded when it was tried last.
        subscriber_failures: how often a subscriber of commits has raised an error.
        passed_over: number of samples since the start that were not stored because of a report rule.
    """

    commits: int
    samples: int
    waiting: int
    lost: int
    error: str | None
    upkeep_error: str | None
    subscriber_failures: int = 0
    passed_over: int = 0


@dataclass(slots=True)
class _Correction:
    """A correction of times that is still to be made.

    Attributes:
        clock: which times are wrong, and by how much.
        before: how many batches had been queued since the start when the correction was queued.
        others: the intervals and alarm events that were queued before the correction and are not stored yet, by `id`.
            They are kept here even if the queue drops them, so that no later object gets the same `id`.
        last: number of the last commit with times to be corrected; None while such times are still queued.
    """

    clock: ClockCorrection
    before: int
    others: dict[int, StateInterval | Gap | AlarmEvent]
    last: int | None = None


class Committer:
    """Writes samples to a store in a thread of its own, several times a second.

    `add`, `add_interval`, `add_alarms`, `describe` and `mend` only queue: they do not wait, and may be called from any
    thread.
    """

    def __init__(
        self,
        writer: StoreWriter,
        *,
        now: Callable[[], int] = time.time_ns,
        interval: float = INTERVAL,
        most_waiting: int = MOST_WAITING,
        retry: float = RETRY,
        rules: StoreRules | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start the threads that write samples to the store, and seal and delete its files.

        Args:
            writer: an open store; closed by `close`.
            now: returns the time, nanoseconds since 1970 UTC.
            interval: seconds that samples wait to be committed together.
            most_waiting: most values that wait while the store cannot be written; beyond it the oldest are dropped.
            retry: seconds between two attempts while the store cannot be written.
            rules: by device and point, report rules of points of which not every sample is kept; None to keep all.
            clock: returns seconds of the monotonic clock, for `is_behind`, for when the log is synced, and for
                `Commit.moment`.
        """
        self.writer = writer
        self._kept = KeptSamples(rules)
        self._clock = clock
        self._now, self._interval, self._most, self._retry = now, interval, most_waiting, retry
        self._subscribers: list[Callable[[Commit], None]] = []
        self._changed = threading.Condition()
        self._batches: deque[SampleBatch] = deque()
        self._intervals: list[StateInterval | Gap] = []
        self._alarms: deque[tuple[int, AlarmEvent]] = deque()
        self._descriptions: deque[tuple[int, list[PointDescription], StoreRules | None]] = deque()
        self._described = 0
        self._correction: _Correction | None = None
        self._is_mending = False
        self._untold: ClockCorrection | None = None
        self._taken = 0
        self._noted = 0
        """Number of calls since the start that queued anything but a batch: intervals, alarm events, descriptions."""
        self._stored = 0
        """Of what was queued since the start (`_queued_so_far`), how much is stored or dropped."""
        self._waiting = 0
        self._queued_since: float | None = None
        self._lost_now: Gap | None = None
        self._commits = self._samples = self._lost = 0
        self._error: str | None = None
        self._upkeep_error: str | None = None
        self._sync_error: str | None = None
        self._mend_error: str | None = None
        self._subscriber_failures = self._passed_over = 0
        self._number, self._committed_at = 0, -math.inf
        self._hurry = self._ending = self._committing = False
        self._ended = threading.Event()
        self._unsynced_since: float | None = None
        self._threads = [
            threading.Thread(target=self._commit_until_closed, name="busway-store-commits", daemon=True),
            threading.Thread(target=self._keep_up_until_closed, name="busway-store-upkeep", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def subscribe(self, told: Callable[[Commit], None]) -> None:
        """Register a function that is called with each commit after it was made, also with empty ones.

        It is called in the thread that commits, also with reads of which no sample is kept (rule 7). Its errors are
        counted in the status; the first error of all subscribers is logged.
        """
        self._subscribers.append(told)

    def add(self, batch: SampleBatch, alarms: Sequence[AlarmEvent] = ()) -> None:
        """Queue the samples of one read, and alarm events that the same commit must contain.

        If more than ``most_waiting`` values are queued, the oldest reads are dropped, and their samples counted as
        lost. Alarm events stay; if more than `MOST_ALARMS` are queued while commits fail or hang, the oldest of them
        are dropped.
        """
        with self._changed:
            self._batches.append(batch)
            self._note_queued()
            self._note_alarms(alarms)
            self._waiting += len(batch)
            if self._waiting > self._most:
                self._drop_oldest()
            if len(self._batches) == 1 or self._waiting >= AT_ONCE:
                self._changed.notify_all()

    def add_interval(self, interval: StateInterval | Gap) -> None:
        """Queue a gap, or an interval in which a device is not read.

        An interval is queued twice: when it begins, with the end None, and when it ends; a skipped round only at its
        end. If more than `MOST_INTERVALS` are queued, the older half of those that have ended is dropped, and becomes a
        gap.
        """
        with self._changed:
            self._intervals.append(interval)
            self._noted += 1
            self._note_queued()
            if len(self._intervals) > MOST_INTERVALS:
                self._drop_whole_intervals()
            self._changed.notify_all()

    def add_alarms(self, alarms: Iterable[AlarmEvent]) -> None:
        """Queue alarm events that no sample in the queue caused, such as acknowledgements; limited as by `add`."""
        with self._changed:
            self._note_alarms(alarms)
            self._noted += 1
            self._changed.notify_all()

    def describe(self, descriptions: Iterable[PointDescription], rules: StoreRules | None = None) -> None:
        """Queue new descriptions of points, and new report rules, which apply after all samples queued so far.

        Args:
            descriptions: names and units of measure of the points.
            rules: report rules by device and point; None to keep the present ones.
        """
        with self._changed:
            self._descriptions.append((self._taken + len(self._batches), list(descriptions), rules))
            self._noted += 1
            self._changed.notify_all()

    def _note_queued(self) -> None:
        """Record the time since when samples or intervals wait in the queue. Call with the lock held."""
        if self._queued_since is None:
            self._queued_since = self._clock()

    @property
    def is_behind(self) -> bool:
        """Whether samples or intervals wait for more than `BEHIND` seconds, because commits fail or hang."""
        since = self._queued_since
        return since is not None and self._clock() - since > BEHIND

    def status(self) -> StoreStatus:
        """Return the current status of writing to the store: its counts since the start, and its errors."""
        with self._changed:
            return StoreStatus(
                self._commits,
                self._samples,
                self._waiting,
                self._lost,
                self._error,
                self._upkeep_error or self._sync_error or self._mend_error,
                self._subscriber_failures,
                self._passed_over,
            )

    def flush(self, timeout: float = 10.0) -> bool:
        """Have everything queued so far committed at once, and wait for that and for a queued correction of times.

        What is queued during the wait is not waited for.

        Returns:
            True if all is committed and corrected; False if ``timeout`` seconds were not enough.
        """
        until = time.monotonic() + timeout
        with self._changed:
            queued = self._queued_so_far()
            while self._stored < queued and (self._is_due() or self._committing):
                self._hurry = True
                self._changed.notify_all()
                if not self._changed.wait(min(0.05, max(0.0, until - time.monotonic()))) and time.monotonic() >= until:
                    return False
        return True

    def _queued_so_far(self) -> int:
        """Return how much was queued since the start, stored or not. Call with the lock held."""
        return self._taken + len(self._batches) + self._noted

    def close(self, timeout: float = 10.0) -> None:
        """Commit everything that is queued, end the threads, and close the store. Errors are logged, not raised.

        What cannot be committed within ``timeout`` seconds is lost; the log says how many samples. Waits up to 30 s
        longer for each thread.
        """
        self.flush(timeout)
        with self._changed:
            if self._has_queued():
                _log.error(
                    "the store could not be written within %g s: %d samples are lost with the end of the collector",
                    timeout,
                    self._waiting,
                )
            self._ending = True
            self._changed.notify_all()
        self._ended.set()
        for thread in self._threads:
            thread.join(timeout + 30.0)
        try:
            self.writer.close(self._now())
        except (sqlite3.Error, OSError) as error:
            _log.error("the store could not be closed: %s", error)

    # Commits

    def _commit_until_closed(self) -> None:
        while self._wait_for_work():
            mended = self._mend()  # first: no right time joins wrong ones that it could be equal to
            if not self._commit_once() or not mended:
                self._ended.wait(self._retry)

    def mend(self, correction: ClockCorrection) -> None:
        """Queue a correction of all times that were given before the wall clock was right, and return at once.

        The thread that commits first stores everything that is queued with wrong times, in commits of its own, and then
        corrects the stored times. Samples, intervals and events that are added from now on must have right times.
        """
        with self._changed:
            others = {id(each): each for each in (*self._intervals, *(each for _, each in self._alarms))}
            self._correction = _Correction(correction, self._taken + len(self._batches), others)
            self._noted += 1
            self._note_corrected(self.writer.newest_commit)
            self._changed.notify_all()

    def _note_corrected(self, newest: int) -> None:
        """Once no wrong times are queued, record the newest commit as the last that has some. Call with the lock held.

        Args:
            newest: number of the newest commit.
        """
        correction = self._correction
        if correction is None or correction.last is not None or self._committing or correction.before > self._taken:
            return
        queued = (*map(id, self._intervals), *(id(each) for _, each in self._alarms))
        if correction.others.keys().isdisjoint(queued):
            correction.last = newest
            self._untold = correction.clock

    def _mend(self) -> bool:
        """Correct times in one more segment file, if a correction is queued and all wrong times are stored.

        Returns:
            False if the correction failed and must be tried again; True if it succeeded or there is nothing to do now.
        """
        with self._changed:
            correction = self._correction
            if correction is None or correction.last is None:
                return True
        try:
            if not self._is_mending:
                self.writer.roll()  # what is committed from now on has right times, some equal to wrong ones
                self.writer.begin_mending(correction.clock, correction.last)
                self._is_mending = True
            more = self.writer.mend_next()
        except Exception as error:  # as in `_commit_once`: told in the status, and tried again
            if self._mend_error is None:
                _log.exception("samples from before the clock was set cannot be mended yet")
            self._mend_error = str(error) or type(error).__name__
            return False
        self._mend_error = None
        if not more:
            _log.info("times from before the clock was right are mended, by %+.3f s", correction.clock.shift / 1e9)
            with self._changed:
                self._correction, self._is_mending = None, False
        return True

    def _wait_for_work(self) -> bool:
        """Wait until a commit is due: something has waited for the interval, or nothing was queued for `ALIVE` seconds.

        A commit is also due if the write-ahead log must be synced, and without the interval's wait if `flush` waits or
        `AT_ONCE` values are queued.

        Returns:
            True if a commit is due; False if the thread must end.
        """
        with self._changed:
            idle_until = time.monotonic() + ALIVE
            while not self._ending and not self._is_due():
                left = min(idle_until - time.monotonic(), self._seconds_to_sync())
                if left <= 0:
                    return True
                self._changed.wait(left)
            due = time.monotonic() + self._interval
            while not self._ending and not self._hurry and self._waiting < AT_ONCE:
                left = due - time.monotonic()
                if left <= 0:
                    break
                self._changed.wait(left)
            self._hurry = False
            return not self._ending

    def _is_due(self) -> bool:
        """Whether something is queued to be written, or times must be corrected. Call with the lock held."""
        return self._has_queued() or self._correction is not None

    def _has_queued(self) -> bool:
        return bool(self._batches or self._intervals or self._descriptions or self._alarms)

    def _note_alarms(self, alarms: Iterable[AlarmEvent]) -> None:
        """Queue alarm events; they are stored under the point names that hold now. Call with the lock held.

        A change of names that is queued later is written after them.
        """
        known = self._described + len(self._descriptions)
        self._alarms.extend((known, event) for event in alarms)
        if len(self._alarms) > MOST_ALARMS and self.is_behind:  # many at once are stored while commits keep up
            self._drop_oldest_alarms()

    def _next_alarms(self) -> list[tuple[int, AlarmEvent]]:
        """Remove and return the queued alarm events before the next change of point names. Call with the lock held."""
        taken = []
        while self._alarms and self._alarms[0][0] <= self._described and self._is_next(self._alarms[0][1]):
            taken.append(self._alarms.popleft())
        return taken

    def _next_intervals(self) -> list[StateInterval | Gap]:
        """Remove and return the queued intervals that the next commit may have. Call with the lock held."""
        taken = [each for each in self._intervals if self._is_next(each)]
        self._intervals = [each for each in self._intervals if not self._is_next(each)]
        return taken

    def _is_next(self, queued: StateInterval | Gap | AlarmEvent) -> bool:
        """Whether the next commit may contain ``queued``.

        While a correction is queued and wrong times are not all stored, it must have been queued before the correction.
        """
        correction = self._correction
        return correction is None or correction.last is not None or id(queued) in correction.others

    def _describe_what_is_due(self) -> None:
        """Write queued descriptions of points and report rules once all samples queued before them are stored."""
        while self._descriptions and self._descriptions[0][0] <= self._taken:
            _, descriptions, rules = self._descriptions[0]
            self.writer.describe_points(descriptions)
            self._kept.begin_anew(rules)
            with self._changed:
                self._descriptions.popleft()
                self._described += 1

    def _next_batches(self) -> list[SampleBatch]:
        """Remove and return the queued samples before the next change of point names. Call with the lock held."""
        count = len(self._batches)
        if self._descriptions:
            count = min(count, max(0, self._descriptions[0][0] - self._taken))
        if self._correction is not None and self._correction.last is None:
            count = min(count, max(0, self._correction.before - self._taken))
        self._taken += count
        return [self._batches.popleft() for _ in range(count)]

    def _commit_once(self) -> bool:
        """Write what is queued (samples, intervals, alarm events) to the store as one commit, and call the subscribers.

        Returns:
            True; False if the store could not be written, then everything is queued again.
        """
        batches: list[SampleBatch] = []
        intervals: list[StateInterval | Gap] = []
        alarms: list[tuple[int, AlarmEvent]] = []
        gap: Gap | None = None
        try:
            self._describe_what_is_due()
            with self._changed:
                batches = self._next_batches()
                intervals = self._next_intervals()
                alarms = self._next_alarms()
                gap, self._lost_now = self._lost_now, None
                queued = 0 if self._is_due() else self._queued_so_far()  # 0: this commit has only a part of it
                self._committing = True
            told = [*intervals, gap] if gap is not None else intervals
            before, began = self._number, self._clock()
            commit, passed_over = self._committed(batches, told, [event for _, event in alarms])
        except Exception as error:  # a defect must not end the thread unseen: it is in the status, and tried again
            if not isinstance(error, sqlite3.Error | OSError) and self._error is None:
                _log.exception("the store failed in an unexpected way")
            self._put_back(batches, intervals, alarms, gap, str(error) or type(error).__name__)
            return False
        if commit.number > before and self._unsynced_since is None and self.writer.options.durability == "process":
            self._unsynced_since = began
        self._sync_when_due()
        with self._changed:
            self._commits += commit.number > before
            count = sum(map(len, batches))
            self._samples += count - passed_over
            self._passed_over += passed_over
            self._waiting -= count
            if self._error is not None:
                _log.warning("the store can be written again; %d samples were lost so far", self._lost)
            self._error = None
            correction, self._untold = self._untold, None
        self._notify(commit if correction is None else replace(commit, correction=correction))
        with self._changed:  # only now: subscribers have what was committed
            self._queued_since = self._clock() if self._batches or self._intervals else None
            self._committing = False
            self._stored = max(self._stored, queued)
            if self._correction is not None:
                for stored in (*intervals, *(each for _, each in alarms)):
                    self._correction.others.pop(id(stored), None)
            self._note_corrected(commit.number)
            self._changed.notify_all()
        return True

    def _committed(
        self, batches: list[SampleBatch], told: list[StateInterval | Gap], alarms: list[AlarmEvent]
    ) -> tuple[Commit, int]:
        """Write the samples that the report rules keep, with intervals and alarm events (rule 7).

        Returns:
            The commit, and the number of samples that were not kept. If there is nothing to write, and the last commit
            was less than `ALIVE` seconds ago, nothing is written: the commit has only the reads to show, and the number
            of the commit before.
        """
        choice, now = self._kept.choose(batches, told, alarms), time.monotonic()
        is_empty = not (choice.batches or choice.counters or told or alarms)
        at, moment = self._now(), self._clock()  # together, and before the disk makes this thread wait
        if is_empty and batches and self._error is None and now - self._committed_at < ALIVE:
            return Commit(self._number, at, [], [], [], choice.shown, moment=moment), choice.passed_over
        commit = self.writer.commit(choice.batches, told, at, alarms, choice.counters)
        self._kept.committed(choice)
        self._number, self._committed_at = commit.number, now
        shown = choice.shown if choice.passed_over else None
        return replace(commit, shown=shown, moment=moment), choice.passed_over

    def _seconds_to_sync(self) -> float:
        """Return the seconds until the write-ahead log must be synced (rule 5); infinite if every commit is synced."""
        return math.inf if self._unsynced_since is None else self._unsynced_since + SYNC - self._clock()

    def _sync_when_due(self) -> None:
        if self._seconds_to_sync() > self._interval:  # else the next commit is too late
            return
        try:
            self.writer.sync()
        except OSError as error:
            if self._sync_error is None:
                _log.error("commits of the store %s cannot be made durable: %s", self.writer.folder, error)
            self._sync_error = str(error)
            self._unsynced_since = self._clock()
        else:
            self._sync_error = self._unsynced_since = None

    def _notify(self, commit: Commit) -> None:
        for subscriber in self._subscribers:
            try:
                subscriber(commit)
            except Exception:  # what subscribers raise is theirs: it is counted, and commits go on
                if not self._subscriber_failures:
                    _log.exception("a subscriber of commits failed; further failures are only counted")
                with self._changed:
                    self._subscriber_failures += 1

    def _put_back(
        self,
        batches: list[SampleBatch],
        intervals: list[StateInterval | Gap],
        alarms: list[tuple[int, AlarmEvent]],
        gap: Gap | None,
        error: str,
    ) -> None:
        with self._changed:
            self._committing = False
            self._batches.extendleft(reversed(batches))
            self._taken -= len(batches)
            self._intervals[:0] = intervals
            self._alarms.extendleft(reversed(alarms))
            self._drop_oldest_alarms()
            if gap is not None:
                self._note_loss(gap)
            if self._correction is not None and self._correction.last is None:
                self._correction.others.update((id(each), each) for each in (*intervals, *(each for _, each in alarms)))
            if self._error is None:
                _log.error("the store %s cannot be written: %s; samples wait in memory", self.writer.folder, error)
            self._error = error
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Drop the oldest queued reads beyond the limit of the queue, and record a gap. Call with the lock held."""
        while self._waiting > self._most and self._batches:
            batch = self._batches.popleft()
            self._taken += 1
            self._waiting -= len(batch)
            self._lost += len(batch)
            self._note_loss(Gap(batch.time, batch.time + 1, Reason.LOST, len(batch)))

    def _drop_oldest_alarms(self) -> None:
        """Drop the oldest queued alarm events beyond `MOST_ALARMS`. Call with the lock held."""
        while len(self._alarms) > MOST_ALARMS:
            self._alarms.popleft()

    def _drop_whole_intervals(self) -> None:
        """Drop the older half of the intervals whose begin and end are both queued, and record a gap in their place.

        Skipped rounds, which have one entry, are among them. Call with the lock held. Entries of other intervals stay,
        a few for each device: without the entry of its end an interval would last for ever in the store, and without
        the entry of its begin it would be missing for sinks.
        """
        begun = {_key_of(each) for each in self._intervals if each.end is None}
        whole = [
            each
            for each in self._intervals
            if each.end is not None and (each.reason == Reason.SKIPPED or _key_of(each) in begun)
        ]
        dropped = whole[: (len(whole) + 1) // 2]
        keys = set(map(_key_of, dropped))
        self._intervals = [each for each in self._intervals if _key_of(each) not in keys]
        for each in dropped:
            self._note_loss(Gap(each.begin, each.end or each.begin, Reason.LOST))

    def _note_loss(self, loss: Gap) -> None:
        known = self._lost_now
        if known is not None:
            loss = Gap(min(known.begin, loss.begin), max(known.end, loss.end), Reason.LOST, known.lost + loss.lost)
        self._lost_now = loss

    # Upkeep

    def _keep_up_until_closed(self) -> None:
        while not self._ended.wait(UPKEEP):
            try:
                self.writer.apply_retention(self._now())
                while self.writer.seal_closed(most=1):
                    self._upkeep_error = None  # what was wrong is over, however many segments wait
            except Exception as error:  # also what pyarrow raises: collecting goes on, and it is tried again
                if self._upkeep_error is None:
                    _log.exception("parts of the store could not be sealed or dropped")
                self._upkeep_error = str(error) or type(error).__name__
            else:
                self._upkeep_error = None


def _key_of(interval: StateInterval | Gap) -> tuple[str, int, int]:
    """Return what identifies an interval in which a device was not read: device, begin and reason.

    It is the same for the two entries of an interval, one for its begin and one for its end. The device of a gap is
    empty.
    """
    return "" if isinstance(interval, Gap) else interval.device, interval.begin, interval.reason
