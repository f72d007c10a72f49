"""pymodbus as the master of a serial line, one read after the other; it opens the port for each turn.

Run by the peers' interpreter from `bench/`:
    python -m peers.pymodbus_line_client blocking|await PATH BAUD READS REGISTERS; see `harness.turns`.

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import asyncio
import sys

from harness.priority import PROGRAM, real_time
from harness.reads import Reads
from harness.turns import Took, make_turns
from pymodbus.client import AsyncModbusSerialClient, ModbusSerialClient


def blocking(path: str, baud: int, reads: Reads, registers: int) -> None:
    client = ModbusSerialClient(path, baudrate=baud, stopbits=2)
    if not client.connect():
        raise ConnectionError("no connection")
    try:
        values = client.read_holding_registers(0, count=registers, device_id=1).registers
        while reads.more(values):
            values = client.read_holding_registers(0, count=registers, device_id=1).registers
    finally:
        client.close()


async def awaiting(path: str, baud: int, reads: Reads, registers: int) -> None:
    client = AsyncModbusSerialClient(path, baudrate=baud, stopbits=2)
    if not await client.connect():
        raise ConnectionError("no connection")
    try:
        values = (await client.read_holding_registers(0, count=registers, device_id=1)).registers
        while reads.more(values):
            values = (await client.read_holding_registers(0, count=registers, device_id=1)).registers
    finally:
        client.close()


def turn(kind: str, path: str, baud: int, count: int, registers: int) -> Took:
    reads = Reads(count, registers)
    if kind == "blocking":
        blocking(path, baud, reads, registers)
    else:
        asyncio.run(awaiting(path, baud, reads, registers))
    return reads.took()


real_time(PROGRAM)
make_turns(lambda: turn(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])))
