"""``busway fleet``: several collectors share the links of a plant; a coordinator holds who polls what.

1. ``apply`` checks a collector file as ``collect`` does, and writes it to the coordinator only if nothing is wrong.
2. ``run`` is one collector of a zone. It gets its configuration from the coordinator, and follows changes while it
   runs.
3. ``run --stream`` sends samples into a stream, from which ``sink`` takes them (`fleet_sinks`).
4. ``demo`` starts a plant, a nats-server and three collectors of its own (`fleet_demo`).
5. ``write`` asks the collector that owns a link to write a value to a point (`fleet_write`).
6. ``server-config`` writes the configuration of NATS servers with an account for each role (`fleet_servers`).
7. ``status`` asks only the coordinator, so it works for a zone in which no collector runs.
8. ``drain`` tells a collector to give away its shards and take none; ``--undo`` lets it take part again.
9. ``restore`` is for a coordinator that has lost its entries, or has old ones; it is refused while a collector runs.
"""

import asyncio
import os
import socket
import time
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import asdict, replace
from datetime import datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError, ModbusError
from .arguments import JSON, QUIET, VERBOSE, seconds, show_traffic, whole_number
from .collect_status import open_page, print_status, warn_of_loads
from .exits import ExitCode
from .fleet_folder import chosen_coordinator
from .fleet_sinks import open_stream, print_stream_status, run_sink
from .fleet_write import write_point
from .output import print_aligned, print_json, say, warn
from .signals import stop_event

if TYPE_CHECKING:
    from ..apps.fleet.coordinator import Coordinator
    from ..apps.fleet.coordinators.opening import CoordinatorOptions
    from ..apps.fleet.durability import ServerDurability
    from ..apps.fleet.fleet_collector import FleetCollector
    from ..apps.fleet.fleet_status import ZoneStatus
    from ..apps.fleet.lease_times import LeaseTimes
    from ..apps.fleet.streams import SinkLag
    from ..apps.fleet.table_records import LeaseHole

EXAMPLES = """\b
Examples:
  busway fleet demo
  busway fleet apply plant.toml --coordinator nats://10.0.0.7 --zone hall
  busway fleet run --coordinator nats://10.0.0.7 --zone hall --name west --store /var/lib/busway/west
  busway fleet run --stream --coordinator nats://10.0.0.7 --zone hall --name east --store /var/lib/busway/east
  busway fleet sink broker --coordinator nats://10.0.0.7 --zone hall
  busway fleet status --coordinator nats://10.0.0.7 --zone hall
  busway fleet write meter-7 setpoint 20 --key order-4711 --coordinator nats://10.0.0.7 --zone hall
  busway fleet drain west --coordinator nats://10.0.0.7 --zone hall
  busway fleet drain west --undo --coordinator nats://10.0.0.7 --zone hall
  busway fleet restore --coordinator nats://10.0.0.7 --zone hall
  busway fleet server-config hall --servers 10.0.0.1,10.0.0.2,10.0.0.3 --out servers

The coordinator may also be local:FOLDER (one machine) or postgresql://user@host/database; without one it is a folder of
this user, ~/.local/state/busway/fleet, for collectors of this machine. BUSWAY_FLEET_PASSWORD holds the password of
--user, BUSWAY_FLEET the coordinator, BUSWAY_FLEET_CREDENTIALS and BUSWAY_FLEET_CA those files.
"""
ACTIONS = {
    "demo": "", "apply": "FILE", "run": "", "sink": "NAME", "write": "DEVICE POINT VALUE", "status": "",
    "drain": "NAME", "restore": "", "server-config": "ZONE",
}  # fmt: skip
"""The actions of ``busway fleet``, each with the names of its arguments; empty for none."""
CONNECTED = ("apply", "run", "sink", "write", "status", "drain", "restore")
"""The actions that use a coordinator."""
TAKEN = {
    "--coordinator": CONNECTED,
    "--zone": CONNECTED,
    "--name": ("run",),
    "--store": ("run",),
    "--shards": ("apply", "run"),
    "--ttl": ("apply",),
    "--user": CONNECTED,
    "--credentials": CONNECTED,
    "--system-credentials": ("apply", "run", "sink", "status"),
    "--ca": CONNECTED,
    "--certificate": CONNECTED,
    "--private-key": CONNECTED,
    "--replicas": CONNECTED,
    "--stream": ("run",),
    "--key": ("write",),
    "--by": ("write",),
    "--within": ("write",),
    "--undo": ("drain",),
    "--for": ("demo",),
    "--out": ("server-config",),
    "--servers": ("server-config",),
    "--sites": ("server-config",),
    "--domain": tuple(action for action in CONNECTED if action != "run"),  # it works with the server of its own site
    "--server-version": ("server-config",),
    "--streams": ("server-config",),
    "--tls": ("server-config",),
    "--force": ("server-config",),
    "--status-every": ("run", "sink"),
    "--json": ("run", "sink", "write", "status"),
}
"""The options, each with the actions that take it; ``--quiet`` and ``--verbose`` go with all."""
LOOK = 1.0
"""Seconds that a collector may be late in renewing its entry before it counts as silent."""


