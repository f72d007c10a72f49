"""busway's asyncio client, one await per request, in as many tasks per connection as requests are in flight on it.

Run from `bench/`: python -m clients.busway_await PORT SECONDS REGISTERS CONNECTIONS TASKS [--uvloop]
"""

import asyncio
import sys
import time
from contextlib import AsyncExitStack

from harness.window import Window, burst

import busway


async def main(port: int, seconds: float, registers: int, connections: int, tasks: int) -> None:
    expected = list(range(registers))
    async with AsyncExitStack() as opened:
        links = []
        for _ in range(connections):
            link = busway.open(
                f"tcp://127.0.0.1:{port}",
                max_transactions=tasks,
                max_connections=max(connections, 8),
                shared=False,
            )
            links.append(await opened.enter_async_context(link))
        await asyncio.gather(*(link.connect() for link in links))
        each = burst(connections * tasks)
        window = Window(seconds)

        async def caller(unit: busway.AsyncUnit) -> None:
            going = True
            while going:
                for _ in range(each):
                    began = time.perf_counter()
                    values = await unit.read_holding_registers(0, count=registers)
                if values != expected:
                    raise SystemExit(f"wrong values: {values}")
                going = window.count(each, began)

        await asyncio.gather(*(caller(link.unit(1)) for link in links for _ in range(tasks)))
    window.report()


run = asyncio.run
if "--uvloop" in sys.argv:
    import uvloop

    run = uvloop.run
run(main(int(sys.argv[1]), float(sys.argv[2]), *map(int, sys.argv[3:6])))
