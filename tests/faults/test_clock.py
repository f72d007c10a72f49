"""A clock that a test moves."""

import asyncio

import pytest

from busway.testing import FakeClock, LoopClock


def test_what_is_due_is_done_in_order_at_its_own_time() -> None:
    clock = FakeClock(100.0)
    done: list[tuple[str, float]] = []
    for name, when in (("c", 103.0), ("a", 101.0), ("b", 101.0), ("never", 200.0)):
        clock.call_at(when, lambda name=name: done.append((name, clock.now())))  # type: ignore[misc]
    cancelled = clock.call_at(102.0, lambda: done.append(("cancelled", clock.now())))
    cancelled.cancel()
    assert clock.next_due == 101.0
    clock.advance(0.5)
    assert done == []
    clock.advance(10)
    assert done == [("a", 101.0), ("b", 101.0), ("c", 103.0)]
    assert (clock.now(), clock.next_due) == (110.5, 200.0)


def test_what_is_asked_for_on_the_way_is_done_on_the_way() -> None:
    clock = FakeClock()
    times: list[float] = []

    def tick() -> None:
        times.append(clock.now())
        if len(times) < 5:
            clock.call_at(clock.now() + 1, tick)

    clock.call_at(1, tick)
    clock.advance(3)
    assert times == [1, 2, 3]
    clock.advance(10)
    assert times == [1, 2, 3, 4, 5]
    assert clock.next_due is None


def test_time_does_not_go_back() -> None:
    with pytest.raises(ValueError, match="back"):
        FakeClock().advance(-1)


async def test_clock_of_a_loop_is_the_loop() -> None:
    loop = asyncio.get_running_loop()
    clock = LoopClock(loop)
    done = asyncio.Event()
    assert clock.now() <= loop.time()
    clock.call_at(clock.now(), done.set)
    clock.call_at(clock.now() + 60, done.clear).cancel()
    async with asyncio.timeout(60):
        await done.wait()
