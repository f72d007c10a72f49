"""Maintenance of a device: not polled, bad for that reason, one interval, over restarts; who and why is told."""

import asyncio
import json
import logging
from contextlib import AsyncExitStack
from pathlib import Path
from urllib.request import urlopen

import pytest
from waiting import until

import busway
from busway.apps.collector.configuration import load_collector
from busway.apps.collector.samples import (
    NANOSECONDS,
    Gap,
    PointGroup,
    Quality,
    Reason,
    SampleBatch,
    StateInterval,
    quality_of,
)
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.writer import Commit
from busway.server.server import Server

PUMP = '[[unit]]\nunit = 1\npoint = [{ name = "speed", address = "4x1" }, { name = "level", address = "4x2" }]\n'
GROUP = PointGroup("pump", ("speed", "level"))


def plant(folder: Path, url: str, more: str = "") -> Path:
    (folder / "pump.toml").write_text(PUMP)
    file = folder / "plant.toml"
    devices = "".join(
        f'[[device]]\nname = "{name}"\nlink = "a"\nunit = 1\nprofile = "pump.toml"\n' for name in ("pump", "other")
    )
    common = '[collector]\nstore = "data"\n[poll_class]\nall.period = 0.05\n'
    file.write_text(f'{common}[[link]]\nname = "a"\nurl = "{url}"\n{devices}{more}')
    return file


def served() -> Server:
    return busway.serve("tcp://127.0.0.1:0", units={1: busway.Device(holding_registers=10)})


def qualities(collector: busway.Collector) -> set[tuple[str, int]]:
    return {(device, reason) for device, _, _, reason, _ in collector.values.samples()}


async def test_maintenance_is_one_interval_over_restarts_and_a_file_that_is_read_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING, "busway.collector")
    bad = int(Reason.MAINTENANCE)
    async with served() as server:
        file = plant(tmp_path, server.endpoints[0])
        async with busway.collect(file) as collector:
            await until(lambda: qualities(collector) == {("pump", 0), ("other", 0)})
            collector.maintenance("pump", begins=True, by="anna", why="changes the bearing")
            await until(lambda: qualities(collector) == {("pump", bad), ("other", 0)})
            begin = collector.in_maintenance()["pump"].begin
            file.write_text(file.read_text().replace("0.05", "0.06"))
            await collector.reload(load_collector(file))
            await until(lambda: {each.name: each.reads for each in collector.status()}["other"] > 2)
            status = {each.name: each for each in collector.status()}
            assert (status["pump"].reads, status["pump"].state) == (0, "maintenance")
        async with busway.collect(file) as collector:
            await until(lambda: ("other", 0) in qualities(collector))
            row = collector.in_maintenance()["pump"]
            assert (row.begin, row.by, row.why) == (begin, "anna", "changes the bearing")
            assert collector.status()[0].state == "maintenance"
            await until(lambda: collector.values.reason_of("pump") == bad)
            collector.maintenance("pump", begins=False, by="otto", why="runs again")
            await until(lambda: qualities(collector) == {("pump", 0), ("other", 0)})
            assert collector.values.reason_of("pump") == 0
        table = busway.Store(tmp_path / "data").read("pump")
    (interval,) = [each for each in table.intervals if each.reason == bad]
    assert interval.begin == begin
    assert interval.end is not None
    inside = [sample for sample in table if interval.begin < sample.time < interval.end and sample.reason == bad]
    assert not inside, "the interval stands for the samples"
    said = [each.message for each in caplog.records if "maintenance" in each.message]
    assert said[0] == "device pump is in maintenance: changes the bearing, by anna"
    assert said[1].endswith("s: runs again, by otto; it began by anna: changes the bearing")
    lines = [json.loads(line) for line in (tmp_path / "data" / "audit.log").read_text().splitlines()]
    told = [(each["what"], each["by"], each["why"]) for each in lines if each["event"] == "maintenance"]
    assert told == [("begin", "anna", "changes the bearing"), ("end", "otto", "runs again")]


