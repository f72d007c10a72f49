"""Ends tasks, also where a library swallows their cancellation.

On Python 3.11 `asyncio.wait_for` can swallow a cancellation that comes in the moment in which it is done: the task goes
on as if nothing had happened. Client libraries call it while they connect.
"""

import asyncio
from collections.abc import Iterable
from typing import Final

AGAIN: Final = 1.0
"""Seconds after which a task that goes on is cancelled again."""


async def end_tasks(tasks: Iterable[asyncio.Task[None]], again: float = AGAIN) -> None:
    """Cancel tasks and wait without limit until all have ended; a task that goes on is cancelled again.

    Errors with which the tasks end are not raised.

    Args:
        tasks: the tasks.
        again: seconds after which a task that goes on is cancelled again: more than it needs to end in order.
    """
    left = {task for task in tasks if not task.done()}
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=again)


def end_if_cancelled() -> None:
    """Raise `CancelledError` if the current task was cancelled, but an awaited function swallowed the cancellation."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError
