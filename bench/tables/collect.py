"""Values through the collector per second of CPU time, the time of plans, and memory of a point.

In one process on the servers' core, the best of several rounds. `offline/collect.py` says what is measured. Beside it,
against one server over TCP, in turns: a whole collector, and a loop of pymodbus that writes CSV.
"""

import statistics

from harness import children
from harness.bench import Bench
from harness.children import ChildFailed
from harness.report import Bar, Table, figure

GOAL = 400_000
MOST_BYTES = 300
PLAN_10_000, PLAN_50_000 = 0.050, 0.300
POINTS, TURN, ABOVE_PYMODBUS = 1000, 1.0, 1.0


def run(bench: Bench) -> Table:
    found = children.run(bench.ours("offline.collect", bench.rounds), bench.server_core, bench.budget * 3 + 60)
    table = Table("Values collected", ("", "figure"))
    table.rows.append(("polled and decoded, values/s of CPU", figure(found["polled/s"])))
    table.rows.append(("polled, decoded and committed, values/s of CPU", figure(found["collected/s"])))
    table.rows.append(("plan of 10 000 points, ms", figure(1000 * found["plan of 10000"])))
    table.rows.append(("plan of 50 000 points, ms", figure(1000 * found["plan of 50000"])))
    table.rows.append(("memory of a point at rest with its last value, bytes", figure(found["bytes/point"])))
    table.rows.append(
        ("the same, of devices with a profile of their own each, bytes", figure(found["bytes/own point"]))
    )
    ratio = _beside_pymodbus(bench, table)
    table.figures.append(found)
    table.bars = [
        Bar("values collected in one core", found["collected/s"], ">=", GOAL, "/s"),
        Bar("seconds for a plan of 10 000 points", found["plan of 10000"], "<=", PLAN_10_000, " s"),
        Bar("seconds for a plan of 50 000 points", found["plan of 50000"], "<=", PLAN_50_000, " s"),
        Bar("bytes of a point at rest", found["bytes/point"], "<=", MOST_BYTES, " B"),
        Bar("collected over TCP / pymodbus into CSV, values for each second of CPU", ratio, ">=", ABOVE_PYMODBUS, " x"),
    ]
    return table


def _beside_pymodbus(bench: Bench, table: Table) -> float | None:
    """Values for each second of CPU of a collector over those of a loop of pymodbus; None where that is not there."""
    ours: list[float] = []
    theirs: list[float] = []
    try:
        with children.server(bench.ours("servers.busway_server"), bench.server_core) as server:
            words = (server.port, TURN, POINTS)
            for _ in range(bench.rounds):
                for command, rates in (
                    (bench.ours("clients.busway_collect", *words), ours),
                    (bench.peer("peers.pymodbus_csv", *words), theirs),
                ):
                    got = children.run(command, bench.load_core, TURN + 10)
                    rates.append(got["values"] / got["cpu"])
    except ChildFailed as failed:
        bench.say(f"no comparison with pymodbus: {failed}")
        return None
    table.rows.append(("a collector over TCP, stored, values/s of CPU", figure(statistics.median(ours))))
    table.rows.append(
        ("pymodbus over TCP into CSV, no quality, no store, values/s of CPU", figure(statistics.median(theirs)))
    )
    return statistics.median(mine / other for mine, other in zip(ours, theirs, strict=True))
