"""``busway fleet run --stream`` and ``busway fleet sink``: samples reach sinks through a stream of NATS JetStream.

1. With ``--stream`` a collector sends its samples into the stream, and keeps them in its store until every sink has
   them; it runs no sink of the file itself.
2. A sink is a process of its own, configured by its ``[[sink]]`` table in the zone's configuration. How far it has read
   the stream is kept under its name. It follows changes of the configuration; if it cannot use a new configuration, it
   reports that and continues with the earlier one.
"""

import asyncio
import time
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any, Final

from ..errors import ConfigError, ModbusError
from ..values.counts import counted
from .output import print_json, say, warn
from .signals import stop_event

if TYPE_CHECKING:
    from ..apps.collector.store.committed_samples import CommittedSample
    from ..apps.fleet.control_entries import SharedConfiguration
    from ..apps.fleet.coordinator import Coordinator
    from ..apps.fleet.fleet_collector import FleetCollector
    from ..apps.fleet.streams import NatsStream, StreamOptions, StreamSink

LOOK: Final = 5.0
"""Seconds between two checks for a newer configuration of the zone, and timeout of such a check."""


def nats_client(table: "Coordinator") -> Any:
    """Return the NATS client of a coordinator. Raises `ConfigError` if the coordinator is not NATS."""
    client = getattr(table, "client", None)
    if client is None:
        raise ConfigError("samples go through a stream of NATS JetStream: nats://host:4222", key="--coordinator")
    return client


async def open_stream(stack: AsyncExitStack, table: "Coordinator", zone: str, replicas: int) -> "NatsStream":
    """Open the stream of a zone for the samples of one collector, and follow how far the sinks of the stream have read.

    Args:
        stack: exit stack; when it closes, the task ends that follows how far the sinks have read.
        table: the coordinator.
        zone: name of the zone.
        replicas: number of servers that keep each message.

    Raises:
        ConfigError: the coordinator is not NATS, the stream cannot be used, or it has too few replicas.
        StreamDown: no server has answered.
    """
    from ..apps.collector.cancellation import end_tasks
    from ..apps.fleet.streams import NatsStream, StreamOptions, make_stream

    client = nats_client(table)
    await make_stream(client, zone, StreamOptions(replicas=replicas))
    stream = NatsStream(client, zone)
    watch = asyncio.create_task(stream.watch_cursors(table), name="busway fleet cursors")
    watch.add_done_callback(_warn_without_cursors)
    stack.push_async_callback(end_tasks, [watch])
    return stream


def _warn_without_cursors(watch: "asyncio.Task[None]") -> None:
    error = None if watch.cancelled() else watch.exception()
    if error is not None:
        warn(f"what the sinks of the stream have is not known any more, so nothing is dropped: {error}")


def print_stream_status(member: "FleetCollector") -> None:
    """Print how many commits of a collector wait to be sent into the stream, and by how many the sinks are behind.

    Samples that are too long for a message or were lost are printed too, if there are any. Nothing is printed for a
    collector without a stream.
    """
    if member.outbox is None:
        return
    status = member.outbox.status()
    error = f": {status.error}" if status.error else ""
    newest = member.collector.newest_commit
    print(f"  stream: {newest - status.sent} of {counted(newest, 'commit')} wait to be sent{error}", flush=True)
    if status.set_aside:
        print(f"  {counted(status.set_aside, 'sample')} too long for a message: no sink gets them", flush=True)
    if status.lost:
        print(f"  {counted(status.lost, 'sample')} lost: deleted before all sinks of the stream had them", flush=True)
    print(f"  sinks of the stream: {counted(newest - status.kept, 'commit')} behind", flush=True)


