"""Servers side by side under the load generator: what the tables of servers have in common.

Knows how servers are started and asked in turn; knows no server.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

from harness import children, machine
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample


@dataclass(frozen=True, slots=True)
class Shape:
    """What is asked: connections, requests in flight on each, registers, function."""

    connections: int
    in_flight: int
    registers: int = 10
    function: int = 3

    def __str__(self) -> str:
        return f"{self.connections:>4} x {self.in_flight:>2}"


def start(bench: Bench, running: ExitStack, wanted: Mapping[str, Callable[[], Command]]) -> dict[str, children.Server]:
    """Start every server that can be started, on the servers' core; one that cannot is said and left out."""
    started = {}
    for name, command in wanted.items():
        try:
            started[name] = running.enter_context(children.server(command(), bench.server_core))
        except ChildFailed as failure:
            bench.say(f"{name} is left out: {failure}")
    return started


def load(bench: Bench, server: children.Server, shape: Shape, seconds: float, *secrets: object) -> Sample:
    """One turn of the load generator, with the CPU time of the server meanwhile; ``secrets`` for one over TLS."""
    before = machine.cpu_seconds(server.pid)
    words = (server.port, shape.connections, shape.in_flight, shape.registers, seconds, shape.function, *secrets)
    command = bench.program("load_tls" if secrets else "load", "127.0.0.1", *words)
    result = children.run(command, bench.load_core, seconds)
    return Sample.of(result, machine.cpu_seconds(server.pid) - before)
