"""The collector: polls the devices of its file, stores their samples, and passes them on to sinks and alarms.

Knows files, links, the store and asyncio; `schedule` decides which request is sent next, and `poller` sends it.

1. A sample is passed on when it is in the store. Programs that follow samples too slowly lose the oldest batches, which
   are counted; they never slow polling down.
2. A file that is read again is refused as a whole, or applied link by link. A link whose section, devices and profiles
   are the same as before is not touched, and misses no round. A change that has begun is completed, even if its caller
   is cancelled.
3. What was learnt about devices is written beside the store when it changes, and at the end.
"""

import asyncio
import contextlib
import logging
import os
import sqlite3
import time
from collections.abc import AsyncIterator, Callable, Container, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from ...access.audit_log import AuditLog
from ...client.aio import AsyncLink, open_link, send_only_while
from ...config.files.sinks import PrometheusSinkSection
from ...errors import ConfigError
from ...points.point import Point
from . import time_service
from .alarms.collector_alarms import CollectorAlarms
from .cancellation import end_tasks
from .command_targets import CollectedTargets
from .commands.audit import revision_of
from .commands.claims import KeyClaims
from .commands.command import CommandResult, CommandValue
from .commands.command_messages import CommandInput, CommandMessageHandler, InputStatus
from .commands.journal import CommandJournal
from .commands.other_owners import OtherOwners
from .commands.runner import CommandRunner
from .configuration import CollectedDevice, CollectorConfiguration, load_collector
from .connected_systems import ConnectedSystems
from .derived_points import DerivedPoints
from .device_status import CollectedDeviceStatus, status_of
from .knowledge import Knowledge
from .learnt_file import LearntFile
from .maintenance import MaintenanceBook
from .permitted_link import PermittedLink
from .point_names import PointKey, PointNames
from .poller import LinkPoller
from .reload import CollectorReload
from .report_rules import points_of, store_rules
from .sample_clock import ClockCorrection, SampleClock
from .sample_readers import SampleReaders
from .samples import CounterState, PointDescription, SampleBatch, StateInterval
from .schedule import LinkSchedule
from .sinks.delivery import SinkStatus
from .sinks.prometheus import LastValues, PrometheusPage
from .store.accumulator_states import counters_by_device
from .store.alarm_events import alarm_events, alarm_rows
from .store.committer import Committer, StoreStatus
from .store.folder import half_of_disk
from .store.manifest import MaintenanceRow, Manifest
from .store.retention import Retention
from .store.writer import Commit, StoreOptions, StoreWriter
from .task_errors import first_error, log_defect
from .time_service import ClockJudge

CLOCK_EVERY: Final = 5.0
"""Seconds between two comparisons with the wall clock."""
AUDIT_LOG: Final = "audit.log"
"""Name of the audit log's file in the store's folder, used if the configuration names none."""
FINISH_LIMIT: Final = 2.0
"""Seconds, beyond the timeout of a link, for which a transaction in progress is waited for when the link is stopped."""
LEARNT_EVERY: Final = 30.0
"""Seconds between two writes of what was learnt about devices; nothing is written if nothing has changed."""

_log = logging.getLogger("busway.collector")


@dataclass(slots=True)
class _RunningLink:
    """A link whose devices are being polled.

    Attributes:
        key: all settings that decide how the link is polled, for comparison (`_key_of`).
        link: the link.
        poller: polls its devices.
        task: the task of the poller.
    """

    key: object
    link: AsyncLink
    poller: LinkPoller
    task: "asyncio.Task[None]"


