"""What stands in for a port: a driver that answers ioctls from a table, and a pseudo-terminal."""

import errno
import os
import tty
from collections.abc import Callable
from pathlib import Path

Answer = Callable[[bytearray], None]


class FakeDriver:
    """Stands where the system's ioctl stands. What it does not know, it refuses as a driver does."""

    def __init__(self, refusal: int = errno.ENOTTY) -> None:
        self.answers: dict[int, Answer] = {}
        self.asked: list[tuple[int, bytes]] = []
        self.refusal = refusal

    def __call__(self, descriptor: int, request: int, buffer: bytearray) -> None:
        self.asked.append((request, bytes(buffer)))
        if request not in self.answers:
            raise OSError(self.refusal, "not offered")
        self.answers[request](buffer)

    def requests(self) -> list[int]:
        """The numbers of what it was asked, in order."""
        return [request for request, _ in self.asked]


def taken(_buffer: bytearray) -> None:
    """The answer of a driver that does as it is told."""


def giving(data: bytes) -> Answer:
    """The answer of a driver that fills the buffer."""

    def answer(buffer: bytearray) -> None:
        buffer[: len(data)] = data

    return answer


class Pty:
    """A pseudo-terminal whose near end the test holds.

    ``name``: a path of the test's own that leads to it until it vanishes. The numbers of pseudo-terminals belong to the
    machine, and one that was given back may be another program's a moment later.
    """

    def __init__(self, name: Path | None = None) -> None:
        self.near, far = os.openpty()
        tty.setraw(far)
        self.path = os.ttyname(far)
        self._far: int | None = far
        self._name = name
        if name is not None:
            name.symlink_to(self.path)
            self.path = str(name)

    def vanish(self) -> None:
        """Take it away from the process that has the far end open."""
        os.close(self.near)
        self._close_far()
        self.near = -1
        if self._name is not None:
            self._name.unlink()

    def close(self) -> None:
        if self.near >= 0:
            self.vanish()

    def _close_far(self) -> None:
        if self._far is not None:
            os.close(self._far)
            self._far = None
