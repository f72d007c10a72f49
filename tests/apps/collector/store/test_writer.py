"""A store is written and read again: keys, kinds of values, segments, late rows, names, gaps, retention, the lock."""

import contextlib
import errno
import math
import os
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from collected import METER, NOON, PUMP, SECOND, at, filled, meter_read, read_of

from busway.apps.collector.samples import (
    Gap,
    PointDescription,
    PointGroup,
    Quality,
    Reason,
    Sample,
    StateInterval,
    exception_reason,
)
from busway.apps.collector.store import manifest, segment
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.folder import SEGMENTS, half_of_disk
from busway.apps.collector.store.manifest import StorePart
from busway.apps.collector.store.retention import Retention, parts_to_drop
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter
from busway.errors import ConfigError

SLOT = 600


def kinds(writer: StoreWriter) -> list[str]:
    return [part.kind for part in writer.manifest.parts()]


def test_what_was_committed_is_read_while_the_store_is_open(tmp_path: Path) -> None:
    with filled(tmp_path, 3):
        table = Store(tmp_path).read("meter-7/*")
        assert len(table) == 9
        assert [sample for sample in table if sample.point == "voltage"] == [
            Sample("meter-7", "voltage", at(number), 5_000_000, 230.0 + number) for number in range(3)
        ]


def test_every_kind_of_value_comes_back_as_it_was(tmp_path: Path) -> None:
    values = [True, False, 0, -1, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), 0.5, math.inf, -0.0, "", "on", "ä\x00b", 1e300]
    group = PointGroup("d", tuple(f"p{number:02}" for number in range(len(values))))
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(group, 1, *values)], [], at(1))
        for _ in ("open", "closed", "sealed"):
            found = Store(tmp_path).read("d").value
            assert found == values
            assert [type(value) for value in found] == [type(value) for value in values]
            writer.roll()
            writer.seal_closed()
        assert kinds(writer) == ["sealed"]


def test_numbers_of_a_point_that_becomes_a_state_stay_what_they_were(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 5)], [], at(1))
        writer.describe_points([PointDescription("pump-1", "speed", is_state=True)])
        writer.commit([read_of(PUMP, 2, True), read_of(PUMP, 3, False)], [], at(3))
        found = Store(tmp_path).read("pump-1").value
        assert list(map(repr, found)) == ["5", "True", "False"]
        commits = CommitReader(tmp_path, writer.manifest).read(0, 10)
        assert commits is not None
        assert [each.value for each in commits.samples] == found, "sinks get the same"


def test_a_nan_stays_a_nan_and_a_bad_value_stays_absent(tmp_path: Path) -> None:
    group = PointGroup("d", ("nan", "bad"))
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(group, 1, math.nan, None, reasons=(0, exception_reason(2)))], [], at(1))
        table = Store(tmp_path).read()
    assert table.value[1] is None or table.value[0] is None
    by_point = {sample.point: sample for sample in table}
    assert isinstance(by_point["nan"].value, float)
    assert math.isnan(by_point["nan"].value)
    assert by_point["bad"].value is None
    assert by_point["bad"].quality is Quality.BAD


def test_a_value_that_no_store_can_keep_is_a_bad_sample_and_spoils_no_other(tmp_path: Path) -> None:
    group = PointGroup("d", ("huge", "list", "fine"))
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(group, 1, 2**64, (True, False), 7)], [], at(1))  # type: ignore[arg-type]
        by_point = {sample.point: sample for sample in Store(tmp_path).read()}
    assert (by_point["huge"].value, by_point["huge"].reason) == (None, Reason.CONFIGURATION)
    assert by_point["list"].reason == Reason.CONFIGURATION
    assert (by_point["fine"].value, by_point["fine"].reason) == (7, 0)


def test_the_same_key_again_replaces_the_sample(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 10)], [], at(1))
        writer.commit([read_of(PUMP, 1, 11)], [], at(2))
        assert Store(tmp_path).read().value == [11]


def test_commit_numbers_rise_also_over_a_start(tmp_path: Path) -> None:
    writer = filled(tmp_path, 2)
    last = writer.commit([], [], at(5)).number
    writer.close(at(6))
    with StoreWriter(tmp_path, now=at(7)) as again:
        assert again.commit([], [], at(8)).number > last


