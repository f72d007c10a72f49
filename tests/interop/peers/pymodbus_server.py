"""A Modbus server made of pymodbus, for the interop tests.

::

    pymodbus_server.py tcp PORT                        port 0 takes a free one; every unit
    pymodbus_server.py tls PORT CERTIFICATE KEY AUTHORITY
    pymodbus_server.py rtu|ascii DEVICE BAUD UNIT      8 data bits, no parity, 2 stop bits

Prints ``ready PORT`` (or ``ready DEVICE``). Four tables of 1000 items with the known content. File records and the FIFO
queue have the constant content that pymodbus itself gives them.
"""

import asyncio
import logging
import ssl
import sys

from conversation import COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, IDENTITY, INPUT_REGISTERS, say
from pymodbus.framer import FramerType
from pymodbus.pdu.device import ModbusDeviceIdentification
from pymodbus.server import ModbusSerialServer, ModbusTcpServer, ModbusTlsServer
from pymodbus.simulator import DataType, SimData, SimDevice

ANY_UNIT = 0


def device(unit: int) -> SimDevice:
    return SimDevice(
        unit,
        simdata=(
            [SimData(0, values=COILS, datatype=DataType.BITS)],
            [SimData(0, values=DISCRETE_INPUTS, datatype=DataType.BITS)],
            [SimData(0, values=HOLDING_REGISTERS, datatype=DataType.REGISTERS)],
            [SimData(0, values=INPUT_REGISTERS, datatype=DataType.REGISTERS)],
        ),
    )


async def serve_tcp(port: int) -> None:
    server = ModbusTcpServer(
        device(ANY_UNIT), address=("127.0.0.1", port), identity=ModbusDeviceIdentification(info=IDENTITY)
    )
    await server.serve_forever(background=True)
    say(f"ready {server.transport.sockets[0].getsockname()[1]}")
    await server.serving


async def serve_tls(port: int, certificate: str, key: str, authority: str) -> None:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    context.load_verify_locations(authority)
    context.verify_mode = ssl.CERT_REQUIRED
    server = ModbusTlsServer(
        device(ANY_UNIT),
        address=("127.0.0.1", port),
        sslctx=context,
        identity=ModbusDeviceIdentification(info=IDENTITY),
    )
    await server.serve_forever(background=True)
    say(f"ready {server.transport.sockets[0].getsockname()[1]}")
    await server.serving


async def serve_line(framing: str, path: str, baud: int, unit: int) -> None:
    server = ModbusSerialServer(
        device(unit),
        framer=FramerType(framing),
        identity=ModbusDeviceIdentification(info=IDENTITY),
        port=path,
        baudrate=baud,
        bytesize=8,
        parity="N",
        stopbits=2,
    )
    await server.serve_forever(background=True)
    say(f"ready {path}")
    await server.serving


logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
match sys.argv[1:]:
    case ["tcp", port]:
        asyncio.run(serve_tcp(int(port)))
    case ["tls", port, certificate, key, authority]:
        asyncio.run(serve_tls(int(port), certificate, key, authority))
    case ["rtu" | "ascii" as framing, path, baud, unit]:
        asyncio.run(serve_line(framing, path, int(baud), int(unit)))
    case _:
        sys.exit("usage: pymodbus_server.py tcp PORT | tls PORT CERTIFICATE KEY AUTHORITY | rtu|ascii DEVICE BAUD UNIT")
