"""Closing a link gives its serial port back."""

import asyncio

import pytest

import busway
from busway.testing.line import PacedLine

pytestmark = pytest.mark.real_time


@pytest.mark.clause("S15")
def test_a_port_can_be_opened_again_as_soon_as_its_link_is_closed() -> None:
    async def ask_a_silent_line(url: str) -> None:
        async with busway.open(url, timeout=0.01, retries=0) as link:
            with pytest.raises(busway.NoReply):
                await link.unit(1).read_coils(0, count=1)

    with PacedLine(ports=1, baud=115_200) as line:
        url = f"rtu://{line.paths[0]}?baud=115200&port_wait=0"
        asyncio.run(ask_a_silent_line(url))
        with busway.connect(url, timeout=0.01, retries=0) as link, pytest.raises(busway.NoReply):
            link.unit(1).read_coils(0, count=1)
        asyncio.run(ask_a_silent_line(url))
