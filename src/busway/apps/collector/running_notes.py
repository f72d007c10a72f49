"""Small files that tell `busway status` which collectors of this user run: collectors have no control socket.

Knows paths, JSON and the lock of a store; asks no collector.

1. A collector writes a note in the directory of control sockets while it runs: ``<process id>.collector``, of mode
   0600, with its file, its store and the URL of its page (without tokens).
2. A note that a dead process left behind is ignored: it counts only if its process holds the lock of the store.
"""

import contextlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from ...errors import ConfigError
from ..control.addresses import control_directory
from .store.folder import holder_of

NOTE_SUFFIX: Final = ".collector"


@dataclass(frozen=True, slots=True)
class RunningCollector:
    """What the note of a running collector says about it.

    Attributes:
        pid: its process id.
        file: absolute path of its configuration file; in a fleet, the name of the fleet's configuration.
        store: absolute path of the folder of its store.
        page: URL of its page; empty if it has none.
        is_in_fleet: whether it belongs to a fleet.
    """

    pid: int
    file: str
    store: str
    page: str
    is_in_fleet: bool


@contextlib.contextmanager
def noted(file: str, store: str, page: str, *, is_in_fleet: bool) -> Iterator[None]:
    """Context manager that keeps the note of this process's collector while its block lasts, then deletes it.

    If the note cannot be written, the block runs without it, and no error is raised.

    Args:
        file: path of the configuration file; made absolute in the note if the file exists. Else it is taken for the
            name of a fleet's configuration.
        store: path of the store's folder; made absolute in the note.
        page, is_in_fleet: as in `RunningCollector`.
    """
    pid = os.getpid()
    name = os.path.abspath(file) if os.path.exists(file) else file
    note = RunningCollector(pid, name, os.path.abspath(store), page, is_in_fleet)
    path = None
    with contextlib.suppress(ConfigError, OSError):  # only `busway status` misses it
        path = control_directory() / f"{pid}{NOTE_SUFFIX}"
        path.unlink(missing_ok=True)  # of a dead process with the same number
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with open(descriptor, "w", encoding="utf-8") as opened:
            json.dump(asdict(note), opened)
    try:
        yield
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()


def find_collectors(*directories: Path) -> list[RunningCollector]:
    """Return the running collectors whose notes are in these directories, in the order of their process ids.

    Notes that cannot be read, or whose process does not run any more, are left out.
    """
    found = []
    for directory in directories:
        for path in directory.glob(f"*{NOTE_SUFFIX}"):
            try:
                note = RunningCollector(**json.loads(path.read_text(encoding="utf-8")))
                is_running = holder_of(Path(note.store)) == note.pid
            except (OSError, ValueError, TypeError):
                continue  # being written, or not ours
            if is_running:
                found.append(note)
    return sorted(found, key=lambda each: each.pid)
