"""What an access policy and an audit log cost a server: reads with and without a policy, writes that are written down.

16 connections with 16 requests in flight: FC03 for 10 registers, FC06. The policy has twelve rules; the one that
permits is about a network and a range of registers, so that hosts, units and addresses are all looked at. The audit log
is a file in a directory for temporary files. The floor looks at nothing.

What a policy costs a read is a few per cent of a time that swings by more than that from one second to the next. So it
is taken from many turns of a sixth of a second, with the policy and without it in pairs, each one right after the other
and in front by turns; the figure is the median of the pairs' ratios.
"""

import tempfile
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from harness.bench import LEAST_TURN, Bench
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, in_pairs, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

READS, WRITES = Shape(16, 16), Shape(16, 16, function=6)
FLOOR, PLAIN, POLICY, AUDIT = "floor (C)", "busway", "busway, policy", "busway, policy and audit"
AUDIT_UVLOOP = "busway, uvloop, policy and audit"
STARTING = 3.0
PAIRS, QUICK_PAIRS = 4, 2
"""Pairs of each round."""
PAIR_TURN = LEAST_TURN + 0.16
"""Seconds of one turn of a pair, with its warm-up, which counts for CPU time as well, and the start of the load."""


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
        paired = {name: servers.pop(name) for name in (PLAIN, POLICY) if name in servers}
        pairs = bench.rounds * (QUICK_PAIRS if bench.quick else PAIRS)
        turns_of_a_round = 2 * len(servers) + len(paired)
        seconds = bench.turn(turns_of_a_round, apart=STARTING + pairs * len(paired) * PAIR_TURN)
        bench.say(f"policy: {pairs} pairs of {LEAST_TURN:.2f} s, other turns of {seconds:.2f} s")
        both = {name: partial(load, bench, server, READS, LEAST_TURN) for name, server in paired.items()}
        alone = {name: partial(load, bench, server, READS, seconds) for name, server in servers.items()}
        every = {**paired, **servers}
        writes = {name: partial(load, bench, server, WRITES, seconds) for name, server in every.items()}
        results[READS] = in_pairs(both, pairs, (ChildFailed,), bench.say) | _in_turns(bench, alone)
        results[WRITES] = _in_turns(bench, writes)
    for shape, label in ((READS, "FC03"), (WRITES, "FC06")):
        for name in wanted:
            if name in results[shape]:
                add_rates(table, label, results[shape][name])
    audited = [results[WRITES][name].median("rate") for name in (AUDIT, AUDIT_UVLOOP) if name in results[WRITES]]
    table.bars = [
        Bar("FC03 with a policy: CPU per transaction above that without", _above(results[READS]), "<=", 15, "%"),
        Bar("FC06 with a policy and an audit log", max(filter(None, audited), default=None), ">=", 100_000, "/s"),
    ]
    table.notes.append(_note(results[READS]))
    return table


def _in_turns(bench: Bench, turns: Mapping[str, Callable[[], Sample]]) -> dict[str, Series]:
    return alternate(turns, bench.rounds, (ChildFailed,), bench.say)


def _above(reads: Mapping[str, Series]) -> float | None:
    times = ratio(reads.get(POLICY), reads.get(PLAIN), "cpu")
    return None if times is None else (times - 1) * 100


def _note(reads: Mapping[str, Series]) -> str:
    """How the first bar came about."""
    mine, theirs = (reads[name].values("cpu") if name in reads else [] for name in (POLICY, PLAIN))
    each = sorted((a / b - 1) * 100 for a, b in zip(mine, theirs, strict=False))
    if not each:
        return "what a policy costs a read was not measured"
    low, high = each[len(each) // 4], each[-1 - len(each) // 4]
    return (
        f"what a policy costs a read: median of {len(each)} pairs of turns, one right after the other, "
        f"half of them between {low:+.0f} and {high:+.0f} %"
    )
