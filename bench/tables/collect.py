"""Values through the collector per second of CPU time, the time of plans, and memory of a point.

In one process on the servers' core, the best of several rounds. `offline/collect.py` says what is measured.
"""

from harness import children
from harness.bench import Bench
from harness.report import Bar, Table, figure

GOAL = 400_000
MOST_BYTES = 300
PLAN_10_000, PLAN_50_000 = 0.050, 0.300


def run(bench: Bench) -> Table:
    found = children.run(bench.ours("offline.collect", bench.rounds), bench.server_core, bench.budget * 3 + 60)
    table = Table("Values collected", ("", "figure"))
    table.rows.append(("polled and decoded, values/s of CPU", figure(found["polled/s"])))
    table.rows.append(("polled, decoded and committed, values/s of CPU", figure(found["collected/s"])))
    table.rows.append(("plan of 10 000 points, ms", figure(1000 * found["plan of 10000"])))
    table.rows.append(("plan of 50 000 points, ms", figure(1000 * found["plan of 50000"])))
    table.rows.append(("memory of a point at rest, bytes", figure(found["bytes/point"])))
    table.figures.append(found)
    table.bars = [
        Bar("values collected in one core", found["collected/s"], ">=", GOAL, "/s"),
        Bar("seconds for a plan of 10 000 points", found["plan of 10000"], "<=", PLAN_10_000, " s"),
        Bar("seconds for a plan of 50 000 points", found["plan of 50000"], "<=", PLAN_50_000, " s"),
        Bar("bytes of a point at rest", found["bytes/point"], "<=", MOST_BYTES, " B"),
    ]
    return table
