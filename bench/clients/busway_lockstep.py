"""Masters of busway that each read in lock-step, together: clients that stand in a queue before one line.

Run from `bench/`: python -m clients.busway_lockstep URL CLIENTS READS REGISTERS

Each client has a connection of its own and makes READS reads. One line of JSON: seconds from one reply to the next,
the middle one (`typical`) and all of them together (`seconds`), of all clients; and CPU seconds (`cpu`).
"""

import asyncio
import json
import statistics
import sys
import time
from contextlib import AsyncExitStack

from harness.priority import PROGRAM, real_time

import busway


async def main(url: str, clients: int, reads: int, registers: int) -> None:
    ended: list[float] = []
    expected = list(range(registers))

    async def client(unit: busway.AsyncUnit) -> None:
        for _ in range(reads):
            values = await unit.read_holding_registers(0, count=registers)
            ended.append(time.perf_counter())
            if values != expected:
                raise SystemExit(f"wrong values: {values}")

    async with AsyncExitStack() as opened:
        links = [await opened.enter_async_context(busway.open(url, shared=False, timeout=5)) for _ in range(clients)]
        for link in links:
            await link.unit(1).read_holding_registers(0, count=registers)  # opens what has to be opened
        before, began = time.process_time(), time.perf_counter()
        await asyncio.gather(*(client(link.unit(1)) for link in links))
    each = [later - earlier for earlier, later in zip([began, *ended], ended, strict=False)]
    cpu = time.process_time() - before
    typical = statistics.median(each[clients:]) if len(each) > clients else each[-1]
    print(json.dumps({"seconds": sum(each), "typical": typical, "cpu": cpu, "reads": len(each)}))


real_time(PROGRAM)
asyncio.run(main(sys.argv[1], *map(int, sys.argv[2:5])))
