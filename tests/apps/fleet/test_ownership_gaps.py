"""Gaps of ownership at sinks: in any order of gap and samples the same gap remains, and no sample is in it."""

import itertools
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from random import Random
from typing import Any

import pytest
from foreign_servers import PostgresqlServer
from hypothesis import given
from hypothesis import strategies as st

from busway.apps.collector.samples import NANOSECONDS, Reason
from busway.apps.collector.sinks.postgresql import PostgresqlSink
from busway.apps.collector.store.committed_samples import CommittedSample
from busway.apps.fleet.chosen_samples import ChosenSamples
from busway.apps.fleet.epoch import Epoch
from busway.apps.fleet.ownership_gaps import OwnershipGap, true_begin
from busway.codes import Table
from busway.options.sinks import DeliveryOptions
from busway.points.point import Point

NOON = 1_800_000_000 * NANOSECONDS
POINTS = {
    (device, name): Point(name, Table.HOLDING_REGISTERS, 0, unit_of_measure="V")
    for device in ("meter", "pump")
    for name in ("power", "state")
}
Step = list[CommittedSample] | OwnershipGap


def at(seconds: float) -> int:
    return NOON + round(seconds * NANOSECONDS)


def sample(seconds: float, device: str = "meter", reason: int = 0, point: str = "power") -> CommittedSample:
    value = None if reason else seconds
    return CommittedSample(int(seconds), device, point, at(seconds), 0, value, reason, "V")


def gap(begin: float, end: float, number: int = 7, *devices: str) -> OwnershipGap:
    return OwnershipGap("hall", Epoch(1, number), number, devices or ("meter",), at(begin), at(end))


@given(st.lists(st.integers(0, 40)), st.integers(0, 40), st.integers(0, 40), st.randoms())
def test_a_gap_shrinks_to_the_same_time_in_whatever_order_its_samples_come(
    times: list[int], begin: int, end: int, chance: Random
) -> None:
    whole = true_begin(begin, end, times)
    chance.shuffle(times)
    one_by_one = begin
    for time in [*times, *times[:3]]:
        one_by_one = true_begin(one_by_one, end, [time])
    assert one_by_one == whole
    assert not [time for time in times if whole < time < end]


class Kept:
    """A sink without gaps of its own."""

    def __init__(self) -> None:
        self.samples: list[CommittedSample] = []

    async def open(self) -> None:
        pass

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        self.samples += samples

    async def close(self) -> None:
        pass


async def give(chosen: ChosenSamples, step: Step) -> None:
    """What a sink of the stream does with a message."""
    if not isinstance(step, OwnershipGap):
        await chosen.send(step)
    elif marks := await chosen.send_gap(step):
        await chosen.send(marks)


async def test_a_sink_without_gaps_gets_a_sample_without_a_value_for_each_point_after_the_last_one() -> None:
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(points=("meter/*",)), {}, POINTS)
    await give(chosen, [sample(8.0), sample(9.5), sample(7.0), sample(10.0, "pump")])
    await give(chosen, gap(9.0, 20.0, 7, "meter", "pump", "unknown"))
    await give(chosen, [sample(20.5)])
    marks = [each for each in kept.samples if each.reason]
    assert {(each.device, each.point, each.time, each.value, each.reason) for each in marks} == {
        ("meter", "power", at(9.5) + 1000, None, Reason.OWNERSHIP),
        ("meter", "state", at(9.5) + 1000, None, Reason.OWNERSHIP),
    }
    before = list(kept.samples)
    await give(chosen, gap(9.0, 20.0, 7, "meter", "pump", "unknown"))
    assert kept.samples[len(before) :] == marks, "what comes again is the same"


async def test_a_sink_that_knows_no_sample_of_the_gap_gets_its_begin_as_it_was_recorded() -> None:
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(), {}, POINTS)
    await give(chosen, gap(9.0, 20.0))
    await give(chosen, [sample(9.5)])
    late = sample(9.7, reason=Reason.OWNERSHIP)  # the former owner is back, and says when its ownership ended
    await give(chosen, [late])
    assert [each.time for each in kept.samples] == [at(9.0), at(9.0), at(9.5), at(9.7)]


