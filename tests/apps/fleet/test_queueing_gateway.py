"""Links behind a gateway that holds requests: none of a former owner reaches a device after one of the next owner."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator
from pathlib import Path

import pytest
from fleet_devices import FleetDevice, plant
from queueing_gateway import OnTheLine, QueueingGateway, late_frames
from waiting import until

from busway.apps.collector.configuration import parse_collector
from busway.apps.fleet.coordinator import Entry
from busway.apps.fleet.coordinators.local import LocalCoordinator
from busway.apps.fleet.fleet_collector import FleetCollector
from busway.apps.fleet.lease_times import LeaseTimes

HELD = 4.0
"""Seconds for which the gateway holds requests of the first owner, and the longest that such leases can allow for."""
LATE = 3.5
"""Seconds from the cut: an owner that knows of the gateway has stopped by then, one that does not polls on."""
LONG = 10.0
"""Seconds after which a takeover is over."""
TIMES = LeaseTimes(ttl=6.0, renew=0.5, guard=0.3, answer=1.0)
QUICK = "timeout = 0.3\nconnect_timeout = 0.3"
ADDRESSES = {"one": "127.0.0.1", "two": "127.0.0.2"}

pytestmark = pytest.mark.real_time


class Cut(LocalCoordinator):
    """A table that a collector does not reach while ``is_cut``."""

    is_cut = False

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        await self._reached()
        return await super().replace(key, value, revision)

    async def create(self, key: str, value: bytes) -> int:
        await self._reached()
        return await super().create(key, value)

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        async for entry in super().watch(prefix):
            await self._reached()
            yield entry

    async def _reached(self) -> None:
        if self.is_cut:
            await asyncio.get_running_loop().create_future()


@contextlib.asynccontextmanager
async def collecting(
    tmp_path: Path, name: str, gateway: QueueingGateway, wait: float
) -> AsyncIterator[tuple[FleetCollector, Cut]]:
    options = f'{QUICK}\nlocal_address = "{ADDRESSES[name]}"\ngateway_wait = {wait}'
    configuration = parse_collector(plant(tmp_path / name, [FleetDevice("line", gateway.port)], options), "x.toml")
    coordinator = await asyncio.to_thread(Cut, tmp_path / "zone", "hall")
    try:
        async with FleetCollector(configuration, coordinator, name, host=name, shards=1, times=TIMES) as collector:
            yield collector, coordinator
    finally:
        await coordinator.close()


async def line_of(tmp_path: Path, how: str, wait: float, held: float) -> list[OnTheLine]:
    """What a device sees when its link goes from one collector to another while the gateway holds requests.

    Args:
        how: ``cut``: the first owner loses the coordinator while requests are held; ``held late``: the same, and
            requests are held only from `LATE` on, until when the owner has polled without a pause; ``drain``: the first
            owner is drained while requests are held.
        wait: for how long the gateway holds requests, as the plant says.
        held: for how long it does.
    """
    one_at, two_at = ADDRESSES.values()
    async with (
        QueueingGateway().serving() as gateway,
        collecting(tmp_path, "one", gateway, wait) as (one, its_table),
    ):
        await until(lambda: len(gateway.line) > 5, 60)
        async with collecting(tmp_path, "two", gateway, wait) as (two, _):
            await until(lambda: two.member.members(two._now())[1:], 60)
            if how == "held late":
                its_table.is_cut = True
                await asyncio.sleep(LATE)
                gateway.held[one_at] = held
            else:
                gateway.held[one_at] = held
                await until(lambda: gateway.waiting > 0, 60)
                its_table.is_cut = how == "cut"
                one.member.drain(draining=how == "drain")
            await until(lambda: two_at in gateway.clients() and not gateway.waiting, 60)
            seen = len(gateway.line)
            await until(lambda: len(gateway.line) > seen + 5, 60)
            return list(gateway.line)


@pytest.mark.parametrize("how", ["cut", "held late", "drain"])
async def test_a_link_goes_to_the_next_owner_when_no_request_of_the_former_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_collector.END_LIMIT", 0.1)
    line = await line_of(tmp_path, how, HELD, HELD)
    assert late_frames(line) == []
    assert how == "held late" or any(each.left - each.arrived > HELD - 0.5 for each in line), "some were held"


@pytest.mark.parametrize("how", ["cut", "held late", "drain"])
async def test_without_the_option_the_device_sees_requests_of_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    monkeypatch.setattr("busway.apps.fleet.fleet_collector.END_LIMIT", 0.1)
    late = late_frames(await line_of(tmp_path, how, 0.0, LONG))
    assert {each.client for each in late} == {ADDRESSES["one"]}
