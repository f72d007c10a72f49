"""Alarms of a collector that runs: from a register to the journal, over a kill, over a file that is read again."""

import asyncio
import contextlib
import os
import sys
from collections.abc import AsyncIterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import alarm_worker
import pytest
from waiting import until

import busway
from busway.apps.collector.alarms.collector_alarms import CollectorAlarms
from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind, AlarmState
from busway.apps.collector.configuration import load_collector
from busway.apps.collector.sample_clock import EARLIEST, NANOSECONDS, ClockCorrection
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch
from busway.codes import Table
from busway.errors import InvalidRequest
from busway.points import Point
from busway.points.point_rules import AlarmRule
from busway.server.server import Server

LIMIT = '{ kind = "H", limit = 80, hysteresis = 5, acknowledge = true }'


def profile(limits: str = LIMIT, name: str = "temperature", more: str = "") -> str:
    return f"""\
[[unit]]
unit = 1
point = [
    {{ name = "{name}", address = "4x1", unit_of_measure = "°C", alarm = [{limits}]{more} }},
    {{ name = "pressure", address = "4x2", alarm = [{{ kind = "LL", limit = 10 }}] }},
    {{ name = "energy", address = "4x3", rollover = true }},
]
"""


def plant(folder: Path, url: str, points: str | None = None, more: str = "") -> Path:
    (folder / "boiler.toml").write_text(points or profile())
    file = folder / "plant.toml"
    file.write_text(f"""\
[collector]
store = "data"
page = "off"
[poll_class]
all.period = 0.02
[[link]]
name = "hall"
url = "{url}"
timeout = 5.0
[[device]]
name = "boiler"
link = "hall"
unit = 1
profile = "boiler.toml"
{more}""")
    return file


@contextlib.asynccontextmanager
async def served(*values: int) -> AsyncIterator[tuple[Server, busway.Device]]:
    device = busway.Device(holding_registers=10)
    device.holding_registers[0 : len(values)] = list(values)
    async with busway.serve("tcp://127.0.0.1:0", units={1: device}) as server:
        yield server, device


async def next_event(events: AsyncIterator[AlarmEvent]) -> str:
    async with asyncio.timeout(60):
        event = await anext(events)
    return f"{event.point} {event.limit} {event.kind}"


async def test_an_alarm_is_raised_acknowledged_and_cleared_and_all_of_it_is_in_the_journal(tmp_path: Path) -> None:
    async with served(81, 50) as (server, device):
        async with busway.collect(plant(tmp_path, server.endpoints[0])) as collector:
            await until(lambda: bool(collector.alarms.active()))
            (alarm,) = collector.alarms.active()
            assert (alarm.key, alarm.value) == (("boiler", "temperature", "H"), 81)
            assert (alarm.text, alarm.state) == ("above 80 °C", AlarmState.UNACKNOWLEDGED)
            assert collector.alarms.counts() == (1, 1)
            table = busway.Store(tmp_path / "data").read("boiler/temperature", since="1h")
            assert alarm.since in table.time, "the sample that raised it is in the store with it"
            events = collector.alarms.events()
            first = asyncio.create_task(next_event(events))
            await asyncio.sleep(0)
            acknowledged = await collector.alarms.acknowledge("boiler", "temperature", "H", "anna")
            assert acknowledged.by == "anna"
            assert await first == "temperature H acknowledged"
            with pytest.raises(InvalidRequest, match="no alarm H of boiler/temperature to acknowledge"):
                await collector.alarms.acknowledge("boiler", "temperature", "H", "otto")
            device.holding_registers[0:2] = [75, 9]
            told = {await next_event(events), await next_event(events)}
            assert told == {"temperature H cleared", "pressure LL raised"}
            journal = collector.alarms.journal()
            assert [each.kind for each in reversed(journal) if each.limit == "H"] == [
                "raised",
                "acknowledged",
                "cleared",
            ]
            await events.aclose()
        kept = busway.Store(tmp_path / "data").alarms("boiler/temperature")
        assert [(each.kind, each.value, each.by) for each in kept] == [
            (AlarmEventKind.RAISED, 81, ""),
            (AlarmEventKind.ACKNOWLEDGED, None, "anna"),
            (AlarmEventKind.CLEARED, 75, ""),
        ]


