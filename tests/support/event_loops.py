"""The event loops that the library runs on, to run a coroutine on each."""

import asyncio
from collections.abc import Callable, Coroutine
from importlib.util import find_spec
from typing import Any

LOOPS = ["asyncio", *(["uvloop"] if find_spec("uvloop") else [])]
LIMIT = 20.0
"""Seconds for one coroutine: only a hang reaches it."""


def run_on(name: str, main: Callable[[], Coroutine[Any, Any, None]]) -> None:
    """Run a coroutine to its end on a new event loop."""

    async def limited() -> None:
        async with asyncio.timeout(LIMIT):
            await main()

    with asyncio.Runner(loop_factory=_factory(name)) as runner:
        runner.run(limited())


def _factory(name: str) -> Callable[[], asyncio.AbstractEventLoop] | None:
    if name == "asyncio":
        return None
    import uvloop

    factory: Callable[[], asyncio.AbstractEventLoop] = uvloop.new_event_loop
    return factory
