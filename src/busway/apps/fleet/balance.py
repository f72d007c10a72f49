"""The balance of a zone's load: which collector takes a shard without owner, and which shards move to another one.

Pure; knows loads and names. Every collector computes the plan for the whole zone from what it sees in the shared table,
and carries out only its own part of the plan.

1. The load of a shard is the line time that polling its links needs: seconds per second, from the read plans. The fair
   load of a collector is its part of the sum of all loads, in proportion to its capacity.
2. Free shards go to the least loaded collector, the shard with the highest load first.
3. Shards begin to move when the load of a collector is further than `BEGIN` from its fair load, and go on moving until
   all collectors are within `END`. So small changes of loads move nothing.
4. A move takes the shard that makes the loads of giver and taker most equal, so that few moves are needed: each move
   interrupts the polling of its links for a moment.
5. If no move improves the balance any more, two collectors exchange a shard with more load for one with less, if that
   removes more than half of the difference between the collectors: if shards are few and unlike, nothing else levels
   the loads. Each collector takes part in one exchange at a time.
6. A collector that drains gives away all its shards. A pinned shard (`pinned_shard`) goes only to a collector on one of
   its hosts, the first host with a live collector; it never moves to level loads.
"""

from bisect import bisect_left, insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import Final

from .shards import hosts_of

BEGIN: Final = 0.08
"""Fraction of the fair load: shards begin to move when a collector's load differs from its fair load by more."""
END: Final = 0.04
"""Fraction of the fair load: once shards move, they go on until no collector's load differs by more."""
MOST_MOVES: Final = 64
"""Most moves that one plan has, for the whole zone."""
MOST_TRIED: Final = 8
"""Most collectors with which an exchange is tried for one giver, the least loaded first."""


@dataclass(slots=True)
class Share:
    """One of the collectors that share a plant, with its load and capacity.

    Attributes:
        name: name of the collector.
        host: name of its machine.
        load: seconds of line time per second that polling its shards (groups of links) needs.
        capacity: the collector's part of the work, relative to the others; above 0.
        draining: whether the collector gives away all its shards and takes none.
    """

    name: str
    host: str
    load: float
    capacity: float = 1.0
    draining: bool = False

    def relative(self, extra: float = 0.0) -> float:
        """Return the collector's load, plus ``extra`` load, divided by its capacity."""
        return (self.load + extra) / self.capacity


@dataclass(frozen=True, slots=True)
class Move:
    """A shard (group of links) that is to move from its owner to another collector.

    Attributes:
        shard: name of the shard.
        giver, taker: names of the collectors that give the shard away and get it.
    """

    shard: str
    giver: str
    taker: str


def takers(free: Mapping[str, float], shares: Iterable[Share]) -> dict[str, str]:
    """Return which collector should take each shard (group of links) that has no owner, by name of the shard.

    The shard with the highest cost is placed first; each goes to the collector whose load relative to its capacity is
    then lowest. Collectors that drain take none. A pinned shard goes to a collector on the first of its hosts where one
    can take it. Shards that no collector can take are left out.

    Args:
        free: the cost of each shard without owner, by name, in seconds of line time per second.
        shares: the live collectors; they are not changed.
    """
    able = _Takers(Share(each.name, each.host, each.load, each.capacity) for each in shares if not each.draining)
    found: dict[str, str] = {}
    for shard, cost in sorted(free.items(), key=lambda item: (-item[1], item[0])):
        taker = able.take(shard, cost)
        if taker is not None:
            found[shard] = taker.name
    return found


