"""Members with real coordinators and real time, short leases."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest
from foreign_servers import nats_server

from busway.apps.fleet.coordinators import open_coordinator
from busway.apps.fleet.coordinators.opening import CoordinatorOptions
from busway.apps.fleet.lease_driver import LeaseDriver, boot_time
from busway.apps.fleet.lease_holder import LeaseHolder, OwnershipChange, ShardEvent
from busway.apps.fleet.lease_times import LeaseTimes

COSTS = {f"{number:04d}": 0.05 for number in range(8)}
TIMES = LeaseTimes(ttl=3.0, renew=0.6, guard=0.3, answer=0.5)

pytestmark = pytest.mark.real_time


class Collecting:
    """A member whose links stop at once when they are to."""

    def __init__(self, name: str) -> None:
        self.member = LeaseHolder(name, f"run of {name}", name, TIMES, random.Random(name))
        self.member.set_shards(COSTS)
        self.events: list[ShardEvent] = []
        self.driver: LeaseDriver | None = None

    def told(self, event: ShardEvent) -> None:
        self.events.append(event)
        if event.change is OwnershipChange.LEAVE:
            assert self.driver is not None
            self.member.left(event.shard)
            self.driver.wake()


@contextlib.asynccontextmanager
async def running(url: str, name: str) -> AsyncIterator[Collecting]:
    one = Collecting(name)
    coordinator = await open_coordinator(url, "hall", CoordinatorOptions(answer=0.5))
    one.driver = LeaseDriver(one.member, coordinator, one.told)
    task = asyncio.create_task(one.driver.run())
    try:
        yield one
    finally:
        task.cancel()
        await asyncio.wait([task])
        await coordinator.close()


async def until(condition: Callable[[], bool], seconds: float = 20.0) -> float:
    begun = boot_time()
    while not condition():
        assert boot_time() < begun + seconds, "it did not come"
        await asyncio.sleep(0.02)
    return boot_time() - begun


async def test_two_collectors_share_and_the_other_takes_over_what_one_has_left_behind(tmp_path: Path) -> None:
    url = f"local:{tmp_path}"
    async with contextlib.AsyncExitStack() as stack:
        one = await stack.enter_async_context(running(url, "one"))
        async with running(url, "two") as two:
            await until(lambda: {len(one.member.owned), len(two.member.owned)} == {4})
        took = await until(lambda: len(one.member.owned) == 8)
        assert took < TIMES.ttl + TIMES.guard + 2.0
        assert all(event.change is not OwnershipChange.LOST for event in two.events)


async def test_a_collector_that_ends_in_order_hands_everything_on_at_once(tmp_path: Path) -> None:
    url = f"local:{tmp_path}"
    async with running(url, "one") as one, running(url, "two") as two:
        await until(lambda: {len(one.member.owned), len(two.member.owned)} == {4})
        assert two.driver is not None
        assert await two.driver.end(5.0)
        assert await until(lambda: len(one.member.owned) == 8) < TIMES.ttl


async def test_a_server_that_is_away_for_longer_than_a_lease_ends_all_ownership_until_it_is_back(
    tmp_path: Path,
) -> None:
    pytest.importorskip("nats")
    with nats_server(tmp_path) as server:
        async with running(f"nats://127.0.0.1:{server.port}", "one") as one:
            await until(lambda: len(one.member.owned) == 8)
            first = {shard: each.epoch for shard, each in one.member.owned.items()}
            server.stop()
            await until(lambda: not one.member.owned)
            assert one.driver is not None
            assert one.driver.error is not None
            assert not one.member.permits("0000", boot_time(), 0.0)
            server.start()
            await until(lambda: len(one.member.owned) == 8)
            assert all(each.epoch > first[shard] for shard, each in one.member.owned.items())


async def test_a_defect_of_a_coordinator_is_an_unknown_outcome_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(f"local:{tmp_path}", "one") as one:
        await until(lambda: len(one.member.owned) == 8)
        assert one.driver is not None
        honest = one.driver._coordinator.replace

        async def broken(*_: object) -> int:
            raise RuntimeError("the protocol is in a state that it cannot have")

        monkeypatch.setattr(one.driver._coordinator, "replace", broken)
        await until(lambda: one.driver is not None and one.driver.error is not None)
        monkeypatch.setattr(one.driver._coordinator, "replace", honest)
        renewals = one.member.counts.renewals
        await until(lambda: len(one.member.owned) == 8 and one.member.counts.renewals > renewals + 16)


@pytest.mark.parametrize("error", [RuntimeError("a state that it cannot have"), asyncio.CancelledError()], ids=repr)
async def test_a_watch_that_ends_by_a_defect_is_begun_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    async with running(f"local:{tmp_path}", "one") as one:
        await until(lambda: len(one.member.owned) == 8)
        assert one.driver is not None
        taken_in = one.member.entry
        left = [error]

        def broken(*entry: object) -> None:
            if left:
                raise left.pop()
            taken_in(*entry)  # type: ignore[arg-type]

        monkeypatch.setattr(one.member, "entry", broken)
        await until(lambda: not left)
        renewals = one.member.counts.renewals
        await until(lambda: len(one.member.owned) == 8 and one.member.counts.renewals > renewals + 16)
        async with running(f"local:{tmp_path}", "two") as two:
            await until(lambda: {len(one.member.owned), len(two.member.owned)} == {4})