def test_samples_of_a_segment_are_in_the_order_of_time_and_then_of_the_point(tmp_path: Path) -> None:
    """By point first, SQLite writes an eighth as many: each commit touches a page of each point."""
    names = ("c", "a", "b")
    with StoreWriter(tmp_path, now=NOON) as writer:
        for number in (3, 1, 2):
            writer.commit([read_of(PointGroup("d", names), number, 1, 2, 3)], [], at(number))
        assert writer._segment is not None
        with contextlib.closing(sqlite3.connect(writer._segment.path)) as database:
            columns = database.execute("SELECT name FROM pragma_table_info('samples') WHERE pk ORDER BY pk").fetchall()
            stored = database.execute("SELECT time, point FROM samples NOT INDEXED").fetchall()
    assert columns == [("time",), ("point",)]
    assert len(stored) == 9
    assert stored == sorted(stored), "the table is its own index: what is scanned lies in this order"


def test_a_segment_ends_above_256_mb_where_no_other_size_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        for number, size in enumerate((0, 256 * 1024 * 1024, 256 * 1024 * 1024 + 1)):
            monkeypatch.setattr(segment, "size_of", lambda path, size=size: size)
            writer.commit([read_of(PUMP, number, 10)], [], at(number))
            assert kinds(writer) == (["open"] if number < 2 else ["closed", "open"])


@pytest.mark.parametrize("sealed", [False, True])
def test_a_segment_ends_after_ten_minutes_and_nothing_is_lost_at_the_seam(tmp_path: Path, sealed: bool) -> None:
    if sealed:
        pytest.importorskip("pyarrow")
    with filled(tmp_path, 25, step=60.0) as writer:
        assert kinds(writer) == ["closed", "closed", "open"]
        assert writer.seal_closed() == (2 if sealed else writer_seals())
        table = Store(tmp_path).read("meter-7/voltage")
        assert table.time == [at(number * 60) for number in range(25)]
        assert table.value == [230.0 + number for number in range(25)]


def writer_seals() -> int:
    """How many of two segments are sealed here."""
    from busway.apps.collector.store.sealing import can_seal

    return 2 if can_seal() else 0


def test_a_segment_ends_when_it_is_large(tmp_path: Path) -> None:
    with filled(tmp_path, 5, options=StoreOptions(segment_size=1)) as writer:
        assert kinds(writer).count("closed") == 5
        assert len(Store(tmp_path).read()) == 15


def test_without_pyarrow_segments_stay_sqlite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busway.apps.collector.store.writer.can_seal", lambda: False)
    with filled(tmp_path, 25, step=60.0) as writer:
        assert writer.seal_closed() == 0
        assert kinds(writer) == ["closed", "closed", "open"]
        assert len(Store(tmp_path).read("meter-7/voltage")) == 25


def test_late_rows_become_parts_of_their_own_and_are_merged_by_key(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 1), read_of(PUMP, 2, 2)], [], at(2))
        writer.roll()
        writer.seal_closed()
        late = [read_of(PUMP, 2, 20), read_of(PUMP, 3, 30), read_of(PUMP, 2000, 9), read_of(PUMP, 700, 7)]
        writer.commit(late, [], at(2000))
        writer.roll()
        writer.seal_closed()
        files = sorted(part.file for part in writer.manifest.parts())
        assert [file for file in files if "late" in file] == [
            f"00000002-late-{NOON // SECOND // SLOT}.parquet",
            f"00000002-late-{NOON // SECOND // SLOT + 1}.parquet",
        ]
        assert Store(tmp_path).read().value == [1, 20, 30, 7, 9]


def test_a_point_with_a_new_name_keeps_its_history_and_answers_to_both(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 10)], [], at(1))
        writer.describe_points([PointDescription("pump-1", "rpm", "1/min", was="speed")])
        writer.commit([read_of(PointGroup("pump-1", ("rpm",)), 2, 11)], [], at(2))
        store = Store(tmp_path)
        assert store.read("pump-1/rpm").value == [10, 11]
        assert store.read("pump-1/speed").value == [10, 11]
        assert [(point.name, point.unit_of_measure) for point in store.points()] == [("pump-1/rpm", "1/min")]


def test_the_time_between_two_runs_is_a_gap_that_says_whether_the_end_was_meant(tmp_path: Path) -> None:
    filled(tmp_path, 2).close(at(5))
    killed = StoreWriter(tmp_path, now=at(100))
    killed.commit([meter_read(100)], [], at(100.1))
    killed.__exit__()  # the process ends without a word
    with StoreWriter(tmp_path, now=at(200)):
        gaps = Store(tmp_path).read().gaps
    assert gaps == [Gap(at(1.1), at(100), Reason.STOPPED), Gap(at(100.1), at(200), Reason.KILLED)]


