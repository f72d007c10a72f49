"""``busway fleet run --stream`` and ``busway fleet sink``: samples of several collectors reach a sink as processes."""

import asyncio
import contextlib
import json
import re
import signal
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from fleet_devices import FleetDevice, devices_of, plant
from fleet_samples import stored, taken
from foreign_servers import free_port, nats_server
from program import Busway
from waiting import until

from busway.apps.fleet.control_entries import read_entries
from busway.apps.fleet.coordinator import RevisionConflict
from busway.apps.fleet.coordinators.nats import open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.table_records import MemberRecord

pytest.importorskip("nats")
pytest.importorskip("msgpack")

pytestmark = pytest.mark.real_time
SECONDS = 90.0


def written(tmp_path: Path, devices: list[FleetDevice], sink: str, name: str = "lines") -> str:
    file = tmp_path / "plant.toml"
    text = plant(tmp_path / "none", devices).replace("[poll_class]", 'page = "off"\n[poll_class]')
    file.write_text(f'{text}\n[[sink]]\nname = "{name}"\n{sink}\n')
    return str(file)


@contextlib.asynccontextmanager
async def running(*arguments: str, says: str) -> AsyncIterator[Busway]:
    with Busway("fleet", *arguments) as program:
        await asyncio.to_thread(program.wait_for, says)
        yield program