def fleet(
    words: list[str] = typer.Argument(
        ...,
        metavar="demo|apply FILE|run|sink NAME|write DEVICE POINT VALUE|status|drain NAME|restore|server-config ZONE",
        help="A collector file, or the name of a sink of it, or of a collector; or a value for a point.",
    ),
    coordinator: str | None = typer.Option(
        None, "--coordinator", metavar="URL", help="nats://host:4222, local:FOLDER; a folder of this user."
    ),
    zone: str | None = typer.Option(
        None, "--zone", metavar="NAME", help="The network that reaches the devices: plant."
    ),
    name: str | None = typer.Option(None, "--name", metavar="NAME", help="run: of this collector; the host's name."),
    folder: str | None = typer.Option(None, "--store", metavar="FOLDER", help="run: the store; that of the file."),
    shards: str | None = typer.Option(
        None, "--shards", metavar="N", help="run, apply --ttl: of the zone, the same for all: 256."
    ),
    ttl: str | None = typer.Option(
        None,
        "--ttl",
        metavar="TIME",
        help="apply: leases of the zone hold for this time: 15s; refused while collectors run.",
    ),
    user: str | None = typer.Option(None, "--user", metavar="NAME", help="The account at the coordinator."),
    credentials: str | None = typer.Option(
        None, "--credentials", metavar="FILE", help="A NATS seed or credentials file."
    ),
    system: str | None = typer.Option(
        None, "--system-credentials", metavar="FILE", help="NATS: status.nk; asks all servers whether they sync."
    ),
    ca: str | None = typer.Option(None, "--ca", metavar="FILE", help="Certificates to check the coordinator by."),
    certificate: str | None = typer.Option(None, "--certificate", metavar="FILE", help="Of this program, for TLS."),
    private_key: str | None = typer.Option(None, "--private-key", metavar="FILE", help="Of that certificate."),
    replicas: str | None = typer.Option(None, "--replicas", metavar="N", help="Servers that must keep each entry: 1."),
    stream: bool = typer.Option(False, "--stream", help="run: send samples into a stream, for sinks (NATS)."),
    key: str | None = typer.Option(None, "--key", metavar="KEY", help="write: sent once for each key; a new one."),
    by: str | None = typer.Option(
        None, "--by", metavar="NAME", help="write: who writes, for the audit log; the account."
    ),
    within: str | None = typer.Option(None, "--within", metavar="TIME", help="write: send it by then, or never: 30s."),
    undo: bool = typer.Option(False, "--undo", help="drain: let the collector take part again."),
    lasts: str | None = typer.Option(None, "--for", metavar="TIME", help="demo: end after this time: 2m."),
    out: str | None = typer.Option(None, "--out", metavar="FOLDER", help="server-config: where to write."),
    servers: str | None = typer.Option(
        None, "--servers", metavar="HOST,…", help="server-config: one, three or five: [NAME=]HOST[:PORT]; 0.0.0.0."
    ),
    sites: str | None = typer.Option(
        None, "--sites", metavar="ZONE=HOST,…", help="server-config: edge sites, each a zone with its own server."
    ),
    domain: str | None = typer.Option(None, "--domain", metavar="SITE", help="Ask an edge site through the centre."),
    server_version: str | None = typer.Option(
        None, "--server-version", metavar="N.N", help="server-config: of nats-server: 2.9."
    ),
    streams: str | None = typer.Option(
        None, "--streams", metavar="FOLDER", help="server-config: of streams on each server: /var/lib/nats."
    ),
    tls: str | None = typer.Option(
        None, "--tls", metavar="FOLDER", help="server-config: of certificates on each server: /etc/nats/tls; off."
    ),
    force: bool = typer.Option(False, "--force", help="server-config: write over what is there, seeds excepted."),
    status_every: str | None = typer.Option(
        None, "--status-every", metavar="TIME", help="run, sink: print a status this often: 60s."
    ),
    as_json: bool = JSON,
    quiet: bool = QUIET,
    verbose: int = VERBOSE,
) -> int:
    """Share the links of a plant among several collectors."""
    from ..apps.fleet.coordinators import open_coordinator
    from ..apps.fleet.coordinators.opening import CoordinatorOptions
    from ..apps.fleet.lease_times import LONGEST_TTL, LeaseTimes
    from ..apps.fleet.shards import checked_zone, keys_zone
    from ..apps.fleet.streams import StreamOptions

    action, *about = _action(words)
    given: dict[str, Any] = {
        "--coordinator": coordinator,
        "--zone": zone,
        "--name": name,
        "--store": folder,
        "--shards": shards,
        "--ttl": ttl,
        "--user": user,
        "--credentials": credentials,
        "--system-credentials": system,
        "--ca": ca,
        "--certificate": certificate,
        "--private-key": private_key,
        "--replicas": replicas,
        "--stream": stream,
        "--key": key,
        "--by": by,
        "--within": within,
        "--undo": undo,
        "--for": lasts,
        "--out": out,
        "--servers": servers,
        "--sites": sites,
        "--domain": domain,
        "--server-version": server_version,
        "--streams": streams,
        "--tls": tls,
        "--force": force,
        "--status-every": status_every,
        "--json": as_json,
    }
    _refuse_not_taken(action, given)
    if action == "demo":
        return _demo(seconds(_or_default(lasts, "2m"), "--for", low=0.1), verbose)
    if action == "server-config":
        return _write_servers(about[0], given, force=force)
    zone = _or_default(zone, "plant")
    checked_zone(zone)
    times = None if ttl is None else LeaseTimes.lasting(seconds(ttl, "--ttl", low=3.0, high=LONGEST_TTL))
    url = chosen_coordinator(coordinator, {**given, action: True, "--replicas": replicas not in (None, "1")})
    options = CoordinatorOptions(
        user=user,
        password=os.environ.get("BUSWAY_FLEET_PASSWORD"),
        credentials=credentials or os.environ.get("BUSWAY_FLEET_CREDENTIALS"),
        ca=ca or os.environ.get("BUSWAY_FLEET_CA"),
        certificate=certificate,
        key=private_key,
        domain=domain,
        replicas=whole_number(_or_default(replicas, "1"), "--replicas", 1, 5),
    )
    count = whole_number(_or_default(shards, "256"), "--shards", 1, 1024)
    every = seconds(_or_default(status_every, "60s"), "--status-every", low=0.1)
    limit = seconds(_or_default(within, "30s"), "--within")
    show_traffic(verbose)
    works: dict[str, Any] = {
        "apply": lambda table: _apply(table, about[0], zone, options, times, count),
        "run": lambda table: _run(
            table,
            name,
            folder,
            count,
            every,
            partial(open_coordinator, url, keys_zone(zone), options),
            zone,
            partial(_take_commands, zone, options, table),
            zone if stream else None,
            options.replicas,
            as_json=as_json,
        ),
        "sink": lambda table: run_sink(
            table, zone, about[0], StreamOptions(replicas=options.replicas, source=domain), every, as_json=as_json
        ),
        "write": lambda table: write_point(table, zone, about, key=key, by=by, seconds=limit, as_json=as_json),
        "status": lambda table: _show_status(
            table, zone, partial(_durability, table, url, options, system), as_json=as_json
        ),
        "drain": lambda table: _drain(table, about[0], undo=undo),
        "restore": _restore,
    }
    from ..server.loops import run

    prepare = partial(_print_durability, url, options, system) if action in ("apply", "run", "sink") else None
    return run(_with_coordinator(url, zone, options, works[action], prepare)) or ExitCode.DONE


