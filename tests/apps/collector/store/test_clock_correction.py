"""Samples from before the wall clock was set: mended when it is, once, over crashes, and handed on with their time."""

import threading
from dataclasses import replace
from pathlib import Path

import pytest
from collected import METER, NOON, SECOND, at, meter_read
from deliveries import RecordingSink, delivery_to, run_until
from waiting import wait_until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.sample_clock import EARLIEST, ClockCorrection, SampleClock
from busway.apps.collector.samples import Gap, Reason, SampleBatch, StateInterval
from busway.apps.collector.sinks.delivery import CLOCK_WAIT
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.alarm_events import forget_old_alarms
from busway.apps.collector.store.check import check_store_files
from busway.apps.collector.store.committer import Committer
from busway.apps.collector.store.manifest import MaintenanceRow, Manifest
from busway.apps.collector.store.retention import Retention
from busway.apps.collector.store.segment import Segment
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

SHIFT = NOON - 100 * SECOND
"""The clock was set at `NOON`, when it showed 100 s after 1970."""
CORRECTION = ClockCorrection(SHIFT)


def early(second: float, *, is_right: bool = False) -> SampleBatch:
    """A read of the meter so many seconds after 1970, or after `NOON` less 100 s."""
    time = round(second * SECOND) + (SHIFT if is_right else 0)
    reasons = (0, int(Reason.TIMEOUT), 0) if is_right else (int(Reason.CLOCK), int(Reason.TIMEOUT), int(Reason.CLOCK))
    return SampleBatch(METER, time, 5, (second, None, "on"), reasons)


def written(folder: Path, options: StoreOptions | None = None) -> StoreWriter:
    """A store with three segments from before the clock was set, and one sample from after it."""
    writer = StoreWriter(folder, options, now=10 * SECOND)
    for second in range(11, 100):
        writer.commit([early(second)], [], second * SECOND)
        if second in (40, 70):
            writer.roll()
    raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, 50 * SECOND, 1.0)
    suspended = StateInterval("meter-7", 60 * SECOND, 61 * SECOND, Reason.SUSPENDED)
    writer.commit([], [suspended], 99 * SECOND, [raised])
    writer.commit([early(100.5, is_right=True)], [], at(1))
    return writer


def mend(writer: StoreWriter) -> None:
    while writer.mend_next():
        pass


def wanted() -> list[tuple[int, float, int]]:
    seconds = [*map(float, range(11, 100)), 100.5]
    return [(SHIFT + round(second * SECOND), second, 0) for second in seconds]


def voltages(folder: Path) -> list[tuple[int, object, int]]:
    table = Store(folder).read("meter-7/voltage")
    rows = zip(table.time, table.value, table.reason, strict=True)
    return [row for row in rows if row[1] is not None]


def test_nothing_waits_for_a_segment_that_is_being_sealed(tmp_path: Path) -> None:
    writer = written(tmp_path)
    writer.begin_mending(CORRECTION)
    found: list[bool] = []
    with writer._files:
        thread = threading.Thread(target=lambda: found.append(writer.mend_next()), daemon=True)
        thread.start()
        thread.join(10)
        assert found == [True]
    mend(writer)
    writer.close(at(2))
    assert voltages(tmp_path) == wanted()


def test_what_was_mended_is_durable_before_it_is_noted_as_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = written(tmp_path)
    writer.begin_mending(CORRECTION)
    assert writer._segment is not None
    order: list[str] = []
    monkeypatch.setattr(Segment, "mend", lambda segment, correction: order.append("mended"))
    monkeypatch.setattr(Segment, "sync", lambda segment: order.append("synced"))
    with monkeypatch.context() as patched:
        patched.setattr(Manifest, "set_fact", lambda manifest, name, value: order.append(f"{name} {value}"))
        mend(writer)
    assert order == ["mended", "synced", "awaits_clock None", "mend_from None"]
    writer.close(at(2))


