"""One collector as a holder of leases (`LeaseHolder`): decides which shards it takes, renews, gives away and may poll.

Pure, without IO: entries, outcomes and the time go in; proposals and events come out. Knows no engine, socket or clock.
The driver (`lease_driver`) makes each proposed change once, and passes the answer to `LeaseHolder.outcome`. The
collector stops the links of a shard, then calls `LeaseHolder.left`. `LeaseHolder.permits` is asked before each
transaction on a link.

1. A shard is owned from a confirmed compare-and-set on until its deadline: the moment *before* the last confirmed
   renewal was sent, plus the time to live, less the guard. A renewal without an answer does not count.
2. A shard of another owner is free when its entry says released, or has had one revision for the time to live and the
   guard, by this collector's own clock. The lease says how long its owner's times are; if they are longer than those of
   this collector, they count. The shard is taken by a compare-and-set on that revision: an old view harms nothing.
3. A shard whose lease this start of the collector has let lapse is free for it at once; it gets a new epoch. A lease of
   an earlier start of the same name counts as another owner's. An epoch is above all that the taker has seen of the
   shard, whatever revision the coordinator gives: a server may count lower than the one before it.
4. At most one proposal for each key is open at a time.
5. Of two processes with one name, the second owns nothing until the first has been silent as in rule 2; `problem` says
   so.
6. A collector whose wall clock is wrong would date samples wrongly: it gives back what it owns, takes nothing, and
   `problem` says so. Its clock is compared with the coordinator's. If more collectors agree with this clock than with
   the coordinator's, the coordinator's counts as the wrong one.
7. The first collector of a zone records how many shards there are and how long leases hold, if no operator has. A
   collector with other figures owns nothing, and `problem` says so: with two numbers of shards a link could be in two
   shards, with two owners. Two collectors with different lease times are kept apart by rule 2, also before they have
   read of each other.
"""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from ..collector.sample_clock import EARLIEST, NANOSECONDS
from .balance import Share, moves, takers
from .coordinator import Entry
from .epoch import Epoch
from .lease_times import LeaseTimes
from .shards import hosts_of
from .table_records import (
    GENERATION,
    LEASES,
    MEMBERS,
    ZONE,
    LeaseHole,
    LeaseRecord,
    MaintainedDevice,
    MemberRecord,
    ZoneRecord,
    decode_generation,
    decode_lease,
    decode_member,
    decode_zone,
)

LOOK_EVERY: Final = 0.5
"""Seconds between two checks for free shards."""
SETTLE: Final = 2.0
"""Seconds that a new collector waits before it takes shards, and that an imbalance must last before shards move."""
WAIT_FOR_OWNER: Final = 0.4
"""Seconds after which any collector that may own a free shard takes it, not only the one that `balance` chooses."""
WAIT_OF_BACKUPS: Final = 3.0
"""Seconds for which a free pinned shard is left to the collector that `balance` chooses; then any of its hosts may."""
CLOCK_LIMIT: Final = 5.0
"""Most seconds that a wall clock may differ from the coordinator's, not counting the time that an answer takes."""
MOST_OPEN: Final = 64
"""Most proposals of leases that are open (without an outcome) at once; others wait."""
MOST_LEAVING: Final = 8
"""Most shards that one collector hands on at once to level loads or to drain.

It is no limit for shards that the collector must give away because it ends or may own none.
"""


class OwnershipChange(Enum):
    """What has happened to a shard (group of links) of this collector, and what the collector has to do.

    ``GAINED``: the shard is owned now, and the collector may poll its links. ``LEAVE``: the shard will be given away;
    the collector lets running transactions end, stops its links, and then calls `LeaseHolder.left`. ``LOST``: the shard
    is not owned any more; the collector resets the connections of its links at once.
    """

    GAINED = "gained"  # its links may begin
    LEAVE = "leave"  # its links are to stop after what runs; then call `LeaseHolder.left`
    LOST = "lost"  # it is not owned any more: its connections are to be reset at once


@dataclass(frozen=True, slots=True)
class ShardEvent:
    """An event that tells the collector to begin or to stop polling the links of one shard (group of links).

    Attributes:
        shard: name of the shard.
        change: what has happened to the shard.
        epoch: epoch of the ownership that begins or ends.
        reason: why the shard is given away or lost, in words; empty for a shard that was gained.
        silent_since: when the lease was renewed last, seconds since 1970 UTC by the owner's wall clock. Set for a shard
            that was gained from an owner that fell silent, and for one that this collector lost because its lease was
            not renewed in time; None otherwise.
        maintenance: for a shard that was gained, its devices in maintenance as the former lease says; None if that says
            nothing.
        former: for a shard that was gained, the epoch of the ownership before, which may be one of this collector; None
            for none.
    """

    shard: str
    change: OwnershipChange
    epoch: Epoch
    reason: str = ""
    silent_since: float | None = None
    maintenance: tuple[MaintainedDevice, ...] | None = None
    former: Epoch | None = None


