"""A link that may send only while a function permits it: no frame leaves after that, however long it waited."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import pytest

from busway.client.aio import open_link, send_only_while
from busway.errors import LinkDown, NoReply, WriteOutcomeUnknown

pytestmark = pytest.mark.real_time


@dataclass
class SilentDevice:
    """A device that answers nothing and keeps what it got."""

    got: list[bytes] = field(default_factory=list)
    ended: int = 0

    async def talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(300):
                self.got.append(data)
        self.ended += 1
        writer.close()


@contextlib.asynccontextmanager
async def silent() -> AsyncIterator[tuple[SilentDevice, int]]:
    device = SilentDevice()
    server = await asyncio.start_server(device.talk, "127.0.0.1", 0)
    try:
        yield device, server.sockets[0].getsockname()[1]
    finally:
        server.close()


@pytest.mark.parametrize("scheme", ["rtu+tcp", "ascii+tcp"])
async def test_a_frame_that_a_line_kept_back_does_not_leave_when_sending_is_no_longer_permitted(scheme: str) -> None:
    permitted = True
    async with silent() as (device, port):
        link = open_link(f"{scheme}://127.0.0.1:{port}", timeout=0.3, retries=0, open_after=0)
        send_only_while(link, lambda: permitted)
        async with link:
            with pytest.raises(NoReply):
                await link.unit(1).read_holding_registers(0, count=1)
            # The unit owes a reply: the line waits before it sends another frame to it, and a marker goes first.
            second = asyncio.create_task(link.unit(1).read_holding_registers(0, count=1))
            await asyncio.sleep(0)
            frames = len(device.got)
            permitted = False
            with pytest.raises(LinkDown, match="sending is not permitted now"):
                await second
            await asyncio.sleep(0.7)
            assert len(device.got) == frames == 1
            assert device.ended == 1, "the connection was reset"


@pytest.mark.parametrize("scheme", ["tcp", "udp"])
async def test_a_write_that_may_not_leave_is_not_sent_on_the_open_connection(scheme: str) -> None:
    permitted = True
    async with silent() as (device, port):
        link = open_link(f"{scheme}://127.0.0.1:{port}", timeout=0.3, retries=0, open_after=0)
        send_only_while(link, lambda: permitted)
        async with link:
            with pytest.raises(NoReply):
                await link.unit(1).read_holding_registers(0, count=1)
            frames = len(device.got)
            permitted = False
            with pytest.raises((LinkDown, WriteOutcomeUnknown)):
                await link.unit(1).write_single_register(0, 1)
            assert len(device.got) == frames


@pytest.mark.parametrize("scheme", ["tcp", "rtu+tcp", "udp"])
async def test_no_connection_is_opened_where_nothing_may_be_sent(scheme: str) -> None:
    async with silent() as (device, port):
        link = open_link(f"{scheme}://127.0.0.1:{port}", timeout=0.3, retries=0, open_after=0)
        send_only_while(link, lambda: False)
        async with link:
            with pytest.raises(LinkDown, match="sending is not permitted now"):
                await link.unit(1).read_holding_registers(0, count=1)
            assert not link.is_connected
        assert not device.got
        assert not device.ended
