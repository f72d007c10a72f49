"""Servers over TLS under the load generator, which speaks TLS for it: the same load as on TCP.

Both sides show certificates of one authority (P-256, made for the run), TLS 1.3 as OpenSSL chooses it. FC03 for 10
registers. The floor is a minimal server in C over the same OpenSSL; the bare loop is Python's own TLS with nothing
behind it, the least that a server in Python can take. With one request in flight busway on TCP stands beside it.
"""

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates
from harness.serving import Shape, load, start

from busway.testing.certificates import CertificateFiles, CertificateStore

FULL, SINGLE = Shape(16, 16), Shape(16, 1)
SHAPES = (FULL, SINGLE, Shape(1, 1))
FLOOR, PYMODBUS, OURS, OURS_UVLOOP = "floor (C)", "pymodbus", "busway", "busway, uvloop"
BARE = "bare loop, checks nothing"
PLAIN = "busway, TCP without TLS"
STARTING = 3.0


def run(bench: Bench) -> Table:
    table = Table("Servers over TLS: FC03 x 10 registers", RATE_COLUMNS)
    results: dict[Shape, dict[str, Series]] = {}
    shapes = SHAPES[:1] if bench.quick else SHAPES
    with ExitStack() as running:
        store = CertificateStore(Path(running.enter_context(tempfile.TemporaryDirectory())))
        servers = start(bench, running, _contenders(bench, _paths(store.server())))
        seconds = bench.turn(len(shapes) * len(servers) + 1, apart=STARTING, overhead=0.12)
        client = _paths(store.client())
        plain = start(bench, running, {PLAIN: lambda: bench.ours("servers.busway_server")})
        for shape in shapes:
            bench.say(f"tls: {shape}, {seconds:.2f} s a turn")
            turns: dict[str, Callable[[], Sample]] = {
                name: partial(load, bench, server, shape, seconds, *client) for name, server in servers.items()
            }
            if shape == SINGLE:
                turns |= {name: partial(load, bench, server, shape, seconds) for name, server in plain.items()}
            results[shape] = alternate(turns, bench.rounds, (ChildFailed,), bench.say)
            for series in results[shape].values():
                add_rates(table, str(shape), series)
    full, single = results[FULL], results.get(SINGLE, {})
    table.bars = [
        Bar("16 x 16 over TLS: busway / pymodbus, rate", ratio(full.get(OURS), full.get(PYMODBUS), "rate"), ">=", 5),
        Bar("16 x 1: over TLS / over TCP, rate", ratio(single.get(OURS), single.get(PLAIN), "rate"), ">=", 0.75),
    ]
    return table


def _contenders(bench: Bench, files: tuple[Path, ...]) -> dict[str, Callable[[], Command]]:
    wanted: dict[str, Callable[[], Command]] = {
        FLOOR: lambda: bench.program("floor_tls", *files),
        BARE: lambda: bench.ours("servers.bare_loop", "--tls", *files),
        PYMODBUS: lambda: bench.peer("peers.pymodbus_tls_server", *files),
        OURS: lambda: bench.ours("servers.busway_server", "--tls", *files),
    }
    if bench.uvloop:
        wanted[OURS_UVLOOP] = lambda: bench.ours("servers.busway_server", "--uvloop", "--tls", *files)
    return wanted


def _paths(files: CertificateFiles) -> tuple[Path, ...]:
    return files.certificate, files.key, files.authority
