"""busway as the master of a serial line, one read after the other; it opens the port for each turn.

Run from `bench/`: python -m clients.busway_line blocking|await URL READS REGISTERS; see `harness.turns`.
"""

import asyncio
import sys

from harness.priority import PROGRAM, real_time
from harness.reads import Reads
from harness.turns import Took, make_turns

import busway


def blocking(url: str, reads: Reads, registers: int) -> None:
    with busway.connect(url) as link:
        unit = link.unit(1)
        values = unit.read_holding_registers(0, count=registers)
        while reads.more(values):
            values = unit.read_holding_registers(0, count=registers)


async def awaiting(url: str, reads: Reads, registers: int) -> None:
    async with busway.open(url) as link:
        unit = link.unit(1)
        values = await unit.read_holding_registers(0, count=registers)
        while reads.more(values):
            values = await unit.read_holding_registers(0, count=registers)


def turn(kind: str, url: str, count: int, registers: int) -> Took:
    reads = Reads(count, registers)
    if kind == "blocking":
        blocking(url, reads, registers)
    else:
        asyncio.run(awaiting(url, reads, registers))
    return reads.took()


real_time(PROGRAM)
make_turns(lambda: turn(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
