"""What an access policy and an audit log cost a server: reads with and without a policy, writes that are written down.

16 connections with 16 requests in flight: FC03 for 10 registers, FC06. The policy has twelve rules; the one that
permits is about a network and a range of registers, so that hosts, units and addresses are all looked at. The audit log
is a file in a directory for temporary files. The floor looks at nothing.
"""

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from harness.bench import Bench
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

READS, WRITES = Shape(16, 16), Shape(16, 16, function=6)
FLOOR, PLAIN, POLICY, AUDIT = "floor (C)", "busway", "busway, policy", "busway, policy and audit"
AUDIT_UVLOOP = "busway, uvloop, policy and audit"
STARTING = 3.0


def run(bench: Bench) -> Table:
    table = Table("Access policy and audit log, 16 x 16", RATE_COLUMNS)
    results: dict[Shape, dict[str, Series]] = {}
    with ExitStack() as running:
        folder = Path(running.enter_context(tempfile.TemporaryDirectory()))
        guarded = ("--policy", "--audit")
        wanted = {
            FLOOR: lambda: bench.program("floor_server"),
            PLAIN: lambda: bench.ours("servers.busway_server"),
            POLICY: lambda: bench.ours("servers.busway_server", "--policy"),
            AUDIT: lambda: bench.ours("servers.busway_server", *guarded, folder / "audit"),
        }
        if bench.uvloop and not bench.quick:
            wanted[AUDIT_UVLOOP] = lambda: bench.ours("servers.busway_server", "--uvloop", *guarded, folder / "uvloop")
        servers = start(bench, running, wanted)
        seconds = bench.turn(2 * len(servers), apart=STARTING)
        for shape, label in ((READS, "FC03"), (WRITES, "FC06")):
            bench.say(f"policy: {label}, {seconds:.2f} s a turn")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(load, bench, server, shape, seconds) for name, server in servers.items()
            }
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, label, series)
    audited = [results[WRITES][name].median("rate") for name in (AUDIT, AUDIT_UVLOOP) if name in results[WRITES]]
    table.bars = [
        Bar("FC03 with a policy: CPU per transaction above that without", _above(results[READS]), "<=", 15, "%"),
        Bar("FC06 with a policy and an audit log", max(filter(None, audited), default=None), ">=", 100_000, "/s"),
    ]
    return table


def _above(reads: dict[str, Series]) -> float | None:
    times = ratio(reads.get(POLICY), reads.get(PLAIN), "cpu")
    return None if times is None else (times - 1) * 100
