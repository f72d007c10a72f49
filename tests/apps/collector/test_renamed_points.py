"""Points that change their names: history goes on under the new one, and no value of another point comes under it."""

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path

from lying_devices import Field, Lies
from waiting import until

import busway
from busway.apps.collector.configuration import CollectorConfiguration, load_collector

ADDRESSES = {"at0": 0, "at4": 4, "at8": 8}


def plant(folder: Path, url: str, names: Mapping[str, str], was: Mapping[str, str]) -> Path:
    """A file with one device; names and former names of its points by address."""
    points = []
    for key, start in ADDRESSES.items():
        former = f', was = "{was[key]}"' if key in was else ""
        points.append(f'{{ name = "{names[key]}", address = "holding:{start}", type = "uint64"{former} }}')
    (folder / "profile.toml").write_text("[[unit]]\nunit = 1\npoint = [\n" + ",\n".join(points) + "\n]\n")
    file = folder / "plant.toml"
    file.write_text(
        '[collector]\nstore = "data"\npage = "off"\n[poll_class]\nall.period = 0.03\n'
        f'[[link]]\nname = "a"\nurl = "{url}"\n'
        '[[device]]\nname = "pump"\nlink = "a"\nunit = 1\nprofile = "profile.toml"\n'
    )
    return file


def starts(folder: Path, point: str) -> list[int]:
    """Which registers the samples of a point are of, in the order of time, repetitions left out."""
    found: list[int] = []
    for sample in busway.Store(folder / "data").read(f"pump/{point}"):
        if sample.value is not None:
            assert isinstance(sample.value, int)
            start = (sample.value >> 32 & 0xFFFF) & ~3
            if found[-1:] != [start]:
                found.append(start)
    return found


async def some_rounds(collector: busway.Collector) -> None:
    before = collector.store_status().samples
    await until(lambda: collector.store_status().samples >= before + 12)


async def all_configurations(folder: Path, url: str, *steps: tuple[Mapping[str, str], Mapping[str, str]]) -> None:
    """Collect by each of these names and former names, one after the other; then start again with the last."""
    names, was = steps[0]
    async with busway.collect(plant(folder, url, names, was)) as collector:
        await some_rounds(collector)
        for names, was in steps[1:]:
            await collector.reload(load_collector(plant(folder, url, names, was)))
            await some_rounds(collector)
    for _ in range(2):
        async with busway.collect(folder / "plant.toml") as collector:
            await some_rounds(collector)


NAMED = {"at0": "a", "at4": "b", "at8": "c"}


async def test_history_goes_on_under_the_new_name_and_both_names_find_it(tmp_path: Path) -> None:
    with Field() as world:
        url, _ = world.endpoint("tcp", [1])
        await all_configurations(tmp_path, url, (NAMED, {}), ({**NAMED, "at0": "new"}, {"at0": "a"}))
    assert starts(tmp_path, "new") == [0]
    assert starts(tmp_path, "a") == [0]
    assert {point.point for point in busway.Store(tmp_path / "data").points()} == {"new", "b", "c"}


async def test_a_sample_that_was_on_its_way_when_its_point_was_renamed_belongs_to_the_new_name(tmp_path: Path) -> None:
    with Field() as world:
        url, devices = world.endpoint("tcp", [1], Lies(delay=0.02))
        async with busway.collect(plant(tmp_path, url, {**NAMED, "at0": "new0"}, {})) as collector:
            for number in range(1, 6):
                turns = devices[1].turns + 2
                await until(lambda turns=turns: devices[1].turns > turns)  # what was asked last is not answered yet
                names, was = {**NAMED, "at0": f"new{number}"}, {"at0": f"new{number - 1}"}
                await collector.reload(load_collector(plant(tmp_path, url, names, was)))
            await some_rounds(collector)
    assert {point.point for point in busway.Store(tmp_path / "data").points()} == {"new5", "b", "c"}
    assert starts(tmp_path, "new5") == [0]
    assert len(devices) == 1


async def test_two_points_that_exchange_their_names_keep_their_history(tmp_path: Path) -> None:
    with Field() as world:
        url, _ = world.endpoint("tcp", [1])
        exchanged = {"at0": "b", "at4": "a", "at8": "c"}
        await all_configurations(tmp_path, url, (NAMED, {}), (exchanged, {"at0": "a", "at4": "b"}))
    assert (starts(tmp_path, "a"), starts(tmp_path, "b"), starts(tmp_path, "c")) == ([4], [0], [8])


async def test_a_point_that_takes_the_name_that_another_gave_up_brings_its_own_history(tmp_path: Path) -> None:
    with Field() as world:
        url, _ = world.endpoint("tcp", [1])
        passed_on = {"at0": "first", "at4": "a", "at8": "b"}
        await all_configurations(tmp_path, url, (NAMED, {}), (passed_on, {"at0": "a", "at4": "b", "at8": "c"}))
    assert [starts(tmp_path, name) for name in ("first", "a", "b")] == [[0], [4], [8]]


