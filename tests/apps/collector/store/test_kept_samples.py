"""Which samples the store keeps: against a model of its own that counts in fractions, and through a committer."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import pytest
from collected import PUMP, at, read_of

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.samples import CounterState, Gap, PointGroup, Reason, SampleBatch, StateInterval
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.accumulator_states import counters_by_device
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.kept_samples import KeptSamples
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreWriter
from busway.points.point_rules import ReportRule

TENTH = Fraction(1, 10)
KEY = ("pump-1", "speed")
CHANGE = {KEY: ReportRule("change")}


@dataclass(frozen=True)
class Ruled:
    """A rule in numbers that are exact: tenths of the unit, tenths of a percent, tenths of a second."""

    when: str = "change"
    deadband: int = 0
    percent: bool = False
    silence: int | None = None

    def rule(self) -> ReportRule:
        seconds = None if self.silence is None else self.silence / 10
        period, most = (seconds, None) if self.when == "change_or_period" else (None, seconds)
        return ReportRule(self.when, period, self.deadband / 10, self.percent, most)  # type: ignore[arg-type]

    def passes(self, last: "Seen", now: "Seen") -> bool:
        if self.when == "every" or last.reason != now.reason:
            return True
        if last.value is None or now.value is None:
            changed = last.value is not now.value
        else:
            band = self.deadband * TENTH * (abs(last.value) * TENTH / 100 if self.percent else 1)
            changed = abs(now.value - last.value) * TENTH > band
        return changed or (self.silence is not None and now.time - last.time >= self.silence)


@dataclass(frozen=True)
class Seen:
    """A sample in whole numbers: tenths of a second, tenths of the unit."""

    time: int
    value: int | None
    reason: int = 0


@dataclass
class Model:
    """What is kept, said in another way than the code says it."""

    rules: dict[str, Ruled]
    last: dict[str, Seen] = field(default_factory=dict)

    def commit(
        self, reads: Sequence[dict[str, Seen]], *, loses_track: bool, causes: set[tuple[str, int]]
    ) -> set[tuple[str, int]]:
        kept: set[tuple[str, int]] = set()
        for read in reads:
            for point, now in read.items():
                last = None if loses_track else self.last.get(point)
                if last is None or self.rules[point].passes(last, now) or (point, now.time) in causes:
                    kept.add((point, now.time))
                    self.last[point] = now
        if loses_track:
            self.last.clear()
        return kept


RULES = [
    Ruled("every"),
    Ruled(),
    Ruled(deadband=1),
    Ruled(deadband=3),
    Ruled(deadband=50, percent=True),
    Ruled(silence=30),
    Ruled("change_or_period", 2, silence=20),
    Ruled(deadband=1000, silence=7),
]


@pytest.mark.parametrize("seed", range(40))
def test_what_is_kept_is_what_the_model_keeps_over_gaps_pauses_alarms_and_restarts(seed: int) -> None:
    chance = random.Random(seed)
    points = ("a", "b", "c")
    ruled = {point: chance.choice(RULES) for point in points}
    rules = {("d", point): each.rule() for point, each in ruled.items() if each.when != "every"}
    group, kept, model, now = PointGroup("d", points), KeptSamples(rules), Model(ruled), 0
    values = dict.fromkeys(points, 7)
    for _ in range(60):
        if chance.random() < 0.05:
            kept, model.last = KeptSamples(rules), {}
        reads = []
        for _ in range(chance.randrange(4)):
            now += chance.choice((1, 5, 7, 10, 30))
            for point in points:
                values[point] += chance.choice((0, 0, 0, 1, -1, 2, 3, -3, 20))
            bad = int(chance.choice((0, 0, 0, 0, Reason.TIMEOUT, Reason.HELD)))
            reads.append({point: Seen(now, None if bad == Reason.TIMEOUT else values[point], bad) for point in points})
        told: list[StateInterval | Gap] = []
        if chance.random() < 0.1:
            told.append(chance.choice((StateInterval("d", at(now), None, Reason.SUSPENDED), Gap(0, 1, Reason.LOST, 1))))
        causes = {("b", read["b"].time) for read in reads if chance.random() < 0.1}
        events = [AlarmEvent("d", point, "H", AlarmEventKind.RAISED, at(time / 10)) for point, time in causes]
        batches = [_batch(group, read) for read in reads]
        choice = kept.choose(batches, told, events)
        if chance.random() < 0.1:
            choice = kept.choose(batches, told, events)  # the disk was full the first time
        kept.committed(choice)
        found = {(sample.point, sample.time) for batch in choice.batches for sample in batch}
        wanted = model.commit(reads, loses_track=bool(told), causes=causes)
        assert found == {(point, at(time / 10)) for point, time in wanted}
        assert choice.passed_over == 3 * len(reads) - len(wanted)
        assert [batch.group for batch in choice.shown] == [group] * len(reads)


def _batch(group: PointGroup, read: dict[str, Seen]) -> SampleBatch:
    seen = [read[point] for point in group.points]
    values = [None if each.value is None else each.value / 10 for each in seen]
    return SampleBatch(group, at(seen[0].time / 10), 5, values, tuple(each.reason for each in seen))


@pytest.mark.parametrize(
    ("before", "now", "rule", "changed"),
    [
        (0.7, 0.8, ReportRule("change", deadband=0.1), False),  # the floats differ by more than the float 0.1
        (0.7, 0.8000001, ReportRule("change", deadband=0.1), True),
        (200.0, 201.0, ReportRule("change", deadband=0.5, percent=True), False),
        (200.0, 201.1, ReportRule("change", deadband=0.5, percent=True), True),
        (2**63, 2**63 + 2, ReportRule("change", deadband=1.0), True),
        (2**63, 2**63 + 1, ReportRule("change", deadband=1.0), False),
        (math.nan, math.nan, ReportRule("change"), False),
        (1.0, math.nan, ReportRule("change", deadband=9.0), True),
        (math.inf, 5.0, ReportRule("change", deadband=9.0, percent=True), True),
        (False, True, ReportRule("change", deadband=9.0), True),
        ("a", "b", ReportRule("change", deadband=9.0), True),
        (0, 0.0, ReportRule("change"), False),
    ],
)
def test_a_change_is_more_than_the_deadband(before: object, now: object, rule: ReportRule, changed: bool) -> None:
    assert rule.is_change(before, now) is changed


def committer_of(folder: Path, **options: object) -> Committer:
    return Committer(StoreWriter(folder, now=at(-1)), now=lambda: at(100), interval=0.001, **options)  # type: ignore[arg-type]


def stored(folder: Path) -> list[tuple[float, object]]:
    found = Store(folder).read("pump-1/speed", since=0)
    return [((sample.time - at(0)) / 1e9, sample.value) for sample in found if sample.value is not None]


def add_one_by_one(committer: Committer, *reads: tuple[float, float]) -> None:
    for second, value in reads:
        committer.add(read_of(PUMP, second, value))
        assert committer.flush()


def test_a_value_that_stays_makes_no_commit_and_is_shown_as_read_now(tmp_path: Path) -> None:
    committer, last = committer_of(tmp_path, rules={KEY: ReportRule("change", deadband=1.0)}), LastValues()
    committer.subscribe(last.update)
    add_one_by_one(committer, (0, 5.0), (1, 5.5), (2, 6.0), (3, 6.5), (4, 6.5))
    status = committer.status()
    assert last.last(*KEY) == (6.5, 0, at(4))
    assert (status.samples, status.passed_over, status.waiting) == (2, 3, 0)
    assert status.commits == 2
    committer.close()
    assert stored(tmp_path) == [(0, 5.0), (3, 6.5)]


def test_a_value_within_the_deadband_is_shown_as_it_is_in_the_store(tmp_path: Path) -> None:
    committer, last = committer_of(tmp_path, rules={KEY: ReportRule("change", deadband=1.0)}), LastValues()
    committer.subscribe(last.update)
    add_one_by_one(committer, (0, 5.0), (1, 5.5))
    assert last.last(*KEY) == (5.0, 0, at(1))
    committer.close()


def test_the_first_sample_after_a_start_and_after_the_file_was_read_again_is_kept(tmp_path: Path) -> None:
    for start in (0, 10):
        committer = committer_of(tmp_path, rules=CHANGE)
        add_one_by_one(committer, (start, 5.0), (start + 1, 5.0))
        committer.describe([], CHANGE)
        add_one_by_one(committer, (start + 2, 5.0), (start + 3, 5.0))
        committer.describe([], {})
        add_one_by_one(committer, (start + 4, 5.0), (start + 5, 5.0))
        committer.close()
    assert [second for second, _ in stored(tmp_path)] == [0, 2, 4, 5, 10, 12, 14, 15]


def test_what_was_lost_on_a_full_disk_decides_nothing() -> None:
    kept = KeptSamples(CHANGE)
    kept.committed(kept.choose([read_of(PUMP, 0, 5.0)]))
    kept.choose([read_of(PUMP, 1, 6.0)])  # the commit failed, and the sample was dropped
    assert kept.choose([read_of(PUMP, 2, 5.0)]).passed_over == 1
    assert kept.choose([read_of(PUMP, 2, 5.0)], [Gap(at(1), at(1) + 1, Reason.LOST, 1)]).passed_over == 0


def test_an_accumulator_goes_on_from_a_sample_that_was_not_kept(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, rules={KEY: ReportRule("change", deadband=100.0)})
    for second in range(3):
        batch = SampleBatch(PUMP, at(second), 5, (float(second),), 0, (CounterState("speed", second, second + 1),))
        committer.add(batch)
        assert committer.flush()
    committer.close()
    with StoreWriter(tmp_path, now=at(10)) as writer:
        assert counters_by_device(writer.manifest) == {"pump-1": [CounterState("speed", 2, 3)]}
    assert [second for second, _ in stored(tmp_path)] == [0]
