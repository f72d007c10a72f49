"""Mixed traffic at a server: functions 01 to 06, 15, 16, 22 and 23 over 20 000 requests that all differ, beside FC03.

16 connections with 16 requests in flight, on busway and on libmodbus: reads of 10 registers, mixed traffic about up to
10 registers or 80 bits, and writes of functions 06 and 16. Ratios are of turns of the same round.
"""

from contextlib import ExitStack
from functools import partial

from harness.bench import Bench
from harness.children import ChildFailed
from harness.measure import alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

MIXED = 0
READS, MANY, WRITE, WRITES = (
    Shape(16, 16),
    Shape(16, 16, function=MIXED),
    Shape(16, 16, function=6),
    Shape(16, 16, 10, 16),
)
KINDS = {"FC03": READS, "mixed": MANY, "FC06": WRITE, "FC16": WRITES}
OURS, LIBMODBUS = "busway", "libmodbus (C)"
STARTING = 1.5
"""Seconds that the servers take to start."""


def run(bench: Bench) -> Table:
    table = Table("Servers: mixed traffic, 16 x 16, 10 registers", RATE_COLUMNS)
    with ExitStack() as running:
        wanted = {
            OURS: lambda: bench.ours("servers.busway_server", "--all-tables"),
            LIBMODBUS: lambda: bench.program("libmodbus_server"),
        }
        servers = start(bench, running, wanted)
        seconds = bench.turn(len(servers) * len(KINDS), apart=STARTING)
        bench.say(f"mixed: {seconds:.2f} s a turn")
        turns = {
            f"{kind}  {name}": partial(load, bench, server, shape, seconds)
            for name, server in servers.items()
            for kind, shape in KINDS.items()
        }
        found = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
    for label, series in found.items():
        series.name = ""
        add_rates(table, label, series)

    def times(mine: str, theirs: str) -> float | None:
        return ratio(found.get(mine), found.get(theirs), "rate")

    table.bars = [
        Bar("mixed: busway / libmodbus, rate", times(f"mixed  {OURS}", f"mixed  {LIBMODBUS}"), ">=", 4.0),
        Bar("mixed / FC03, rate", times(f"mixed  {OURS}", f"FC03  {OURS}"), ">=", 0.42),
        Bar("FC06 / FC03, rate", times(f"FC06  {OURS}", f"FC03  {OURS}"), ">=", 0.6),
        Bar("FC16 / FC03, rate", times(f"FC16  {OURS}", f"FC03  {OURS}"), ">=", 0.6),
    ]
    return table
