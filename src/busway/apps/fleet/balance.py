"""The balance of a zone's load: which collector takes a shard without owner, and which shards move to another one.

Pure; knows loads and names. Every collector computes the same from what it sees, and does its own part only.

1. Load is what the links of a shard need of their own time: seconds per second, from the read plans. The fair load of a
   collector is its part of the sum, by capacity.
2. Free shards go to the least loaded, the dearest shard first.
3. Shards move where a collector is further than `BEGIN` from the fair load, and until all are within `END`: between the
   two nothing moves, so loads that change a little move nothing.
4. A move takes the shard that levels giver and taker best: the fewest moves, since each costs its links a moment.
5. A collector that drains gives all it has; one that another host cannot reach is never asked to take a pinned shard.
"""

from bisect import bisect_left, insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from .shards import hosts_of

BEGIN: Final = 0.08
"""Part of the fair load that a collector must be off before shards move."""
END: Final = 0.04
"""Part of the fair load within which collectors are left alone, once shards move."""
MOST_MOVES: Final = 64
"""Moves that are planned at once, in the whole zone."""


@dataclass(slots=True)
class Share:
    """The load and the capacity of one of the collectors that share a plant.

    Attributes:
        name, host: its names.
        load: seconds of line time per second that its shards need.
        capacity: its share of the work, relative to the others.
        draining: whether it gives all and takes nothing.
    """

    name: str
    host: str
    load: float
    capacity: float = 1.0
    draining: bool = False

    def relative(self, extra: float = 0.0) -> float:
        """Return the collector's load divided by its capacity, after ``more`` load was added."""
        return (self.load + extra) / self.capacity


@dataclass(frozen=True, slots=True)
class Move:
    """A shard (group of links) that is to move from its owner to another collector."""

    shard: str
    giver: str
    taker: str


def takers(free: Mapping[str, float], shares: Iterable[Share]) -> dict[str, str]:
    """Return which collector takes which shard (group of links) without owner; shards that no collector may take are
    left out.

    Args:
        free: the cost of each free shard.
        shares: the collectors that live; they are not changed.
    """
    able = [Share(each.name, each.host, each.load, each.capacity) for each in shares if not each.draining]
    found: dict[str, str] = {}
    for shard, cost in sorted(free.items(), key=lambda item: (-item[1], item[0])):
        taker = _taker(shard, cost, able)
        if taker is not None:
            taker.load += cost
            found[shard] = taker.name
    return found


def moves(owned: Mapping[str, tuple[str, float]], shares: Iterable[Share], *, moving: bool = False) -> list[Move]:
    """Return the moves of shards (groups of links) that make the loads of a zone's collectors fair.

    Args:
        owned: owner and cost of each shard.
        shares: the collectors that live; they are not changed.
        moving: whether shards move already, so that moving goes on until `END`.
    """
    state = {
        each.name: Share(each.name, each.host, each.load, each.capacity, each.draining)
        for each in sorted(shares, key=lambda each: each.name)
    }
    able = [each for each in state.values() if not each.draining]
    if not able:
        return []
    found = _drained(owned, state, able)
    fair = sum(each.load for each in state.values()) / sum(each.capacity for each in able)
    if len(able) > 1 and fair > 0 and _is_off(able, fair, END if moving or found else BEGIN):
        _level(owned, {move.shard for move in found}, able, fair, found)
    return found


def _drained(owned: Mapping[str, tuple[str, float]], state: Mapping[str, Share], able: list[Share]) -> list[Move]:
    """Return the moves of shards (groups of links) away from collectors that are being emptied."""
    found: list[Move] = []
    leaving = [(cost, shard, owner) for shard, (owner, cost) in owned.items() if owner in state]
    for cost, shard, owner in sorted(leaving, reverse=True):
        if len(found) < MOST_MOVES and state[owner].draining:
            taker = _taker(shard, cost, able)
            if taker is not None:
                taker.load += cost
                state[owner].load -= cost
                found.append(Move(shard, owner, taker.name))
    return found


def _level(
    owned: Mapping[str, tuple[str, float]], left_out: set[str], able: list[Share], fair: float, found: list[Move]
) -> None:
    costs: dict[str, list[tuple[float, str]]] = {each.name: [] for each in able}
    for shard, (owner, cost) in owned.items():
        if owner in costs and shard not in left_out and cost > 0 and not hosts_of(shard):
            costs[owner].append((cost, shard))
    for each in costs.values():
        each.sort()
    # In order of load, so that a zone of a thousand collectors costs a look no more than a few of them.
    order = sorted((each.relative(), each.name) for each in able)
    by_name = {each.name: each for each in able}
    stuck: set[str] = set()
    while len(found) < MOST_MOVES and (order[-1][0] > fair * (1 + END) or order[0][0] < fair * (1 - END)):
        name = next((name for _, name in reversed(order) if name not in stuck), None)
        if name is None:
            return
        giver, taker = by_name[name], by_name[order[0][1]]
        best = _best(costs[giver.name], giver, taker)
        if best is None:
            stuck.add(giver.name)
            continue
        for share in (giver, taker):
            del order[bisect_left(order, (share.relative(), share.name))]
        costs[giver.name].remove(best)
        insort(costs[taker.name], best)
        giver.load -= best[0]
        taker.load += best[0]
        for share in (giver, taker):
            insort(order, (share.relative(), share.name))
        found.append(Move(best[1], giver.name, taker.name))


def _best(costs: list[tuple[float, str]], giver: Share, taker: Share) -> tuple[float, str] | None:
    """Return the shard (group of links) whose move levels the loads of two collectors best; None if no move helps."""
    if giver is taker:
        return None
    wanted = (giver.relative() - taker.relative()) / (1 / giver.capacity + 1 / taker.capacity)
    place = bisect_left(costs, (wanted, ""))
    near = [each for each in costs[max(0, place - 1) : place + 1] if taker.relative(each[0]) < giver.relative()]
    return min(near, key=lambda each: (abs(each[0] - wanted), each[1]), default=None)


def _taker(shard: str, cost: float, able: list[Share]) -> Share | None:
    hosts = hosts_of(shard)
    for host in hosts:
        there = [each for each in able if each.host == host]
        if there:
            return min(there, key=lambda each: (each.relative(cost), each.name))
    return None if hosts else min(able, key=lambda each: (each.relative(cost), each.name), default=None)


def _is_off(able: list[Share], fair: float, limit: float) -> bool:
    relative = [each.relative() for each in able]
    return max(relative) > fair * (1 + limit) or min(relative) < fair * (1 - limit)
