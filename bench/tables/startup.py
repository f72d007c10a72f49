"""Start-up times, from start to exit, in milliseconds: what a user of the library and of the command waits for.

Programs take turns, every one once a round, and are pinned to one core. Bytecode is compiled before, in one round that
does not count.
"""

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from harness import children
from harness.bench import Bench, Command
from harness.children import ChildFailed
from harness.measure import median, spread
from harness.report import Bar, Table, figure

BARE, IMPORT = "python, nothing else", "python, import busway"
TYPER, READ = "a bare typer program", "busway read, 10 registers"


def run(bench: Bench) -> Table:
    table = Table("Start-up, from start to exit", ("", "ms", "± %", "over bare python, ms"))
    rounds = 5 if bench.quick else 20
    with ExitStack() as running:
        commands = _commands(bench, running)
        times = _alternate(bench, commands, rounds)
    bare = times[BARE]
    for name, taken in times.items():
        if not taken:
            table.rows.append((name, "–", "", ""))
            table.figures.append({"name": name, "missing": "failed"})
            continue
        over = median([a - b for a, b in zip(taken, bare, strict=True)])
        off = spread(taken)
        table.rows.append((name, figure(median(taken) or 0), f"{off:.0f}", "" if name == BARE else figure(over or 0)))
        table.figures.append({"name": name, "ms": median(taken), "over_bare_ms": over, "rounds": taken})
    beside_typer = median([a / b for a, b in zip(times.get(READ, []), times[TYPER], strict=False)])
    imported = median([a - b for a, b in zip(times[IMPORT], bare, strict=False)])
    table.bars = [
        Bar("import busway over bare python", imported, "<=", 80, "ms"),
        Bar("busway read / a bare typer program", beside_typer, "<=", 1.3),
    ]
    return table


def _commands(bench: Bench, running: ExitStack) -> dict[str, Command]:
    commands: dict[str, Command] = {
        BARE: [sys.executable, "-c", "pass"],
        IMPORT: [sys.executable, "-c", "import busway"],
        TYPER: bench.ours("clients.bare_typer"),
    }
    try:
        floor = running.enter_context(children.server(bench.program("floor_server"), bench.load_core))
    except ChildFailed as failure:
        bench.say(f"startup: busway read is left out. {failure}")
        return commands
    busway = Path(sys.executable).with_name("busway")
    commands[READ] = [busway, "read", f"tcp://127.0.0.1:{floor.port}", "4x1", "--count", "10"]
    return commands


def _alternate(bench: Bench, commands: dict[str, Command], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each round; a program that fails is left out, with an empty list."""
    times: dict[str, list[float]] = {name: [] for name in commands}
    failed: set[str] = set()

    def once(name: str, keep: Callable[[float], None]) -> None:
        if name in failed:
            return
        try:
            keep(children.wall_seconds(commands[name], bench.server_core) * 1000)
        except ChildFailed as failure:
            bench.say(f"startup: {name} is left out. {failure}")
            failed.add(name)
            times[name].clear()

    for name in commands:
        once(name, lambda _: None)
    for _ in range(rounds):
        for name in commands:
            once(name, times[name].append)
    for name, taken in times.items():
        if taken:
            bench.say(f"startup: {name:<42} {median(taken):>8.1f} ms")
    return times
