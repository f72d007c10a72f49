"""The tasks that handle messages: they end with their connection, and what they have taken is done all the same."""

import asyncio
import logging
from functools import partial

import pytest

from busway.apps.collector.commands.message_tasks import MOST_AT_ONCE, MOST_WAITING, MessageTasks


async def test_tasks_have_ended_when_the_connection_is_left() -> None:
    ended: list[str] = []

    async def answer() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)  # ending takes turns of the loop too
            ended.append("answer")

    async with MessageTasks() as tasks:
        tasks.begin(answer)
        tasks.begin(answer)
    assert ended == ["answer", "answer"]


async def test_what_was_begun_takes_its_first_step_although_the_connection_ends_at_once() -> None:
    taken: list[str] = []

    async def take() -> None:
        taken.append("command")
        await asyncio.Event().wait()

    async def receive() -> None:
        async with MessageTasks() as tasks:
            tasks.begin(take)
            asyncio.current_task().cancel()  # type: ignore[union-attr]  # the collector ends in this very turn
            await asyncio.Event().wait()

    (outcome,) = await asyncio.gather(asyncio.create_task(receive()), return_exceptions=True)
    assert (taken, type(outcome)) == (["command"], asyncio.CancelledError)


async def test_only_so_many_are_handled_at_once_and_those_that_wait_are_not_at_the_end() -> None:
    begun: list[int] = []

    async def handle(number: int) -> None:
        begun.append(number)
        await asyncio.Event().wait()

    async with MessageTasks() as tasks:
        taken = [tasks.begin(partial(handle, number)) for number in range(MOST_AT_ONCE + MOST_WAITING + 3)]
        await asyncio.sleep(0)
    assert tasks.begin(partial(handle, -1))  # and is lost with its connection
    await asyncio.sleep(0)
    assert begun == list(range(MOST_AT_ONCE))
    assert taken == [True] * (MOST_AT_ONCE + MOST_WAITING) + [False] * 3


async def test_messages_that_wait_are_handled_in_the_order_of_their_coming() -> None:
    begun: list[int] = []
    all_begun, go_on = asyncio.Event(), asyncio.Event()

    async def handle(number: int) -> None:
        begun.append(number)
        if len(begun) == MOST_AT_ONCE + MOST_WAITING:
            all_begun.set()
        await go_on.wait()

    async with MessageTasks() as tasks:
        for number in range(MOST_AT_ONCE + MOST_WAITING):
            assert tasks.begin(partial(handle, number))
        await asyncio.sleep(0)
        go_on.set()
        await all_begun.wait()
    assert begun == list(range(MOST_AT_ONCE + MOST_WAITING))


async def test_a_defect_of_one_message_is_logged_and_the_next_is_handled(caplog: pytest.LogCaptureFixture) -> None:
    handled = asyncio.Event()

    async def fail() -> None:
        raise RuntimeError("a defect")

    async def handle() -> None:
        handled.set()

    with caplog.at_level(logging.ERROR, "busway.collector.commands"):
        async with MessageTasks() as tasks:
            tasks.begin(fail)
            tasks.begin(handle)
            await handled.wait()
    assert "by a defect" in caplog.text
