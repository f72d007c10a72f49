"""busway as the master of a serial line, one read after the other.

Run from `bench/`: python -m clients.busway_line blocking|await URL READS REGISTERS
"""

import asyncio
import sys

from harness.reads import Reads

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


kind, url, count, registers = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
if kind == "blocking":
    blocking(url, Reads(count, registers), registers)
else:
    asyncio.run(awaiting(url, Reads(count, registers), registers))