def test_times_move_by_the_difference_and_are_good(tmp_path: Path) -> None:
    with written(tmp_path) as writer:
        assert voltages(tmp_path)[0] == (11 * SECOND, 11, Reason.CLOCK)
        writer.begin_mending(CORRECTION)
        mend(writer)
        assert voltages(tmp_path) == wanted()
        assert set(Store(tmp_path).read("meter-7/current").reason) == {Reason.TIMEOUT, Reason.SUSPENDED}
        assert [each.begin for each in Store(tmp_path).read("meter-7").intervals] == [SHIFT + 60 * SECOND]
        assert [each.at for each in Store(tmp_path).alarms()] == [SHIFT + 50 * SECOND]
        assert check_store_files(tmp_path) == []
        mend(writer)
        assert voltages(tmp_path) == wanted()


def test_a_crash_while_samples_are_mended_is_made_good_at_the_next_start(tmp_path: Path) -> None:
    for segments in range(4):
        folder = tmp_path / str(segments)
        with written(folder) as writer:
            writer.begin_mending(CORRECTION)
            for _ in range(segments):
                assert writer.mend_next()
        StoreWriter(folder, now=at(500)).close(at(500))
        assert voltages(folder) == wanted()
        gaps = [gap for gap in Store(folder).read().gaps if gap.end > at(10)]
        assert gaps == [Gap(at(1), at(500), Reason.KILLED)]


def test_nothing_is_sealed_or_dropped_for_its_age_before_it_is_mended(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    options = StoreOptions(retention=Retention(age=3600.0))
    with written(tmp_path, options) as writer:
        assert writer.apply_retention(at(1)) == []
        assert writer.seal_closed() == 0
        writer.begin_mending(CORRECTION)
        mend(writer)
        assert writer.seal_closed() == 3
        assert voltages(tmp_path) == wanted()


def test_the_gap_before_a_start_without_the_time_ends_where_that_start_was(tmp_path: Path) -> None:
    StoreWriter(tmp_path, now=NOON - 5000 * SECOND).close(NOON - 4000 * SECOND)
    with written(tmp_path) as writer:
        writer.begin_mending(CORRECTION)
        mend(writer)
        (gap,) = Store(tmp_path).read().gaps
        assert (gap.begin, gap.end) == (NOON - 5000 * SECOND, SHIFT + 10 * SECOND)


def test_samples_of_an_earlier_process_stay_as_they_are(tmp_path: Path) -> None:
    first = StoreWriter(tmp_path, now=3 * SECOND)
    first.commit([early(5)], [], 5 * SECOND)
    first.close(6 * SECOND)
    with written(tmp_path) as writer:
        writer.begin_mending(CORRECTION)
        mend(writer)
        assert voltages(tmp_path) == [(5 * SECOND, 5, Reason.CLOCK), *wanted()]


def test_the_committer_mends_what_was_added_before_the_clock_was_set_in_the_order_of_reading(tmp_path: Path) -> None:
    clock, now = SampleClock(0.0, 0), 0
    committer = Committer(StoreWriter(tmp_path, now=0), now=lambda: now, interval=0.001)
    for second in range(1, 200):
        now = clock.time_ns(float(second)) if second != 100 else NOON
        if second == 100:
            correction = clock.adjust(100.0, NOON)
            assert correction is not None
            assert correction.shift == SHIFT
            committer.mend(correction)
        reason = 0 if clock.is_right else int(Reason.CLOCK)
        committer.add(SampleBatch(METER, clock.time_ns(float(second)), 0, (float(second), 1, "on"), reason))
    assert committer.flush()
    committer.close()
    assert voltages(tmp_path) == [(SHIFT + second * SECOND, second, 0) for second in range(1, 200)]


def test_segments_without_samples_are_mended_too(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=10 * SECOND) as writer:
        writer.commit([], [StateInterval("meter-7", 20 * SECOND, 30 * SECOND, Reason.SUSPENDED)], 31 * SECOND)
        writer.roll()
        raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, 50 * SECOND, 1.0)
        writer.commit([], [], 51 * SECOND, [raised])
        writer.roll()
        assert writer.seal_closed() == 0
        writer.begin_mending(CORRECTION)
        mend(writer)
        assert [each.at for each in Store(tmp_path).alarms()] == [SHIFT + 50 * SECOND]
        mended = [(each.begin, each.end) for each in Store(tmp_path).read("meter-7").intervals]
    assert mended == [(SHIFT + 20 * SECOND, SHIFT + 30 * SECOND)]


