"""Shifts the wall clock of a program by what a file says, so that a test can step it while the program runs.

Import it before anything that asks the time. The environment names the file (``BUSWAY_SHIFTED_CLOCK``); without it
nothing is shifted. The file has eight bytes: signed nanoseconds.
"""

import mmap
import os
import struct
import time
from pathlib import Path

VARIABLE = "BUSWAY_SHIFTED_CLOCK"
_SHIFT = struct.Struct("<q")


def set_shift(file: Path, nanoseconds: int) -> None:
    """Step the clock of all programs that look at this file: by so much it is ahead from now on."""
    if not file.exists():
        file.write_bytes(_SHIFT.pack(nanoseconds))
    with file.open("r+b") as opened, mmap.mmap(opened.fileno(), _SHIFT.size) as memory:
        _SHIFT.pack_into(memory, 0, nanoseconds)


def _shift_time(file: Path) -> None:
    real = time.time_ns
    with file.open("r+b") as opened:
        memory = mmap.mmap(opened.fileno(), _SHIFT.size)

    def time_ns() -> int:
        return real() + int(_SHIFT.unpack_from(memory)[0])

    time.time_ns = time_ns
    time.time = lambda: time_ns() / 1e9


if VARIABLE in os.environ:
    _shift_time(Path(os.environ[VARIABLE]))
