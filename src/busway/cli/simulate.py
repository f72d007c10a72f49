"""``busway simulate``: serves simulated devices whose values change as a file says, until Ctrl-C or SIGTERM.

1. Once all listeners answer, their endpoints go to stdout, one per line, with the real ports; all else goes to stderr.
   A listener that the network reaches is read-only unless there is a policy, or ``--allow-writes``.
2. SIGHUP reads policy, address lists and certificates again; units and behaviours stay those of the start.
3. ``--fault`` switches on a fault of the file, or adds a fault profile. What a fault does is printed on stderr, and if
   it has a schedule, when it begins and ends. A fault of ``--fault`` that can never strike is refused; for one that the
   file switches on there is a warning.
4. With ``--api`` the address of the page goes to stderr once it answers, with the token behind ``#`` if the program has
   created the token. A token from a file is not shown.
"""

import asyncio
import math
import re
import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ..errors import ConfigError, MissingExtra
from ..values.counts import counted
from .arguments import CAPTURE, QUIET, VERBOSE, seconds, show_traffic, whole_number
from .cloning import CloneOptions, clone_device, refuse_without_clone
from .exits import ExitCode
from .files import capturing, read_text
from .output import say, warn
from .reload_on_sighup import read_again_on_hangup
from .service_options import (
    ALLOW,
    ALLOW_WRITES,
    AUDIT,
    CONTROL,
    DENY,
    METRICS,
    NO_STANDARD_PORT,
    POLICY,
    PRIORITY,
    access_rules,
    address_list,
    announce,
    priority_networks,
)
from .signals import stop_event
from .sources import (
    CLONE,
    DEVICE,
    FILE_HELP,
    FORCE,
    LIST_DEVICES,
    MAP,
    OUT,
    RANGE,
    THOROUGH,
    UNIT,
    WATCH,
    Chosen,
    chosen_source,
)

if TYPE_CHECKING:
    from ..apps.service.configuration import Configuration
    from ..apps.service.service import Service
    from ..apps.service.service_interfaces import DeclaredServer
    from ..apps.simulator.simulation import Simulation
    from ..apps.web.simulation_page import ControlPage
    from ..faults.applied_faults import AppliedFault
    from ..faults.switchboard import FaultStatus

EXAMPLES = """\b
Examples:
  busway simulate plant.toml
  busway simulate plant.toml --listen tcp://127.0.0.1:1502 --listen rtu:///dev/ttyUSB0?baud=9600
  busway simulate plant.toml --seed 7 --speed 60 --for 1m
  busway simulate plant.toml --api 127.0.0.1:8502
  busway simulate plant.toml --fault late --fault wedged:units=3,from=60,for=10
  busway simulate plant.toml --check
  busway simulate --device meter
  busway simulate --map points.csv
  busway simulate --clone tcp://10.0.0.5 --map points.csv --out plant.toml

The same file and seed give the same values. A listener that the network reaches is read-only without a policy;
--allow-writes lifts that.
"""

_SPEED = re.compile(r"\d{1,7}(\.\d{1,6})?|\.\d{1,6}", re.ASCII)
_FASTEST = 100_000.0


def _list_faults(wanted: bool) -> None:
    if wanted:
        from ..apps.simulator.added_faults import fault_profile_lines

        print("\n".join(fault_profile_lines()))
        raise typer.Exit(ExitCode.DONE)


