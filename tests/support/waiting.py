"""Waiting for an event, in the running event loop or in a thread, without guessing how long it takes."""

import asyncio
import time
from collections.abc import Callable

import pytest

LONGEST_WAIT = 60.0
"""Seconds after which something that should happen at once has failed, however busy the machine is."""


TURNS_AT_ONCE = 1000
"""Turns of the event loop after which other threads, such as that of a line, get time too."""


async def until(condition: Callable[[], object], seconds: float = LONGEST_WAIT) -> None:
    """Let the event loop turn until ``condition()`` holds. Raises `TimeoutError`."""
    turns = 0
    async with asyncio.timeout(seconds):
        while not condition():
            turns += 1
            await asyncio.sleep(0 if turns < TURNS_AT_ONCE else 0.002)


def set_forward(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """From now on the monotonic clock of this process is some seconds ahead: what is due by then is due now.

    The limit of a coroutine test, 100 seconds, may be due by then too.
    """
    before = time.monotonic
    monkeypatch.setattr(time, "monotonic", lambda: before() + seconds)


def wait_until(condition: Callable[[], object], seconds: float = LONGEST_WAIT) -> None:
    """Wait in this thread until ``condition()``, about another thread, holds. Raises `TimeoutError`."""
    limit = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > limit:
            raise TimeoutError("what the test waits for did not happen")
        time.sleep(0.005)
