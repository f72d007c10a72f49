"""Real NATS servers lose something: the one that decides on leases, after which none lapses, or the table of keys."""

import asyncio
import contextlib
import random
import signal
from functools import partial
from pathlib import Path

import pytest
from foreign_servers import nats_cluster, nats_server
from waiting import until

from busway.apps.collector.cancellation import end_tasks
from busway.apps.collector.commands.command import CommandResult, CommandState, PointCommand
from busway.apps.fleet.coordinator import CoordinatorDown
from busway.apps.fleet.coordinators.nats import NatsCoordinator, open_nats
from busway.apps.fleet.coordinators.opening import CoordinatorOptions, until_up
from busway.apps.fleet.key_table import KeyTable, slot_of
from busway.apps.fleet.lease_driver import LeaseDriver
from busway.apps.fleet.lease_holder import LeaseHolder, OwnershipChange, ShardEvent
from busway.apps.fleet.lease_times import LeaseTimes

pytest.importorskip("nats")
SHARDS = 32
MEMBERS = 3


async def leader_of(table: NatsCoordinator) -> str:
    """The server that leads the stream of the table."""
    import nats

    while True:
        with contextlib.suppress(nats.errors.Error, TimeoutError):
            info = await table.client.jetstream(timeout=1.0).stream_info("KV_busway-hall")
            behind = [each.name for each in info.cluster.replicas or () if not each.current]
            if info.cluster.leader and not behind:
                return str(info.cluster.leader)
        await asyncio.sleep(0.1)


def hand_on(member: LeaseHolder, event: ShardEvent) -> None:
    """Let a shard go that is to move: it has no links here."""
    if event.change is OwnershipChange.LEAVE:
        member.left(event.shard)


async def lapsed_after_kills(folder: Path, kills: int) -> int:
    """How many leases lapse while the leader is killed and comes back, one time after the other."""
    servers = nats_cluster(folder, 3)
    url = "nats://" + ",".join(f"127.0.0.1:{server.port}" for server in servers)
    options = CoordinatorOptions(replicas=3)
    async with contextlib.AsyncExitStack() as stack:
        for server in servers:
            server._stop = signal.SIGKILL
            stack.enter_context(server)

        async def opened() -> NatsCoordinator:
            table = await until_up(lambda: open_nats(url, "hall", options), CoordinatorDown, 60)
            stack.push_async_callback(table.close)
            return table

        members: list[LeaseHolder] = []
        for number in range(MEMBERS):
            name = f"c{number}"
            member = LeaseHolder(name, f"run-{number}", name, LeaseTimes(), random.Random(number), shards=SHARDS)
            member.set_shards({f"{shard:04d}": 0.1 for shard in range(SHARDS)})
            members.append(member)
            driver = LeaseDriver(member, await opened(), partial(hand_on, member))
            stack.push_async_callback(end_tasks, [asyncio.create_task(driver.run())])
        watching = await opened()
        await until(lambda: all(len(each.owned) > SHARDS // 6 for each in members), 90)
        for _ in range(kills):
            killed = servers[int((await leader_of(watching)).removeprefix("n"))]
            killed.stop()
            counts = [each.counts.renewals for each in members]
            await until(
                lambda counts=counts: all(  # type: ignore[misc]
                    each.counts.renewals > count + 2 * SHARDS // MEMBERS
                    for each, count in zip(members, counts, strict=True)
                ),
                90,
            )
            killed.start()
        return sum(each.counts.lapsed for each in members)


@pytest.mark.real_time
@pytest.mark.alone
async def test_no_lease_lapses_when_the_server_that_decides_on_leases_is_killed(tmp_path: Path) -> None:
    assert await lapsed_after_kills(tmp_path, 1) == 0


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_no_lease_lapses_in_twenty_kills(tmp_path: Path) -> None:
    assert asyncio.run(lapsed_after_kills(tmp_path, 20)) == 0


@pytest.mark.real_time
async def test_a_server_that_has_lost_the_table_of_keys_gets_the_keys_that_a_collector_knows(tmp_path: Path) -> None:
    def opened(key: str) -> CommandResult:
        return CommandResult(PointCommand(key, "boiler", "setpoint", 7, "anna", "api", 1030.0), CommandState.OPEN, 1.0)

    new = next(key for key in (f"n{number}" for number in range(5000)) if slot_of(key) == slot_of("k1"))
    with nats_server(tmp_path) as server:
        url = f"nats://127.0.0.1:{server.port}"
        table = await until_up(lambda: open_nats(url, "hall", CoordinatorOptions()), CoordinatorDown, 60)
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(table.close)
            async with KeyTable(table, "west") as west:
                assert await west.claim(opened("k1")) is None
                await until(lambda: bool(west._seen))
                await table.client.jetstream().purge_stream("KV_busway-hall")
                assert await west.claim(opened(new)) is None
                assert await west.claim(opened("k1")) is not None
            async with KeyTable(table, "east") as east:
                await until(lambda: bool(east._seen))
                assert await east.claim(opened("k1")) is not None