def test_an_interval_that_was_open_at_a_crash_ends_with_the_last_commit(tmp_path: Path) -> None:
    killed = filled(tmp_path, 1)
    killed.commit([], [StateInterval("pump-1", at(2), None, Reason.SUSPENDED)], at(3))
    killed.commit([read_of(PUMP, 2, None, reasons=Reason.TIMEOUT)], [], at(4))
    killed.__exit__()
    with StoreWriter(tmp_path, now=at(50)):
        assert Store(tmp_path).read("pump-1").intervals == [StateInterval("pump-1", at(2), at(4), Reason.SUSPENDED)]


@pytest.mark.parametrize("sealed", [False, True])
def test_an_interval_is_a_sample_without_a_value_for_each_point_at_its_begin(tmp_path: Path, sealed: bool) -> None:
    if sealed:
        pytest.importorskip("pyarrow")
    with filled(tmp_path, 2) as writer:
        writer.commit([], [StateInterval("meter-7", at(3), None, Reason.SUSPENDED)], at(3))
        writer.commit([], [StateInterval("meter-7", at(3), at(8), Reason.SUSPENDED)], at(8))
        writer.commit([meter_read(9, 9)], [], at(9))
        if sealed:
            writer.roll()
            writer.seal_closed()
        table = Store(tmp_path).read("meter-7/voltage")
        assert [(sample.time, sample.value, sample.reason) for sample in table] == [
            (at(0), 230.0, 0),
            (at(1), 231.0, 0),
            (at(3), None, Reason.SUSPENDED),
            (at(9), 239.0, 0),
        ]
        assert table.intervals == [StateInterval("meter-7", at(3), at(8), Reason.SUSPENDED)]
        from_five = Store(tmp_path).read("meter-7/voltage", since=at(5))
        assert from_five.time == [at(5), at(9)], "what lasts when the question begins is told at its begin"


def test_retention_drops_by_age_and_by_size_and_never_the_open_part(tmp_path: Path) -> None:
    options = StoreOptions(seals=False, retention=Retention(age=1500))
    with filled(tmp_path, 50, options=options, step=60.0) as writer:
        assert kinds(writer) == ["closed"] * 4 + ["open"]
        dropped = writer.apply_retention(at(3000))
        assert [part.high for part in dropped] == [at(9 * 60), at(19 * 60)]
        assert Store(tmp_path).read("meter-7/voltage").time[0] == at(20 * 60)
        names = {path.name.partition(".")[0] for path in (tmp_path / SEGMENTS).iterdir()}
        assert names == {"00000003", "00000004", "00000005"}
    with filled(
        tmp_path, 5, options=StoreOptions(seals=False, retention=Retention(size=1_000_000)), first=50
    ) as writer:
        assert writer.apply_retention(at(3000)) == []


def test_an_interval_ends_where_its_end_is_in_a_segment_that_was_deleted_before_it_was_sealed(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, StoreOptions(retention=Retention(age=600)), now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 1)], [StateInterval("pump-1", at(2), None, Reason.MAINTENANCE)], at(2))
        writer.roll()
        writer.seal_closed()
        writer.commit([read_of(PUMP, 700, 2)], [StateInterval("pump-1", at(2), at(650), Reason.MAINTENANCE)], at(700))
        writer.roll()
        writer.commit([read_of(PUMP, 3000, 3)], [], at(3000))
        assert len(writer.apply_retention(at(3001))) == 2
        assert Store(tmp_path).read().intervals == []


@pytest.mark.parametrize("age", [600, None])
def test_retention_deletes_what_was_replaced_before_what_replaced_it(tmp_path: Path, age: float | None) -> None:
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, 5, 1), read_of(PUMP, 599, 2)], [], at(599))
        writer.commit([read_of(PUMP, 5, 9), read_of(PUMP, 1300, 3)], [], at(1300))
        writer.roll()
        writer.seal_closed()
        if age is None:  # by size
            parts = [replace(part, bytes=1_000_000) for part in writer.manifest.parts()]
            assert [part.segment for part in parts_to_drop(parts, Retention(size=2_000_000), at(1400))] == [1]
            return
        writer.keep(Retention(age=age))
        for now, left in ((650, [9, 2, 3]), (1190, [9, 2, 3]), (1200, [3])):
            writer.apply_retention(at(now))
            assert Store(tmp_path).read().value == left


