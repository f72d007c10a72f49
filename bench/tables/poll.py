"""A large plant polled by one process: 10 000 devices, each asked for eight ranges of ten registers once a second.

The devices are played by the floor server, which has the other core: each has an address of its own (127.x.y.z), and it
listens on all of them. What counts is how much of one core the poller needs, and whether a device is asked late.
The floor is the paced load generator: as many connections, one request a second each and not eight, and no values kept;
its own CPU time stands in the table.
"""

from collections.abc import Mapping

from harness import children, measure
from harness.bench import Bench
from harness.children import ChildFailed
from harness.report import Bar, Table, figure

READS, REGISTERS, PERIOD = 8, 10, 1.0
DEVICES, QUICK_DEVICES = 10_000, 1_000
COLUMNS = ("", "per second", "CPU %", "CPU µs each", "p50 ms", "p99 ms", "p99.9 ms", "longest ms", "late", "missing")
DIALLING = 0.0008
"""Seconds for each device on top of a run, to dial and to close."""
FLOOR = "floor (C), 1 read each"


def run(bench: Bench) -> Table:
    devices = QUICK_DEVICES if bench.quick else DEVICES
    table = Table(f"One process polls {devices:,} devices, {READS} reads each, every {PERIOD:g} s", COLUMNS)
    variants: dict[str, tuple[str, ...]] = {"busway": ()}
    if bench.uvloop and not bench.quick:
        variants["busway, uvloop"] = ("--uvloop",)
    apart = (devices * DIALLING + PERIOD + 1.0) * (len(variants) + 1) * bench.rounds
    left = (bench.budget - apart) / ((len(variants) + 1) * bench.rounds)
    seconds = bench.asked_seconds or max(min(left, 5.0), 1.0)
    found: dict[str, list[Mapping[str, float]]] = {name: [] for name in (FLOOR, *variants)}
    for _ in range(bench.rounds):
        _floor(bench, devices, seconds, found[FLOOR])
        for name, options in variants.items():
            _ours(bench, name, options, devices, seconds, found[name])
    best = [_add(bench, table, name, results) for name, results in found.items()]
    each = min(filter(None, best[1:]), default=None)
    # A poller that falls behind on a busy machine asks less and needs less: the share is that of all it should ask.
    ours = None if each is None else each * devices * READS / PERIOD * 100
    late = [one["late"] + one["missing"] for name in variants for one in found[name]]
    table.bars = [
        Bar(f"{devices:,} devices, {READS} reads a second each: CPU of one core", ours, "<=", 100, "%"),
        Bar("the same: devices asked late or not at all, quietest round", min(late, default=None), "<=", 0, ""),
    ]
    return table


def _floor(bench: Bench, devices: int, seconds: float, found: list[Mapping[str, float]]) -> None:
    try:
        with children.server(bench.program("floor_server"), bench.server_core) as server:
            words = ("127.0.0.1", server.port, devices, PERIOD, seconds, server.pid)
            found.append(children.run(bench.program("paced", *words), bench.load_core, seconds + 10))
    except ChildFailed as failure:
        bench.say(f"poll: {FLOOR} is left out. {failure}")


def _ours(
    bench: Bench, name: str, options: tuple[str, ...], devices: int, seconds: float, found: list[Mapping[str, float]]
) -> None:
    try:
        with children.server(bench.program("floor_server", 0, "0.0.0.0"), bench.server_core) as server:
            words = (server.port, seconds, devices, READS, REGISTERS, *options)
            found.append(children.run(bench.ours("clients.busway_poll", *words), bench.load_core, seconds + 30))
    except ChildFailed as failure:
        bench.say(f"poll: {name} is left out. {failure}")


def _add(bench: Bench, table: Table, name: str, rounds: list[Mapping[str, float]]) -> float | None:
    """Add a row; gives the CPU seconds of a transaction."""
    if not rounds:
        table.rows.append((name, "–", *[""] * (len(COLUMNS) - 2)))
        table.figures.append({"name": name, "missing": "it failed"})
        return None

    def middle(key: str, per: str | None = None) -> float:
        return measure.median([one[key] / (one[per] if per else 1.0) for one in rounds]) or 0.0

    cpu = middle("cpu", "seconds") * 100
    times = [figure(middle(key) / 1000) for key in ("p50", "p99", "p99.9", "longest")]
    late, missing = (f"{sum(int(one[key]) for one in rounds):,}" for key in ("late", "missing"))
    each = middle("cpu", "transactions")
    table.rows.append((name, f"{middle('rate'):,.0f}", f"{cpu:.1f}", figure(each * 1e6), *times, late, missing))
    table.figures.append({"name": name, "cpu_percent": cpu, "rounds": rounds})
    bench.say(f"poll: {name:<42} {cpu:>8.1f} % of a core")
    return each
