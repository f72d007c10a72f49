"""The entries of the shared table that operators write: configuration, drained collectors, lease times, generation.

Knows entries of the coordinator's table and the checks of a collector file; knows no collector.

1. A configuration is written only after it was checked, by compare-and-set on the revision that was seen. A refused
   one changes nothing.
2. Only the text of the configuration and the path of its file are shared: device profiles that the text names must be
   under the same path on every machine of the fleet.
3. The keys of the configuration and of drained collectors begin with ``control.``, so that a server can deny them to
   collectors. Those of the entries ``zone`` and ``generation`` do not.
4. The entry ``zone`` says how many shards there are and how long leases hold. The first collector makes the entry,
   unless an operator has. It may change only while no collector runs, which the caller checks. A collector that was cut
   off meanwhile owns nothing once it has read the new entry; the leases that it holds until then say themselves how
   long they hold.
"""

import asyncio
import contextlib
import json
import os
import zlib
from collections.abc import Collection
from contextlib import aclosing
from dataclasses import dataclass
from typing import Final

from ...config.file_text import read_text
from ...errors import ConfigError
from ..collector.configuration import CollectorConfiguration, parse_collector
from .coordinator import LONGEST_VALUE, SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Coordinator, Entry
from .coordinators.local import LocalCoordinator
from .lease_times import LeaseTimes
from .plant_configuration import (
    refuse_links_of_one_subject,
    refuse_moved_endpoints,
    refuse_moved_maintenance,
    refuse_ports_of_any_host,
    refuse_slow_links,
    refuse_two_owners,
    with_short_user_timeout,
)
from .shards import checked_name
from .table_records import (
    GENERATION,
    LEASES,
    MEMBERS,
    ZONE,
    ZoneRecord,
    decode_generation,
    decode_lease,
    decode_member,
    decode_zone,
)

CONTROL: Final = "control."
CONFIGURATION: Final = "control.configuration"
DRAINED: Final = "control.drain."
_LONGEST_TEXT: Final = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class SharedConfiguration:
    """The text of a plant's configuration, as the coordinator keeps it for all collectors.

    Attributes:
        name: path of the file that an operator applied.
        text: content of that file.
        revision: revision of the entry in the shared table; 0 for a file that is not in the table yet.
    """

    name: str
    text: str
    revision: int

    def parsed(self, times: LeaseTimes) -> CollectorConfiguration:
        """Check the text, and return it as a configuration of collectors (`with_short_user_timeout`).

        Args:
            times: the lengths of the leases; a transaction on a link must be short enough for them.

        Raises:
            ConfigError: the text is wrong, with all its problems; a transaction may last too long; or two links to one
                endpoint have different hosts.
        """
        configuration = with_short_user_timeout(parse_collector(self.text, self.name))
        refuse_slow_links(configuration, times)
        refuse_two_owners(configuration)
        return configuration


async def read_entries(coordinator: Coordinator, prefix: str) -> dict[str, Entry]:
    """Return the entries of the shared table whose keys begin with a prefix, as they are now, by key.

    Deleted entries are among them, with an empty value. Waits without limit for a coordinator that does not answer.

    Raises:
        ConfigError: the table can never be read, for example because rights are missing.
    """
    found: dict[str, Entry] = {}
    async with aclosing(coordinator.watch(prefix)) as entries:
        async for entry in entries:
            if entry is SNAPSHOT_ENDS:
                break
            if entry is SNAPSHOT_BEGINS:
                found.clear()
            else:
                found[entry.key] = entry
    return found


def decode_configuration(entry: Entry) -> SharedConfiguration:
    """Return the plant's configuration that an entry of the shared table holds. Raises `ConfigError` if unreadable."""
    try:
        unpacked = zlib.decompressobj().decompress(entry.value, _LONGEST_TEXT)
        name, text = json.loads(unpacked)
        return SharedConfiguration(str(name), str(text), entry.revision)
    except (ValueError, TypeError, RecursionError, zlib.error) as error:
        raise ConfigError(f"the fleet's configuration of revision {entry.revision} cannot be read: {error}") from error


async def read_configuration(coordinator: Coordinator) -> SharedConfiguration | None:
    """Return the configuration of a zone; None if none was applied. Raises `ConfigError` if it cannot be read."""
    entry = (await read_entries(coordinator, CONFIGURATION)).get(CONFIGURATION)
    return decode_configuration(entry) if entry is not None and entry.value else None


