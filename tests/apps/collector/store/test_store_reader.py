"""Questions to a store: points, times, buckets, gaps; open, closed and sealed parts as one."""

from collections import defaultdict
from collections.abc import Iterator
from datetime import UTC, datetime
from math import inf
from pathlib import Path
from random import Random
from time import time_ns

import pytest
from collected import NOON, PUMP, SECOND, at, filled, meter_read, read_of

import busway
from busway.apps.collector.samples import Gap, PointGroup, Reason, SampleBatch, StateInterval
from busway.apps.collector.store.committed_samples import CommitReader
from busway.apps.collector.store.manifest import StorePart
from busway.apps.collector.store.selection import moment, span
from busway.apps.collector.store.store_reader import Store, TimePiece, pieces_of
from busway.apps.collector.store.writer import StoreOptions, StoreWriter
from busway.errors import InvalidRequest, MissingExtra

pytest.importorskip("pyarrow")


def test_store_is_public_and_the_library_does_not_load_it() -> None:
    assert busway.Store is Store


def test_points_are_named_by_patterns(tmp_path: Path) -> None:
    with filled(tmp_path, 1) as writer:
        writer.commit([read_of(PUMP, 2, 9)], [], at(2))
        store = busway.Store(tmp_path)
        assert len(store.read()) == 4
        assert store.read("meter-*/v*").point == ["voltage"]
        assert store.read("pump-1").point == ["speed"]
        assert sorted(store.read(["pump-1", "meter-7/state"]).point) == ["speed", "state"]
        with pytest.raises(InvalidRequest, match="'meter-8' names no point of this store"):
            store.read("meter-8")


def test_a_name_with_brackets_means_its_point_and_no_other(tmp_path: Path) -> None:
    names = ("t[1]", "t1", "q*", "qq")
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PointGroup(device, names), 1, 1, 2, 3, 4) for device in ("hall[1]", "hall1")], [], at(1))
        store = Store(tmp_path)
        for name, number in zip(names, (1, 2, 3, 4), strict=True):
            for device in ("hall[1]", "hall1"):
                table = store.read(f"{device}/{name}")
                assert (table.device, table.point, table.value) == ([device], [name], [number])
        assert "hall[1]" in store.read("hall[1]").device
        assert store.read("hall1/t[*").point == ["t[1]"]


