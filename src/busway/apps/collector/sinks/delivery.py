"""Delivery of a store's samples to one sink: reads after the sink's cursor, sends, then moves the cursor.

Knows when to send, to wait, to drop and to set aside; knows no receiver.

1. At least once: the cursor moves, and is saved in the manifest, only after the receiver has taken a batch.
2. A sink that is down is tried again after a pause that doubles up to `PAUSE_LIMIT`. Samples wait in the store.
3. Samples wait for at most `DeliveryOptions.keep` seconds. Older ones are dropped for this sink, oldest first, and
   counted; so are samples that retention deletes from the store before they were sent.
4. The report rule of the sink decides whether a sample is sent; without one, that of the point. The sample is compared
   with the one that this sink got before, and always sent if its reason has changed. What the sink got before is in
   the manifest with the cursor: after a crash the same samples are sent again, wherever batches are cut then.
5. Samples and events of alarms that the receiver refuses are found by halving the batch, and set aside in a file, up to
   `ASIDE_LIMIT` bytes; then, and while the file cannot be written (a full disk), they are only counted. All others are
   sent.
6. Samples from before the wall clock was set wait until their times are corrected, so that the receiver gets them once,
   with the right time. After `CLOCK_WAIT` seconds they are sent as they are, and not again.
7. A sink that shows current values stays connected while nothing is to be sent, and is told which points exist. After a
   restart it gets the last sent samples of points of which only some samples are sent.
8. If the cursor cannot be saved (a full disk), the delivery goes on, and saves it when there is room. After a crash
   before that, the samples since the saved cursor are sent again. `Delivery.finish` tries to save it too.
9. If the receiver goes away in the middle of a batch, what it took of it by an earlier `Sink.send`, and what was set
   aside of it, is not sent again, unless the process ends before.
"""

import asyncio
import contextlib
import json
import logging
import sqlite3
import time
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ....options.sinks import DeliveryOptions
from ....points.name_patterns import is_meant
from ....points.point_rules import ReportRule
from ..cancellation import end_if_cancelled
from ..sample_clock import EARLIEST
from ..samples import NANOSECONDS, reason_text
from ..store.committed_samples import CommitRange, CommitReader, CommittedAlarm, CommittedSample
from ..store.folder import is_cut_off
from ..store.manifest import Manifest, ReportedSample
from .documents import alarm_document
from .interface import AlarmSink, CurrentSink, Sink, SinkDown, SinkRefused

PAUSE: Final = 0.5
PAUSE_LIMIT: Final = 30.0
CLOCK_WAIT: Final = 600.0
"""Most seconds that samples from before the wall clock was set wait for the correction of their times."""
ASIDE: Final = "set-aside"
ASIDE_LIMIT: Final = 16 * 1024 * 1024
_EVERY: Final = ReportRule()

_log = logging.getLogger("busway.sinks")


@dataclass(frozen=True, slots=True)
class SinkStatus:
    """The status of one sink: what its receiver has got, what was lost, and what is wrong.

    Attributes:
        name: the name of the sink.
        cursor: number of a commit; of it and all commits before, everything was sent, set aside or dropped.
        sent: number of samples that the receiver has taken since the start; repeated ones count again.
        lost: number of samples that were dropped for the sink before they were sent, over all restarts.
        set_aside: number of samples and alarm events that the receiver refused since the start.
        error: why nothing can be sent now, or the cursor cannot be saved; else the reason of the last refusal since
            the start; None if all is well.
    """

    name: str
    cursor: int
    sent: int
    lost: int
    set_aside: int
    error: str | None


