"""A serial port under asyncio, opened for a test, and what it tells."""

import asyncio

from fake_port import Pty

from busway.errors import LinkDown
from busway.options.ports import SerialSettings
from busway.transport.serial.connection import SerialConnection
from busway.transport.serial.ioctl import Ioctl, system_ioctl

FAST = SerialSettings(baud=1_000_000)


class Ears:
    """Holds what a connection tells."""

    def __init__(self) -> None:
        self.data = b""
        self.errors = 0
        self.reasons: list[LinkDown] = []
        self._told = asyncio.Event()

    def received(self, data: bytes, errors: int) -> None:
        self.data += data
        self.errors += errors
        self._told.set()

    def lost(self, reason: LinkDown) -> None:
        self.reasons.append(reason)
        self._told.set()

    async def heard(self, count: int) -> bytes:
        while len(self.data) < count:
            await self._next()
        return self.data

    async def end(self) -> LinkDown:
        while not self.reasons:
            await self._next()
        return self.reasons[0]

    async def _next(self) -> None:
        await self._told.wait()
        self._told.clear()


async def connected(
    pty: Pty, settings: SerialSettings = FAST, ioctl: Ioctl = system_ioctl
) -> tuple[SerialConnection, Ears]:
    ears = Ears()
    return await SerialConnection.open(pty.path, settings, received=ears.received, lost=ears.lost, ioctl=ioctl), ears


async def closed(connection: SerialConnection) -> None:
    connection.close()
    await connection.wait_closed()
