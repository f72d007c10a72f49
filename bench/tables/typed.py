"""Typed values of a device: 100 mixed points by `read_many`, beside one request for each by `execute_many`.

The floor server has one core, the client the other; 16 in flight, 1 and 16 connections. The figures are values, not
transactions: `read_many` asks for all 100 with two requests, `execute_many` with 100. Growth is that of the CPU time of
a value from 1 to 16 connections.
"""

import math
from functools import partial

from harness import children
from harness.bench import Bench
from harness.children import ChildFailed
from harness.measure import Sample, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates

TOGETHER, APART = "read_many", "execute_many"
WAYS = {TOGETHER: "together", APART: "apart"}
CONNECTIONS = (1, 16)
STARTING = 0.4


def run(bench: Bench) -> Table:
    table = Table("Typed values: 100 mixed points of a device", RATE_COLUMNS)
    seconds = bench.turn(len(CONNECTIONS) * len(WAYS), apart=STARTING * len(CONNECTIONS) * len(WAYS) * bench.rounds)
    with children.server(bench.program("floor_server"), bench.server_core) as floor:

        def turn(way: str, connections: int) -> Sample:
            command = bench.ours("clients.busway_typed", floor.port, seconds, way, connections)
            result = children.run(command, bench.load_core, seconds)
            return Sample.of(result, result["cpu"])

        found = alternate(
            {f"{many:>3}  {name}": partial(turn, way, many) for many in CONNECTIONS for name, way in WAYS.items()},
            bench.rounds,
            (ChildFailed,),
            bench.say,
        )
    for label, series in found.items():
        series.name = ""
        add_rates(table, label, series)
    few, many = (found.get(f"{count:>3}  {TOGETHER}") for count in CONNECTIONS)
    grown = ratio(many, few, "cpu")
    table.bars = [
        *(
            Bar(
                f"read_many / execute_many, {count} connection{'s' * (count > 1)}",
                ratio(found.get(f"{count:>3}  {TOGETHER}"), found.get(f"{count:>3}  {APART}"), "rate"),
                ">=",
                3.0,
            )
            for count in CONNECTIONS
        ),
        Bar(f"read_many, {CONNECTIONS[1]} connections", many.median("rate") if many else None, ">=", 1_500_000, "/s"),
        Bar(
            "growth of CPU per value with connections, exponent",
            math.log(grown) / math.log(CONNECTIONS[1] / CONNECTIONS[0]) if grown else None,
            "<=",
            0.1,
        ),
    ]
    return table
