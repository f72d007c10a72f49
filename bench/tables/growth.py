"""What a transaction costs when there is more of everything: connections, units, registers, routes, points.

In one process without sockets, so that busway's own work is seen and not the kernel's, stores and memory included (how
memory grows with connections is in the table `memory`); then servers with so many real connections under the load
generator, four requests in flight on each of sixteen and the others idle, beside the floor.
The exponent says how the cost grows with the size: 0 is flat, 1 in proportion. It is taken by least squares over all
sizes of a row.
"""

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from harness import children
from harness.bench import Bench
from harness.children import ChildFailed, Server
from harness.measure import median
from harness.report import Bar, Table, figure
from harness.serving import Shape, load, start
from offline.timing import exponent

FLAT = 0.1
"""Twice the cost for a thousand times the size."""
IDLE = (0, 100, 1000, 4000)
ACTIVE = Shape(16, 4)
FLOOR, OURS = "floor (C)", "busway"
SOCKETS_SHARE = 1 / 3
"""Part of the budget for real connections."""
SETTING_UP = 15.0
"""Seconds for servers, devices, plans and stores of all sizes, before they are timed."""


def run(bench: Bench) -> Table:
    table = Table(
        "Growth: ns per transaction, value, point or sample by size, and its exponent",
        ("", "sizes", "ns, or bytes", "exponent"),
    )
    seconds = bench.asked_seconds or max(bench.budget * (1 - SOCKETS_SHARE) - SETTING_UP, 1.5)
    found: dict[str, dict[str, float]] = children.run(
        bench.ours("offline.growth", seconds, *(["--quick"] if bench.quick else [])), bench.server_core, seconds + 120
    )
    rows = {setting: {int(size): cost for size, cost in costs.items()} for setting, costs in found.items()}
    rows |= {f"connections that are idle: {name}": costs for name, costs in _with_idle(bench).items()}
    for setting, costs in rows.items():
        power = exponent([size + 16 if "idle" in setting else size for size in costs], list(costs.values()))
        sizes, figures = ("  ".join(map(str, costs)), "  ".join(map(figure, costs.values())))
        table.rows.append((setting, sizes, figures, f"{power:+.2f}"))
        table.figures.append({"name": setting, "costs": costs, "exponent": power})
        bench.say(f"growth: {setting:<50} {power:+.2f}")
        if FLOOR not in setting:
            table.bars.append(Bar(f"{setting}: exponent", power, "<=", FLAT, ""))
    return table


def _with_idle(bench: Bench) -> dict[str, dict[int, float]]:
    """CPU nanoseconds of a transaction by the number of idle connections beside the busy ones."""
    idle = (0, 1000) if bench.quick else IDLE
    wanted = {FLOOR: lambda: bench.program("floor_server"), OURS: lambda: bench.ours("servers.busway_server")}
    costs: dict[str, dict[int, float]] = {}
    with ExitStack() as running:
        servers = start(bench, running, wanted)
        seconds = bench.turn(len(idle) * len(wanted), apart=bench.budget * (1 - SOCKETS_SHARE) + 2.0)
        for size in idle:
            with ExitStack() as beside:
                for server in servers.values():
                    beside.enter_context(_idle(server, size))
                samples: dict[str, list[float]] = {name: [] for name in servers}
                for _ in range(bench.rounds):
                    for name, server in servers.items():
                        try:
                            cpu = load(bench, server, ACTIVE, seconds).cpu
                        except ChildFailed as failure:
                            bench.say(f"growth: {name} with {size} idle connections: {failure}")
                            continue
                        samples[name].append((cpu or 0.0) * 1000)
            for name, values in samples.items():
                middle = median(values)
                if middle:
                    costs.setdefault(name, {})[size] = middle
    return costs


@contextmanager
def _idle(server: Server, count: int) -> Iterator[None]:
    links: list[socket.socket] = []
    try:
        for _ in range(count):
            links.append(socket.create_connection(("127.0.0.1", server.port), timeout=5))
        yield
    finally:
        for link in links:
            link.close()
