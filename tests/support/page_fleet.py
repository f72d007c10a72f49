"""Two collectors of a fleet over a small plant, with the page of the first, in a thread of its own."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

from fleet_devices import TIMES, devices_of, parsed

from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.zone_watch import ZoneWatch
from busway.apps.web.collector_page import CollectorPage
from busway.apps.web.fleet_page import FleetApi

LINKS = 8


class WatchedFleet:
    """Two running collectors, and the page of the one that stays."""

    def __init__(self, page: CollectorPage, goes: FleetCollector) -> None:
        self.page, self._goes = page, goes
        self._loop = asyncio.get_running_loop()

    def silence(self) -> None:
        """Let the second collector renew nothing any more, as if it had died."""
        (task,) = [task for task in self._goes._tasks if task.get_name() == "busway fleet member"]
        self._loop.call_soon_threadsafe(task.cancel)


@contextlib.asynccontextmanager
async def _running(folder: Path) -> AsyncIterator[WatchedFleet]:
    async with contextlib.AsyncExitStack() as stack:
        devices = await stack.enter_async_context(devices_of(LINKS))
        made = []
        for name in ("stays", "goes"):
            coordinator = await open_coordinator(f"local:{folder}/zone", "hall")
            stack.push_async_callback(coordinator.close)
            configuration = parsed(folder, name, devices)
            fleet = FleetCollector(configuration, coordinator, name, host=name, shards=LINKS, times=TIMES)
            made.append(await stack.enter_async_context(fleet))
        watch = await stack.enter_async_context(ZoneWatch(coordinator, TIMES))
        page = CollectorPage(made[0].collector, "127.0.0.1:0", FleetApi(watch))
        yield WatchedFleet(await stack.enter_async_context(page), made[1])


@contextlib.contextmanager
def watched_fleet(folder: Path) -> Iterator[WatchedFleet]:
    """Run them while the block lasts."""
    ready: list[WatchedFleet | BaseException] = []
    begun, loop = threading.Event(), asyncio.new_event_loop()
    end = asyncio.Event()

    async def run() -> None:
        try:
            async with _running(folder) as running:
                ready.append(running)
                begun.set()
                await end.wait()
        except BaseException as error:
            ready.append(error)
            begun.set()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()), daemon=True)
    thread.start()
    assert begun.wait(60)
    try:
        if isinstance(ready[0], BaseException):
            raise ready[0]
        yield ready[0]
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join(60)
        loop.close()
