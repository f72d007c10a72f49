"""Entries of a zone's shared table, as data and as bytes: leases, members, the generation, the settings of the zone.

Each record is a JSON array; the generation is a number in decimal digits. A record that cannot be read is treated as
missing: a newer version of this program must not stop an older one. So is one with a number that no record has, such as
an infinite one (`number_of`).
"""

import json
from dataclasses import dataclass
from typing import Any, Final

from .epoch import Epoch

LEASES: Final = "lease."
MEMBERS: Final = "member."
GENERATION: Final = "generation"
ZONE: Final = "zone"
LONGEST_SILENCE: Final = 375.0
"""Longest valid `LeaseTimes.silence`, in seconds: longer ones are cut, so no wrong entry keeps a shard for good."""
LONGEST_WORD: Final = 200
"""Most characters that an entry has of a name or a reason of maintenance; longer ones are cut."""
LARGEST: Final = 2**62
"""Largest number of a valid record. SQLite, in which generations and revisions are kept, has numbers below 2**63."""


@dataclass(frozen=True, slots=True)
class LeaseHole:
    """The span of time in which no collector owned a shard (group of links) before its present owner took the shard.

    Attributes:
        before: name of the collector that owned the shard before.
        was_silent: True if that collector stopped renewing its lease; False if it released the shard.
        begin: last renewal or release by the owner before, seconds since 1970 UTC by that owner's clock.
        end: when the present owner took the shard, seconds since 1970 UTC by its own clock.
    """

    before: str
    was_silent: bool
    begin: float
    end: float


@dataclass(frozen=True, slots=True)
class MaintainedDevice:
    """A device of a shard (group of links) that is in maintenance: the next owner of the shard leaves it alone, too.

    Attributes:
        device: name of the device.
        begin: since when, nanoseconds since 1970 UTC.
        by: who began the maintenance, `LONGEST_WORD` characters at most.
        why: the reason, `LONGEST_WORD` characters at most.
    """

    device: str
    begin: int
    by: str
    why: str


@dataclass(frozen=True, slots=True)
class LeaseRecord:
    """The lease (right to poll) of one shard (group of links): its owner and the epoch of this ownership.

    Attributes:
        owner: name of the collector that owns the shard, or owned it last.
        run: a random word for this start of the owner; two processes of one name are two owners.
        held: whether the owner still owns the shard; False once the shard is released.
        count: renewals so far, so that every renewal changes the entry.
        cost: seconds of line time per second that the reads of the shard's links need.
        epoch: the epoch of the ownership; None in the entry that takes the lease, as the revision of that entry gives
            the epoch (`epoch_at`).
        target: in a released lease, name of the collector that is to take the shard; empty if any collector may.
        at: when the entry was written, seconds since 1970 UTC by the owner's wall clock. It only dates gaps: who owns
            the shard is never decided by it.
        before: in the entry that takes the lease, the last earlier epoch of the shard that the owner knows. None if it
            knows none, and in all other entries.
        hole: the time without an owner before this one took the shard; None if it is not known.
        silence: seconds for which the entry must not change before another collector may take the shard, by the lease
            times of the owner; 0 in an entry of an older version. The taker waits for the longer of this and its own.
        maintenance: the devices of the shard that are in maintenance; None in an entry of an older version.
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
    silence: float = 0.0
    maintenance: tuple[MaintainedDevice, ...] | None = None

    def epoch_at(self, revision: int, generation: int) -> Epoch:
        """Return the epoch of the ownership: ``epoch``, or if that is None, one from the revision of the entry.

        An epoch from a revision is always above ``before``.

        Args:
            revision: revision of the table entry that holds this record.
            generation: generation number of the zone.
        """
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
                round(self.silence, 3),
                None if self.maintenance is None else [_encoded_device(each) for each in self.maintenance],
            ],
            separators=(",", ":"),
        ).encode()


@dataclass(frozen=True, slots=True)
class MemberRecord:
    """What one collector tells the others of its zone about itself: name, host, capacity, configuration, problems.

    Attributes:
        name: name of the collector, the only one of that name in the zone.
        run: a random word for this start of the collector.
        host: name of its machine, for links that only some machines can reach.
        count: how often this start of the collector has written the record.
        capacity: the collector's part of the work, relative to the others; 1 is usual.
        draining: whether the collector gives away all its shards (groups of links) and takes none.
        revision: revision of the configuration that the collector works with; 0 if that is not from the coordinator.
        gone: True once the collector has released all its shards and ended; False while it runs or if it was killed.
        at: when the record was written, seconds since 1970 UTC by the collector's wall clock; shows wrong clocks.
        problem: why the collector may own no shard; empty while it may.
        behind: number of commits of the collector's store that not all sinks have.
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
    """The settings that all collectors of a zone must share, so that no link has two owners.

    Attributes:
        shards: how many shards (groups of links) the zone has.
        ttl, guard: as in `LeaseTimes`, in seconds.
    """

    shards: int
    ttl: float
    guard: float

    def encode(self) -> bytes:
        """Return the settings of the zone as bytes for the shared table."""
        return json.dumps([self.shards, self.ttl, self.guard], separators=(",", ":")).encode()

    def difference(self, zone: "ZoneRecord") -> str:
        """Return in words how the settings of a zone differ from these; empty if they are equal.

        Args:
            zone: the settings that the zone has.
        """
        found = []
        if self.shards != zone.shards:
            found.append(f"{zone.shards} shards and not {self.shards}")
        if self.ttl != zone.ttl:
            found.append(f"leases of {zone.ttl:g} s and not {self.ttl:g}")
        if self.guard != zone.guard:
            found.append(f"a guard of {zone.guard:g} s and not {self.guard:g}")
        return ", ".join(found)


