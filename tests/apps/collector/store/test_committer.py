"""The committer: told after the commit, patient with a full disk, counts what it drops."""

import sqlite3
import threading
from pathlib import Path
from typing import Any

import pytest
from collected import NOON, PUMP, at, meter_read, read_of
from waiting import wait_until

from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import Gap, PointDescription, PointGroup, Reason, StateInterval
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store import committer as committer_module
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.committer import INTERVAL, MOST_WAITING, SYNC, Committer
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import Commit, StoreWriter


def committer_of(folder: Path, *, interval: float = INTERVAL, most_waiting: int = MOST_WAITING) -> Committer:
    return Committer(
        StoreWriter(folder, now=NOON),
        now=lambda: at(100),
        interval=interval,
        most_waiting=most_waiting,
        retry=0.01,
    )


def test_a_subscriber_is_told_what_is_in_the_store_by_then(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, interval=0.01)
    seen: list[tuple[int, int]] = []
    told = threading.Event()

    def look(commit: Commit) -> None:
        seen.append((sum(map(len, commit.batches)), len(Store(tmp_path).read())))
        told.set()

    committer.subscribe(look)
    committer.add(meter_read(1))
    assert told.wait(10)
    committer.close()
    assert seen[0] == (3, 3)
    assert committer.status().samples == 3


@pytest.mark.alone
def test_a_sample_is_committed_within_a_quarter_of_a_second(tmp_path: Path) -> None:
    import time

    committer = committer_of(tmp_path)
    moments: list[float] = []
    told = threading.Event()

    def note(commit: Commit) -> None:
        moments.append(time.monotonic())
        told.set()

    committer.subscribe(note)
    added: list[float] = []
    for number in range(3):
        told.clear()
        added.append(time.monotonic())
        committer.add(meter_read(number))
        assert told.wait(10)
    committer.close()
    assert sorted(now - then for now, then in zip(moments, added, strict=False))[1] < 0.25


def test_a_subscriber_that_fails_stops_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    committer = committer_of(tmp_path, interval=0.0)

    def fail(commit: Commit) -> None:
        raise RuntimeError("no")

    committer.subscribe(fail)
    for number in range(3):
        committer.add(meter_read(number))
        assert committer.flush()
    committer.close()
    assert len(Store(tmp_path).read("meter-7/voltage")) == 3
    assert caplog.text.count("a subscriber of commits failed") == 1
    assert committer.status().subscriber_failures == 3


def test_a_flush_ends_also_where_something_is_queued_in_each_commit(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, interval=0.0)
    ends = threading.Event()

    def add_more(commit: Commit) -> None:
        if not ends.is_set():
            committer.add(meter_read(commit.number))

    committer.subscribe(add_more)
    committer.add(meter_read(1))
    committer.add_interval(StateInterval("meter-7", at(1), at(2), Reason.MAINTENANCE))
    flushed = committer.flush()
    ends.set()
    committer.close()
    assert flushed
    assert len(Store(tmp_path).read().intervals) == 1


def test_a_defect_of_the_store_is_told_in_the_status_and_ends_no_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    committer = committer_of(tmp_path, interval=0.0)
    commit_really = committer.writer.commit
    is_broken = threading.Event()
    is_broken.set()

    def commit(*arguments: Any) -> Commit:  # Any: those of `StoreWriter.commit`
        if is_broken.is_set():
            raise ZeroDivisionError("of the test")
        return commit_really(*arguments)

    monkeypatch.setattr(committer.writer, "commit", commit)
    committer.add(meter_read(1))
    wait_until(lambda: committer.status().error == "of the test")
    is_broken.clear()
    assert committer.flush()
    committer.close()
    assert len(Store(tmp_path).read("meter-7/voltage")) == 1
    assert "in an unexpected way" in caplog.text


def test_a_commit_tells_the_moment_before_the_disk_made_it_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moment, told = [100.0], list[Commit]()
    writer = StoreWriter(tmp_path, now=NOON)
    commit_really = writer.commit

    def commit(*arguments: Any) -> Commit:  # Any: those of `StoreWriter.commit`
        moment[0] += 4.0
        return commit_really(*arguments)

    monkeypatch.setattr(writer, "commit", commit)
    committer = Committer(writer, now=lambda: at(100), interval=0.0, clock=lambda: moment[0])
    values = LastValues(limits={("meter-7", "voltage"): 3.0}, moment=lambda: moment[0])
    committer.subscribe(values.update)
    committer.subscribe(told.append)
    committer.add(meter_read(100))
    assert committer.flush()
    committer.close()
    assert [(each.at, each.moment) for each in told] == [(at(100), 100.0)]
    assert values.last("meter-7", "voltage") == (230.0, Reason.HELD, at(100)), "the disk took longer than the limit"


