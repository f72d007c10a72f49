"""Lock of a serial port against other programs, and the name of the program that holds it.

Knows the lock that `serialx` takes on an open port (``flock``), the system's refusal of a second opening (``TIOCEXCL``)
and where Linux lists locks and open files; knows no Modbus. On other systems the lock works, but the other program
cannot be named.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from .ioctl import Ioctl, asked, system_ioctl

TIOCEXCL = 0x540C
TIOCNXCL = 0x540D

PROCESSES = Path("/proc")


@dataclass(frozen=True, slots=True)
class Holder:
    """The program that has a serial port open or locked.

    Attributes:
        process: its process number.
        command: its command line, at most 200 characters; empty if this user is not allowed to see it.
        ourselves: whether it is this process.
    """

    process: int
    command: str = ""
    ourselves: bool = False

    def __str__(self) -> str:
        if self.ourselves:
            return f"this program itself (process {self.process})"
        return f"process {self.process} ({self.command})" if self.command else f"process {self.process}"


def refuse_others(descriptor: int, ioctl: Ioctl = system_ioctl) -> None:
    """Make the system refuse any further opening of the serial port, by other programs or by this one.

    Privileged programs can still open it. Does nothing if the driver does not offer that.
    """
    asked(ioctl, descriptor, TIOCEXCL, bytearray())


def admit_others(descriptor: int, ioctl: Ioctl = system_ioctl) -> None:
    """Undo `refuse_others`, whose refusal would otherwise last as long as any descriptor of the port is open."""
    try:
        asked(ioctl, descriptor, TIOCNXCL, bytearray())
    except OSError:
        return  # the port is gone, and with it the refusal


def holder_of(path: str, processes: Path = PROCESSES) -> Holder | None:
    """Return the program that has locked the port at ``path``, or else one that has it open; None if none is seen.

    Programs of other users are often not seen, and on systems other than Linux none is.
    """
    if not processes.is_dir():
        return None
    try:
        status = os.stat(path)
    except OSError:
        return None
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    process = _who_locked(place, processes)
    if process is None:
        process = next(_who_opened(status, processes), None)
    if process is None:
        return None
    return Holder(process, _command(process, processes), ourselves=process == os.getpid())


def _who_locked(place: str, processes: Path) -> int | None:
    """Return the process number from a line of /proc/locks: 4711 from ``1: FLOCK ADVISORY WRITE 4711 00:1a:3 0 EOF``.

    None if no such line is for the file ``place`` (``00:1a:3``), or /proc/locks cannot be read.
    """
    try:
        lines = (processes / "locks").read_text().splitlines()
    except OSError:
        return None
    for line in lines:
        words = line.split()
        if len(words) >= 6 and words[1] == "FLOCK" and words[5] == place and int(words[4]) > 0:
            return int(words[4])
    return None


def _who_opened(status: os.stat_result, processes: Path) -> Iterator[int]:
    """Yield the numbers of other processes that have the port open, as far as this process may see them."""
    for directory in _listed(processes):
        if not directory.name.isdigit() or int(directory.name) == os.getpid():
            continue
        for entry in _listed(directory / "fd"):
            try:
                opened = entry.stat()
            except OSError:
                continue
            if (opened.st_rdev, opened.st_dev, opened.st_ino) == (status.st_rdev, status.st_dev, status.st_ino):
                yield int(directory.name)
                break


def _listed(directory: Path) -> list[Path]:
    try:
        return list(directory.iterdir())
    except OSError:
        return []  # another user's process, or one that has just ended


def _command(process: int, processes: Path) -> str:
    try:
        words = (processes / str(process) / "cmdline").read_bytes().split(b"\0")
    except OSError:
        return ""
    return b" ".join(words).decode(errors="replace").strip()[:200]
