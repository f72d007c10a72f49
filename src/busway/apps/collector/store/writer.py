"""The writer of a store: writes one commit after the other into the open segment, and begins a new one when it ends.

Knows the order of steps that keeps a store consistent; knows no thread and no clock. Times come as arguments.

1. A point is in the manifest before its first sample is in a segment.
2. A commit has a number greater than those of all commits before. Only what `StoreWriter.commit` has returned may be
   shown or sent: it is in the store.
3. A commit that fails (a full disk) is undone as a whole. The caller keeps its batches and tries again; for samples
   that it must drop meanwhile it adds a `Gap` with their number.
4. `Segment.has_ended` decides when a segment ends: when its ten minutes of the clock are over, at ``segment_size``
   bytes (256 MB by default), or when a reader keeps its log from shrinking. Another thread can seal it then.
5. A start that finds commits of an earlier run records the time between as a `Gap`, and ends intervals left open
   (`recovery`).
"""

import logging
import sqlite3
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, Self

from ....errors import ConfigError
from ..alarms.events import AlarmEvent
from ..sample_clock import EARLIEST, ClockCorrection
from ..samples import CounterState, Gap, PointDescription, PointGroup, Reason, SampleBatch, StateInterval
from .alarm_events import forget_old_alarms
from .clock_correction import EVERY, CommitCorrection, mend_segment
from .database import name_if_damaged, open_database
from .folder import SEGMENTS, StoreLock, make_folder, sync_folder
from .manifest import IntervalRow, Manifest, StorePart
from .recovery import close_open_segments, close_segment, intervals_since_end
from .retention import Retention, parts_to_drop
from .sealing import StepDone, can_seal, remove_unfinished, remove_unlisted, seal
from .segment import Segment, alarms_of, facts_of, intervals_of, open_for_reading

EVER: Final = 2**63 - 1
SEGMENT_SIZE: Final = 256 * 1024 * 1024

_log = logging.getLogger("busway.store")

Durability = Literal["process", "power"]


@dataclass(frozen=True, slots=True)
class StoreOptions:
    """Options of writing a store: durability, retention, when a segment ends, and sealing.

    Attributes:
        durability: ``process``: commits survive the end of the process, but a power failure loses those of the last
            seconds (`SYNC` of `committer`). ``power``: commits survive a power failure too, because each waits for
            the disk.
        retention: how long and how much is kept.
        segment_size: bytes after which a segment ends.
        seals: whether finished segments become Parquet files, if the packages for that are installed (`can_seal`).
    """

    durability: Durability = "process"
    retention: Retention = field(default_factory=Retention)
    segment_size: int = SEGMENT_SIZE
    seals: bool = True


@dataclass(frozen=True, slots=True)
class Commit:
    """A commit: the samples, intervals and alarms that became part of a store together, under one number.

    Attributes:
        number: greater than that of every commit before. If the report rules keep no sample of some reads, nothing is
            committed: the object has only these reads in ``shown``, and the number of the commit before, or 0.
        at: time of the commit, nanoseconds since 1970 UTC.
        batches: the samples that were stored.
        intervals: intervals and gaps.
        alarms: alarm events.
        shown: all reads since the commit before, to show last values; None if ``batches`` has them all. A sample that
            the report rules do not keep has the last kept value of its point in place of its own.
        correction: a correction of times that holds for all commits since the start and before this one; None for none.
        moment: the time ``at`` in seconds of the monotonic clock. It was read before the store was written, so that the
            age of a read is right however long the disk takes, and even if the wall clock is set.
    """

    number: int
    at: int
    batches: Sequence[SampleBatch]
    intervals: Sequence[StateInterval | Gap]
    alarms: Sequence[AlarmEvent] = ()
    shown: Sequence[SampleBatch] | None = None
    correction: ClockCorrection | None = None
    moment: float = 0.0

    @property
    def last_values(self) -> Sequence[SampleBatch]:
        """The reads from which last values are shown: ``shown``, or ``batches`` if every sample was kept."""
        return self.batches if self.shown is None else self.shown


def no_step(name: str) -> None:
    """Do nothing. This is the default of ``step``, which is called after each step of a write; tests give another."""


