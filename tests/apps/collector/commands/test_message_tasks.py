"""The tasks that handle messages: they end with their connection, and what they have taken is done all the same."""

import asyncio
import logging

import pytest

from busway.apps.collector.commands.message_tasks import MOST_AT_ONCE, MessageTasks


async def test_tasks_have_ended_when_the_connection_is_left() -> None:
    ended: list[str] = []

    async def answer() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)  # ending takes turns of the loop too
            ended.append("answer")

    async with MessageTasks() as tasks:
        await tasks.begin(answer)
        await tasks.begin(answer)
    assert ended == ["answer", "answer"]


async def test_what_was_begun_takes_its_first_step_although_the_connection_ends_at_once() -> None:
    taken: list[str] = []

    async def take() -> None:
        taken.append("command")
        await asyncio.Event().wait()

    async def receive() -> None:
        async with MessageTasks() as tasks:
            await tasks.begin(take)
            asyncio.current_task().cancel()  # type: ignore[union-attr]  # the collector ends in this very turn
            await asyncio.Event().wait()

    (outcome,) = await asyncio.gather(asyncio.create_task(receive()), return_exceptions=True)
    assert (taken, type(outcome)) == (["command"], asyncio.CancelledError)


async def test_only_so_many_are_handled_at_once_and_none_begins_after_the_end() -> None:
    begun: list[int] = []
    go_on = asyncio.Event()

    async def handle() -> None:
        begun.append(1)
        await go_on.wait()

    async with MessageTasks() as tasks:
        for _ in range(MOST_AT_ONCE):
            await tasks.begin(handle)
        late = [asyncio.create_task(tasks.begin(handle)) for _ in range(3)]
        await asyncio.sleep(0)
    await asyncio.gather(*late)
    assert len(begun) == MOST_AT_ONCE


async def test_a_defect_of_one_message_is_logged_and_the_next_is_handled(caplog: pytest.LogCaptureFixture) -> None:
    handled = asyncio.Event()

    async def fail() -> None:
        raise RuntimeError("a defect")

    async def handle() -> None:
        handled.set()

    with caplog.at_level(logging.ERROR, "busway.collector.commands"):
        async with MessageTasks() as tasks:
            await tasks.begin(fail)
            await tasks.begin(handle)
            await handled.wait()
    assert "by a defect" in caplog.text
