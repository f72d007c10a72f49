"""A busway server for the tests of load, in a process of its own, so that its memory is its own too.

Use: python server.py ENDPOINT OPTIONS, with OPTIONS as JSON. Holding register n of every unit holds n. Each line on
stdin is answered with a status, once there are as many ``connections`` as the line says, or after its longest wait;
``objects`` counts what the garbage collector knows of, after it has run.
"""

import asyncio
import dataclasses
import gc
import json
import sys
import time
from typing import Any
from urllib.parse import urlsplit

import busway

LONGEST_WAIT = 10.0
"""Seconds."""


async def settled(server: busway.Server, wanted: int | None) -> dict[str, Any]:
    """The status when there are so many connections."""
    end = time.monotonic() + LONGEST_WAIT
    while wanted is not None and len(server.status().connections) != wanted and time.monotonic() < end:  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    return status(server)


def status(server: busway.Server) -> dict[str, Any]:
    """What the tests look at."""
    gc.collect()
    now = server.status()
    return {
        "port": urlsplit(server.endpoints[0]).port,
        "connections": len(now.connections),
        "objects": len(gc.get_objects()),
        "counters": dataclasses.asdict(now.counters),
    }


async def main(endpoint: str, options: dict[str, Any]) -> None:
    """Serve until the input ends."""
    loop = asyncio.get_running_loop()
    device = busway.Device(holding_registers=list(range(65_536)))
    async with busway.serve(endpoint, units=device, **options) as server:
        print("ready", flush=True)
        while line := await loop.run_in_executor(None, sys.stdin.readline):
            print(json.dumps(await settled(server, json.loads(line).get("connections"))), flush=True)


asyncio.run(main(sys.argv[1], json.loads(sys.argv[2])))
