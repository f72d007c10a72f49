"""500 simulated units × 100 points that change once a second, on one core that answers 5000 single reads a second.

The share of the core is CPU time of the simulating process by time on the clock, so what else the machine does
meanwhile does not count. The first row has no reads, the second has them; the difference is what reads cost.
"""

import time
from signal import SIGUSR2

from harness import children, machine
from harness.bench import Bench
from harness.children import ChildFailed, Server
from harness.report import Bar, Table, figure

POINTS = 50_000
READS = 5000  # per second
CONNECTIONS = 50
UNITS = 250
MOST = 60.0  # per cent of a core
COLUMNS = ("", "CPU %", "changes/s", "left out", "reads/s", "p50 µs", "p99 µs")


def run(bench: Bench) -> Table:
    table = Table("Simulator: 500 units x 100 points, once a second", COLUMNS)
    seconds = min(max((bench.budget - 8) / 2, 2.0), 10.0)
    share: float | None = None
    try:
        with children.server(bench.ours("servers.busway_simulator"), bench.server_core) as server:
            _add(table, "no reads", server, seconds, None)
            command = bench.ours("clients.paced_reads", seconds, READS, CONNECTIONS, UNITS, *server.told)
            share = _add(table, f"{READS} reads/s", server, seconds, (command, bench.load_core))
    except ChildFailed as failure:
        bench.say(f"simulator: {failure}")
    table.bars = [Bar(f"CPU of one core with {READS} reads a second", share, "<=", MOST, "%")]
    return table


def _add(
    table: Table, name: str, server: Server, seconds: float, load: tuple[list[object], int | None] | None
) -> float:
    """One row; the share of a core in per cent."""
    before, cpu, began = _told(server), machine.cpu_seconds(server.pid), time.perf_counter()
    found = {}
    if load is None:
        time.sleep(seconds)
    else:
        found = children.run(load[0], load[1], seconds)  # type: ignore[arg-type]
    took = time.perf_counter() - began
    share = 100 * (machine.cpu_seconds(server.pid) - cpu) / took
    changes, left_out = (after - early for after, early in zip(_told(server), before, strict=True))
    reads = [figure(found[key]) if key in found else "–" for key in ("rate", "p50", "p99")]
    table.rows.append((name, figure(share), figure(changes / took), str(left_out), *reads))
    table.figures.append({"name": name, "cpu": share, "changes": changes / took, "left_out": left_out, **found})
    return share


def _told(server: Server) -> tuple[int, int]:
    changes, left_out = server.answer(SIGUSR2, "changes")
    return int(changes), int(left_out)
