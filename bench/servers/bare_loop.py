"""What asyncio's own transports come to under Python: a bare `asyncio.BufferedProtocol` that checks nothing.

Run from `bench/`: python -m servers.bare_loop [--uvloop] [--tls CERTIFICATE KEY AUTHORITY]

For: a row in every table of servers, as the floor in C is one. What it takes is what the loop's transports, the kernel
and the least of Python take; a server that leaves those transports out, as busway does, can come below it.
Must not: be used as a server. It takes every 12 bytes for a read of holding registers.
"""

import argparse
import asyncio
import ssl
from typing import cast

from harness import announce

TABLE = b"".join(number.to_bytes(2, "big") for number in range(65536)) + bytes(512)
HEADS = [bytes((0, 0, 0, 3 + 2 * count, 1, 3, 2 * count)) for count in range(126)]
REQUEST = 12


class Bare(asyncio.BufferedProtocol):
    """Answers reads of unit 1. All connections share a buffer, so a request that comes in two parts is lost."""

    buffer = bytearray(262_144)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)  # uvloop's is none by its class

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        asked = bytes(memoryview(self.buffer)[:nbytes])
        replies = []
        for at in range(0, nbytes, REQUEST):
            start, count = 2 * (asked[at + 8] << 8 | asked[at + 9]), asked[at + 11]
            replies.append(asked[at : at + 2] + HEADS[count] + TABLE[start : start + 2 * count])
        self.transport.write(b"".join(replies))


async def main(credentials: ssl.SSLContext | None) -> None:
    server = await asyncio.get_running_loop().create_server(Bare, "127.0.0.1", 0, ssl=credentials, backlog=4096)
    announce.port(server.sockets[0].getsockname()[1])
    await asyncio.Event().wait()


def agreed(certificate: str, key: str, authority: str) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    context.load_verify_locations(authority)
    context.verify_mode = ssl.CERT_REQUIRED
    return context


parser = argparse.ArgumentParser()
parser.add_argument("--uvloop", action="store_true")
parser.add_argument("--tls", nargs=3)
asked = parser.parse_args()
serving = main(agreed(*asked.tls) if asked.tls else None)
if asked.uvloop:
    import uvloop

    uvloop.run(serving)
else:
    asyncio.run(serving)
