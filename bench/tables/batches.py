"""Samples of a fleet, published: an acknowledged message beside the same bytes published by nats-py alone.

A nats-server with JetStream on the servers' core, one publisher on the other. `clients/fleet_batches.py` says what is
in a message and in a turn. Encoding is part of what a message costs us, and has a row of its own.
"""

from harness import children
from harness.bench import Bench
from harness.children import ChildFailed
from harness.report import Bar, Table, figure

ABOVE_BARE = 1.3
KINDS = (("bare", "nats-py, the same bytes"), ("ours", "stream of a fleet"), ("encoding", "encoding alone"))
MICROSECONDS = 1e6


def run(bench: Bench) -> Table:
    table = Table("Fleet: an acknowledged message of samples", ("", "samples", "bytes", "µs", "µs of CPU"))
    try:
        with children.server(bench.ours("servers.nats"), bench.server_core) as server:
            turn = bench.turn(6 * bench.rounds)
            command = bench.ours("clients.fleet_batches", server.port, turn, bench.rounds)
            found = children.run(command, bench.load_core, bench.budget * 3 + 30)
    except ChildFailed as failed:
        bench.say(f"no messages of a fleet: {failed}")
        table.notes.append(f"not measured: {str(failed).splitlines()[0]}")
        return table
    for size, each in found.items():
        for kind, name in KINDS:
            table.rows.append(
                (
                    f"{size}, {name}",
                    str(each["samples"]),
                    figure(each["bytes"]),
                    figure(MICROSECONDS * each[f"{kind}, s"]),
                    figure(MICROSECONDS * each[f"{kind}, CPU s"]),
                )
            )
        for unit, word in (("s", "time"), ("CPU", "CPU")):
            name = f"message of {size} acknowledged / bare nats-py, {word}"
            table.bars.append(Bar(name, each[f"ratio, {unit}"], "<=", ABOVE_BARE, " x"))
    table.figures.append(found)
    return table
