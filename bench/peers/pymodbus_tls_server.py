"""A pymodbus server over TLS with 65 536 registers for unit 1, register n holding n.

Run by the peers' interpreter from `bench/`: python -m peers.pymodbus_tls_server CERTIFICATE KEY AUTHORITY

Its own framing for TLS leaves the header out, which MODBUS/TCP Security does not; it is told to frame as on TCP.
"""

import asyncio
import ssl
import sys

from harness import announce
from pymodbus import FramerType
from pymodbus.server import ModbusTlsServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def main(certificate: str, key: str, authority: str) -> None:
    registers = SimData(address=0, values=list(range(65536)), datatype=DataType.REGISTERS)
    bits = SimData(address=0, count=1000, values=False, datatype=DataType.BITS)
    device = SimDevice(id=1, simdata=([bits], [bits], [registers], [registers]))
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    context.load_verify_locations(authority)
    context.verify_mode = ssl.CERT_REQUIRED
    server = ModbusTlsServer(device, framer=FramerType.SOCKET, address=("127.0.0.1", 0), sslctx=context)
    await server.serve_forever(background=True)
    announce.port(server.transport.sockets[0].getsockname()[1])
    await server.serving


asyncio.run(main(*sys.argv[1:4]))
