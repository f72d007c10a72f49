"""A collector of a fleet: polls only the links of the shards that it owns, as the coordinator says.

Knows the collector, the holder of leases and the log of ownership; which shards are owned is decided by `lease_holder`.

1. Polling of a link begins after its epoch is on disk. It stops before the link's shard is handed on: running requests
   end, samples taken so far are committed, and only then is the lease released. Where a gateway may still hold a
   request that was not answered (``gateway_wait``), the release waits for that long, and so does the confirmation of a
   newer configuration without the link.
2. Right before each transaction it is checked that even the longest one ends before the lease
   (`LeaseHolder.permits`); and again when each of its frames is sent, on a line perhaps seconds later. So a lease
   that lapses ends polling at once, even if no task of this program gets to run.
3. Changes of ownership are applied one after the other; several that have come together are applied as one. While the
   disk does not take what was sampled before, they wait, and so does a newer configuration: samples would get the
   epoch or the revision of later ones.
4. The store has an interval for each time in which a link was not owned: from the end of polling here until the link is
   owned again. A collector that takes a link from an owner that fell silent records the time since that owner's last
   renewal, in its store and for the sinks of the stream. Samples that the old owner still sends make this gap shorter
   in the sinks of the stream (`ownership_gaps`). One that was killed records at its next start that its ownership ended
   with its last commit. These times are by the clock of the samples. Those from before the wall clock was right are
   corrected with theirs.
5. The key of each command that writes a point is taken for the whole zone before anything is sent to the device
   (`key_table`), no matter how the command came: page, HTTP, MQTT, NATS. A message with a command is executed and
   answered by the owner of its link; with ``zone`` a server gives the message to one collector, which passes it on.
6. A collector that was started with a revision takes each newer configuration of the zone, as a whole. One that is
   refused, by its check or because a sink differs, changes nothing, and `refused` says why. Links that a new
   configuration changes stop before the last commit of the old one, so every sample has the revision with which it was
   taken. The store stays the one with which the collector was started, whatever the new configuration names.
7. Maintenance of a device goes with its link: the lease of a shard says which of its devices are in maintenance. The
   collector that takes the shard takes over their maintenance before it polls or tells anything, and ends a maintenance
   of its own that a later owner has ended since. That has not happened if no lease has ever said it, or if the lease is
   of an earlier epoch (a table that was put back). What ended here comes back by no lease of its own. The lease goes on
   to say it of devices that the configuration of the collector does not have, because it is an older one; with the
   newer configuration the collector takes over their maintenance, too.
"""

import asyncio
import logging
import math
import random
import secrets
import sqlite3
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, aclosing
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from ...errors import ConfigError, LinkDown
from ..collector.cancellation import end_tasks
from ..collector.collector import Collector
from ..collector.commands.command import CommandState, PointCommand
from ..collector.configuration import CollectorConfiguration
from ..collector.sample_clock import EARLIEST, ClockCorrection
from ..collector.samples import NANOSECONDS, Reason, StateInterval
from ..collector.store.manifest import MaintenanceRow
from .chosen_samples import refuse_what_needs_a_store
from .control_entries import CONFIGURATION, CONTROL, DRAINED, decode_configuration, refuse_other_figures
from .coordinator import Coordinator, Entry
from .coordinators.local import LocalCoordinator
from .epoch import Epoch
from .key_table import KeyTable
from .lease_driver import LeaseDriver, boot_time
from .lease_holder import CLOCK_LIMIT, LeaseHolder, OwnershipChange, ShardEvent
from .lease_times import LeaseTimes
from .outbox import Outbox, SampleStream
from .ownership_gaps import OwnershipGap
from .ownership_log import OwnershipLog
from .plant_configuration import (
    costs_by_link,
    link_times,
    links_of_shards,
    name_edge_nodes,
    refuse_ports_of_any_host,
    refuse_slow_links,
    refuse_two_owners,
    restricted,
    with_short_user_timeout,
)
from .shards import checked_name
from .table_records import LONGEST_WORD, MaintainedDevice

LOOK_AGAIN: Final = 1.0
"""Seconds after which a link without a known owner is checked again: the entry of its new owner may not be read yet."""
RECORD_AGAIN: Final = 1.0
"""Seconds after which it is tried again to record owned links on disk, if that failed."""
END_LIMIT: Final = 10.0
"""Longest wait in seconds for the release of all shards when the collector ends."""

_log = logging.getLogger("busway.fleet")


class _NotStored(Exception):
    """Error: the store has not taken all samples in time."""


