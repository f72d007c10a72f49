"""Foreign Modbus programs as objects: built, started, spoken to and ended. Knows nothing of the library under test.

1. A program that is not there skips its tests and says why; with ``BUSWAY_REQUIRE_PEERS=1`` that is a failure.
2. A program says ``ready …`` when it can be spoken to; nothing waits for a length of time.
3. Every wait has a limit, and every program is ended by the one who started it, by its handle.
"""

import json
import select
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from missing_peers import missing as missing

HERE = Path(__file__).parent
CHECKOUT = HERE.parents[1]
PEERS = HERE / "peers"
BUILD = HERE / "build"
PEER_PYTHON = CHECKOUT / ".peers" / "bin" / "python"

LIMIT = 30.0
"""Seconds for one step of a foreign program: starting a Python one on a busy machine takes a few."""

ITEMS = 1000
CONTENT: dict[str, list[int]] = {
    "holding_registers": [(address * 7 + 3) & 0xFFFF for address in range(ITEMS)],
    "input_registers": [(address * 11 + 5) & 0xFFFF for address in range(ITEMS)],
    "coils": [address % 3 == 0 for address in range(ITEMS)],
    "discrete_inputs": [address % 5 == 0 for address in range(ITEMS)],
}
"""What every server of these tests holds at first, ours and the foreign ones (``peers/conversation.py``)."""

IDENTITY: dict[int, bytes] = {
    0x00: b"Acme",
    0x01: b"PX-1",
    0x02: b"2.5",
    0x03: b"https://acme.example",
    0x04: b"Pump",
    0x05: b"P",
    0x06: b"Hall 3",
}


class Program:
    """A running foreign program; a context manager that ends it."""

    def __init__(self, command: Sequence[str | Path]) -> None:
        self.command = [str(word) for word in command]
        self._complaints = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed together with the program
        pipe = subprocess.PIPE
        try:
            self._process = subprocess.Popen(
                self.command, stdin=pipe, stdout=pipe, stderr=self._complaints, text=True, bufsize=1
            )
        except OSError:
            self._complaints.close()
            raise
        try:
            first = self.line()
            assert first.startswith("ready"), self._story(f"it said {first!r} instead of ready")
        except BaseException:
            self.close()
            raise
        self.ready = first.removeprefix("ready").strip()
        """What the program says of itself when it is ready: a server its port."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def url(self) -> str:
        """Where a server that is ready can be reached."""
        return f"tcp://127.0.0.1:{self.ready}"

    def ask(self, command: str) -> dict[str, Any]:
        """Send a client one command line; its answer, as ``peers/conversation.py`` describes."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.line())
        return answer

    def line(self) -> str:
        """The next line that the program prints, within the limit. It prints exactly one for each question."""
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], LIMIT)
        assert readable, self._story(f"it said nothing for {LIMIT:g} s")
        line = self._process.stdout.readline()
        assert line, self._story("it ended")
        return line.strip()

    def close(self) -> None:
        """End the program, by force if it does not go."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.terminate()
        try:
            self._process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdin.close()
        self._process.stdout.close()
        self._complaints.close()

    def _story(self, what: str) -> str:
        self._complaints.seek(0)
        return f"{' '.join(self.command)}: {what}\n{self._complaints.read()}"


def python_peer(script: str, *arguments: object) -> Program:
    """Start a Python peer in the peers' own environment."""
    if not PEER_PYTHON.exists():
        missing(f"no {PEER_PYTHON.relative_to(CHECKOUT)}: run make peers")
    return Program([PEER_PYTHON, PEERS / script, *map(str, arguments)])


def c_peer(name: str, *arguments: object) -> Program:
    """Compile a C peer if its source is newer than its program, and start it."""
    return Program([compiled(name), *map(str, arguments)])


def compiled(name: str) -> Path:
    """The program made of ``peers/NAME.c`` and libmodbus."""
    source, program = PEERS / f"{name}.c", BUILD / name
    if program.exists() and program.stat().st_mtime > source.stat().st_mtime:
        return program
    compiler = shutil.which("cc") or shutil.which("gcc")
    finder = shutil.which("pkg-config")
    if compiler is None or finder is None:
        missing("no C compiler or no pkg-config (Debian: gcc, pkg-config)")
    found = subprocess.run([finder, "--cflags", "--libs", "libmodbus"], capture_output=True, text=True, check=False)
    if found.returncode != 0:
        missing("no libmodbus to compile against (Debian: libmodbus-dev)")
    BUILD.mkdir(exist_ok=True)
    # Another process of the tests may compile the same program now, or start it: it is whole, or not there.
    with tempfile.TemporaryDirectory(dir=BUILD) as folder:
        made = Path(folder) / name
        options = ["-Wall", "-Wextra", "-Werror", "-O1"]
        subprocess.run([compiler, *options, "-o", made, source, *found.stdout.split()], check=True)
        made.replace(program)
    return program
