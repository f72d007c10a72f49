"""A pymodbus TCP server with 65 536 registers for unit 1, register n holding n.

Run by the peers' interpreter from `bench/`: python -m peers.pymodbus_server [--trace-memory]
"""

import asyncio
import sys

from harness import announce
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def main() -> None:
    registers = SimData(address=0, values=list(range(65536)), datatype=DataType.REGISTERS)
    bits = SimData(address=0, count=1000, values=False, datatype=DataType.BITS)
    device = SimDevice(id=1, simdata=([bits], [bits], [registers], [registers]))
    server = ModbusTcpServer(device, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    announce.port(server.transport.sockets[0].getsockname()[1])
    await server.serving


if "--trace-memory" in sys.argv:
    announce.trace_memory()
asyncio.run(main())