@pytest.mark.parametrize("reason", [Reason.SUSPENDED, Reason.MAINTENANCE])
def test_an_interval_that_an_earlier_process_left_open_is_not_moved_by_the_clock_of_a_later_one(
    tmp_path: Path, reason: Reason
) -> None:
    first = StoreWriter(tmp_path, now=3 * SECOND)
    first.commit([early(5)], [StateInterval("meter-7", 7 * SECOND, None, reason)], 8 * SECOND)
    first.close(9 * SECOND)
    with written(tmp_path) as writer:
        writer.begin_mending(CORRECTION)
        mend(writer)
        left = [each for each in Store(tmp_path).read("meter-7").intervals if each.begin == 7 * SECOND]
        assert [(each.begin, each.end) for each in left] == [(7 * SECOND, 8 * SECOND)], "it ended when that process did"
        assert voltages(tmp_path)[1:] == wanted()


def test_maintenance_that_was_noted_without_the_time_moves_with_the_samples_or_begins_anew(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=10 * SECOND) as writer:
        writer.manifest.begin_maintenance(MaintenanceRow("meter-7", 20 * SECOND, "anna", "new sensor"))
        writer.begin_mending(CORRECTION)
        assert [row.begin for row in writer.manifest.maintenance()] == [SHIFT + 20 * SECOND]
        mend(writer)
        writer.manifest.begin_maintenance(MaintenanceRow("pump-1", 30 * SECOND, "anna", "new seal"))
    with StoreWriter(tmp_path, now=at(50)) as writer:
        begun = {row.device: row.begin for row in writer.manifest.maintenance()}
    assert begun == {"meter-7": SHIFT + 20 * SECOND, "pump-1": at(50)}


def test_the_gap_after_a_process_that_never_knew_the_time_begins_with_what_is_known(tmp_path: Path) -> None:
    StoreWriter(tmp_path, now=at(0)).close(at(10))
    with StoreWriter(tmp_path, now=100 * SECOND) as writer:
        writer.commit([early(101)], [], 101 * SECOND)
    with StoreWriter(tmp_path, now=20 * SECOND) as writer:  # the machine was started again
        writer.commit([early(21)], [], 21 * SECOND)
    StoreWriter(tmp_path, now=at(500)).close(at(500))
    gaps = [(gap.begin, gap.end) for gap in Store(tmp_path).read().gaps]
    assert all(begin <= end and (begin < EARLIEST) is (end < EARLIEST) for begin, end in gaps if begin != at(0)), gaps
    assert (at(0), at(500)) in gaps, gaps


def test_what_was_written_without_the_time_is_as_old_as_what_was_written_next(tmp_path: Path) -> None:
    options = StoreOptions(seals=False, retention=Retention(age=3600.0))
    with StoreWriter(tmp_path, options, now=10 * SECOND) as writer:
        raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, 12 * SECOND, 1.0)
        writer.commit([early(11)], [], 12 * SECOND, [raised, replace(raised, kind=AlarmEventKind.CLEARED)])
    with StoreWriter(tmp_path, options, now=at(0)) as writer:
        writer.commit([meter_read(1)], [], at(1))
        writer.roll()
        assert writer.apply_retention(at(3000)) == []
        assert len(Store(tmp_path).alarms()) == 2
        writer.commit([meter_read(4000)], [], at(4000))
        assert len(writer.apply_retention(at(4500))) == 2, "both are older than an hour by now"


def test_events_of_an_active_alarm_are_kept_and_those_of_its_earlier_ones_are_not(tmp_path: Path) -> None:
    raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, at(1), 1.0)
    with StoreWriter(tmp_path, now=at(0)) as writer:
        cleared = replace(raised, kind=AlarmEventKind.CLEARED, at=at(1))
        writer.commit([], [], at(2), [raised, cleared, raised])  # all at once
        writer.roll()
        assert forget_old_alarms(writer.manifest, at(100)) == 2
        assert [each.kind for each in Store(tmp_path).alarms()] == [AlarmEventKind.RAISED]


