"""pymodbus as the master of a serial line, one read after the other.

Run by the peers' interpreter from `bench/`:
    python -m peers.pymodbus_line_client blocking|await PATH BAUD READS REGISTERS

A pseudo-terminal has no parity, so it is told 8N2, whose characters have the same length as those of 8E1.
"""

import asyncio
import sys

from harness.reads import Reads
from pymodbus.client import AsyncModbusSerialClient, ModbusSerialClient


def blocking(path: str, baud: int, reads: Reads, registers: int) -> None:
    client = ModbusSerialClient(path, baudrate=baud, stopbits=2)
    if not client.connect():
        raise SystemExit("no connection")
    values = client.read_holding_registers(0, count=registers, device_id=1).registers
    while reads.more(values):
        values = client.read_holding_registers(0, count=registers, device_id=1).registers
    client.close()


async def awaiting(path: str, baud: int, reads: Reads, registers: int) -> None:
    client = AsyncModbusSerialClient(path, baudrate=baud, stopbits=2)
    if not await client.connect():
        raise SystemExit("no connection")
    values = (await client.read_holding_registers(0, count=registers, device_id=1)).registers
    while reads.more(values):
        values = (await client.read_holding_registers(0, count=registers, device_id=1)).registers
    client.close()


kind, path, baud, count, registers = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
if kind == "blocking":
    blocking(path, baud, Reads(count, registers), registers)
else:
    asyncio.run(awaiting(path, baud, Reads(count, registers), registers))
