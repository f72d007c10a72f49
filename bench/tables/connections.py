"""Many clients that ask seldom: 5000 connections, each with one request per second.

What a server of many clients does all day. Here it is not the rate that counts, but what of one core a server needs for
it, and whether a client waits. The questions are spread evenly over the second, so nearly each wakes the server:
a transaction costs more than with requests that arrive together. Servers run one after another, each alone on its
core; the generator has the other one.
"""

import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from harness import children, measure
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.report import Bar, Table, figure

CONNECTIONS = 5000
PERIOD = 1.0
"""Seconds between two questions of a connection."""
SETTLE = 3.0
"""Seconds on top of a run for dialling; a server that needs much longer is left out."""
COLUMNS = ("", "CPU %", "CPU µs each", "p50 ms", "p99 ms", "p99.9 ms", "longest ms", "late", "missing")
PLANT = f"""\
[server]
max_connections = {CONNECTIONS + 10}
[[unit]]
unit = 1
holding_registers = 1000
"""

OURS = "busway serve"
OUR_ROUNDS = 2
LEAST, LONGEST = 3.0, 10.0
"""Seconds of one round."""


def run(bench: Bench) -> Table:
    turns = 3 + (1 if bench.quick else OUR_ROUNDS)
    seconds = min(max(bench.budget / turns - PERIOD - SETTLE, LEAST), LONGEST)
    table = Table(f"Many clients: {CONNECTIONS} connections, a request each {PERIOD:g} s", COLUMNS)
    ours: list[Mapping[str, float]] = []
    with tempfile.TemporaryDirectory() as folder:
        plant = Path(folder) / "plant.toml"
        plant.write_text(PLANT)
        for name, command in _contenders(bench, plant).items():
            rounds: list[Mapping[str, float]] = []
            try:
                for _ in range(1 if bench.quick or name != OURS else OUR_ROUNDS):
                    rounds.append(_round(bench, command(), seconds))
            except ChildFailed as failure:
                bench.say(f"connections: {name} is left out. {failure}")
                table.rows.append((name, "–", *[""] * (len(COLUMNS) - 2)))
                table.figures.append({"name": name, "missing": str(failure)})
                continue
            _add(bench, table, name, rounds)
            if name == OURS:
                ours = rounds
    table.bars = _bars(ours)
    return table


def _contenders(bench: Bench, plant: Path) -> dict[str, Callable[[], Command]]:
    cli: Command = [sys.executable, "-m", "busway", "serve", plant, "--listen", "tcp://127.0.0.1:0"]
    return {
        "floor (C)": lambda: bench.program("floor_server"),
        OURS: lambda: [*cli, "--control", "off"],
        "busway, asyncio": lambda: bench.ours("servers.busway_server"),
        "pymodbus": lambda: bench.peer("peers.pymodbus_server"),
    }


def _round(bench: Bench, command: Command, seconds: float) -> Mapping[str, float]:
    with children.server(command, bench.server_core) as server:
        asked = bench.program("paced", "127.0.0.1", server.port, CONNECTIONS, PERIOD, seconds, server.pid)
        return children.run(asked, bench.load_core, seconds + PERIOD + SETTLE)


def _add(bench: Bench, table: Table, name: str, rounds: list[Mapping[str, float]]) -> None:
    def middle(value: Callable[[Mapping[str, float]], float]) -> float:
        return measure.median([value(one) for one in rounds]) or 0.0

    cpu = middle(_percent)
    times = [middle(lambda one, key=key: one[key] / 1000) for key in ("p50", "p99", "p99.9", "longest")]  # type: ignore[misc]
    cells = [figure(value) for value in (cpu, middle(lambda one: one["server"] / one["transactions"] * 1e6), *times)]
    late, missing = (sum(int(one[key]) for one in rounds) for key in ("late", "missing"))
    bench.say(f"connections: {name:<42} {cpu:>8.1f} % of a core")
    table.rows.append((name, *cells, f"{late:,}", f"{missing:,}"))
    table.figures.append({"name": name, "cpu_percent": cpu, "rounds": rounds})


def _bars(ours: list[Mapping[str, float]]) -> list[Bar]:
    cpu = p99 = delayed = None
    with suppress(ValueError):  # nothing was measured
        cpu, p99 = max(map(_percent, ours)), max(one["p99"] / 1000 for one in ours)
        delayed = sum(one["late"] + one["missing"] for one in ours)
    return [
        Bar(f"{OURS}, {CONNECTIONS} connections, CPU of one core", cpu, "<=", 60, "%"),
        Bar(f"{OURS}, {CONNECTIONS} connections, p99", p99, "<=", 50, "ms"),
        Bar(f"{OURS}, {CONNECTIONS} connections, late or missing replies", delayed, "<=", 0, ""),
    ]


def _percent(one: Mapping[str, float]) -> float:
    return one["server"] / one["seconds"] * 100
