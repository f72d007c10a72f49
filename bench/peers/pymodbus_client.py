"""pymodbus as a client: lock-step, or asyncio tasks that each await one request after the other.

Run by the peers' interpreter from `bench/`:
    python -m peers.pymodbus_client blocking PORT SECONDS REGISTERS
    python -m peers.pymodbus_client await PORT SECONDS REGISTERS CONNECTIONS TASKS_PER_CONNECTION
(its asyncio client lets one request per connection be on its way; further tasks wait for their turn inside it)
"""

import asyncio
import sys
import time

from harness.window import BURST, Window, burst
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient


def blocking(port: int, seconds: float, registers: int) -> None:
    client = ModbusTcpClient("127.0.0.1", port=port)
    if not client.connect():
        raise SystemExit("no connection")
    window = Window(seconds)
    going = True
    while going:
        for _ in range(BURST):
            began = time.perf_counter()
            reply = client.read_holding_registers(0, count=registers, device_id=1)
        if reply.isError() or len(reply.registers) != registers:
            raise SystemExit(f"wrong reply: {reply}")
        going = window.count(BURST, began)
    client.close()
    window.report()


async def awaiting(port: int, seconds: float, registers: int, connections: int, tasks: int) -> None:
    clients = [AsyncModbusTcpClient("127.0.0.1", port=port) for _ in range(connections)]
    for client in clients:
        if not await client.connect():
            raise SystemExit("no connection")
    each = burst(connections * tasks)
    window = Window(seconds)

    async def caller(client: AsyncModbusTcpClient) -> None:
        going = True
        while going:
            for _ in range(each):
                began = time.perf_counter()
                reply = await client.read_holding_registers(0, count=registers, device_id=1)
            if reply.isError() or len(reply.registers) != registers:
                raise SystemExit(f"wrong reply: {reply}")
            going = window.count(each, began)

    await asyncio.gather(*(caller(client) for client in clients for _ in range(tasks)))
    for client in clients:
        client.close()
    window.report()


if sys.argv[1] == "blocking":
    blocking(int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
else:
    asyncio.run(awaiting(int(sys.argv[2]), float(sys.argv[3]), *map(int, sys.argv[4:7])))