async def test_a_new_point_under_a_name_that_was_given_up_has_no_history(tmp_path: Path) -> None:
    with Field() as world:
        url, _ = world.endpoint("tcp", [1])
        last = {"at0": "new", "at4": "b", "at8": "a"}
        await all_configurations(
            tmp_path, url, (NAMED, {}), ({**NAMED, "at0": "new"}, {"at0": "a"}), (last, {"at0": "a"})
        )
    assert [starts(tmp_path, name) for name in ("new", "a", "b")] == [[0], [8], [4]]


async def test_totals_of_points_that_pass_on_their_names_go_on_from_their_own(tmp_path: Path) -> None:
    device = busway.Device(holding_registers=10)

    def count(*values: int) -> None:
        for address, value in zip(ADDRESSES.values(), values, strict=True):
            device.holding_registers[address] = value

    def totals() -> dict[str, object]:
        table = busway.Store(tmp_path / "data").read("pump/*")
        rows = zip(table.point, table.value, strict=True)
        return {point: value for point, value in rows if value is not None}

    async with busway.serve("tcp://127.0.0.1:0", units={1: device}) as server:

        def counters(names: Mapping[str, str], was: Mapping[str, str]) -> CollectorConfiguration:
            file = plant(tmp_path, server.endpoints[0], names, was)
            profile = tmp_path / "profile.toml"
            profile.write_text(profile.read_text().replace('type = "uint64"', 'type = "uint16", rollover = true'))
            return load_collector(file)

        count(65_000, 50_000, 65_100)
        async with busway.collect(counters(NAMED, {})) as collector:
            await until(lambda: totals() == {"a": 65_000, "b": 50_000, "c": 65_100}, 20)
            count(464, 50_000, 64)
            await until(lambda: totals() == {"a": 66_000, "b": 50_000, "c": 65_600}, 20)
            passed_on = {"at0": "first", "at4": "a", "at8": "b"}
            await collector.reload(counters(passed_on, {"at0": "a", "at4": "b", "at8": "c"}))
            count(465, 50_001, 65)
            await until(lambda: totals() == {"first": 66_001, "a": 50_001, "b": 65_601}, 20)
            await collector.reload(counters({**passed_on, "at8": "c"}, {"at0": "a", "at4": "b"}))
            await until(lambda: totals().get("c") == 65, 20)  # a new point under a name that was given up


async def test_a_sink_gets_each_sample_under_the_name_that_it_was_read_by(tmp_path: Path) -> None:
    passed_on = {"at0": "first", "at4": "a", "at8": "b"}
    sink = '[[sink]]\nname = "lines"\nurl = "file://lines.jsonl"\nage = 0.05\n'
    with Field() as world:
        url, _ = world.endpoint("tcp", [1])
        file = plant(tmp_path, url, NAMED, {})
        file.write_text(file.read_text() + sink)
        async with busway.collect(file) as collector:
            await some_rounds(collector)
            file = plant(tmp_path, url, passed_on, {"at0": "a", "at4": "b", "at8": "c"})
            file.write_text(file.read_text() + sink)
            await collector.reload(load_collector(file))
            await some_rounds(collector)
            file = plant(tmp_path, url, {**passed_on, "at8": "last"}, {"at8": "b"})
            file.write_text(file.read_text() + sink)
            await collector.reload(load_collector(file))
            await some_rounds(collector)
            await until(lambda: collector.sink_statuses()[0].sent >= collector.store_status().samples - 12)
    begun: dict[str, list[int]] = {}
    for line in (tmp_path / "lines.jsonl").read_text().splitlines():
        sample = json.loads(line)
        if sample["value"] is not None:
            start = (sample["value"] >> 32 & 0xFFFF) & ~3
            found = begun.setdefault(sample["point"], [])
            if found[-1:] != [start]:
                found.append(start)
    assert begun == {"a": [0, 4], "b": [4, 8], "c": [8], "first": [0], "last": [8]}


async def test_files_that_are_read_again_at_once_are_applied_one_after_the_other(tmp_path: Path) -> None:
    with Field() as world:
        url, devices = world.endpoint("tcp", [1, 2, 3, 4])
        configurations = []
        for unit in (1, 2, 3, 4):
            file = plant(tmp_path, url, NAMED, {})
            file.write_text(file.read_text().replace("unit = 1", f"unit = {unit}"))
            configurations.append(load_collector(file))
        async with busway.collect(configurations[0]) as collector:
            await some_rounds(collector)
            await asyncio.gather(*(collector.reload(each) for each in configurations[1:]))
            await some_rounds(collector)
            turns = [devices[unit].turns for unit in (1, 2, 3)]
            await some_rounds(collector)
            assert [devices[unit].turns for unit in (1, 2, 3)] == turns
