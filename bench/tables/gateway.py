"""A gateway from TCP to TCP: transactions per second and CPU of the gateway alone.

The server behind is the floor, on the core of the load generator; the gateway has the other core for itself. 16
connections with 16 requests in flight, FC03 for 10 registers. All requests are alike, so sharing of reads is switched
off: a generator that asks 256 times the same would measure that alone. The links behind have 16 transactions, so what
is asked in one turn of the loop leaves in one segment, whoever asked. The floor is what
the generator gets from the server behind when it asks it directly, on the other core like the gateways.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

SHAPES = (Shape(16, 16), Shape(16, 1))
FLOOR = "floor (C), no gateway"
ONE, FOUR = "1 connection behind", "4 connections behind"
ONE_UVLOOP, FOUR_UVLOOP = "1 behind, uvloop", "4 behind, uvloop"
STARTING = 3.0


def run(bench: Bench) -> Table:
    table = Table("Gateway, TCP to TCP: FC03 x 10 registers", RATE_COLUMNS)
    results: dict[Shape, dict[str, Series]] = {}
    with ExitStack() as running:
        behind = running.enter_context(children.server(bench.program("floor_server"), bench.load_core))
        gateways = start(bench, running, _contenders(bench, f"tcp://127.0.0.1:{behind.port}"))
        shapes = SHAPES[:1] if bench.quick else SHAPES
        seconds = bench.turn(len(shapes) * len(gateways), apart=STARTING)
        for shape in shapes:
            bench.say(f"gateway: {shape}, {seconds:.2f} s a turn")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(load, bench, gateway, shape, seconds) for name, gateway in gateways.items()
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, str(shape), series)
    full = results[SHAPES[0]]
    table.bars = [
        Bar("16 x 16: one connection behind", _rate(full, ONE), ">=", 60_000, "/s"),
        Bar("16 x 16: four connections behind", _best(full, FOUR, FOUR_UVLOOP), ">=", 100_000, "/s"),
    ]
    return table


def _contenders(bench: Bench, url: str) -> dict[str, Callable[[], Command]]:
    def ours(connections: int, *options: str) -> Callable[[], Command]:
        return lambda: bench.ours("servers.busway_gateway", url, "--no-sharing", "--connections", connections, *options)

    wanted = {FLOOR: lambda: bench.program("floor_server"), ONE: ours(1), FOUR: ours(4)}
    if bench.uvloop:
        wanted |= {ONE_UVLOOP: ours(1, "--uvloop"), FOUR_UVLOOP: ours(4, "--uvloop")}
    return wanted


def _rate(series: dict[str, Series], name: str) -> float | None:
    return series[name].median("rate") if name in series else None


def _best(series: dict[str, Series], *names: str) -> float | None:
    return max(filter(None, (_rate(series, name) for name in names)), default=None)
