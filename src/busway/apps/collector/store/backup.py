"""Backs up a store, also while it is being written, and restores it.

Knows files and what the manifest says of them; changes nothing in the store that it copies.

1. A backup is a store of its own: the manifest as it was at one moment, and the parts that it lists. SQLite copies the
   manifest, then the segments, so that the open one has every commit up to a moment; then sealed parts are copied. A
   segment whose file the writer has not made yet, so that it has no commits, is not listed in the copy.
   At the end the points are copied anew, so that every copied sample has its point, and the reserved commit numbers, so
   that a commit after the restore has a number that no copied commit has. If a part was removed meanwhile, all starts
   again.
2. The journal of commands and the record of ownership of a fleet are copied last. The record may concern later commits,
   which are not in the copy; that does no harm. After a restore, a command whose key is in the journal is not sent
   again, and a command that is open in it ends as unknown.
3. A backup that was interrupted is a folder whose name ends with ``.unfinished``, and is no store.
"""

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Final

from ....errors import ConfigError
from .check import check_store_files
from .folder import (
    COMMANDS,
    LOCK,
    MANIFEST,
    OWNERSHIP,
    SEGMENTS,
    UNFINISHED,
    StoreLock,
    check_store,
    make_folder,
    sync_file,
    sync_folder,
)
from .manifest import Manifest, StorePart, copy_points
from .segment import open_for_reading

_TRIES: Final = 10


def back_up(folder: Path, target: Path) -> int:
    """Copy a store into a new folder, also while the store is being written.

    Args:
        folder: the folder of the store.
        target: the folder of the backup, which must not exist.

    Returns:
        The number of files with samples (segment and Parquet files) in the backup.

    Raises:
        ConfigError: there is no store, the target exists or cannot be written, or files were replaced faster than they
            could be copied. What was copied until then stays in a folder whose name ends with ``.unfinished``.
    """
    check_store(folder)
    if target.exists():
        raise ConfigError("exists already; a backup makes a folder of its own", file=str(target))
    unfinished = target.with_name(target.name + UNFINISHED)
    try:
        for _ in range(_TRIES):
            shutil.rmtree(unfinished, ignore_errors=True)
            make_folder(unfinished)
            copied = _copied(folder, unfinished)
            if copied is not None:
                break
        else:
            raise ConfigError("parts were sealed faster than they could be copied; try again", file=str(folder))
        sync_folder(unfinished)
        unfinished.rename(target)
        sync_folder(target.parent)
    except (OSError, sqlite3.Error) as error:
        raise ConfigError(f"the backup cannot be written: {error}", file=str(target)) from error
    return copied


def _copied(folder: Path, target: Path) -> int | None:
    """Copy the manifest of a store, the files with samples that it lists, and what a collector keeps beside them.

    Returns:
        The number of files with samples in the copy; None if one was sealed or deleted before it was copied.
    """
    _copy_database(folder / MANIFEST, target / MANIFEST)
    with closing(Manifest(target)) as manifest:
        parts = manifest.parts()
    unmade: list[StorePart] = []
    for part in sorted(parts, key=lambda part: part.kind == "sealed"):
        source, copy = folder / SEGMENTS / part.file, target / SEGMENTS / part.file
        try:
            if part.kind == "sealed":
                shutil.copyfile(source, copy)
                sync_file(copy)
            else:
                _copy_database(source, copy)
        except FileNotFoundError:
            if part.kind != "open" or not _is_listed(folder, part):
                return None
            unmade.append(part)
    with closing(Manifest(target)) as manifest:
        manifest.drop_parts(unmade, before=0)
    with closing(sqlite3.connect(target / MANIFEST)) as written:
        copy_points(folder / MANIFEST, written)
    sync_file(target / MANIFEST)
    for name in (COMMANDS, OWNERSHIP):
        if (folder / name).exists():
            _copy_database(folder / name, target / name)
    return len(parts) - len(unmade)


def _is_listed(folder: Path, part: StorePart) -> bool:
    """Whether the manifest still lists a segment whose file is missing; then the writer will create the file soon.

    If it is not listed any more, the segment was sealed or deleted after the manifest was copied.
    """
    with closing(Manifest(folder)) as manifest:
        return part in manifest.parts()


def _copy_database(source: Path, target: Path) -> None:
    """Copy an SQLite file.

    Raises:
        FileNotFoundError: there is no such file, or it was deleted meanwhile: what its log had may not be in the copy.
    """
    target.unlink(missing_ok=True)
    try:
        with closing(open_for_reading(source)) as read, closing(sqlite3.connect(target)) as written:
            read.backup(written)
    except sqlite3.Error as error:
        if source.exists():
            raise
        raise FileNotFoundError(os.fspath(source)) from error
    if not source.exists():
        raise FileNotFoundError(os.fspath(source))
    sync_file(target)


def restore(backup: Path, folder: Path) -> int:
    """Restore a store from a backup into a new or empty folder, after a check of the backup.

    Args:
        backup: the folder of the backup.
        folder: the folder of the restored store: missing, empty, or with a lock file alone.

    Returns:
        The number of restored files with samples (segment and Parquet files).

    Raises:
        ConfigError: there is no backup or it is damaged, ``folder`` is not empty, is no folder or cannot be written, or
            another process is about to collect into it.
    """
    problems = check_store_files(backup)
    if problems:
        raise ConfigError(f"the backup is not whole: {problems[0]}", file=str(backup))
    _make_way(folder)
    return back_up(backup, folder)


def _make_way(folder: Path) -> None:
    """Remove the folder for a restored store, if it exists; its lock file too, unless a process has locked it.

    Raises:
        ConfigError: it is not empty, is no folder, cannot be removed, or a process has locked it.
    """
    try:
        if not folder.exists():
            return
        _check_empty(folder)
        lock = StoreLock(folder)
        try:
            _check_empty(folder)  # a process may have made a store meanwhile, and ended
            (folder / LOCK).unlink()
            folder.rmdir()
        finally:
            lock.release()
    except OSError as error:
        raise ConfigError(f"no backup can be restored here: {error.strerror}", file=str(folder)) from error


def _check_empty(folder: Path) -> None:
    """Raise `ConfigError` if there is anything but a lock file in a folder."""
    if any(path.name != LOCK for path in folder.iterdir()):
        raise ConfigError("is not empty; a backup is restored into a new folder", file=str(folder))
