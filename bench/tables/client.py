"""Clients against the floor server: transactions per second, client CPU per transaction, latency.

The floor server has one core, the client the other. FC03 for 10 registers. `await` means one await per request, in as
many tasks per connection as requests are in flight; `execute_many` hands over a batch and gets all replies together;
`blocking` is lock-step. The latency of `execute_many` is that of a whole batch (256 requests, fewer on 100 connections
and more). The load generator is the floor of a client: it checks little and keeps no result; whether it is an upper
limit on one connection has not been shown.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import Sample, Series, alternate, ratio
from harness.report import RATE_COLUMNS, Bar, Table, add_rates

REGISTERS = 10
IN_FLIGHT = 16

MANY, AWAIT, BLOCKING = "execute_many", "await", "blocking"
GENERATOR = "floor: load generator (C)"
STARTING = 0.35
"""Seconds that a client in Python takes beside what is counted, to start and to dial, on the average of the table."""

Pattern = tuple[int, int]
"""Connections × requests in flight on each."""
LONGER = {100: 2.0, 1000: 5.0}
"""Turns with many connections last longer: a round of all of them has to be short beside what is counted."""


@dataclass(frozen=True, slots=True)
class Contender:
    """A command that lacks its port and duration, and how many times as long as others it is measured."""

    command: Callable[[int, float], Command]
    longer: float = 1.0


def run(bench: Bench) -> Table:
    table = Table(f"Clients against the floor server: FC03 x {REGISTERS} registers", RATE_COLUMNS)
    contenders = {MANY: _many(bench), AWAIT: _await(bench), BLOCKING: _blocking(bench)}
    every = [one for these in contenders.values() for one in these.values()]
    apart = STARTING * len(every) * bench.rounds
    seconds = bench.turn(int(sum(one.longer for one in every)), apart=apart, overhead=0.0)
    with children.server(bench.program("floor_server"), bench.server_core) as floor:
        groups = {kind: _measure(bench, floor, kind, seconds, these) for kind, these in contenders.items()}
    for kind, group in groups.items():
        for series in group.values():
            add_rates(table, kind, series)
    table.bars = _bars(groups)
    return table


def _many(bench: Bench) -> dict[str, Contender]:
    patterns = [(16, IN_FLIGHT)] if bench.quick else [(many, IN_FLIGHT) for many in (1, 16, 100, 1000)]
    contenders: dict[str, Contender] = {}
    for pattern in patterns:
        contenders[_label(GENERATOR, pattern)] = _generator(bench, pattern)
        contenders[_label("busway", pattern)] = _ours(bench, "clients.busway_many", pattern)
        if bench.uvloop:
            contenders[_label("busway, uvloop", pattern)] = _ours(bench, "clients.busway_many", pattern, "--uvloop")
    return contenders


def _await(bench: Bench) -> dict[str, Contender]:
    patterns = [(1, IN_FLIGHT)] if bench.quick else [(1, IN_FLIGHT), (16, 1), (100, 1), (1000, 1)]
    module = "clients.busway_await"
    contenders: dict[str, Contender] = {}
    for pattern in patterns:
        contenders[_label(GENERATOR, pattern)] = _generator(bench, pattern)
        if pattern[0] <= 100:
            contenders[_label("pymodbus", pattern)] = _peer(bench, "peers.pymodbus_client", pattern)
        if pattern[0] <= 16 and not bench.quick:
            contenders[_label("modbus-rs", pattern)] = _peer(bench, "peers.modbus_rs_client", pattern)
        contenders[_label("busway", pattern)] = _ours(bench, module, pattern)
        if bench.uvloop:
            contenders[_label("busway, uvloop", pattern)] = _ours(bench, module, pattern, "--uvloop")
    if bench.quick:
        return contenders
    return contenders


def _blocking(bench: Bench) -> dict[str, Contender]:
    def peer(module: str, *words: str) -> Contender:
        return Contender(lambda port, seconds: bench.peer(module, *words, port, seconds, REGISTERS))

    others = {
        "pymodbus": peer("peers.pymodbus_client", "blocking"),
        "umodbus": peer("peers.umodbus_client"),
        "modbus-rs": peer("peers.modbus_rs_client", "blocking"),
    }
    return {
        GENERATOR: _generator(bench, (1, 1)),
        "pyModbusTCP": peer("peers.pymodbustcp_client"),
        **({} if bench.quick else others),
        "busway": Contender(lambda port, seconds: bench.ours("clients.busway_blocking", port, seconds, REGISTERS)),
    }


def _label(name: str, pattern: Pattern) -> str:
    return f"{pattern[0]:>4} x {pattern[1]:>2}  {name}"


def _ours(bench: Bench, module: str, pattern: Pattern, *options: str) -> Contender:
    def command(port: int, seconds: float) -> Command:
        return bench.ours(module, port, seconds, REGISTERS, *pattern, *options)

    return Contender(command, LONGER.get(pattern[0], 1.0))


def _peer(bench: Bench, module: str, pattern: Pattern) -> Contender:
    def command(port: int, seconds: float) -> Command:
        return bench.peer(module, "await", port, seconds, REGISTERS, *pattern)

    return Contender(command, LONGER.get(pattern[0], 1.0))


def _generator(bench: Bench, pattern: Pattern) -> Contender:
    return Contender(
        lambda port, seconds: bench.program("load", "127.0.0.1", port, *pattern, REGISTERS, seconds),
        LONGER.get(pattern[0], 1.0),
    )


def _measure(
    bench: Bench, floor: children.Server, kind: str, seconds: float, contenders: dict[str, Contender]
) -> dict[str, Series]:
    def turn(one: Contender) -> Sample:
        length = seconds * one.longer
        result = children.run(one.command(floor.port, length), bench.load_core, length)
        return Sample.of(result, result["cpu"])

    bench.say(f"client: {kind}, {seconds:.2f} s a turn")
    turns = {name: partial(turn, one) for name, one in contenders.items()}
    return alternate(turns, bench.rounds, (ChildFailed,), bench.say)


def _bars(groups: dict[str, dict[str, Series]]) -> list[Bar]:
    def rate(kind: str, name: str, pattern: Pattern) -> float | None:
        series = groups[kind].get(_label(name, pattern))
        return None if series is None else series.median("rate")

    def beside(kind: str, peer: str, name: str, pattern: Pattern) -> float | None:
        group = groups[kind]
        return ratio(group.get(_label(name, pattern)), group.get(_label(peer, pattern)), "rate")

    sixteen, one, single = (16, IN_FLIGHT), (1, IN_FLIGHT), (16, 1)
    fast = "busway, uvloop"
    blocking = groups[BLOCKING]["busway"], groups[BLOCKING]["pyModbusTCP"]
    return [
        Bar("execute_many, 16 connections", rate(MANY, "busway", sixteen), ">=", 450_000, "/s"),
        Bar("execute_many, 16 connections, uvloop", rate(MANY, fast, sixteen), ">=", 500_000, "/s"),
        Bar("execute_many, 1 x 16: busway / load generator, rate", beside(MANY, GENERATOR, "busway", one), ">=", 0.85),
        Bar("await, 16 in flight on 1 connection, uvloop", rate(AWAIT, fast, one), ">=", 100_000, "/s"),
        Bar("await, 1 x 16: busway / pymodbus, rate", beside(AWAIT, "pymodbus", "busway", one), ">=", 10),
        Bar("await, 16 x 1: busway / pymodbus, rate", beside(AWAIT, "pymodbus", "busway", single), ">=", 4),
        Bar("await, 16 x 1: busway / modbus-rs, rate", beside(AWAIT, "modbus-rs", "busway", single), ">=", 6),
        Bar("blocking: busway / pyModbusTCP, rate", ratio(*blocking, "rate"), ">=", 1.0),
        Bar("blocking: busway / pyModbusTCP, CPU", ratio(*blocking, "cpu"), "<=", 1.1),
    ]
