"""Masters of busway that each read in lock-step, together: clients that stand in a queue before one line.

Run from `bench/`: python -m clients.busway_lockstep URL CLIENTS READS REGISTERS; see `harness.turns`.

Each client has a connection of its own, new in every turn, and makes READS reads. What counts is the time from one
reply to the next, whichever task got it.
"""

import asyncio
import sys
import time
from contextlib import AsyncExitStack

from harness.priority import PROGRAM, real_time
from harness.turns import Took, make_turns

import busway


async def turn(url: str, clients: int, reads: int, registers: int) -> Took:
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
        before = time.process_time()
        await asyncio.gather(*(client(link.unit(1)) for link in links))
        cpu = time.process_time() - before
    return Took.of(ended, cpu)


real_time(PROGRAM)
make_turns(lambda: asyncio.run(turn(sys.argv[1], *map(int, sys.argv[2:5]))))