def _action(words: list[str]) -> list[str]:
    """Check the words of ``busway fleet``, an action and its arguments, and return them unchanged.

    Raises:
        ConfigError: there is no such action, or it has too few or too many arguments.
    """
    action, *rest = words
    wanted = ACTIONS.get(action)
    if wanted is None:
        raise ConfigError(f"must be {', '.join(ACTIONS)}, not {action}", key="ACTION")
    if len(rest) != len(wanted.split()):
        raise ConfigError(
            f"{f'wants {wanted}' if wanted else 'wants nothing'}, not {' '.join(rest) or 'nothing'}", key=action
        )
    return words


def _or_default(given: str | None, default: str) -> str:
    """Return the text of an option, also if it is empty, so that it is checked; the default only for None."""
    return default if given is None else given


def _refuse_not_taken(action: str, given: dict[str, Any]) -> None:
    """Raise `ConfigError` if an option was given that the action does not take (`TAKEN`).

    Args:
        action: the action.
        given: the values of all options, by name; None or False for those that were not given.
    """
    for option, value in given.items():
        if value is not None and value is not False and action not in TAKEN[option]:
            raise ConfigError(f"is for {', '.join(TAKEN[option])}; {action} does not take it", key=option)


def _write_servers(zones: str, given: dict[str, Any], *, force: bool) -> int:
    from .fleet_servers import write_server_files

    out = given["--out"]
    if out is None:
        raise ConfigError("is needed: a folder to write to", key="--out")
    tls = given["--tls"] or "/etc/nats/tls"
    write_server_files(
        zones,
        out,
        given["--servers"] or "0.0.0.0",
        given["--server-version"] or "2.9",
        given["--streams"] or "/var/lib/nats",
        None if tls == "off" else tls,
        force=force,
        sites=given["--sites"],
    )
    return ExitCode.DONE