def simulate(
    file: str | None = typer.Argument(None, metavar="[FILE]", help=FILE_HELP),
    device: str | None = DEVICE,
    list_devices: bool = LIST_DEVICES,
    map_file: str | None = MAP,
    clone: str | None = CLONE,
    unit: str | None = UNIT,
    out: str | None = OUT,
    force: bool = FORCE,
    watch: str | None = WATCH,
    ranges: str | None = RANGE,
    thorough: bool = THOROUGH,
    listen: list[str] | None = typer.Option(
        None, "--listen", metavar="URL", help="Listen here, and not where the file says; several times if need be."
    ),
    seed: str | None = typer.Option(
        None, "--seed", metavar="N", help="Seed of all random values, instead of the file's."
    ),
    speed: str = typer.Option("1", "--speed", metavar="X", help="Seconds of the simulation in a second: 60."),
    duration: str | None = typer.Option(None, "--for", metavar="TIME", help="End after this time: 10s, 5m."),
    fault: list[str] | None = typer.Option(
        None,
        "--fault",
        metavar="NAME[:KEY=VALUE,…]",
        help="Switch on a fault of the file, or put on a fault profile: late, late:delay=2,units=1-3,probability=0.1.",
    ),
    list_faults: bool = typer.Option(
        False,
        "--list-faults",
        help="List the fault profiles with their parameters.",
        is_eager=True,
        callback=_list_faults,
    ),
    check: bool = typer.Option(
        False, "--check", help="Print what the file contains, or what is wrong with it; serve nothing."
    ),
    api: str | None = typer.Option(
        None, "--api", metavar="HOST:PORT", help="Offer the control API and its page here: 127.0.0.1:8502."
    ),
    api_token: str | None = typer.Option(
        None,
        "--api-token",
        metavar="FILE",
        help="File with the token of the API; without it, one is made if the network can reach the address.",
    ),
    no_standard_port: bool = NO_STANDARD_PORT,
    policy: str | None = POLICY,
    allow_writes: bool = ALLOW_WRITES,
    allow: list[str] | None = ALLOW,
    deny: list[str] | None = DENY,
    priority: list[str] | None = PRIORITY,
    audit: str | None = AUDIT,
    metrics: str | None = METRICS,
    control: str | None = CONTROL,
    capture: str | None = CAPTURE,
    verbose: int = VERBOSE,
    quiet: bool = QUIET,
) -> int:
    """Serve simulated devices that a file describes."""
    wanted = CloneOptions(clone or "", unit, map_file, out, watch, ranges, thorough, force=force, verbose=verbose)
    if clone is not None:
        if file is not None or device is not None:
            raise ConfigError("names what is recorded; there is nothing else to simulate", key="--clone")
        with capturing(capture):
            return clone_device(wanted)
    refuse_without_clone(wanted)
    limit = None if duration is None else seconds(duration, "--for", high=366 * 86_400)
    options: dict[str, Any] = {  # of different types
        "seed": None if seed is None else whole_number(seed, "--seed", 0, 2**31 - 1),
        "speed": _speed(speed),
    }
    from ..apps.service.overrides import Overrides
    from ..apps.service.service import Service
    from ..server.loops import run

    overrides = Overrides(
        listen=listen or (),
        rules=access_rules(policy),
        addresses=address_list(allow, deny),
        allow_writes=allow_writes,
        priority=priority_networks(priority),
        audit=audit,
        metrics=metrics,
        control=control,
        standard_port=False if no_standard_port else None,
        can_reload=True,
        name="simulator",
    )
    source = chosen_source(file, device, map_file, unit, overrides.listener_options, preflight=check)
    simulation = _loaded(source, fault or (), listen or (), keeps_state=not check, **options)
    if check:
        _print_units(simulation)
        return ExitCode.DONE
    service = Service(_reader(simulation, source), overrides)
    if api is None and api_token is not None:
        raise ConfigError("goes with --api only", key="--api-token")
    page = None if api is None else _page(simulation, api, api_token, source.name)
    show_traffic(verbose)
    with capturing(capture):
        run(_simulate(simulation, service, page, limit))
    return ExitCode.DONE


def _loaded(
    source: Chosen,
    faults: Iterable[str],
    listen: Collection[str],
    *,
    keeps_state: bool,
    **options: Any,  # of different types
) -> "Simulation":
    """Return the simulation of a source, with the faults of ``--fault`` switched on; it does not run yet.

    Args:
        source: where the simulation comes from.
        faults: the texts of ``--fault``.
        listen: the endpoints of ``--listen``; empty for those of the source.
        keeps_state: whether the values that an earlier run has saved are loaded, and saved again at the end. False if a
            file is only checked, so that its state stays untouched.
        options: keyword arguments of `Simulation`.

    Raises:
        ConfigError: the source or a fault is invalid, or a fault of ``--fault`` can never strike.
    """
    from ..apps.simulator.added_faults import put_on_by_words, why_it_never_strikes
    from ..apps.simulator.simulation import Simulation

    declaration = source.load()
    simulation = Simulation(declaration if keeps_state else replace(declaration, state=None), **options)
    endpoints = listen or [str(one.endpoint) for one in simulation.listeners]
    for words in faults:
        try:
            status = simulation.switchboard.status(put_on_by_words(simulation.switchboard, words))
        except ConfigError as error:
            raise ConfigError(str(error), key=f"--fault {words}") from error
        if why := why_it_never_strikes(status, endpoints, simulation.units):
            raise ConfigError(f"it would never strike: {why}", key=f"--fault {words}")
    for status in simulation.switchboard:
        if status.is_on and (why := why_it_never_strikes(status, endpoints, simulation.units)):
            warn(f"fault {status.name} never strikes: {why}")
    return simulation


