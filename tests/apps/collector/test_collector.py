"""A collector from end to end: a file, real links, a store; what readers get, and reading the file again."""

import asyncio
import json
import os
import sqlite3
import threading
import time
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any, TypeVar
from urllib.request import urlopen

import pytest
from collected import at
from waiting import until

import busway
from busway.apps.collector import collector as collecting
from busway.apps.collector import time_service
from busway.apps.collector.alarms.events import AlarmEvent, AlarmEventKind
from busway.apps.collector.configuration import CollectorConfiguration, load_collector
from busway.apps.collector.samples import PointGroup, Reason, SampleBatch
from busway.apps.collector.sinks.files import FileSink
from busway.apps.collector.sinks.prometheus import LastValues
from busway.apps.collector.store.writer import Commit
from busway.apps.collector.time_service import Synchronisation
from busway.errors import ConfigError
from busway.points.quality import exception_reason
from busway.server.server import Server

CLOSED = "tcp://127.0.0.1:9"
"""Where nothing listens."""
Item = TypeVar("Item")
PUMP = """\
[[unit]]
unit = 1
point = [
    { name = "speed", address = "4x1", scale = 0.1 },
    { name = "level", address = "4x2" },
    { name = "gone", address = "4x50" },
]
"""


def plant(folder: Path, links: Mapping[str, str], devices: Mapping[str, str], period: float = 0.05) -> Path:
    (folder / "pump.toml").write_text(PUMP)
    text = f'[collector]\nstore = "data"\n[poll_class]\nall.period = {period}\n'
    for name, url in links.items():
        text += f'[[link]]\nname = "{name}"\nurl = "{url}"\ntimeout = 5.0\n'
    for name, link in devices.items():
        text += f'[[device]]\nname = "{name}"\nlink = "{link}"\nunit = 1\nprofile = "pump.toml"\n'
    file = folder / "plant.toml"
    file.write_text(text)
    return file


def served(items: int = 100) -> Server:
    device = busway.Device(holding_registers=items)
    device.holding_registers[0:2] = [15, 7]
    return busway.serve("tcp://127.0.0.1:0", units={1: device})


def read_of(value: float) -> SampleBatch:
    return SampleBatch(PointGroup("a", ("level",)), at(value), 5, (value,))


async def all_of(items: AsyncIterator[Item]) -> list[Item]:
    return [each async for each in items]


async def first_values(collector: busway.Collector, devices: list[str], points: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    async with asyncio.timeout(60):
        async for batch in collector.samples(devices=devices):
            for sample in batch:
                if sample.value is not None:
                    found[f"{sample.device}/{sample.point}"] = sample.value
            if len(found) == points:
                return found
    raise AssertionError("no more samples")


async def test_the_clock_is_followed_while_files_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collecting, "CLOCK_EVERY", 0.01)
    async with busway.collect(plant(tmp_path, {"hall": CLOSED}, {"a": "hall"})) as collector:
        waits, goes_on, shifts = asyncio.Event(), asyncio.Event(), list[object]()

        async def record_again() -> None:
            waits.set()
            await goes_on.wait()

        monkeypatch.setattr(collector.commands, "record_again", record_again)
        await waits.wait()
        monkeypatch.setattr(collector, "_mend", shifts.append)
        await until(lambda: len(shifts) >= 3)
        goes_on.set()


async def test_samples_are_uncertain_until_a_time_service_has_set_the_clock_and_are_mended_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = [Synchronisation.NO]
    monkeypatch.delenv("BUSWAY_CLOCK")
    monkeypatch.setattr(collecting, "CLOCK_EVERY", 0.01)
    monkeypatch.setattr(time_service, "kernel_synchronisation", lambda: said[0])
    monkeypatch.setattr(time_service, "seconds_since_boot", lambda: 20.0)
    async with (
        served() as server,
        busway.collect(plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})) as collector,
    ):
        await until(lambda: (collector.values.last("pump", "level") or (0, 0))[1] == Reason.CLOCK)
        await collector.flush()
        store = busway.Store(tmp_path / "data")
        assert Reason.NONE not in store.read("pump/level").reason
        said[0] = Synchronisation.YES
        await until(lambda: (collector.values.last("pump", "level") or (0, 1))[1] == Reason.NONE)
        await collector.flush()
        table = store.read("pump/level")
        assert Reason.NONE in table.reason
        assert Reason.CLOCK not in table.reason
        assert list(table.time) == sorted(table.time)
    file = plant(tmp_path, {"a": CLOSED}, {"pump": "a"})
    file.write_text(file.read_text().replace("[collector]", '[collector]\nclock = "trusted"'))
    said[0] = Synchronisation.NO
    async with busway.collect(file) as collector:
        assert collector._clock.is_right


