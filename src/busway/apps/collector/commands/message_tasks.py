"""The tasks that handle messages of one broker connection; all of them end before the connection is left.

Knows tasks; knows no message and no broker.

1. At most `MOST_AT_ONCE` messages are handled at once, and at most `MOST_WAITING` wait, in the order of their arrival;
   further ones are dropped. None waits in the library of a broker, where the time of its arrival would be unknown.
2. Leaving the ``async with`` block cancels every task and awaits it. A task that did not have to wait has begun by
   then: the runner has taken its command, executes it, and records it in journal and audit log. Only the answer is
   lost. Messages that still wait are not handled.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Final, Self

MOST_AT_ONCE: Final = 32
"""Most messages of one connection that are handled at once."""
MOST_WAITING: Final = 4 * MOST_AT_ONCE
"""Most messages of one connection that wait to be handled."""

_log = logging.getLogger("busway.collector.commands")


class MessageTasks:
    """The tasks that handle messages of one broker connection, while the ``async with`` block lasts.

    At most `MOST_AT_ONCE` run at once, and `MOST_WAITING` wait, in the order in which they were begun.
    """

    def __init__(self) -> None:
        self._places = asyncio.Semaphore(MOST_AT_ONCE)
        self._tasks: set[asyncio.Task[None]] = set()
        self._has_ended = False

    def begin(self, handle: Callable[[], Awaitable[None]]) -> bool:
        """Start a task that handles a message; it waits while too many others run.

        Args:
            handle: handles the message; its errors are logged.

        Returns:
            False if too many tasks wait: then no task is started, and the message is lost. Else True, also after the
            block has ended, when no task is started either.
        """
        if len(self._tasks) >= MOST_AT_ONCE + MOST_WAITING:
            return False
        if not self._has_ended:
            task = asyncio.create_task(self._handled(handle))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        return True

    async def _handled(self, handle: Callable[[], Awaitable[None]]) -> None:
        waits = self._places.locked()
        async with self._places:
            if waits and self._has_ended:
                return
            try:
                await handle()
            except Exception:  # a defect, whatever it is: other messages are handled all the same
                _log.exception("a message could not be handled, by a defect")

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Cancel all tasks and wait for their end.

        A task that did not have to wait runs its first step before, so that its command is taken (rule 2).
        """
        self._has_ended = True
        await asyncio.sleep(0)
        if self._tasks:
            _log.warning("%d answers to commands are not sent: the connection ends", len(self._tasks))
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks)
