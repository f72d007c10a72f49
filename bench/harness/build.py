"""Compiles the C programs of `bench/c/` into `bench/build/`, those that this machine can compile.

Rules:
1. A program is compiled again only when its source is newer.
2. A missing compiler or library is no error: the program is left out, and the tables say what they lack.
"""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

SOURCES = Path(__file__).parent.parent / "c"
TARGET = Path(__file__).parent.parent / "build"
FLAGS = ["-O2", "-Wall", "-Wextra"]
LIBRARIES: dict[str, str | None] = {"floor_server": None, "load": None, "paced": None, "libmodbus_server": "libmodbus"}


def programs(say: Callable[[str], None]) -> dict[str, Path]:
    """The programs that are there after building, by name; `say` hears what is left out and why."""
    compiler = shutil.which("cc")
    if compiler is None:
        say("no C compiler (cc): no load generator, no floor and no libmodbus")
        return {}
    TARGET.mkdir(exist_ok=True)
    built = {}
    for name, library in LIBRARIES.items():
        target, source = TARGET / name, SOURCES / f"{name}.c"
        flags = [] if library is None else _library_flags(library)
        if flags is None:
            say(f"{library} is not installed (pkg-config): {name} is left out")
            continue
        if not target.exists() or target.stat().st_mtime < source.stat().st_mtime:
            command = [compiler, *FLAGS, "-o", target, source, *flags]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                say(f"{source.name} does not compile and is left out:\n{done.stderr.strip()}")
                continue
        built[name] = target
    return built


def _library_flags(library: str) -> list[str] | None:
    finder = shutil.which("pkg-config")
    if finder is None:
        return None
    found = subprocess.run([finder, "--cflags", "--libs", library], capture_output=True, text=True, check=False)
    return found.stdout.split() if found.returncode == 0 else None
