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
    """

    module: str
    full: float
    quick: float | None = None
    rounds: int = 5


TABLES = {
    "server": Entry("tables.server", 125, 13),
    "client": Entry("tables.client", 95, 12, rounds=3),
    "policy": Entry("tables.policy", 25, 5),
    "tls": Entry("tables.tls", 25, 6),
    "gateway": Entry("tables.gateway", 30, 4),
    "poll": Entry("tables.poll", 30, 6),
    "growth": Entry("tables.growth", 20, 4),
    "codec": Entry("tables.codec", 12, 3),
    "startup": Entry("tables.startup", 18, 4),
    "memory": Entry("tables.memory", 60),
    "gateway_line": Entry("tables.gateway_line", 35, rounds=3),
    "line": Entry("tables.line", 60),
    "connections": Entry("tables.connections", 50),
    "simulator": Entry("tables.simulator", 36, rounds=1),
}
QUICK_ROUNDS = 2
ASKED_BY_NAME_SECONDS = 10.0
"""The budget in a quick run of a table that has none."""
