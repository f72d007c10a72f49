"""What an idle connection costs a server, with 1000, 5000 and 10 000 of them.

A few connections come first, so that what a server imports and allocates once is there already. Each connection makes
one transaction and then rests. Two figures: growth of the resident memory of the process (without the kernel's sockets,
and without what the process had free before, so it can be too low), and, in a second run, living Python objects as
`tracemalloc` counts them, those that Python itself makes for a connection included. The bar takes the larger one.

Beside them, the whole of `busway serve` as a user runs it: its resident memory with 10 000 connections and 250 units,
each with 100 holding registers; how much a connection beyond the first 1000 takes of it; and four such servers in one
process (`servers.busway_four_plants`), which have 1000 units.
"""

import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from signal import SIGUSR2

from harness import children, machine
from harness.bench import Bench, Command
from harness.children import ChildFailed, Server
from harness.report import Bar, Table, figure
from offline.timing import exponent

FIRST = 10
CONNECTIONS = (1000, 5000, 10_000)
QUICK_CONNECTIONS = (1000,)
SELECT_LIMIT = 1000  # libmodbus waits with select(), which knows 1024 descriptors
PEER_LIMIT = 5000  # of connections to peers in Python: they take seconds to accept more
REQUEST = bytes.fromhex("0001 0000 0006 01 03 0000 000A")  # FC03, unit 1, 10 registers from 0
REPLY_SIZE = 7 + 2 + 20

WHOLE = "busway serve, the whole process"
FOUR, SERVERS = "four such servers, one process", 4
UNITS = 250
BEYOND = 2500
"""Connections of the first step beyond 1000; the first thousand may take memory that the process had free."""
FLAT = 0.1
PLANT = f"[server]\nmax_connections = {CONNECTIONS[-1] + FIRST}\n" + "".join(
    f"[[unit]]\nunit = {unit}\nholding_registers = 100\n" for unit in range(1, UNITS + 1)
)
OURS, OURS_UVLOOP = "busway", "busway, uvloop"


@dataclass(frozen=True, slots=True)
class Contender:
    """A server: its command, how many connections it is given at most, and whether its Python objects are counted."""

    command: Callable[[], Command]
    limit: int = CONNECTIONS[-1]
    traced: bool = False


def run(bench: Bench) -> Table:
    sizes = QUICK_CONNECTIONS if bench.quick else CONNECTIONS
    columns = [f"{kind} KB, {size:,}" for kind in ("resident", "objects") for size in sizes]
    table = Table("Memory per idle connection", ("", *columns))
    larger: dict[tuple[str, int], float] = {}
    for name, contender in _contenders(bench).items():
        within = [size for size in sizes if size <= contender.limit]
        try:
            resident = _cost(bench, contender.command(), within, _resident)
            objects = {}
            if contender.traced:
                objects = _cost(bench, [*contender.command(), "--trace-memory"], within, _traced)
        except (ChildFailed, OSError) as failure:
            bench.say(f"memory: {name} is left out. {failure}")
            table.rows.append((name, "–", *[""] * (len(columns) - 1)))
            table.figures.append({"name": name, "missing": str(failure)})
            continue
        for size in within:
            larger[name, size] = max(resident[size], objects.get(size, 0.0))
            bench.say(f"memory: {name}, {size} connections: {resident[size]:.1f} KB")
        cells = [figure(found[size]) if size in found else "" for found in (resident, objects) for size in sizes]
        table.rows.append((name, *cells))
        table.figures.append({"name": name, "resident_kb": resident, "objects_kb": objects})
    most = sizes[-1]
    whole, growth = _whole(bench, table, [CONNECTIONS[0], BEYOND, *CONNECTIONS[1:]] if most > BEYOND else [most])
    four = _four(bench, table, most)
    table.notes.append(
        f"{WHOLE}, has {UNITS} units: a unit identifier is one byte, and all listeners of a server show the units of "
        f"its file, so {SERVERS * UNITS:,} units are {SERVERS} such servers; they are measured in one process."
    )
    together = f"{most:,} connections, {SERVERS * UNITS:,} units"
    table.bars = [
        Bar(f"{most:,} connections held, memory of each", larger.get((OURS, most)), "<=", 8, "KB"),
        Bar(f"{WHOLE}: {most:,} connections, {UNITS} units", whole, "<=", 60, "MB"),
        Bar(f"{FOUR}: {together}", four, "<=", 60, "MB"),
        Bar("busway serve, bytes of a connection beyond the first 1,000: exponent", growth, "<=", FLAT, ""),
    ]
    return table