async def test_readers_get_all_that_was_stored_until_the_end(tmp_path: Path) -> None:
    last, raised = read_of(1.0), AlarmEvent("a", "level", "H", AlarmEventKind.RAISED, at(1.0))
    async with busway.collect(plant(tmp_path, {"x": CLOSED}, {"a": "x"})) as collector:
        samples, events = collector.samples(), collector.alarms.events()
        reading = asyncio.create_task(all_of(samples)), asyncio.create_task(all_of(events))
        await asyncio.sleep(0)
        assert collector._committer is not None
        collector._committer.add(last, [raised])
    batches, told = await asyncio.gather(*reading)
    assert batches[-1] is last
    assert told == [raised]


async def test_the_event_loop_does_not_wait_for_the_disk_when_what_was_learnt_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: list[threading.Thread] = []
    monkeypatch.setattr(
        "busway.apps.collector.learnt_file.write_whole", lambda path, text: threads.append(threading.current_thread())
    )
    async with busway.collect(plant(tmp_path, {"x": CLOSED}, {"a": "x"})):
        pass
    assert threads
    assert threading.main_thread() not in threads


async def test_samples_are_in_the_store_when_they_are_handed_on(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        async with busway.collect(file) as collector:
            found = await first_values(collector, ["pump"], 3)
            assert found == {"pump/speed": 1.5, "pump/level": 7, "pump/gone": 0}
            table = busway.Store(tmp_path / "data").read("pump/speed", since="1h")
            assert len(table) >= 1
            (status,) = collector.status()
            assert (status.state, status.link) == ("polled", "a")
            assert status.reads > 0
            assert collector.store_status().samples >= 3


async def test_with_a_rule_the_store_keeps_changes_the_last_value_is_fresh_and_a_file_read_again_says_another(
    tmp_path: Path,
) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=0.02)
        every = file.read_text()
        file.write_text(every.replace("[collector]", '[collector]\nstore_report = "change"'))
        async with busway.collect(file) as collector:
            last = collector.values.last
            await until(lambda: collector.store_status().passed_over >= 6, 20)
            first = (last("pump", "speed") or (0, 0, 0))[2]
            await until(lambda: (last("pump", "speed") or (0, 0, 0))[2] > first, 20)
            file.write_text(every)
            await collector.read_again()
            samples = collector.store_status().samples
            await until(lambda: collector.store_status().samples > samples + 6, 20)


async def test_a_sample_that_is_handed_on_is_already_the_last_value_of_its_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update = LastValues.update

    def slow_update(values: LastValues, commit: Commit) -> None:
        time.sleep(0.05)
        update(values, commit)

    monkeypatch.setattr(LastValues, "update", slow_update)
    async with (
        served() as server,
        busway.collect(plant(tmp_path, {"a": server.endpoints[0]}, {"one": "a"})) as collector,
        asyncio.timeout(60),
    ):
        async for batch in collector.samples():
            assert collector.values.last(batch.device, batch.points[0]) is not None
            break


async def test_only_samples_of_the_wanted_devices_are_handed_on(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"one": "a", "two": "a"})
        async with busway.collect(file) as collector:
            found = await first_values(collector, ["two"], 3)
            assert {name.split("/")[0] for name in found} == {"two"}
            with pytest.raises(ConfigError, match="there is no device 'three'"):
                async for _ in collector.samples(devices=["three"]):
                    pass


async def test_what_was_learnt_survives_a_restart(tmp_path: Path) -> None:
    async with served(items=20) as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=0.02)
        for run in range(2):
            async with busway.collect(file) as collector:
                assert bool(collector.status()[0].learnt) is bool(run)  # before anything was asked
                await until(lambda: any("exception 02" in line for line in collector.status()[0].learnt))
        kept = json.loads((tmp_path / "data" / "learnt.json").read_text())
        assert kept["devices"]["pump"]["holes"][0]["start"] == 49