def _demo(limit: float, verbose: int) -> int:
    from ..server.loops import run
    from .fleet_demo import fleet_demo

    show_traffic(verbose)
    run(fleet_demo(limit))
    return ExitCode.DONE


async def _with_coordinator(
    url: str,
    zone: str,
    options: "CoordinatorOptions",
    work: Any,
    prepare: "Callable[[Coordinator], Awaitable[None]] | None" = None,
) -> int | None:
    """Open the coordinator of a zone, await ``work(coordinator)``, close it, and return the result of ``work``.

    Args:
        url: URL of the coordinator.
        zone: name of the zone.
        options: options of the connection.
        work: coroutine function that returns an exit code, or None for success.
        prepare: coroutine function that prints warnings about the coordinator, awaited before ``work``; None for none.
    """
    from ..apps.fleet.coordinators import open_coordinator

    table = await open_coordinator(url, zone, options)
    try:
        if prepare is not None:
            await prepare(table)
        doing: Coroutine[Any, Any, int | None] = work(table)
        return await doing
    finally:
        await table.close()


async def _durability(
    table: "Coordinator", url: str, options: "CoordinatorOptions", system: str | None
) -> "list[ServerDurability]":
    """Return for each NATS server whether it syncs to its disk before it acknowledges; empty unless it is NATS.

    ``system`` is the path of the credentials of the system account, with which all servers are asked; None asks only
    the server that this connection has.
    """
    from ..apps.fleet.coordinators.nats import NatsCoordinator
    from ..apps.fleet.durability import server_durability

    return await server_durability(table, url, options, system) if isinstance(table, NatsCoordinator) else []