async def test_maintenance_ends_with_the_device_in_the_file(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, server.endpoints[0])
        async with busway.collect(file) as collector:
            collector.maintenance("pump", begins=True, by="anna", why="x")
            file.write_text(file.read_text().replace('name = "pump"', 'name = "new"'))
            await collector.reload(load_collector(file))
            assert dict(collector.in_maintenance()) == {}
        intervals = busway.Store(tmp_path / "data").read("*").intervals
        (interval,) = [each for each in intervals if each.reason == Reason.MAINTENANCE]
        assert interval.end is not None


async def test_a_device_that_died_has_no_good_last_value_and_is_not_shown_to_prometheus(tmp_path: Path) -> None:
    async with AsyncExitStack() as stack:
        server = await stack.enter_async_context(served())
        text = '[[sink]]\nname = "page"\nurl = "prometheus://127.0.0.1:0"\npoints = ["*/*"]\n'
        file = plant(tmp_path, server.endpoints[0], text)
        async with busway.collect(file) as collector:
            await until(lambda: qualities(collector) == {("pump", 0), ("other", 0)})
            assert "busway_point_value{" in await page_of(collector)
            await stack.aclose()
            await until(lambda: all(quality_of(reason) is Quality.BAD for _, reason in qualities(collector)), 30)
            assert "busway_point_value{" not in await page_of(collector)


async def page_of(collector: busway.Collector) -> str:
    loop = asyncio.get_running_loop()
    return await loop.run_in_executor(None, lambda: urlopen(collector.pages[0]).read().decode())


def commit(*told: SampleBatch | StateInterval | Gap) -> Commit:
    batches = [each for each in told if isinstance(each, SampleBatch)]
    return Commit(1, 0, batches, [each for each in told if not isinstance(each, SampleBatch)])


def reasons(values: LastValues) -> list[int]:
    return [reason for _, _, _, reason, _ in values.samples()]


def read(second: int, reason: int = 0) -> SampleBatch:
    return SampleBatch(GROUP, second * NANOSECONDS, 0, (1, 2), reason)


def test_last_values_are_bad_from_the_begin_of_an_interval_until_the_point_is_read_again() -> None:
    values = LastValues()
    values.update(commit(read(10)))
    assert reasons(values) == [0, 0]
    values.update(commit(StateInterval("pump", 11 * NANOSECONDS, 12 * NANOSECONDS, Reason.SKIPPED)))
    assert reasons(values) == [0, 0]
    values.update(commit(StateInterval("pump", 12 * NANOSECONDS, None, Reason.SUSPENDED)))
    assert reasons(values) == [Reason.SUSPENDED] * 2
    assert values.last("pump", "level") == (2, Reason.SUSPENDED, 10 * NANOSECONDS)
    alone = SampleBatch(PointGroup("pump", ("speed",)), 20 * NANOSECONDS, 0, (3,))
    values.update(commit(alone, StateInterval("pump", 12 * NANOSECONDS, 21 * NANOSECONDS, Reason.SUSPENDED)))
    assert reasons(values) == [Reason.SUSPENDED, 0], "the level was not read since"
    values.update(commit(read(22)))
    assert reasons(values) == [0, 0]


def test_a_bad_value_keeps_its_reason_while_a_device_is_suspended_but_not_in_maintenance() -> None:
    values = LastValues()
    values.update(commit(read(10, Reason.TIMEOUT), StateInterval("pump", 11 * NANOSECONDS, None, Reason.SUSPENDED)))
    assert reasons(values) == [Reason.TIMEOUT] * 2
    values.update(commit(StateInterval("pump", 12 * NANOSECONDS, None, Reason.MAINTENANCE)))
    assert reasons(values) == [Reason.MAINTENANCE] * 2
    assert (values.reason_of("pump"), values.reason_of("other")) == (Reason.MAINTENANCE, 0)
