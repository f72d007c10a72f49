"""The tasks that handle messages of one broker connection; all of them end before the connection is left.

Knows tasks; knows no message and no broker.

1. At most `MOST_AT_ONCE` messages are handled at once; further ones wait at the broker or in its library.
2. Leaving ends every task and awaits it. Each has begun by then, so that its command has been taken, is done by the
   runner, recorded and audited; what is lost is the answer.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Final, Self

MOST_AT_ONCE: Final = 32
"""Messages of one connection that are handled at once."""

_log = logging.getLogger("busway.collector.commands")


class MessageTasks:
    """The tasks that handle messages of one broker connection, while the ``async with`` block lasts."""

    def __init__(self) -> None:
        self._places = asyncio.Semaphore(MOST_AT_ONCE)
        self._tasks: set[asyncio.Task[None]] = set()
        self._has_ended = False

    async def begin(self, handle: Callable[[], Awaitable[None]]) -> None:
        """Start a task that handles a message, once there is room for one (rule 1); ignored after the end."""
        await self._places.acquire()
        if self._has_ended:  # while it waited
            self._places.release()  # the next that waits shall see it too
            return
        task = asyncio.create_task(_handled(handle))
        self._tasks.add(task)
        task.add_done_callback(self._leave)

    def _leave(self, task: "asyncio.Task[None]") -> None:
        self._tasks.discard(task)
        self._places.release()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all tasks that handle messages; one just created takes its first step before (rule 2)."""
        self._has_ended = True
        await asyncio.sleep(0)
        if self._tasks:
            _log.warning("%d answers to commands are not sent: the connection ends", len(self._tasks))
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks)


async def _handled(handle: Callable[[], Awaitable[None]]) -> None:
    try:
        await handle()
    except Exception:  # a defect, whatever it is: other messages are handled all the same
        _log.exception("a message could not be handled, by a defect")
