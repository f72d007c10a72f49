"""Simulated units that misbehave, served in a thread by the real server on any transport."""

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from typing import Any

import busway
from busway.faults.switchboard import FaultSwitchboard
from busway.server.server import Server
from busway.testing import known_device


@contextlib.contextmanager
def played(switchboard: FaultSwitchboard, url: str, **options: Any) -> Iterator[str]:
    """Two units, each a `known_device`, with the faults of a switchboard; yields the endpoint."""
    units = {1: known_device(), 2: known_device()}
    ready = threading.Event()
    loops: list[asyncio.AbstractEventLoop] = []
    ends: list[asyncio.Event] = []
    servers: list[Server] = []

    async def serve() -> None:
        server = busway.serve(url, units=units, **options)
        switchboard.attach(server)
        async with server:
            loops.append(asyncio.get_running_loop())
            ends.append(asyncio.Event())
            servers.append(server)
            ready.set()
            await ends[0].wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="played faults", daemon=True)
    thread.start()
    assert ready.wait(10.0), "the server did not start"
    try:
        yield servers[0].endpoints[0]
    finally:
        loops[0].call_soon_threadsafe(ends[0].set)
        thread.join()
