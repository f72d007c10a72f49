"""A collector of a fleet that takes commands until it is killed, by itself at a step.

usage: commanded.py FILE URL NAME STEP. Says ``ready`` when it owns all links.
"""

import asyncio
import os
import signal
import sys

from fleet_devices import TIMES
from waiting import until

from busway.apps.collector.configuration import load_collector
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, until_up
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.fleet_commands import FleetCommands


def kill_at(step: str, name: str) -> None:
    if step == name:
        os.kill(os.getpid(), signal.SIGKILL)


async def main() -> None:
    file, url, name, step = sys.argv[1:]
    coordinator = await until_up(
        lambda: open_nats(url, "hall", CoordinatorOptions(answer=TIMES.answer)), CoordinatorDown, 30
    )
    made = load_collector(file)
    async with (
        FleetCollector(made, coordinator, name, host=name, shards=8, times=TIMES) as fleet,
        FleetCommands(fleet, coordinator.client, "hall") as commands,
    ):
        fleet.collector.commands._step = lambda each: kill_at(step, each)
        await until(lambda: len(commands._subscribed) == len(made.links), 60)
        await coordinator.client.flush()
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)


asyncio.run(main())