def _whole(bench: Bench, table: Table, sizes: Sequence[int]) -> tuple[float | None, float | None]:
    """Resident MB of `busway serve` with all units and connections, and the exponent of the bytes of a connection.

    None for what cannot be had.
    """
    found: dict[int, float] = {}
    command = [sys.executable, "-m", "busway", "serve", "--listen", "tcp://127.0.0.1:0", "--control", "off"]
    try:
        with _plant() as plant, children.server([*command, plant], bench.server_core) as server, _links() as links:
            for size in sizes:
                _dial(links, [server.port], size - len(links))
                found[size] = _resident(server)
            _all_stand(links)
    except (ChildFailed, OSError) as failure:
        bench.say(f"memory: {WHOLE} is left out. {failure}")
        return None, None
    first, *beyond = sizes
    each = {size: (found[size] - found[first]) / (size - first) for size in beyond}
    if each:
        told = ", ".join(f"{cost:,.0f} up to {size:,}" for size, cost in each.items())
        table.notes.append(f"busway serve, bytes of a connection beyond the first {first:,}: {told}.")
    megabytes = {size: resident / 1e6 for size, resident in found.items()}
    table.figures.append({"name": WHOLE, "units": UNITS, "resident_mb": megabytes, "bytes_beyond": each})
    grows = min(each.values(), default=0) > 0
    return megabytes[sizes[-1]], exponent(list(each), list(each.values())) if grows else None


def _four(bench: Bench, table: Table, connections: int) -> float | None:
    """Resident MB of a process with four such servers, which share the connections; None if it cannot be had."""
    try:
        with _plant() as plant, _links() as links:
            command = bench.ours("servers.busway_four_plants", plant)
            with children.server(command, bench.server_core) as server:
                _dial(links, list(map(int, server.told)), connections)
                resident = _resident(server) / 1e6
                _all_stand(links)
    except (ChildFailed, OSError) as failure:
        bench.say(f"memory: {FOUR} is left out. {failure}")
        return None
    table.figures.append({"name": FOUR, "connections": connections, "units": SERVERS * UNITS, "resident_mb": resident})
    return resident


@contextmanager
def _plant() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        plant = Path(folder) / "plant.toml"
        plant.write_text(PLANT)
        yield plant


def _contenders(bench: Bench) -> dict[str, Contender]:
    contenders = {
        "floor (C)": Contender(lambda: bench.program("floor_server")),
        "bare loop, checks nothing": Contender(lambda: bench.ours("servers.bare_loop")),
        "libmodbus (C)": Contender(lambda: bench.program("libmodbus_server"), SELECT_LIMIT),
        "pymodbus": Contender(lambda: bench.peer("peers.pymodbus_server"), PEER_LIMIT),
        OURS: Contender(lambda: bench.ours("servers.busway_server"), traced=True),
    }
    if bench.uvloop:
        contenders[OURS_UVLOOP] = Contender(lambda: bench.ours("servers.busway_server", "--uvloop"))
    return contenders


def _cost(bench: Bench, command: Command, sizes: Sequence[int], measure: Callable[[Server], float]) -> dict[int, float]:
    """KB per connection above FIRST, for each number of connections; they stay while others come."""
    with children.server(command, bench.server_core) as server, _links() as links:
        _dial(links, [server.port], FIRST)
        before = measure(server)
        cost = {}
        for size in sizes:
            _dial(links, [server.port], FIRST + size - len(links))
            cost[size] = (measure(server) - before) / size / 1024
        _all_stand(links)
        return cost


@contextmanager
def _links() -> Iterator[list[socket.socket]]:
    links: list[socket.socket] = []
    try:
        yield links
    finally:
        for link in links:
            link.close()


def _dial(links: list[socket.socket], ports: Sequence[int], count: int) -> None:
    """Open so many more connections, to one port after the other, and make a transaction on each."""
    for _ in range(count):
        link = socket.create_connection(("127.0.0.1", ports[len(links) % len(ports)]), timeout=5)
        links.append(link)
        link.sendall(REQUEST)
        reply = b""
        while len(reply) < REPLY_SIZE:
            part = link.recv(REPLY_SIZE - len(reply))
            if not part:
                raise ChildFailed(f"the server closed connection {len(links)}")
            reply += part


def _all_stand(links: list[socket.socket]) -> None:
    """A server that made room for newer connections did not hold them all."""
    for number, link in enumerate(links, 1):
        link.settimeout(0)
        try:
            link.recv(1)
        except BlockingIOError:
            continue
        raise ChildFailed(f"the server closed connection {number} of {len(links)} while it was idle")


def _resident(server: Server) -> float:
    time.sleep(0.1)  # an event loop may still be busy with what it does after a reply
    return machine.resident_bytes(server.pid)


def _traced(server: Server) -> float:
    return server.ask(SIGUSR2, "traced")