async def test_a_point_that_is_not_asked_for_is_bad_for_its_reason_after_a_start(tmp_path: Path) -> None:
    async with served(items=20) as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=0.02)
        async with busway.collect(file) as collector:
            await until(lambda: any("exception 02" in line for line in collector.status()[0].learnt))
        async with busway.collect(file) as collector:
            assert collector.values.last("pump", "gone") is None
            await until(lambda: collector.values.last("pump", "gone") is not None)
            value, reason, time = collector.values.last("pump", "gone") or (0, 0, 0)
            assert (value, reason) == (None, exception_reason(2))
    table = busway.Store(tmp_path / "data").read("pump/gone")
    rows = [row for row in zip(table.time, table.reason, strict=True) if row[1] != Reason.SKIPPED]  # a busy machine
    assert rows[-1] == (time, exception_reason(2))


@pytest.mark.parametrize("firmware", ["2.1", "2.2"])
async def test_a_third_device_of_a_kind_begins_with_what_two_have_learnt_alike(tmp_path: Path, firmware: str) -> None:
    async with served(items=20) as first, served(items=20) as second, served(items=20) as third:
        links = {"a": first.endpoints[0], "b": second.endpoints[0], "c": third.endpoints[0]}
        file = plant(tmp_path, links, {"one": "a", "two": "b"}, period=0.02)
        known = file.read_text().replace("unit = 1", 'unit = 1\nfirmware = "2.1"')
        file.write_text(known)
        async with busway.collect(file) as collector:
            await until(lambda: all("exception 02" in "".join(each.learnt) for each in collector.status()))
        device = f'[[device]]\nname = "three"\nlink = "c"\nunit = 1\nfirmware = "{firmware}"\nprofile = "pump.toml"\n'
        file.write_text(known + device)
        async with busway.collect(file) as collector:
            (status,) = [each for each in collector.status() if each.name == "three"]
            assert ("exception 02" in "".join(status.learnt)) is (firmware == "2.1")  # before anything was asked


