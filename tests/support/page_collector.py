"""A collector with its page over a small served plant, in a thread of its own."""

import asyncio
import contextlib
import json
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import Request, urlopen

import busway
from busway.apps.web.collector_page import CollectorPage

PUMP = """\
[[unit]]
unit = 1
point = [
    { name = "speed", address = "4x1", scale = 0.1, unit_of_measure = "rpm" },
    { name = "level", address = "4x2" },
    { name = "gone", address = "4x5000" },
]
"""
PLANT = """\
[collector]
store = "data"
[poll_class]
all.period = 0.1
[[link]]
name = "hall"
url = "{url}"
[[device]]
name = "pump"
link = "hall"
unit = 1
poll_class = "all"
profile = "pump.toml"
[[sink]]
name = "lines"
url = "file://lines.jsonl"
"""
MUTE = """\
[[device]]
name = "mute"
link = "hall"
unit = 9
poll_class = "all"
profile = "pump.toml"
"""
"""More for the file: a device that is not there."""


class WatchedCollector:
    """A running collector, its plant and its page."""

    def __init__(self, page: CollectorPage, collector: busway.Collector, device: busway.Device) -> None:
        self.page, self.collector, self.device = page, collector, device
        self.loop = asyncio.get_running_loop()

    def ask(self, path: str, token: str = "", **wanted: Any) -> tuple[int, Any]:
        """Status and content of an answer."""
        request = Request(self.page.url.rstrip("/") + path + (f"?{urlencode(wanted)}" if wanted else ""))
        if token:
            request.add_header("Authorization", f"Bearer {token}")
        try:
            with urlopen(request, timeout=60) as answer:
                return answer.status, json.load(answer)
        except HTTPError as error:
            return error.code, json.load(error)


@contextlib.asynccontextmanager
async def _running(folder: Path, at: str, more: str, profile: str) -> AsyncIterator[WatchedCollector]:
    device = busway.Device(holding_registers=100)
    device.holding_registers[0:2] = [15, 7]
    async with busway.serve("tcp://127.0.0.1:0", units={1: device}) as server:
        (folder / "pump.toml").write_text(profile)
        file = folder / "plant.toml"
        file.write_text(PLANT.replace("{url}", server.endpoints[0]) + more)
        async with busway.collect(file) as collector, CollectorPage(collector, at) as page:
            yield WatchedCollector(page, collector, device)


@contextlib.contextmanager
def watched_collector(
    folder: Path, at: str = "127.0.0.1:0", more: str = "", profile: str = PUMP
) -> Iterator[WatchedCollector]:
    """Run one while the block lasts. ``more`` is added to its file; ``profile`` is that of its pump."""
    ready: list[WatchedCollector | BaseException] = []
    begun, loop = threading.Event(), asyncio.new_event_loop()
    end = asyncio.Event()

    async def run() -> None:
        try:
            async with _running(folder, at, more, profile) as running:
                ready.append(running)
                begun.set()
                await end.wait()
        except BaseException as error:
            ready.append(error)
            begun.set()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()), daemon=True)
    thread.start()
    assert begun.wait(30)
    if isinstance(ready[0], BaseException):
        thread.join(30)
        loop.close()
        raise ready[0]
    try:
        yield ready[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join(30)
        loop.close()
