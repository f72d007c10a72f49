"""The folder of a store: names of its files, the lock of its writer, and making changes durable.

Knows names, descriptors and process ids; knows nothing of samples.
"""

import contextlib
import os
import shutil
import time
from pathlib import Path
from typing import BinaryIO, Final

from ....errors import ConfigError

try:
    import fcntl

    HAS_LOCKS = True
except ImportError:  # Windows
    HAS_LOCKS = False

MANIFEST: Final = "manifest.sqlite"
LOCK: Final = "lock"
COMMANDS: Final = "commands.sqlite"
"""File of the journal of commands, which the collector writes into the folder of its store."""
OWNERSHIP: Final = "fleet.sqlite"
"""File of the record of which links a collector of a fleet owned when; it is in the folder of its store."""
SEGMENTS: Final = "segments"
UNFINISHED: Final = ".unfinished"
"""Ending of the name of a file or folder that is being written; a writer's start deletes such files in its store."""
_ENDING: Final = 2.0
"""Seconds for which the lock of a process that has ended may still be held."""


def check_locks() -> None:
    """Raise `ConfigError` on a system without POSIX file locks, such as Windows: no store can be written there."""
    if not HAS_LOCKS:
        raise ConfigError(
            "a store cannot be written on this system: it has no file locks of POSIX (fcntl), as Windows has none;"
            " the collector runs on Linux"
        )


def half_of_disk(folder: Path) -> int | None:
    """Return half the size in bytes of the disk that a folder is on, or will be on; at least 1 MB.

    None if the system does not tell the size. The folder need not exist.
    """
    there = next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())
    try:
        total = shutil.disk_usage(there).total
    except OSError:
        return None
    return max(total // 2, 1_000_000) if total else None


def is_cut_off(file: BinaryIO) -> bool:
    """Return whether the last line of a file has no end, as after a crash or on a full disk; False for an empty file.

    A line break is then to be written first. ``file`` must be open for reading and appending.
    """
    if not file.seek(0, os.SEEK_END):
        return False
    file.seek(-1, os.SEEK_END)
    return file.read(1) != b"\n"


class StoreLock:
    """The exclusive right of one process to write a store; the system releases it however that process ends."""

    def __init__(self, folder: Path) -> None:
        """Lock a store for writing by this process.

        Args:
            folder: the folder of the store.

        Raises:
            ConfigError: another process holds the lock (the message has its number, if it is known), the lock file
                cannot be opened, or the system has no file locks.
        """
        check_locks()
        self._open_and_take(folder)
        while not self._is_of(folder):  # a restore removed the file between open and lock: another could lock a new one
            os.close(self._handle)
            self._open_and_take(folder)
        with contextlib.suppress(OSError):  # a full disk: the lock holds, only its holder has no number then
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, f"{os.getpid()}\n".encode(), 0)

    def _open_and_take(self, folder: Path) -> None:
        path = folder / LOCK
        try:
            self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise ConfigError(f"the store cannot be locked: {error.strerror}", file=str(path)) from error
        try:
            self._take()
        except OSError as error:
            holder = self._holder()
            os.close(self._handle)
            who = "another process" if holder is None else f"process {holder}"
            raise ConfigError(
                f"{who} collects into this store; end it first, or name another folder", file=str(folder)
            ) from error

    def _is_of(self, folder: Path) -> bool:
        """Whether the file that is locked is still the lock file of a folder."""
        try:
            return os.path.samestat(os.fstat(self._handle), os.stat(folder / LOCK))
        except FileNotFoundError:
            return False

    def _take(self) -> None:
        """Lock the store's lock file. If it is still held for a process that has ended, wait up to `_ENDING` seconds.

        Raises:
            BlockingIOError: another process holds the lock.
        """
        until = time.monotonic() + _ENDING
        while True:
            try:
                return fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = self._holder()
                if holder is None or is_alive(holder) or time.monotonic() > until:
                    raise
                time.sleep(0.01)

    def _holder(self) -> int | None:
        """Return the process number in the store's lock file; None if the file has none."""
        text = os.pread(self._handle, 32, 0).decode("ascii", "replace").strip()
        return int(text) if text.isdigit() else None

    def release(self) -> None:
        """Release the lock, so that another process can write the store. Call it once."""
        os.ftruncate(self._handle, 0)
        os.close(self._handle)


def is_alive(process: int) -> bool:
    """Whether a process with this process number runs; False for numbers that no process can have."""
    if process < 1:  # 0 and less mean groups of processes
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def holder_of(folder: Path) -> int | None:
    """Return the number of the process that writes a store now; None if none does, as far as can be told.

    The number is 0 if a process writes the store but its number is not known. None also if the lock file cannot be
    opened, and on systems without file locks.
    """
    if not HAS_LOCKS:
        return None  # no process writes a store here
    try:
        handle = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        text = os.read(handle, 32).decode("ascii", "replace").strip()
        return int(text) if text.isdigit() else 0
    finally:
        os.close(handle)
    return None


def make_folder(path: Path) -> None:
    """Create the folder of a store if it is missing; a new folder is private to its owner.

    Raises:
        ConfigError: the folder cannot be created, or the system has no file locks.
    """
    check_locks()
    try:
        make_durably(path, mode=0o700)
        (path / SEGMENTS).mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"the store cannot be made: {error.strerror}", file=str(path)) from error
    sync_folder(path)


def make_durably(path: Path, *, mode: int = 0o777) -> None:
    """Create a folder, and missing folders above it, so that they survive a power failure.

    Args:
        path: the folder; an existing one is left as it is.
        mode: permissions of the folder, if it is created; folders above it get the usual ones.

    Raises:
        OSError: the folder cannot be created.
    """
    missing = [each for each in (path, *path.parents) if not each.exists()]
    path.mkdir(mode=mode, parents=True, exist_ok=True)
    for each in missing:
        with contextlib.suppress(PermissionError):  # a folder that may be entered and not listed
            sync_folder(each.parent)


def check_store(path: Path) -> None:
    """Raise `ConfigError` unless there is a store in this folder."""
    try:
        found = (path / MANIFEST).is_file()
    except OSError as error:  # such as a name that is too long, or a folder that may not be entered
        raise ConfigError(f"the store cannot be read: {error.strerror}", file=str(path)) from error
    if not found:
        raise ConfigError("there is no store in this folder; `busway collect` makes one", file=str(path))


def sync_folder(path: Path) -> None:
    """Make the names of the files in a folder survive a power failure.

    Raises:
        OSError: the folder cannot be opened or written to the disk.
    """
    _sync(path, os.O_RDONLY | os.O_DIRECTORY)


def sync_file(path: Path) -> None:
    """Make the contents of a file survive a power failure. A missing file is ignored.

    Raises:
        OSError: the file cannot be opened or written to the disk.
    """
    with contextlib.suppress(FileNotFoundError):
        _sync(path, os.O_RDONLY)


def _sync(path: Path, flags: int) -> None:
    handle = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unlink_part(path: Path) -> None:
    """Delete one of the store's files with samples, and SQLite's files beside it; missing ones are ignored."""
    for name in (path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-shm")):
        name.unlink(missing_ok=True)


def size_of(path: Path) -> int:
    """Return the size in bytes of one of the store's files with samples and its write-ahead log; 0 if it is missing."""
    total = 0
    for name in (path, path.with_name(path.name + "-wal")):
        with contextlib.suppress(FileNotFoundError):
            total += name.stat().st_size
    return total
