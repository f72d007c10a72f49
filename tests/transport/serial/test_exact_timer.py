"""The timer rings once, when it was set to, and leaves nothing behind."""

import asyncio
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest

from busway.transport.serial import exact_timer as module
from busway.transport.serial.exact_timer import LONGEST_LEAD, ExactTimer


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
    exact_timer = ExactTimer(bell)
    when = time.monotonic() + 0.01
    exact_timer.set(when)
    await asyncio.wait_for(bell.rung.wait(), 60)
    await asyncio.sleep(0.01)
    exact_timer.close()
    assert len(bell.times) == 1
    assert bell.times[0] >= when - 0.001  # the clock of a loop may be another one


async def test_what_the_one_who_is_rung_raises_is_reported(kind: str) -> None:
    reported = asyncio.Event()
    told: list[object] = []

    def report(loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        told.append(context["exception"])
        reported.set()

    def ring() -> None:
        raise error

    error = BlockingIOError("a port that takes nothing")
    asyncio.get_running_loop().set_exception_handler(report)
    exact_timer = ExactTimer(ring)
    exact_timer.set(time.monotonic())
    await asyncio.wait_for(reported.wait(), 60)
    exact_timer.close()
    assert told == [error]


async def test_setting_it_again_moves_it(kind: str) -> None:
    bell = Bell()
    exact_timer = ExactTimer(bell)
    exact_timer.set(time.monotonic() + 3600)
    exact_timer.set(time.monotonic() + 0.001)
    await asyncio.wait_for(bell.rung.wait(), 60)
    bell.rung.clear()
    exact_timer.set(time.monotonic() + 0.001)
    exact_timer.set(later := time.monotonic() + 0.01)
    await asyncio.wait_for(bell.rung.wait(), 60)
    exact_timer.close()
    assert bell.times[1] >= later - 0.001
    assert len(bell.times) == 2


@pytest.mark.parametrize("when", [0.0, -1.0])
async def test_a_time_that_has_passed_rings_in_the_next_turns(kind: str, when: float) -> None:
    bell = Bell()
    exact_timer = ExactTimer(bell)
    exact_timer.set(when)
    assert bell.times == []
    await asyncio.wait_for(bell.rung.wait(), 60)
    exact_timer.close()


@pytest.mark.parametrize("stop", [ExactTimer.cancel, ExactTimer.close])
async def test_it_does_not_ring_after_it_was_stopped(kind: str, stop: Callable[[ExactTimer], None]) -> None:
    bell = Bell()
    exact_timer = ExactTimer(bell)
    exact_timer.set(time.monotonic())
    stop(exact_timer)
    await turns()
    exact_timer.close()
    assert bell.times == []


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are listed by Linux")
async def test_a_closed_exact_timer_has_given_its_descriptor_back(kind: str) -> None:
    before = len(os.listdir("/proc/self/fd"))
    exact_timer = ExactTimer(Bell())
    exact_timer.close()
    exact_timer.close()
    assert len(os.listdir("/proc/self/fd")) == before


@pytest.mark.skipif(sys.platform != "linux", reason="descriptors are listed by Linux")
def test_an_exact_timer_whose_loop_was_closed_under_it_gives_its_descriptor_back_when_it_is_forgotten() -> None:
    async def forget() -> ExactTimer:
        return ExactTimer(lambda: None)

    before = len(os.listdir("/proc/self/fd"))
    exact_timer = asyncio.run(forget())
    del exact_timer
    assert len(os.listdir("/proc/self/fd")) == before


@dataclass
class LateTimer:
    """Stands for the system's timer and its clock: it wakes the loop so many seconds late as it is told."""

    now: float = 1000.0
    set_to: float = 0.0
    ends: tuple[int, int] = field(default_factory=os.pipe)

    def monotonic(self) -> float:
        self.now += 1e-6  # a wait for a time ends
        return self.now

    def set(self, descriptor: int, when: tuple[int, int]) -> None:
        self.set_to = when[0] + when[1] / 1e9

    async def wake(self, late: float) -> None:
        self.now = self.set_to + late
        os.write(self.ends[1], bytes(8))
        await turns(3)


@pytest.fixture
def timer(monkeypatch: pytest.MonkeyPatch) -> Iterator[LateTimer]:
    late_timer = LateTimer()
    monkeypatch.setattr(module, "time", late_timer)
    monkeypatch.setattr(module, "_new_timer", lambda: late_timer.ends[0])
    monkeypatch.setattr(module, "_set_timer", late_timer.set)
    yield late_timer
    os.close(late_timer.ends[1])  # the other end is the timer's


needs_selectors = pytest.mark.skipif(sys.platform == "win32", reason="its loop watches no pipes")


async def lead_after(timer: LateTimer, exact_timer: ExactTimer, late: float, times: int) -> float:
    """How much earlier the timer is set once it was so late so many times."""
    for _ in range(times):
        exact_timer.set(timer.now + 1)
        await timer.wake(late)
    exact_timer.set(2000.0)
    return 2000.0 - timer.set_to


@needs_selectors
async def test_the_timer_is_set_as_much_earlier_as_it_was_late_lately(timer: LateTimer) -> None:
    exact_timer = ExactTimer(lambda: None)
    assert await lead_after(timer, exact_timer, 60e-6, 0) == pytest.approx(0, abs=1e-6)
    assert 0 < await lead_after(timer, exact_timer, 60e-6, 1) < 10e-6
    assert await lead_after(timer, exact_timer, 60e-6, 200) == pytest.approx(60e-6, abs=2e-6)
    assert await lead_after(timer, exact_timer, 20e-6, 1) == pytest.approx(20e-6, abs=2e-6)
    assert await lead_after(timer, exact_timer, 0.5, 200) == pytest.approx(LONGEST_LEAD, abs=1e-6)
    exact_timer.close()


@needs_selectors
async def test_it_does_not_ring_before_its_time_where_the_timer_is_quicker_than_it_was(timer: LateTimer) -> None:
    rung: list[float] = []
    exact_timer = ExactTimer(lambda: rung.append(timer.now))
    assert await lead_after(timer, exact_timer, 80e-6, 200) > 70e-6
    assert timer.set_to < 2000.0 - 70e-6
    await timer.wake(1e-6)
    assert 2000.0 <= rung[-1] < 2000.0 + 5e-6
    exact_timer.close()


@needs_selectors
async def test_a_time_that_has_passed_makes_no_later_exact_timer_ring_early(timer: LateTimer) -> None:
    rung: list[float] = []
    exact_timer = ExactTimer(lambda: rung.append(timer.now))
    exact_timer.set(0.0)
    timer.set_to = timer.now
    await timer.wake(0.0)
    exact_timer.set(3000.0)
    assert timer.set_to >= 3000.0 - LONGEST_LEAD
    await timer.wake(0.0)
    assert rung[-1] >= 3000.0
    exact_timer.close()