async def recorded_times(coordinator: Coordinator) -> LeaseTimes:
    """Return the lease times that are recorded for a zone; the defaults of `LeaseTimes` if none are, or none readable.

    The table has only ``ttl`` and ``guard``; ``renew`` and ``answer`` are in the proportion of the defaults to ``ttl``.

    Raises:
        ConfigError: the table can never be read, or its times are out of their range.
    """
    entry = (await read_entries(coordinator, ZONE)).get(ZONE)
    zone = None if entry is None else decode_zone(entry.value)
    return LeaseTimes() if zone is None else LeaseTimes.lasting(zone.ttl, zone.guard)


async def record_times(coordinator: Coordinator, times: LeaseTimes, shards: int) -> None:
    """Record the lease times of a zone; all collectors that start later use them.

    The caller must have made sure that no collector of the zone runs: this is not checked here.

    Args:
        coordinator: the coordinator of the zone.
        times: the lengths of the leases.
        shards: how many shards (groups of links) the zone has, if no collector has recorded that yet, 1…1024.

    Raises:
        ConfigError: the table can never be read.
        RevisionConflict: a collector, or another operator, recorded other times meanwhile, and those hold.
        CoordinatorDown: nothing was changed.
        OutcomeUnknown: the times may have been recorded.
    """
    entry = (await read_entries(coordinator, ZONE)).get(ZONE)
    zone = None if entry is None else decode_zone(entry.value)
    value = ZoneRecord(shards if zone is None else zone.shards, times.ttl, times.guard).encode()
    if entry is None:
        await coordinator.create(ZONE, value)
    else:
        await coordinator.replace(ZONE, value, entry.revision)


async def apply_configuration(coordinator: Coordinator, path: str, times: LeaseTimes | None = None) -> int:
    """Check a collector file, make it the configuration of the zone, and return its revision.

    Args:
        coordinator: the coordinator of the zone.
        path: path of the file.
        times: the lengths of the leases; None for those that are recorded for the zone.

    Raises:
        ConfigError: the file is wrong, with all problems, is too long, or would move an endpoint to another shard while
            a collector may live, or a device in maintenance. The zone's configuration is as before.
        RevisionConflict: another configuration was applied meanwhile, and is the zone's now.
        CoordinatorDown: nothing was changed.
        OutcomeUnknown: the file may have become the configuration.
    """
    seen = (await read_entries(coordinator, CONFIGURATION)).get(CONFIGURATION)
    times = times or await recorded_times(coordinator)
    may_run, maintained = await _may_run(coordinator), await _devices_in_maintenance(coordinator)
    before = _parsed(seen) if seen is not None and seen.value and (may_run or maintained) else None
    shared = await asyncio.to_thread(
        _checked,
        path,
        times,
        before,
        maintained,
        may_run=may_run,
        is_one_machine=isinstance(coordinator, LocalCoordinator),
    )
    packed = zlib.compress(json.dumps([shared.name, shared.text]).encode())
    if len(packed) > LONGEST_VALUE or len(shared.text) > _LONGEST_TEXT // 8:
        raise ConfigError(f"is too long for the fleet: {len(packed)} bytes packed, {LONGEST_VALUE} at most", file=path)
    if seen is None:
        return await coordinator.create(CONFIGURATION, packed)
    return await coordinator.replace(CONFIGURATION, packed, seen.revision)


def _checked(
    path: str,
    times: LeaseTimes,
    before: CollectorConfiguration | None,
    maintained: Collection[str],
    *,
    may_run: bool,
    is_one_machine: bool,
) -> SharedConfiguration:
    """Read and check a collector file, and return it with its absolute path and revision 0.

    Args:
        path: path of the file; errors name it as it was given.
        times: the lengths of the leases.
        before: the configuration of the zone; None for none.
        maintained: names of the devices in maintenance.
        may_run: whether collectors may work by ``before`` now.
        is_one_machine: whether all collectors of the zone are on one machine, so that a serial port needs no host.

    Raises:
        ConfigError: the file is wrong, with all problems, or moves an endpoint or a device to another shard.
    """
    text = read_text(path)
    configuration = SharedConfiguration(path, text, 0).parsed(times)
    if not is_one_machine:
        refuse_ports_of_any_host(configuration)
    refuse_links_of_one_subject(configuration)
    if before is not None:
        refuse_moved_maintenance(before, configuration, maintained)
        if may_run:
            refuse_moved_endpoints(before, configuration)
    return SharedConfiguration(os.path.abspath(path), text, 0)


