"""A program that tests start and tell what to do: a line of JSON there, a line of JSON back.

Knows processes and pipes; knows no Modbus. What it can look at from outside is what the kernel tells of a process.

1. Every wait has a limit, and a program that ends or falls silent fails the test with what it said on stderr.
2. It is ended by its handle, and by nothing else.
"""

import json
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

LIMIT = 30.0
"""Seconds for one step of a program: starting Python on a busy machine takes a few."""
ESTABLISHED = "01"
"""The state of a connection in /proc/net/tcp."""
LONGEST_STORY = 100_000
"""Bytes of its complaints that a failure shows."""
PAUSE = 0.01
"""Seconds between two looks at the table of connections, which reports no changes."""


class Program:
    """A running program that says ``ready`` when it is, and answers each line of JSON with one."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = command
        self._complaints = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed together with the program
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._complaints, text=True, bufsize=1
        )
        self._is_ready = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    def ready(self, limit: float = LIMIT) -> None:
        """Wait until it says that it is ready, for some seconds; whatever it is asked waits for that."""
        if not self._is_ready:
            first = self._line(limit)
            assert first == "ready", self._story(f"said {first!r} instead of ready")
            self._is_ready = True

    def ask(self, do: str, **arguments: Any) -> dict[str, Any]:  # Any: whatever JSON holds
        """Have something done, and wait for its outcome."""
        self.tell(do, **arguments)
        return self.outcome()

    def tell(self, do: str, **arguments: Any) -> None:
        """Have something done, and fetch its outcome later, by `outcome`."""
        self.ready()
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, **arguments}) + "\n")

    def outcome(self) -> dict[str, Any]:
        """The outcome of what was asked first and not fetched yet."""
        answer: dict[str, Any] = json.loads(self._line())
        return answer

    def established(self, port: int) -> int:
        """Connections with ``port`` at either end that the stack of its host takes for open."""
        rows = Path(f"/proc/{self._process.pid}/net/tcp").read_text().splitlines()[1:]
        ends = f":{port:04X}"
        return sum(
            (local.endswith(ends) or remote.endswith(ends)) and state == ESTABLISHED
            for _, local, remote, state, *_ in map(str.split, rows)
        )

    def until_established(self, port: int, wanted: int, seconds: float) -> float:
        """Wait until there are so many such connections; the seconds it took. Raises `TimeoutError`."""
        began = time.monotonic()
        while self.established(port) != wanted:
            if time.monotonic() > began + seconds:
                raise TimeoutError(f"{self.established(port)} connections, not {wanted}, after {seconds:g} s")
            time.sleep(PAUSE)
        return time.monotonic() - began

    @property
    def pid(self) -> int:
        """The number of its process."""
        return self._process.pid

    @property
    def runs(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    @property
    def resident(self) -> int:
        """Bytes of memory that it has in use."""
        for line in Path(f"/proc/{self._process.pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024
        raise LookupError("the process shows no resident memory")

    @property
    def handles(self) -> int:
        """Its open files and sockets."""
        return len(list(Path(f"/proc/{self._process.pid}/fd").iterdir()))

    def complaints(self) -> str:
        """What it has said on stderr so far, and whether it still runs."""
        return self._story("runs" if self.runs else f"ended with {self._process.returncode}")

    def kill(self) -> None:
        """End it as a crash does."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with suppress(BrokenPipeError):
                pipe.close()
        self._complaints.close()

    def _line(self, limit: float = LIMIT) -> str:
        assert self._process.stdout is not None
        readable, _, _ = select.select([self._process.stdout], [], [], limit)
        assert readable, self._story(f"said nothing for {limit:g} s")
        line = self._process.stdout.readline()
        assert line, self._story("ended")
        return line.strip()

    def _story(self, what: str) -> str:
        said = os.pread(self._complaints.fileno(), LONGEST_STORY, 0).decode(errors="replace")
        return f"{' '.join(self._command)}: {what}\n{said}"
