"""Starts the programs that are measured, and ends exactly those.

Rules:
1. A child is ended through its own handle, never by name; leaving the `with` block of a server ends it.
2. A server announces itself by a word and what it has to tell on its first line, `port N` for one on TCP, or by its
   URL as `busway serve` does; it has START seconds for that.
3. What a child says on stderr is kept and shown only when it fails.
4. Python keeps the bytecode of what it imports, as it does for every user, in a place of the benchmark's own; an
   environment that forbids it (PYTHONDONTWRITEBYTECODE) would have start-up times be those of the compiler.
"""

import json
import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

HERE = Path(__file__).parent.parent
START = 15.0  # seconds; a peer that imports much on a loaded machine needs some
STOP = 3.0

ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
ENVIRONMENT["PYTHONPYCACHEPREFIX"] = str(HERE / "build" / "bytecode")


class ChildFailed(Exception):
    """A measured program did not start, failed, or took far longer than it was told to."""


@dataclass(slots=True)
class Server:
    """A running server: its process and what it told."""

    process: subprocess.Popen[bytes]
    told: list[str]

    @property
    def port(self) -> int:
        return int(self.told[0])

    @property
    def pid(self) -> int:
        return self.process.pid

    def ask(self, number: signal.Signals, word: str) -> float:
        """Sends a signal and returns the number in the server's next line, which reads `<word> <number>`."""
        return float(self.answer(number, word)[0])

    def answer(self, number: signal.Signals, word: str) -> list[str]:
        """Sends a signal and returns what stands behind `<word>` in the server's next line."""
        self.process.send_signal(number)
        line = _line(self.process, START)
        if not line.startswith(word):
            raise ChildFailed(f"process {self.pid} said {line!r} where '{word} …' was expected")
        return line.split()[1:]


@contextmanager
def server(command: Sequence[str | Path], core: int | None, word: str = "port") -> Iterator[Server]:
    """Runs a server pinned to `core` (None: wherever) for the length of the block."""
    with tempfile.TemporaryFile() as complaints:
        process = _start(command, core, complaints)
        try:
            first = _line(process, START)
            if first.startswith("tcp://"):
                first = f"port {first.rpartition(':')[2]}"
            if not first.startswith(f"{word} "):
                raise ChildFailed(_failure(command, f"did not tell its {word} but {first!r}", complaints))
            yield Server(process, first.split()[1:])
        finally:
            _stop(process)


def run(command: Sequence[str | Path], core: int | None, seconds: float) -> dict[str, Any]:
    """Runs a program to its end and returns the JSON of its last line; it may take `seconds` and START on top."""
    with tempfile.TemporaryFile() as complaints:
        process = _start(command, core, complaints)
        try:
            output, _ = process.communicate(timeout=seconds + START)
        except subprocess.TimeoutExpired as late:
            raise ChildFailed(_failure(command, f"was not done after {seconds + START:.0f} s", complaints)) from late
        finally:
            _stop(process)
        if process.returncode != 0:
            raise ChildFailed(_failure(command, f"ended with code {process.returncode}", complaints))
        lines = output.decode().strip().splitlines()
        if not lines:
            raise ChildFailed(_failure(command, "printed no result", complaints))
        result: dict[str, Any] = json.loads(lines[-1])
        return result


def wall_seconds(command: Sequence[str | Path], core: int | None) -> float:
    """Runs a program to its end, output thrown away, and returns how long that took from start to exit, in seconds."""
    with tempfile.TemporaryFile() as complaints:
        began = time.perf_counter()
        process = _start(command, core, complaints, output=subprocess.DEVNULL)
        try:
            code = process.wait(START)
            took = time.perf_counter() - began
        except subprocess.TimeoutExpired as late:
            raise ChildFailed(_failure(command, f"was not done after {START:.0f} s", complaints)) from late
        finally:
            _stop(process)
        if code != 0:
            raise ChildFailed(_failure(command, f"ended with code {code}", complaints))
        return took


def _start(
    command: Sequence[str | Path], core: int | None, complaints: IO[bytes], output: int = subprocess.PIPE
) -> subprocess.Popen[bytes]:
    with _pinned(core):  # a child inherits the cores of its parent
        try:
            return subprocess.Popen(
                [str(part) for part in command],
                cwd=HERE,
                env=ENVIRONMENT,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=complaints,
            )
        except OSError as error:
            raise ChildFailed(f"{command[0]} could not be started: {error}") from error


@contextmanager
def _pinned(core: int | None) -> Iterator[None]:
    if core is None:
        yield
        return
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, mine)


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _line(process: subprocess.Popen[bytes], seconds: float) -> str:
    """One line of the child's output, read byte-wise from the pipe, as a buffered reader could not be waited for."""
    assert process.stdout is not None
    descriptor, line, end = process.stdout.fileno(), b"", time.monotonic() + seconds
    while not line.endswith(b"\n"):
        ready, _, _ = select.select([descriptor], [], [], max(0.0, end - time.monotonic()))
        byte = os.read(descriptor, 1) if ready else b""
        if not byte:
            break
        line += byte
    return line.decode().strip()


def _failure(command: Sequence[str | Path], what: str, complaints: IO[bytes]) -> str:
    complaints.seek(0)
    said = complaints.read().decode(errors="replace").strip()[-2000:]
    return f"{' '.join(str(part) for part in command)} {what}" + (f"\n{said}" if said else "")
