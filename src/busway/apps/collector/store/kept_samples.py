"""Chooses which samples the store keeps of points with a report rule that drops some, such as only changes.

Pure: knows rules and samples; knows no file. Used by the thread that commits.

1. A sample is compared with the last kept sample of its point that was committed; samples that were lost do not count.
2. The first sample of a point is kept after a start, after a gap, after a time in which its device was not read, and
   after the configuration was read again. So a stored value holds until the next stored sample or interval.
3. A sample that causes an alarm event is kept. Alarms, computed points and accumulators see all samples, kept or not.
4. If a sample is not kept, the last kept value of its point is shown instead, with the time of the new read.
"""

import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from ....points.point_rules import ReportRule
from ..alarms.events import AlarmEvent
from ..samples import NANOSECONDS, CounterState, Gap, PointGroup, SampleBatch, SampleValue, StateInterval

StoreRules = Mapping[tuple[str, str], ReportRule]
"""By device and point, the report rules of the points of which not every sample is kept."""

MOST_PARTS: Final = 64
"""Most subsets of one group of points for which a `PointGroup` is kept in memory and used for later reads."""


@dataclass(frozen=True, slots=True)
class _Kept:
    """The last sample of a point that the store has kept.

    Attributes:
        time: nanoseconds since 1970 UTC.
        value: the value; None if the sample is bad and has none.
        reason: number of the reason, 0 for good.
    """

    time: int
    value: SampleValue | None
    reason: int


@dataclass(slots=True)
class Choice:
    """The samples of a commit that the store keeps, and those that it drops.

    Attributes:
        batches: the kept samples, as batches of one read each; reads without a kept sample are left out.
        shown: all reads of the commit with all their points, for showing last values. A sample that is not kept has the
            last kept value of its point in place of its own.
        counters: by device and point, the states of accumulators whose last sample is not kept; they are stored without
            the sample, so that the totals continue after a restart.
        passed_over: number of samples that are not kept.
        last: by device, then by point, the last kept sample; after `committed`, later samples are compared with it.
        unread: names of the devices that have an interval without reads in this commit; empty without report rules.
        has_gap: whether the commit has a gap, in which samples of all devices are missing; False without report rules.
    """

    batches: list[SampleBatch] = field(default_factory=list)
    shown: list[SampleBatch] = field(default_factory=list)
    counters: dict[tuple[str, str], CounterState] = field(default_factory=dict)
    passed_over: int = 0
    last: dict[str, dict[str, _Kept]] = field(default_factory=dict)
    unread: set[str] = field(default_factory=set)
    has_gap: bool = False


