"""The last committed value of each point, and the changes since a tick as one JSON text for all viewers.

A tick is a numbered moment at which changes are made visible to viewers. Knows commits and the positions of points in
the list of points; knows no request and no WebSocket. The thread of the store calls `LiveValues.update`; any thread may
call the other methods.

1. A commit costs one entry for each read, with or without viewers. Its points are handled in the next tick.
2. A viewer that has seen tick 7 gets all changes since tick 7, however many ticks it missed: nothing is queued.
3. While a device is not read (suspended, without connection, in maintenance), its points have the quality bad, with
   that as the reason, until each point is read again.
4. While the store cannot be written, all points are bad with that as the reason: what was read since is not known here.
5. A good value that was not read again when it was due is held, and so uncertain (`..collector.held_values`). Values
   are checked for this when the first of them can be due.
6. Points that are neighbours in the list are sent together: points that were read at the same time as three numbers,
   points with changed values as one list.
"""

import json
import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final
from weakref import WeakKeyDictionary

from ..collector.held_values import age_of
from ..collector.sample_clock import ClockCorrection
from ..collector.samples import (
    PointGroup,
    Quality,
    Reason,
    SampleBatch,
    SampleValue,
    StateInterval,
    mended_batch,
    mended_interval,
    quality_of,
    reason_text,
)
from ..collector.store.writer import Commit
from .messages import plain_value

MOST_WAITING: Final = 10_000
"""Most groups of points whose latest samples may wait for a tick; with more, `LiveValues.update` begins a tick."""
_MILLION: Final = 1_000_000


