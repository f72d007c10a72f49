"""Makes a running service read its files again at SIGHUP; an error is printed, and the old settings stay."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

from ..errors import ModbusError
from .output import say, say_problems
from .signals import on_hangup

if TYPE_CHECKING:
    from ..apps.service.service import Service


@asynccontextmanager
async def read_again_on_hangup(
    service: "Service", told: Callable[[bool], None] = lambda is_over: None
) -> AsyncIterator[None]:
    """Context manager during which each SIGHUP makes a service read its configuration again; prints the result.

    A reload that still runs at the end of the block is cancelled.

    Args:
        service: the service; it need not run yet.
        told: called with False before each reload, and with True after it, whether it succeeded or not.
    """
    loop = asyncio.get_running_loop()
    tasks: set[asyncio.Task[None]] = set()

    async def read_again() -> None:
        told(False)
        try:
            done = await service.reload()
        except ModbusError as error:
            say_problems("read again, nothing was changed:", str(error))
        except Exception:  # a defect, which asyncio logs; the service goes on
            told(True)
            raise
        else:
            say(f"read again: {'; '.join(done)}")
        told(True)

    def hung_up() -> None:
        task = loop.create_task(read_again())
        tasks.add(task)
        task.add_done_callback(tasks.discard)

    with on_hangup(hung_up):
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