def test_retention_leaves_no_begin_of_an_interval_whose_end_it_deletes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    with StoreWriter(tmp_path, StoreOptions(retention=Retention(age=600)), now=NOON) as writer:
        writer.commit([read_of(PUMP, 1, 1)], [StateInterval("pump-1", at(2), None, Reason.MAINTENANCE)], at(2))
        writer.commit([read_of(PUMP, 11, 2)], [StateInterval("pump-1", at(2), at(10), Reason.MAINTENANCE)], at(11))
        writer.commit([read_of(PUMP, 3000, 3)], [], at(3000))
        writer.seal_closed()
        assert len(writer.apply_retention(at(3001))) == 1
        table = Store(tmp_path).read()
        assert (table.value, table.intervals) == ([3], [])
        assert Store(tmp_path).read(bucket=60, until=at(3060)).reason == [0]
    with StoreWriter(tmp_path, now=at(3100)):
        assert Store(tmp_path).read().intervals == [], "nor does the next start give it an end of its own"


@pytest.mark.parametrize(("size", "left"), [(3.0, 3), (2.5, 2), (2.0, 2), (1.9, 1), (1.0, 1)])
def test_retention_by_size_drops_the_oldest_parts_until_the_rest_fits_and_never_the_open_one(
    size: float, left: int
) -> None:
    parts = [
        StorePart(
            number, number, f"{number}", kind, at(number), at(number + 1), number, number, at(number), 9, 1_000_000
        )
        for number, kind in [(1, "sealed"), (3, "open"), (2, "closed")]
    ]
    dropped = parts_to_drop(parts, Retention(size=int(size * 1_000_000)), at(1000))
    assert [part.id for part in dropped] == [1, 2][: 3 - left]


def test_without_a_limit_a_store_takes_half_of_its_disk(tmp_path: Path) -> None:
    assert half_of_disk(tmp_path / "not" / "there") == shutil.disk_usage(tmp_path).total // 2


