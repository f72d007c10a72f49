"""Follows the shared table of a zone for the zone's web page: the status now, and times in which shards had no owner.

Knows entries of the coordinator; asks no collector.

1. A collector counts as alive for `LeaseTimes.silence` seconds after each change of its entry that this process sees;
   the first sight of the entry counts as a change.
2. A hole is the time from an owner's last renewal, or its release, until the next owner took the shard, by the wall
   clocks of both. An owner that fell silent may have polled for a part of that time, so the real hole may be shorter.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from contextlib import aclosing
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self

from ...errors import ConfigError
from ..collector.cancellation import end_tasks
from .coordinator import SNAPSHOT_BEGINS, SNAPSHOT_ENDS, Coordinator, Entry
from .epoch import Epoch
from .fleet_status import ZoneStatus, generation_of, status_of
from .lease_driver import boot_time, keep_following
from .lease_times import LeaseTimes
from .table_records import LEASES, MEMBERS, LeaseRecord, decode_lease, decode_list, integer_of

CURSORS: Final = "cursor."
MOST_HOLES: Final = 200
"""Most holes that are remembered; older ones are in the stores of the collectors."""
_log = logging.getLogger("busway.fleet")


@dataclass(frozen=True, slots=True)
class OwnershipHole:
    """A span of time in which no collector owned a shard (group of links).

    Attributes:
        shard: name of the shard.
        before, after: names of the collector that owned the shard before, and of the one that took it.
        was_silent: True if the owner before stopped renewing its lease; False if it released the shard.
        begin: when the owner before renewed or released its lease for the last time, seconds since 1970 UTC.
        end: when the new owner took the shard, seconds since 1970 UTC.
        epoch: the epoch of the new ownership.
    """

    shard: str
    before: str
    after: str
    was_silent: bool
    begin: float
    end: float
    epoch: Epoch


class ZoneWatch:
    """Follows the shared table of a zone while the ``async with`` block lasts, and tells the status of the zone.

    If the table cannot be followed (`ConfigError`), that is logged once, following ends, and `is_complete` stays False.

    Args:
        coordinator: the coordinator of the zone; not closed here.
        times: the lengths of the leases, the same as those of the collectors; None for the defaults of `LeaseTimes`.
        now: returns the time of the clock of leases, in seconds; see `boot_time`.
    """

    def __init__(
        self, coordinator: Coordinator, times: LeaseTimes | None = None, *, now: Callable[[], float] = boot_time
    ) -> None:
        self._coordinator, self._times, self._now = coordinator, times or LeaseTimes(), now
        self._entries: dict[str, Entry] = {}
        self._shown_again: set[str] = set()
        self._seen: dict[str, float] = {}
        self._holes: deque[OwnershipHole] = deque(maxlen=MOST_HOLES)
        self._complete = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        """Begin to follow the zone's table in a task; its entries are not known yet (`is_complete`)."""
        self._task = asyncio.create_task(self._follow(), name="busway fleet watch")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop following the zone's table. The coordinator stays open."""
        assert self._task is not None
        await end_tasks([self._task])

    @property
    def is_complete(self) -> bool:
        """Whether all entries of the table are known; False at the start and while the coordinator is away."""
        return self._complete.is_set()

    def status(self) -> ZoneStatus:
        """Return the status of the zone as far as it is known now (`is_complete`); nothing is waited for.

        Raises:
            ConfigError: the zone's configuration in the table cannot be read.
        """
        now = self._now()
        living = {key for key, at in self._seen.items() if key.startswith(MEMBERS) and now < self._times.free_at(at)}
        return status_of(self._entries, living)

    def holes(self) -> list[OwnershipHole]:
        """Return the times in which a shard had no owner, the latest first, `MOST_HOLES` at most.

        Only those whose end this object has seen while it followed the table.
        """
        return [*reversed(self._holes)]

    def sinks(self) -> dict[str, int]:
        """Return by name of each sink the number of the last message that the sink has taken from the zone's stream.

        Sinks whose entry cannot be read are left out.
        """
        found: dict[str, int] = {}
        for key, entry in sorted(self._entries.items()):
            if key.startswith(CURSORS) and entry.value:
                try:
                    found[key.removeprefix(CURSORS)] = integer_of(decode_list(entry.value)[0])
                except (ValueError, TypeError, LookupError):
                    continue  # of a newer version of this program
        return found

    def take(self, entry: Entry) -> None:
        """Update the status by an entry of the table, or by a mark (`SNAPSHOT_BEGINS`, `SNAPSHOT_ENDS`).

        An entry that is not newer than the known one is ignored, unless a new snapshot shows it with a lower revision.
        """
        if entry is SNAPSHOT_BEGINS:
            self._complete.clear()
            self._shown_again = set(self._entries)
        elif entry is SNAPSHOT_ENDS:
            self._complete.set()
        else:
            known = self._entries.get(entry.key)
            if known is not None and entry.key in self._shown_again:
                self._shown_again.discard(entry.key)
                if entry.revision < known.revision:  # what was shown before was wrong
                    known = None
            if known is not None and entry.revision <= known.revision:
                return
            if entry.key.startswith(LEASES) and known is not None:
                self._note_hole(entry, decode_lease(entry.value))
            self._entries[entry.key] = entry
            self._seen[entry.key] = self._now()

    def _note_hole(self, entry: Entry, lease: LeaseRecord | None) -> None:
        if lease is None or lease.hole is None or not lease.held or lease.count:
            return  # a renewal, a release
        epoch = lease.epoch_at(entry.revision, generation_of(self._entries))
        hole, shard = lease.hole, entry.key.removeprefix(LEASES)
        self._holes.append(OwnershipHole(shard, hole.before, lease.owner, hole.was_silent, hole.begin, hole.end, epoch))

    async def _follow(self) -> None:
        try:
            await keep_following(self._follow_table, "the table of the zone", lambda: self.take(SNAPSHOT_BEGINS))
        except ConfigError as error:
            self.take(SNAPSHOT_BEGINS)
            _log.error("the status of the zone is not known: its table cannot be followed: %s", error)

    async def _follow_table(self) -> None:
        async with aclosing(self._coordinator.watch()) as entries:
            async for entry in entries:
                self.take(entry)
