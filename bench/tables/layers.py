"""Where the microseconds of one transaction go, layer by layer: `profile_layers` as a table.

In one process without sockets, on the servers' core. What kernel and event loop add stands in the tables of servers and
clients, where the bare loop is the floor.
"""

from harness import children
from harness.bench import Bench
from harness.report import Table


def run(bench: Bench) -> Table:
    seconds = bench.asked_seconds or max(bench.budget - 2.5, 1.0)
    found = children.run(bench.ours("profile_layers", seconds, "--json"), bench.server_core, seconds + 30)
    table = Table("Layers of one transaction, without sockets", ("", "µs", "instructions"))
    for name, profile in found.items():
        table.rows.append(
            (name, f"{sum(profile['parts'].values()):.2f}", f"{sum(profile['instructions'].values()):.0f}")
        )
        for part, microseconds in profile["parts"].items():
            table.rows.append((f"    {part}", f"{microseconds:.2f}", ""))
        for layer, number in profile["instructions"].items():
            table.rows.append((f"    {layer}", "", f"{number:.0f}"))
        table.figures.append({"name": name} | profile)
    return table