def moves(owned: Mapping[str, tuple[str, float]], shares: Iterable[Share], *, moving: bool = False) -> list[Move]:
    """Return the moves of shards (groups of links) that empty draining collectors and level the loads of the others.

    At most `MOST_MOVES` moves are returned. Empty if all collectors are draining, if no collector with shards is and
    the loads are fair enough (rule 3), or if no move helps.

    Args:
        owned: by name of each shard, the name of its owner and its cost in seconds of line time per second.
        shares: the live collectors; they are not changed.
        moving: whether shards are moving now: then the loads are levelled until all are within `END`.
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
    """Return the moves of shards (groups of links) away from the collectors that drain, the costliest shard first.

    Changes the loads of the collectors in ``state``.

    Args:
        owned: by name of each shard, the name of its owner and its cost in seconds of line time per second.
        state: all collectors, by name.
        able: the collectors of ``state`` that do not drain.
    """
    found: list[Move] = []
    draining = {name for name, each in state.items() if each.draining}
    leaving = [(cost, shard, owner) for shard, (owner, cost) in owned.items() if owner in draining]
    takers_of_all = _Takers(able)
    for cost, shard, owner in sorted(leaving, reverse=True):
        if len(found) < MOST_MOVES:
            taker = takers_of_all.take(shard, cost)
            if taker is not None:
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
    givers = order[:]  # without those that have nothing to give
    while givers and len(found) < MOST_MOVES and (order[-1][0] > fair * (1 + END) or order[0][0] < fair * (1 - END)):
        giver, taker = by_name[givers[-1][1]], by_name[order[0][1]]
        best = _best(costs[giver.name], giver, taker)
        if best is None:
            givers.pop()
            continue
        for share in (giver, taker):
            was = (share.relative(), share.name)
            share.load += -best[0] if share is giver else best[0]
            for each in (order, givers):
                _replace(each, was, (share.relative(), share.name))
        costs[giver.name].remove(best)
        insort(costs[taker.name], best)
        found.append(Move(best[1], giver.name, taker.name))
    if not found:
        _exchange_all(costs, [by_name[name] for _, name in order], fair, found)


def _exchange_all(
    costs: Mapping[str, list[tuple[float, str]]], order: list[Share], fair: float, found: list[Move]
) -> None:
    """Append to ``found`` exchanges of two shards between two collectors each, so that their loads get closer (rule 5).

    Each collector takes part in one exchange at most.

    Args:
        costs: by name of each collector, cost and name of each of its shards that may move, sorted.
        order: the collectors in the order of their relative loads, the least loaded first.
        fair: the relative load that all collectors should have.
        found: the moves so far; an exchange adds two.
    """
    takers = order[:]
    for giver in reversed(order):
        for taker in takers[:MOST_TRIED]:
            is_off = giver.relative() > fair * (1 + END) or taker.relative() < fair * (1 - END)
            if giver not in takers or not is_off or len(found) >= MOST_MOVES:
                break
            exchanged = _exchange(costs[giver.name], costs[taker.name], giver, taker)
            if exchanged is not None:
                found.append(Move(exchanged[0], giver.name, taker.name))
                found.append(Move(exchanged[1], taker.name, giver.name))
                takers.remove(giver)
                takers.remove(taker)
                break


def _replace(order: list[tuple[float, str]], was: tuple[float, str], now: tuple[float, str]) -> None:
    """Replace an entry of a sorted list, which stays sorted; do nothing if the list does not have the entry."""
    place = bisect_left(order, was)
    if place < len(order) and order[place] == was:
        del order[place]
        insort(order, now)


def _best(costs: list[tuple[float, str]], giver: Share, taker: Share) -> tuple[float, str] | None:
    """Return cost and name of the giver's shard whose move to the taker levels both loads best; None if no move helps.

    Args:
        costs: cost and name of each shard that the giver may give, sorted.
        giver, taker: the two collectors.
    """
    if giver is taker:
        return None
    wanted = _difference(giver, taker)
    place = bisect_left(costs, (wanted, ""))
    near = [each for each in costs[max(0, place - 1) : place + 1] if taker.relative(each[0]) < giver.relative()]
    return min(near, key=lambda each: (abs(each[0] - wanted), each[1]), default=None)


def _exchange(
    dearer: list[tuple[float, str]], cheaper: list[tuple[float, str]], giver: Share, taker: Share
) -> tuple[str, str] | None:
    """Return the names of the two shards whose exchange levels the loads of two collectors best.

    None if no exchange removes more than half of the difference between their loads.

    Args:
        dearer: cost and name of each shard of the giver, sorted.
        cheaper: cost and name of each shard of the taker, sorted.
        giver, taker: the two collectors.

    Returns:
        The giver's shard and the taker's shard.
    """
    if giver is taker:
        return None
    found: tuple[str, str] | None = None
    wanted = _difference(giver, taker)
    left = wanted / 2
    for cost, shard in dearer:
        place = bisect_left(cheaper, (cost - wanted, ""))
        for other, back in cheaper[max(0, place - 1) : place + 1]:
            if abs(cost - other - wanted) < left:
                left, found = abs(cost - other - wanted), (shard, back)
    return found


def _difference(giver: Share, taker: Share) -> float:
    """Return the load, in seconds of line time per second, that has to move from giver to taker to level both.

    Level means the same relative load.
    """
    return (giver.relative() - taker.relative()) / (1 / giver.capacity + 1 / taker.capacity)


class _Takers:
    """The collectors that may take shards (groups of links), arranged to find the best one for the next shard.

    Args:
        able: the collectors that do not drain; `take` adds to their loads.
    """

    def __init__(self, able: Iterable[Share]) -> None:
        self._hosts: dict[str, list[Share]] = {}
        self._heaps: dict[float, list[tuple[float, str, Share]]] = {}
        for each in able:
            self._hosts.setdefault(each.host, []).append(each)
            self._heaps.setdefault(each.capacity, []).append((each.load, each.name, each))
        for heap in self._heaps.values():
            heapify(heap)

    def take(self, shard: str, cost: float) -> Share | None:
        """Choose the collector for a shard, add the shard's cost to the collector's load, and return the collector.

        None if no collector may own the shard.

        Args:
            shard: name of the shard.
            cost: seconds of line time per second that polling it needs.
        """
        hosts = hosts_of(shard)
        there = next((self._hosts[host] for host in hosts if host in self._hosts), [])
        able = there if hosts else [self._least_loaded(heap) for heap in self._heaps.values()]
        taker = min(able, key=lambda each: (each.relative(cost), each.name), default=None)
        if taker is not None:
            taker.load += cost
            heappush(self._heaps[taker.capacity], (taker.load, taker.name, taker))
        return taker

    def _least_loaded(self, heap: list[tuple[float, str, Share]]) -> Share:
        """Return the least loaded of some collectors that have the same capacity.

        Args:
            heap: load, name and collector of each; entries whose load is out of date are removed.
        """
        while heap[0][0] != heap[0][2].load:  # it was the load before another shard was taken
            heappop(heap)
        return heap[0][2]


def _is_off(able: list[Share], fair: float, limit: float) -> bool:
    relative = [each.relative() for each in able]
    return max(relative) > fair * (1 + limit) or min(relative) < fair * (1 - limit)
