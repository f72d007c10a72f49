"""The runbook of a fleet whose NATS servers have lost their folders, step by step with real servers and processes."""

import asyncio
import contextlib
import json
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from fleet_devices import devices_of, plant
from fleet_samples import stored, taken
from foreign_servers import nats_cluster
from program import Busway
from waiting import until

pytest.importorskip("nats")
pytest.importorskip("msgpack")

pytestmark = pytest.mark.real_time
SECONDS = 100.0


def order(epoch: str) -> tuple[int, ...]:
    """An epoch as numbers that can be compared: generation, revision."""
    return tuple(int(part) for part in epoch.split("."))


async def test_after_all_servers_lost_their_folders_the_fleet_goes_on_and_epochs_do_not_go_back(
    run: Callable[..., Any], tmp_path: Path
) -> None:
    lines = tmp_path / "samples.jsonl"
    async with contextlib.AsyncExitStack() as stack:
        servers = nats_cluster(tmp_path, 3)
        for server in servers:
            stack.enter_context(server)
        devices = await stack.enter_async_context(devices_of(6))
        urls = ",".join(f"nats://127.0.0.1:{server.port}" for server in servers)
        at = ("--coordinator", urls, "--zone", "hall", "--replicas", "3")
        file = tmp_path / "plant.toml"
        text = plant(tmp_path / "none", devices).replace("[poll_class]", 'page = "127.0.0.1:0"\n[poll_class]')
        file.write_text(f'{text}\n[[sink]]\nname = "lines"\nurl = "file://{lines}"\n')

        async def command(*words: str) -> Any:
            result = await asyncio.to_thread(run, "fleet", *words, *at)
            assert result.code == 0, result.err
            return result

        async def started(*words: str, says: str) -> tuple[Busway, str]:
            program = stack.enter_context(Busway("fleet", *words, *at))
            page = ""
            if words[0] == "run":
                page = (await asyncio.to_thread(program.wait_for, "page on")).split()[3]
            await asyncio.to_thread(program.wait_for, says)
            return program, page

        async def collectors_started() -> tuple[list[Busway], list[str]]:
            found = []
            for name in ("west", "east"):
                words = ("run", "--stream", "--name", name, "--store", str(tmp_path / name), "--shards", "8")
                found.append(await started(*words, says=f"{name} collects into"))
            return [program for program, _ in found], [page for _, page in found]

        async def shown(page: str) -> Any:
            def asked() -> Any:
                with urlopen(f"{page}api/fleet", timeout=60) as answer:
                    return json.load(answer)

            return await asyncio.to_thread(asked)

        async def until_polled(page: str) -> dict[str, tuple[int, ...]]:
            """Wait until both collectors own all shards and the sink is near; return the epoch of each shard."""
            before, limit = [device.reads for device in devices], time.monotonic() + SECONDS
            while True:
                found = await shown(page)
                owners = {each["owner"] for each in found["shards"]}
                moved = all(device.reads > reads + 3 for device, reads in zip(devices, before, strict=True))
                sinks = {each["name"]: each["behind"] for each in found["sinks"]}
                if owners == {"west", "east"} and moved and sinks.get("lines") is not None:
                    assert 0 <= sinks["lines"] < 1000
                    return {each["shard"]: order(each["epoch"]) for each in found["shards"]}
                assert time.monotonic() < limit, found
                await asyncio.sleep(0.5)  # the page answers, and tells nothing by itself

        await command("apply", str(file))
        sink, _ = await started("sink", "lines", says="takes the samples of zone hall")
        collectors, pages = await collectors_started()
        before = await until_polled(pages[1])
        await until(lambda: len(taken(lines)) > 20, SECONDS)

        for program in collectors:  # 1. stop all collectors; the sink goes on
            program.process.send_signal(signal.SIGTERM)
        for program in collectors:
            await asyncio.to_thread(program.process.wait, 60)
        for server in servers:
            server.stop()
        for number in range(3):
            shutil.rmtree(tmp_path / f"n{number}")
        for server in servers:  # 2. start the servers with empty folders
            server.start()
        await command("restore")  # 3.
        await command("apply", str(file))  # 4. apply the file again, and start the collectors
        assert sink.process.poll() is None
        collectors, pages = await collectors_started()
        after = await until_polled(pages[1])

        assert before.keys() == after.keys()
        assert min(after.values()) > max(before.values()), (before, after)
        for name in ("west", "east"):  # nothing of before or after is missing at the sink
            kept = await asyncio.to_thread(stored, tmp_path / name)
            assert kept
            await until(lambda kept=kept: kept <= taken(lines), SECONDS)
        for program in (sink, *collectors):
            program.process.send_signal(signal.SIGTERM)
            await asyncio.to_thread(program.process.wait, 60)
            assert program.process.returncode == 0
