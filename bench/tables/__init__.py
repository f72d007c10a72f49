"""One file per table. To add one: a module with `run(bench: Bench) -> Table`, and its line here.

The budgets of a full run add up to less than ten minutes, those of a quick one to less than one. A table divides its
budget among its turns (`Bench.turn`); it says on stderr what it took.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Entry:
    """A table: its module, and the seconds that it may take.

    Attributes:
        module: below `bench/`.
        full: seconds in a full run.
        quick: seconds in a quick run; None where a quick run leaves it out, unless it is asked for by name.
        rounds: turns of each contender in a full run; fewer where to start a program takes longer than to measure it.
        alone: whether it is measured only where it is asked for by name; its seconds are not among those of a full run.
    """

    module: str
    full: float
    quick: float | None = None
    rounds: int = 5
    alone: bool = False


TABLES = {
    "server": Entry("tables.server", 84, 12),
    "mixed": Entry("tables.mixed", 20),
    "networks": Entry("tables.networks", 10),
    "client": Entry("tables.client", 56, 11, rounds=3),
    "typed": Entry("tables.typed", 12),
    "policy": Entry("tables.policy", 20, 5),
    "tls": Entry("tables.tls", 32, 6),
    "gateway": Entry("tables.gateway", 30, 4),
    "poll": Entry("tables.poll", 62, 6, rounds=2),
    "growth": Entry("tables.growth", 42, 5),
    "store": Entry("tables.store", 20, rounds=2),
    "collect": Entry("tables.collect", 12, rounds=1),
    "batches": Entry("tables.batches", 6, rounds=3),
    "codec": Entry("tables.codec", 8, 3),
    "layers": Entry("tables.layers", 8, 4, rounds=1),
    "startup": Entry("tables.startup", 10, 4),
    "memory": Entry("tables.memory", 26, rounds=1),
    "gateway_line": Entry("tables.gateway_line", 30, rounds=3),
    "line": Entry("tables.line", 52, rounds=2),
    "connections": Entry("tables.connections", 34),
    "simulator": Entry("tables.simulator", 22, rounds=1),
    "fleet": Entry("tables.fleet", 120, rounds=1, alone=True),
}
QUICK_ROUNDS = 2
ASKED_BY_NAME_SECONDS = 10.0
"""The budget in a quick run of a table that has none."""
