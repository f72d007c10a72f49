"""Clients that send bytes as they are told, each from an address and by a listener of its own.

Knows the frames of Modbus/TCP and RTU; of the library under test only the certificates for tests.
"""

import asyncio
import contextlib
import ssl
import struct
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from typing import cast

from policy_oracle import Asker
from tls_peers import foreign_context

from busway.testing.certificates import CertificateFiles

LONGEST_WAIT = 10.0
"""Seconds for a reply: only a reply that never comes takes them."""


@dataclass(frozen=True)
class Reply:
    """A reply, or a frame that is none."""

    transaction: int
    unit: int
    pdu: bytes


def crc(data: bytes) -> bytes:
    """The check of an RTU frame."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def mbap(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A frame of Modbus/TCP."""
    return struct.pack(">HHHB", transaction, 0, 1 + len(pdu), unit) + pdu


class PlainClient(asyncio.Protocol, asyncio.DatagramProtocol):
    """One connection.

    Attributes:
        asker: whom a policy sees.
        local: address and port that it has.
    """

    def __init__(self, asker: Asker, scheme: str) -> None:
        self.asker = asker
        self.scheme = scheme
        self.local = ""
        self.is_line = scheme == "rtu+tcp"
        self._replies: list[Reply] = []
        self._data = b""
        self._came = asyncio.Event()
        self._transport: asyncio.Transport | None = None
        self.lost = False

    @classmethod
    async def dial(
        cls, endpoint: str, host: str, tls: ssl.SSLContext | None = None, role: str | None = None
    ) -> "PlainClient":
        """Connect to a listener from ``host``."""
        scheme, _, rest = endpoint.partition("://")
        port = int(rest.rpartition(":")[2])
        made = cls(Asker(host, endpoint, role), scheme)
        loop = asyncio.get_running_loop()
        if scheme == "udp":
            await loop.create_datagram_endpoint(lambda: made, local_addr=(host, 0), remote_addr=("127.0.0.1", port))
        else:
            secure = {} if tls is None else {"ssl": tls, "server_hostname": "localhost"}
            await loop.create_connection(lambda: made, "127.0.0.1", port, local_addr=(host, 0), **secure)
        return made

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take the transport."""
        self._transport = cast(asyncio.Transport, transport)
        address, port = transport.get_extra_info("sockname")[:2]
        self.local = f"{address}:{port}"

    def connection_lost(self, error: Exception | None) -> None:
        """Note the end."""
        self.lost = True
        self._came.set()

    def datagram_received(self, data: bytes, address: object) -> None:
        """Take a datagram: one reply."""
        self.data_received(data)

    def data_received(self, data: bytes) -> None:
        """Take what came."""
        self._data += data
        while self._take_one():
            self._came.set()

    def _take_one(self) -> bool:
        if self.is_line:
            data = self._data  # one request is asked at a time, so what came is the reply, or the beginning of it
            if len(data) < 4 or crc(data[:-2]) != data[-2:]:
                return False
            self._replies.append(Reply(0, data[0], data[1:-2]))
            self._data = b""
            return True
        if len(self._data) < 8:
            return False
        transaction, _, length, unit = struct.unpack(">HHHB", self._data[:7])
        if len(self._data) < 6 + length:
            return False
        self._replies.append(Reply(transaction, unit, self._data[7 : 6 + length]))
        self._data = self._data[6 + length :]
        return True

    def frame(self, transaction: int, unit: int, pdu: bytes) -> bytes:
        """A request as this client sends it."""
        if self.is_line:
            return bytes((unit,)) + pdu + crc(bytes((unit,)) + pdu)
        return mbap(transaction, unit, pdu)

    def send(self, data: bytes) -> None:
        """Send bytes as they are: one segment, or one datagram."""
        assert self._transport is not None
        if self.scheme == "udp":
            cast(asyncio.DatagramTransport, self._transport).sendto(data)
        else:
            self._transport.write(data)

    async def receive(self, count: int = 1) -> Sequence[Reply]:
        """The next replies, in the order in which they came. Raises `TimeoutError`."""
        async with asyncio.timeout(LONGEST_WAIT):
            while len(self._replies) < count:
                assert not self.lost, f"{self.local} lost its connection to {self.asker.listener}"
                self._came.clear()
                await self._came.wait()
        taken, self._replies = self._replies[:count], self._replies[count:]
        return taken

    @property
    def unexpected(self) -> bool:
        """Whether there are replies that nothing was asked for."""
        return bool(self._replies or self._data)

    def close(self) -> None:
        """End the connection."""
        if self._transport is not None:
            self._transport.abort()


@contextlib.asynccontextmanager
async def connected(
    endpoints: Sequence[str], hosts: Sequence[str], certificates: Mapping[str | None, CertificateFiles]
) -> AsyncIterator[list[PlainClient]]:
    """Clients of every listener: two connections of one host, other hosts, and roles."""
    made: list[PlainClient] = []
    try:
        for endpoint in endpoints:
            if endpoint.startswith("tls"):
                for role in ("operator", "viewer"):
                    context = foreign_context(certificates[role], certificates[role])
                    made.append(await PlainClient.dial(endpoint, hosts[0], context, role))
                continue
            some = (hosts[0], *hosts) if endpoint.startswith("tcp") else hosts[:2]
            made += [await PlainClient.dial(endpoint, host) for host in some]
        yield made
    finally:
        for client in made:
            client.close()