async def test_every_sample_of_two_collectors_reaches_the_sink_although_one_is_killed(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    lines = tmp_path / "samples.jsonl"
    with nats_server(tmp_path) as server:
        async with devices_of(6) as devices, contextlib.AsyncExitStack() as stack:
            at = ("--coordinator", f"nats://127.0.0.1:{server.port}", "--zone", "hall")
            file = written(tmp_path, devices, f'url = "file://{lines}"')
            assert (await asyncio.to_thread(run, "fleet", "apply", file, *at)).code == 0
            sink = await stack.enter_async_context(running("sink", "lines", *at, says="takes the samples of zone hall"))

            def collector(name: str) -> contextlib.AbstractAsyncContextManager[Busway]:
                given = ("run", "--stream", "--name", name, "--store", str(tmp_path / name), "--shards", "8", *at)
                return running(*given, says=f"{name} collects into")

            west = await stack.enter_async_context(collector("west"))
            east = await stack.enter_async_context(collector("east"))
            await until(lambda: all(device.reads > 3 for device in devices), SECONDS)
            await until(lambda: len(taken(lines)) > 20, SECONDS)
            shares: list[int] = []
            while 0 in shares or len(shares) != 2:
                status = await asyncio.to_thread(run, "fleet", "status", "--json", *at)
                shares = [len(each["shards"]) for each in json.loads(status.out)["collectors"]]
                assert json.loads(status.out)["sinks"]["lines"]["messages_behind"] >= 0
            west.process.kill()
            west.process.wait()
            again = await stack.enter_async_context(collector("west"))  # its store still has what the stream has not
            for program in (again, east):
                program.process.send_signal(signal.SIGTERM)
                await asyncio.to_thread(program.process.wait, 60)
            last = await stack.enter_async_context(collector("west"))
            other = await stack.enter_async_context(collector("east"))
            for name in ("west", "east"):
                kept = await asyncio.to_thread(stored, tmp_path / name)
                assert kept
                begun = time.monotonic()
                while not kept <= taken(lines):
                    assert time.monotonic() < begun + SECONDS, f"{len(kept - taken(lines))} of {name} are missing"
                    await asyncio.sleep(0.2)
            for program in (last, other, sink):
                program.process.send_signal(signal.SIGTERM)
                await asyncio.to_thread(program.process.wait, 60)
                assert program.process.returncode == 0
            status = await asyncio.to_thread(run, "fleet", "status", *at)
            assert re.search(r"^lines +\d+ +(-|[\d.]+ s)$", status.out, re.MULTILINE), status.out


PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "run-a-fleet.md"
FAMILY = re.compile(r"^\| `(busway_fleet_\w+)` \|", re.MULTILINE)
ALERT = re.compile(r"`(busway_fleet_\w+) == 0`")


def scraped(port: int) -> dict[str, float]:
    """The metrics of a fleet on a page for Prometheus, each with the sum of its samples."""
    from prometheus_client.parser import text_string_to_metric_families

    with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    samples = [each for family in families for each in family.samples if each.name.startswith("busway_fleet_")]
    return {
        name: sum(each.value for each in samples if each.name == name)
        for name in dict.fromkeys(each.name for each in samples)
        if not name.endswith("_created")
    }


async def test_a_scrape_has_each_metric_that_is_documented_and_each_documented_alert_fires_when_it_should(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("prometheus_client")
    text, port = PAGE.read_text(encoding="utf-8"), free_port()
    alerts = ALERT.findall(text)
    assert set(alerts) == {f"busway_fleet_{name}" for name in ("may_own", "coordinator_up", "stream_up")}

    async def fires(alert: str, port: int = port) -> bool:
        return (await asyncio.to_thread(scraped, port))[alert] == 0

    with nats_server(tmp_path) as server:
        async with devices_of(2) as devices, contextlib.AsyncExitStack() as stack:
            url = f"nats://127.0.0.1:{server.port}"
            at = ("--coordinator", url, "--zone", "hall")
            file = written(tmp_path, devices, f'url = "prometheus://127.0.0.1:{port}"\npoints = ["*/*"]')
            assert (await asyncio.to_thread(run, "fleet", "apply", file, *at)).code == 0
            given = ("run", "--stream", "--name", "west", "--store", str(tmp_path / "west"), "--shards", "8", *at)
            await stack.enter_async_context(running(*given, says="west collects into"))
            await until(lambda: all(device.reads > 3 for device in devices), SECONDS)
            found = await asyncio.to_thread(scraped, port)
            assert set(found) == set(FAMILY.findall(text))
            assert (found["busway_fleet_shards"], found["busway_fleet_leases_total"]) >= (1, 1)
            assert found["busway_fleet_configuration_revision"] > 0
            assert not [alert for alert in alerts if await fires(alert)]

            table = await open_nats(url, "hall", CoordinatorOptions())
            other = MemberRecord("west", "another process", "box", 1).encode()
            while not await fires("busway_fleet_may_own"):
                entry = (await read_entries(table, "member.west"))["member.west"]
                with contextlib.suppress(RevisionConflict):  # it has renewed its entry meanwhile
                    await table.replace("member.west", other, entry.revision)
            await table.close()
            assert not await fires("busway_fleet_coordinator_up")

            server.stop()
            for alert in ("busway_fleet_coordinator_up", "busway_fleet_stream_up"):
                while not await fires(alert):  # noqa: ASYNC110 - the process tells nothing
                    await asyncio.sleep(0.1)


async def test_a_running_sink_follows_a_newer_configuration_and_goes_on_where_it_cannot(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    with nats_server(tmp_path) as server:
        async with devices_of(2) as devices, contextlib.AsyncExitStack() as stack:
            at = ("--coordinator", f"nats://127.0.0.1:{server.port}", "--zone", "hall")

            async def applied(to: Path, name: str = "lines") -> None:
                file = written(tmp_path, devices, f'url = "file://{to}"', name)
                assert (await asyncio.to_thread(run, "fleet", "apply", file, *at)).code == 0

            first, second = tmp_path / "first.jsonl", tmp_path / "second.jsonl"
            await applied(first)
            sink = await stack.enter_async_context(running("sink", "lines", *at, says="takes the samples of zone hall"))
            given = ("run", "--stream", "--name", "west", "--store", str(tmp_path / "west"), "--shards", "8", *at)
            west = await stack.enter_async_context(running(*given, says="west collects into"))
            await until(lambda: len(taken(first)) > 5, SECONDS)
            await applied(second)
            await asyncio.to_thread(sink.wait_for, "works by revision")
            await until(lambda: len(taken(second)) > 5, SECONDS)
            await applied(first, "renamed")
            told = await asyncio.to_thread(sink.wait_for, "goes on as before")
            assert "the configuration has no sink lines; there are renamed" in told
            kept = await asyncio.to_thread(stored, tmp_path / "west")
            assert len(kept) > 10
            await until(lambda: kept <= taken(first) | taken(second), SECONDS)
            west.process.send_signal(signal.SIGTERM)
            await asyncio.to_thread(west.process.wait, 60)
            sink.process.send_signal(signal.SIGTERM)
            await asyncio.to_thread(sink.process.wait, 60)
            assert sink.process.returncode == 0


@pytest.mark.parametrize("words", [["sink", "lines"], ["run", "--stream"]])
async def test_a_sink_that_needs_a_store_is_refused(run: Callable[..., Any], tmp_path: Path, words: list[str]) -> None:
    pytest.importorskip("pyarrow")
    with nats_server(tmp_path) as server:
        at = ("--coordinator", f"nats://127.0.0.1:{server.port}", "--zone", "hall")
        sink = f'url = "file://{tmp_path}/archive"\nformat = "parquet"'
        file = written(tmp_path, [FleetDevice("a", 502)], sink)
        applied = await asyncio.to_thread(run, "fleet", "apply", file, *at)
        assert applied.code == 0, applied.err
        refused = await asyncio.to_thread(run, "fleet", *words, *at)
        assert (refused.code, "sink.lines: Parquet files are called by commits" in refused.err) == (2, True)
        unknown = await asyncio.to_thread(run, "fleet", "sink", "liens", *at)
        assert "the configuration has no sink liens; there are lines" in unknown.err


@pytest.mark.parametrize("words", [["run", "--stream"], ["sink", "lines"]])
def test_a_stream_needs_nats(run: Callable[..., Any], tmp_path: Path, words: list[str]) -> None:
    at = ("--coordinator", f"local:{tmp_path}/zone")
    assert run("fleet", "apply", written(tmp_path, [FleetDevice("a", 502)], 'url = "file:///x.csv"'), *at).code == 0
    refused = run("fleet", *words, *at)
    assert refused.code == 2
    assert "--coordinator: samples go through a stream of NATS JetStream" in refused.err
