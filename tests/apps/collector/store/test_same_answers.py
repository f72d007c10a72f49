"""One store, four ways to read it: SQLite alone, Parquet by pyarrow, Parquet by DuckDB, and a model of what it holds.

Random commits of several points: late ones, ones that replace others, at edges of buckets, numbers that no float holds.
"""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import pytest
from collected import NOON, SECOND, at

from busway.apps.collector.sample_clock import ClockCorrection
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch
from busway.apps.collector.store import sealed_reader, store_reader
from busway.apps.collector.store.store_reader import Store
from busway.apps.collector.store.writer import StoreOptions, StoreWriter

pytest.importorskip("pyarrow")
pytest.importorskip("duckdb", minversion="2.0")

GROUPS = (PointGroup("d", ("a", "b")), PointGroup("d", ("b", "c")), PointGroup("e", ("a", "state")))
BUCKET = 100
VALUES: tuple[Callable[[Random], Any], ...] = (
    lambda chance: chance.randrange(-9, 9) / 4,
    lambda chance: chance.choice((2**53 + 1, -(2**63), 2**63 - 1, 2**64 - 1, 2**63, 0)),
    lambda chance: chance.choice((1e-300, -1e300, 0.1, -0.0, 5e-324)),
    lambda chance: chance.choice(("", "text", "1.5", "'; --", "ä\u2028")),
    lambda chance: None,
)


def value_of(point: str, chance: Random) -> Any:
    """A state for a point that has states, else a number, a text or nothing."""
    return chance.choice((True, False)) if point == "state" else chance.choice(VALUES)(chance)


@dataclass
class Model:
    """What a store holds, by device, point and time."""

    rows: dict[tuple[str, str, int], tuple[Any, int]] = field(default_factory=dict)

    def take(self, batch: SampleBatch, shift: int) -> None:
        for point, value, reason in zip(batch.points, batch.values, batch.reason_column(), strict=True):
            reason = 0 if reason == Reason.CLOCK else reason
            self.rows[batch.device, point, batch.time + shift] = value, reason


def filled_at_random(folder: Path, chance: Random, *, seals: bool, shift: int) -> Model:
    model, made = Model(), list[SampleBatch]()
    usual = int(Reason.CLOCK) if shift else 0
    with StoreWriter(folder, StoreOptions(seals=seals), now=at(0), clock_is_right=not shift) as writer:
        for number in range(120):
            group = chance.choice(GROUPS)
            second = number * 10 - chance.choice((0, 0, 0, 0, 0.5, 700, 1000))
            time = max(at(1), at(second)) + chance.choice((0, 0, 1, -1))
            if made and chance.random() < 0.1:
                time, group = (old := chance.choice(made)).time, old.group  # replaces
            values = [value_of(point, chance) for point in group.points]
            reasons = [
                int(Reason.TIMEOUT) if value is None else chance.choice((usual, usual, int(Reason.OUT_OF_RANGE)))
                for value in values
            ]
            batch = SampleBatch(group, time, chance.randrange(9), values, reasons)
            made.append(batch)
            writer.commit([batch], [], at(number * 10))
            model.take(batch, shift)
            if number in (50, 90):
                writer.roll()
                writer.seal_closed()
        if shift:
            writer.begin_mending(ClockCorrection(shift, at(0), at(1300)), writer.newest_commit)
            while writer.mend_next():
                pass
        writer.roll()
        if seals:
            assert writer.seal_closed() > 0
            assert {part.kind for part in writer.manifest.parts()} == {"sealed"}
    return model


def same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return one == other or math.isclose(one, other, rel_tol=1e-12, abs_tol=1e-12)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize(("seed", "shift"), [(0, 0), (1, -3600 * SECOND)])
def test_all_ways_to_read_a_store_give_the_same_rows_and_buckets(
    seed: int, shift: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = filled_at_random(tmp_path / "segments", Random(seed), seals=False, shift=shift)
    assert model == filled_at_random(tmp_path / "sealed", Random(seed), seals=True, shift=shift)
    begin = NOON + shift
    windows = [(begin, begin + 3000 * SECOND), (begin + 333 * SECOND, begin + 800 * SECOND)]
    for points, asked in (("*", windows), ("d/b", windows[:1])):
        for since, until in asked:
            answers, buckets = list[Any](), list[Any]()
            for folder, many in (("segments", False), ("sealed", False), ("sealed", True)):
                for module in (sealed_reader, store_reader):
                    monkeypatch.setattr(module, "reads_many", lambda many=many: many)
                store = Store(tmp_path / folder)
                table = store.read(points, since=since, until=until)
                rows = zip(table.device, table.point, table.time, table.value, table.reason, strict=True)
                answers.append(sorted(rows, key=lambda row: row[:3]))
                table_of = store.read(points, since=since, until=until, bucket=BUCKET)
                columns = (table_of.device, table_of.point, table_of.time, table_of.minimum, table_of.maximum)
                more = (table_of.mean, table_of.count, table_of.samples, table_of.reason)
                buckets.append(sorted(zip(*columns, *more, strict=True), key=lambda row: row[:3]))
            wanted = [
                (*key, value, reason)
                for key, (value, reason) in sorted(model.rows.items())
                if since <= key[2] < until and points in ("*", "/".join(key[:2]))
            ]
            for found in answers:
                assert [row[:3] for row in found] == [row[:3] for row in wanted]
                for one, other in zip(found, wanted, strict=True):
                    assert one[3:] == other[3:], other
                    assert isinstance(one[3], str) is isinstance(other[3], str)
            for found in buckets[1:]:
                assert len(found) == len(buckets[0])
                for one, other in zip(found, buckets[0], strict=True):
                    assert all(map(same, one, other)), (one, other)
            check_buckets(buckets[0], wanted)


def check_buckets(found: list[Any], rows: list[Any]) -> None:
    by_bucket: dict[tuple[str, str, int], list[tuple[Any, int]]] = defaultdict(list)
    for device, point, time, value, reason in rows:
        by_bucket[device, point, time // (BUCKET * SECOND) * BUCKET * SECOND].append((value, reason))
    assert {row[:3] for row in found if row[7]} == by_bucket.keys()
    for row in found:
        if not row[7]:
            continue
        numbers = [value for value, reason in by_bucket[row[:3]] if not isinstance(value, str | None) and reason < 16]
        assert (row[6], row[7]) == (len(numbers), len(by_bucket[row[:3]]))
        assert row[8] == max(reason for _, reason in by_bucket[row[:3]])
        if numbers:
            assert (row[3], row[4]) == (float(min(numbers)), float(max(numbers)))
            assert row[5] == pytest.approx(
                math.fsum(map(float, numbers)) / len(numbers),
                rel=1e-9,
                abs=1e-9 * max(abs(float(each)) for each in numbers),
            )