def _speed(text: str) -> float:
    value = float(text) if _SPEED.fullmatch(text) else math.nan
    if not 0 < value <= _FASTEST:
        raise ConfigError(f"a number above 0, at most {_FASTEST:g}, is needed, not {text!r}", key="--speed")
    return value


def _reader(simulation: "Simulation", source: Chosen) -> "Callable[[], DeclaredServer]":
    """Return a function that returns the loaded simulation at its first call, and later reads the source again.

    Later calls, at each reload, raise `ConfigError` if a new start with the source would fail.
    """
    from ..apps.service.file_warnings import logging_warnings
    from ..apps.simulator.simulation import Simulation

    first = [simulation]

    @logging_warnings
    def configuration() -> "Configuration":
        if first:
            return simulation.declaration.configuration
        declaration = source.load()
        Simulation(replace(declaration, state=None))  # what the next start would refuse is said now
        return declaration.configuration

    def read() -> "DeclaredServer":
        found = configuration()
        return first.pop() if first else found

    return read


def _page(simulation: "Simulation", api: str, token_file: str | None, file: str) -> "ControlPage":
    from ..options.text import host_and_port

    try:
        from ..apps.web.simulation_page import ControlPage
    except ImportError as error:
        raise MissingExtra(error.name or "starlette", "web", purpose="the page", key="--api") from error

    host_and_port(api, "--api", "127.0.0.1:8502")
    token = None if token_file is None else read_text(token_file).strip()
    return ControlPage(simulation, api, token=token, name=Path(file).stem)


def check_file(file: str) -> None:
    """Print the units and faults of a simulation file on stdout, without running it.

    Raises:
        ConfigError: the file is invalid.
    """
    from ..apps.simulator.includes import load_declaration
    from ..apps.simulator.simulation import Simulation

    _print_units(Simulation(replace(load_declaration(file, preflight=True), state=None)))


def _print_units(simulation: "Simulation") -> None:
    from ..apps.simulator.added_faults import fault_details

    for unit in simulation.units.values():
        moving = sum(point.behaviour != "" for point in unit.points.values())
        name = f" {unit.name}:" if unit.name else ""
        print(f"unit {unit.unit}:{name} {counted(len(unit.points), 'point')}, {moving} with a behaviour")
    for each in simulation.switchboard:
        details = fault_details(each)
        with_them = f"; {details}" if details else ""
        print(f"fault {each.name}: {each.fault_profile}, {'on' if each.is_on else 'off'}{with_them}")
    for warning in simulation.declaration.configuration.warnings:
        print(warning, file=sys.stderr)


def _announce_fault(status: "FaultStatus") -> None:
    """Print on stderr what a fault does, its parameters, and in how many seconds it begins if not at once."""
    from ..apps.simulator.added_faults import fault_details

    details, after = fault_details(status), status.selection.schedule.after
    told = [status.happens, *([details] if details else []), *([f"begins in {after:g} s"] if after else [])]
    say(f"fault {status.name}: {'; '.join(told)}")


def _print_fault_time(fault: "AppliedFault", begins: bool) -> None:
    say(f"fault {fault.label} {'begins' if begins else 'ends'}")


async def _simulate(
    simulation: "Simulation", service: "Service", page: "ControlPage | None", limit: float | None
) -> None:
    from ..apps.simulator.fault_times import report_fault_times

    with stop_event() as stop:
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(read_again_on_hangup(service))
            stack.callback(simulation.keep)  # what was written until the server had stopped
            await stack.enter_async_context(service)
            await stack.enter_async_context(simulation.driven(service.server))
            if page is not None:
                await stack.enter_async_context(page)
                say(f"control API and page on {page.announced_url}")
            for unit in simulation.units.values():
                name = f" is {unit.name}" if unit.name else ""
                say(f"unit {unit.unit}{name}: {counted(len(unit.points), 'point')}")
            for sentence in simulation.warnings:
                warn(sentence)
            for each in simulation.switchboard:
                if each.is_on:
                    _announce_fault(each)
            announce(service)
            times = asyncio.create_task(report_fault_times(simulation.switchboard, _print_fault_time))
            stack.callback(times.cancel)
            with suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), limit)
