"""Clients against the floor server: transactions per second, client CPU per transaction, latency.

The floor server has one core, the client the other. FC03 for 10 registers. `await` means one await per request, in as
many tasks as requests are in flight; `execute_many` hands over a batch and gets all replies together; `blocking` is
lock-step. The latency of `execute_many` is that of a whole batch. The load generator stands beside
them for comparison; whether it is an upper limit on one connection has not been shown.
"""

from collections.abc import Callable
from functools import partial

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates

REGISTERS = 10
IN_FLIGHT = 16

MANY, AWAIT, BLOCKING = "execute_many", "await", "blocking"


def run(bench: Bench) -> Table:
    table = Table(f"Clients against the floor server: FC03 x {REGISTERS} registers", RATE_COLUMNS)
    with children.server(bench.program("floor_server"), bench.server_core) as floor:
        groups = {
            kind: _measure(bench, floor, kind, contenders)
            for kind, contenders in ((MANY, _many(bench)), (AWAIT, _await(bench)), (BLOCKING, _blocking(bench)))
        }
    for kind, group in groups.items():
        for series in group.values():
            add_rates(table, kind, series)
    table.bars = _bars(groups)
    return table


# A contender's command lacks its port and duration, which are known when it is its turn.
Contender = Callable[[int, float], Command]


def _many(bench: Bench) -> dict[str, Contender]:
    def ours(connections: int, *options: str) -> Contender:
        return lambda port, seconds: bench.ours(
            "clients.busway_many", port, seconds, REGISTERS, connections, IN_FLIGHT, *options
        )

    contenders: dict[str, Contender] = {
        "load generator (C), 1 connection": _generator(bench, 1, IN_FLIGHT),
        "load generator (C), 16 connections": _generator(bench, 16, IN_FLIGHT),
        "busway, 1 connection": ours(1),
        "busway, 16 connections": ours(16),
    }
    if bench.uvloop:
        contenders["busway, uvloop, 1 connection"] = ours(1, "--uvloop")
        contenders["busway, uvloop, 16 connections"] = ours(16, "--uvloop")
    return contenders


def _await(bench: Bench) -> dict[str, Contender]:
    def ours(connections: int, tasks: int, *options: str) -> Contender:
        return lambda port, seconds: bench.ours(
            "clients.busway_await", port, seconds, REGISTERS, connections, tasks, *options
        )

    def pymodbus(connections: int, tasks: int) -> Contender:
        return lambda port, seconds: bench.peer(
            "peers.pymodbus_client", "await", port, seconds, REGISTERS, connections, tasks
        )

    contenders = {
        "pymodbus, 1 connection, 16 tasks": pymodbus(1, IN_FLIGHT),
        "pymodbus, 16 connections, 1 task each": pymodbus(16, 1),
        "busway, 1 connection, 16 tasks": ours(1, IN_FLIGHT),
        "busway, joined, 1 connection, 16 tasks": ours(1, IN_FLIGHT, "--join"),
        "busway, 16 connections, 1 task each": ours(16, 1),
    }
    if bench.uvloop:
        contenders["busway, uvloop, 1 connection, 16 tasks"] = ours(1, IN_FLIGHT, "--uvloop")
        contenders["busway, uvloop, joined, 1 connection, 16 tasks"] = ours(1, IN_FLIGHT, "--uvloop", "--join")
    return contenders


def _blocking(bench: Bench) -> dict[str, Contender]:
    return {
        "load generator (C)": _generator(bench, 1, 1),
        "pyModbusTCP": lambda port, seconds: bench.peer("peers.pymodbustcp_client", port, seconds, REGISTERS),
        "pymodbus": lambda port, seconds: bench.peer("peers.pymodbus_client", "blocking", port, seconds, REGISTERS),
        "busway": lambda port, seconds: bench.ours("clients.busway_blocking", port, seconds, REGISTERS),
    }


def _generator(bench: Bench, connections: int, in_flight: int) -> Contender:
    return lambda port, seconds: bench.program("load", "127.0.0.1", port, connections, in_flight, REGISTERS, seconds)


def _measure(bench: Bench, floor: children.Server, kind: str, contenders: dict[str, Contender]) -> dict[str, Series]:
    def turn(command: Contender) -> Sample:
        result = children.run(command(floor.port, bench.seconds), bench.load_core, bench.seconds)
        return Sample.of(result, result["cpu"])

    bench.say(f"client: {kind}")
    turns = {name: partial(turn, command) for name, command in contenders.items()}
    return alternate(turns, bench.rounds, (ChildFailed,), bench.say)


def _bars(groups: dict[str, dict[str, Series]]) -> list[Bar]:
    def rate(kind: str, name: str) -> float | None:
        return groups[kind][name].median("rate")

    def against(kind: str, mine: str, theirs: str) -> float | None:
        return ratio(groups[kind][mine], groups[kind][theirs], "rate")

    one, sixteen = "1 connection", "16 connections"
    awaited = "1 connection, 16 tasks"
    return [
        Bar(f"execute_many, {one}", rate(MANY, f"busway, {one}"), ">=", 150_000, "/s"),
        Bar(f"execute_many, {sixteen}", rate(MANY, f"busway, {sixteen}"), ">=", 350_000, "/s"),
        Bar("await per request, 16 in flight on 1 connection", rate(AWAIT, f"busway, {awaited}"), ">=", 80_000, "/s"),
        Bar("the same, requests of one turn joined", rate(AWAIT, f"busway, joined, {awaited}"), ">=", 80_000, "/s"),
        Bar("blocking: busway / pyModbusTCP, rate", against(BLOCKING, "busway", "pyModbusTCP"), ">=", 0.9),
    ]
