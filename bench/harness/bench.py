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


@dataclass(frozen=True, slots=True)
class Bench:
    """One run of the benchmark."""

    quick: bool
    rounds: int  # of every contender
    seconds: float  # counted part of one round; its warm-up comes on top
    server_core: int | None
    load_core: int | None
    programs: dict[str, Path]  # the C programs that are there
    peers_python: Path | None  # interpreter of the peers' environment
    uvloop: bool
    say: Callable[[str], None]

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
            raise ChildFailed("the peers are not installed (make peers)")
        return [self.peers_python, "-m", module, *map(str, arguments)]


def prepare(quick: bool, rounds: int | None = None, seconds: float | None = None) -> Bench:
    """Builds what can be built and finds out what is there."""
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"[{time.monotonic() - began:5.0f} s] {text}", file=sys.stderr, flush=True)

    machine.raise_file_limit()
    server_core, load_core = machine.two_cores()
    if server_core is None:
        say("fewer than two cores: nothing is pinned, and the figures say little")
    peers = ROOT / ".peers" / "bin" / "python"
    if not peers.exists():
        say("no .peers environment: the Python peers are left out (make peers)")
    return Bench(
        quick=quick,
        rounds=rounds or (3 if quick else 5),
        seconds=seconds or (0.2 if quick else 1.5),
        server_core=server_core,
        load_core=load_core,
        programs=build.programs(say),
        peers_python=peers if peers.exists() else None,
        uvloop=importlib.util.find_spec("uvloop") is not None,
        say=say,
    )