def test_times_are_spans_iso_texts_datetimes_and_nanoseconds() -> None:
    assert moment("1h", NOON) == NOON - 3600 * SECOND
    assert moment("250ms", NOON) == NOON - SECOND // 4
    assert moment("2027-01-15T08:00:00Z", 0) == NOON
    assert moment("2027-01-15 09:00+01:00", 0) == NOON
    assert moment(datetime(2027, 1, 15, 8, 0, 0, 1, tzinfo=UTC), 0) == NOON + 1000
    assert moment(5, NOON) == 5
    for wrong in ("yesterday", "1x", "", "2027-13-01"):
        with pytest.raises(InvalidRequest, match="is no time"):
            moment(wrong, NOON)
    assert (span("10s"), span(0.5)) == (10 * SECOND, SECOND // 2)
    for length in ("0s", "fast", 0.0, "400d"):
        with pytest.raises(InvalidRequest, match="a bucket is"):
            span(length)


def test_since_is_part_of_the_answer_and_until_is_not(tmp_path: Path) -> None:
    with filled(tmp_path, 5):
        table = busway.Store(tmp_path).read("meter-7/current", since=at(1), until=at(3))
        assert table.value == [1.0, 2.0]


def many(tmp_path: Path, seed: int) -> tuple[StoreWriter, dict[tuple[str, int], float]]:
    """A store of random samples in parts of all kinds that overlap, and what it holds by point and time."""
    random = Random(seed)
    writer = StoreWriter(tmp_path, StoreOptions(), now=at(0))
    held: dict[tuple[str, int], float] = {}
    group = PointGroup("d", ("a", "b"))
    for number in range(120):
        when = number * 20 - random.choice((0, 0, 0, 1500))
        values = (random.randrange(100) / 4, float(random.randrange(9)))
        writer.commit([read_of(group, when, *values)], [], at(number * 20))
        held["a", at(when)], held["b", at(when)] = values
        if number in (40, 80):
            writer.roll()
            writer.seal_closed()
        if number == 100:
            writer.roll()
    return writer, held


@pytest.mark.parametrize("seed", range(4))
def test_parts_of_all_kinds_that_overlap_are_read_as_one(tmp_path: Path, seed: int) -> None:
    writer, held = many(tmp_path, seed)
    with writer:
        assert {part.kind for part in writer.manifest.parts()} == {"open", "closed", "sealed"}
        table = Store(tmp_path).read()
        assert {(s.point, s.time): s.value for s in table} == held
        assert table.time == sorted(table.time)
        assert len(table) == len(held)


@pytest.mark.parametrize("seed", range(4))
def test_buckets_are_those_of_the_samples(tmp_path: Path, seed: int) -> None:
    writer, held = many(tmp_path, seed)
    wanted: dict[tuple[str, int], list[float]] = defaultdict(list)
    for (point, time), value in held.items():
        wanted[point, time // (100 * SECOND)].append(value)
    with writer:
        table = Store(tmp_path).read("d", bucket="100s")
    found = zip(table.point, table.time, table.minimum, table.maximum, table.mean, table.count, strict=True)
    by_key = {(point, time // (100 * SECOND)): rest for point, time, *rest in found}
    assert by_key.keys() == wanted.keys()
    for key, values in wanted.items():
        low, high, mean, count = by_key[key]
        assert (low, high, count) == (min(values), max(values), len(values))
        assert mean == pytest.approx(sum(values) / len(values))


@pytest.mark.parametrize("kind", ["open", "sealed"])
def test_a_bucket_leaves_out_bad_values_and_texts_and_keeps_the_worst_reason(tmp_path: Path, kind: str) -> None:
    group = PointGroup("d", ("number", "text"))
    with StoreWriter(tmp_path, now=NOON) as writer:
        reads = [
            read_of(group, 1, 5, "x"),
            read_of(group, 2, 7.5, "y", reasons=(Reason.HELD, 0)),
            read_of(group, 3, None, None, reasons=Reason.TIMEOUT),
        ]
        writer.commit(reads, [], at(4))
        if kind == "sealed":
            writer.roll()
            writer.seal_closed()
        table = Store(tmp_path).read(bucket=60)
    assert table.point == ["number", "text"]
    assert (table.minimum, table.maximum, table.mean) == ([5.0, None], [7.5, None], [6.25, None])
    assert (table.count, table.samples, table.reason) == ([2, 0], [3, 3], [Reason.TIMEOUT] * 2)


def test_buckets_say_why_a_point_was_not_read_in_them_or_in_a_part_of_them(tmp_path: Path) -> None:
    filled(tmp_path, 2).close(at(1.5))
    with filled(tmp_path, 2, first=5) as writer:
        writer.commit([], [StateInterval("meter-7", at(7), at(9), Reason.MAINTENANCE)], at(9))
        table = Store(tmp_path).read("meter-7/voltage", bucket=1, until=at(9))
    assert [(time - NOON) // SECOND for time in table.time] == list(range(9))
    assert table.samples == [1, 1, 0, 0, 0, 1, 1, 0, 0]
    assert table.reason == [0, *[Reason.STOPPED] * 4, 0, 0, *[Reason.MAINTENANCE] * 2], "it stopped at 1.5 s"
    assert table.mean[1] == 231.0
    assert table.mean[2] is None


@pytest.mark.parametrize("until", [None, "9999-12-31T23:59:59", datetime.max, 2**70])
def test_what_has_not_ended_yet_makes_no_buckets_of_a_time_that_is_to_come(
    tmp_path: Path, until: str | datetime | int | None
) -> None:
    now = time_ns()
    with StoreWriter(tmp_path, now=now - 10 * SECOND) as writer:
        writer.commit([SampleBatch(PUMP, now - 9 * SECOND, 0, (1.0,), 0)], [], now - 9 * SECOND)
        writer.commit([], [StateInterval("pump-1", now - 5 * SECOND, None, Reason.MAINTENANCE)], now)
        table = Store(tmp_path).read("pump-1", bucket="10s", until=until)
        assert table.time
        assert max(table.time) <= time_ns()
        assert len(Store(tmp_path).read("pump-1", bucket="10s", since="9998-01-01", until=until)) == 0


@pytest.mark.parametrize("kind", ["open", "sealed"])
@pytest.mark.parametrize("until", ["9999-12-31T23:59:59-12:00", datetime.max, 2**70])
def test_a_period_may_be_longer_than_a_store_can_name(tmp_path: Path, kind: str, until: str | datetime | int) -> None:
    with filled(tmp_path, 3) as writer:
        if kind == "sealed":
            writer.roll()
            writer.seal_closed()
        store, since = Store(tmp_path), datetime.min
        assert len(store.read("meter-7/voltage", since=since, until=until)) == 3
        assert len(store.read("meter-7/voltage", since=since, until=until, bucket=60)) == 1
        assert store.alarms(since=since, until=until) == []


@pytest.mark.parametrize("bucket", [None, 60])
def test_a_period_that_ends_before_it_begins_is_refused(tmp_path: Path, bucket: int | None) -> None:
    filled(tmp_path, 2).close(at(2))
    with pytest.raises(InvalidRequest, match="the end of the period, '2h', is not after its begin, '1h'"):
        Store(tmp_path).read(since="1h", until="2h", bucket=bucket)


def test_a_gap_of_all_devices_is_told_to_each_point(tmp_path: Path) -> None:
    with filled(tmp_path, 1) as writer:
        writer.commit([], [Gap(at(2), at(3), Reason.LOST, lost=12)], at(3))
        table = Store(tmp_path).read("meter-7/voltage")
        assert table.gaps == [Gap(at(2), at(3), Reason.LOST, lost=12)]
        assert table.value == [230.0, None]


def test_a_reader_follows_a_part_that_is_sealed_while_it_reads(tmp_path: Path) -> None:
    with filled(tmp_path, 25, step=60.0) as writer:
        pieces = Store(tmp_path).pieces("meter-7/voltage")
        values = next(pieces).value
        assert writer.seal_closed() == 2
        for table in pieces:
            values += table.value
        assert values == [230.0 + number for number in range(25)]


@pytest.mark.parametrize("bucket", [None, 1.0])
def test_a_point_that_comes_while_a_store_is_read_is_not_in_the_result(
    tmp_path: Path, bucket: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with filled(tmp_path, 2) as writer:
        store, pieces = Store(tmp_path), Store._pieces

        def with_a_new_point(self: Store, low: int, high: int, most: int) -> Iterator[TimePiece]:
            for piece in pieces(self, low, high, most):
                writer.commit([read_of(PUMP, 0.5, 9)], [], at(2))
                yield piece

        monkeypatch.setattr(Store, "_pieces", with_a_new_point)
        table = store.read(bucket=bucket, until=at(9)) if bucket else store.read(until=at(9))
        assert set(table.device) == {"meter-7"}
        assert len(table) == 6


@pytest.mark.parametrize("kind", ["open", "sealed"])
def test_the_mean_of_both_infinities_is_no_number_and_spoils_no_other_bucket(tmp_path: Path, kind: str) -> None:
    with StoreWriter(tmp_path, now=NOON) as writer:
        writer.commit([read_of(PUMP, *each) for each in ((1, inf), (2, -inf), (11, inf), (21, 5.0))], [], at(30))
        if kind == "sealed":
            writer.roll()
            writer.seal_closed()
        table = Store(tmp_path).read(bucket=10, until=at(40))
    assert list(map(str, table.mean)) == ["nan", "inf", "5.0"]
    assert (table.minimum, table.maximum, table.count) == ([-inf, inf, 5.0], [inf, inf, 5.0], [2, 1, 1])


def test_pieces_are_small_and_cover_each_nanosecond_once() -> None:
    def part(number: int, low: int, high: int, rows: int) -> StorePart:
        return StorePart(number, number, f"{number}", "closed", low, high, 1, 1, high, rows, 1)

    parts = [part(1, 0, 999, 1_000_000), part(2, 500, 1999, 10), part(3, 5000, 5000, 1)]
    pieces = list(pieces_of(parts, 100, 6000, 200_000))
    covered = [moment for piece in pieces for moment in range(piece.low, piece.high)]
    assert covered == [*range(100, 2000), 5000]
    assert {tuple(p.id for p in piece.parts) for piece in pieces} == {(1,), (1, 2), (2,), (3,)}
    assert sum(len(piece.parts) == 2 for piece in pieces) == 3, "half a million rows are three pieces"


def test_tables_become_arrow_and_frames_where_those_are_installed(tmp_path: Path) -> None:
    with filled(tmp_path, 2) as writer:
        writer.commit([SampleBatch(PUMP, at(3), 7, (None,), Reason.TIMEOUT)], [], at(3))
        store = Store(tmp_path)
    arrow = store.read().to_arrow()
    assert arrow.num_rows == 7
    assert str(arrow.schema.field("time").type) == "timestamp[ns, tz=UTC]"
    assert arrow.column("reason").to_pylist()[-1] == "timeout"
    assert arrow.column("text").to_pylist().count("on") == 2
    assert store.read("meter-7", bucket=60).to_arrow().column("count").to_pylist() == [2, 0, 2]
    for method, package in (("to_pandas", "pandas"), ("to_polars", "polars")):
        try:
            __import__(package)
        except ImportError:
            with pytest.raises(MissingExtra, match=package):
                getattr(store.read(), method)()
        else:
            assert len(getattr(store.read(), method)()) == 7


def test_integers_that_no_float_holds_keep_their_digits_as_text_in_columns(tmp_path: Path) -> None:
    with StoreWriter(tmp_path, now=at(0)) as writer:
        for second, value in enumerate((2**53, 2**53 + 1, -(2**63) + 1, 2**64 - 1, 1.5, True)):
            writer.commit([SampleBatch(PUMP, at(second), 7, (value,))], [], at(second))
        table = Store(tmp_path).read()
    digits = ["9007199254740993", "-9223372036854775807", "18446744073709551615"]
    assert table.columns()["text"] == [None, *digits, None, None]
    assert table.to_arrow().column("text").to_pylist() == [None, *digits, None, None]


def test_a_sealed_part_names_its_points_for_other_programs(tmp_path: Path) -> None:
    import pyarrow.parquet as pq

    with filled(tmp_path, 3) as writer:
        writer.roll()
        writer.seal_closed()
        (part,) = [part for part in writer.manifest.parts() if part.kind == "sealed"]
    table = pq.read_table(tmp_path / "segments" / part.file)
    assert table["device"].to_pylist() == ["meter-7"] * 9
    assert table["name"].to_pylist() == ["voltage"] * 3 + ["current"] * 3 + ["state"] * 3
    assert table["time"].cast("int64").to_pylist() == [at(0), at(1), at(2)] * 3, "sorted by point and time"
    assert meter_read(0).points == ("voltage", "current", "state")


def test_a_segment_that_is_listed_and_not_yet_made_holds_nothing_and_reading_makes_no_file(tmp_path: Path) -> None:
    with filled(tmp_path, 2) as writer:
        part = writer.manifest.add_segment()
        path = tmp_path / "segments" / part.file
        assert len(Store(tmp_path).read()) == 6
        assert not path.exists()
        path.touch()  # what SQLite has made before its first transaction
        assert len(Store(tmp_path).read()) == 6
        assert Store(tmp_path).read(bucket=60).samples == [2, 2, 2]
        reader = CommitReader(tmp_path, writer.manifest)
        found = reader.read(0, 100)
        assert found is not None
        assert len(found.samples) == 6