@dataclass(frozen=True, slots=True)
class Proposal:
    """One change of the shared table that this collector wants made: a compare-and-set of one entry.

    The driver makes the change once, and passes the answer to `LeaseHolder.outcome`.

    Attributes:
        key, value: key and new value of the table entry.
        revision: the revision that the entry must have now; 0 to create the entry.
        asked: when the change was proposed, in the clock of `LeaseHolder.turn`.
    """

    key: str
    value: bytes
    revision: int
    asked: float


class NotConfirmed(Enum):
    """Why a proposed change of the shared table was not confirmed.

    ``CONFLICT``: the entry had another revision, and nothing was changed. ``UNKNOWN``: no answer says whether the
    change was made.
    """

    CONFLICT = "conflict"
    UNKNOWN = "unknown"


@dataclass(slots=True)
class _SeenLease:
    record: LeaseRecord | None
    revision: int
    at: float


@dataclass(slots=True)
class _SeenMember:
    record: MemberRecord
    revision: int
    at: float
    ahead: float | None
    """How far the collector's wall clock is ahead of the coordinator's, in seconds, less the time that its change took
    to arrive there. None if the entry or the record has no time.
    """


@dataclass(slots=True)
class OwnedShard:
    """A shard (group of links) that this collector owns, with the state of its lease.

    Attributes:
        epoch: the epoch of the ownership.
        revision: revision of the lease's table entry.
        asked: when the last confirmed renewal was proposed, in the clock of `LeaseHolder.turn`.
        renew_at: when the next renewal is to be proposed, in the same clock.
        count: renewals so far.
        leaving: once the shard is being given away, name of the collector that is to take it, or empty for any
            collector. None while the shard stays.
        has_left: whether the links have stopped, so that the lease can be released.
        hole: the time without an owner before this collector took the shard; None if it is not known.
        maintenance: the devices of the shard in maintenance, told with each renewal; None if that is not known.
    """

    epoch: Epoch
    revision: int
    asked: float
    renew_at: float
    count: int = 0
    leaving: str | None = None
    has_left: bool = False
    hole: LeaseHole | None = None
    maintenance: tuple[MaintainedDevice, ...] | None = None


@dataclass(slots=True)
class MemberCounts:
    """Counters of what happened to the leases of a collector since its start.

    Attributes:
        taken: shards (groups of links) taken.
        lapsed: shards lost because their lease was not renewed in time.
        handed_on: shards whose lease this collector released itself.
        renewals: confirmed renewals of leases.
        conflicts: changes of the shared table that were refused, as the entry had another revision.
        unknown: changes of the shared table without an answer.
    """

    taken: int = 0
    lapsed: int = 0
    handed_on: int = 0
    renewals: int = 0
    conflicts: int = 0
    unknown: int = 0


