"""busway's asyncio client with batches: `execute_many`, one batch after the other on every connection.

Run from `bench/`: python -m clients.busway_many PORT SECONDS REGISTERS CONNECTIONS IN_FLIGHT [--uvloop]
"""

import asyncio
import sys
import time
from contextlib import AsyncExitStack

from harness.window import Window

import busway

BATCH = 256  # requests handed over at once; what a poller of a plant asks of one endpoint each second
ALL = 16 * BATCH  # requests handed over at once of all connections together, where they are many: turns stay short


async def main(port: int, seconds: float, registers: int, connections: int, in_flight: int) -> None:
    expected = list(range(registers))
    batch = [busway.ReadHoldingRegisters(0, registers)] * max(min(BATCH, ALL // connections), in_flight)
    async with AsyncExitStack() as opened:
        links = []
        for _ in range(connections):
            link = busway.open(
                f"tcp://127.0.0.1:{port}", max_transactions=in_flight, shared=False, max_connections=max(connections, 8)
            )
            links.append(await opened.enter_async_context(link))
        await asyncio.gather(*(link.connect() for link in links))
        window = Window(seconds)

        async def caller(unit: busway.AsyncUnit) -> None:
            going = True
            while going:
                began = time.perf_counter()
                replies = await unit.execute_many(batch)
                if len(replies) != len(batch) or replies[-1].registers != expected:
                    raise SystemExit(f"wrong replies, the last of {len(replies)} is {replies[-1]}")
                going = window.count(len(batch), began)

        await asyncio.gather(*(caller(link.unit(1)) for link in links))
    window.report()


run = asyncio.run
if "--uvloop" in sys.argv:
    import uvloop

    run = uvloop.run
run(main(int(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:6])))
