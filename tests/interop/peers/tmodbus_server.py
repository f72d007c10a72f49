"""A Modbus server made of tmodbus, for the check of peers: ``tmodbus_server.py PORT``; port 0 takes a free one.

Prints ``ready PORT``. Four tables of 1000 items with the known content, on every unit. Which items there are is the
task of its handlers, so they refuse others with the library's own error.
"""

import asyncio
import logging
import sys

from conversation import COILS, DISCRETE_INPUTS, HOLDING_REGISTERS, INPUT_REGISTERS, ITEMS, say
from tmodbus import pdu
from tmodbus.exceptions import IllegalDataAddressError
from tmodbus.server import AsyncTcpServer, ModbusRequestRouter

router = ModbusRequestRouter()


def checked(request, address, count):
    """Where the items are, if all of them are there."""
    if address + count > ITEMS:
        raise IllegalDataAddressError(request.function_code)
    return slice(address, address + count)


def reads(kind, table):
    @router.register(kind)
    async def read(unit, request):
        return table[checked(request, request.start_address, request.quantity)]


def writes_one(kind, table):
    @router.register(kind)
    async def write(unit, request):
        table[checked(request, request.address, 1)] = [request.value]
        return request.value


def writes_many(kind, table):
    @router.register(kind)
    async def write(unit, request):
        table[checked(request, request.start_address, len(request.values))] = list(request.values)
        return len(request.values)


reads(pdu.ReadCoilsPDU, COILS)
reads(pdu.ReadDiscreteInputsPDU, DISCRETE_INPUTS)
reads(pdu.ReadHoldingRegistersPDU, HOLDING_REGISTERS)
reads(pdu.ReadInputRegistersPDU, INPUT_REGISTERS)
writes_one(pdu.WriteSingleCoilPDU, COILS)
writes_one(pdu.WriteSingleRegisterPDU, HOLDING_REGISTERS)
writes_many(pdu.WriteMultipleCoilsPDU, COILS)
writes_many(pdu.WriteMultipleRegistersPDU, HOLDING_REGISTERS)


async def main() -> None:
    server = AsyncTcpServer("127.0.0.1", router, port=int(sys.argv[1]))
    await server.start()
    say(f"ready {server._server.sockets[0].getsockname()[1]}")  # the chosen port has no public name
    await asyncio.Event().wait()


logging.disable(logging.CRITICAL)
asyncio.run(main())