async def test_a_second_collector_on_one_store_is_refused_with_the_pid_of_the_first(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        async with busway.collect(file):
            with pytest.raises(ConfigError, match=str(os.getpid())):
                async with busway.collect(file):
                    pass


async def test_a_disk_that_is_full_at_the_start_is_told_and_leaves_the_store_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = plant(tmp_path, {"hall": CLOSED}, {"a": "hall"})
    file.write_text(file.read_text() + '[[sink]]\nname = "lines"\nurl = "file://lines.jsonl"\n')

    def no_room(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr("busway.apps.collector.store.manifest.Manifest.set_cursor", no_room)
        with pytest.raises(ConfigError, match="the store cannot be written: database or disk is full"):
            async with busway.collect(file):
                pass
    async with busway.collect(file):
        pass


async def test_a_collector_whose_link_cannot_begin_leaves_the_store_to_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with served() as server:
        url = server.endpoints[0]
        file = plant(tmp_path, {"a": url, "b": url}, {"one": "a", "two": "b"})
        collector = busway.collect(file)
        start = collector._start_link

        def fail_at_b(name: str, configuration: CollectorConfiguration) -> None:
            if name == "b":
                raise ConfigError("not this one")
            start(name, configuration)

        with monkeypatch.context() as broken:
            broken.setattr(collector, "_start_link", fail_at_b)
            with pytest.raises(ConfigError, match="not this one"):
                await collector.__aenter__()
        async with busway.collect(file) as again:
            await first_values(again, ["one"], 2)


async def test_an_end_that_is_cancelled_still_closes_the_store_and_is_cancelled(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"one": "a"})
        collector = await busway.collect(file).__aenter__()
        await first_values(collector, ["one"], 2)
        ending = asyncio.create_task(collector.__aexit__(None, None, None))
        await asyncio.sleep(0)  # it waits for the first of its tasks now
        ending.cancel()
        with pytest.raises(asyncio.CancelledError):
            await ending
        async with busway.collect(file) as again:
            await first_values(again, ["one"], 2)


async def test_a_device_in_maintenance_is_not_asked(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a", "other": "a"}, period=0.02)
        async with busway.collect(file) as collector:

            def reads(name: str) -> int:
                return next(each.reads for each in collector.status() if each.name == name)

            async def some_rounds() -> None:
                begun = reads("other")
                await until(lambda: reads("other") >= begun + 8)

            await first_values(collector, ["pump"], 3)
            collector.maintenance("pump", begins=True)
            assert {each.name: each.state for each in collector.status()} == {"pump": "maintenance", "other": "polled"}
            await some_rounds()  # a read that was on the wire has ended then
            before = reads("pump")
            await some_rounds()
            assert reads("pump") == before
            collector.maintenance("pump", begins=False)
            await until(lambda: reads("pump") > before)


async def test_reading_the_file_again_leaves_links_alone_that_did_not_change(tmp_path: Path) -> None:
    async with served() as first, served() as second:
        links = {"a": first.endpoints[0], "b": second.endpoints[0]}
        file = plant(tmp_path, links, {"one": "a", "two": "b"})
        async with busway.collect(file) as collector:
            await first_values(collector, ["one", "two"], 6)
            untouched = collector._links["a"]
            rounds = {each.name: each.rounds for each in collector.status()}
            plant(tmp_path, links, {"one": "a", "two": "b", "three": "b"})
            assert await collector.reload(load_collector(file)) == ["link b began anew"]
            assert collector._links["a"] is untouched
            assert not untouched.task.done()
            assert collector.status()[0].rounds >= rounds["one"]
            await first_values(collector, ["three"], 3)
            plant(tmp_path, {"a": links["a"]}, {"one": "a"})
            assert await collector.reload(load_collector(file)) == ["link b ended"]
            assert await collector.reload(load_collector(file)) == ["nothing changed"]


async def test_reading_the_file_again_leaves_links_alone_whose_poll_classes_did_not_change(tmp_path: Path) -> None:
    (tmp_path / "pump.toml").write_text('[[unit]]\npoint = [{ name = "speed", address = "4x1" }]\n')
    async with served() as first, served() as second:
        text = f"""
[poll_class]
fast.period = 0.05
slow.period = 50.0
[[link]]
name = "a"
url = "{first.endpoints[0]}"
[[link]]
name = "b"
url = "{second.endpoints[0]}"
[[device]]
name = "one"
link = "a"
unit = 1
profile = "pump.toml"
poll_class = "fast"
[[device]]
name = "two"
link = "b"
unit = 1
profile = "pump.toml"
poll_class = "slow"
"""
        file = tmp_path / "plant.toml"
        file.write_text(text)
        async with busway.collect(file) as collector:
            file.write_text(text.replace("slow.period = 50.0", "slow.period = 40.0"))
            assert await collector.reload(load_collector(file)) == ["link b began anew"]
            file.write_text(text.replace("slow.period = 50.0", "rare.period = 90.0\nslow.period = 40.0"))
            assert await collector.reload(load_collector(file)) == ["nothing changed"]
            file.write_text(
                text.replace("fast.period = 0.05\nslow", "slow").replace("[[link]]", "fast.period = 0.05\n[[link]]", 1)
            )
            assert await collector.reload(load_collector(file)) == ["link b began anew"]


async def test_last_values_of_a_link_whose_polling_has_stopped_are_held(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        async with busway.collect(file) as collector:
            await first_values(collector, ["pump"], 3)
            await collector.flush()
            collector._links["a"].poller.finish()
            last = collector.commands._targets.last
            await until(lambda: (found := last("pump", "level")) is not None and found.quality == "uncertain")
            found = collector.values.last("pump", "level")
            assert found is not None
            assert found[1] == Reason.HELD


async def test_another_store_is_refused_as_a_whole(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        async with busway.collect(file) as collector:
            file.write_text(file.read_text().replace('"data"', '"other"').replace("pump", "pumpe"))
            (tmp_path / "pumpe.toml").write_text(PUMP)
            with pytest.raises(ConfigError, match="restart it"):
                await collector.reload(load_collector(file))
            assert [each.name for each in collector.status()] == ["pump"]


async def test_changes_that_hold_after_the_next_start_are_named_until_they_are_undone(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        text = file.read_text()
        async with busway.collect(file) as collector:
            file.write_text(text.replace("[collector]\n", '[collector]\npage = "off"\ndurability = "power"\n'))
            left = ["[collector] durability holds after the next start", "[collector] page holds after the next start"]
            assert await collector.reload(load_collector(file)) == left
            assert await collector.reload(load_collector(file)) == left
            file.write_text(text + '[page_access]\ntokens = "tokens"\n')
            assert await collector.reload(load_collector(file)) == ["[page_access] holds after the next start"]
            file.write_text(text)
            assert await collector.reload(load_collector(file)) == ["nothing changed"]


async def test_a_link_that_is_not_there_is_a_reason_and_the_others_are_polled(tmp_path: Path) -> None:
    async with served() as server:
        async with served() as closed:
            gone = closed.endpoints[0]
        file = plant(tmp_path, {"a": server.endpoints[0], "b": gone}, {"pump": "a", "lost": "b"})
        async with busway.collect(file) as collector:
            await first_values(collector, ["pump"], 3)
            await until(lambda: {each.name: each.state for each in collector.status()}["lost"] == "silent")
            status = {each.name: each for each in collector.status()}
            assert status["lost"].last_error
            assert status["pump"].state == "polled"


async def test_watched_points_are_read_more_often(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=3600.0)
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled")
            collector.watch("pump", ["level"], period=0.02, seconds=5)
            found = await first_values(collector, ["pump"], 2)
            assert found["pump/level"] == 7


async def test_samples_are_handed_on_to_sinks_and_shown_to_prometheus(tmp_path: Path) -> None:
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"})
        with file.open("a") as text:
            text.write('[[sink]]\nname = "lines"\nurl = "file://lines.jsonl"\nage = 0.1\n')
            text.write('[[sink]]\nname = "page"\nurl = "prometheus://127.0.0.1:0"\npoints = ["pump/*"]\n')
        async with busway.collect(file) as collector:
            await first_values(collector, ["pump"], 3)
            await until(lambda: collector.sink_statuses()[0].sent >= 3)
            loop = asyncio.get_running_loop()
            page = await loop.run_in_executor(None, lambda: urlopen(collector.pages[0]).read().decode())
            assert 'busway_point_value{device="pump",point="speed"} 1.5' in page
            file.write_text(file.read_text().replace("lines.jsonl", "others.jsonl"))
            assert await collector.reload(load_collector(file)) == ["sink lines began anew"]
            await until((tmp_path / "others.jsonl").exists)
        assert '"speed"' in _text_of(tmp_path, "lines*")


@pytest.mark.parametrize("holds_its_thread", [False, True])
async def test_a_sink_that_hangs_stops_neither_polling_nor_commits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, holds_its_thread: bool
) -> None:
    """Judged by rounds: it polls on while the sink has waited for an answer since its first batch."""
    hangs, released = threading.Event(), threading.Event()

    async def send(sink: FileSink, samples: object) -> None:
        hangs.set()
        if holds_its_thread:
            released.wait(60)
        await asyncio.Event().wait()

    monkeypatch.setattr(FileSink, "send", send)
    async with served() as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=0.02)
        with file.open("a") as text:
            text.write('[[sink]]\nname = "lines"\nurl = "file://lines.jsonl"\nage = 0.0\n')
        async with busway.collect(file) as collector:
            await until(hangs.is_set)
            (device,), kept = collector.status(), collector.store_status().samples
            await until(lambda: collector.status()[0].rounds >= device.rounds + 100)
            await until(lambda: collector.store_status().samples >= kept + 100)
            assert collector.sink_statuses()[0].sent == 0
            released.set()


async def test_a_scrape_sends_no_request(tmp_path: Path) -> None:
    """A point that has no value yet is not asked for either: the device is read once in an hour."""
    device = busway.Device(holding_registers=100)
    asked: list[int] = []
    device.on_read("holding_registers", lambda access: asked.append(access.address))
    async with busway.serve("tcp://127.0.0.1:0", units={1: device}) as server:
        file = plant(tmp_path, {"a": server.endpoints[0]}, {"pump": "a"}, period=3600.0)
        with file.open("a") as text:
            text.write('[[sink]]\nname = "page"\nurl = "prometheus://127.0.0.1:0"\npoints = ["pump/*"]\n')
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].state == "polled")
            before = len(asked)
            for _ in range(50):
                await asyncio.to_thread(lambda: urlopen(collector.pages[0]).read())
            assert len(asked) - before < 5, "its first round, and what is asked once to learn"


def _text_of(folder: Path, pattern: str) -> str:
    return next(folder.glob(pattern)).read_text()
