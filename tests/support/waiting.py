"""Waiting for an event, in the running event loop or in a thread, without guessing how long it takes."""

import asyncio
import time
from collections.abc import Callable

LONGEST_WAIT = 10.0
"""Seconds after which something that should happen at once has failed."""


async def until(condition: Callable[[], object], seconds: float = LONGEST_WAIT) -> None:
    """Let the event loop turn until ``condition()`` holds. Raises `TimeoutError`."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - what the condition looks at tells nobody when it changes
            await asyncio.sleep(0)


def wait_until(condition: Callable[[], object], seconds: float = LONGEST_WAIT) -> None:
    """Wait in this thread until ``condition()``, about another thread, holds. Raises `TimeoutError`."""
    limit = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > limit:
            raise TimeoutError("what the test waits for did not happen")
        time.sleep(0.005)
