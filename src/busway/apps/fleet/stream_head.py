"""Reads the number of the newest message of a zone's stream; the zone's web page shows by it how far sinks are behind.

Knows the stream's name at NATS; reads no message, so the credentials of a collector permit it.
"""

import asyncio
from importlib import import_module
from typing import Final

from .coordinator import Coordinator

SECONDS: Final = 3.0
"""Longest wait for the server's answer."""


async def newest_message(coordinator: Coordinator, zone: str) -> int | None:
    """Return the number of the newest message of a zone's stream; 0 if it never had one.

    None if there is no stream, or the server does not answer within `SECONDS`. Raises nothing.

    Args:
        coordinator: the coordinator of the zone; only one by NATS has a stream.
        zone: name of the zone.
    """
    client = getattr(coordinator, "client", None)
    if client is None:
        return None
    nats = import_module("nats")
    try:
        async with asyncio.timeout(SECONDS):
            info = await client.jetstream(timeout=SECONDS).stream_info(f"busway-samples-{zone}")
    except (nats.errors.Error, OSError, TimeoutError):
        return None
    return int(info.state.last_seq)