class StoreWriter:
    """Writes a store: commits samples, ends and seals segments, and deletes old files.

    Most methods are for one thread, that of `commit`. `seal_closed` and `apply_retention` may run in one other thread.

    Attributes:
        folder: the folder of the store.
        options: the options of writing.
        manifest: the manifest of the store.
    """

    def __init__(
        self,
        folder: Path | str,
        options: StoreOptions | None = None,
        *,
        now: int,
        clock_is_right: bool = True,
        step: StepDone = no_step,
    ) -> None:
        """Open a store for writing, and create it if there is none.

        What an earlier process left unfinished is closed, and the time since its end is committed as a gap.

        Args:
            folder: the folder of the store.
            options: the options of writing; None for the defaults.
            now: the present time, nanoseconds since 1970 UTC.
            clock_is_right: whether ``now`` is known to be right; if not, times may be corrected later.
            step: called with the name of each step, for tests that end the process there.

        Raises:
            ConfigError: another process writes the store (the message has its number), or the store cannot be opened.
        """
        self.folder: Path = Path(folder)
        self.options: StoreOptions = options or StoreOptions()
        self._step = step
        make_folder(self.folder)
        self._segment: Segment | None = None
        self._part: StorePart | None = None
        self._begun = 0
        self._journal_grew = True
        self._files = threading.Lock()
        self._groups: weakref.WeakKeyDictionary[PointGroup, tuple[int, ...]] = weakref.WeakKeyDictionary()
        self._lock = StoreLock(self.folder)
        try:
            with ExitStack() as unless_open:
                unless_open.callback(self._lock.release)
                self.manifest: Manifest = Manifest(self.folder, writes=True)
                unless_open.callback(self.manifest.close)
                unless_open.callback(self._forget_segment)
                remove_unfinished(self.folder, self.manifest)
                remove_unlisted(self.folder, self.manifest)
                self._next, self._behind = self.manifest.reserve_numbers()
                self._first = self._next
                self._recover(now)
                self._awaits_clock = now < EARLIEST or not clock_is_right
                self.manifest.set_fact("awaits_clock", self._first if self._awaits_clock else None)
                unless_open.pop_all()
        except (sqlite3.Error, OSError) as error:
            raise ConfigError(f"the store cannot be written: {error}", file=str(self.folder)) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        with ExitStack() as opened:  # each is closed, whatever the others raise
            opened.callback(self._lock.release)
            opened.callback(self.manifest.close)
            opened.callback(self._close_segment)

    def close(self, now: int) -> None:
        """Record in the store that it was closed on purpose, close all files, and release the lock.

        Args:
            now: the present time, nanoseconds since 1970 UTC.

        Raises:
            sqlite3.Error, OSError: the manifest or the segment could not be written; all files are closed nevertheless.
        """
        try:
            self.manifest.set_fact("ended", now)
        finally:
            self.__exit__()

    # Start

    def _recover(self, now: int) -> None:
        """Finish what an earlier process left unfinished, and record the time since its end as a gap."""
        close_open_segments(self.folder, self.manifest)
        while self.manifest.fact("mend_from") is not None:
            self.mend_next()
        self.manifest.begin_maintenance_again(EARLIEST, now)
        self.commit([], intervals_since_end(self.folder, self.manifest, now), now)
        self.manifest.set_fact("ended", None)

    # Commits

    def describe_points(self, descriptions: Iterable[PointDescription]) -> None:
        """Store descriptions of points; a point with a new name keeps its history. Call in the thread of `commit`."""
        self.manifest.describe_points(descriptions, self._next - 1)
        self._groups.clear()

    def commit(
        self,
        batches: Sequence[SampleBatch],
        intervals: Sequence[StateInterval | Gap],
        now: int,
        alarms: Sequence[AlarmEvent] = (),
        counters: Mapping[tuple[str, str], CounterState] | None = None,
    ) -> Commit:
        """Write samples, intervals and alarms as one commit, and return it.

        Args:
            batches: samples, of any devices and times.
            intervals: intervals that began or ended, and gaps.
            now: time of the commit, nanoseconds since 1970 UTC.
            alarms: alarm events.
            counters: by device and point, states of accumulators that are in no batch.

        Raises:
            sqlite3.Error, OSError: nothing of the commit was stored (a full disk). The caller can try again with the
                same arguments; the commit then gets another number.
        """
        keyed = [(self._ids(batch), batch) for batch in batches]
        events = [(self._id(event.device, event.point), event) for event in alarms]
        states = [(self._id(*key), state) for key, state in (counters or {}).items()]
        number = self._take_number()
        segment = self._segment_for(now)
        with ExitStack() as unless_committed:
            unless_committed.callback(self._forget_segment)
            unless_committed.callback(segment.rollback)
            segment.begin(number, now, keyed, intervals, events, states)
            self._step("before-commit")
            segment.commit()
            unless_committed.pop_all()
        self._step("after-commit")
        return Commit(number, now, batches, intervals, alarms)

    def begin_mending(self, clock: ClockCorrection, last: int = EVERY) -> None:
        """Record a correction of the wrong times that were stored since this start; `mend_next` makes it.

        Args:
            clock: which times are wrong, and by how much.
            last: number of the last commit that has wrong times.
        """
        self.manifest.begin_mending(CommitCorrection(self._first, last, clock))

    def mend_next(self) -> bool:
        """Correct the wrong times in one more segment, if a correction was recorded (`begin_mending`).

        A correction that a crash interrupted is continued at the next start.

        Returns:
            Whether to call it again: segments are left, the thread that seals works on the files just now, or the open
            segment must wait for the next commit. False if no correction is left to be made.

        Raises:
            sqlite3.Error, OSError: the segment or the manifest cannot be written; call it again.
        """
        correction = self.manifest.correction()
        if correction is None:
            return False
        if not self._files.acquire(blocking=False):
            return True  # the other thread seals or drops; samples do not wait for that
        try:
            done = self.manifest.fact("mended") or 0
            for part in self.manifest.parts():
                if part.kind == "closed" and part.id > done and (part.last_commit or 0) >= correction.first:
                    self._mend_closed(part, correction)
                    return True
            if self._segment is not None:
                self._segment.mend(correction)
                self._segment.sync()  # before the manifest says that all is done
            elif self._part is not None:
                return True  # the next commit opens it again
        finally:
            self._files.release()
        self.manifest.set_fact("awaits_clock", None)
        self.manifest.set_fact("mend_from", None)
        self._awaits_clock = False
        return False

    def _mend_closed(self, part: StorePart, correction: CommitCorrection) -> None:
        path = self.folder / SEGMENTS / part.file
        with name_if_damaged(path), closing(open_database(path, makes=False)) as database:
            mend_segment(database, correction)
            found = facts_of(database, part, path.stat().st_size)
            self.manifest.close_segment(found, alarms_of(database), is_mended=True)

    def _is_to_be_mended(self, part: StorePart) -> bool:
        """Whether times in a part may still have to be corrected, so that it is neither sealed nor deleted for age.

        A segment without samples counts too, because its intervals and alarms have times.
        """
        return self._awaits_clock and (part.last_commit or 0) >= self._first

    def keep(self, retention: Retention) -> None:
        """Use new limits of retention from now on. Safe from any thread."""
        self.options = replace(self.options, retention=retention)

    def sync(self) -> None:
        """Make all commits so far survive a power failure: write the open segment's log to the disk.

        Raises:
            OSError: the log cannot be written to the disk.
        """
        if self._segment is not None:
            self._segment.sync()

    def limit_pages(self, pages: int) -> None:
        """Limit the number of pages of the open segment file, as on a full disk; for tests."""
        if self._segment is not None:
            self._segment.limit_pages(pages)

    @property
    def log_size(self) -> int:
        """The size of the open segment's write-ahead log in bytes; 0 if no segment is open."""
        return 0 if self._segment is None else self._segment.log_size()

    @property
    def newest_commit(self) -> int:
        """The number of the last commit of this run, also of one that failed: that uses up a number too.

        Opening the store makes a commit, so there always is one.
        """
        return self._next - 1

    def _take_number(self) -> int:
        if self._next >= self._behind:
            self._next, self._behind = self.manifest.reserve_numbers()
        self._next += 1
        return self._next - 1

    def _id(self, device: str, point: str) -> int:
        return self.manifest.point_ids(device, [point])[0]

    def _ids(self, batch: SampleBatch) -> tuple[int, ...]:
        ids = self._groups.get(batch.group)
        if ids is None:
            pairs = zip(batch.points, batch.values, strict=True)
            states = frozenset(point for point, value in pairs if isinstance(value, bool))
            ids = tuple(self.manifest.point_ids(batch.device, batch.points, states))
            self._groups[batch.group] = ids
        return ids

    # Segments

    def _segment_for(self, now: int) -> Segment:
        if self._segment is not None and self._segment.has_ended(self._begun, now, self.options.segment_size):
            self.roll()
        if self._segment is None:
            if self._part is None:
                self._part = self.manifest.add_segment()
                self._step("segment-listed")
                self._begun = now
            path = self.folder / SEGMENTS / self._part.file
            self._segment = Segment(path, every_commit_durable=self.options.durability == "power")
            sync_folder(path.parent)
            self._step("segment-made")
        return self._segment

    def _forget_segment(self) -> None:
        """Close the file of the open segment; the next commit opens it again."""
        if self._segment is not None:
            self._segment.close()
        self._segment = None

    def roll(self) -> None:
        """End the open segment, the file that samples are written to; the next commit begins a new one.

        Raises:
            sqlite3.Error, OSError: the end cannot be written into the manifest (a full disk); the segment is still the
                open one, and the next call tries again to end it.
        """
        if self._part is None:
            return
        self._close_segment()
        if close_segment(self.folder, self.manifest, self._part):
            self._journal_grew = True
        self._part = None
        remove_unlisted(self.folder, self.manifest)
        self._step("segment-closed")

    def _close_segment(self) -> None:
        try:
            self.sync()
        finally:
            self._forget_segment()

    # Upkeep, in another thread

    def seal_closed(self, most: int | None = None) -> int:
        """Turn finished segments into Parquet files, and return how many.

        It is 0 if the packages for that are not installed, or if the option ``seals`` is False. Segments whose times
        may still be corrected are left for later.

        Args:
            most: number of segments at most; None for all.

        Raises:
            SealingFailed: a Parquet file could not be written; its segment is unchanged.
            OSError, sqlite3.Error: a file or the manifest could not be written; no samples are lost.
        """
        if not self.options.seals or not can_seal():
            return 0
        with self._files:
            parts = self.manifest.parts()
            closed = [part for part in parts if part.kind == "closed" and not self._is_to_be_mended(part)]
            wanted = closed[:most]
            for part in wanted:
                seal(self.folder, self.manifest, part, self._step)
            return len(wanted)

    def apply_retention(self, now: int) -> list[StorePart]:
        """Delete files, intervals and alarm events beyond the limits of retention; return the parts that were deleted.

        Alarm events are looked at only if a segment has ended since the last call; see `forget_old_alarms`.

        Args:
            now: the present time, nanoseconds since 1970 UTC.

        Raises:
            OSError, sqlite3.Error: a file or the manifest could not be written; the next call tries again.
        """
        with self._files:
            dropped = parts_to_drop(self._sized_parts(), self.options.retention, now)
            age = self.options.retention.age
            if self._journal_grew:
                self._journal_grew = False
                forgotten = forget_old_alarms(self.manifest, 0 if age is None else now - int(age * 1_000_000_000))
                if forgotten:
                    _log.info("%d events of alarms are older than samples, or too many: no longer kept", forgotten)
            if not dropped and age is None:
                return []
            before = 0 if age is None else now - int(age * 1_000_000_000)
            self.manifest.drop_parts(dropped, before, self._halves_of_intervals(dropped))
            self._step("drop-listed")
            remove_unlisted(self.folder, self.manifest)
            self._step("drop-unlinked")
            return dropped

    def _halves_of_intervals(self, parts: Iterable[StorePart]) -> list[IntervalRow]:
        """Return the interval rows of parts to be dropped whose other half, begin or end, is not in these parts.

        They must be kept in the manifest. Skipped rounds, gaps and parts that may still be corrected are left out.
        """
        rows: list[IntervalRow] = []
        for part in parts:
            if part.kind == "closed" and not self._is_to_be_mended(part):
                with suppress(FileNotFoundError), closing(open_for_reading(self.folder / SEGMENTS / part.file)) as file:
                    rows += intervals_of(file)
        rows = [row for row in rows if row.device is not None and row.reason != Reason.SKIPPED]  # which has no begin
        begun = {row.key for row in rows if row.end is None}
        ended = {row.key for row in rows if row.end is not None}
        return [row for row in rows if row.key not in (ended if row.end is None else begun)]

    def _sized_parts(self) -> list[StorePart]:
        segment = self._segment
        size = 0 if segment is None else segment.size()
        parts = [replace(part, bytes=size) if part.kind == "open" else part for part in self.manifest.parts()]
        return list(_aged(parts, self._is_to_be_mended))


def _aged(parts: Sequence[StorePart], may_be_mended: Callable[[StorePart], bool]) -> Iterator[StorePart]:
    """Yield the parts (files) of a store, the last first, with ``high`` set to the time that decides how old they are.

    A part that was written while the clock was not set counts as old as the next part with right times. A part whose
    times may still be corrected counts as new: it is never too old.
    """
    next_high = EVER
    for part in reversed(parts):
        high = part.high if part.high is not None else part.alive
        if may_be_mended(part):
            yield replace(part, high=EVER)
        elif high is not None and high < EARLIEST:
            yield replace(part, high=next_high)
        else:
            next_high = next_high if high is None else high
            yield part
