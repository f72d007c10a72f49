"""The alarm rings once, when it was set to, and leaves nothing behind."""

import asyncio
import os
import sys
import time
from collections.abc import Callable

import pytest

from busway.transport.serial import alarm as module
from busway.transport.serial.alarm import Alarm


@pytest.fixture(params=["exact", "loop"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With the system's timer, where there is one, and with those of the loop."""
    if request.param == "loop":
        monkeypatch.setattr(module, "_libc", None)
    return str(request.param)


class Bell:
    """Notes when it was rung."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.rung = asyncio.Event()

    def __call__(self) -> None:
        self.times.append(time.monotonic())
        self.rung.set()


async def turns(count: int = 5) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


async def test_it_rings_once_and_not_before_its_time(kind: str) -> None:
    bell = Bell()
    alarm = Alarm(bell)
    when = time.monotonic() + 0.01
    alarm.set(when)
    await asyncio.wait_for(bell.rung.wait(), 5)
    await asyncio.sleep(0.01)
    alarm.close()
    assert len(bell.times) == 1
    assert bell.times[0] >= when - 0.001  # the clock of a loop may be another one


async def test_setting_it_again_moves_it(kind: str) -> None:
    bell = Bell()
    alarm = Alarm(bell)
    alarm.set(time.monotonic() + 3600)
    alarm.set(time.monotonic() + 0.001)
    await asyncio.wait_for(bell.rung.wait(), 5)
    bell.rung.clear()
    alarm.set(time.monotonic() + 0.001)
    alarm.set(later := time.monotonic() + 0.01)
    await asyncio.wait_for(bell.rung.wait(), 5)
    alarm.close()
    assert bell.times[1] >= later - 0.001
    assert len(bell.times) == 2


@pytest.mark.parametrize("when", [0.0, -1.0])
async def test_a_time_that_has_passed_rings_in_the_next_turns(kind: str, when: float) -> None:
    bell = Bell()
    alarm = Alarm(bell)
    alarm.set(when)
    assert bell.times == []
    await asyncio.wait_for(bell.rung.wait(), 5)
    alarm.close()


@pytest.mark.parametrize("stop", [Alarm.cancel, Alarm.close])
async def test_it_does_not_ring_after_it_was_stopped(kind: str, stop: Callable[[Alarm], None]) -> None:
    bell = Bell()
    alarm = Alarm(bell)
    alarm.set(time.monotonic())
    stop(alarm)
    await turns()
    alarm.close()
    assert bell.times == []


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are listed by Linux")
async def test_a_closed_alarm_has_given_its_descriptor_back(kind: str) -> None:
    before = len(os.listdir("/proc/self/fd"))
    alarm = Alarm(Bell())
    alarm.close()
    alarm.close()
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are listed by Linux")
def test_an_alarm_whose_loop_was_closed_under_it_gives_its_descriptor_back_when_it_is_forgotten() -> None:
    async def forget() -> Alarm:
        return Alarm(lambda: None)

    before = len(os.listdir("/proc/self/fd"))
    alarm = asyncio.run(forget())
    del alarm
    assert len(os.listdir("/proc/self/fd")) == before