class Collector:
    """Polls the devices of a collector file and stores their samples, while its ``async with`` block lasts.

    Made by `collect`. All methods are for the thread of the event loop, and only inside the block.

    Attributes:
        configuration: the configuration in use.
        knowledge: what was learnt about the devices.
        more_metrics: functions that return further families of metrics for the pages for Prometheus; callers add
            theirs.
        on_mending: functions to be called if the collector was started with a wrong wall clock, once the clock is
            right: in the event loop, with the correction of all times given so far, before the store is corrected.
            Callers add theirs.
        on_maintenance: functions to be called in the event loop after the maintenance of a device has begun or ended.
            Callers add theirs.
        values: the last stored sample of each point.
        alarms: the alarms of the points; there is no such attribute before the block is entered.
    """

    alarms: CollectorAlarms

    def __init__(
        self,
        configuration: CollectorConfiguration,
        *,
        permit: Callable[[str], None] | None = None,
        may_send: Callable[[str], bool] | None = None,
        unanswered: Callable[[str], None] | None = None,
        claims: KeyClaims | None = None,
        plant: Callable[[], CollectorConfiguration] | None = None,
        others: OtherOwners | None = None,
    ) -> None:
        """Create a collector from its configuration; nothing is opened yet.

        Args:
            configuration: the contents of its file.
            permit: called with the name of a link right before each of its transactions, reads and writes. If it raises
                `LinkDown`, nothing is sent, and the transaction fails with that error. None to permit all.
            may_send: called with the name of a link right before each of its frames is sent, on a serial line perhaps
                seconds after ``permit``. If it returns False, nothing is sent, and the connection is reset. None if all
                frames may be sent.
            unanswered: called with the name of a link after a permitted transaction of which a request may have been
                sent and got no valid reply. None if it is not needed.
            claims: ensures that of all collectors of a fleet only one executes a write command; None for a collector
                that works alone.
            plant: returns the configuration of a whole fleet, of which ``configuration`` is the part that this
                collector polls; None for a collector that works alone.
            others: the other collectors of a fleet, which may have to execute a received command; None for a collector
                that works alone.
        """
        self.configuration: CollectorConfiguration = configuration
        self._permit, self._may_send, self._claims = permit, may_send, claims
        self._unanswered = unanswered
        self._plant, self._others = plant, others
        self._committer: Committer | None = None
        self.knowledge: Knowledge = Knowledge()
        self._learnt = LearntFile(configuration.learnt_path)
        self._links: dict[str, _RunningLink] = {}
        self._readers = SampleReaders()
        self._upkeep: asyncio.Task[None] | None = None
        self._systems = ConnectedSystems(self._made_page, self._made_handler)
        # Families of prometheus-client, whose types are not there without its extra.
        self.more_metrics: list[Callable[[], Iterable[Any]]] = []
        self.on_mending: list[Callable[[ClockCorrection], None]] = []
        self.on_maintenance: list[Callable[[], None]] = []
        self._counters: dict[str, dict[str, CounterState]] = {}
        self._started = 0.0
        self.values: LastValues = LastValues(self._is_behind, configuration.hold_limits())
        self._audit: AuditLog | None = None
        self._commands: CommandRunner | None = None
        self._journal: CommandJournal | None = None
        self._maintenance: MaintenanceBook | None = None
        self._names = PointNames()
        self._reloading = CollectorReload(
            lambda: self.configuration, lambda: self._audit, self._apply, self._systems.prepare, self._systems.check
        )

    async def __aenter__(self) -> Self:
        """Open the store, start the sinks and begin to poll the devices.

        Raises:
            ConfigError: the store cannot be written or another process writes it (the message has its pid), or another
                part of the configuration cannot be used. Nothing was sent to a device.
            LinkDown: the port of a page for Prometheus is in use.
        """
        try:
            await self._start_parts()
        except sqlite3.Error as error:
            raise ConfigError(f"the store cannot be written: {error}", file=self.configuration.store) from error
        return self

    async def _start_parts(self) -> None:
        """Open the store and start every part; if one cannot start, those before it are stopped."""
        loop = asyncio.get_running_loop()
        self._started = loop.time()
        self._judge = ClockJudge(time_service.trust_of(self.configuration.file.collector.clock))
        is_known = self._clock_is_known()
        self._clock = SampleClock(loop.time(), time.time_ns(), is_known=is_known)
        if not is_known:
            _log.warning("no time service has set the clock yet: samples are uncertain (clock not set)")
        writer = self._opened_store(is_known)
        self._committer = committer = Committer(writer, rules=store_rules(self.configuration))
        self.alarms = CollectorAlarms(committer.add_alarms, loop.time, lambda: self._clock.time_ns(loop.time()))
        self._committer.subscribe(self.values.update)  # first: who gets a sample finds it in `values`
        self._committer.subscribe(lambda commit: self._committed_in_thread(loop, commit))
        async with AsyncExitStack() as unless_started:
            unless_started.push_async_callback(self._stop)
            self._systems.begin(writer, self.configuration)
            self.alarms.begin(alarm_events(alarm_rows(writer.folder, writer.manifest), writer.manifest), self._points())
            for device, counters in counters_by_device(writer.manifest).items():
                self._counters[device] = {each.point: each for each in counters}
            self._start_commands()
            for name in self.configuration.links:
                self._start_link(name, self.configuration)
            self._readers.begin()
            self._upkeep = asyncio.create_task(self._keep_up(), name="busway collector upkeep")
            self._upkeep.add_done_callback(log_defect)
            self._systems.receive(self.configuration)
            unless_started.pop_all()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop polling the devices, store the samples that are not stored yet, and close the store."""
        await self._stop()

    async def _stop(self) -> None:
        """Stop every part of the collector, the last started first; all are stopped even if one of them fails."""
        try:
            await self._reloading.end()  # else a link that a change begins would not be ended
        finally:
            await self._stop_parts()

    async def _stop_parts(self) -> None:
        async with AsyncExitStack() as steps:
            steps.callback(self._readers.end)
            steps.callback(self.alarms.end)
            steps.push_async_callback(self._close_store)
            steps.push_async_callback(self._write_learnt)
            if self._audit is not None:
                steps.callback(self._audit.close)
            if self._commands is not None:
                steps.push_async_callback(self._commands.close)
            for name in reversed(self._links):
                steps.push_async_callback(self._stop_link, name)
            if self._upkeep is not None:
                steps.push_async_callback(_ended, self._upkeep)
            steps.push_async_callback(self._systems.end_inputs)

    def _clock_is_known(self) -> bool:
        """Whether the wall clock of the machine is known to be right (`time_service`)."""
        return self._judge.is_known(time_service.kernel_synchronisation(), time_service.seconds_since_boot())

    def _opened_store(self, clock_is_right: bool) -> StoreWriter:
        """Open the store, give it the points of the configuration, and return it; also read `knowledge` from its file.

        Args:
            clock_is_right: whether the wall clock is known to be right.

        Raises:
            ConfigError: the store, or the file with what was learnt about devices, cannot be used; the store is closed.
        """
        configuration = self.configuration
        options = StoreOptions(
            durability=configuration.file.collector.durability, retention=_retention_of(configuration)
        )
        writer = StoreWriter(configuration.store, options, now=time.time_ns(), clock_is_right=clock_is_right)
        with ExitStack() as unless_known:
            unless_known.callback(lambda: writer.close(time.time_ns()))
            self.knowledge = self._learnt.read()
            writer.describe_points(_descriptions(configuration))
            self._names = writer.manifest.point_names()
            unless_known.pop_all()
        return writer

    def _made_page(self, section: PrometheusSinkSection) -> PrometheusPage:
        """Return a new page for Prometheus, which already listens.

        Raises:
            ConfigError: the page cannot be used as configured.
            LinkDown: its port is in use.
        """
        return PrometheusPage(
            section.parts.netloc,
            section.points,
            self.values,
            stale=section.stale,
            alarms=self.alarms.active,
            more=lambda: [family for give in self.more_metrics for family in give()],
        )

    def _made_handler(self, name: str, made: CommandInput) -> CommandMessageHandler:
        return CommandMessageHandler(
            name, made, self.commands, lambda: self.configuration, plant=self._plant, others=self._others
        )

    def _start_commands(self) -> None:
        """Open the audit log, the journal of commands and the record of maintenance.

        Commands that an earlier process left open end with the state unknown. Maintenance of devices that are no longer
        in the configuration ends.

        Raises:
            ConfigError: the audit log, the journal or the record cannot be read or written.
        """
        configuration = self.configuration
        section = configuration.file.audit
        path = configuration.common.audit or Path(configuration.store) / AUDIT_LOG
        options = {} if section is None else section.options()
        self._audit = AuditLog(**{**options, "path": path})
        targets = CollectedTargets(lambda: self.configuration, self._poller_of, self.values, self._plant)
        journal = CommandJournal(Path(configuration.store), keep=_age_of(configuration))
        self._journal = journal
        try:
            self._commands = CommandRunner(targets, journal, self._audit, claims=self._claims)
        except OSError as error:
            journal.close()
            raise ConfigError(str(error), file=str(journal.path)) from error
        assert self._committer is not None
        self._maintenance = MaintenanceBook(self._committer.writer.manifest, self._audit)
        self._end_maintenance_of_others()

    @property
    def commands(self) -> CommandRunner:
        """The part of the collector that executes commands, which write values to points."""
        assert self._commands is not None, "the collector does not run"
        return self._commands

    async def _close_store(self) -> None:
        """Close the pages, store the waiting samples, stop the sinks, and close the store, in this order.

        All are closed even if one of them fails.
        """
        assert self._committer is not None
        async with AsyncExitStack() as steps:
            steps.push_async_callback(asyncio.to_thread, self._committer.close)
            steps.push_async_callback(asyncio.to_thread, self._systems.close_sinks)
            steps.push_async_callback(asyncio.to_thread, self._committer.flush)
            steps.callback(self._systems.close_pages)

    # What programs use.

    async def samples(self, devices: Iterable[str] | None = None) -> AsyncIterator[SampleBatch]:
        """Yield the samples that are stored from the first iteration on, in batches: one for each read, once stored.

        The samples of computed points are batches of their own. Ends when the collector stops. A program that is too
        slow misses the oldest batches (`readers_lost`).

        Args:
            devices: names of the devices; None for all.

        Raises:
            ConfigError: a name is not that of a device; raised at the first iteration.
        """
        wanted = None if devices is None else frozenset(devices)
        for name in sorted(wanted or ()):
            if name not in self.configuration.devices:
                raise ConfigError(f"there is no device {name!r}", file=self.configuration.name, key="device")
        async with contextlib.aclosing(self._readers.read(wanted)) as batches:
            async for batch in batches:
                yield batch

    def maintenance(self, device: str, *, begins: bool, by: str = "program", why: str = "") -> None:
        """Begin or end the maintenance of a device; a device in maintenance is not polled, not even after a restart.

        Meanwhile the last values of its points are bad, and the store has one interval for the whole time. Ending a
        maintenance does nothing if the device is not in maintenance. Beginning it for a device already in maintenance
        changes only ``by`` and ``why``.

        Args:
            device: name of the device.
            begins: True begins the maintenance, False ends it.
            by: who begins or ends it, for the log and the audit log.
            why: the reason, for the log and the audit log.

        Raises:
            ConfigError: there is no such device, the store cannot be written, or another collector of the fleet has the
                link of the device now.
        """
        poller, book = self._poller_of(device), self._maintenance
        assert book is not None, "the collector does not run"
        if self._others is not None and self._others.owned_since(device) is None:
            raise ConfigError(f"the link of {device} is not owned by this collector now", key="device")
        at = self._clock.time_ns(asyncio.get_running_loop().time())
        if begins:
            is_new = device not in book.devices
            row = book.begin(device, at, by, why)
            if is_new:
                poller.pause(device, paused=True, since=row.begin)
        elif device in book.devices:
            book.end(device, at, by, why)
            poller.pause(device, paused=False)
        for told in self.on_maintenance:
            told()

    def take_over_maintenance(self, rows: Iterable[MaintenanceRow], ended: Iterable[str] = ()) -> None:
        """Take over the maintenance of devices that another collector had; call it before their links are polled.

        Args:
            rows: the maintenance of devices.
            ended: names of devices in maintenance here whose maintenance has ended there.

        Raises:
            ConfigError: the store cannot be written; call it again.
        """
        assert self._maintenance is not None, "the collector does not run"
        for row in rows:
            self._maintenance.take_over(row)
        self._end_maintenance(ended, "the collector that polled it since has ended it")

    def in_maintenance(self) -> Mapping[str, MaintenanceRow]:
        """Return the devices in maintenance, by name, each with its begin, who began it and why."""
        return {} if self._maintenance is None else self._maintenance.devices

    def watch(self, device: str, points: Iterable[str], *, period: float = 1.0, seconds: float = 10.0) -> None:
        """Read some points of a device more often for a while, with priority over regular polling.

        To be called again before the time is over, for as long as a viewer watches the points.

        Args:
            device: name of the device.
            points: names of its points; they replace those of an earlier call. Other names are ignored.
            period: seconds between two reads.
            seconds: how long this lasts from now on.

        Raises:
            ConfigError: there is no such device.
        """
        self._poller_of(device).lease(device, list(points), period, seconds)

    def registers_of(self, device: str, points: Container[str]) -> dict[str, bytes]:
        """Return the raw registers of a device's points as last read, by point name: two bytes for each register.

        Points that were not read yet, coils, discrete inputs and computed points are left out.

        Args:
            device: name of the device.
            points: names of the points wanted.

        Raises:
            ConfigError: there is no such device.
        """
        return self._poller_of(device).devices[device].registers_of(points)

    def _is_behind(self) -> bool:
        return self._committer is not None and self._committer.is_behind

    def store_status(self) -> StoreStatus:
        """Return the status of the store: commits, waiting and lost samples, and what is wrong."""
        assert self._committer is not None
        return self._committer.status()

    @property
    def newest_commit(self) -> int:
        """The number of the newest commit of the store, 1 or more: opening the store makes a commit.

        Numbers rise but are not consecutive: each run begins with a fresh range, and a failed commit uses up a number.
        """
        assert self._committer is not None
        return self._committer.writer.newest_commit

    @property
    def manifest(self) -> Manifest:
        """The manifest of the open store: the file that lists its parts, points and sinks."""
        assert self._committer is not None
        return self._committer.writer.manifest

    async def flush(self) -> bool:
        """Store all samples taken so far. Return True, or False if that has not succeeded within ten seconds."""
        assert self._committer is not None
        return await asyncio.to_thread(self._committer.flush)

    def sample_time(self) -> int:
        """Follow the wall clock, and return the time that a sample taken now gets, in nanoseconds since 1970 UTC.

        For a while after the wall clock was set back, sample times are ahead of it. To be called in the event loop.
        """
        now = asyncio.get_running_loop().time()
        self._mend(self._clock.adjust(now, time.time_ns(), is_known=self._clock_is_known()))
        return self._clock.time_ns(now)

    def note_interval(self, interval: StateInterval) -> None:
        """Store an interval in which a device was not read for a reason that the poller does not know.

        An example is that another collector of a fleet polled the device. To be called twice for each interval: when it
        begins, with the end None, and when it ends.
        """
        assert self._committer is not None
        self._committer.add_interval(interval)

    def subscribe(self, told: Callable[[Commit], None]) -> None:
        """Register a function that is called with each new commit, in the thread that commits.

        The function must be quick; its errors are logged and counted.

        Args:
            told: the function.
        """
        assert self._committer is not None
        self._committer.subscribe(told)

    def sink_statuses(self) -> Sequence[SinkStatus]:
        """Return the status of each sink, such as an MQTT broker; pages for Prometheus are not among them."""
        return self._systems.sink_statuses()

    def input_statuses(self) -> Sequence[InputStatus]:
        """Return the status of each input of commands, such as an MQTT broker that sends write commands."""
        return self._systems.input_statuses()

    @property
    def pages(self) -> list[str]:
        """The URLs of the pages from which Prometheus can scrape last values."""
        return self._systems.urls

    def status(self) -> list[CollectedDeviceStatus]:
        """Return the status of each device of the running links; also of silent devices and those in maintenance."""
        return [status_of(running.poller, name) for running in self._links.values() for name in running.poller.devices]

    def loads(self) -> Mapping[str, tuple[float, float]]:
        """Return the measured load of each link, by name of the link, as shares of the time since the start.

        If a reload has started a link anew, only its requests since then count, but the time is still that since the
        start of the collector.

        Returns:
            Two shares, each 0…1: the time that all requests of the link took; and the part of it that probes of silent
            devices took.
        """
        elapsed = max(asyncio.get_running_loop().time() - self._started, 1e-9)
        return {
            name: (running.poller.schedule.busy / elapsed, running.poller.schedule.probing / elapsed)
            for name, running in self._links.items()
        }

    def latencies(self, parts: Sequence[float]) -> Mapping[str, list[float]]:
        """Return quantiles of the response times of each link, by name of the link.

        Args:
            parts: the quantiles wanted, each 0…1.

        Returns:
            For each link the response times in seconds, in the order of ``parts``, over its latest answered
            transactions; an empty list before the first answer.
        """
        return {name: running.poller.latencies(parts) for name, running in self._links.items()}

    def _poller_of(self, device: str) -> LinkPoller:
        for running in self._links.values():
            if device in running.poller.devices:
                return running.poller
        raise ConfigError(f"there is no device {device!r}", file=self.configuration.name, key="device")

    async def write(
        self,
        device: str,
        point: str,
        value: CommandValue,
        *,
        by: str,
        expires: float | None = None,
        key: str | None = None,
        origin: str = "program",
    ) -> CommandResult:
        """Write a value to a point, at most once, and return the result when the write is finished.

        Args:
            device: name of the device.
            point: name of its point.
            value: the new value in the unit of measure of the point, or a name that the point gives to a number;
                checked against the write rule of the point.
            by: who gives the command, for the journal and the audit log.
            expires: until when the command may be sent, seconds since 1970 UTC; None for 30 seconds from now.
            key: identifies the command: a second call with the same key writes nothing. It returns the first result, or
                is refused if its point or value is another. None for a new key.
            origin: where the command comes from, for the journal and the audit log.

        Returns:
            The result, also if the write was refused, failed or expired. Its state is `CommandState.UNKNOWN` if the
            write may have been sent and it is not known whether the device executed it.

        Raises:
            InvalidRequest: an argument is not valid, or there is no such point and the key is new. Nothing was sent.
        """
        return await self.commands.write(device, point, value, by=by, origin=origin, expires=expires, key=key)

    # Reading the file again.

    @property
    def readers_lost(self) -> int:
        """Number of batches that programs missed in `samples` because they were too slow; counted as iterations end."""
        return self._readers.lost

    @property
    def revision(self) -> str:
        """The revision of the configuration in use: 16 hexadecimal digits computed from its text."""
        return revision_of(self.configuration.text)

    @property
    def restart_needed(self) -> list[str]:
        """Keys of the file, such as ``[collector] page``, whose changes take effect only at the next start."""
        return list(self._reloading.waiting)

    @property
    def refused_file(self) -> list[str]:
        """The lines and keys for which the file was refused when it was read again, without values.

        Empty once a configuration was accepted.
        """
        return list(self._reloading.refusal)

    def check(self, configuration: CollectorConfiguration) -> None:
        """Raise `ConfigError` if another configuration cannot be used while the collector runs.

        Nothing that is in use changes; only new sinks are listed in the store.
        """
        self._reloading.check(configuration)

    async def reload(
        self, configuration: CollectorConfiguration, *, by: str = "this program", origin: str = "program"
    ) -> list[str]:
        """Use another configuration from now on; links that it does not change go on polling (rule 2).

        Args:
            configuration: the new configuration.
            by: who changes the configuration, for the audit log.
            origin: where the change comes from, for the audit log.

        Returns:
            What changed, each as a sentence; also each key that takes effect only at the next start. If nothing
            changed, one sentence that says so.

        Raises:
            ConfigError: the store is another one or cannot be written, the port of a page for Prometheus is in use,
                or the collector ends; nothing was changed.
        """
        return await self._reloading.reload(configuration, by, origin)

    async def read_again(self, *, by: str = "this program", origin: str = "signal") -> list[str]:
        """Read the configuration file again and use it from now on; opens the audit log anew, for log rotation.

        Arguments and result are those of `reload`.

        Raises:
            FileError: the file is wrong; ``problems`` has all errors, with file, line and key. Nothing was changed.
            ConfigError: the file cannot be read or used (see `reload`), or the collector ends; nothing was changed.
        """
        return await self._reloading.read_again(by, origin)

    async def replace_configuration(
        self, text: str, *, by: str, origin: str = "api", revision: str | None = None
    ) -> list[str]:
        """Replace the text of the configuration file and use it from now on; if the text is wrong, nothing changes.

        If a port or the store becomes unusable between check and use, the file has the new text, and the old
        configuration stays in use.

        Args:
            text: the new text of the whole file.
            by: who changes the configuration, for the audit log.
            origin: where the change comes from, for the audit log.
            revision: the `revision` from which the caller has made the text; it must still be in use. None skips this
                check.

        Returns:
            What changed, as `reload` returns it.

        Raises:
            FileError: the text is wrong; ``problems`` has all errors, each with file, line and key.
            ConfigError: the text cannot be used (see `reload`), the file cannot be written, another revision is in use,
                or the collector ends.
        """
        return await self._reloading.replace(text, by, origin, revision)

    async def _apply(self, configuration: CollectorConfiguration) -> list[str]:
        """Put another configuration into use, and return what changed, each as a sentence; empty if nothing did.

        In this order: links that change are stopped; points are renamed for all later samples; the limits of the store,
        sinks, pages, inputs and alarms change; links are started; the maintenance of devices that are gone ends.
        """
        assert self._committer is not None
        self.configuration = configuration
        self.values.configure(configuration.hold_limits(), points_of(configuration).keys())
        done: list[str] = []
        changed = sorted(self.changed_links(configuration))
        for name in changed:  # before anything is awaited: no command for a new point goes to an old device
            self._links[name].poller.finish()
        await asyncio.gather(*(self._finish_link(name) for name in changed))
        for name in changed:
            await self._stop_link(name)
            if name not in configuration.links:
                done.append(f"link {name} ended")
        descriptions = _descriptions(configuration)
        moved = self._names.describe(descriptions)
        self._committer.describe(descriptions, store_rules(configuration))
        done += self._keep(_retention_of(configuration))
        done += await self._systems.apply(configuration)
        self.alarms.configure(self._points(), moved)
        self._counters = _renamed(self._counters, moved)
        for name in configuration.links:
            if name not in self._links:
                self._start_link(name, configuration)
                done.append(f"link {name} {'began anew' if name in changed else 'began'}")
        self._end_maintenance_of_others()
        return done

    def _keep(self, retention: Retention) -> list[str]:
        """Use other limits of age and size for the store; return one sentence in a list, or [] if nothing changed."""
        assert self._committer is not None
        assert self._journal is not None
        writer = self._committer.writer
        if retention == writer.options.retention:
            return []
        writer.keep(retention)
        self._journal.keep = _age_of(self.configuration)
        return ["keep_days and keep_bytes hold from now on"]

    def changed_links(self, configuration: CollectorConfiguration) -> frozenset[str]:
        """Return the names of the polled links that a reload with this configuration would end or restart."""
        return frozenset(name for name, link in self._links.items() if link.key != _key_of(configuration, name))

    def _end_maintenance_of_others(self) -> None:
        """End the maintenance of devices that are no longer in the configuration; in a fleet, in that of the plant."""
        configuration = self.configuration if self._plant is None else self._plant()
        gone = [device for device in self.in_maintenance() if device not in configuration.devices]
        self._end_maintenance(gone, "the device is no longer in the file")

    def _end_maintenance(self, devices: Iterable[str], why: str) -> None:
        """End the maintenance of devices that are not polled; raises `ConfigError` if the store cannot be written."""
        assert self._maintenance is not None
        assert self._committer is not None
        for device in devices:
            at = self._clock.time_ns(asyncio.get_running_loop().time())
            self._committer.add_interval(self._maintenance.end(device, at, "collector", why))

    # Links.

    def _start_link(self, name: str, configuration: CollectorConfiguration) -> None:
        settings = configuration.links[name].settings
        loop = asyncio.get_running_loop()
        assert self._committer is not None
        link = open_link(configuration.links[name].url, **configuration.links[name].options)
        if self._may_send is not None:
            send_only_while(link, partial(self._may_send, name))
        numbered = settings.endpoint.framing == "mbap"
        schedule = LinkSchedule(
            settings.parameters.timeout, batch=settings.parameters.max_transactions if numbered else 1
        )
        poller = LinkPoller(
            name,
            link if self._permit is None else PermittedLink(name, link, self._permit, self._unanswered),
            schedule,
            self._clock,
            self._take,
            self._committer.add_interval,
            numbered=numbered,
            now=loop.time,
        )
        for device in configuration.devices_of(name):
            known = configuration.known_of(device, self.knowledge)
            counters = self._counters.get(device.name, {}).values()
            limits = device.hold_limits(configuration.periods)
            derived = DerivedPoints(device.name, device.points, counters, limits)
            poller.add(
                device.name,
                device.unit,
                device.book(known),
                configuration.periods,
                None if derived.is_empty else derived,
                device.rules.pause,
                on_line=device.fixed,
                limits=limits,
            )
            row = self.in_maintenance().get(device.name)
            if row is not None:
                poller.pause(device.name, paused=True, since=row.begin)
        task = asyncio.create_task(poller.run(), name=f"busway collector link {name}")
        task.add_done_callback(log_defect)
        self._links[name] = _RunningLink(_key_of(configuration, name), link, poller, task)

    async def _finish_link(self, name: str) -> None:
        """End the polling of a link after its transaction in progress, and wait for that end.

        The wait is at most the timeout of the link plus `FINISH_LIMIT`; then this returns without an error.
        """
        running = self._links[name]
        running.poller.finish()
        await asyncio.wait([running.task], timeout=running.poller.schedule.timeout + FINISH_LIMIT)

    async def _stop_link(self, name: str) -> None:
        running = self._links.pop(name)
        try:
            await _ended(running.task)
        finally:
            self._learn_from(running.poller)
            running.poller.close()
            await running.link.close()

    # Upkeep.

    async def _keep_up(self) -> None:
        try:
            async with asyncio.TaskGroup() as tasks:  # the clock does not wait for the disk
                tasks.create_task(self._follow_clock())
                tasks.create_task(self._write_files())
        except ExceptionGroup as group:
            raise first_error(group) from None

    async def _follow_clock(self) -> None:
        while True:
            await asyncio.sleep(CLOCK_EVERY)
            self.sample_time()

    async def _write_files(self) -> None:
        loop = asyncio.get_running_loop()
        write_at = loop.time() + LEARNT_EVERY
        while True:
            await asyncio.sleep(CLOCK_EVERY)
            await self.commands.record_again()
            if loop.time() >= write_at:
                write_at = loop.time() + LEARNT_EVERY
                for running in self._links.values():
                    self._learn_from(running.poller)
                await self._write_learnt()

    def _mend(self, correction: ClockCorrection | None) -> None:
        """Correct all times from before the wall clock was right, in the store and in memory; with None do nothing."""
        if correction is None:
            return
        assert self._committer is not None
        for told in self.on_mending:
            told(correction)
        self._committer.mend(correction)
        self.alarms.mend(correction)
        for running in self._links.values():
            running.poller.mend(correction)
        if self._maintenance is not None:
            self._maintenance.mend(correction)

    def _learn_from(self, poller: LinkPoller) -> None:
        for name, device in poller.devices.items():
            self.knowledge.set(name, device.book.knowledge)

    async def _write_learnt(self) -> None:
        if self.configuration.file.collector.learn:
            try:
                await asyncio.to_thread(self._learnt.write, self.knowledge.text())
            except OSError as error:
                _log.error("what was learnt cannot be written to %s: %s", self._learnt.path, error)

    def _take(self, batch: SampleBatch) -> None:
        """Queue the samples of a read for the store, with the alarm events that follow, and keep its counter states."""
        assert self._committer is not None
        if batch.counters:
            self._counters.setdefault(batch.device, {}).update((each.point, each) for each in batch.counters)
        self._committer.add(batch, self.alarms.take(batch))

    def _points(self) -> dict[str, Sequence[Point]]:
        return {device.name: device.points for device in self.configuration.devices.values()}

    def _committed_in_thread(self, loop: asyncio.AbstractEventLoop, commit: Commit) -> None:
        if (self._readers and commit.batches) or commit.alarms:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._committed, commit)

    def _committed(self, commit: Commit) -> None:
        self.alarms.committed(commit.alarms)
        self._readers.take(commit.batches)


def collect(file: str | os.PathLike[str] | CollectorConfiguration) -> Collector:
    """Return a collector for asyncio programs: ``async with busway.collect("plant.toml") as collector: …``.

    The file is read at once; nothing is opened or polled before the ``async with`` block.

    Args:
        file: path of a collector file, or a configuration that `load_collector` has returned.

    Raises:
        FileError: the file is wrong; ``problems`` has all errors, each with file, line and key.
        ConfigError: the file cannot be read.
    """
    return Collector(file if isinstance(file, CollectorConfiguration) else load_collector(file))


def _key_of(configuration: CollectorConfiguration, link: str) -> object:
    """Return all settings that decide how a link is polled, as one object to compare; None if there is no such link.

    A reload does not touch a link for which these objects of the old and the new configuration are equal.
    """
    if link not in configuration.links:
        return None
    devices: list[CollectedDevice] = configuration.devices_of(link)
    periods = {name: configuration.periods[name] for device in devices for name in device.items}
    return configuration.links[link].settings, devices, periods


def _age_of(configuration: CollectorConfiguration) -> float | None:
    """Return the seconds for which samples and results of commands are kept (``keep_days``); None for no limit."""
    days = configuration.file.collector.keep_days
    return None if days is None else 86_400 * days


def _retention_of(configuration: CollectorConfiguration) -> Retention:
    size = configuration.file.collector.keep_bytes or half_of_disk(Path(configuration.store))
    return Retention(_age_of(configuration), size)


def _descriptions(configuration: CollectorConfiguration) -> list[PointDescription]:
    """Return the descriptions of all points of a configuration, such as units of measure, which the store keeps."""
    return [each for device in configuration.devices.values() for each in device.descriptions()]


def _renamed(
    counters: Mapping[str, Mapping[str, CounterState]], moved: Mapping[PointKey, str]
) -> dict[str, dict[str, CounterState]]:
    """Return the states of accumulators, by device and point, with renamed points under their new names.

    Args:
        counters: the states by device and old name of the point.
        moved: by device and old name, the new name of each renamed point.
    """
    return {
        device: {
            (name := moved.get((device, point), point)): replace(each, point=name) for point, each in states.items()
        }
        for device, states in counters.items()
    }


async def _ended(task: "asyncio.Task[None]") -> None:
    """Cancel a task and wait for its end. Its error is not raised: `log_defect` has logged it."""
    await end_tasks([task])
