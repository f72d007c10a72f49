"""A Modbus server made of pymodbus, for the interop tests: ``pymodbus_server.py PORT``; port 0 takes a free one.

Prints ``ready PORT``. Four tables of 1000 items with the known content, on every unit. File records and the FIFO queue
have the constant content that pymodbus itself gives them.
"""

import asyncio
import logging
import sys

from conversation import COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, IDENTITY, INPUT_REGISTERS, say
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

ANY_UNIT = 0


async def serve(port: int) -> None:
    device = SimDevice(
        ANY_UNIT,
        simdata=(
            [SimData(0, values=COILS, datatype=DataType.BITS)],
            [SimData(0, values=DISCRETE_INPUTS, datatype=DataType.BITS)],
            [SimData(0, values=HOLDING_REGISTERS, datatype=DataType.REGISTERS)],
            [SimData(0, values=INPUT_REGISTERS, datatype=DataType.REGISTERS)],
        ),
    )
    server = ModbusTcpServer(device, address=("127.0.0.1", port), identity=ModbusDeviceIdentification(info=IDENTITY))
    await server.serve_forever(background=True)
    say(f"ready {server.transport.sockets[0].getsockname()[1]}")
    await server.serving


logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
asyncio.run(serve(int(sys.argv[1])))
