"""A gateway from TCP to TCP: transactions per second and CPU of the gateway alone.

The server behind is the floor, on the core of the load generator; the gateway has the other core for itself. 16
connections with 16 requests in flight, FC03 for 10 registers, all requests alike but for their addresses, so reads are
not shared: sharing is switched off, since a generator that asks 256 times the same would measure that alone.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from harness import children, machine
from harness.bench import Bench
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate
from harness.report import RATE_COLUMNS, Bar, Table, add_rates

REGISTERS = 10
SHAPES = ((16, 16), (16, 1))
ONE, FOUR, UVLOOP = "1 connection behind", "4 connections behind", "4 behind, uvloop"


def run(bench: Bench) -> Table:
    table = Table(f"Gateway, TCP to TCP: FC03 x {REGISTERS} registers", RATE_COLUMNS)
    results: dict[tuple[int, int], dict[str, Series]] = {}
    with ExitStack() as running:
        behind = running.enter_context(children.server(bench.program("floor_server"), bench.load_core))
        gateways = _start(bench, running, f"tcp://127.0.0.1:{behind.port}")
        for shape in SHAPES:
            bench.say(f"gateway: {shape[0]} connections x {shape[1]} in flight")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(_load, bench, gateway, *shape) for name, gateway in gateways.items()
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, f"{shape[0]:>2} x {shape[1]:>2}", series)
    table.bars = [
        Bar("16 x 16: one connection behind", _rate(results, ONE), ">=", 60_000, "/s"),
        Bar("16 x 16: four connections behind", _rate(results, FOUR), ">=", 80_000, "/s"),
    ]
    return table


def _start(bench: Bench, running: ExitStack, url: str) -> dict[str, children.Server]:
    wanted = {ONE: ("--connections", 1), FOUR: ("--connections", 4)}
    if bench.uvloop:
        wanted[UVLOOP] = ("--connections", 4, "--uvloop")  # type: ignore[assignment]
    started = {}
    for name, options in wanted.items():
        command = bench.ours("servers.busway_gateway", url, "--no-sharing", *options)
        try:
            started[name] = running.enter_context(children.server(command, bench.server_core))
        except ChildFailed as failure:
            bench.say(f"{name} is left out: {failure}")
    return started


def _load(bench: Bench, gateway: children.Server, connections: int, in_flight: int) -> Sample:
    before = machine.cpu_seconds(gateway.pid)
    command = bench.program("load", "127.0.0.1", gateway.port, connections, in_flight, REGISTERS, bench.seconds)
    result = children.run(command, bench.load_core, bench.seconds)
    return Sample.of(result, machine.cpu_seconds(gateway.pid) - before)


def _rate(results: dict[tuple[int, int], dict[str, Series]], name: str) -> float | None:
    series = results[16, 16].get(name)
    return None if series is None else series.median("rate")