@pytest.fixture(scope="module")
def database() -> Iterator[PostgresqlServer]:
    pytest.importorskip("asyncpg")
    with PostgresqlServer() as server:
        yield server


class Gaps:
    """A sink to PostgreSQL with tables of its own; it can be created again on these, as in another process."""

    def __init__(self, server: PostgresqlServer, number: int) -> None:
        self.server, self.number = server, number
        self.begin_anew()

    def begin_anew(self) -> None:
        self.sink = PostgresqlSink(
            self.server.url, password=self.server.PASSWORD, table=f"samples_{self.number}", gap_table=f"g_{self.number}"
        )
        self.chosen = ChosenSamples(self.sink, DeliveryOptions(), {}, POINTS)

    async def rows(self, query: str) -> list[Any]:
        return [tuple(row) for row in await self.sink._connection.fetch(query)]

    async def found(self) -> list[tuple[str, str, datetime, datetime]]:
        return await self.rows(f"SELECT device, epoch, begins, ends FROM g_{self.number} ORDER BY ends, device")


def moment(seconds: float) -> datetime:
    return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=NOON // NANOSECONDS + seconds)


async def test_a_database_has_one_gap_for_each_device_and_a_backlog_shrinks_it(database: PostgresqlServer) -> None:
    kept = Gaps(database, 0)
    await kept.chosen.open()
    await give(kept.chosen, [sample(8.0), sample(9.25), sample(9.5, reason=Reason.OWNERSHIP)])
    await give(kept.chosen, gap(9.0, 20.0, 7, "meter", "pump"))
    assert await kept.found() == [
        ("meter", "1.7", moment(9.25), moment(20)),
        ("pump", "1.7", moment(9), moment(20)),
    ]
    await give(kept.chosen, [sample(20.0), sample(11.5, point="state"), sample(11.0), sample(12.0, "pump")])
    await give(kept.chosen, [sample(15.0, reason=Reason.OWNERSHIP)])
    assert [row[2] for row in await kept.found()] == [moment(11.5), moment(12)]
    await kept.chosen.close()


async def test_in_whatever_order_gaps_and_backlogs_come_the_same_gaps_remain_without_a_sample_in_them(
    database: PostgresqlServer,
) -> None:
    for seed in range(25):
        chance = Random(seed)
        devices = ("meter", "pump")
        steps: list[Step] = []
        spans: list[OwnershipGap] = []
        time = 0.0
        for number in range(chance.randrange(1, 5)):  # owners that take the link one after the other
            times = sorted(time + chance.random() * 10 for _ in range(chance.randrange(12)))
            rows = [
                sample(round(each, 3), chance.choice(devices), point=chance.choice(("power", "state")))
                for each in times
            ]
            cuts = sorted(chance.randrange(len(rows) + 1) for _ in range(2))
            steps += [part for part in (rows[: cuts[0]], rows[cuts[0] : cuts[1]], rows[cuts[1] :]) if part]
            renewed = time + chance.random() * 10
            time += 10 + chance.random() * 10
            spans.append(gap(round(renewed, 3), round(time, 3), number, *devices))
        steps += spans
        every = [each for step in steps if not isinstance(step, OwnershipGap) for each in step]
        wanted = [
            (device, str(each.epoch), true_begin(each.begin, each.end, [s.time for s in every if s.device == device]))
            for each, device in itertools.product(spans, devices)
        ]
        order = steps + chance.sample(steps, chance.randrange(len(steps)))
        chance.shuffle(order)
        kept = Gaps(database, seed + 1)
        await kept.chosen.open()
        for step in order:
            if chance.random() < 0.2:  # the process of the sink is another one
                await kept.chosen.close()
                kept.begin_anew()
                await kept.chosen.open()
            await give(kept.chosen, step)
        found = await kept.found()
        assert [(device, epoch, begins) for device, epoch, begins, _ in found] == [
            (device, epoch, moment((begin - NOON) / NANOSECONDS)) for device, epoch, begin in wanted
        ], seed
        inside = (
            f"SELECT count(*) FROM g_{kept.number} g JOIN samples_{kept.number} s"
            " ON s.device = g.device AND s.time > g.begins AND s.time < g.ends"
        )
        assert await kept.rows(inside) == [(0,)], seed
        await kept.chosen.close()


