"""A gateway from TCP to TCP: transactions per second and CPU of the gateway alone.

The server behind is the floor, on the core of the load generator; the gateway has the other core for itself. 16
connections with 16 requests in flight, FC03 for 10 registers. All requests are alike, so sharing of reads is switched
off: a generator that asks 256 times the same would measure that alone. The links behind have 16 transactions, so what
is asked in one turn of the loop leaves in one segment, whichever client asked. The floor is what
the generator gets from the server behind when it asks it directly, on the other core like the gateways. With one
request in flight libmodbus answers directly too. `observed` has metrics, a policy of twelve rules and an audit log.
"""

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

FULL, SINGLE = Shape(16, 16), Shape(16, 1)
SHAPES = (FULL, SINGLE)
FLOOR = "floor (C), no gateway"
LIBMODBUS = "libmodbus (C), no gateway"
OBSERVED = "1 behind, observed"
ONE, FOUR = "1 connection behind", "4 connections behind"
ONE_UVLOOP, FOUR_UVLOOP = "1 behind, uvloop", "4 behind, uvloop"
STARTING = 3.0


def run(bench: Bench) -> Table:
    table = Table("Gateway, TCP to TCP: FC03 x 10 registers", RATE_COLUMNS)
    results: dict[Shape, dict[str, Series]] = {}
    with ExitStack() as running:
        behind = running.enter_context(children.server(bench.program("floor_server"), bench.load_core))
        audit = Path(running.enter_context(tempfile.TemporaryDirectory())) / "audit.jsonl"
        gateways = start(bench, running, _contenders(bench, f"tcp://127.0.0.1:{behind.port}", audit))
        shapes = SHAPES[:1] if bench.quick else SHAPES
        seconds = bench.turn(len(shapes) * len(gateways), apart=STARTING)
        for shape in shapes:
            bench.say(f"gateway: {shape}, {seconds:.2f} s a turn")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(load, bench, gateway, shape, seconds)
                for name, gateway in gateways.items()
                if shape == SINGLE or name not in (LIBMODBUS, OBSERVED)
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, str(shape), series)
    full, single = results[FULL], results.get(SINGLE, {})
    table.bars = [
        Bar("16 x 16: one connection behind", _rate(full, ONE), ">=", 60_000, "/s"),
        Bar("16 x 16: four connections behind", _best(full, FOUR, FOUR_UVLOOP), ">=", 100_000, "/s"),
        Bar(
            "16 x 1: one behind / libmodbus without a gateway, rate",
            ratio(single.get(ONE), single.get(LIBMODBUS), "rate"),
            ">=",
            0.45,
        ),
        Bar("16 x 1: observed / not, rate", ratio(single.get(OBSERVED), single.get(ONE), "rate"), ">=", 0.8),
    ]
    return table


def _contenders(bench: Bench, url: str, audit: Path) -> dict[str, Callable[[], Command]]:
    def ours(connections: int, *options: str) -> Callable[[], Command]:
        return lambda: bench.ours("servers.busway_gateway", url, "--no-sharing", "--connections", connections, *options)

    wanted = {FLOOR: lambda: bench.program("floor_server"), ONE: ours(1), FOUR: ours(4)}
    if not bench.quick:
        wanted |= {LIBMODBUS: lambda: bench.program("libmodbus_server"), OBSERVED: ours(1, "--observed", str(audit))}
    if bench.uvloop:
        wanted |= {ONE_UVLOOP: ours(1, "--uvloop"), FOUR_UVLOOP: ours(4, "--uvloop")}
    return wanted


def _rate(series: dict[str, Series], name: str) -> float | None:
    return series[name].median("rate") if name in series else None


def _best(series: dict[str, Series], *names: str) -> float | None:
    return max(filter(None, (_rate(series, name) for name in names)), default=None)
