"""Another configuration while the collector runs: untouched links go on, the audit log has revision and difference."""

import asyncio
import json
import re
import socket
import time
import urllib.request
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from commanded_plant import RecordedDevice, commanded_plant
from foreign_servers import free_port
from waiting import until

import busway
from busway.apps.collector.commands.audit import LONGEST_DIFFERENCE, configuration_line, revision_of
from busway.apps.collector.configuration import parse_collector
from busway.apps.collector.reload import left_for_the_next_start, replace_file
from busway.apps.collector.store.retention import Retention
from busway.apps.web.collector_stream import CollectorStream
from busway.config.files.file_error import FileError
from busway.errors import ConfigError
from busway.points import Reason


@dataclass
class HalfDone:
    """A change of a configuration that waits in its middle until it is released."""

    collector: busway.Collector
    stack: AsyncExitStack
    change: asyncio.Task[list[str]]
    release: asyncio.Event


def changes(collector: busway.Collector, folder: Path) -> list[dict[str, Any]]:
    assert collector._audit is not None
    collector._audit.flush()
    lines = [json.loads(line) for line in (folder / "data" / "audit.log").read_text().splitlines()]
    return [line for line in lines if line["event"] == "configuration"]


async def test_links_that_did_not_change_go_on_and_are_not_held_up_for_a_round(tmp_path: Path) -> None:
    one, two = RecordedDevice(), RecordedDevice()
    asked: list[float] = []
    # Seconds of processor of this thread, where the collector works: how busy the machine is does not count.
    one.device.on_read("holding_registers", lambda read: asked.append(time.thread_time()))
    async with one.server() as first, two.server() as second:
        file = commanded_plant(tmp_path, first.endpoints[0], period=0.5)
        begun = file.read_text()
        async with busway.collect(file) as collector:
            await until(lambda: collector.status()[0].rounds >= 2)
            asked.clear()
            for turn in range(1, 6):
                other = f'[[link]]\nname = "b"\nurl = "{second.endpoints[0]}"\n' + "".join(
                    f'[[device]]\nname = "d{number}"\nlink = "b"\nunit = 1\nprofile = "valve.toml"\n'
                    for number in range(10 * (turn % 3))
                )
                text = begun + (other if turn % 3 else "")
                done = await collector.replace_configuration(text, by="anna")
                assert all(each.startswith("link b ") for each in done)
                rounds = len(asked)
                await until(lambda rounds=rounds: len(asked) > rounds)
            assert max(later - earlier for earlier, later in pairwise(asked)) < 0.5
            assert first.counters.accepted == 1
            intervals = busway.Store(tmp_path / "data").read("boiler/*", since="1m").intervals
            assert {each.reason for each in intervals} <= {
                Reason.SKIPPED
            }  # by a machine that is busy, as measured above