async def test_a_sink_gets_them_once_with_their_right_time(tmp_path: Path) -> None:
    with written(tmp_path) as writer:
        sink, waits = RecordingSink(), [0.0]
        delivery = delivery_to(sink, writer)
        delivery._clock._now = lambda: waits[0]
        for waits[0] in (0.0, 300.0, CLOCK_WAIT - 1):
            assert await delivery.step() is False
        assert sink.taken == []
        writer.begin_mending(CORRECTION)
        mend(writer)
        await run_until(delivery, lambda: voltage_times(sink) == [time for time, _, _ in wanted()])
        assert delivery.status().lost == 0


async def test_a_sink_does_not_wait_for_ever_where_the_clock_is_never_set(tmp_path: Path) -> None:
    with written(tmp_path) as writer:
        sink, seconds = RecordingSink(), [0.0]
        delivery = delivery_to(sink, writer)
        delivery._clock._now = lambda: seconds[0]
        assert await delivery.step() is False
        seconds[0] = CLOCK_WAIT + 1
        await run_until(delivery, lambda: len(voltage_times(sink)) == 90)
        assert voltage_times(sink)[0] == 11 * SECOND


def voltage_times(sink: RecordingSink) -> list[int]:
    return [sample.time for sample in sink.taken if sample.point == "voltage" and sample.value is not None]


@pytest.mark.parametrize("shift", [3600 * SECOND, -3600 * SECOND, 2 * SECOND, -2 * SECOND, 0])
def test_times_of_a_clock_that_was_a_little_wrong_move_once_over_crashes_and_later_ones_stay(
    tmp_path: Path, shift: int
) -> None:
    """Times overlap those that they become, and there is a sample each second: two could have one key for a moment."""

    def read(second: int, reason: int) -> SampleBatch:
        return SampleBatch(METER, at(second), 5, (float(second), None, "on"), (reason, int(Reason.TIMEOUT), reason))

    with StoreWriter(tmp_path, now=at(-50)) as earlier:
        earlier.commit([read(-50, int(Reason.CLOCK))], [], at(-50))
    writer = StoreWriter(tmp_path, now=at(0), clock_is_right=False)
    for second in range(1, 30):
        writer.commit([read(second, int(Reason.CLOCK))], [], at(second))
        if second in (10, 20):
            writer.roll()
    raised = AlarmEvent("meter-7", "voltage", "H", AlarmEventKind.RAISED, at(5), 1.0)
    writer.commit([], [StateInterval("meter-7", at(6), at(7), Reason.SUSPENDED)], at(29), [raised])
    last = writer.newest_commit
    right = SampleBatch(METER, at(30) + shift + 7, 5, (30.0, None, "on"), (0, int(Reason.TIMEOUT), 0))
    writer.commit([right], [], at(30) + shift)
    writer.seal_closed()
    assert [part.kind for part in writer.manifest.parts()].count("closed") >= 2, "those of this process"
    writer.begin_mending(ClockCorrection(shift, at(0), at(30)), last)
    assert writer.mend_next()
    with writer:  # as a crash: it is not closed, and goes on with the next start
        pass
    with StoreWriter(tmp_path, now=at(9000)) as later:
        assert later.manifest.correction() is None
        later.begin_mending(ClockCorrection(0, at(0), at(1)), last)
    wanted = [(at(-50), -50.0, int(Reason.CLOCK)), (at(30) + shift + 7, 30.0, 0)]
    wanted += [(at(second) + shift, float(second), 0) for second in range(1, 30)]
    assert sorted(voltages(tmp_path)) == sorted(wanted)
    store = Store(tmp_path)
    assert [each.begin for each in store.read("meter-7").intervals] == [at(6) + shift]
    assert [each.at for each in store.alarms()] == [at(5) + shift]


