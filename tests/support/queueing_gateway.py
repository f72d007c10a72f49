"""A gateway like the cheap ones: requests wait in a queue, and reach the device even if their client has gone."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class OnTheLine:
    """One request that the device has seen: when it came to the gateway and left it, and the address of its client."""

    arrived: float
    left: float
    client: str


@dataclass
class QueueingGateway:
    """Holds each request of a connection in a queue of that connection before the device sees it.

    Attributes:
        held: seconds for which requests of a client are held, counted from when they arrive, by address of the client;
            requests of other clients pass at once. A gateway with one thread for each connection behaves like this,
            because its threads compete for the line.
        line: the requests that the device has seen, in order.
        waiting: number of requests in the queues.
        reads: number of requests that were answered; the registers hold it.
    """

    port: int = 0
    held: dict[str, float] = field(default_factory=dict)
    line: list[OnTheLine] = field(default_factory=list)
    waiting: int = 0
    reads: int = 0
    _queues: list[asyncio.Task[None]] = field(default_factory=list)

    @contextlib.asynccontextmanager
    async def serving(self) -> AsyncIterator["QueueingGateway"]:
        """Serve on a free port; requests that wait at the end are dropped."""
        server = await asyncio.start_server(self._talk, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        try:
            yield self
        finally:
            server.close()
            for task in self._queues:
                task.cancel()
            await asyncio.gather(*self._queues, return_exceptions=True)

    def clients(self) -> set[str]:
        """Return the addresses of all clients of which the device has seen a request."""
        return {each.client for each in self.line}

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        requests: asyncio.Queue[tuple[float, bytes] | None] = asyncio.Queue()
        self._queues.append(asyncio.create_task(self._serve(requests, writer)))
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                head = await reader.readexactly(6)
                adu = head + await reader.readexactly(struct.unpack(">H", head[4:])[0])
                self.waiting += 1
                requests.put_nowait((asyncio.get_running_loop().time(), adu))
        requests.put_nowait(None)

    async def _serve(self, requests: "asyncio.Queue[tuple[float, bytes] | None]", writer: asyncio.StreamWriter) -> None:
        client, now = writer.get_extra_info("peername")[0], asyncio.get_running_loop().time
        while (request := await requests.get()) is not None:
            arrived, adu = request
            await asyncio.sleep(arrived + self.held.get(client, 0.0) - now())
            self.waiting -= 1
            self.line.append(OnTheLine(arrived, now(), client))
            self.reads += 1
            registers = struct.unpack(">H", adu[10:12])[0]
            pdu = bytes((3, 2 * registers)) + struct.pack(">2H", *divmod(self.reads, 65536))[: 2 * registers]
            with contextlib.suppress(ConnectionError):
                writer.write(adu[:4] + struct.pack(">H", len(pdu) + 1) + adu[6:7] + pdu)
        writer.close()


def late_frames(line: list[OnTheLine]) -> list[OnTheLine]:
    """Return the requests that reached the device after it had seen one of the next owner of its link."""
    order = list(dict.fromkeys(each.client for each in line))
    found, newest = [], 0
    for each in line:
        newest = max(newest, order.index(each.client))
        if order.index(each.client) < newest:
            found.append(each)
    return found
