"""The status of a zone, computed from its shared table: collectors, owners of shards, epochs, load, configuration.

Knows entries of the coordinator; asks no collector.

1. A collector lives if its entry in the table changes while the table is followed: no wall clock is compared.
"""

import asyncio
from collections.abc import Container, Mapping
from contextlib import aclosing
from dataclasses import dataclass, replace

from .control_entries import CONFIGURATION, DRAINED, decode_configuration
from .coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Coordinator, Entry
from .table_records import (
    GENERATION,
    LEASES,
    MEMBERS,
    LeaseRecord,
    MemberRecord,
    decode_generation,
    decode_lease,
    decode_member,
)


@dataclass(frozen=True, slots=True)
class ZoneMember:
    """The status of one collector of a zone: whether it lives, which shards it owns, and its load.

    Attributes:
        record: what the collector tells of itself.
        lives: whether the collector renews its entry in the shared table, as far as the follower of the table has seen.
        is_drained: whether an operator has told the collector to give away its shards (groups of links).
        load: seconds of line time per second that polling its shards needs.
        shards: names of the shards that the collector owns.
    """

    record: MemberRecord
    lives: bool
    is_drained: bool
    load: float
    shards: tuple[str, ...]

    @property
    def state(self) -> str:
        """The state of the collector in one word: ``polls``, ``drains``, ``refuses``, ``silent`` or ``ended``.

        A collector that polls may take and keep shards; one that drains gives them away. One that refuses owns nothing,
        for the reason in ``record.problem``. A silent one no longer renews its entry; an ended one has released its
        shards and left the zone.
        """
        if self.record.gone:
            return "ended"
        if not self.lives:
            return "silent"
        if self.record.problem:
            return "refuses"
        return "drains" if self.record.draining or self.is_drained else "polls"


@dataclass(frozen=True, slots=True)
class ZoneStatus:
    """The status of a zone of a fleet: its collectors, the owner of each shard (group of links), its configuration.

    Attributes:
        members: the collectors, by name.
        leases: the last known lease of each shard, by name of the shard.
        configuration: path of the configuration file that an operator applied; empty if none was.
        revision: revision of that configuration; 0 for none.
        generation: the generation number of the zone.
    """

    members: dict[str, ZoneMember]
    leases: dict[str, LeaseRecord]
    configuration: str
    revision: int
    generation: int = 1


async def zone_status(coordinator: Coordinator, seconds: float) -> ZoneStatus:
    """Return the status of a zone, after following its table until each running collector has renewed its entry.

    Args:
        coordinator: the coordinator of the zone; not closed here.
        seconds: longest wait for renewals, from when all entries are known. A collector that has not renewed its entry
            by then counts as not alive. The wait for the entries themselves has no limit.

    Raises:
        ConfigError: the table cannot be followed, or the zone's configuration cannot be read.
    """
    found: dict[str, Entry] = {}
    living: set[str] = set()
    try:
        async with asyncio.timeout(None) as limit, aclosing(coordinator.watch()) as entries:
            is_complete = False
            async for entry in entries:
                if entry is SNAPSHOT_BEGINS:
                    continue
                if entry is SNAPSHOT_ENDS:
                    is_complete = True
                    limit.reschedule(asyncio.get_running_loop().time() + seconds)
                else:
                    if is_complete and entry.key.startswith(MEMBERS) and entry.key in found:
                        living.add(entry.key)
                    found[entry.key] = entry
                if is_complete and _running(found) <= living:
                    break
    except TimeoutError:
        pass
    return status_of(found, living)


def _running(found: dict[str, Entry]) -> set[str]:
    """Return the keys of the table entries of collectors that have not ended in order.

    Entries that cannot be read are left out.
    """
    members = {key: decode_member(entry.value) for key, entry in found.items() if key.startswith(MEMBERS)}
    return {key for key, record in members.items() if record is not None and not record.gone}


def generation_of(found: Mapping[str, Entry]) -> int:
    """Return the generation number of a zone, from the entries of its table by key; 1 if there is none."""
    return decode_generation(found[GENERATION].value) if GENERATION in found else 1


def status_of(found: Mapping[str, Entry], living: Container[str]) -> ZoneStatus:
    """Return the status of a zone, computed from the entries of its table.

    Args:
        found: all entries of the table, by key.
        living: keys of the entries of the collectors that live (``member.NAME``).

    Raises:
        ConfigError: the zone's configuration in the table cannot be read.
    """
    generation = generation_of(found)
    leases: dict[str, LeaseRecord] = {}
    for key, entry in sorted(found.items()):
        lease = decode_lease(entry.value) if key.startswith(LEASES) else None
        if lease is not None:
            leases[key.removeprefix(LEASES)] = replace(lease, epoch=lease.epoch_at(entry.revision, generation))
    members: dict[str, ZoneMember] = {}
    for key, entry in sorted(found.items()):
        record = decode_member(entry.value) if key.startswith(MEMBERS) else None
        if record is not None:
            owned = {shard: each for shard, each in leases.items() if each.held and each.run == record.run}
            drained = found.get(DRAINED + record.name)
            members[record.name] = ZoneMember(
                record,
                key in living,
                drained is not None and bool(drained.value),
                sum(each.cost for each in owned.values()),
                tuple(owned),
            )
    entry = found.get(CONFIGURATION, Entry("", b"", 0))
    name = decode_configuration(entry).name if entry.value else ""
    return ZoneStatus(members, leases, name, entry.revision, generation)
