"""Compiles the C programs of `bench/c/` into `bench/build/`, those that this machine can compile.

Rules:
1. A program is compiled again only when its source is newer.
2. A missing compiler or library is no error: the program is left out, and the tables say what they lack.
"""

import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

SOURCES = Path(__file__).parent.parent / "c"
TARGET = Path(__file__).parent.parent / "build"
FLAGS = ["-O2", "-Wall", "-Wextra"]


@dataclass(frozen=True, slots=True)
class Program:
    """A program in C: its source, the library it needs (as `pkg-config` knows it), and what the compiler is told."""

    source: str
    library: str | None = None
    flags: tuple[str, ...] = ()


PROGRAMS = {
    "floor_server": Program("floor_server"),
    "floor_tls": Program("floor_server", "openssl", ("-DTLS",)),
    "load": Program("load"),
    "load_tls": Program("load", "openssl", ("-DTLS",)),
    "paced": Program("paced"),
    "libmodbus_server": Program("libmodbus_server", "libmodbus"),
}


def programs(say: Callable[[str], None]) -> dict[str, Path]:
    """The programs that are there after building, by name; `say` hears what is left out and why."""
    compiler = shutil.which("cc")
    if compiler is None:
        say("no C compiler (cc): no load generator, no floor and no libmodbus")
        return {}
    TARGET.mkdir(exist_ok=True)
    built = {}
    for name, program in PROGRAMS.items():
        target, source = TARGET / name, SOURCES / f"{program.source}.c"
        flags = [] if program.library is None else _library_flags(program.library)
        if flags is None:
            say(f"{program.library} is not installed (pkg-config): {name} is left out")
            continue
        if not target.exists() or target.stat().st_mtime < source.stat().st_mtime:
            command = [compiler, *FLAGS, *program.flags, "-o", target, source, *flags]
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
