"""Servers under the load generator: transactions per second, server CPU per transaction, latency.

All servers run at once, pinned to one core, and are asked in turn by the generator on the other core; one that is not
asked sleeps. FC03 for 10 registers. With several requests in flight, pymodbus answers one frame per read of its socket
and leaves the others for the next, so its queue is longer than the latency of its answers shows.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from harness import children, machine
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates

SHAPES = ((16, 16), (16, 1), (1, 1))  # connections × requests in flight on each
REGISTERS = 10

FLOOR, LIBMODBUS, PYMODBUS, PYMODBUSTCP = "floor (C)", "libmodbus (C)", "pymodbus", "pyModbusTCP"
OURS, OURS_UVLOOP = "busway", "busway, uvloop"


def run(bench: Bench) -> Table:
    table = Table(f"Servers: FC03 x {REGISTERS} registers", RATE_COLUMNS)
    results: dict[tuple[int, int], dict[str, Series]] = {}
    with ExitStack() as running:
        servers = _start(bench, running)
        for shape in SHAPES:
            bench.say(f"server: {shape[0]} connections x {shape[1]} in flight")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(_load, bench, server, *shape) for name, server in servers.items()
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, f"{shape[0]:>2} x {shape[1]:>2}", series)
    table.bars = _bars(results)
    return table


def _start(bench: Bench, running: ExitStack) -> dict[str, children.Server]:
    """Starts every server that can be started; one that can not is said and left out."""
    wanted: dict[str, Callable[[], Command]] = {
        FLOOR: lambda: bench.program("floor_server"),
        LIBMODBUS: lambda: bench.program("libmodbus_server"),
        PYMODBUS: lambda: bench.peer("peers.pymodbus_server"),
        PYMODBUSTCP: lambda: bench.peer("peers.pymodbustcp_server"),
        OURS: lambda: bench.ours("servers.busway_server"),
    }
    if bench.uvloop:
        wanted[OURS_UVLOOP] = lambda: bench.ours("servers.busway_server", "--uvloop")
    started = {}
    for name, command in wanted.items():
        try:
            started[name] = running.enter_context(children.server(command(), bench.server_core))
        except ChildFailed as failure:
            bench.say(f"{name} is left out: {failure}")
    return started


def _load(bench: Bench, server: children.Server, connections: int, in_flight: int) -> Sample:
    before = machine.cpu_seconds(server.pid)
    command = bench.program("load", "127.0.0.1", server.port, connections, in_flight, REGISTERS, bench.seconds)
    result = children.run(command, bench.load_core, bench.seconds)
    return Sample.of(result, machine.cpu_seconds(server.pid) - before)


def _bars(results: dict[tuple[int, int], dict[str, Series]]) -> list[Bar]:
    def against(shape: tuple[int, int], peer: str, quantity: str = "rate") -> float | None:
        return ratio(results[shape].get(OURS), results[shape].get(peer), quantity)

    return [
        Bar("16 x 16: busway / libmodbus, rate", against((16, 16), LIBMODBUS), ">=", 3),
        Bar("16 x 16: busway / pymodbus, rate", against((16, 16), PYMODBUS), ">=", 25),
        Bar("16 x 16: busway / floor, CPU per transaction", against((16, 16), FLOOR, "cpu"), "<=", 5),
        Bar("16 x 1: busway / libmodbus, rate", against((16, 1), LIBMODBUS), ">=", 0.9),
        Bar("1 x 1: busway / libmodbus, rate", against((1, 1), LIBMODBUS), ">=", 0.9),
    ]