@pytest.mark.parametrize("what", ["samples", "interval"])
def test_it_is_behind_once_something_waits_five_seconds_for_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    moment, is_full = [100.0], threading.Event()
    is_full.set()
    committer = Committer(
        StoreWriter(tmp_path, now=NOON), now=lambda: at(100), interval=0.0, retry=0.01, clock=lambda: moment[0]
    )
    commit_really = committer.writer.commit

    def commit(*arguments: Any) -> Commit:  # Any: those of `StoreWriter.commit`
        if is_full.is_set():
            raise OSError(28, "No space left on device")
        return commit_really(*arguments)

    monkeypatch.setattr(committer.writer, "commit", commit)
    assert not committer.is_behind
    if what == "samples":
        committer.add(meter_read(1))
    else:
        committer.add_interval(StateInterval("meter-7", at(1), None, Reason.SUSPENDED))
    wait_until(lambda: committer.status().error is not None)
    moment[0] += committer_module.BEHIND
    assert not committer.is_behind
    moment[0] += 0.1
    assert committer.is_behind
    is_full.clear()
    assert committer.flush()
    assert not committer.is_behind
    moment[0] += 3600.0
    assert not committer.is_behind, "nothing waits"
    committer.close()


def test_a_defect_while_times_are_mended_is_told_in_the_status_and_ends_no_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    committer = committer_of(tmp_path, interval=0.0)

    def mend_next() -> bool:
        raise ZeroDivisionError

    with monkeypatch.context() as patched:
        patched.setattr(committer.writer, "mend_next", mend_next)
        committer.mend(ClockCorrection(1))
        wait_until(lambda: committer.status().upkeep_error == "ZeroDivisionError")
    assert committer.flush()
    assert committer.status().upkeep_error is None
    committer.add(meter_read(1))
    assert committer.flush()
    committer.close()
    assert caplog.text.count("cannot be mended yet") == 1


def test_a_defect_of_upkeep_that_says_nothing_is_told_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(committer_module, "UPKEEP", 0.01)

    def seal_closed(writer: StoreWriter, most: int | None = None) -> int:
        raise AssertionError

    with monkeypatch.context() as patched:
        patched.setattr(StoreWriter, "seal_closed", seal_closed)
        committer = committer_of(tmp_path)
        wait_until(lambda: committer.status().upkeep_error == "AssertionError")
    committer.close()


def test_intervals_that_wait_for_a_full_disk_are_bounded_and_no_device_stays_silent_in_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(committer_module, "MOST_INTERVALS", 100)
    committer = committer_of(tmp_path, interval=0.0)
    committer.add_interval(StateInterval("meter-7", at(0), None, Reason.SUSPENDED))
    committer.add(meter_read(0))
    assert committer.flush()

    def commit(*arguments: object) -> Commit:
        raise OSError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(committer.writer, "commit", commit)
        committer.add_interval(StateInterval("meter-7", at(0), at(1), Reason.SUSPENDED))
        for second in range(2, 1000, 2):
            committer.add_interval(StateInterval("meter-7", at(second), None, Reason.SUSPENDED))
            committer.add_interval(StateInterval("meter-7", at(second), at(second + 1), Reason.SUSPENDED))
            committer.add_interval(StateInterval("meter-7", at(second + 1), at(second + 2), Reason.SKIPPED))
            assert len(committer._intervals) <= 101
        committer.add_interval(StateInterval("meter-7", at(1000), None, Reason.SUSPENDED))
    assert committer.flush()
    committer.close()
    table = Store(tmp_path).read("meter-7/*")
    (lost,) = [each for each in table.gaps if each.reason == Reason.LOST]
    assert (lost.begin, lost.lost) == (at(2), 0)
    silent = [each for each in table.intervals if each.reason == Reason.SUSPENDED]
    assert silent[0] == StateInterval("meter-7", at(0), at(1), Reason.SUSPENDED)
    assert [each.begin for each in silent if each.end is None] == [at(1000)]
    assert len(silent) < 60