async def _print_durability(url: str, options: "CoordinatorOptions", system: str | None, table: "Coordinator") -> None:
    """Print warnings if NATS servers may lose entries that they have acknowledged, or if too few servers keep them.

    If the system account cannot be used, that is a warning too, and only what the coordinator's own connection shows is
    checked.
    """
    from ..apps.fleet.durability import durability_warnings

    try:
        servers = await _durability(table, url, options, system)
    except ModbusError as error:
        warn(f"warning: whether the servers sync cannot be asked: {error}")
        servers = await _durability(table, url, options, None)
    replicas, is_clustered = getattr(table, "replicas", 1), getattr(table, "is_clustered", False)
    for sentence in durability_warnings(servers, replicas, is_clustered=is_clustered):
        warn(f"warning: {sentence}")


async def _apply(
    table: "Coordinator",
    file: str,
    zone: str,
    options: "CoordinatorOptions",
    times: "LeaseTimes | None",
    shards: int,
) -> None:
    """Make a collector file the configuration of a zone, create the zone's streams, and print the revision.

    Args:
        table: the coordinator.
        file: path of the collector file.
        zone: name of the zone.
        options: options of the connection.
        times: new times of leases for the zone; None leaves those that the zone has.
        shards: number of shards of the zone; recorded with ``times`` if the zone has no number yet, else not used.

    Raises:
        ConfigError: the file is invalid, or ``times`` differ from those of the zone and a collector runs.
        RevisionConflict, CoordinatorDown, OutcomeUnknown: as of `apply_configuration` and `record_times`.
    """
    from ..apps.fleet.control_entries import apply_configuration, record_times, recorded_times

    before = await recorded_times(table)
    if times is not None and times != before:
        await _refuse_running(table, "--ttl", f"leases of the zone hold for {before.ttl:g} s, the same for all; ")
    revision = await apply_configuration(table, file, times)
    if times is not None:
        await record_times(table, times, shards)
        print(f"leases of the zone hold for {times.ttl:g} s")
    await _make_streams(table, zone, options)
    print(f"{file} is the configuration of the zone, with revision {revision}")


async def _make_streams(table: "Coordinator", zone: str, options: "CoordinatorOptions") -> None:
    """Create the streams of a zone, and its bucket for commands, on NATS servers; print a warning for each that fails.

    That is done here because the accounts of collectors and sinks may lack the right. Nothing is done for a coordinator
    other than NATS.
    """
    client = getattr(table, "client", None)
    if client is None:
        return
    from ..apps.fleet.coordinators.nats import find_bucket
    from ..apps.fleet.streams import StreamOptions, make_audit_stream, make_stream

    for make in (
        lambda: find_bucket(client, f"busway-{zone}-commands", options),
        lambda: make_stream(client, zone, StreamOptions(replicas=options.replicas, source=options.domain)),
        lambda: make_audit_stream(client, zone, options.replicas, domain=options.domain),
    ):
        try:
            await make()
        except ModbusError as error:
            warn(f"warning: {error}")


async def _drain(table: "Coordinator", name: str, *, undo: bool) -> None:
    from ..apps.fleet.control_entries import drain_collector

    await drain_collector(table, name, draining=not undo)
    print(
        f"{name} takes part again"
        if undo
        else f"{name} is told to hand on its shards; those that no other collector takes stay; see busway fleet status"
    )


async def _take_commands(
    zone: str,
    options: "CoordinatorOptions",
    table: "Coordinator",
    stack: AsyncExitStack,
    member: "FleetCollector",
) -> None:
    """Let a collector execute commands, and publish its last values, over NATS; if that fails, print a warning.

    Args:
        zone: name of the zone.
        options: options of the coordinator.
        table: the coordinator; if it is not NATS, nothing is done.
        stack: exit stack that ends commands and publishing when it closes.
        member: the collector.
    """
    client = getattr(table, "client", None)
    if client is None:
        return
    from ..apps.fleet.fleet_commands import FleetCommands
    from ..apps.fleet.live_subjects import LiveSubjects

    try:
        await stack.enter_async_context(FleetCommands(member, client, zone, replicas=options.replicas))
        await stack.enter_async_context(LiveSubjects(member.collector, client, zone))
    except ModbusError as error:
        warn(f"no commands over the fleet: {error}")