async def test_a_table_gets_a_column_for_revisions_with_the_first_sample_that_has_one(
    database: PostgresqlServer,
) -> None:
    kept = Gaps(database, 100)
    await kept.chosen.open()
    await give(kept.chosen, [sample(1.0)])
    columns = "SELECT attname FROM pg_attribute WHERE attrelid = 'samples_100'::regclass AND attname = 'revision'"
    assert await kept.rows(columns) == []
    for _ in range(2):
        await give(kept.chosen, [sample(2.0)._replace(revision=3), sample(3.0)])
        await kept.chosen.close()
        kept.begin_anew()
        await kept.chosen.open()
    assert await kept.rows("SELECT value, revision FROM samples_100 ORDER BY time") == [(1, None), (2, 3), (3, None)]
    await kept.chosen.close()


async def test_a_table_of_another_user_gets_samples_without_their_revision(
    database: PostgresqlServer, caplog: pytest.LogCaptureFixture
) -> None:
    kept = Gaps(database, 101)
    await kept.chosen.open()
    await give(kept.chosen, [sample(1.0)])
    for statement in (
        "CREATE ROLE guest_101 LOGIN PASSWORD 'x9-guest'",
        "GRANT ALL ON SCHEMA public TO guest_101",
        "GRANT ALL ON samples_101 TO guest_101",
    ):
        await kept.sink._connection.execute(statement)
    sink = PostgresqlSink(database.url.replace("collector@", "guest_101@"), password="x9-guest", table="samples_101")
    await sink.open()
    for second in (2.0, 3.0):
        await sink.send([sample(second)._replace(revision=3)])
    await sink.close()
    assert await kept.rows("SELECT value FROM samples_101 ORDER BY time") == [(1,), (2,), (3,)]
    assert len([each for each in caplog.records if "no column for the revision" in each.message]) == 1
    await kept.chosen.close()


@pytest.mark.parametrize("newest", [8.9999999, 9.0, 9.0000005, 9.5])
async def test_the_mark_of_a_gap_never_has_the_time_of_a_sample(newest: float) -> None:
    """A receiver that finds a sample by device, point and time would have the mark in its place."""
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(points=("meter/*",)), {}, POINTS)
    last = sample(9.0)._replace(time=NOON + int(newest * 1e9))
    await give(chosen, [last])
    for _ in range(2):
        await give(chosen, gap(9.0, 20.0))
    marks = [each for each in kept.samples if each.reason]
    assert {each.time // 1000 for each in marks} == {max(at(9.0), last.time) // 1000 + 1}
    assert marks[:2] == marks[2:]


async def test_a_sample_long_before_or_after_a_gap_moves_no_mark() -> None:
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(points=("meter/power",)), {}, POINTS)
    await give(chosen, [sample(8.0)])
    await give(chosen, gap(9.0, 20.0, 7))
    await give(chosen, [sample(20.5)])
    await give(chosen, gap(9.0, 20.0, 8))
    assert [each.time for each in kept.samples if each.reason] == [at(9.0), at(9.0)]


async def test_a_gap_of_no_length_has_no_sample_in_it() -> None:
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(points=("meter/power",)), {}, POINTS)
    assert true_begin(at(9.0), at(9.0), [at(8.0), at(9.0), at(10.0)]) == at(9.0)
    assert true_begin(at(9.0), at(10.0), [at(10.0)]) == at(9.0), "a sample at the end of a gap is not in it"
    await give(chosen, [sample(9.0)])
    await give(chosen, gap(9.0, 9.0))
    assert [(each.time, bool(each.reason)) for each in kept.samples] == [(at(9.0), False), (at(9.0) + 1000, True)]


async def test_an_interval_that_an_owner_has_recorded_is_no_sample_that_moves_a_gap() -> None:
    kept = Kept()
    chosen = ChosenSamples(kept, DeliveryOptions(points=("meter/power",)), {}, POINTS)
    await give(chosen, [sample(9.5), sample(12.0, reason=Reason.OWNERSHIP)])
    await give(chosen, gap(9.0, 20.0))
    assert [each.time for each in kept.samples] == [at(9.5), at(12.0), at(9.5) + 1000]
