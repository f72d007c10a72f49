"""A gateway as cheap ones are: what has come waits in a queue, and reaches the device also when its client has gone."""

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class OnTheLine:
    """One request that the device behind the gateway has seen: when it came and left, and the address of its client."""

    arrived: float
    left: float
    client: str


@dataclass
class QueueingGateway:
    """Holds each request of a connection in a queue of that connection before the device sees it.

    Attributes:
        held: by address of a client, the seconds for which its requests are held, counted from when they arrive; those
            of the others pass at once. So does a gateway that gives each connection a thread, and lets these fight
            for the line.
        line: what the device has seen, in order.
        waiting: how many requests are in the queues.
    """

    port: int = 0
    held: dict[str, float] = field(default_factory=dict)
    line: list[OnTheLine] = field(default_factory=list)
    waiting: int = 0
    reads: int = 0
    _queues: list[asyncio.Task[None]] = field(default_factory=list)

    @contextlib.asynccontextmanager
    async def serving(self) -> AsyncIterator["QueueingGateway"]:
        """Serve on a free port; what waits at the end is dropped."""
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