class FleetCollector:
    """A collector that shares the links of a plant with others, and polls those it owns while ``async with`` lasts.

    Args:
        configuration: the configuration of the whole plant; each collector of the fleet has a store of its own.
        coordinator: the coordinator of the zone; not closed here.
        name: name of this collector, the only one of that name in the zone.
        host: name of this machine, for links that only some machines can reach.
        shards: how many shards (groups of links) the zone has, 1…1024; the same for all collectors.
        hosts: for each link, the names of the machines that can reach it, the preferred one first. Links that are
            missing have the hosts that the configuration names for them; without such names all machines can reach
            them.
        times: the lengths of the leases, the same for all collectors; None for the defaults of `LeaseTimes`.
        capacity: this collector's part of the work, relative to the others.
        stream: gets the collector's samples; None if they stay in its own store.
        revision: revision of the configuration if it is from the coordinator: newer revisions are then applied too
            (rule 6), and orders to drain are followed. 0 if the configuration is not from the coordinator.
        keys: the table of the keys of commands, the same for all collectors; not closed here. None if the keys are in
            the table of ``coordinator``.
        zone: name of the zone if a `FleetCommands` passes on commands for links of other collectors; empty if commands
            cannot be passed on.
        now: returns the time of the clock of leases, in seconds.

    Attributes:
        member: the collector's state in the zone, such as the shards that it owns.
        collector: polls the devices.
        ownership: the record of which links this collector owned when.
        outbox: sends the samples to the stream; None without a stream.
        revision: revision of the configuration in force; 0 if it is not from the coordinator.
        unowned_seconds: seconds for which links had no owner before this collector took them, as far as is known; the
            sum of all links.
        pass_on: asks the owner of a link to execute a command, and returns its answer; set by `FleetCommands`. None
            while commands cannot be passed on.

    Raises:
        ConfigError: a transaction on a link may last longer than a lease allows, two links to one endpoint have
            different hosts, a serial port has no host though machines differ, a name is invalid, or collectors would
            share an edge node of Sparkplug.
    """

    collector: Collector
    ownership: OwnershipLog
    outbox: Outbox | None

    def __init__(
        self,
        configuration: CollectorConfiguration,
        coordinator: Coordinator,
        name: str,
        *,
        host: str,
        shards: int = 256,
        hosts: Mapping[str, Sequence[str]] | None = None,
        times: LeaseTimes | None = None,
        capacity: float = 1.0,
        stream: SampleStream | None = None,
        revision: int = 0,
        keys: Coordinator | None = None,
        zone: str = "",
        now: Callable[[], float] = boot_time,
    ) -> None:
        times = times or LeaseTimes()
        configuration = with_short_user_timeout(configuration)
        refuse_slow_links(configuration, times)
        refuse_two_owners(configuration)
        if not isinstance(coordinator, LocalCoordinator) and not hosts:
            refuse_ports_of_any_host(configuration)
        self._now = now
        self._stream = stream
        self._coordinator, self._shards, self._hosts = coordinator, shards, dict(hosts or {})
        self.revision: int = revision
        self._refusal: tuple[int, ConfigError] | None = None
        self._delay: str | None = None
        self.unowned_seconds: float = 0.0
        self.outbox = None
        self.pass_on: Callable[[str, PointCommand, str], Awaitable[dict[str, Any]]] | None = None
        self._others = _OtherOwners(self, name, f"busway-{zone}" if zone else "")
        name_edge_nodes(configuration, name)
        self._set_configuration(configuration)
        self.member: LeaseHolder = LeaseHolder(
            checked_name(name, "collector"),
            secrets.token_hex(8),
            checked_name(host, "host"),
            times,
            random.Random(),
            capacity=capacity,
            shards=shards,
        )
        self.member.set_revision(revision)
        self._keys = KeyTable(keys or coordinator, name)
        self._driver = LeaseDriver(self.member, coordinator, self._told, now=now, behind=lambda: self.behind)
        self._active: dict[str, Epoch] = {}
        self._active_since: dict[str, float] = {}
        self._begun: dict[str, Epoch] = {}
        """By shard, the last epoch that is recorded with the gaps before it."""
        self._owned_last: dict[str, Epoch] = {}
        """By link, the last epoch in which a collector of this name and store has owned it."""
        self._maintained: dict[str, MaintainedDevice] = {}
        """The devices in maintenance here as last told, by name."""
        self._told_before: set[tuple[str, int]] = set()
        """Device and begin of each maintenance that was known at the start."""
        self._ended: set[tuple[str, int]] = set()
        """Device and begin of each maintenance that has ended here."""
        self._link_followers: list[Callable[[], None]] = []
        self._first_commit = 0
        self._unowned_since: dict[str, int] = {}
        self._permitted: dict[str, float] = {}
        self._held_until: dict[str, float] = {}
        self._left_until = -math.inf
        self._waiting: list[ShardEvent] = []
        self._newer: tuple[CollectorConfiguration, int] | None = None
        self._gone: dict[str, Epoch] = {}
        self._wake = asyncio.Event()
        self._defect = ""
        self._is_ending = False
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        """Open the store, and join the collectors of the zone; links are polled later, once their shards are owned.

        Raises the errors of `Collector.__aenter__`, and `ConfigError` if the zone has another number of shards or other
        lease times, or the record of ownership cannot be used.
        """
        await refuse_other_figures(self._coordinator, self._shards, self.member.times)
        async with AsyncExitStack() as unless_started:
            await unless_started.enter_async_context(self._keys)
            collector = Collector(
                restricted(self._configuration, ()),
                permit=self._permit,
                may_send=self._may_send,
                unanswered=self._note_unanswered,
                claims=self._keys,
                plant=lambda: self._configuration,
                others=self._others,
            )
            self.collector = await unless_started.enter_async_context(collector)
            self._first_commit = collector.newest_commit
            self._set_costs()
            self.ownership = OwnershipLog(Path(self._configuration.store))
            unless_started.callback(self.ownership.close)
            self.ownership.set_configuration(self.revision, collector.newest_commit)
            collector.on_mending.append(self._mend)
            collector.on_maintenance.append(self._tell_maintenance)
            self._maintained = {name: _maintained_device(row) for name, row in collector.in_maintenance().items()}
            self._told_before = {(each.device, each.begin) for each in self._maintained.values()}
            self._note_owned((row.link, row.epoch) for row in self.ownership.all())
            self._end_what_was_owned()
            self.outbox = self._opened_outbox()
            self._tasks = [
                asyncio.create_task(self._driver.run(), name="busway fleet member"),
                asyncio.create_task(self._apply_changes(), name="busway fleet links"),
            ]
            if self.revision:
                self._tasks.append(asyncio.create_task(self._follow(), name="busway fleet configuration"))
            if self.outbox is not None:
                self._tasks.append(asyncio.create_task(self.outbox.run(), name="busway fleet outbox"))
            for task in self._tasks:
                task.add_done_callback(self._part_ended)
            unless_started.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop polling, release all owned shards (groups of links) in at most `END_LIMIT` seconds, and close the store.

        While a gateway may hold a request, the limit is longer, by at most the length of a lease. Leases that could not
        be released in time lapse, and other collectors take the shards later.
        """
        async with AsyncExitStack() as steps:
            steps.callback(self.ownership.close)
            steps.push_async_exit(self._keys)
            steps.push_async_exit(self.collector)
            steps.push_async_callback(self._end_tasks)
            limit = END_LIMIT + min(self._held_for(self._held_until), self.member.times.ttl)
            if not any(task.done() for task in self._tasks) and not await self._driver.end(limit):
                _log.warning("not all shards were handed back in %.3g s: others take them later", limit)

    @property
    def links(self) -> frozenset[str]:
        """The names of the links that this collector polls now."""
        return frozenset(self._active)

    def owned_since(self, link: str) -> float | None:
        """Return since when this collector polls a link, in seconds of `time.monotonic`; None if it does not."""
        return self._active_since.get(link) if link in self._active else None

    def follow_links(self, told: Callable[[], None]) -> None:
        """Register a function that is called in the event loop each time that `links` may have changed.

        The function must be quick.

        Args:
            told: the function.
        """
        self._link_followers.append(told)

    @property
    def problem(self) -> str:
        """Why this collector may own no links, or why its leases are not renewed, in words; empty while all is well."""
        return self._defect or self._driver.problem

    @property
    def refused(self) -> str | None:
        """Why the newest configuration of the zone was not applied, or why it waits; None if it was applied.

        The refusal of the newest one stays also while an older one waits, and after that was applied.
        """
        if self._refusal is None:
            return self._delay
        revision, error = self._refusal
        return f"revision {revision} is refused, revision {self.revision} holds: {error}"

    @property
    def is_confirmed(self) -> bool:
        """Whether the coordinator has confirmed this collector's last change of the shared table; True at the start.

        False after a change without a confirmation, until a later one is confirmed. A change that still waits for its
        answer, or was refused because the entry had another revision, does not count.
        """
        return self._driver.error is None

    @property
    def behind(self) -> int:
        """The number of commits of the store that not all sinks have; 0 without a stream."""
        return 0 if self.outbox is None else max(0, self.collector.newest_commit - self.outbox.status().kept)

    def _opened_outbox(self) -> Outbox | None:
        if self._stream is None:
            return None
        return Outbox(
            Path(self._configuration.store),
            self.collector.manifest,
            self._stream,
            collector=self.member.name,
            store=self.ownership.store,
            link_of=lambda: self._link_of,
            shard_of=self.shard_of,
            epoch_of=self.ownership.epoch_of,
            revision_of=self.ownership.revision_of,
            gaps_of=self.ownership.gaps,
            now=self._now,
        )

    def link_of(self, device: str) -> str:
        """Return the name of the link of a device of the plant; empty if the configuration has no such device."""
        return self._link_of.get(device, "")

    def is_responsible(self, link: str) -> bool:
        """Whether this collector is the one that answers commands for a link: True if it owns the link.

        If no live collector owns the link, True for the live collector whose name sorts first, so that one of all
        answers.
        """
        lease = self.member.leases().get(self.shard_of(link))
        living = {each.name for each in self.member.members(self._now())} | {self.member.name}
        owner = lease.owner if lease is not None and lease.held else ""
        return (owner if owner in living else min(living)) == self.member.name

    def shard_of(self, link: str) -> str:
        """Return the name of a link's shard (group of links); ``none`` if the configuration has no such link."""
        return self._shard_of.get(link, "none")

    @property
    def configuration(self) -> CollectorConfiguration:
        """The configuration in force, with the links of all collectors of the zone."""
        return self._configuration

    def _set_configuration(self, configuration: CollectorConfiguration) -> None:
        self._configuration = configuration
        self._links_of = links_of_shards(configuration, self._shards, self._hosts)
        self._shard_of = {link: shard for shard, links in self._links_of.items() for link in links}
        self._times_of = link_times(configuration)
        self._link_of = {device.name: device.link for device in configuration.devices.values()}

    def _set_costs(self) -> None:
        """Tell `member` which shards (groups of links) the configuration has, and what polling each of them costs."""
        loads = {load.link: load.load for load in self._configuration.loads(self.collector.knowledge)}
        costs = costs_by_link(self._configuration, loads)
        self.member.set_shards({shard: sum(costs[link] for link in links) for shard, links in self._links_of.items()})

    async def _follow(self) -> None:
        """Follow the coordinator's table until cancelled: apply newer configurations and orders to drain."""
        async with aclosing(self._coordinator.watch(CONTROL)) as entries:
            async for entry in entries:
                if entry.key == CONFIGURATION and entry.value and entry.revision > self.revision:
                    await self._check(entry)
                elif entry.key == DRAINED + self.member.name:
                    self.member.drain(draining=bool(entry.value))
                    self._driver.wake()

    async def _check(self, entry: Entry) -> None:
        """Check a newer configuration of the zone: if it is right, `_apply_changes` applies it; else set `refused`."""
        try:
            shared = decode_configuration(entry)
            newer = await asyncio.to_thread(shared.parsed, self.member.times)
            if not isinstance(self._coordinator, LocalCoordinator) and not self._hosts:
                refuse_ports_of_any_host(newer)
            if self._stream is not None:
                refuse_what_needs_a_store(newer)
            sinks = newer.sinks if self._stream is None else {}  # its samples reach sinks through the stream
            newer = replace(newer, store=self._configuration.store, sinks=sinks)
            name_edge_nodes(newer, self.member.name)
            self.collector.check(newer)
        except ConfigError as error:
            self._refusal = entry.revision, error
            _log.error("%s", self.refused)
            return
        self._refusal = self._delay = None
        self._newer = newer, entry.revision
        self._wake.set()

    async def _take_newer(self) -> None:
        """Apply the newer configuration that was checked; do nothing if there is none.

        Links that it lacks end, links that it changes begin anew, and its new links of owned shards begin. Links of a
        shard that was gained meanwhile begin later, when the event of the shard is applied: only the event says since
        when the shard had no owner.

        Raises:
            sqlite3.Error: ownership cannot be recorded; this is to be called again later, and goes on then.
            _NotStored: samples wait for the disk, or the store cannot be written; this is to be called again later too.
        """
        if self._newer is None:
            return
        newer, revision = taken = self._newer
        gone = [link for link in self._active if link not in newer.links]
        self._gone.update((link, self._active.pop(link)) for link in gone)
        changed = self.collector.changed_links(newer)
        if changed:  # they stop before the flush: what they take later is of the newer configuration
            staying = self._active.keys() - changed
            await self.collector.reload(restricted(self._configuration, staying), by=self.member.name, origin="fleet")
        stopped = [link for link in self._held_until if link in changed or link not in self._active]
        self._left_until = max(self._left_until, self._now() + self._held_for(stopped))
        await self._store_samples()
        commit = self.collector.newest_commit
        await asyncio.to_thread(self.ownership.end, list(self._gone.items()), commit, self.collector.sample_time())
        self._gone.clear()
        await asyncio.to_thread(self.ownership.set_configuration, revision, commit)
        self._take_over_maintenance_of_new(newer)
        gone_devices = self._configuration.devices.keys() - newer.devices.keys()
        self._set_configuration(newer)
        self.revision = revision
        for shard, owned in list(self.member.owned.items()):
            fresh = [link for link in self._links_of.get(shard, ()) if link not in self._active]
            if fresh and owned.leaving is None and self._begun.get(shard) == owned.epoch:
                rows = [(link, owned.epoch) for link in fresh]
                await asyncio.to_thread(self.ownership.begin, rows, commit, self.collector.sample_time())
                if self.member.owned.get(shard) is owned:  # it may have been lost meanwhile
                    self._activate(fresh, owned.epoch)
        self._tell_maintenance(gone_devices)
        await self._poll_active()
        self._confirm_revision(revision)
        self._set_costs()
        self._driver.wake()
        if self._newer is taken:
            self._newer = None
        _log.info("the configuration of revision %d holds", revision)

    def _part_ended(self, task: asyncio.Task[None]) -> None:
        """End all tasks of this collector because one has ended: leases lapse, and other collectors take the links.

        A done callback of each task. Sets `problem`. Does nothing if another task has ended before, or while the
        collector ends in order.
        """
        if self._is_ending or self._defect:
            return
        error = None if task.cancelled() else task.exception()
        why = "it was cancelled" if error is None else str(error) or type(error).__name__
        self._defect = f"{task.get_name()} has ended: {why}; start this collector again"
        _log.error("collector %s owns nothing: %s", self.member.name, self._defect, exc_info=error)
        for each in self._tasks:
            each.cancel()

    async def _end_tasks(self) -> None:
        self._is_ending = True
        await end_tasks(self._tasks)

    def _permit(self, link: str) -> None:
        """Raise `LinkDown` unless this collector owns the link by a lease that outlasts a transaction begun now.

        If no error is raised, the present time is kept as the begin of the link's last transaction, for `_end_of`.
        """
        if link not in self._active or not self.member.permits(
            self._shard_of[link], self._now(), self._times_of[link].transaction
        ):
            raise LinkDown(f"link {link} is not owned by this collector now; nothing was sent", kind="other")
        self._permitted[link] = self._now()

    def _may_send(self, link: str) -> bool:
        """Whether a frame may be sent on a link now (rule 2).

        True if this collector owns the link by a lease that ends later than any byte of the frame can reach the device.
        """
        times = self._times_of.get(link)
        worst = math.inf if times is None else times.after_sending
        return self.member.permits(self.shard_of(link), self._now(), worst)

    def _note_unanswered(self, link: str) -> None:
        """Note that a gateway behind a link may now hold a request, and until when (rule 1).

        Does nothing for a link whose configuration says no time for which a gateway may hold requests.
        """
        times = self._times_of.get(link)
        if times is not None and times.held:
            self._held_until[link] = self._now() + times.after_sending

    def _held_for(self, links: Iterable[str]) -> float:
        """Return for how many more seconds a gateway behind any of these links may hold a request; 0 if none does."""
        now = self._now()
        for link in [link for link, until in self._held_until.items() if until <= now]:
            del self._held_until[link]
        return max((self._held_until.get(link, now) - now for link in links), default=0.0)

    def _release(self, shard: str, epoch: Epoch) -> None:
        """Release the lease of a shard whose links have stopped, as soon as no gateway can hold a request (rule 1).

        Requests of links that the present configuration lacks count too: the next owner may still work by the former
        configuration. Returns at once; if a gateway may hold a request, the release follows later. Does nothing if the
        shard is not owned in this epoch any more, or is not to be given away.
        """
        owned = self.member.owned.get(shard)
        if owned is None or owned.epoch != epoch or owned.leaving is None:
            return
        held = max(self._held_for(self._links_of.get(shard, ())), self._left_until - self._now())
        if held > 0:
            asyncio.get_running_loop().call_later(held, self._release, shard, epoch)
            return
        self.member.left(shard)
        self._driver.wake()

    def _confirm_revision(self, revision: int) -> None:
        """Tell the other collectors that this one works by a revision, as soon as no gateway can hold a request.

        Only gateways of links that were stopped for the revision matter. Returns at once; if a request may be held, the
        others are told later. Does nothing if another revision is in force by then.
        """
        if revision != self.revision:
            return
        held = self._left_until - self._now()
        if held > 0:
            asyncio.get_running_loop().call_later(held, self._confirm_revision, revision)
            return
        self.member.set_revision(revision)
        self._driver.wake()

    def _told(self, event: ShardEvent) -> None:
        self._waiting.append(event)
        self._wake.set()
        if event.change is OwnershipChange.LOST:
            for link in self._links_of.get(event.shard, ()):
                self._active.pop(link, None)
            _log.warning("shard %s in epoch %s is lost: %s", event.shard, event.epoch, event.reason)

    async def _apply_changes(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            events, self._waiting = self._waiting, []
            try:
                await self._apply(events)
                await self._take_newer()
            except (sqlite3.Error, _NotStored) as error:
                if self._newer is None:
                    _log.error("what is owned does not change: %s", error)
                else:
                    self._delay = f"revision {self._newer[1]} waits: what is owned cannot be recorded: {error}"
                    _log.error("%s", self._delay)
                await self._poll_active()  # also links that were stopped for the change
                asyncio.get_running_loop().call_later(RECORD_AGAIN, self._wake.set)
            else:
                if self._newer is None:
                    self._delay = None

    async def _apply(self, events: Sequence[ShardEvent]) -> None:
        """Apply events of shards (groups of links): stop the links of shards that end, and poll those of gained shards.

        A shard that is given away is released once its links have stopped and their samples are committed.

        Raises:
            _NotStored: samples wait for the disk. The events that are not applied are to be applied later.
        """
        ended = [event for event in events if event.change is not OwnershipChange.GAINED]
        for event in ended:
            for link in self._links_of.get(event.shard, ()):
                self._active.pop(link, None)
        if ended:
            await self._poll_active()
        over = {(event.shard, event.epoch) for event in ended}
        brief = [
            event for event in events if event.change is OwnershipChange.GAINED and (event.shard, event.epoch) in over
        ]
        if brief:  # they are not polled here, but who takes them next does not know of the gap before
            await self._store_samples(events)
            await self._begin(brief)
        gained = [event for event in events if event.change is OwnershipChange.GAINED and event not in brief]
        if ended:
            self._note_ends(ended)
            await self._store_samples([*ended, *gained])
            await self._record_ends(ended)
            for event in ended:
                if event.change is OwnershipChange.LEAVE:
                    self._release(event.shard, event.epoch)
            self._driver.wake()
        # Also those that have ended since these events were taken: who takes them next does not know of the gap either.
        gained = [event for event in gained if self._is_next(event)]
        if gained:
            await self._store_samples(gained)
            await self._begin(gained)
            await self._poll_active()

    async def _store_samples(self, waiting: Sequence[ShardEvent] = ()) -> None:
        """Store all samples taken so far: only then may an ownership begin or end, or another configuration hold.

        Args:
            waiting: the events to be applied after that. If it fails, they come before all others that wait.

        Raises:
            _NotStored: the disk has not taken the samples in ten seconds.
        """
        if not await self.collector.flush():
            self._waiting[:0] = waiting
            raise _NotStored("samples that were taken before are not on disk yet")

    def _is_owned(self, event: ShardEvent) -> bool:
        """Whether an event says that a shard was gained, and the shard is still owned in that epoch and to be kept."""
        owned = self.member.owned.get(event.shard)
        is_kept = owned is not None and owned.epoch == event.epoch and owned.leaving is None
        return event.change is OwnershipChange.GAINED and is_kept

    def _is_next(self, event: ShardEvent) -> bool:
        """Whether the epoch of an event may be recorded now: True if no later epoch of the shard is recorded yet."""
        begun = self._begun.get(event.shard)
        return begun is None or event.epoch >= begun

    def _owned_by(self, events: Iterable[ShardEvent]) -> list[tuple[str, Epoch]]:
        return [(link, event.epoch) for event in events for link in self._links_of.get(event.shard, ())]

    async def _record_ends(self, events: Sequence[ShardEvent]) -> None:
        """Record in `ownership` that links of shards are no longer owned; if this fails, it is logged and not repeated.

        The end of the ownership is then missing on disk.
        """
        rows, commit = self._owned_by(events), self.collector.newest_commit
        try:
            await asyncio.to_thread(self.ownership.end, rows, commit, self.collector.sample_time())
        except sqlite3.Error as error:
            shards = ", ".join(event.shard for event in events)
            _log.error("the end of shards %s cannot be recorded: %s", shards, error)

    async def _begin(self, events: Sequence[ShardEvent]) -> None:
        """Record the epochs of gained shards and the gaps before them, then activate the links of shards still owned.

        Shards that were lost meanwhile are recorded as ended. If recording fails, that is logged, no link is activated,
        and the events are applied again after `RECORD_AGAIN` seconds.
        """
        rows, commit, now = self._owned_by(events), self.collector.newest_commit, self.collector.sample_time()
        gaps = self._gaps_before(events, commit, now)
        try:
            for event in events:
                self._take_over_maintenance(event)
            await asyncio.to_thread(self.ownership.begin, rows, commit, now, gaps)
            self._note_owned(rows)
        except (sqlite3.Error, ConfigError) as error:
            shards = ", ".join(event.shard for event in events)
            _log.error("shards %s are not polled yet: their epochs cannot be recorded: %s", shards, error)
            self._waiting += events
            asyncio.get_running_loop().call_later(RECORD_AGAIN, self._wake.set)
            return
        for event in events:
            self._begun[event.shard] = event.epoch
            links = self._links_of.get(event.shard, [])
            if self._is_owned(event):  # it may have been lost meanwhile
                self._activate(links, event.epoch)
            self._note_silence(links, event.silent_since)
        self._tell_maintenance()
        gone = [replace(event, silent_since=None) for event in events if not self._is_owned(event)]
        if gone:
            self._note_ends(gone)
            await self._record_ends(gone)

    def _note_owned(self, rows: Iterable[tuple[str, Epoch]]) -> None:
        for link, epoch in rows:
            self._owned_last[link] = max(epoch, self._owned_last.get(link, epoch))

    def _take_over_maintenance(self, event: ShardEvent) -> None:
        """Take over the maintenance of the devices of a gained shard as its former lease says (rule 7).

        Also if the shard is to be given away at once: the next owner learns it from this one. Of a lease of an older
        version nothing is known.

        Raises:
            ConfigError: the store cannot be written.
        """
        owned = self.member.owned.get(event.shard)
        if event.maintenance is None or event.former is None or owned is None or owned.epoch != event.epoch:
            return
        devices = self._devices_of(event.shard)
        told = {each.device: each for each in event.maintenance if each.device in devices}
        if event.former == self._begun.get(event.shard):
            told = {name: each for name, each in told.items() if (name, each.begin) not in self._ended}
        last = [self._owned_last[link] for link in self._links_of.get(event.shard, ()) if link in self._owned_last]
        is_later = all(event.former > epoch for epoch in last)
        here = {
            name: _maintained_device(row) for name, row in self.collector.in_maintenance().items() if name in devices
        }
        ended = [name for name, each in here.items() if is_later and name not in told and self._has_told(each)]
        self.collector.take_over_maintenance(map(_maintenance_row, told.values()), ended)

    def _has_told(self, device: MaintainedDevice) -> bool:
        """Whether other collectors may have learnt of a maintenance; of one from before the start that is not known."""
        return (device.device, device.begin) in self._told_before or self.member.has_said(device)

    def _take_over_maintenance_of_new(self, newer: CollectorConfiguration) -> None:
        """Take over the maintenance of devices that the configuration does not have yet, as the leases say (rule 7).

        Raises:
            _NotStored: the store cannot be written.
        """
        new = newer.devices.keys() - self._configuration.devices.keys()
        told = [each for owned in self.member.owned.values() for each in owned.maintenance or () if each.device in new]
        try:
            self.collector.take_over_maintenance(map(_maintenance_row, told))
        except ConfigError as error:
            raise _NotStored(error.message) from error

    def _tell_maintenance(self, gone: Collection[str] = ()) -> None:
        """Have the leases of owned shards say which of their devices are in maintenance (rule 7).

        Left out are shards whose former lease was not looked at yet.

        Args:
            gone: devices that the configuration has no longer.
        """
        before, rows = self._maintained, self.collector.in_maintenance()
        self._maintained = {name: _maintained_device(row) for name, row in rows.items()}
        self._ended.update((each.device, each.begin) for each in before.values())
        self._ended.difference_update((each.device, each.begin) for each in self._maintained.values())
        known = self._configuration.devices.keys() | gone
        for shard, owned in self.member.owned.items():
            if self._begun.get(shard) == owned.epoch:
                found = [self._maintained[name] for name in sorted(self._devices_of(shard) & rows.keys())]
                unknown = [each for each in owned.maintenance or () if each.device not in known]
                self.member.set_maintenance(shard, found + unknown)
        self._driver.wake()

    def _devices_of(self, shard: str) -> set[str]:
        links = self._links_of.get(shard, ())
        return {device.name for link in links for device in self._configuration.devices_of(link)}

    def _gaps_before(self, events: Sequence[ShardEvent], commit: int, now: int) -> list[OwnershipGap]:
        """Return the times without an owner before shards were gained from owners that fell silent.

        One for each link of these shards that has devices, if the begin of the time is known and before ``now``.

        Args:
            events: events of gained shards.
            commit: number of the last commit before.
            now: end of the gaps, nanoseconds since 1970 UTC.
        """
        found = []
        for event in events:
            for link in self._links_of.get(event.shard, ()):
                begin = self._silent_from(link, event.silent_since)
                devices = tuple(device.name for device in self._configuration.devices_of(link))
                if begin is not None and begin < now and devices:
                    found.append(OwnershipGap(link, event.epoch, commit + 1, devices, begin, now))
        return found

    def _silent_from(self, link: str, silent_since: float | None) -> int | None:
        """Return since when a link had no owner, in nanoseconds since 1970 UTC; None if no owner fell silent.

        If the silent owner was this collector, that is when it stopped polling, which may be after its last renewal.

        Args:
            link: name of the link.
            silent_since: last renewal by the owner that fell silent, seconds since 1970 UTC; None if none did.
        """
        if silent_since is None:
            return None
        return max(int(silent_since * NANOSECONDS), self._unowned_since.get(link, 0))

    def _end_what_was_owned(self) -> None:
        """Record that links which this collector owned when it was killed have had no owner since its last commit.

        The log of ownership is written before the store, so that a further crash cannot make the interval in the store
        begin at a later start.
        """
        owned, alive = self.ownership.unended(), self.collector.manifest.fact("alive")
        if not owned or alive is None:
            return
        self.ownership.end(list(owned.items()), self.collector.newest_commit, alive)
        if alive < EARLIEST:  # by a clock that was not set yet
            return
        for link in owned:
            self._unowned_since[link] = alive
            self._note_unowned(link, alive, None)

    def _activate(self, links: Sequence[str], epoch: Epoch) -> None:
        now = time.monotonic()
        self._active.update((link, epoch) for link in links)
        self._active_since.update((link, now) for link in links)

    def _note_ends(self, events: Sequence[ShardEvent]) -> None:
        """Record in the store the begin of an interval without ownership for the links of shards that ended (rule 4).

        It begins now; if the lease has lapsed, it begins at the end of the link's last transaction: a process that was
        frozen learns only when it wakes that it has lost the lease.
        """
        now = self.collector.sample_time()
        for event in events:
            for link in self._links_of.get(event.shard, ()):
                if link not in self._unowned_since and link not in self._active:
                    self._unowned_since[link] = begin = self._end_of(link, event.silent_since, now)
                    self._note_unowned(link, begin, None)

    def _end_of(self, link: str, renewed: float | None, now: int) -> int:
        """Return when the last transaction of a link ended at the latest, in nanoseconds since 1970 UTC.

        The result is not before ``renewed`` and not after ``now``; it is ``now`` if ``renewed`` is None.

        Args:
            link: name of the link.
            renewed: when the lapsed lease was renewed last, seconds since 1970 UTC; None for a lease that ends in
                order.
            now: nanoseconds since 1970 UTC.
        """
        if renewed is None:
            return now
        times = self._times_of[link]
        ago = self._now() - self._permitted.get(link, -math.inf) - times.connecting - times.exchange
        over = 0 if ago == math.inf else now - int(ago * NANOSECONDS)
        return min(max(int(renewed * NANOSECONDS), over), now)

    def _note_silence(self, links: Sequence[str], silent_since: float | None) -> None:
        """Record in the store the time without an owner before links that are owned from now on (rule 4).

        Nothing is recorded for a link whose time without an owner has no known begin. If an owner fell silent, the time
        since then is added to `unowned_seconds`.

        Args:
            links: names of the links.
            silent_since: last renewal by an owner that fell silent, seconds since 1970 UTC; None if that is not known.
        """
        now = self.collector.sample_time()
        for link in links:
            silent = self._silent_from(link, silent_since)
            begin = self._unowned_since.pop(link, silent)
            if begin is not None:
                self._note_unowned(link, min(begin, now), now)
            if silent is not None:
                self.unowned_seconds += max(0, now - silent) / NANOSECONDS

    def _note_unowned(self, link: str, begin: int, end: int | None) -> None:
        for device in self._configuration.devices_of(link):
            self.collector.note_interval(StateInterval(device.name, begin, end, Reason.OWNERSHIP))

    def _mend(self, correction: ClockCorrection) -> None:
        """Correct times without an owner that were noted before the wall clock was right (rule 4); log errors."""
        self._unowned_since = {link: correction.corrected(begin) for link, begin in self._unowned_since.items()}
        is_one_clock = abs(correction.shift) > CLOCK_LIMIT * NANOSECONDS  # else the one before may have had a right one
        try:
            self.ownership.mend(correction, self._first_commit, of_one_clock=is_one_clock)
        except sqlite3.Error as error:
            _log.error("times without an owner from before the clock was set keep their wrong time: %s", error)

    async def _poll_active(self) -> None:
        await self.collector.reload(restricted(self._configuration, self._active), by=self.member.name, origin="fleet")
        for told in self._link_followers:
            told()


def _maintenance_row(device: MaintainedDevice) -> MaintenanceRow:
    return MaintenanceRow(device.device, device.begin, device.by, device.why)


def _maintained_device(row: MaintenanceRow) -> MaintainedDevice:
    return MaintainedDevice(row.device, row.begin, row.by[:LONGEST_WORD], row.why[:LONGEST_WORD])


class _OtherOwners:
    """What commands need to know of the fleet: whether this collector owns a device's link, and a way to its owner.

    Args:
        fleet: this collector.
        member: name of this collector.
        group: name of the group in which a server gives each message with a command to one collector; empty if every
            collector gets all messages.
    """

    def __init__(self, fleet: FleetCollector, member: str, group: str) -> None:
        self._fleet = fleet
        self.member, self.group = member, group

    def owned_since(self, device: str) -> float | None:
        return self._fleet.owned_since(self._fleet.link_of(device))

    async def answers(self, device: str | None) -> bool:
        link = "" if device is None else self._fleet.link_of(device)
        if link in self._fleet.links:
            return True
        if not self._fleet.is_responsible(link):
            return False
        await asyncio.sleep(LOOK_AGAIN)
        return self._fleet.is_responsible(link)

    async def pass_on(self, command: PointCommand, role: str) -> dict[str, Any]:
        if self._fleet.pass_on is None:
            reason = f"the link of {command.device} is not owned here, and commands cannot be passed on now"
            return {"key": command.key, "state": CommandState.REFUSED.value, "reason": f"{reason}; nothing was sent"}
        return await self._fleet.pass_on(self._fleet.link_of(command.device), command, role)