def test_a_second_collector_is_refused_with_the_pid_of_the_first(tmp_path: Path) -> None:
    with filled(tmp_path, 1), pytest.raises(ConfigError, match=f"process {os.getpid()} collects into this store"):
        StoreWriter(tmp_path, now=NOON)
    StoreWriter(tmp_path, now=NOON).close(NOON)
    program = f"""
from busway.apps.collector.store.writer import StoreWriter
import sys, time
writer = StoreWriter({str(tmp_path)!r}, now=0)
print("open", flush=True)
sys.stdin.read()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == b"open\n"
        with pytest.raises(ConfigError, match=f"process {first.pid} collects"):
            StoreWriter(tmp_path, now=NOON)
        first.kill()
    StoreWriter(tmp_path, now=NOON).close(NOON)


def test_a_full_disk_undoes_the_commit_and_is_over_when_there_is_room(tmp_path: Path) -> None:
    group = PointGroup("d", tuple(f"p{number}" for number in range(500)))
    with filled(tmp_path, 1) as writer:
        writer.limit_pages(1)
        with pytest.raises(sqlite3.OperationalError, match="full"):
            writer.commit([read_of(group, second, *range(500)) for second in range(20)], [], at(20))
        assert len(Store(tmp_path).read("meter-7")) == 3
        commit = writer.commit([read_of(group, 21, *range(500))], [], at(21))
        assert len(commit.batches) == 1
        assert len(Store(tmp_path).read("d")) == 500


def test_a_store_that_cannot_be_opened_because_the_disk_is_full_is_not_called_unreadable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object) -> sqlite3.Connection:
        raise sqlite3.OperationalError("disk I/O error")  # what SQLite says where its -shm file has no room

    monkeypatch.setattr(manifest, "open_database", no_room)
    with pytest.raises(ConfigError, match="the store cannot be written: disk I/O error"):
        StoreWriter(tmp_path, now=NOON)


def test_the_lock_of_a_store_holds_where_a_full_disk_takes_no_number_of_its_holder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "pwrite", no_room)
        with StoreWriter(tmp_path, now=NOON), pytest.raises(ConfigError, match="another process collects"):
            StoreWriter(tmp_path, now=NOON)
    StoreWriter(tmp_path, now=NOON).close(NOON)


def test_the_log_stays_bounded_while_a_reader_holds_a_snapshot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment, "LOG_LIMIT", 500_000)
    monkeypatch.setattr(segment, "LOG_STUCK", 1_000_000)
    group = PointGroup("d", tuple(f"p{number}" for number in range(120)))
    with filled(tmp_path, 1) as writer:
        open_part = writer.manifest.parts()[-1]
        reader = sqlite3.connect(tmp_path / SEGMENTS / open_part.file, isolation_level=None)
        reader.execute("BEGIN")
        assert reader.execute("SELECT count(*) FROM samples").fetchone() == (3,)
        most = 0
        for round_number in range(50):
            reads = [read_of(group, 1 + round_number + part / 20, *map(float, range(120))) for part in range(20)]
            writer.commit(reads, [], at(1 + round_number))
            most = max(most, writer.log_size)
        assert 500_000 < most < 1_500_000
        assert len(writer.manifest.parts()) == 2, "the writer goes on in one more segment, not in one for each commit"
        assert reader.execute("SELECT count(*) FROM samples").fetchone() == (3,)
        reader.close()
        assert Store(tmp_path).read("d", bucket=1.0).samples == [20] * 50 * 120


def test_another_process_that_reads_after_a_sync_takes_the_log_from_no_writer(tmp_path: Path) -> None:
    """The last connection of all processes removes the log: who has closed the file by itself has lost its lock."""
    reads = f"import busway; print(len(busway.Store({str(tmp_path)!r}).read()))"
    with filled(tmp_path, 3) as writer:
        writer.sync()
        (log,) = (tmp_path / SEGMENTS).glob("*-wal")
        before = log.stat().st_ino
        read = subprocess.run([sys.executable, "-c", reads], capture_output=True, text=True, timeout=60, check=True)
        assert read.stdout == "9\n"
        assert log.stat().st_ino == before
        writer.commit([meter_read(10, 10)], [], at(10))
        assert len(Store(tmp_path).read()) == 12


def test_a_segment_whose_end_cannot_be_listed_goes_on_and_ends_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with filled(tmp_path, 3) as writer:
        with monkeypatch.context() as disk:
            disk.setattr(writer.manifest, "close_segment", full)
            with pytest.raises(sqlite3.OperationalError):
                writer.commit([meter_read(SLOT, 3)], [], at(SLOT))
        writer.commit([meter_read(SLOT, 3)], [], at(SLOT))
        assert kinds(writer) == ["open"]
        writer.commit([meter_read(SLOT + 1, 4)], [], at(SLOT + 1))
        assert kinds(writer) == ["closed", "open"]
        assert len(Store(tmp_path).read()) == 15


def test_after_a_clock_that_was_set_back_the_gap_begins_with_the_last_commit(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=at(0)) as writer:
        for moment in (3600, 10, 20):  # the clock was an hour ahead, and was set back
            writer.commit([meter_read(moment)], [], at(moment))
            writer.roll()
    with StoreWriter(tmp_path, now=at(50)):
        pass
    with StoreWriter(tmp_path, now=at(70)):
        pass
    gaps = [(gap.begin, gap.end, gap.reason) for gap in Store(tmp_path).read().gaps]
    assert gaps == [(at(20), at(50), Reason.KILLED), (at(50), at(70), Reason.KILLED)]


def test_a_store_of_a_later_format_is_refused(tmp_path: Path) -> None:
    with filled(tmp_path, 1) as writer:
        writer.manifest.set_fact("format", 99)
    with pytest.raises(ConfigError, match="format 99"):
        Store(tmp_path).read()
    with pytest.raises(ConfigError, match="there is no store"):
        Store(tmp_path / "nothing")


def test_the_group_of_points_of_the_meter_is_as_the_tests_expect() -> None:
    assert METER.points == ("voltage", "current", "state")


@pytest.mark.parametrize("sealed", [False, True])
def test_a_system_clock_that_is_stepped_by_an_hour_loses_nothing(tmp_path: Path, sealed: bool) -> None:
    if sealed:
        pytest.importorskip("pyarrow")
    numbers = []
    with StoreWriter(tmp_path, StoreOptions(seals=sealed), now=NOON) as writer:
        for step, clock in enumerate((0, 1, 3601, 3602, -3599, -3598, 2, 3)):
            numbers.append(writer.commit([read_of(PUMP, step, step)], [], at(clock)).number)
            writer.seal_closed()
        assert numbers == sorted(set(numbers))
        table = Store(tmp_path).read()
        assert table.value == list(range(8)), "samples have times of their own, which do not jump"
    with StoreWriter(tmp_path, now=at(10)):
        assert Store(tmp_path).read().gaps == [Gap(at(3), at(10), Reason.KILLED)], "from the last commit on"
