"""The status of a zone as its coordinator shows it: collectors, owners of shards, epochs, load, configuration.

Knows entries of the coordinator; asks no collector.

1. A collector lives if its entry changes while it is looked at: no wall clock is compared.
"""

import asyncio
from collections.abc import Container, Mapping
from contextlib import aclosing
from dataclasses import dataclass, replace

from .control_entries import CONFIGURATION, DRAINED, decode_configuration
from .coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Coordinator, Entry
from .records import (
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
    """One collector of a zone.

    Attributes:
        record: what it says of itself.
        lives: whether it renewed its entry while it was looked at.
        is_drained: whether an operator drains it.
        load: seconds of line time in a second that its shards need.
        shards: those that it owns.
    """

    record: MemberRecord
    lives: bool
    is_drained: bool
    load: float
    shards: tuple[str, ...]

    @property
    def state(self) -> str:
        """``polls``, ``drains``, ``refuses`` (its record says why), ``silent`` or ``ended``."""
        if self.record.gone:
            return "ended"
        if not self.lives:
            return "silent"
        if self.record.problem:
            return "refuses"
        return "drains" if self.record.draining or self.is_drained else "polls"


@dataclass(frozen=True, slots=True)
class ZoneStatus:
    """The status of a zone.

    Attributes:
        members: by name.
        leases: by shard, the last known lease.
        configuration: the path of the file that was applied; empty for none.
        revision: of the configuration; 0 for none.
        generation: the generation of the zone.
    """

    members: dict[str, ZoneMember]
    leases: dict[str, LeaseRecord]
    configuration: str
    revision: int
    generation: int = 1


async def zone_status(coordinator: Coordinator, seconds: float) -> ZoneStatus:
    """Look at a zone until every collector has renewed its entry, at most for some seconds. Raises `ConfigError`."""
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
    """Return the keys of collectors that have not ended in order."""
    members = {key: decode_member(entry.value) for key, entry in found.items() if key.startswith(MEMBERS)}
    return {key for key, record in members.items() if record is not None and not record.gone}


def status_of(found: Mapping[str, Entry], living: Container[str]) -> ZoneStatus:
    """Return the status of a zone. Raises `ConfigError` for a configuration that cannot be read.

    Args:
        found: the entries of its table, by key.
        living: the keys of collectors that live.
    """
    generation = decode_generation(found[GENERATION].value) if GENERATION in found else 1
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