async def _restore(table: "Coordinator") -> None:
    from ..apps.fleet.control_entries import raise_generation, read_entries
    from ..apps.fleet.table_records import LEASES

    await _refuse_running(table, "restore")
    print(f"epochs of the zone go on in generation {await raise_generation(table, time.time())}")
    if not await read_entries(table, LEASES):
        warn(
            "warning: the coordinator has no leases, which say what devices are in maintenance: a device is left alone"
            " only by a collector that knows it from before; begin maintenance again after the start"
        )


async def _refuse_running(table: "Coordinator", key: str, why: str = "") -> None:
    """Raise `ConfigError` if a collector of the zone runs.

    Args:
        table: the coordinator of the zone.
        key: what the error is about: an option or an action.
        why: beginning of the error's sentence.
    """
    from ..apps.fleet.fleet_status import zone_status

    status = await zone_status(table, await _look(table))
    living = [name for name, each in status.members.items() if each.lives and not each.record.gone]
    if living:
        raise ConfigError(f"{why}stop all collectors first: {', '.join(living)} still run", key=key)


async def _look(table: "Coordinator") -> float:
    """Return after how many seconds without a renewed entry a collector of the zone counts as silent."""
    from ..apps.fleet.control_entries import recorded_times

    return (await recorded_times(table)).renew + LOOK


async def _run(
    table: "Coordinator",
    name: str | None,
    folder: str | None,
    shards: int,
    every: float,
    open_keys: Callable[[], Awaitable["Coordinator"]],
    zone: str,
    take_commands: Callable[[AsyncExitStack, "FleetCollector"], Awaitable[None]],
    stream_zone: str | None,
    replicas: int,
    *,
    as_json: bool,
) -> None:
    from ..apps.fleet.chosen_samples import refuse_what_needs_a_store
    from ..apps.fleet.control_entries import read_configuration, recorded_times
    from ..apps.fleet.fleet_collector import FleetCollector
    from ..apps.fleet.fleet_metrics import fleet_families
    from ..apps.fleet.stream_head import newest_message
    from ..apps.fleet.zone_watch import ZoneWatch

    shared = await read_configuration(table)
    if shared is None:
        raise ConfigError("the zone has no configuration yet: busway fleet apply FILE", key="--zone")
    times = await recorded_times(table)
    configuration = await asyncio.to_thread(shared.parsed, times)
    configuration = replace(configuration, store=folder or configuration.store)
    host = socket.gethostname().partition(".")[0]
    with stop_event() as stop:
        async with AsyncExitStack() as stack:
            keys = await _opened_keys(open_keys)
            stack.push_async_callback(keys.close)
            stream = None
            if stream_zone is not None:
                refuse_what_needs_a_store(configuration)
                stream = await open_stream(stack, table, stream_zone, replicas)
                configuration = replace(configuration, sinks={})
            member = await stack.enter_async_context(
                FleetCollector(
                    configuration,
                    table,
                    name or host,
                    host=host,
                    shards=shards,
                    times=times,
                    stream=stream,
                    revision=shared.revision,
                    keys=keys,
                    zone="" if getattr(table, "client", None) is None else zone,
                )
            )
            member.collector.more_metrics.append(lambda: fleet_families(member))
            await take_commands(stack, member)
            watch = await stack.enter_async_context(ZoneWatch(table, times))
            await open_page(stack, member.collector, watch, partial(newest_message, table, zone))
            say(f"{name or host} collects into {configuration.store} by revision {shared.revision}")
            warned_of = None
            while not stop.is_set():
                if member.revision != warned_of:
                    warned_of = member.revision
                    warn_of_loads(member.configuration, member.collector.knowledge)
                try:
                    async with asyncio.timeout(every):
                        await stop.wait()
                except TimeoutError:
                    print_status(member.collector, as_json=as_json)
                    if not as_json:
                        print_stream_status(member)
                    if member.refused is not None:
                        warn(f"warning: {member.refused}")