async def test_an_alarm_stays_active_and_acknowledged_over_a_kill_and_is_raised_once(tmp_path: Path) -> None:
    async with served(81, 50) as (server, device):
        file = plant(tmp_path, server.endpoints[0])
        for run, options in enumerate((["--acknowledge"], [], [])):
            worker = await asyncio.create_subprocess_exec(
                sys.executable, alarm_worker.__file__, os.fspath(file), *options, stdout=asyncio.subprocess.PIPE
            )
            assert worker.stdout is not None
            try:
                async with asyncio.timeout(40):
                    lines = [(await worker.stdout.readline()).decode().strip()]
                    if run == 0:
                        lines += [(await worker.stdout.readline()).decode().strip() for _ in range(2)]
                        assert lines == ["began", "H|raised|", "H|acknowledged|anna"]
                    else:
                        assert lines == ["began|H=active"]
                        device.holding_registers[1] = 5 if run == 1 else 50
                        assert (await worker.stdout.readline()).decode().strip() == ("LL|raised|" if run == 1 else "")
                        break
            finally:
                with contextlib.suppress(ProcessLookupError):
                    worker.kill()
                await worker.wait()
        journal = busway.Store(tmp_path / "data").alarms()
        assert [(each.limit, each.kind) for each in journal] == [
            ("H", "raised"),
            ("H", "acknowledged"),
            ("LL", "raised"),
        ]


async def test_a_file_that_is_read_again_changes_renames_and_ends_alarms(tmp_path: Path) -> None:
    async with served(81, 50) as (server, _):
        url = server.endpoints[0]
        async with busway.collect(plant(tmp_path, url)) as collector:
            await until(lambda: bool(collector.alarms.active()))
            renamed = profile(LIMIT.replace("80", "60"), "heat", ', was = "temperature"')
            await collector.reload(load_collector(plant(tmp_path, url, renamed)))
            await until(lambda: [each.point for each in collector.alarms.active()] == ["heat"])
            assert collector.alarms.active()[0].state is AlarmState.UNACKNOWLEDGED
            await collector.alarms.acknowledge("boiler", "heat", "H", "anna")
            without = profile("", "heat", ', was = "temperature"')
            await collector.reload(load_collector(plant(tmp_path, url, without)))
            await until(lambda: not collector.alarms.active())
        kept = busway.Store(tmp_path / "data").alarms()
        assert [(each.point, each.kind) for each in kept] == [
            ("heat", "raised"),
            ("heat", "acknowledged"),
            ("heat", "removed"),
        ]


def test_events_that_wait_for_their_commit_are_shown_by_the_names_and_times_of_then() -> None:
    kept: list[AlarmEvent] = []
    alarms = CollectorAlarms(kept.extend, lambda: 5.0, lambda: 7 * NANOSECONDS)
    rule = (AlarmRule("H", 10.0, acknowledge=True),)
    old = Point("temperature", Table.HOLDING_REGISTERS, 0, alarms=rule)
    earlier = AlarmEvent("boiler", "temperature", "L", AlarmEventKind.RAISED, 3 * NANOSECONDS)
    alarms.begin([earlier], {"boiler": [old]})
    read = SampleBatch(PointGroup("boiler", ("temperature",)), 6 * NANOSECONDS, 0, (15.0,), int(Reason.CLOCK))
    (raised,) = alarms.take(read)
    shift = EARLIEST
    alarms.configure({"boiler": [replace(old, name="heat", was="temperature")]}, {("boiler", "temperature"): "heat"})
    alarms.mend(ClockCorrection(shift))
    alarms.committed([raised])
    (shown,) = [each for each in alarms.active() if each.limit == "H"]
    assert (shown.point, shown.since) == ("heat", 6 * NANOSECONDS + shift)
    last, first = alarms.journal()
    assert (last.point, last.at) == ("heat", 6 * NANOSECONDS + shift)
    assert (first.point, first.at) == ("heat", 3 * NANOSECONDS), "the clock of an earlier process is not known"


async def test_totals_go_on_after_a_kill(tmp_path: Path) -> None:
    async with served(0, 50, 65_000) as (server, device):
        file = plant(tmp_path, server.endpoints[0])
        for counter, total in ((65_000, 65_000), (464, 66_000), (964, 66_500)):
            device.holding_registers[2] = counter
            worker = await asyncio.create_subprocess_exec(
                sys.executable, alarm_worker.__file__, os.fspath(file), stdout=asyncio.subprocess.DEVNULL
            )
            try:
                await until(partial(_is_last, tmp_path, total), 40)
            finally:
                worker.kill()
                await worker.wait()


def _is_last(folder: Path, total: int) -> bool:
    return _last(folder) == total


def _last(folder: Path) -> object:
    try:
        values = busway.Store(folder / "data").read("boiler/energy").value
    except busway.ModbusError:
        return None  # nothing is there yet
    return next((value for value in reversed(values) if value is not None), None)