def test_the_committer_never_mixes_times_to_be_corrected_with_right_ones(tmp_path: Path) -> None:
    """The clock was ahead by an hour: right times that come later are among the wrong ones."""
    hour = 3600 * SECOND
    clock, now = SampleClock(0.0, at(0) + hour, is_known=False), at(0) + hour
    committer = Committer(StoreWriter(tmp_path, now=now, clock_is_right=False), now=lambda: now, interval=0.001)
    for second in range(1, 400):
        if second == 200:
            correction = clock.adjust(200.0, at(200), is_known=True)
            assert correction == ClockCorrection(-hour, at(0) + hour, at(200) + hour + 1)
            committer.mend(correction)
        now = clock.time_ns(float(second))
        reason = 0 if clock.is_right else int(Reason.CLOCK)
        committer.add(SampleBatch(METER, now, 0, (float(second), 1, "on"), reason))
        if second % 50 == 0:
            committer.add_interval(StateInterval("meter-7", now, now + SECOND, Reason.SKIPPED))
    assert committer.flush()
    committer.close()
    assert voltages(tmp_path) == [(at(second), second, 0) for second in range(1, 400)]
    found = [each.begin for each in Store(tmp_path).read("meter-7").intervals]
    assert found == [at(second) for second in range(50, 400, 50)]


def test_a_sample_whose_right_time_equals_a_wrong_one_that_is_not_mended_yet_replaces_nothing(tmp_path: Path) -> None:
    clock, now, values = SampleClock(0.0, NOON, is_known=False), NOON, LastValues()
    writer = StoreWriter(tmp_path, now=NOON, clock_is_right=False)
    committer = Committer(writer, now=lambda: now, interval=0.001)
    committer.subscribe(values.update)

    def read(second: float, reason: int) -> None:
        nonlocal now
        now = clock.time_ns(second)
        committer.add(SampleBatch(METER, now, 0, (second, 1, "on"), reason))
        assert committer.flush() or reason == 0

    for second in range(1, 20):
        read(float(second), int(Reason.CLOCK))
        if second == 10:
            writer.roll()
    with writer._files:  # as if a segment was being sealed, so that mending waits
        correction = clock.adjust(20.0, at(15), is_known=True)
        assert correction is not None
        committer.mend(correction)
        for second in range(20, 30):
            committer.add(SampleBatch(METER, clock.time_ns(float(second)), 0, (float(second), 1, "on"), 0))
        wait_until(lambda: (values.last("meter-7", "voltage") or (0, 0, 0))[0] == 29.0)
        assert values.last("meter-7", "voltage") == (29.0, 0, at(24)), "later than what it replaces by its right time"
    assert committer.flush()
    committer.close()
    assert voltages(tmp_path) == [(at(second - 5), float(second), 0) for second in range(1, 30)]


def test_a_process_that_completes_the_correction_of_another_waits_for_its_own(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, now=at(0), clock_is_right=False) as writer:
        writer.commit([meter_read(1)], [], at(1))
        writer.begin_mending(ClockCorrection(3600 * SECOND, at(0), at(2)))
    with StoreWriter(tmp_path, now=at(0), clock_is_right=False) as writer:
        writer.commit([SampleBatch(METER, at(3), 0, (3.0, 1, "on"), int(Reason.CLOCK))], [], at(3))
        last = writer.newest_commit
        writer.roll()
        assert writer.seal_closed() == 1, "what the other process wrote"
        writer.begin_mending(ClockCorrection(7200 * SECOND, at(0), at(4)), last)
        mend(writer)
        assert writer.seal_closed() == 1
    times = [(time, value, reason) for time, value, reason in voltages(tmp_path)]
    assert times == [(at(3601), 230.0, 0), (at(7203), 3.0, 0)]


@pytest.mark.parametrize("shift", [2 * 3600 * SECOND, 3700 * SECOND])
def test_the_gap_before_a_process_whose_clock_was_behind_keeps_its_begin(tmp_path: Path, shift: int) -> None:
    """The clock showed the end of the process before as still to come, and reached it before it was set."""
    with StoreWriter(tmp_path, now=at(-10)) as writer:
        writer.commit([meter_read(0)], [], at(0))
    with StoreWriter(tmp_path, now=at(-3600), clock_is_right=False) as writer:
        for second in (-3500, 100):
            writer.commit([SampleBatch(METER, at(second), 0, (1.0, 1, "on"), int(Reason.CLOCK))], [], at(second))
        writer.begin_mending(ClockCorrection(shift, at(-3600), at(101)), writer.newest_commit)
        mend(writer)
        assert [(gap.begin, gap.end) for gap in Store(tmp_path).read().gaps] == [(at(0), at(-3600) + shift)]
