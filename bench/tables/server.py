"""Servers under the load generator: transactions per second, server CPU per transaction, latency.

All servers run at once, pinned to one core, and are asked in turn by the generator on the other core; one that is not
asked sleeps. FC03 for 10 and for 125 registers. With several requests in flight, pymodbus answers one frame per read of
its socket and leaves the others for the next, so its queue is longer than the latency of its answers shows.

The goals are ratios of two servers. In a full run they are measured once more, in pairs of short turns: with five
rounds of nine contenders a ratio swings by half on a machine that is not alone.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from harness.bench import LEAST_TURN, Bench, Command
from harness.children import ChildFailed, Server
from harness.measure import Sample, Series, alternate, in_pairs, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

SHAPES = ((16, 16), (16, 1), (1, 1), (1, 16), (50, 4))
"""Connections × requests in flight on each."""
QUICK_SHAPES = (Shape(16, 16), Shape(16, 1), Shape(50, 4, 125))
FULL_ONLY = frozenset({"pyModbusTCP", "modbus-rs, Python handler", "bare loop, uvloop"})

FLOOR, LIBMODBUS, PYMODBUS, PYMODBUSTCP = "floor (C)", "libmodbus (C)", "pymodbus", "pyModbusTCP"
MODBUS_RS = "modbus-rs, Python handler"
BARE, BARE_UVLOOP = "bare loop, checks nothing", "bare loop, uvloop"
OURS, OURS_UVLOOP = "busway", "busway, uvloop"
STARTING = 4.0
"""Seconds that all servers together take to start."""
FULL, SINGLE, ONE, WIDE = Shape(16, 16), Shape(16, 1), Shape(1, 1), Shape(50, 4, 125)
GOALS = (
    ("16 x 16 x 10: busway / libmodbus, rate", FULL, LIBMODBUS, "rate", ">=", 5.0),
    ("16 x 16 x 10: busway / pymodbus, rate", FULL, PYMODBUS, "rate", ">=", 40.0),
    ("16 x 16 x 10: busway / floor, CPU per transaction", FULL, FLOOR, "cpu", "<=", 2.0),
    ("50 x 4 x 125: busway / libmodbus, rate", WIDE, LIBMODBUS, "rate", ">=", 2.0),
    ("16 x 1 x 10: busway / libmodbus, rate", SINGLE, LIBMODBUS, "rate", ">=", 1.0),
    ("1 x 1 x 10: busway / libmodbus, rate", ONE, LIBMODBUS, "rate", ">=", 0.9),
)
"""What, shape, peer, quantity, and the bar."""
PAIRS = 20
PAIR_SECONDS = 2 * (LEAST_TURN + 0.16)
"""With the warm-up and the start of the load."""


def run(bench: Bench) -> Table:
    table = Table("Servers: FC03", RATE_COLUMNS)
    shapes = QUICK_SHAPES if bench.quick else [Shape(*shape, registers) for registers in (10, 125) for shape in SHAPES]
    results: dict[Shape, dict[str, Series]] = {}
    with ExitStack() as running:
        servers = start(bench, running, _contenders(bench))
        in_goals = 0.0 if bench.quick else PAIRS * PAIR_SECONDS * len(GOALS)
        seconds = bench.turn(len(shapes) * len(servers), apart=STARTING + in_goals)
        for shape in shapes:
            bench.say(f"server: {shape}, {shape.registers} registers, {seconds:.2f} s a turn")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(load, bench, server, shape, seconds) for name, server in servers.items()
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, f"{shape} x {shape.registers:>3}", series)
        for what, shape, peer, quantity, sense, bar in GOALS:
            found = results.get(shape, {}) if bench.quick else _pairs(bench, servers, shape, peer)
            reached = ratio(found.get(OURS), found.get(peer), quantity)
            table.bars.append(Bar(what, reached, sense, bar))
    table.notes.append("connections x in flight x registers")
    if not bench.quick:
        table.notes.append(f"goals: the middle of the ratios of {PAIRS} pairs of turns, one right after the other")
    return table


def _pairs(bench: Bench, servers: dict[str, Server], shape: Shape, peer: str) -> dict[str, Series]:
    if OURS not in servers or peer not in servers:
        return {}
    bench.say(f"server: goals, {shape}, {shape.registers} registers, {PAIRS} pairs with {peer}")
    turns = {name: partial(load, bench, servers[name], shape, LEAST_TURN) for name in (OURS, peer)}
    return in_pairs(turns, PAIRS, (ChildFailed,), bench.say)


def _contenders(bench: Bench) -> dict[str, Callable[[], Command]]:
    wanted: dict[str, Callable[[], Command]] = {
        FLOOR: lambda: bench.program("floor_server"),
        BARE: lambda: bench.ours("servers.bare_loop"),
        LIBMODBUS: lambda: bench.program("libmodbus_server"),
        PYMODBUS: lambda: bench.peer("peers.pymodbus_server"),
        PYMODBUSTCP: lambda: bench.peer("peers.pymodbustcp_server"),
        MODBUS_RS: lambda: bench.peer("peers.modbus_rs_server"),
        OURS: lambda: bench.ours("servers.busway_server"),
    }
    if bench.uvloop:
        wanted[BARE_UVLOOP] = lambda: bench.ours("servers.bare_loop", "--uvloop")
        wanted[OURS_UVLOOP] = lambda: bench.ours("servers.busway_server", "--uvloop")
    return {name: command for name, command in wanted.items() if not bench.quick or name not in FULL_ONLY}
