"""A zone of a fleet on the virtual clock: balance, takeover and messages by the number of collectors.

Members, balance and leases are the product's, driven by the world of the tests (`fleet_scale.py`): loss of
1 %, delays up to 50 ms, clocks that drift by 0.1 %. Ten thousand points for each collector. Figures are seconds of the
virtual clock, so they are the same on every machine; only `CPU` is this one's.
"""

import sys
import time
from pathlib import Path

from harness.bench import Bench
from harness.report import Bar, Table, figure

SIZES = (10, 25, 100)
ZONES = {100: 10}
"""Zones of a size that make a fleet of a thousand."""
TAKEOVER = 15.0 + 1.0 + 1.0
BALANCE = 10.0


def run(bench: Bench) -> Table:
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
    from fleet_scale import scale

    columns = ("collectors", "points", "shards", "off by %", "takeover s", "changes/s", "deliveries/s", "CPU s")
    table = Table("Fleet: one zone on the virtual clock, by the number of collectors", columns)
    for size in SIZES:
        began = time.process_time()
        found = scale(size)
        took = time.process_time() - began
        bench.say(f"fleet: {size} collectors took {took:.0f} s of CPU")
        rows = [(str(size), found, 1)]
        if size in ZONES:
            rows.append((f"{ZONES[size] * size} in {ZONES[size]} zones", found, ZONES[size]))
        for name, each, zones in rows:
            table.rows.append(
                (
                    name,
                    f"{each.points * zones:,}",
                    str(each.shards * zones),
                    figure(100 * each.imbalance),
                    figure(each.takeover),
                    figure(each.changes * zones),
                    figure(each.deliveries * zones),
                    figure(took * zones),
                )
            )
        table.figures.append({"name": f"{size} collectors", "imbalance": found.imbalance, "takeover": found.takeover})
        table.bars.append(
            Bar(f"{size} collectors: furthest from the fair load", 100 * found.imbalance, "<=", BALANCE, "%")
        )
        table.bars.append(Bar(f"{size} collectors: takeover after kill -9", found.takeover, "<=", TAKEOVER, "s"))
    table.notes.append(
        "Several zones are as many times the zone of their size: zones share nothing, not even a server's stream."
    )
    table.notes.append("Larger zones, by `python tests/support/fleet_scale.py 250 60`, take minutes.")
    return table
