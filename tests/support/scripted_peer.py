"""A server of a few lines, for tests of clients: it keeps the frames it got and says what the test says."""

import asyncio
from collections.abc import Callable
from types import TracebackType
from typing import Self

from busway.framing.mbap import MbapFrame, MbapReceiver, encode_mbap

Answer = Callable[["ScriptedPeer", MbapFrame], bytes | None]


def echo_of(frame: MbapFrame, *words: int) -> bytes:
    """A right answer to a read of registers: these words."""
    data = b"".join(word.to_bytes(2, "big") for word in words)
    return encode_mbap(frame.transaction, frame.unit, bytes((frame.pdu[0], len(data))) + data)


def first_address(peer: "ScriptedPeer", frame: MbapFrame) -> bytes:
    """Answers a read of one register with its address."""
    return echo_of(frame, int.from_bytes(frame.pdu[1:3], "big"))


class ScriptedPeer:
    """Listens on a free port of the local host while the ``async with`` lasts.

    Args:
        answer: the bytes to send for a frame, or None for none.
        close_after: closes each connection after so many answers; 0 for never.

    Attributes:
        frames: all frames so far, of all connections.
        chunks: what each receive brought.
        writers: the connections so far; ``peers`` their addresses.
        ended: connections that the client has closed.
    """

    def __init__(self, answer: Answer = first_address, *, close_after: int = 0) -> None:
        self._answer = answer
        self._close_after = close_after
        self._server: asyncio.Server | None = None
        self.frames: list[MbapFrame] = []
        self.chunks: list[bytes] = []
        self.writers: list[asyncio.StreamWriter] = []
        self.peers: list[tuple[str, int]] = []
        self.ended = 0

    @property
    def endpoint(self) -> str:
        """Its URL."""
        assert self._server is not None
        port = self._server.sockets[0].getsockname()[1]
        return f"tcp://127.0.0.1:{port}"

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._server is not None
        self._server.close()
        for writer in self.writers:
            writer.transport.abort()
        await self._server.wait_closed()
        for _ in range(3):
            await asyncio.sleep(0)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        self.peers.append(writer.get_extra_info("peername")[:2])
        receiver = MbapReceiver()
        answered = 0
        try:
            while data := await reader.read(65_536):
                self.chunks.append(data)
                for frame in receiver.receive(data):
                    self.frames.append(frame)
                    reply = self._answer(self, frame)
                    if reply is not None:
                        writer.write(reply)
                        answered += 1
                if self._close_after and answered >= self._close_after:
                    return
            self.ended += 1
        except ConnectionError:
            self.ended += 1
        finally:
            writer.close()
