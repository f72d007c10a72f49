"""Reading files again at SIGHUP: the end of it is told, however it ends."""

import asyncio
import os
import signal
from typing import Any, cast

import pytest

from busway.cli.reload_on_sighup import read_again_on_hangup
from busway.errors import ConfigError


class Failing:
    """A service whose files cannot be read again."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    async def reload(self) -> list[str]:
        raise self._error


@pytest.mark.parametrize("error", [ConfigError("wrong"), RuntimeError("a defect")], ids=["refused", "defect"])
async def test_the_end_of_a_reload_that_fails_is_told(error: Exception) -> None:
    told: list[bool] = []
    over = asyncio.Event()
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)  # it would log the defect

    def tell(is_over: bool) -> None:
        told.append(is_over)
        if is_over:
            over.set()

    service = cast("Any", Failing(error))
    async with read_again_on_hangup(service, tell):
        os.kill(os.getpid(), signal.SIGHUP)
        await asyncio.wait_for(over.wait(), 60)
    assert told == [False, True]
