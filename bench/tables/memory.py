"""What an idle connection costs a server, with 1000 of them.

A few connections come first, so that what a server imports and allocates once is there already. Each connection makes
one transaction and then rests. Two figures: growth of the resident memory of the process (without the kernel's sockets,
and without what the process had free before, so it can be too low), and, in a second run, living Python objects as
`tracemalloc` counts them. The bar takes the larger one.
"""

import socket
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from signal import SIGUSR2

from harness import children, machine
from harness.bench import Bench, Command
from harness.children import ChildFailed, Server
from harness.report import Bar, Table, figure

FIRST, CONNECTIONS = 10, 1000  # together below 1024, the most that libmodbus' select() can wait for
REQUEST = bytes.fromhex("0001 0000 0006 01 03 0000 000A")  # FC03, unit 1, 10 registers from 0
REPLY_SIZE = 7 + 2 + 20

OURS = "busway"


def run(bench: Bench) -> Table:
    table = Table(f"Memory per idle connection, {CONNECTIONS} connections", ("", "resident KB", "Python objects KB"))
    larger: dict[str, float] = {}
    for name, command, traced in _contenders(bench):
        try:
            rounds = [_cost(bench, command(), _resident) for _ in range(1 if bench.quick else 3)]
            resident = statistics.median(rounds)
            objects = _cost(bench, [*command(), "--trace-memory"], _traced) if traced else None
        except (ChildFailed, OSError) as failure:
            bench.say(f"memory: {name} is left out. {failure}")
            table.rows.append((name, "–", "–"))
            table.figures.append({"name": name, "missing": str(failure)})
            continue
        larger[name] = max(resident, objects or 0.0)
        bench.say(f"memory: {name:<42} {resident:>8.1f} KB")
        table.rows.append((name, figure(resident), "" if objects is None else figure(objects)))
        table.figures.append({"name": name, "resident_kb": resident, "rounds": rounds, "objects_kb": objects})
    table.bars = [Bar("busway, memory per idle connection", larger.get(OURS), "<=", 10, "KB")]
    return table


def _contenders(bench: Bench) -> list[tuple[str, Callable[[], Command], bool]]:
    """Name, command, and whether its Python objects are counted (a quick run counts only ours: it takes long)."""
    contenders: list[tuple[str, Callable[[], Command], bool]] = [
        ("floor (C)", lambda: bench.program("floor_server"), False),
        ("libmodbus (C)", lambda: bench.program("libmodbus_server"), False),
        ("pymodbus", lambda: bench.peer("peers.pymodbus_server"), not bench.quick),
        (OURS, lambda: bench.ours("servers.busway_server"), True),
    ]
    if bench.uvloop:
        contenders.append(("busway, uvloop", lambda: bench.ours("servers.busway_server", "--uvloop"), True))
    return contenders


def _cost(bench: Bench, command: Command, measure: Callable[[Server], float]) -> float:
    """KB per connection between FIRST and FIRST + CONNECTIONS connections."""
    with (
        children.server(command, bench.server_core) as server,
        _idle(server.port, FIRST),
    ):
        before = measure(server)
        with _idle(server.port, CONNECTIONS):
            return (measure(server) - before) / CONNECTIONS / 1024


@contextmanager
def _idle(port: int, count: int) -> Iterator[None]:
    links: list[socket.socket] = []
    try:
        for _ in range(count):
            link = socket.create_connection(("127.0.0.1", port), timeout=5)
            links.append(link)
            link.sendall(REQUEST)
            reply = b""
            while len(reply) < REPLY_SIZE:
                part = link.recv(REPLY_SIZE - len(reply))
                if not part:
                    raise ChildFailed(f"the server closed connection {len(links)} of {count}")
                reply += part
        yield
        for number, link in enumerate(links, 1):  # a server that made room for newer ones did not hold them all
            link.settimeout(0)
            try:
                link.recv(1)
            except BlockingIOError:
                continue
            raise ChildFailed(f"the server closed connection {number} of {count} while it was idle")
    finally:
        for link in links:
            link.close()


def _resident(server: Server) -> float:
    time.sleep(0.1)  # an event loop may still be busy with what it does after a reply
    return machine.resident_bytes(server.pid)


def _traced(server: Server) -> float:
    return server.ask(SIGUSR2, "traced")
