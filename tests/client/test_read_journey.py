"""The journey of a read, as docs/architecture.md tells it: which files of the package it passes."""

import asyncio
import sys
from pathlib import Path
from types import FrameType

import pytest

import busway

PACKAGE = f"{Path(busway.__file__).parent}/"
PAGE = Path(__file__).parents[2] / "docs" / "architecture.md"
JOURNEY = 9
"""Files that a read in asyncio passes at most."""


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while len(request := await reader.read(12)) == 12:
        writer.write(request[:4] + bytes((0, 23)) + request[6:8] + bytes((20,)) + bytes(20))
    writer.close()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the loop's own transports carry the bytes")
async def test_a_read_passes_few_files_and_the_page_names_each() -> None:
    passed: set[str] = set()

    def profile(frame: FrameType, event: str, argument: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            passed.add(frame.f_code.co_filename.removeprefix(PACKAGE))

    server = await asyncio.start_server(_answer, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    async with server, busway.open(f"tcp://127.0.0.1:{port}", shared=False) as link:
        unit = link.unit(1)
        await unit.read_holding_registers(5, count=10)  # compiles the codecs, and connects
        before = sys.getprofile()
        sys.setprofile(profile)
        try:
            assert await unit.read_holding_registers(0, count=10) == [0] * 10
        finally:
            sys.setprofile(before)
    assert len(passed) <= JOURNEY, sorted(passed)
    text = PAGE.read_text(encoding="utf-8")
    journey = text[text.index("## Journey 1") : text.index("## Journey 2")]
    assert [one for one in sorted(passed) if one.removeprefix("transport/epoll/") not in journey] == []
