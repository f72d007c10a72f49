"""Codecs alone: nanoseconds to encode and decode each message, numbers, and the check sums of serial lines.

In one process without sockets, on the servers' core; the quickest of several measurements counts. The floor is `struct`
for as many registers, or `sum` over as many bytes: what the work takes where nothing is checked or named.
"""

from harness import children
from harness.bench import Bench
from harness.report import Table, figure

STEPS = ("encode request", "decode request", "encode reply", "decode reply")


def run(bench: Bench) -> Table:
    seconds = bench.asked_seconds or max(bench.budget - 2.0, 1.0)
    found = children.run(bench.ours("offline.codecs", seconds), bench.server_core, seconds + 10)
    table = Table("Codecs, nanoseconds", ("", *STEPS))
    for name, steps in found["messages"].items():
        table.rows.append((name, *(figure(steps[step]) if step in steps else "" for step in STEPS)))
        table.figures.append({"group": "messages", "name": name} | steps)
    for name, steps in found["values"].items():
        table.rows.append((name, figure(steps["encode"]), "", "", figure(steps["decode"])))
        table.figures.append({"group": "values", "name": name} | steps)
    for name, steps in found["checks"].items():
        table.rows.append((name, figure(steps["check"]), "", "", ""))
        table.figures.append({"group": "checks", "name": name} | steps)
    table.notes.append("numbers and check sums: encoding stands in the first column, decoding in the last")
    return table