def _parsed(entry: Entry) -> CollectorConfiguration | None:
    """Return the configuration of an entry; None if this program refuses the text: then no collector works by it."""
    try:
        shared = decode_configuration(entry)
        return parse_collector(shared.text, shared.name)
    except ConfigError:
        return None


async def _may_run(coordinator: Coordinator) -> bool:
    """Whether a collector of the zone may be running: one has joined and has not ended in order.

    So it is True for good after a crash; True too if the entry of a collector cannot be read. Waits and raises as
    `read_entries`.
    """
    members = await read_entries(coordinator, MEMBERS)
    records = [decode_member(entry.value) for entry in members.values() if entry.value]
    return any(record is None or not record.gone for record in records)


async def _devices_in_maintenance(coordinator: Coordinator) -> set[str]:
    """Return the names of the devices that are in maintenance by the leases of all shards, also of released ones."""
    entries = await read_entries(coordinator, LEASES)
    leases = [decode_lease(entry.value) for entry in entries.values() if entry.value]
    return {each.device for lease in leases if lease is not None for each in lease.maintenance or ()}


async def refuse_other_figures(coordinator: Coordinator, shards: int, times: LeaseTimes) -> None:
    """Raise `ConfigError` if the zone has another number of shards, or other lease times, than a collector that joins.

    Nothing is raised if the coordinator does not answer within ``times.answer`` seconds, or if the zone has recorded
    nothing yet. If the figures differ, the collector then finds that later, and owns nothing.

    Args:
        coordinator: the coordinator of the zone.
        shards: how many shards (groups of links) the collector believes the zone has.
        times: the lengths of the leases of the collector.
    """
    entry = None
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(times.answer):
            entry = (await read_entries(coordinator, ZONE)).get(ZONE)
    zone = None if entry is None else decode_zone(entry.value)
    difference = "" if zone is None else ZoneRecord(shards, times.ttl, times.guard).difference(zone)
    if difference:
        raise ConfigError(
            f"the zone has {difference}; all its collectors must have the same",
            key="times" if zone is not None and zone.shards == shards else "shards",
        )


async def drain_collector(coordinator: Coordinator, name: str, *, draining: bool = True) -> None:
    """Tell a collector to give away all its shards (groups of links) and to take none, or to take part again.

    Returns once the order is in the table; the collector follows it later. The order also holds for later starts of the
    collector. Shards that no other collector can take stay with it.

    Args:
        coordinator: the coordinator of the zone.
        name: name of the collector.
        draining: False to let the collector take part again.

    Raises:
        ConfigError: no collector of the zone has ever had this name, or the name is invalid.
        RevisionConflict: the order was changed by another operator meanwhile; it is as that one has set it.
        CoordinatorDown: nothing was changed.
        OutcomeUnknown: the order may have been given.
    """
    members = await read_entries(coordinator, MEMBERS)
    if MEMBERS + checked_name(name, "collector") not in members:
        there = ", ".join(sorted(key.removeprefix(MEMBERS) for key in members)) or "none yet"
        raise ConfigError(f"no collector has the name {name}; there are {there}", key="NAME")
    key = DRAINED + name
    seen = (await read_entries(coordinator, key)).get(key)
    if seen is None:
        await coordinator.create(key, b"drain" if draining else b"")
    else:
        await coordinator.replace(key, b"drain" if draining else b"", seen.revision)


async def raise_generation(coordinator: Coordinator, now: float) -> int:
    """Raise the generation of a zone, so that all later epochs are above the earlier ones; return the new generation.

    To be called for a coordinator that has lost its entries, or got older ones back from a backup. The new generation
    is ``now`` in whole seconds, so that it is above a generation that was lost; if the recorded one is not below
    ``now``, it is one more than that.

    Args:
        coordinator: the coordinator of the zone.
        now: seconds since 1970 UTC.

    Raises:
        ConfigError: the table can never be read.
        RevisionConflict: the generation was raised by another operator meanwhile.
        CoordinatorDown: nothing was changed.
        OutcomeUnknown: the generation may have been raised.
    """
    seen = (await read_entries(coordinator, GENERATION)).get(GENERATION)
    generation = max(int(now), 1 + (0 if seen is None else decode_generation(seen.value)))
    if seen is None:
        await coordinator.create(GENERATION, b"%d" % generation)
    else:
        await coordinator.replace(GENERATION, b"%d" % generation, seen.revision)
    return generation