def decode_zone(value: bytes) -> ZoneRecord | None:
    """Return the settings that all collectors of a zone share, from the bytes of a table entry; None if unreadable."""
    try:
        shards, ttl, guard = decode_list(value)[:3]
        return ZoneRecord(integer_of(shards), number_of(ttl), number_of(guard))
    except (ValueError, TypeError):
        return None


def decode_lease(value: bytes) -> LeaseRecord | None:
    """Return the lease in the bytes of a table entry; None if the bytes are not a valid lease."""
    try:
        row = _filled(decode_list(value), 12)
        owner, run, held, count, cost, epoch, target, at, before, hole, silence, maintenance, *_ = row
        return LeaseRecord(
            str(owner),
            str(run),
            bool(held),
            integer_of(count),
            number_of(cost),
            _epoch(epoch),
            str(target),
            number_of(at),
            _epoch(before),
            None if hole is None else LeaseHole(str(hole[0]), bool(hole[1]), number_of(hole[2]), number_of(hole[3])),
            number_of(min(silence or 0.0, LONGEST_SILENCE)),
            None if maintenance is None else tuple(map(_decoded_device, maintenance)),
        )
    except (ValueError, TypeError, LookupError):
        return None


def decode_member(value: bytes) -> MemberRecord | None:
    """Return the collector that a table entry describes; None if its bytes are not a valid record."""
    try:
        row = decode_list(value)
        row += (0.0, "", 0)[len(row) - 8 :]  # what an older version of this program did not write
        name, run, host, count, capacity, draining, revision, gone, at, problem, behind, *_ = row
        if not number_of(capacity) > 0:
            return None  # loads are divided by it
        return MemberRecord(
            str(name),
            str(run),
            str(host),
            integer_of(count),
            number_of(capacity),
            bool(draining),
            integer_of(revision),
            bool(gone),
            number_of(at),
            str(problem),
            integer_of(behind),
        )
    except (ValueError, TypeError):
        return None


def decode_generation(value: bytes) -> int:
    """Return the zone's generation number in the bytes of a table entry; 1 if they hold none."""
    try:
        return max(1, integer_of(int(value)))
    except ValueError:
        return 1


def decode_list(value: bytes) -> list[Any]:  # JSON
    """Return the JSON array in the bytes of a table entry.

    Raises:
        ValueError: the bytes are no JSON, or are nested too deeply.
        TypeError: they are another thing than an array.
    """
    try:
        found = json.loads(value)
    except RecursionError as error:
        raise ValueError("the entry is nested too deeply") from error
    if not isinstance(found, list):
        raise TypeError("a record is a list")
    return found


def number_of(found: Any) -> float:  # JSON
    """Return a number that an entry has.

    Raises:
        ValueError: it is infinite, not a number, or beyond `LARGEST`.
        TypeError: the entry has another thing there.
    """
    if not abs(found) <= LARGEST:
        raise ValueError(f"{found} is no number of a record")
    return float(found)


def integer_of(found: Any) -> int:  # JSON
    """Return a number that an entry has as an integer. Raises as `number_of` does."""
    number_of(found)
    return int(found)


def _hole_row(hole: LeaseHole) -> list[str | int | float]:
    return [hole.before, int(hole.was_silent), round(hole.begin, 3), round(hole.end, 3)]


def _encoded_device(each: MaintainedDevice) -> list[str | int]:
    return [each.device, each.begin, each.by, each.why]


def _decoded_device(row: Any) -> MaintainedDevice:  # JSON
    return MaintainedDevice(str(row[0]), integer_of(row[1]), str(row[2]), str(row[3]))


def _numbers(epoch: Epoch | None) -> list[int] | None:
    return None if epoch is None else [epoch.generation, epoch.revision]


def _epoch(numbers: Any) -> Epoch | None:  # Any: what an entry has there
    return None if numbers is None else Epoch(integer_of(numbers[0]), integer_of(numbers[1]))


def _filled(row: list[Any], length: int) -> list[Any]:
    """Return a row with None for what an older version of this program did not write."""
    return [*row, *[None] * (length - len(row))]
