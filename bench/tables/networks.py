"""Servers on UDP and on RTU over TCP beside TCP: FC03 for 10 registers, 16 senders with 16 requests in flight.

A datagram carries one request, so UDP takes a system call for each request and for each reply, where one read and one
write of TCP carry sixteen. RTU has a CRC, which Python computes. Ratios are of CPU time, of turns of the same round.
"""

from contextlib import ExitStack
from functools import partial

from harness import children, machine
from harness.bench import Bench
from harness.children import ChildFailed
from harness.measure import Sample, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, start

SHAPE = Shape(16, 16)
TCP, UDP, RTU = "TCP", "UDP", "RTU over TCP"
SCHEMES = {TCP: ("tcp", "tcp"), UDP: ("udp", "udp"), RTU: ("rtu+tcp", "rtu")}
"""Of each: the scheme of the server's URL, and the word of the load generator."""
STARTING = 1.5


def run(bench: Bench) -> Table:
    table = Table("Servers: UDP and RTU over TCP, 16 x 16, FC03 x 10 registers", RATE_COLUMNS)
    with ExitStack() as running:
        wanted = {
            name: partial(bench.ours, "servers.busway_server", "--scheme", scheme)
            for name, (scheme, _) in SCHEMES.items()
        }
        servers = start(bench, running, wanted)
        seconds = bench.turn(len(servers), apart=STARTING)

        def turn(name: str) -> Sample:
            server = servers[name]
            before = machine.cpu_seconds(server.pid)
            words = (server.port, SHAPE.connections, SHAPE.in_flight, SHAPE.registers, seconds, SHAPE.function)
            command = bench.program("load", "127.0.0.1", *words, SCHEMES[name][1])
            result = children.run(command, bench.load_core, seconds)
            return Sample.of(result, machine.cpu_seconds(server.pid) - before)

        found = alternate({name: partial(turn, name) for name in servers}, bench.rounds, (ChildFailed,), bench.say)
    for label, series in found.items():
        series.name = ""
        add_rates(table, label, series)
    table.bars = [
        Bar(f"{name} / TCP, CPU", ratio(found.get(name), found.get(TCP), "cpu"), "<=", limit)
        for name, limit in ((UDP, 1.5), (RTU, 1.2))
    ]
    return table
