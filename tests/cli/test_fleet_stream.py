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

import pytest
from fleet_devices import FleetDevice, devices_of, plant
from fleet_samples import stored, taken
from foreign_servers import nats_server
from program import Busway
from waiting import until

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