async def _opened_keys(open_keys: Callable[[], Awaitable["Coordinator"]]) -> "Coordinator":
    try:
        return await open_keys()
    except ConfigError as error:
        raise ConfigError(
            f"the table of the keys of commands cannot be used: {error.message}", key=error.key
        ) from error


async def _show_status(
    table: "Coordinator",
    zone: str,
    durability: "Callable[[], Awaitable[list[ServerDurability]]]",
    *,
    as_json: bool,
) -> None:
    from ..apps.fleet.fleet_status import zone_status

    status = await zone_status(table, await _look(table))
    lags = await _sink_lags(table, zone)
    servers = await durability()
    if as_json:
        _print_json(status, lags, servers, getattr(table, "replicas", 1))
        return
    for each in servers:
        print(f"{each.sentence}; replicas of the table: {getattr(table, 'replicas', 1)}")
    print(
        f"configuration: revision {status.revision}, {status.configuration}" if status.revision else "no configuration"
    )
    rows = [
        [each.record.name, each.record.host, each.state, str(len(each.shards)), f"{each.load:.3f}",
         str(each.record.behind), str(each.record.revision)]
        for each in status.members.values()
    ]  # fmt: skip
    if rows:
        print_aligned([["collector", "host", "state", "shards", "load", "commits behind", "revision"], *rows])
    if status.leases:
        print_aligned(
            [
                ["shard", "owner", "epoch", "last hole", "because"],
                *(
                    [shard, each.owner if each.held else "free", str(each.epoch or "new"), *_hole_texts(each.hole)]
                    for shard, each in status.leases.items()
                ),
            ]
        )
    if lags:
        rows = [[name, str(lag.messages), _age_text(lag)] for name, lag in lags.items()]
        print_aligned([["sink", "messages behind", "oldest waits"], *rows])


def _hole_texts(hole: "LeaseHole | None") -> list[str]:
    """Return two texts about the last time in which no collector owned a shard: its begin and length, and the reason.

    Both are ``-`` if ``hole`` is None: there was no such time.
    """
    if hole is None:
        return ["-", "-"]
    began = datetime.fromtimestamp(hole.begin).astimezone().isoformat(" ", "seconds")
    why = "fell silent" if hole.was_silent else "gave it back"
    return [f"{began}, {hole.end - hole.begin:.1f} s", f"{hole.before} {why}"]


def _age_text(lag: "SinkLag") -> str:
    if not lag.messages:
        return "-"
    return "unknown" if lag.seconds is None else f"{lag.seconds:.1f} s"


async def _sink_lags(table: "Coordinator", zone: str) -> "dict[str, SinkLag]":
    """Return how far each sink is behind the zone's stream, by its name; empty if the coordinator is not NATS."""
    from ..apps.fleet.streams import sink_lags

    client = getattr(table, "client", None)
    return {} if client is None else await sink_lags(client, table, zone)


def _print_json(
    status: "ZoneStatus", lags: "dict[str, SinkLag]", servers: "list[ServerDurability]", replicas: int
) -> None:
    print_json(
        {
            "configuration": status.configuration,
            "revision": status.revision,
            "collectors": [
                {"name": each.record.name, "host": each.record.host, "state": each.state,
                 "revision": each.record.revision, "load": round(each.load, 6), "commits_behind": each.record.behind,
                 "problem": each.record.problem, "shards": list(each.shards)}
                for each in status.members.values()
            ],
            "sinks": {
                name: {"messages_behind": lag.messages, "oldest_waits_seconds": lag.seconds}
                for name, lag in lags.items()
            },
            "servers": [{**asdict(each), "replicas": replicas} for each in servers],
            "shards": {
                shard: {
                    "owner": each.owner if each.held else None,
                    "epoch": str(each.epoch) if each.epoch else None,
                    "hole": None if each.hole is None else asdict(each.hole),
                }
                for shard, each in status.leases.items()
            },
        }
    )  # fmt: skip