async def run_sink(
    table: "Coordinator", zone: str, name: str, stream: "StreamOptions", every: float, *, as_json: bool
) -> None:
    """Pass the samples of a zone's stream on to one of its sinks until a signal comes.

    It follows changes of the configuration, and prints its status regularly and at the end. If passing on ends with an
    error, that is raised.

    Args:
        table: the coordinator.
        zone: name of the zone.
        name: name of the sink in the zone's configuration.
        stream: options of the stream.
        every: seconds between two prints of the status.
        as_json: whether the status is printed as JSON.

    Raises:
        ConfigError: the zone has no configuration or no such sink, the sink cannot work without a store, or the
            coordinator is not NATS.
    """
    from ..apps.collector.cancellation import end_tasks
    from ..apps.fleet.control_entries import read_configuration

    shared = await read_configuration(table)
    if shared is None:
        raise ConfigError("the zone has no configuration yet: busway fleet apply FILE", key="--zone")
    handed = await _sink_of(shared, table, zone, name, stream)
    with stop_event() as stop:
        running = asyncio.create_task(handed.run(), name="busway fleet sink")
        stopped: asyncio.Task[Any] = asyncio.create_task(stop.wait(), name="busway fleet sink stop")
        say(f"sink {name} takes the samples of zone {zone}")
        told = time.monotonic()
        try:
            while not stopped.done() and not running.done():
                left = max(0.0, told + every - time.monotonic())
                await asyncio.wait((running, stopped), timeout=min(left, LOOK), return_when=asyncio.FIRST_COMPLETED)
                if stopped.done() or running.done() or time.monotonic() >= told + every:
                    _print_status(handed, name, as_json=as_json)
                    told = time.monotonic()
                newer = await _newer(table, shared.revision)
                if newer is None or stopped.done() or running.done():
                    continue
                shared = newer
                try:
                    after = await _sink_of(shared, table, zone, name, stream)
                except ConfigError as error:
                    warn(f"warning: revision {newer.revision} is not applied, sink {name} goes on as before: {error}")
                    continue
                await end_tasks([running])
                for counter in ("taken", "refused", "unreadable", "dropped"):
                    setattr(after, counter, getattr(handed, counter))
                handed, running = after, asyncio.create_task(after.run(), name="busway fleet sink")
                say(f"sink {name} works by revision {newer.revision} of the configuration")
        finally:
            await end_tasks([running, stopped])
    if not running.cancelled():
        running.result()


async def _sink_of(
    shared: "SharedConfiguration", table: "Coordinator", zone: str, name: str, stream: "StreamOptions"
) -> "StreamSink":
    """Return the object that passes a zone's samples on to the sink ``name`` of a configuration; it is not started yet.

    Raises:
        ConfigError: the configuration has no such sink, the sink cannot work without a store, or the coordinator is not
            NATS.
    """
    from ..apps.collector.report_rules import points_of, sink_rules
    from ..apps.fleet.chosen_samples import ChosenSamples, refuse_what_needs_a_store, sinks_without_alarms
    from ..apps.fleet.control_entries import recorded_times
    from ..apps.fleet.streams import StreamSink

    configuration = await asyncio.to_thread(shared.parsed, await recorded_times(table))
    if name not in configuration.sinks:
        there = ", ".join(configuration.sinks) or "none"
        raise ConfigError(f"the configuration has no sink {name}; there are {there}", key="NAME")
    sink, options = configuration.sinks[name]
    refuse_what_needs_a_store(configuration, name)
    if name in sinks_without_alarms(configuration):
        warn(f"warning: sink {name} gets samples alone: events of alarms do not go through the stream")

    def set_aside(sample: "CommittedSample", error: str) -> None:
        warn(f"sink {name}: {sample.device}/{sample.point} at {sample.time} ns is refused for good: {error}")

    chosen = ChosenSamples(sink, options, sink_rules(configuration), points_of(configuration))
    return StreamSink(nats_client(table), table, zone, name, chosen, set_aside, stream)


async def _newer(table: "Coordinator", revision: int) -> "SharedConfiguration | None":
    """Return the zone's configuration if its revision is not ``revision``; None otherwise, or if reading fails."""
    from ..apps.fleet.control_entries import read_configuration

    try:
        async with asyncio.timeout(LOOK):
            found = await read_configuration(table)
    except (ModbusError, TimeoutError):
        return None
    return found if found is not None and found.revision != revision else None


def _print_status(handed: Any, name: str, *, as_json: bool) -> None:
    facts = {
        "sink": name, "taken": handed.taken, "refused": handed.refused, "unreadable": handed.unreadable,
        "dropped": handed.dropped, "error": handed.error,
    }  # fmt: skip
    if as_json:
        print_json(facts)
        return
    lost = "".join(f", {facts[key]} {key}" for key in ("refused", "unreadable", "dropped") if facts[key])
    print(f"{counted(handed.taken, 'sample')} taken{lost}{f': {handed.error}' if handed.error else ''}", flush=True)
