"""Waiting for what happens of itself in the running event loop, without guessing how long it takes."""

import asyncio
from collections.abc import Callable

ADAPTIVE_TIMEOUT = 10.0
"""Seconds after which something that should happen at once has failed."""


async def until(condition: Callable[[], object], seconds: float = ADAPTIVE_TIMEOUT) -> None:
    """Let the event loop turn until ``condition()`` holds. Raises `TimeoutError`."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - what the condition looks at tells nobody when it changes
            await asyncio.sleep(0)