class KeptSamples:
    """Chooses by report rules which samples the store keeps.

    `choose` decides for the next commit. Call `committed` once that commit is made: later samples are compared with it
    then.
    """

    def __init__(self, rules: StoreRules | None = None) -> None:
        """Start with these report rules and no earlier samples; ``rules`` is None if every sample is kept."""
        self._rules: StoreRules = rules or {}
        self._last: dict[str, dict[str, _Kept]] = {}
        self._by_group: weakref.WeakKeyDictionary[PointGroup, tuple[ReportRule | None, ...] | None] = (
            weakref.WeakKeyDictionary()
        )
        self._parts: weakref.WeakKeyDictionary[PointGroup, dict[tuple[int, ...], PointGroup]] = (
            weakref.WeakKeyDictionary()
        )

    def begin_anew(self, rules: StoreRules | None = None) -> None:
        """Forget all earlier samples, so that the next sample of each point is kept whatever its value.

        Args:
            rules: new report rules; None to keep the present ones.
        """
        self._rules = self._rules if rules is None else rules
        self._by_group.clear()
        self._last.clear()

    def choose(
        self,
        batches: Sequence[SampleBatch],
        intervals: Sequence[StateInterval | Gap] = (),
        alarms: Sequence[AlarmEvent] = (),
    ) -> Choice:
        """Choose the samples that the next commit keeps. Nothing changes until `committed` is called with the result.

        Args:
            batches: samples of the reads since the last commit.
            intervals: intervals and gaps of the commit; the samples of their devices (of a gap: all samples) are kept.
            alarms: alarm events of the commit; the samples that caused them are kept.
        """
        if not self._rules:
            return Choice(list(batches), list(batches))
        choice = Choice(
            unread={each.device for each in intervals if isinstance(each, StateInterval)},
            has_gap=any(isinstance(each, Gap) for each in intervals),
        )
        causes = {(event.device, event.point, event.at) for event in alarms}
        for batch in batches:
            rules = self._rules_of(batch.group)
            if rules is None or choice.has_gap or batch.device in choice.unread:
                choice.batches.append(batch)
                choice.shown.append(batch)
            else:
                self._choose_of(batch, rules, causes, choice)
        return choice

    def committed(self, choice: Choice) -> None:
        """Record that the samples of ``choice`` are stored; the report rules compare later samples with them.

        Forgets earlier samples of the devices in ``unread``, or of all devices if there was a gap.
        """
        if choice.has_gap:
            self._last.clear()
        for device in choice.unread:
            self._last.pop(device, None)
        for device, points in choice.last.items():
            self._last.setdefault(device, {}).update(points)

    def _rules_of(self, group: PointGroup) -> tuple[ReportRule | None, ...] | None:
        """Return the report rules of the points of one read; None if every sample of them is kept."""
        if group not in self._by_group:
            found = tuple(self._rules.get((group.device, point)) for point in group.points)
            self._by_group[group] = found if any(found) else None
        return self._by_group[group]

    def _choose_of(
        self,
        batch: SampleBatch,
        rules: tuple[ReportRule | None, ...],
        causes: set[tuple[str, str, int]],
        choice: Choice,
    ) -> None:
        device, time = batch.device, batch.time
        known, fresh = self._last.get(device, {}), choice.last.setdefault(device, {})
        places: list[int] = []
        values: list[SampleValue | None] | None = None
        columns = zip(batch.points, batch.values, batch.reason_column(), rules, strict=True)
        for place, (point, value, reason, rule) in enumerate(columns):
            if rule is None:
                places.append(place)
                continue
            last = fresh.get(point) or known.get(point)
            if (
                last is None
                or rule.passes((last.value, last.reason), (value, reason), (time - last.time) / NANOSECONDS)
                or (device, point, time) in causes
            ):
                places.append(place)
                fresh[point] = _Kept(time, value, reason)
            elif last.value != value:
                values = list(batch.values) if values is None else values
                values[place] = last.value
        choice.passed_over += len(batch) - len(places)
        choice.shown.append(batch if values is None else replace(batch, values=values))
        if len(places) == len(batch):
            choice.batches.append(batch)
        elif places:
            choice.batches.append(self._part(batch, tuple(places)))
        if batch.counters:
            kept = {batch.points[place] for place in places}
            for each in batch.counters:
                choice.counters.pop((device, each.point), None)
                if each.point not in kept:
                    choice.counters[device, each.point] = each

    def _part(self, batch: SampleBatch, places: tuple[int, ...]) -> SampleBatch:
        """Return the samples of a read that are at the given positions of its batch, as a batch of their own."""
        parts = self._parts.setdefault(batch.group, {})
        group = parts.get(places)
        if group is None:
            if len(parts) >= MOST_PARTS:
                parts.clear()
            group = parts[places] = PointGroup(batch.device, tuple(batch.points[place] for place in places))
        reasons = batch.reasons if isinstance(batch.reasons, int) else tuple(batch.reasons[each] for each in places)
        return SampleBatch(
            group,
            batch.time,
            batch.half_width,
            tuple(batch.values[place] for place in places),
            reasons,
            tuple(each for each in batch.counters if each.point in group.points),
        )
