"""The entries that collectors share through a coordinator, as data and as bytes: leases, members, the generation.

Each record is a line of JSON. What cannot be read is treated as if it were not there, and told: a newer version of this
program must not stop an older one.
"""

import json
from dataclasses import dataclass
from typing import Any, Final

from .lease_times import Epoch

LEASES: Final = "lease."
MEMBERS: Final = "member."
GENERATION: Final = "generation"
ZONE: Final = "zone"


@dataclass(frozen=True, slots=True)
class LeaseHole:
    """The time in which no collector owned a shard (group of links) before its owner took it.

    Attributes:
        before: the collector that had it.
        was_silent: whether that one fell silent; it gave the shard back otherwise.
        begin, end: its last renewal or its release, and the taking; seconds since 1970 UTC by the clocks of both.
    """

    before: str
    was_silent: bool
    begin: float
    end: float


@dataclass(frozen=True, slots=True)
class LeaseRecord:
    """The lease (right to poll) of one shard (group of links): who owns it, in which epoch.

    Attributes:
        owner, run: the collector, and a word for this start of it; two processes of one name are two owners.
        held: whether it owns the shard; False after it has released it.
        count: renewals so far, so that every renewal changes the entry.
        cost: seconds of its links' time that the reads of the shard need in a second.
        epoch: the epoch of the ownership; None in the entry that takes the lease, whose own revision it is.
        target: the collector that it was released for; empty where all may take it.
        at: seconds since 1970 UTC by the owner's wall clock; for the record of gaps only, no decision rests on it.
        before: in the entry that takes the lease, the last epoch that the owner knows of; None without one.
        hole: the time without an owner before this one took the shard; None for the first owner.
    """

    owner: str
    run: str
    held: bool
    count: int
    cost: float
    epoch: Epoch | None
    target: str = ""
    at: float = 0.0
    before: Epoch | None = None
    hole: LeaseHole | None = None

    def epoch_at(self, revision: int, generation: int) -> Epoch:
        """Return the epoch of the ownership, from the entry's own revision where the entry takes the lease."""
        return self.epoch or Epoch(generation, revision).above(self.before)

    def encode(self) -> bytes:
        """Return the lease as bytes for the shared table."""
        return json.dumps(
            [
                self.owner,
                self.run,
                int(self.held),
                self.count,
                round(self.cost, 6),
                _numbers(self.epoch),
                self.target,
                round(self.at, 3),
                _numbers(self.before),
                None if self.hole is None else _hole_row(self.hole),
            ],
            separators=(",", ":"),
        ).encode()


@dataclass(frozen=True, slots=True)
class MemberRecord:
    """One running collector as the others see it: name, capacity, configuration.

    Attributes:
        name, run: as in `LeaseRecord`.
        host: the machine, for links that are pinned to it.
        count: renewals so far.
        capacity: its share of the work, relative to the others; 1 is usual.
        draining: whether it hands everything on and takes nothing.
        revision: the revision of the configuration that it works by.
        gone: whether it has ended in order.
        at: seconds since 1970 UTC by its wall clock; to find clocks that are wrong.
        problem: why it owns nothing; empty while it may own.
        behind: commits of its store that not all sinks have.
    """

    name: str
    run: str
    host: str
    count: int
    capacity: float = 1.0
    draining: bool = False
    revision: int = 0
    gone: bool = False
    at: float = 0.0
    problem: str = ""
    behind: int = 0

    def encode(self) -> bytes:
        """Return the record of a collector as bytes for the shared table."""
        return json.dumps(
            [
                self.name,
                self.run,
                self.host,
                self.count,
                self.capacity,
                int(self.draining),
                self.revision,
                int(self.gone),
                round(self.at, 3),
                self.problem,
                self.behind,
            ],
            separators=(",", ":"),
        ).encode()


@dataclass(frozen=True, slots=True)
class ZoneRecord:
    """What all collectors of a zone must have alike, or one link could have two owners.

    Attributes:
        shards: how many shards (groups of links) the zone has.
        ttl, guard: as in `LeaseTimes`.
    """

    shards: int
    ttl: float
    guard: float

    def encode(self) -> bytes:
        """Return the record as bytes for the shared table."""
        return json.dumps([self.shards, self.ttl, self.guard], separators=(",", ":")).encode()

    def difference(self, zone: "ZoneRecord") -> str:
        """Return in words what the zone has and this does not; empty where they are alike."""
        found = []
        if self.shards != zone.shards:
            found.append(f"{zone.shards} shards and not {self.shards}")
        if self.ttl != zone.ttl:
            found.append(f"leases of {zone.ttl:g} s and not {self.ttl:g}")
        if self.guard != zone.guard:
            found.append(f"a guard of {zone.guard:g} s and not {self.guard:g}")
        return ", ".join(found)


def decode_zone(value: bytes) -> ZoneRecord | None:
    """Return what all collectors of a zone have alike, from the bytes of a table entry; None if they are not that."""
    try:
        shards, ttl, guard = _list(value)[:3]
        return ZoneRecord(int(shards), float(ttl), float(guard))
    except (ValueError, TypeError):
        return None


def decode_lease(value: bytes) -> LeaseRecord | None:
    """Return the lease in the bytes of a table entry; None if they are not a lease."""
    try:
        owner, run, held, count, cost, epoch, target, at, before, hole, *_ = [*_list(value), None, None]
        return LeaseRecord(
            str(owner),
            str(run),
            bool(held),
            int(count),
            float(cost),
            _epoch(epoch),
            str(target),
            float(at),
            _epoch(before),
            None if hole is None else LeaseHole(str(hole[0]), bool(hole[1]), float(hole[2]), float(hole[3])),
        )
    except (ValueError, TypeError, IndexError):
        return None


def decode_member(value: bytes) -> MemberRecord | None:
    """Return the collector that a table entry describes; None if its bytes are not a valid record."""
    try:
        name, run, host, count, capacity, draining, revision, gone, at, problem, behind, *_ = [*_list(value), 0, "", 0]
        return MemberRecord(
            str(name),
            str(run),
            str(host),
            int(count),
            float(capacity),
            bool(draining),
            int(revision),
            bool(gone),
            float(at),
            str(problem),
            int(behind),
        )
    except (ValueError, TypeError, IndexError):
        return None


def decode_generation(value: bytes) -> int:
    """Return the fleet's generation number in the bytes of a table entry; 1 if they hold none."""
    try:
        return max(1, int(value))
    except ValueError:
        return 1


def _hole_row(hole: LeaseHole) -> list[str | int | float]:
    return [hole.before, int(hole.was_silent), round(hole.begin, 3), round(hole.end, 3)]


def _numbers(epoch: Epoch | None) -> list[int] | None:
    return None if epoch is None else [epoch.generation, epoch.revision]


def _epoch(numbers: Any) -> Epoch | None:  # Any: what an entry has there
    return None if numbers is None else Epoch(int(numbers[0]), int(numbers[1]))


def _list(value: bytes) -> list[Any]:
    found = json.loads(value)
    if not isinstance(found, list):
        raise TypeError("a record is a list")
    return found
