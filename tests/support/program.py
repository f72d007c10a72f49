"""``busway`` as a process of its own, for commands that run until they are stopped."""

import os
import select
import signal
import subprocess
import sys
from types import TracebackType
from typing import Self

LIMIT = 20.0
"""Seconds for each step: starting Python on a busy machine takes a few."""


class Busway:
    """A running ``busway``; a context manager that ends it whatever has happened.

    Args:
        arguments: of the command line.
        alone: whether it has a process group of its own, with what it starts.
    """

    def __init__(self, *arguments: str, alone: bool = False) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "busway", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=alone,
        )
        self._left = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    def wait_for(self, words: str) -> str:
        """Wait until a line of stderr has these words, and give it."""
        assert self.process.stderr is not None
        descriptor = self.process.stderr.fileno()
        while True:
            line, newline, rest = self._left.partition(b"\n")
            if newline:
                self._left = rest
                if words in line.decode():
                    return line.decode()
                continue
            readable, _, _ = select.select([descriptor], [], [], LIMIT)
            assert readable, f"nothing more on stderr, and no {words!r}"
            data = os.read(descriptor, 4096)
            assert data, f"stderr ended without {words!r}: {self._left.decode()}"
            self._left += data

    def stop(self, number: int = signal.SIGINT) -> tuple[str, str]:
        """End it by a signal; stdout, and what is left of stderr."""
        self.process.send_signal(number)
        return self.end()

    def end(self) -> tuple[str, str]:
        """Wait until it ends; stdout, and what is left of stderr."""
        out, err = self.process.communicate(timeout=LIMIT)
        return out.decode(), (self._left + err).decode()