class LeaseHolder:
    """One collector as a holder of leases: decides which shards (groups of links) it takes, renews and gives away.

    Does no IO. The driver gives it the entries of the shared table (`entry`), makes the changes that `turn` returns,
    and passes their answers to `outcome`; `events` says which shards may be polled and which must stop. ``now`` is
    always the time in seconds by the clock of leases (`busway.apps.fleet.lease_driver.boot_time`).

    Args:
        name, run, host: as in `MemberRecord`.
        times: the lengths of the leases; the same for all collectors of the zone.
        chance: source of random numbers, which spread renewals and checks for free shards in time.
        capacity: the collector's part of the work, relative to the others.
        shards: how many shards the zone has, 1…1024; the same for all collectors.

    Attributes:
        times: the lengths of the leases.
        owned: by name, the shards that this collector owns.
        counts: counters of what happened to its leases.
        generation: the generation number of the zone.
        rival: the word ``run`` of another live process with the same name; None without one.
        clock_error: how far the wall clock is ahead of the coordinator's, in seconds, negative if it is behind; 0 if
            the difference is within `CLOCK_LIMIT` or not known.
        behind: number of commits that not all sinks have; set by the driver and told to the other collectors.
        wall_ahead: how far the wall clock is ahead of the clock of leases, in seconds; set by the driver, and used only
            to date entries and to find wrong clocks.
    """

    def __init__(
        self,
        name: str,
        run: str,
        host: str,
        times: LeaseTimes,
        chance: random.Random,
        *,
        capacity: float = 1.0,
        shards: int = 256,
    ) -> None:
        self.times: LeaseTimes = times
        self._zone = ZoneRecord(shards, times.ttl, times.guard)
        self._zone_revision = 0
        self._agrees = False
        self._disagreement = ""
        self.owned: dict[str, OwnedShard] = {}
        self.counts: MemberCounts = MemberCounts()
        self.generation: int = 1
        self.rival: str | None = None
        self.clock_error: float = 0.0
        self._is_known = False
        self._drains = False
        self.wall_ahead: float = 0.0
        self.behind: int = 0
        self._me = MemberRecord(name, run, host, 0, capacity)
        self._my_revision = 0
        self._my_asked: float | None = None
        self._my_renewal = 0.0
        self._chance = chance
        self._costs: Mapping[str, float] = {}
        self._leases: dict[str, _SeenLease] = {}
        self._last_epochs: dict[str, Epoch] = {}
        self._members: dict[str, _SeenMember] = {}
        self._open: dict[str, Proposal] = {}
        self._events: list[ShardEvent] = []
        self._complete_at: float | None = None
        self._shown_again: set[str] = set()
        self._look_at = 0.0
        self._free_since: dict[str, float] = {}
        self._silent_since: dict[str, float] = {}
        self._formers: dict[str, Epoch] = {}
        """By shard that is about to be taken, the epoch of the ownership before."""
        self._said_maintenance: set[tuple[str, int]] = set()
        self._gained: dict[str, Epoch] = {}
        """By shard, the last epoch in which this collector has owned it."""
        self._lapsed: dict[str, float] = {}
        """By shard, when the lease that lapsed here was last renewed with an answer, in the clock of leases."""
        self._off_since: float | None = None
        self._ends = False

    # What is known.

    @property
    def name(self) -> str:
        """The name of this collector, the only one of that name in its zone."""
        return self._me.name

    def cost(self, shard: str) -> float:
        """Return the seconds of line time per second that polling a shard (group of links) needs; 0 if not known."""
        return self._costs.get(shard, 0.0)

    def set_shards(self, costs: Mapping[str, float]) -> None:
        """Set which shards (groups of links) have links, and what each costs; the next turns release all other shards.

        Args:
            costs: seconds of line time per second that polling the links of each shard needs, by name of the shard.
        """
        self._costs = costs
        self._look_at = 0.0

    def set_revision(self, revision: int) -> None:
        """Set the configuration revision that this collector works with; the others learn it by the next renewal."""
        self._me = replace(self._me, revision=revision)

    def drain(self, *, draining: bool = True) -> None:
        """Begin to give away all shards (groups of links) and to take none, or take part again; the next turns do it.

        Args:
            draining: False to take shards again.
        """
        self._drains = draining
        self._me = replace(self._me, draining=draining or bool(self._me.problem))
        self._my_renewal = 0.0

    def end(self) -> None:
        """Begin to release all shards (groups of links), and then tell the others that this collector has ended.

        The next turns propose the changes; `has_ended` says when they are confirmed.
        """
        self._ends = self._drains = True
        self._me = replace(self._me, draining=True)
        self._my_renewal = self._look_at = 0.0

    @property
    def has_ended(self) -> bool:
        """Whether, after `end`, all shards (groups of links) are released and the other collectors are told so."""
        return self._ends and not self.owned and self._me.gone and f"{MEMBERS}{self.name}" not in self._open

    @property
    def problem(self) -> str:
        """Why this collector may own no shard (group of links), in words; empty while it may."""
        return "another process has its name" if self.rival is not None else self._me.problem

    def deadline(self, shard: str) -> float:
        """Return until when all transactions of a shard (group of links) must have ended, by the clock of leases.

        Minus infinity if this collector does not own the shard, or after `left` was called for it.
        """
        owned = self.owned.get(shard)
        if owned is None or owned.has_left:
            return float("-inf")
        return self.times.deadline(owned.asked)

    def permits(self, shard: str, now: float, worst: float) -> bool:
        """Whether a transaction on a link of a shard is permitted now: whether it ends before the shard's `deadline`.

        To be asked right before each transaction.

        Args:
            shard: name of the shard (group of links).
            now: the time by the clock of leases.
            worst: most seconds that the transaction can take.
        """
        return now + worst < self.deadline(shard)

    def members(self, now: float) -> list[MemberRecord]:
        """Return the records of the live collectors of the zone in the order of their names; always with this one."""
        found = [each.record for each in self._members.values() if self._lives(each, now)]
        return sorted((*found, self._me), key=lambda each: each.name)

    def leases(self) -> dict[str, LeaseRecord]:
        """Return the last known lease of each shard (group of links), by name of the shard, also if it was released.

        Shards that never had a lease are missing.
        """
        return {shard: each.record for shard, each in self._leases.items() if each.record is not None}

    # What comes in.

    def begin_snapshot(self) -> None:
        """Prepare to receive all entries of the shared table from the start, because its watch begins or begins again.

        Known entries stay known. An entry that the new snapshot shows with a lower revision replaces the known one.
        """
        self._complete_at = None
        self._shown_again = {ZONE, *(f"{LEASES}{shard}" for shard in self._leases)}
        self._shown_again |= {f"{MEMBERS}{name}" for name in (*self._members, self.name)}

    def end_snapshot(self, now: float) -> None:
        """Record that all existing entries of the shared table were passed to `entry`; later entries are changes."""
        self._complete_at = now

    def entry(self, entry: Entry, now: float) -> None:
        """Take over a new, changed or deleted entry of the shared table, seen at ``now`` by the clock of leases.

        It is ignored if this or a newer revision is known, except the first time that a new snapshot shows a known
        entry: see `begin_snapshot`. Entries that are no leases, members, generation or zone are ignored too.
        """
        self._forget_wrong_revision(entry)
        if entry.key.startswith(LEASES):
            self._lease(entry.key[len(LEASES) :], entry, now)
        elif entry.key.startswith(MEMBERS):
            self._member(entry, now)
        elif entry.key == GENERATION:
            self.generation = max(self.generation, decode_generation(entry.value))
        elif entry.key == ZONE and entry.revision > self._zone_revision:
            self._compare_zone(entry)

    def _forget_wrong_revision(self, entry: Entry) -> None:
        """Forget a known entry that the table, read from the start again, shows with a lower revision."""
        if entry.key not in self._shown_again:
            return
        self._shown_again.discard(entry.key)
        table, _, name = entry.key.partition(".")
        if entry.key == ZONE:
            self._zone_revision = min(self._zone_revision, entry.revision - 1)
        elif entry.key == f"{MEMBERS}{self.name}":
            self._my_revision = min(self._my_revision, entry.revision)
        elif f"{table}." == LEASES:
            if name in self._leases and entry.revision < self._leases[name].revision:
                del self._leases[name]
        elif name in self._members and entry.revision < self._members[name].revision:
            del self._members[name]

    def _compare_zone(self, entry: Entry) -> None:
        """Compare shards and lease times of this collector with those in an entry; keep how they differ (rule 7)."""
        self._zone_revision = entry.revision
        zone = decode_zone(entry.value)
        if zone is None:
            self._disagreement = "the entry of the zone cannot be read" if entry.value else ""
        elif difference := self._zone.difference(zone):
            self._disagreement = f"the zone has {difference}; all its collectors must have the same"
        else:
            self._disagreement = ""
        self._agrees = zone == self._zone

    def _lease(self, shard: str, entry: Entry, now: float) -> None:
        seen = self._leases.get(shard)
        if seen is not None and entry.revision <= seen.revision:
            return
        record = decode_lease(entry.value) if entry.value else None
        self._leases[shard] = _SeenLease(record, entry.revision, now)
        if record is not None:
            self._note_maintenance(record)
            self._note_epoch(shard, record.epoch_at(entry.revision, self.generation))
        self._free_since.pop(shard, None)
        if record is not None and not record.held:
            self._look_at = now
        self._compare(shard)

    def _note_epoch(self, shard: str, epoch: Epoch) -> None:
        if shard not in self._last_epochs or epoch > self._last_epochs[shard]:
            self._last_epochs[shard] = epoch

    def _compare(self, shard: str) -> None:
        """Compare an owned shard with the newest entry of its lease; lose the shard if the entry names another owner.

        Also lose it if the entry holds no readable lease. Does nothing if the shard is not owned here.
        """
        owned, seen = self.owned.get(shard), self._leases.get(shard)
        if owned is None or seen is None or seen.revision <= owned.revision:
            return
        if seen.record is not None and seen.record.held and seen.record.run == self._me.run:
            owned.revision = seen.revision  # a renewal whose answer was lost; it does not count as one
        elif f"{LEASES}{shard}" not in self._open or seen.record is None or seen.record.run != self._me.run:
            other = "no collector" if seen.record is None else seen.record.owner
            self._lose(shard, f"{other} has it, by revision {seen.revision}")

    def _member(self, entry: Entry, now: float) -> None:
        name = entry.key[len(MEMBERS) :]
        record = decode_member(entry.value) if entry.value else None
        if name == self.name:
            other = record is not None and record.run != self._me.run and not record.gone
            if other and entry.revision <= self._my_revision:
                return  # the table is read anew: that process has not renewed, and is waited for no longer than before
            self._my_revision = max(self._my_revision, entry.revision)
            if other and record is not None:
                self.rival = record.run
                self._my_asked = None
                self._my_renewal = self.times.free_at(now)
            elif self.rival is not None:
                self.rival = None
                self._my_renewal = now
            if record is not None and record.run == self._me.run:
                self._compare_clocks(entry, record, now)
            return
        if record is None:
            self._members.pop(name, None)
            return
        seen = self._members.get(name)
        if seen is None or entry.revision > seen.revision:
            ahead = None if entry.time is None or not record.at else record.at - entry.time
            self._members[name] = _SeenMember(record, entry.revision, now, ahead)

    def _compare_clocks(self, entry: Entry, record: MemberRecord, now: float) -> None:
        """Note that the table has shown this collector's own entry, and set `clock_error` from the entry's time.

        `clock_error` stays as it is if the entry has no time or is not the newest. The coordinator made the change
        after it was proposed (``record.at``) and before ``now``.
        """
        self._is_known = True
        if entry.time is not None and record.count == self._me.count:
            ahead, behind = record.at - entry.time, entry.time - (now + self.wall_ahead)
            self.clock_error = ahead if ahead > CLOCK_LIMIT else -behind if behind > CLOCK_LIMIT else 0.0

    def _clock_problem(self, now: float) -> str:
        """Return in words that this machine's wall clock is too wrong to own shards; empty if it may own some (rule 6).

        Empty also if more of the other live collectors agree with this clock than with the coordinator's.
        """
        if not self.clock_error:
            return ""
        others = [each.ahead for each in self._members.values() if each.ahead is not None and self._lives(each, now)]
        with_server = sum(abs(ahead) <= CLOCK_LIMIT for ahead in others)
        with_this = sum(abs(ahead - self.clock_error) <= CLOCK_LIMIT for ahead in others)
        if with_this > with_server:
            return ""
        side = "ahead of" if self.clock_error > 0 else "behind"
        return f"its clock is {abs(self.clock_error):.0f} s {side} the coordinator's"

    def _look_for_problems(self, now: float) -> None:
        problem = self._disagreement or self._clock_problem(now)
        if problem != self._me.problem:
            self._me = replace(self._me, problem=problem, draining=self._drains or bool(problem))
            self._my_renewal = min(self._my_renewal, now)

    def outcome(self, proposal: Proposal, result: int | NotConfirmed, now: float) -> None:
        """Process the answer to a proposed change of the shared table; ignored if no proposal for its key is open.

        Args:
            proposal: the change, as `turn` returned it.
            result: the new revision of the entry if the change was confirmed; otherwise why it was not.
            now: the time by the clock of leases.
        """
        if self._open.pop(proposal.key, None) is None:
            return
        if result is NotConfirmed.CONFLICT:
            self.counts.conflicts += 1
        elif result is NotConfirmed.UNKNOWN:
            self.counts.unknown += 1
        if proposal.key == ZONE:
            if isinstance(result, int):
                self._compare_zone(Entry(ZONE, proposal.value, result))
        elif proposal.key.startswith(MEMBERS):
            self._member_outcome(proposal, result, now)
        else:
            self._lease_outcome(proposal.key[len(LEASES) :], proposal, result, now)

    def _member_outcome(self, proposal: Proposal, result: int | NotConfirmed, now: float) -> None:
        if isinstance(result, int):
            self._my_revision = max(self._my_revision, result)
            self._my_asked = proposal.asked
            self.rival = None
        else:
            self._my_renewal = min(self._my_renewal, now + 0.2 + 0.2 * self._chance.random())
            if self._me.gone and result is NotConfirmed.UNKNOWN:
                self._me = replace(self._me, gone=False)

    def _lease_outcome(self, shard: str, proposal: Proposal, result: int | NotConfirmed, now: float) -> None:
        record = decode_lease(proposal.value)
        owned = self.owned.get(shard)
        assert record is not None
        if not isinstance(result, int):
            if owned is not None:
                owned.renew_at = now + 0.2 + 0.2 * self._chance.random()
                self._compare(shard)
            return
        self._note_maintenance(record)
        seen = self._leases.get(shard)
        if seen is None or seen.revision < result:
            self._leases[shard] = _SeenLease(record, result, now)
        if not record.held:
            if owned is not None:
                del self.owned[shard]
                self.counts.handed_on += 1
                if self._ends and not self.owned:
                    self._my_renewal = now
        elif owned is None:
            self._gain(shard, record, proposal.asked, result)
        else:
            owned.revision = max(owned.revision, result)
            owned.asked = proposal.asked
            owned.count = record.count
            self.counts.renewals += 1
            self._compare(shard)

    def _gain(self, shard: str, record: LeaseRecord, asked: float, revision: int) -> None:
        if record.epoch is not None:
            return  # a renewal of what lapsed meanwhile: it is taken anew, with a new epoch
        epoch = record.epoch_at(revision, self.generation)
        self._note_epoch(shard, epoch)
        renew_at = asked + self._spread(self.times.renew)
        maintenance = record.maintenance
        self.owned[shard] = OwnedShard(epoch, revision, asked, renew_at, hole=record.hole, maintenance=maintenance)
        self.counts.taken += 1
        self._gained[shard] = epoch
        silent_since, former = self._silent_since.pop(shard, None), self._formers.pop(shard, None)
        gained = OwnershipChange.GAINED
        self._events.append(
            ShardEvent(shard, gained, epoch, silent_since=silent_since, maintenance=maintenance, former=former)
        )
        self._compare(shard)

    def left(self, shard: str) -> None:
        """Record that a shard's links have stopped and their samples are stored; the next turn proposes its release.

        To be called after an event `OwnershipChange.LEAVE`. Does nothing if the shard is not owned any more.
        """
        owned = self.owned.get(shard)
        if owned is not None:
            owned.has_left = True
            owned.renew_at = 0.0

    def set_maintenance(self, shard: str, devices: Sequence[MaintainedDevice]) -> None:
        """Set which devices of an owned shard (group of links) are in maintenance; the next turn proposes to tell it.

        Does nothing if the shard is not owned, or if it is told already.
        """
        owned = self.owned.get(shard)
        if owned is not None and owned.maintenance != tuple(devices):
            owned.maintenance = tuple(devices)
            owned.renew_at = 0.0

    def _note_maintenance(self, record: LeaseRecord) -> None:
        self._said_maintenance.update((each.device, each.begin) for each in record.maintenance or ())

    def has_said(self, device: MaintainedDevice) -> bool:
        """Whether a lease, as far as this collector has seen it, has said this maintenance: same device, same begin."""
        return (device.device, device.begin) in self._said_maintenance

    # What goes out.

    def events(self) -> list[ShardEvent]:
        """Return the events of shards (groups of links) since the last call, in order; empty if there were none."""
        found, self._events = self._events, []
        return found

    def turn(self, now: float) -> list[Proposal]:
        """Return the changes of the shared table to be made now, each to be made once; empty if there is nothing to do.

        The changes renew leases and this collector's own entry, release shards (groups of links) and take free ones.
        Shards whose lease has run out are lost now; `events` then has these, and the shards that are to be given away.
        """
        for shard in [shard for shard, each in self.owned.items() if now >= self.times.deadline(each.asked)]:
            self.counts.lapsed += 1
            self._lapsed[shard] = self.owned[shard].asked
            self._lose(shard, "it could not be renewed in time", self._lapsed[shard] + self.wall_ahead)
        self._look_for_problems(now)
        found: list[Proposal] = []
        self._propose_member(now, found)
        self._propose_renewals(now, found)
        if self._complete_at is not None and now >= self._look_at:
            self._look_at = now + self._spread(LOOK_EVERY)
            if not self._agrees and not self._disagreement and ZONE not in self._open:
                self._propose(ZONE, self._zone.encode(), self._zone_revision, now, found)
            self._take_free(now, found)
            self._hand_on(now)
        return found

    def next_turn(self) -> float:
        """Return when `turn` must be called next, as a time of the clock of leases; infinity if nothing is due.

        After a call of another method that changes the state, `turn` must be called at once.
        """
        due = [self._look_at if self._complete_at is not None else float("inf")]
        if f"{MEMBERS}{self.name}" not in self._open:
            due.append(self._my_renewal)
        for shard, each in self.owned.items():
            due.append(self.times.deadline(each.asked))
            if f"{LEASES}{shard}" not in self._open:
                due.append(each.renew_at)
        return min(due)

    def _propose_member(self, now: float, found: list[Proposal]) -> None:
        key = f"{MEMBERS}{self.name}"
        if self._complete_at is None or now < self._my_renewal or key in self._open or self._me.gone:
            return
        self._me = replace(
            self._me,
            count=self._me.count + 1,
            gone=self._ends and not self.owned,
            at=now + self.wall_ahead,
            behind=self.behind,
        )
        self._my_renewal = now + self._spread(self.times.renew)
        self._propose(key, self._me.encode(), self._my_revision, now, found)

    def _propose_renewals(self, now: float, found: list[Proposal]) -> None:
        for shard, owned in self.owned.items():
            key = f"{LEASES}{shard}"
            if now >= owned.renew_at and key not in self._open and len(self._open) < MOST_OPEN:
                owned.renew_at = now + self._spread(self.times.renew)
                target = owned.leaving or ""
                record = LeaseRecord(
                    self.name,
                    self._me.run,
                    not owned.has_left,
                    owned.count + 1,
                    self.cost(shard),
                    owned.epoch,
                    target if owned.has_left else "",
                    now + self.wall_ahead,
                    hole=owned.hole,
                    silence=self.times.silence,
                    maintenance=owned.maintenance,
                )
                self._propose(key, record.encode(), owned.revision, now, found)

    def _propose(self, key: str, value: bytes, revision: int, now: float, found: list[Proposal]) -> None:
        proposal = Proposal(key, value, revision, now)
        self._open[key] = proposal
        found.append(proposal)

    def _take_free(self, now: float, found: list[Proposal]) -> None:
        free = self._free(now)
        mapped = takers(free, self._shares(now)) if free else {}
        self._free_since = {shard: self._free_since.get(shard, now) for shard in mapped}
        assert self._complete_at is not None
        if self._me.draining or self._my_asked is None or not self._is_known or not self._agrees:
            return
        if now < self._complete_at + SETTLE:
            return
        for shard, taker in mapped.items():
            if len(self._open) >= MOST_OPEN:
                return
            wait = WAIT_OF_BACKUPS if hosts_of(shard) else WAIT_FOR_OWNER
            seen = self._leases.get(shard)
            is_for_me = seen is not None and seen.record is not None and seen.record.target == self.name
            is_late = now >= self._free_since[shard] + wait
            is_mine = taker == self.name or is_for_me or (is_late and self._may_own(shard))
            if is_mine and f"{LEASES}{shard}" not in self._open:
                hole = self._hole_before(shard, seen, now + self.wall_ahead)
                self._note_silence(shard, seen, now + self.wall_ahead)
                former = None if seen is None else seen.record
                self._formers.pop(shard, None)
                if seen is not None and former is not None:
                    self._formers[shard] = former.epoch_at(seen.revision, self.generation)
                record = LeaseRecord(
                    self.name,
                    self._me.run,
                    True,
                    0,
                    self.cost(shard),
                    None,
                    at=now + self.wall_ahead,
                    before=self._last_epochs.get(shard),
                    hole=hole,
                    silence=self.times.silence,
                    maintenance=None if former is None else former.maintenance,
                )
                self._propose(f"{LEASES}{shard}", record.encode(), 0 if seen is None else seen.revision, now, found)

    def _hole_before(self, shard: str, seen: _SeenLease | None, end: float) -> LeaseHole | None:
        record = None if seen is None else seen.record
        if seen is None or record is None or not 0 < record.at < end:
            return None
        if self._had_no_answer(shard, record, seen.revision):
            return None if record.hole is None else replace(record.hole, end=end)
        return LeaseHole(record.owner, record.held, record.at, end)

    def _note_silence(self, shard: str, seen: _SeenLease | None, end: float) -> None:
        """Note when the last owner of a shard that is about to be taken fell silent; nothing if it released the shard.

        If the present lease is one that this collector took without an answer, it never owned the shard by it: the time
        noted before stays. If another collector took the lease and never renewed it, it may have had no answer either,
        so the time without an owner before that lease counts too. If the lease is dated by a clock that was not set
        yet, the silence begins when this collector last saw the lease change.

        Args:
            shard: name of the shard.
            seen: its lease as last seen; None if it never had one.
            end: the present time, seconds since 1970 UTC.
        """
        record = None if seen is None else seen.record
        if seen is not None and record is not None and self._had_no_answer(shard, record, seen.revision):
            return
        self._silent_since.pop(shard, None)
        if seen is None or record is None or not record.held:
            return
        since = record.at
        if record.run == self._me.run and shard in self._lapsed:
            since = self._lapsed[shard] + self.wall_ahead
        elif record.run != self._me.run and record.count == 0 and record.hole is not None:
            since = record.hole.begin
        is_before_the_clock = since < EARLIEST / NANOSECONDS <= end
        self._silent_since[shard] = seen.at + self.wall_ahead if is_before_the_clock else since

    def _had_no_answer(self, shard: str, record: LeaseRecord, revision: int) -> bool:
        """Whether this start of the collector took a lease but got no answer, and so never owned the shard by it."""
        is_taken = record.run == self._me.run and record.held and record.epoch is None
        return is_taken and record.epoch_at(revision, self.generation) != self._gained.get(shard)

    def _free(self, now: float) -> dict[str, float]:
        """Return the shards (groups of links) that have no owner now, and the cost of each, by name of the shard.

        If another shard becomes free before the next check for free shards, that check is moved to the earlier time.
        """
        found: dict[str, float] = {}
        for shard, cost in self._costs.items():
            if shard in self.owned:
                continue
            seen = self._leases.get(shard)
            free_at = float("-inf") if seen is None else self._free_at(seen)
            if now >= free_at:
                found[shard] = cost
            elif free_at < self._look_at:
                self._look_at = free_at
        return found

    def _free_at(self, seen: _SeenLease) -> float:
        record = seen.record
        if record is None:
            return seen.at
        if not record.held:
            for_another = record.target and record.target != self.name
            return seen.at + (1.0 if for_another else 0.0)
        return seen.at if record.run == self._me.run else max(self.times.free_at(seen.at), seen.at + record.silence)

    def _hand_on(self, now: float) -> None:
        """Begin to give away the shards that this collector must not keep or that `balance` moves."""
        leaving = sum(each.leaving is not None for each in self.owned.values())
        takes = takers({shard: self.cost(shard) for shard in self.owned}, self._shares(now)) if self._ends else {}
        for shard, owned in self.owned.items():
            unwanted = shard not in self._costs or self._ends or self._me.problem
            if unwanted and owned.leaving is None:
                reason = "the collector ends" if self._ends else self._me.problem or "no link belongs to it"
                self._leave(shard, owned, takes.get(shard, ""), reason)
        shares = self._shares(now)
        found = moves(self._owned_by_all(now), shares, moving=leaving > 0) if not self._free_since else []
        if not found:
            self._off_since = None
            return
        if self._off_since is None:
            self._off_since = now + SETTLE * self._chance.random()
        if now < self._off_since + (0.0 if self._me.draining else SETTLE):
            return
        for move in found:
            mine = self.owned.get(move.shard)
            if move.giver == self.name and mine is not None and mine.leaving is None and leaving < MOST_LEAVING:
                leaving += 1
                self._leave(move.shard, mine, move.taker, f"{move.taker} takes it")

    def _leave(self, shard: str, owned: OwnedShard, taker: str, reason: str) -> None:
        owned.leaving = taker
        self._events.append(ShardEvent(shard, OwnershipChange.LEAVE, owned.epoch, reason))

    def _lose(self, shard: str, reason: str, silent_since: float | None = None) -> None:
        owned = self.owned.pop(shard)
        self._events.append(ShardEvent(shard, OwnershipChange.LOST, owned.epoch, reason, silent_since))

    def _owned_by_all(self, now: float) -> dict[str, tuple[str, float]]:
        found: dict[str, tuple[str, float]] = {}
        for shard, cost in self._costs.items():
            if shard in self.owned:
                found[shard] = (self.owned[shard].leaving or self.name, cost)
                continue
            seen = self._leases.get(shard)
            if seen is not None and seen.record is not None:
                found[shard] = (seen.record.owner if seen.record.held else seen.record.target, cost)
        return found

    def _shares(self, now: float) -> list[Share]:
        loads: dict[str, float] = {}
        for owner, cost in self._owned_by_all(now).values():
            loads[owner] = loads.get(owner, 0.0) + cost
        return [
            Share(each.name, each.host, loads.get(each.name, 0.0), each.capacity, each.draining)
            for each in self.members(now)
        ]

    def _may_own(self, shard: str) -> bool:
        hosts = hosts_of(shard)
        return not hosts or self._me.host in hosts

    def _lives(self, seen: _SeenMember, now: float) -> bool:
        return not seen.record.gone and now < self.times.free_at(seen.at)

    def _spread(self, seconds: float) -> float:
        return seconds * (0.9 + 0.1 * self._chance.random())