def test_what_cannot_be_stored_at_the_end_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    committer = committer_of(tmp_path, interval=0.0)

    def commit(*arguments: object) -> Commit:
        raise OSError("the disk is full")

    monkeypatch.setattr(committer.writer, "commit", commit)
    committer.add(meter_read(0))
    committer.close(timeout=0.1)
    assert "3 samples are lost with the end of the collector" in caplog.text


def test_a_full_disk_is_told_and_survived_and_what_is_lost_is_a_gap_with_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    committer = committer_of(tmp_path, interval=0.0, most_waiting=30)
    committer.add(meter_read(0))
    assert committer.flush()
    full = threading.Event()
    full.set()

    def commit(*arguments: Any) -> Commit:  # Any: those of `StoreWriter.commit`
        if full.is_set():
            committer.writer._segment_for(at(100))
            committer.writer.limit_pages(1)
            batches = [read_of(PUMP, 1000 + number, "x" * 4000) for number in range(100)]
            return commit_really([*batches, *arguments[0]], *arguments[1:])
        return commit_really(*arguments)

    commit_really = committer.writer.commit
    monkeypatch.setattr(committer.writer, "commit", commit)
    for number in range(1, 21):
        committer.add(meter_read(number))
    assert not committer.flush(timeout=0.3)
    status = committer.status()
    assert "full" in (status.error or "")
    assert status.waiting == 30
    assert status.lost == 30
    full.clear()
    assert committer.flush()
    assert committer.status().error is None
    committer.close()
    table = Store(tmp_path).read("meter-7/current")
    assert table.gaps == [Gap(at(1), at(10) + 1, Reason.LOST, lost=30)]
    assert [sample.time for sample in table if sample.value is not None] == [at(0), *map(at, range(11, 21))]
    assert "cannot be written" in caplog.text
    assert "30 samples were lost" in caplog.text


@pytest.mark.parametrize("hangs", [True, False])
def test_only_so_many_alarm_events_wait_while_a_commit_hangs_and_all_are_stored_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hangs: bool
) -> None:
    monkeypatch.setattr(committer_module, "MOST_ALARMS", 3)
    moment, has_begun, goes_on = [100.0], threading.Event(), threading.Event()
    committer = Committer(StoreWriter(tmp_path, now=NOON), now=lambda: at(100), interval=0.0, clock=lambda: moment[0])
    commit_really = committer.writer.commit
    stored: list[int] = []

    def commit(*arguments: Any) -> Commit:  # Any: those of `StoreWriter.commit`
        has_begun.set()
        goes_on.wait(60)
        stored.extend(event.at for event in arguments[3])
        return commit_really(*arguments)

    monkeypatch.setattr(committer.writer, "commit", commit)
    committer.add(meter_read(1))
    assert has_begun.wait(60)
    if hangs:
        moment[0] += committer_module.BEHIND + 0.1
    for number in range(1, 6):
        committer.add(meter_read(number), [AlarmEvent("meter-7", "power", "H", AlarmEventKind.RAISED, at(number))])
    committer.add_alarms([AlarmEvent("meter-7", "power", "H", AlarmEventKind.CLEARED, at(6))])
    goes_on.set()
    assert committer.flush()
    committer.close()
    assert stored == [at(number) for number in range(4 if hangs else 1, 7)]


def test_intervals_are_committed_like_samples(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, interval=0.0)
    committer.add(read_of(PUMP, 1, 5))
    committer.add_interval(StateInterval("pump-1", at(2), None, Reason.SUSPENDED))
    assert committer.flush()
    committer.close()
    assert Store(tmp_path).read().intervals == [StateInterval("pump-1", at(2), None, Reason.SUSPENDED)]


class SyncedStore(StoreWriter):
    """A store that tells when its log is synced."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, now=NOON)
        self.is_synced = threading.Event()

    def sync(self) -> None:
        super().sync()
        self.is_synced.set()


def test_the_log_is_synced_in_time_where_nothing_more_is_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second commit comes just before the log is due: what waits for the next sample would wait for it twice."""
    monkeypatch.setattr("busway.apps.collector.store.committer.ALIVE", 600.0)
    writer, seconds = SyncedStore(tmp_path), [0.0]
    committer = Committer(writer, now=lambda: at(100), interval=0.0, clock=lambda: seconds[0])
    for passed in (0.0, SYNC - 0.1):
        seconds[0] = passed
        committer.add(read_of(PUMP, passed, 5))
        assert committer.flush()
    assert not writer.is_synced.is_set()
    seconds[0] = SYNC
    assert writer.is_synced.wait(60), "5 s after the first commit, by itself"
    committer.close()


