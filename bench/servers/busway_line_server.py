"""A busway server on a serial line with 100 holding registers for unit 1, register n holding n.

Run from `bench/`: python -m servers.busway_line_server URL; prints `serving URL` once it listens.
"""

import asyncio
import sys

from harness.priority import PROGRAM, real_time

import busway


async def main(url: str) -> None:
    device = busway.Device(holding_registers=list(range(100)))
    async with busway.serve(url, units={1: device}):
        print(f"serving {url}", flush=True)
        await asyncio.Event().wait()


real_time(PROGRAM)
asyncio.run(main(sys.argv[1]))
