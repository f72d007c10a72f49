"""Errors with which tasks end, as texts for people."""

import asyncio

import pytest

from busway.apps.collector.task_errors import first_error, log_defect


async def _breaks() -> None:
    raise ValueError("the disk is gone")


def test_the_first_error_of_a_group_is_the_innermost_one_and_the_others_are_its_notes() -> None:
    inner = ValueError("the disk is gone")
    group = ExceptionGroup("unhandled errors", [ExceptionGroup("more of them", [inner]), KeyError("x")])
    assert first_error(group) is inner
    assert inner.__notes__ == ["another task ended at the same time by KeyError: 'x'"]


async def test_a_task_that_ends_by_an_error_is_logged_and_one_that_is_cancelled_is_not(
    caplog: pytest.LogCaptureFixture,
) -> None:
    ended = asyncio.create_task(_breaks(), name="busway upkeep")
    stopped = asyncio.create_task(asyncio.sleep(60), name="busway pause")
    for task in (ended, stopped):
        task.add_done_callback(log_defect)
    stopped.cancel()
    await asyncio.wait([ended, stopped])
    await asyncio.sleep(0)
    (line,) = caplog.records
    assert line.getMessage() == "busway upkeep ended unexpectedly"
    assert str(line.exc_info and line.exc_info[1]) == "the disk is gone"