class UnsyncedStore(StoreWriter):
    """A store on a disk that takes commits and never becomes durable."""

    def sync(self) -> None:
        raise OSError(28, "No space left on device")


def test_a_commit_that_cannot_be_made_durable_is_told_once_and_not_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busway.apps.collector.store.committer.SYNC", 0.05)
    committer = Committer(UnsyncedStore(tmp_path, now=NOON), now=lambda: at(100), interval=0.05, retry=0.01)
    told: list[Commit] = []
    committer.subscribe(told.append)
    for number in range(3):
        committer.add(meter_read(number))
        assert committer.flush()
    status = committer.status()
    assert [len(commit.batches) for commit in told if commit.batches] == [1, 1, 1]
    assert (status.samples, status.waiting, status.error) == (9, 0, None)
    assert "No space left" in str(status.upkeep_error)
    assert len(Store(tmp_path).read()) == 9


def test_a_commit_whose_log_cannot_be_moved_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.collector.store.segment.LOG_LIMIT", 0)
    writer = StoreWriter(tmp_path, now=NOON)
    assert writer._segment is not None
    denied = []

    def authorize(action: int, name: str | None, *_: object) -> int:
        if action == sqlite3.SQLITE_PRAGMA and name == "wal_checkpoint":
            denied.append(name)
            return sqlite3.SQLITE_DENY
        return sqlite3.SQLITE_OK

    writer._segment._database.set_authorizer(authorize)
    committer = Committer(writer, now=lambda: at(100), interval=0.0, retry=0.01)
    told: list[Commit] = []
    committer.subscribe(told.append)
    committer.add(meter_read(1))
    assert committer.flush()
    assert denied
    assert [len(commit.batches) for commit in told if commit.batches] == [1]
    assert CommitReader(tmp_path, writer.manifest).count(0, told[-1].number) == 3
    assert committer.status().error is None
    writer._segment._database.set_authorizer(None)
    committer.close()


def test_samples_go_by_the_names_that_held_when_they_were_added(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, interval=0.0)
    committer.add(read_of(PUMP, 1, 1.0))
    committer.describe([PointDescription("pump-1", "rpm", was="speed")])
    committer.add(read_of(PointGroup("pump-1", ("rpm", "speed")), 2, 2.0, 20.0))
    committer.close()
    store = Store(tmp_path)
    assert store.read("pump-1/rpm").value == [1.0, 2.0]
    assert store.read("pump-1/speed").value == [20.0]


def test_names_change_in_their_place_after_a_disk_was_full(tmp_path: Path) -> None:
    committer = committer_of(tmp_path, interval=0.0)
    committer.writer.limit_pages(1)
    for number in range(400):
        committer.add(read_of(PUMP, number, "x" * 1000))
    committer.describe([PointDescription("pump-1", "rpm", was="speed")])
    committer.add(read_of(PointGroup("pump-1", ("rpm",)), 1000, 2.0))
    assert committer.flush(20)
    committer.close()
    assert len(Store(tmp_path).read("pump-1/rpm")) == 401
    assert [point.point for point in Store(tmp_path).points()] == ["rpm"]


def test_an_error_of_upkeep_is_over_with_the_first_segment_that_is_sealed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(committer_module, "UPKEEP", 0.001)
    writer = StoreWriter(tmp_path, now=NOON)
    told: list[str | None] = []
    is_made = threading.Event()

    def seal_closed(most: int | None = None) -> int:
        assert is_made.wait(60)
        told.append(committer.status().upkeep_error)
        if len(told) == 1:
            raise OSError("no room")
        return int(len(told) < 4)

    monkeypatch.setattr(writer, "seal_closed", seal_closed)
    committer = Committer(writer, now=lambda: NOON)
    is_made.set()
    wait_until(lambda: len(told) >= 4)
    committer.close()
    assert told[:4] == [None, "no room", None, None]