class ClockWait:
    """Decides whether commits wait because their times are from before the wall clock was set (rule 6).

    Args:
        now: returns seconds of a clock that is never set.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._since: float | None = None

    def must_wait(self, found: CommitRange) -> bool:
        """Whether ``found``, the next commits to be sent, must wait until their times are corrected.

        True if a time in them is from before the clock was set, for at most `CLOCK_WAIT` seconds from the first such
        call on.
        """
        if all(sample.time >= EARLIEST for sample in found.samples) and all(
            alarm.event.at >= EARLIEST for alarm in found.alarms
        ):
            self._since = None
            return False
        if self._since is None:
            self._since = self._now()
        return self.waits

    @property
    def waits(self) -> bool:
        """Whether the commits that were given to `must_wait` last still have to wait."""
        return self._since is not None and self._now() - self._since < CLOCK_WAIT


class Delivery:
    """Sends the samples of a store to one sink, from the sink's cursor on, until `run` is cancelled.

    Attributes:
        name: the name of the sink.
        options: the options of the delivery.
    """

    def __init__(
        self,
        name: str,
        sink: Sink,
        folder: Path,
        manifest: Manifest,
        options: DeliveryOptions | None = None,
        *,
        point_rules: Mapping[tuple[str, str], ReportRule] | None = None,
        points: Collection[tuple[str, str]] | None = None,
        now: Callable[[], int] = time.time_ns,
        monotonic: Callable[[], float] = time.monotonic,
        pause: Callable[[float], Awaitable[object]] = asyncio.sleep,
    ) -> None:
        """Prepare to send what follows the sink's cursor, the last commit that it got; `run` sends.

        A new sink begins with the oldest samples; its cursor is put into the manifest. A sink that shows current values
        is told the last samples that it got of points of which it gets only some (`CurrentSink.remember`).

        Args:
            name: the name of the sink and of its cursor.
            sink: the sink.
            folder: the folder of the store.
            manifest: the store's manifest, opened for writing.
            options: the options of the delivery.
            point_rules: by device and point, the report rules of points of which only some samples are sent; used if
                ``options`` has no report rule. None for no rules.
            points: device and name of each point in the configuration; None for all points of the store.
            now: returns the time, nanoseconds since 1970 UTC.
            monotonic: returns seconds of a clock that is never set.
            pause: waits for the seconds that it is given.

        Raises:
            sqlite3.Error: the manifest cannot be read or written.
        """
        self.name = name
        self._sink, self._folder, self._manifest = sink, folder, manifest
        self.options: DeliveryOptions = options or DeliveryOptions()
        self._now, self._pause = now, pause
        self._clock = ClockWait(monotonic)
        self._reader = CommitReader(folder, manifest)
        known = manifest.cursors().get(name)
        self._cursor, self._lost = known or (0, 0)
        if known is None:
            manifest.set_cursor(name, 0, 0)
        self._named: dict[tuple[str, str], bool] = {}
        self._point_rules: Mapping[tuple[str, str], ReportRule] = point_rules or {}
        self._points = points
        self._reported: dict[tuple[str, str], ReportedSample] = {
            (row.device, row.point): row for row in manifest.reported(name)
        }
        self._sent = self._aside = 0
        self._down_error: str | None = None
        self._refusal: str | None = None
        self._only_counts = False  # what is refused could not be set aside
        self._store_error: str | None = None
        self._is_saved = True  # whether the cursor is in the manifest
        self._unsaved: dict[tuple[str, str], ReportedSample] = {}  # sent, and not in the manifest yet
        self._arrived: list[Sequence[CommittedSample]] = []  # taken or set aside since the cursor moved (rule 9)
        self._arrived_alarms: list[Sequence[CommittedAlarm]] = []
        self._is_open = False
        self._is_finishing = False
        self._step_ended: asyncio.Event | None = None
        self._shown = points
        if isinstance(sink, CurrentSink):
            self._forget_all_but(points)
            sink.remember(self._last_reported())

    def _last_reported(self) -> list[CommittedSample]:
        """Return, for each point of which the sink gets only some samples, the last sample that it got."""
        units = {(each.device, each.point): each.unit_of_measure for each in self._manifest.points()}
        return [
            CommittedSample(self._cursor, row.device, row.point, row.time, 0, row.value, row.reason, units.get(key, ""))
            for key, row in self._reported.items()
            if self._is_named(key)
        ]

    def note_defect(self, error: Exception) -> None:
        """Set the error in the sink's status to that of a delivery that ended unexpectedly."""
        self._down_error = f"failed unexpectedly: {str(error) or type(error).__name__}"

    def set_points(
        self, points: Collection[tuple[str, str]] | None, rules: Mapping[tuple[str, str], ReportRule]
    ) -> None:
        """Use the points and report rules of a configuration that was read again. Safe from any thread.

        Args:
            points: device and name of each point in the configuration; None for all points of the store.
            rules: by device and point, the report rules of points of which only some samples are sent.
        """
        self._points, self._point_rules = points, rules

    def status(self) -> SinkStatus:
        """Return the status of the sink: its cursor, counts and error. Safe from any thread."""
        error = self._down_error or self._store_error or self._refusal
        return SinkStatus(self.name, self._cursor, self._sent, self._lost, self._aside, error)

    async def run(self) -> None:
        """Send stored samples to the sink, and new ones as they are stored, until cancelled; then the sink is closed.

        While the sink is down, sending is tried again after pauses of `PAUSE` to `PAUSE_LIMIT` seconds. Any other error
        is raised, after the sink was closed. After `finish` nothing more is sent.
        """
        wait = PAUSE
        try:
            while True:
                try:
                    more = await self._whole_step()
                except SinkDown as error:
                    await self._down(error)
                    end_if_cancelled()
                    await self._pause(wait)
                    wait = min(2 * wait, PAUSE_LIMIT)
                    continue
                wait = PAUSE
                end_if_cancelled()
                if not more:
                    await self._rest(max(self.options.age, 0.05))
        finally:
            self._is_open = False
            await self._sink.close()

    async def finish(self, seconds: float) -> None:
        """Begin no further batch, and wait until the one that is being sent has arrived or failed.

        A cursor that could not be saved before is saved then, if that succeeds now (rule 8). Returns after ``seconds``
        at the latest.
        """
        self._is_finishing = True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                if self._step_ended is not None:
                    await self._step_ended.wait()
                if not self._is_saved:
                    await asyncio.to_thread(self._save_cursor)

    async def _whole_step(self) -> bool:
        if self._is_finishing:
            return False
        self._step_ended = ended = asyncio.Event()
        try:
            return await self.step()
        finally:
            self._step_ended = None
            ended.set()

    async def step(self) -> bool:
        """Send the next commits of the store to the sink, and move its cursor.

        Returns:
            Whether the store already has later commits. False also if the store cannot be read now, or if the samples
                must wait for the clock to be set.

        Raises:
            SinkDown: some samples may have arrived; the cursor stays, so that all are sent again that are not known to
                have arrived.
        """
        found = await asyncio.to_thread(self._next)
        if found is None or self._clock.must_wait(found):
            await self._show_current()
            return False
        wanted, reported = self._wanted(found.samples)
        sink = self._sink
        alarms = found.alarms if isinstance(sink, AlarmSink) else []
        alarms = [each for each in alarms if self._is_named((each.event.device, each.event.point))]
        wanted, alarms = self._not_arrived(wanted, alarms)
        if wanted or alarms:
            await self._open()
        if wanted:
            await self._send(wanted)
        if alarms and isinstance(sink, AlarmSink):
            await self._send_alarms(sink, alarms)
        self._down_error = None
        await asyncio.to_thread(self._move, found.last, reported)
        if not found.more:
            await self._show_current()
        return found.more

    def _not_arrived(
        self, samples: list[CommittedSample], alarms: list[CommittedAlarm]
    ) -> tuple[list[CommittedSample], list[CommittedAlarm]]:
        """Return those samples and events of a batch that an earlier attempt has not sent or set aside (rule 9)."""
        if self._arrived:
            keys = {_key(sample) for part in self._arrived for sample in part}
            samples = [sample for sample in samples if _key(sample) not in keys]
        if self._arrived_alarms:
            places = {(alarm.commit, alarm.place) for part in self._arrived_alarms for alarm in part}
            alarms = [alarm for alarm in alarms if (alarm.commit, alarm.place) not in places]
        return samples, alarms

    def _forget_all_but(self, points: Collection[tuple[str, str]] | None) -> None:
        """Forget the last sent sample of each point that is not in ``points``; None forgets none.

        If such a point comes back to the configuration, its first sample is sent whatever its value.
        """
        if points is not None:
            self._reported = {key: row for key, row in self._reported.items() if key in points}

    async def _open(self) -> None:
        if not self._is_open:
            await self._sink.open()
            self._is_open = True

    async def _show_current(self) -> None:
        """Have a sink that shows current values connect and show them; do nothing for other sinks."""
        if isinstance(self._sink, CurrentSink):
            await self._open()
            points = self._points
            await self._sink.show_current(points)
            if points is not self._shown:
                self._forget_all_but(points)
                self._shown = points
            self._down_error = None

    async def _rest(self, seconds: float) -> None:
        """Pause for some seconds, or until a sink that shows current values is disturbed (`CurrentSink.disturbed`)."""
        if not (self._is_open and isinstance(self._sink, CurrentSink)):
            await self._pause(seconds)
            return
        ends = [asyncio.ensure_future(self._pause(seconds)), asyncio.ensure_future(self._sink.disturbed())]
        try:
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in ends:
                each.cancel()
            await asyncio.gather(*ends, return_exceptions=True)

    def _next(self) -> CommitRange | None:
        """Drop samples that have waited too long, and return the next commits after the sink's cursor.

        A cursor that could not be saved before is saved first.

        Returns:
            The commits; None if there are none, or if the store cannot be read now.
        """
        try:
            if not self._is_saved:
                self._save_cursor()
            self._drop_old()
            found = self._reader.read(self._cursor, self.options.most)
        except (sqlite3.Error, OSError) as error:
            self._note_store_error(error)
            return None
        if self._is_saved:
            self._store_error = None
        return found

    def _move(self, cursor: int, reported: Mapping[tuple[str, str], ReportedSample]) -> None:
        """Move the sink's cursor past sent samples, and save it in the manifest.

        The samples are not sent again while the process runs, even if the cursor cannot be saved (rule 8).

        Args:
            cursor: number of the last sent commit.
            reported: the last sent samples of points of which only some are sent.
        """
        self._cursor = cursor
        self._arrived.clear()
        self._arrived_alarms.clear()
        self._reported.update(reported)
        self._unsaved.update(reported)
        self._save_cursor()

    def _save_cursor(self) -> None:
        """Save the sink's cursor in the manifest; if that fails, it is tried again before the next commits (rule 8)."""
        try:
            self._lost = self._lost_in_all()
            self._manifest.set_cursor(self.name, self._cursor, self._lost, self._unsaved.values())
        except sqlite3.Error as error:
            self._is_saved = False
            self._note_store_error(error)
        else:
            self._is_saved = True
            self._unsaved.clear()

    def _lost_in_all(self) -> int:
        """Return the number of samples lost for the sink, including those that retention has deleted meanwhile."""
        return max(self._lost, self._manifest.cursors().get(self.name, (0, 0))[1])

    def _note_store_error(self, error: Exception) -> None:
        if self._store_error is None:
            _log.warning("sink %s: the store cannot be used now: %s", self.name, error)
        self._store_error = f"the store cannot be used now: {error}"

    def _drop_old(self) -> None:
        lost = self._lost_in_all() - self._lost
        if lost:
            self._lost += lost
            _log.warning("sink %s: %d samples were dropped with the oldest parts of the store", self.name, lost)
        oldest = self._now() - int(self.options.keep * NANOSECONDS)
        last = self._reader.last_before(oldest, self._cursor)
        if last > self._cursor:
            lost = self._reader.count(self._cursor, last)
            self._lost += lost
            self._cursor = last
            self._save_cursor()
            if lost:
                _log.warning(
                    "sink %s: %d samples waited longer than %g s, and are dropped", self.name, lost, self.options.keep
                )

    def _wanted(
        self, samples: Sequence[CommittedSample]
    ) -> tuple[list[CommittedSample], dict[tuple[str, str], ReportedSample]]:
        """Return the samples that the sink gets, by its patterns of points and the report rules (rule 4).

        Returns:
            The samples to send; and by device and point, the last of them of each point that has a report rule, or had
            one when an earlier sample was sent.
        """
        wanted = []
        fresh = dict[tuple[str, str], ReportedSample]()
        for sample in samples:
            key = (sample.device, sample.point)
            if not self._is_named(key):
                continue
            rule = self.options.report or self._point_rules.get(key, _EVERY)
            if rule.when != "every":
                last = fresh.get(key) or self._reported.get(key)
                if last is not None and not _passes(rule, last, sample):
                    continue
            if rule.when != "every" or key in self._reported:
                fresh[key] = ReportedSample(*key, sample.time, sample.value, sample.reason)
            wanted.append(sample)
        return wanted, fresh

    def _is_named(self, key: tuple[str, str]) -> bool:
        named = self._named.get(key)
        if named is None:
            named = any(is_meant("/".join(key), pattern) for pattern in self.options.points)
            self._named[key] = named
        return named

    async def _send(self, samples: Sequence[CommittedSample]) -> None:
        """Send samples to the sink; those that it refuses for good are found by halving and set aside.

        Raises:
            SinkDown: some samples may have arrived; those that are not in `_arrived` will be sent again.
        """
        try:
            await self._sink.send(samples)
            self._sent += len(samples)
            self._arrived.append(samples)
        except SinkRefused as error:
            if len(samples) > 1:
                middle = len(samples) // 2
                await self._send(samples[:middle])
                await self._send(samples[middle:])
                return
            sample = samples[0]
            line = {
                "device": sample.device,
                "point": sample.point,
                "time": sample.time,
                "value": sample.value,
                "reason": reason_text(sample.reason),
            }
            await self._set_aside("a sample", line, error)
            self._arrived.append(samples)

    async def _send_alarms(self, sink: AlarmSink, alarms: Sequence[CommittedAlarm]) -> None:
        """Send alarm events to the sink; those that it refuses for good are found by halving and set aside.

        Raises:
            SinkDown: some events may have arrived; those that are not in `_arrived_alarms` will be sent again.
        """
        try:
            await sink.send_alarms(alarms)
            self._arrived_alarms.append(alarms)
        except SinkRefused as error:
            if len(alarms) > 1:
                middle = len(alarms) // 2
                await self._send_alarms(sink, alarms[:middle])
                await self._send_alarms(sink, alarms[middle:])
                return
            await self._set_aside("an event of an alarm", alarm_document(alarms[0]).content, error)
            self._arrived_alarms.append(alarms)

    async def _set_aside(self, what: str, line: Mapping[str, Any], error: SinkRefused) -> None:  # what JSON has
        """Count a refused sample or event of an alarm, and set it aside in the file, if that can be written (rule 5).

        Args:
            what: ``a sample`` or ``an event of an alarm``, for the log.
            line: the keys and values that the line in the file has, beside ``error``.
            error: why it is refused.
        """
        if self._aside == 0:
            _log.error("sink %s refused %s, which is set aside: %s", self.name, what, error)
        self._aside += 1
        self._refusal = str(error)
        try:
            await asyncio.to_thread(self._write_aside, {**line, "error": str(error)})
        except OSError as problem:
            if not self._only_counts:
                _log.error("sink %s: what it refuses cannot be set aside, and is only counted: %s", self.name, problem)
            self._only_counts = True
            self._refusal = f"{error}; it cannot be set aside: {problem}"
        else:
            self._only_counts = False

    def _write_aside(self, line: dict[str, Any]) -> None:  # what JSON has
        folder = self._folder / ASIDE
        folder.mkdir(mode=0o700, exist_ok=True)
        path = folder / f"{self.name}.jsonl"
        if path.exists() and path.stat().st_size > ASIDE_LIMIT:
            return
        with path.open("a+b") as file:
            begin = "\n" if is_cut_off(file) else ""
            file.write(f"{begin}{json.dumps(line)}\n".encode())

    async def _down(self, error: SinkDown) -> None:
        if self._down_error is None:
            _log.warning("sink %s is down: %s; samples wait in the store", self.name, error)
        self._down_error = str(error)
        self._is_open = False
        await self._sink.close()


def _key(sample: CommittedSample) -> tuple[int, str, str, int]:
    return sample.commit, sample.device, sample.point, sample.time


def _passes(rule: ReportRule, last: ReportedSample, sample: CommittedSample) -> bool:
    silence = (sample.time - last.time) / NANOSECONDS
    return rule.passes((last.value, last.reason), (sample.value, sample.reason), silence)