class LiveValues:
    """The last stored values of all points of a collector, by the position of each point in the list of points.

    Args:
        points: device and name of each point, in the order of ``/api/points``.
        is_behind: returns whether commits have failed or hung for some seconds; then all points are shown as bad.
        limits: by device and point, seconds without a new read after which a value is held, that is, uncertain because
            it may be too old; a point without an entry is never held.
        moment: returns seconds of the monotonic clock.

    Attributes:
        tick: number of the last tick; 0 before the first.
        values: the last value of each point; None for a point that was not read yet, or whose last sample has no value.
        reasons: the reason code of each point's quality, not regarding held values and failing commits; 0 without a
            reason.
        times: when each point was read, milliseconds since 1970 UTC; 0 for a point that was not read yet.
    """

    def __init__(
        self,
        points: Sequence[tuple[str, str]],
        is_behind: Callable[[], bool] = lambda: False,
        limits: Mapping[tuple[str, str], float] | None = None,
        moment: Callable[[], float] = time.monotonic,
    ) -> None:
        self.tick: int = 0
        self.values: list[SampleValue | None] = [None] * len(points)
        self.reasons: list[int] = [0] * len(points)
        self.times: list[int] = [0] * len(points)
        self._changed_at = [0] * len(points)
        self._read_at = [0] * len(points)
        self._places = {key: place for place, key in enumerate(points)}
        self._moment = moment
        self._taken_at = [math.inf] * len(points)
        self._held = [False] * len(points)
        self._look_at = 0.0
        self._groups: WeakKeyDictionary[PointGroup, list[int]] = WeakKeyDictionary()
        self._waiting: dict[PointGroup, tuple[SampleBatch, float]] = {}
        self._by_device: dict[str, list[int]] = {}
        for place, (device, _) in enumerate(points):
            self._by_device.setdefault(device, []).append(place)
        self._intervals: dict[str, StateInterval] = {}
        self._unapplied: set[str] = set()
        self._is_mended = False
        self._is_behind = is_behind
        self._was_behind = False
        self._lock = threading.Lock()
        self._texts: dict[int, str] = {}
        self.set_limits(limits or {})

    def set_limits(self, limits: Mapping[tuple[str, str], float]) -> None:
        """Use other limits from now on: by device and point, seconds without a new read after which a value is held."""
        self._limits = [limits.get(key, math.inf) for key in self._places]
        self._shortest = min(self._limits, default=math.inf)
        self._look_at = 0.0

    def begin(self, reads: Iterable[tuple[SampleBatch, float]], intervals: Mapping[str, StateInterval]) -> None:
        """Take over samples and intervals that were stored before the first `update`; newer ones are not replaced.

        Args:
            reads: the last read of each group of points, each with the time of its end, seconds of the monotonic clock.
            intervals: by device, the latest interval in which the device was not read.
        """
        with self._lock:
            for batch, at in reads:
                self._waiting.setdefault(batch.group, (batch, at))  # an older one than a point has already is ignored
            for device, interval in intervals.items():
                if self._intervals.setdefault(device, interval) is interval:
                    self._unapplied.add(device)

    def update(self, commit: Commit) -> None:
        """Take over the samples, intervals and corrected times of a commit; the next tick makes them visible.

        Called by the thread of the store for each commit, once it is stored. Begins a tick itself if more than
        `MOST_WAITING` groups of points wait.
        """
        with self._lock:
            if commit.correction is not None:
                self._mend(commit.correction)
            for batch in commit.last_values:
                self._waiting[batch.group] = batch, commit.moment - age_of(batch, commit.at)
            for each in commit.intervals:
                if isinstance(each, StateInterval) and each.reason != Reason.SKIPPED:
                    self._intervals[each.device] = each
                    self._unapplied.add(each.device)
            if len(self._waiting) > MOST_WAITING:
                self._advance()

    def advance(self) -> bool:
        """Begin a new tick with the changes since the last tick, and return True.

        Returns False, without a new tick, if there is no change: no commit with samples, intervals or a correction of
        times has come, no further value is held, and commits fail or succeed as before.
        """
        with self._lock:
            has_new = self._waiting or self._unapplied or self._is_mended
            is_quiet = not has_new and self._is_behind() == self._was_behind
            if is_quiet and not self._newly_held():
                return False
            self._advance()
            return True

    def _advance(self) -> None:
        self.tick += 1
        self._is_mended = False
        self._texts.clear()
        waiting, self._waiting = self._waiting, {}
        for batch, at in sorted(waiting.values(), key=lambda each: each[0].time):
            self._take(batch, at)
        concerned, self._unapplied = self._unapplied | {batch.device for batch, _ in waiting.values()}, set()
        for device in concerned & self._intervals.keys():
            self._apply(self._intervals[device])
        for place in self._newly_held():
            self._held[place] = True
            self._changed_at[place] = self.tick
        behind = self._is_behind()
        if behind != self._was_behind:
            self._was_behind = behind
            for place, at in enumerate(self.times):
                if at:
                    self._changed_at[place] = self.tick

    def _newly_held(self) -> list[int]:
        """Return the positions of points whose value is too old now, and which are not marked as held yet."""
        now = self._moment()
        if now <= self._look_at:
            return []
        ends = [at + limit for at, limit in zip(self._taken_at, self._limits, strict=True)]
        found = [place for place, end in enumerate(ends) if end < now and not self._held[place]]
        if not found:
            self._look_at = min((end for end in ends if end >= now), default=math.inf)
        return found

    def _mend(self, correction: ClockCorrection) -> None:
        """Correct times from before the clock was set; values that were uncertain only because of it become good."""
        self._is_mended = True
        self._waiting = {group: (mended_batch(each, correction), at) for group, (each, at) in self._waiting.items()}
        self._intervals = {device: mended_interval(each, correction) for device, each in self._intervals.items()}
        for place, at in enumerate(self.times):
            if at and correction.begin - _MILLION < at * _MILLION < correction.end:
                self.times[place] = at + correction.shift // _MILLION
                self._read_at[place] = self.tick + 1
                if self.reasons[place] == Reason.CLOCK:
                    self.reasons[place] = 0
                    self._changed_at[place] = self.tick + 1

    def _shown(self, place: int) -> int:
        """Return the reason code to show for the point at a position; it regards held values and failing commits."""
        reason = self.reasons[place] or (Reason.HELD if self._held[place] else 0)
        is_old = self._was_behind and self.times[place] and quality_of(reason) is not Quality.BAD
        return Reason.LOST if is_old else reason

    def _apply(self, interval: StateInterval) -> None:
        """Give the points of a device the reason of an interval in which the device was not read.

        Points that were read since the interval began, or are bad already, keep their reason; in a maintenance that
        still lasts, all points get the new reason.
        """
        always = interval.end is None and interval.reason == Reason.MAINTENANCE
        begin = interval.begin // _MILLION
        for place in self._by_device.get(interval.device, ()):
            known = self.reasons[place]
            is_older = always or self.times[place] <= begin
            if is_older and known != interval.reason and (always or quality_of(known) is not Quality.BAD):
                self.reasons[place] = interval.reason
                self._changed_at[place] = self.tick

    def _take(self, batch: SampleBatch, taken_at: float) -> None:
        tick, at = self.tick, batch.time // _MILLION
        self._look_at = min(self._look_at, taken_at + self._shortest)
        values, reasons, times, held = self.values, self.reasons, self.times, self._held
        for place, value, reason in zip(self._places_of(batch.group), batch.values, batch.reason_column(), strict=True):
            if place < 0 or times[place] > at:
                continue
            times[place] = at
            self._read_at[place] = tick
            self._taken_at[place] = taken_at
            if value != values[place] or reason != reasons[place] or held[place] or not self._changed_at[place]:
                held[place] = False
                values[place] = value
                reasons[place] = reason
                self._changed_at[place] = tick

    def _places_of(self, group: PointGroup) -> list[int]:
        found = self._groups.get(group)
        if found is None:
            known = self._places
            found = self._groups[group] = [known.get((group.device, point), -1) for point in group.points]
        return found

    def columns(self) -> tuple[list[SampleValue | None], list[int], list[int]]:
        """Return values, reason codes to show and times of all points as three new lists, after an `advance`.

        Times are milliseconds since 1970 UTC; 0 for points that were not read yet.
        """
        self.advance()
        with self._lock:
            reasons = [self._shown(place) for place in range(len(self.reasons))]
            return self.values.copy(), reasons, self.times.copy()

    def since(self, seen: int) -> str:
        """Return the changes after tick ``seen`` up to the last tick, as a JSON object without its braces.

        With -1, all points are returned. The text is encoded once for all open pages that have seen the same tick. It
        has three keys. ``read``: one flat list with three numbers for each run of neighbouring points that were read at
        the same time: first position, number of points, time in milliseconds since 1970 UTC. ``changed``: for each run
        of neighbouring points whose value or reason has changed, a list of first position, list of values and list of
        reason codes (a single number if all are equal). ``reasons``: for each of these codes its quality and its text.
        """
        with self._lock:
            text = self._texts.get(seen)
            if text is None:
                text = self._texts[seen] = json.dumps(self._delta(seen), ensure_ascii=False, separators=(",", ":"))
            return text[1:-1]

    def _delta(self, seen: int) -> dict[str, Any]:
        read, end, at = list[int](), -1, -1
        times = self.times
        for place, tick in enumerate(self._read_at):
            if tick <= seen:
                continue
            if place == end and times[place] == at:
                read[-2] += 1
            else:
                at = times[place]
                read += (place, 1, at)
            end = place + 1
        changed, used = self._runs(seen)
        return {"read": read, "changed": changed, "reasons": {str(reason): reason_shown(reason) for reason in used}}

    def _runs(self, seen: int) -> tuple[list[Any], set[int]]:
        """Return the points changed after tick ``seen``, as runs of neighbouring points, and all reason codes in them.

        A run is a list: first position, list of values, list of reason codes. If all codes of a run are equal, a single
        number replaces their list.
        """
        runs: list[Any] = []
        used: set[int] = set()
        end, values, reasons = -1, list[Any](), list[int]()
        for place, tick in enumerate(self._changed_at):
            if tick <= seen:
                continue
            if place != end:
                values, reasons = [], []
                runs.append([place, values, reasons])
            values.append(plain_value(self.values[place]))
            reasons.append(self._shown(place))
            end = place + 1
        for run in runs:
            kinds = set(run[2])
            used |= kinds
            if len(kinds) == 1:
                run[2] = run[2][0]
        return runs, used


def reason_shown(reason: int) -> list[str]:
    """Return two texts for a reason code: the quality, and the reason (empty for code 0)."""
    return [quality_of(reason).label, reason_text(reason) if reason else ""]
