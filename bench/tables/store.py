"""Samples kept: rows per second of CPU time beside bare SQLite inserts of the same rows, and bytes per row.

In one process on the servers' core, the best of several rounds. `offline/store.py` has the rows and what is measured.
With ``--minutes`` also for so long, while a page reads on the other core (`offline/store_long.py`).
"""

from harness import children
from harness.bench import Bench
from harness.report import Bar, Table, figure

SHARE, GOAL = 0.3, 400_000
MEGABYTE = 1e6
LARGEST_LOG = 72 * 1024 * 1024
"""Bytes: 64 MB, where a segment ends because a reader holds its log, and one commit."""
MOST_GROWTH = 300


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
    if bench.minutes is not None:
        _add_long_run(bench, table, bench.minutes)
    return table


def _add_long_run(bench: Bench, table: Table, minutes: float) -> None:
    command = bench.ours("offline.store_long", 60 * minutes, bench.load_core or 0)
    found = children.run(command, bench.server_core, 60 * minutes + 900)
    table.rows.append((f"{minutes:g} minutes while a page reads, sealed", figure(found["rows/s"]), ""))
    table.rows.append(("its slowest minute", figure(found["slowest minute, rows/s"]), ""))
    table.notes.append(
        f"{minutes:g} minutes: {found['rows']:,} samples, {found['rows/s, wall']:,.0f} a second with "
        f"{found['core']:.2f} of a core, {found['lost']} lost; largest log {found['largest log'] / MEGABYTE:.1f} MB; "
        f"memory {found['memory at first'] / MEGABYTE:.0f} MB after the first samples, "
        f"{found['memory at most'] / MEGABYTE:.0f} MB at most, {found['growth/point']:.0f} bytes more at the end "
        f"for each of 20 000 points; {found['page']['looks']} looks of the page, {found['page']['failures']} failed, "
        f"{found['page']['median']:.2f} s in the median, {found['page']['slowest']:.2f} s at most; "
        f"load {found['load'][0]:.1f}."
    )
    table.figures.append(found)
    table.bars += [
        Bar("samples stored and sealed for minutes in one core", found["rows/s"], ">=", GOAL, "/s"),
        Bar("bytes of the largest log meanwhile", found["largest log"], "<=", LARGEST_LOG, " B"),
        Bar("growth of a point meanwhile", found["growth/point"], "<=", MOST_GROWTH, " B"),
    ]
