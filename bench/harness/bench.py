"""What a table is given: the programs it may run, the cores, and how long it may take."""

import importlib.util
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from harness import build, machine
from harness.children import ChildFailed

ROOT = Path(__file__).parent.parent.parent
Command = list[str | Path]
LEAST_TURN, LONGEST_TURN = 0.05, 1.5
PEERS = ("bench/build/peers", ".peers")
"""Environments with peers, the first that is there is taken: the benchmark's own has more than the tests need."""


@dataclass(frozen=True, slots=True)
class Bench:
    """One run of the benchmark."""

    quick: bool
    rounds: int  # turns of every contender
    server_core: int | None
    load_core: int | None
    programs: dict[str, Path]  # the C programs that are there
    peers_python: Path | None  # interpreter of the peers' environment
    uvloop: bool
    say: Callable[[str], None]
    budget: float = 60.0  # seconds that the table may take
    asked_seconds: float | None = None  # by the command line, instead of what the budget leaves
    minutes: float | None = None  # how long the long run of the table ``store`` lasts; None for no such run

    def turn(self, turns: int, *, apart: float = 0.0, overhead: float = 0.06) -> float:
        """Counted seconds of one turn, so that `rounds` rounds of `turns` turns stay within the budget.

        Args:
            turns: of one round: contenders, in all shapes.
            apart: seconds of the budget that go elsewhere, to start servers for example.
            overhead: seconds that a turn takes beside its warm-up and its counted part: a program has to start.
        """
        if self.asked_seconds is not None:
            return self.asked_seconds
        left = (self.budget - apart) / (turns * self.rounds) - overhead
        counted = left / 1.2 if left > 0.6 else left - 0.1  # the warm-up is a fifth, 0.1 s at least
        return min(max(counted, LEAST_TURN), LONGEST_TURN)

    def program(self, name: str, *arguments: object) -> Command:
        """The command of a C program; ChildFailed where it could not be built."""
        if name not in self.programs:
            raise ChildFailed(f"{name} is not built")
        return [self.programs[name], *map(str, arguments)]

    def ours(self, module: str, *arguments: object) -> Command:
        """The command of a Python program of `bench/` that uses busway."""
        return [sys.executable, "-m", module, *map(str, arguments)]

    def peer(self, module: str, *arguments: object) -> Command:
        """The command of a Python program of `bench/peers/`; ChildFailed where the peers' environment is missing."""
        if self.peers_python is None:
            raise ChildFailed("the peers are not installed (make bench-peers)")
        return [self.peers_python, "-m", module, *map(str, arguments)]


def prepare(quick: bool, seconds: float | None = None) -> Bench:
    """Builds what can be built and finds out what is there."""
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"[{time.monotonic() - began:5.0f} s] {text}", file=sys.stderr, flush=True)

    machine.raise_file_limit()
    server_core, load_core = machine.two_cores()
    if server_core is None:
        say("fewer than two cores: nothing is pinned, and the figures say little")
    peers = next((found for name in PEERS if (found := ROOT / name / "bin" / "python").exists()), None)
    if peers is None:
        say("no environment with the Python peers: they are left out (make bench-peers)")
    return Bench(
        quick=quick,
        rounds=1,
        asked_seconds=seconds,
        server_core=server_core,
        load_core=load_core,
        programs=build.programs(say),
        peers_python=peers,
        uvloop=importlib.util.find_spec("uvloop") is not None,
        say=say,
    )
