"""Four servers of `busway serve` in one process: a server has 256 units at most, and each has the 250 of its file.

Run from `bench/`: python -m servers.busway_four_plants FILE; tells four ports.

What the command loads is loaded; options of its command line and signals are left out.
"""

import asyncio
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from urllib.parse import urlsplit

import busway.cli.program
import busway.cli.serve  # noqa: F401
from busway.apps.service.configuration import parse_configuration
from busway.apps.service.file_warnings import logging_warnings
from busway.apps.service.overrides import Overrides
from busway.apps.service.service import Service
from busway.server.loops import run

SERVERS = 4


async def main(file: str, text: str) -> None:
    overrides = Overrides(listen=("tcp://127.0.0.1:0",), control="off", can_reload=True)
    async with AsyncExitStack() as running:
        ports = []
        read = logging_warnings(lambda: parse_configuration(text, file))
        for _ in range(SERVERS):
            service = await running.enter_async_context(Service(read, overrides))
            ports.append(urlsplit(service.server.endpoints[0]).port)
        print("port", *ports, flush=True)
        await asyncio.Event().wait()


run(main(sys.argv[1], Path(sys.argv[1]).read_text()))
