"""What a zone of many collectors does, on the virtual clock: balance, takeover, messages. Members are the product's.

Collectors keep their leases over a network that loses and delays messages, by clocks that drift. What their links do is
left out: a link is the line time that its reads need. `python tests/support/fleet_scale.py COLLECTORS SETTLE` prints
what one zone does that has settled for so many seconds.
"""

import functools
import gc
import random
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

from fleet_world import Network, World

from busway.apps.collector.cost import line_cost, network_cost
from busway.apps.fleet import lease_holder
from busway.apps.fleet.balance import Share, takers
from busway.apps.fleet.lease_times import LeaseTimes
from busway.apps.fleet.shards import shard_of
from busway.codes import Table
from busway.framing.character_times import SerialTiming

POINTS_OF_A_LINK = 500
POINTS_OF_A_COLLECTOR = 10_000
SERIAL_SHARE = 0.3
"""Part of the links that are serial lines: ten slow devices each, read every ten seconds; the others every second."""


@dataclass(frozen=True, slots=True)
class Scale:
    """What one zone did.

    Attributes:
        collectors, points, shards: how many there were; shards with links only.
        imbalance: how far the worst collector is from the fair load, as a part of that, settled.
        dealt: the same, were all shards dealt anew to collectors without any, the dearest first.
        takeover: seconds from the end of a collector to the moment at which all of its shards were owned.
        changes: of entries in a second that the coordinator was asked for, settled.
        deliveries: of entries in a second to all collectors together, settled.
    """

    collectors: int
    points: int
    shards: int
    imbalance: float
    dealt: float
    takeover: float
    changes: float
    deliveries: float


@contextmanager
def computed_once() -> Iterator[None]:
    """Let members that see the same compute it once: each of a real fleet has a machine for it, and all of these one.

    What is remembered are results of the product's pure functions by all that went in.
    """
    decode_lease = functools.lru_cache(1 << 16)(lease_holder.decode_lease)
    decode_member = functools.lru_cache(1 << 16)(lease_holder.decode_member)
    with mock.patch.multiple(
        lease_holder,
        decode_lease=decode_lease,
        decode_member=decode_member,
        takers=_remembered(lease_holder.takers),
        moves=_remembered(lease_holder.moves),
    ):
        gc.disable()  # a collection looks at the views of all members: millions of entries
        try:
            yield
        finally:
            gc.enable()


def _remembered(decide: Callable[..., Any]) -> Callable[..., Any]:
    @functools.lru_cache(64)
    def decided(shards: tuple[Any, ...], shares: tuple[Any, ...], options: tuple[Any, ...]) -> Any:
        return decide(dict(shards), [Share(*each) for each in shares], **dict(options))

    def remembered(shards: Mapping[str, Any], shares: Iterable[Share], **options: Any) -> Any:
        rows = tuple((each.name, each.host, each.load, each.capacity, each.draining) for each in shares)
        return decided(tuple(shards.items()), rows, tuple(options.items()))

    return remembered


def shard_costs(points: int, shards: int, chance: random.Random) -> dict[str, float]:
    """The line seconds per second of the shards of a plant."""
    serial = line_cost(SerialTiming.of_line(19_200))
    network = network_cost()
    costs: dict[str, float] = {}
    for number in range(points // POINTS_OF_A_LINK):
        if chance.random() < SERIAL_SHARE:
            cost = 10 * serial.of(Table.HOLDING_REGISTERS, 50) / 10.0
        else:
            cost = 5 * network.of(Table.HOLDING_REGISTERS, 100) / 1.0
        shard = shard_of(f"link-{number}", shards)
        costs[shard] = costs.get(shard, 0.0) + cost
    return costs


def scale(collectors: int, *, shards: int = 1024, settle: float = 35.0, watched: float = 6.0, seed: int = 1) -> Scale:
    """Let a zone settle, count for a while, then end one collector as kill -9 does."""
    with computed_once():
        return _scale(collectors, shards, settle, watched, seed)


def _scale(collectors: int, shards: int, settle: float, watched: float, seed: int) -> Scale:
    points = collectors * POINTS_OF_A_COLLECTOR
    costs = shard_costs(points, shards, random.Random(seed))
    network = Network((0.001, 0.05), loss=0.01, late=0.001)
    world = World(costs, seed=seed, network=network, drift=0.001, poll=None)
    for number in range(collectors):
        world.start(f"c{number:04d}")
    world.run(settle)
    imbalance, proposals, deliveries = world.imbalance(), world.proposals, world.deliveries
    world.run(watched)
    proposals, deliveries = world.proposals - proposals, world.deliveries - deliveries
    world.kill("c0000")
    killed = world.now
    limit = killed + 2 * LeaseTimes().ttl
    world.run(LeaseTimes().ttl - 1.0)
    while len(world.owners()) < len(costs) and world.now < limit:
        world.run(0.1)
    takeover = world.now - killed
    return Scale(
        collectors,
        points,
        len(costs),
        imbalance,
        _dealt(costs, collectors),
        takeover,
        proposals / watched,
        deliveries / watched,
    )


def _dealt(costs: Mapping[str, float], collectors: int) -> float:
    loads = dict.fromkeys((f"c{number:04d}" for number in range(collectors)), 0.0)
    for shard, taker in takers(costs, [Share(name, name, 0.0) for name in loads]).items():
        loads[taker] += costs[shard]
    fair = sum(costs.values()) / collectors
    return max(abs(load - fair) / fair for load in loads.values())


if __name__ == "__main__":
    began = time.process_time()
    print(scale(int(sys.argv[1]), settle=float(sys.argv[2])), f"{time.process_time() - began:.0f} s of CPU")
