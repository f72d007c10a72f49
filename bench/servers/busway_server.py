"""A busway server on TCP with 65 536 holding registers for unit 1, register n holding n.

Run from `bench/`: python -m servers.busway_server [--uvloop] [--trace-memory]
"""

import asyncio
import sys
from urllib.parse import urlsplit

from harness import announce

import busway


async def main() -> None:
    device = busway.Device(holding_registers=list(range(65536)))
    async with busway.serve("tcp://127.0.0.1:0", units={1: device}, max_connections=20_000) as server:
        announce.port(urlsplit(server.endpoints[0]).port or 0)
        await asyncio.Event().wait()


if "--trace-memory" in sys.argv:
    announce.trace_memory()
if "--uvloop" in sys.argv:
    import uvloop

    uvloop.run(main())
else:
    asyncio.run(main())
