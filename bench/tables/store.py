"""Samples kept: rows per second of CPU time beside bare SQLite inserts of the same rows, and bytes per row.

In one process on the servers' core, the best of several rounds. `offline/store.py` has the rows and what is measured.
"""

from harness import children
from harness.bench import Bench
from harness.report import Bar, Table, figure

SHARE, GOAL = 0.3, 400_000


def run(bench: Bench) -> Table:
    found = children.run(bench.ours("offline.store", bench.rounds), bench.server_core, bench.budget * 3 + 60)
    table = Table("Samples kept, all columns", ("", "rows/s of CPU", "bytes/row"))
    bare, ours, whole = found["bare"]["rows/s"], found["written"], found.get("committed")
    table.rows.append(("bare SQLite, rows made before", figure(bare), ""))
    table.rows.append(("store, commits", figure(ours["rows/s"]), figure(ours["bytes/row"])))
    if whole is not None:
        table.rows.append(("store, thread that commits", figure(whole["rows/s"]), ""))
        table.rows.append(("sealing into Parquet", figure(whole["sealing rows/s"]), figure(whole["sealed bytes/row"])))
        table.rows.append(("store, commits and sealing", figure(whole["with sealing rows/s"]), ""))
        table.rows.append(("reading one device of sealed parts", figure(whole["read rows/s, one device"]), ""))
        table.rows.append(("summing up into buckets", figure(whole["rows/s into buckets"]), ""))
    table.figures.append(found)
    rate = None if whole is None else whole["rows/s"]
    table.bars = [
        Bar(
            "samples stored, thread and columns, against bare inserts",
            None if rate is None else rate / bare,
            ">=",
            SHARE,
        ),
        Bar("samples stored in one core", rate, ">=", GOAL, "/s"),
        Bar("samples stored and sealed in one core", whole and whole["with sealing rows/s"], ">=", GOAL, "/s"),
    ]
    return table