async def test_the_audit_log_has_who_revision_and_difference_of_each_change(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(tmp_path, server.endpoints[0])
        old = file.read_text()
        async with busway.collect(file) as collector:
            new = old.replace("all.period = 0.1", "all.period = 0.2")
            file.write_text(new)
            assert await collector.read_again() == ["link hall began anew"]
            file.write_text(new.replace("unit = 1", "unit = 256"))
            with pytest.raises(FileError, match=r"plant\.toml:\d+: device\[0\]\.unit"):
                await collector.read_again()
            with pytest.raises(ConfigError, match="restart it"):
                await collector.replace_configuration(new.replace('"data"', '"other"'), by="bernd")
            assert collector.revision == revision_of(new)
            applied, wrong, other = changes(collector, tmp_path)
            assert (applied["outcome"], applied["origin"]) == ("applied", "signal")
            assert (applied["before"], applied["revision"]) == (revision_of(old), revision_of(new))
            assert applied["difference"][-2:] == ["-all.period = 0.1", "+all.period = 0.2"]
            assert applied["done"] == ["link hall began anew"]
            assert (wrong["outcome"], wrong["before"]) == ("refused", revision_of(new))
            assert "device[0].unit" in wrong["done"][0]
            assert (other["outcome"], other["by"], other["origin"]) == ("refused", "bernd", "api")


async def test_keys_that_need_a_restart_are_logged_and_kept_until_they_are_changed_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    text = file.read_text()
    async with busway.collect(file) as collector:
        file.write_text(text.replace('page = "off"', 'page = "127.0.0.1:0"'))
        assert await collector.read_again() == ["[collector] page holds after the next start"]
        assert collector.restart_needed == ["[collector] page"]
        assert "a restart is needed: changes of [collector] page hold" in caplog.text
        caplog.clear()
        file.write_text(text)
        await collector.read_again()
        assert (collector.restart_needed, caplog.text) == ([], "")


def sink(name: str, file: str, more: str = "") -> str:
    return f'[[sink]]\nname = "{name}"\nurl = "file://{file}"\nage = 0\n{more}\n'


def lines(path: Path) -> list[dict[str, Any]]:
    """The lines that a sink has written so far, without one that it is writing."""
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


async def test_sinks_begin_change_and_end_while_links_and_other_sinks_go_on(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(tmp_path, server.endpoints[0], more=sink("kept", "kept.jsonl"))
        text = file.read_text()
        async with busway.collect(file) as collector:
            untouched = collector._links["hall"]
            await until(lambda: len(lines(tmp_path / "kept.jsonl")) > 20)
            more = text + sink("late", "late.jsonl")
            assert await collector.replace_configuration(more, by="anna") == ["sink late began"]
            await until(lambda: len(lines(tmp_path / "late.jsonl")) > 20)
            assert [each.name for each in collector.sink_statuses()] == ["kept", "late"]
            fewer = text + sink("late", "late.jsonl", 'points = ["boiler/mode"]')
            assert await collector.replace_configuration(fewer, by="anna") == ["sink late began anew"]
            last = len(lines(tmp_path / "late.jsonl"))
            await until(lambda: len(lines(tmp_path / "late.jsonl")) > last + 5)
            assert {each["point"] for each in lines(tmp_path / "late.jsonl")[last:]} == {"mode"}
            found = [each["time"] for each in lines(tmp_path / "late.jsonl") if each["point"] == "mode"]
            await until(lambda: lines(tmp_path / "kept.jsonl")[-1]["time"] > max(found))
            all_of_it = {each["time"] for each in lines(tmp_path / "kept.jsonl") if each["point"] == "mode"}
            assert {time for time in all_of_it if time <= max(found)} == set(found), "it went on where it was"
            assert await collector.replace_configuration(text, by="anna") == ["sink late ended"]
            assert [each.name for each in collector.sink_statuses()] == ["kept"]
            last = len(lines(tmp_path / "late.jsonl"))
            count = len(lines(tmp_path / "kept.jsonl"))
            await until(lambda: len(lines(tmp_path / "kept.jsonl")) > count + 20)
            assert len(lines(tmp_path / "late.jsonl")) == last
            assert collector._links["hall"] is untouched
            # It counts all that it has sent since the start, so it is the delivery of the start.
            await until(lambda: collector.sink_statuses()[0].sent == len(lines(tmp_path / "kept.jsonl")))
            assert collector.restart_needed == []


async def test_a_page_for_prometheus_changes_in_place_and_a_port_that_is_taken_refuses_the_whole_file(
    tmp_path: Path,
) -> None:
    pytest.importorskip("prometheus_client")
    boiler = RecordedDevice()

    def page(port: int, points: str) -> str:
        return f'[[sink]]\nname = "scrape"\nurl = "prometheus://127.0.0.1:{port}"\npoints = ["{points}"]\n'

    async def shown(collector: busway.Collector) -> str:
        def read() -> str:
            with urllib.request.urlopen(collector.pages[0], timeout=60) as answer:
                return str(answer.read().decode())

        return await asyncio.to_thread(read)

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with boiler.server() as server:
            file = commanded_plant(tmp_path, server.endpoints[0])
            text = file.read_text()
            async with busway.collect(file) as collector:
                await until(lambda: collector.values.last("boiler", "mode") is not None)
                assert await collector.replace_configuration(text + page(0, "boiler/mode"), by="a") == [
                    "sink scrape began"
                ]
                url = collector.pages[0]
                assert 'point="mode"' in await shown(collector)
                await collector.replace_configuration(text + page(0, "boiler/level"), by="a")
                assert collector.pages == [url]
                assert 'point="mode"' not in await shown(collector)
                in_use = file.read_text()
                wanted = text.replace("all.period = 0.1", "all.period = 0.2") + page(port, "boiler/mode")
                with pytest.raises(ConfigError, match=r"sink\.scrape\.url"):
                    await collector.replace_configuration(wanted, by="a")
                assert (file.read_text(), collector.revision) == (in_use, revision_of(in_use))
                assert collector.pages == [url]
                assert 'point="level"' in await shown(collector)
                assert await collector.replace_configuration(text, by="a") == ["sink scrape ended"]
                assert collector.pages == []


async def test_pages_for_prometheus_exchange_their_ports_and_names_and_a_check_binds_none(tmp_path: Path) -> None:
    pytest.importorskip("prometheus_client")
    one, two, three = free_port(), free_port(), free_port()

    def pages(**ports: int) -> str:
        return "".join(
            f'[[sink]]\nname = "{name}"\nurl = "prometheus://127.0.0.1:{port}"\npoints = ["{name}/*"]\n'
            for name, port in ports.items()
        )

    def points(collector: busway.Collector) -> dict[int, tuple[str, ...]]:
        return {int(page.url.split(":")[2].split("/")[0]): page._points for page in collector._systems._pages.values()}

    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    text = file.read_text()
    async with busway.collect(file) as collector:
        for wanted in (
            {"a": one, "b": two},
            {"a": two, "b": one},
            {"c": two, "b": one},
            {"a": one, "c": two},
            {"b": two, "a": three, "c": one},
            {"c": three},
        ):
            assert await collector.replace_configuration(text + pages(**wanted), by="anna")
            assert points(collector) == {port: (f"{name}/*",) for name, port in wanted.items()}
            for port in {one, two, three} - set(wanted.values()):
                socket.create_server(("127.0.0.1", port)).close()
        collector.check(parse_collector(text + pages(c=three, d=one), str(file)))
        file.unlink()
        with pytest.raises(ConfigError, match="cannot be replaced"):
            await collector.replace_configuration(text + pages(d=two), by="anna")
        for port in (one, two):
            socket.create_server(("127.0.0.1", port)).close()
        assert points(collector) == {three: ("c/*",)}


async def test_a_device_that_is_removed_has_no_last_value_and_others_keep_theirs_on_the_page(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(tmp_path, server.endpoints[0])
        text = file.read_text()
        other = f'[[link]]\nname = "b"\nurl = "{server.endpoints[0]}"\n' + (
            '[[device]]\nname = "other"\nlink = "b"\nunit = 1\nprofile = "valve.toml"\n'
        )
        async with busway.collect(file) as collector:
            stream = CollectorStream(collector)
            await collector.replace_configuration(text + other, by="anna")
            await until(lambda: all(collector.values.last(device, "mode") for device in ("boiler", "other")))
            stream.refresh().columns()
            await collector.replace_configuration(text, by="anna")
            assert collector.values.last("other", "mode") is None
            collector._links["hall"].poller.finish()
            await collector.flush()
            values, _, times = stream.refresh().columns()
            assert values[stream.points.index(("boiler", "mode"))] is not None
            assert {device for device, *_ in collector.values.samples()} == {"boiler"}
            assert min(times[place] for place, key in enumerate(stream.points) if key[1] == "mode") > 0


async def test_limits_of_the_store_hold_at_once(tmp_path: Path) -> None:
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    async with busway.collect(file) as collector:
        text = file.read_text().replace("[collector]", "[collector]\nkeep_days = 3\nkeep_bytes = 5000000")
        done = await collector.replace_configuration(text, by="anna")
        assert done == ["keep_days and keep_bytes hold from now on"]
        assert collector._committer is not None
        assert collector._committer.writer.options.retention == Retention(3 * 86_400.0, 5_000_000)
        assert await collector.replace_configuration(text, by="anna") == ["nothing changed"]


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('"data"', '"other"', "store: the store cannot be another while the collector runs: restart it"),
        ('url = "tcp:', 'url = "tcp://joe:secret@x?bad=1"\n#', r"line \d+: link\[0\].url"),
        ("[collector]", "[collector\nsecret", r"line 1"),
    ],
)
async def test_a_file_that_is_refused_is_logged_with_its_keys_and_no_values_until_another_holds(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, old: str, new: str, told: str
) -> None:
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    text = file.read_text()
    async with busway.collect(file) as collector:
        file.write_text(text.replace(old, new))
        with pytest.raises(ConfigError):
            await collector.read_again()
        (refused,) = collector.refused_file
        assert re.fullmatch(told, refused)
        assert f"refused, nothing was changed: {refused}" in caplog.text
        assert "secret" not in caplog.text
        await collector.replace_configuration(text.replace("0.1", "0.2"), by="anna")
        assert collector.refused_file == []


@asynccontextmanager
async def half_of_a_change(folder: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[HalfDone]:
    """A collector whose configuration is being replaced: its only link is about to be stopped."""
    held, release = asyncio.Event(), asyncio.Event()
    file = commanded_plant(folder, "tcp://127.0.0.1:1")
    collector = busway.collect(file)
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(collector)
        stack.callback(release.set)
        stop_link = collector._stop_link

        async def stop_slowly(name: str) -> None:
            held.set()
            await release.wait()
            await stop_link(name)

        monkeypatch.setattr(collector, "_stop_link", stop_slowly)
        text = file.read_text().replace("all.period = 0.1", "all.period = 0.2")
        change = asyncio.create_task(collector.replace_configuration(text, by="anna"))
        await held.wait()
        yield HalfDone(collector, stack, change, release)


async def test_a_change_that_has_begun_is_done_although_its_caller_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with half_of_a_change(tmp_path, monkeypatch) as half:
        half.change.cancel()
        with pytest.raises(asyncio.CancelledError):
            await half.change
        half.release.set()
        await until(lambda: half.collector.configuration.periods["all"] == 0.2 and "hall" in half.collector._links)
        await until(lambda: not half.collector._reloading.running)
        assert changes(half.collector, tmp_path)[-1]["done"] == ["link hall began anew"]


async def test_a_collector_that_ends_during_a_change_leaves_no_link_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with half_of_a_change(tmp_path, monkeypatch) as half:
        ending = asyncio.create_task(half.stack.aclose())
        await until(lambda: half.collector._reloading.is_ending)
        late = asyncio.create_task(half.collector.read_again())
        half.release.set()
        await ending
        assert await half.change == ["link hall began anew"]
        assert half.collector._links == {}
        with pytest.raises(ConfigError, match="the collector ends"):
            await late


async def test_the_audit_log_is_opened_anew_when_the_file_is_read_again(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(tmp_path, server.endpoints[0])
        async with busway.collect(file) as collector:
            log = tmp_path / "data" / "audit.log"
            log.rename(log.with_suffix(".1"))
            assert await collector.read_again() == ["nothing changed"]
            assert [each["outcome"] for each in changes(collector, tmp_path)] == ["applied"]
            assert log.with_suffix(".1").read_text() == ""


async def test_what_holds_after_the_next_start_is_said(tmp_path: Path) -> None:
    boiler = RecordedDevice()
    async with boiler.server() as server:
        file = commanded_plant(tmp_path, server.endpoints[0])
        text = file.read_text().replace('page = "off"', 'page = "127.0.0.1:8599"\ndurability = "power"')
        text += f'[audit]\npath = "{tmp_path}/other.log"\n'
        async with busway.collect(file) as collector:
            assert await collector.replace_configuration(text, by="anna") == [
                "[collector] durability holds after the next start",
                "[collector] page holds after the next start",
                "[audit] holds after the next start",
            ]


def test_a_configuration_without_a_change_leaves_nothing(tmp_path: Path) -> None:
    file = commanded_plant(tmp_path, "tcp://127.0.0.1:1")
    text = file.read_text()
    one, other = (parse_collector(each, str(file)) for each in (text, text + "# a remark\n"))
    assert left_for_the_next_start(one, other) == []


def test_a_file_is_replaced_whole_with_its_rights_and_behind_its_link(tmp_path: Path) -> None:
    (tmp_path / "real.toml").write_text("old")
    (tmp_path / "real.toml").chmod(0o640)
    (tmp_path / "plant.toml").symlink_to("real.toml")
    replace_file(str(tmp_path / "plant.toml"), "new")
    assert (tmp_path / "plant.toml").is_symlink()
    assert (tmp_path / "real.toml").read_text() == "new"
    assert (tmp_path / "real.toml").stat().st_mode & 0o777 == 0o640
    assert {each.name for each in tmp_path.iterdir()} == {"real.toml", "plant.toml"}
    with pytest.raises(ConfigError, match="cannot be replaced"):
        replace_file(str(tmp_path / "missing.toml"), "new")


def test_a_line_of_the_audit_log_is_bounded() -> None:
    old, new = "", "".join(f"key{number} = {'x' * 1000}\n" for number in range(5000))
    line = json.loads(
        configuration_line(
            old, new, ["done"] * 5000, is_applied=True, by="a", origin="api", time="2026-01-01T00:00:00Z"
        )
    )
    assert (len(line["difference"]), line["more"]) == (LONGEST_DIFFERENCE, 5000 + 3 - LONGEST_DIFFERENCE)
    assert max(map(len, line["difference"])) <= 300
    assert len(line["done"]) <= LONGEST_DIFFERENCE
