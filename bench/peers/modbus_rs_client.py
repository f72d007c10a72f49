"""modbus-rs as a client: lock-step, or asyncio tasks that each await one request after the other.

Run by the peers' interpreter from `bench/`:
    python -m peers.modbus_rs_client blocking PORT SECONDS REGISTERS
    python -m peers.modbus_rs_client await PORT SECONDS REGISTERS CONNECTIONS TASKS_PER_CONNECTION
(a Python module made in Rust, with threads of its own; their CPU time is counted too)
"""

import asyncio
import sys
import time

import modbus_rs
from harness.window import BURST, Window, burst


def blocking(port: int, seconds: float, registers: int) -> None:
    transport = modbus_rs.TcpTransport.connect("127.0.0.1", port)
    client = transport.create_client(1)
    window = Window(seconds)
    going = True
    while going:
        for _ in range(BURST):
            began = time.perf_counter()
            values = client.read_holding_registers(0, registers)
        if list(values) != list(range(registers)):
            raise SystemExit(f"wrong values: {values}")
        going = window.count(BURST, began)
    transport.close()
    window.report()


async def awaiting(port: int, seconds: float, registers: int, connections: int, tasks: int) -> None:
    transports = [await modbus_rs.AsyncTcpTransport.connect("127.0.0.1", port) for _ in range(connections)]
    each = burst(connections * tasks)
    window = Window(seconds)

    async def caller(transport: modbus_rs.AsyncTcpTransport) -> None:
        client = transport.create_client(1)
        going = True
        while going:
            for _ in range(each):
                began = time.perf_counter()
                values = await client.read_holding_registers(0, registers)
            if list(values) != list(range(registers)):
                raise SystemExit(f"wrong values: {values}")
            going = window.count(each, began)

    await asyncio.gather(*(caller(transport) for transport in transports for _ in range(tasks)))
    window.report()


if sys.argv[1] == "blocking":
    blocking(int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
else:
    asyncio.run(awaiting(int(sys.argv[2]), float(sys.argv[3]), *map(int, sys.argv[4:7])))
