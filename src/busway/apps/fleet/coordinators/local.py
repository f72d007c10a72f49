"""The coordinator for collectors on one machine: a table in an SQLite file. Needs no server and no further package.

1. The lock of SQLite makes changes one after the other; a change is on disk when it is confirmed.
2. Watches look every `LOOK_EVERY` seconds for revisions that are newer than the last they have seen.
3. After an error the file is opened anew at the next use. Until that succeeds, changes are refused, and watches begin
   again every `AGAIN` seconds.
4. While the path names no file, or another file than at the start, the coordinator is down. It neither creates the file
   anew nor uses the other one: SQLite would mix the other file with the files that it keeps beside the first
   (https://www.sqlite.org/howtocorrupt.html §1.4, §2.4), and another process may still change the first.
"""

import asyncio
import contextlib
import sqlite3
import threading
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

from ....errors import ConfigError
from ..coordinator import (
    LONGEST_VALUE,
    SNAPSHOT_BEGINS,
    SNAPSHOT_ENDS,
    CoordinatorDown,
    Entry,
    OutcomeUnknown,
    RevisionConflict,
)
from ..shards import checked_name
from .outages import OutageLog

LOOK_EVERY: Final = 0.1
AGAIN: Final = 0.2
"""Seconds after which a file that could not be read is read again."""
LOCKED_SECONDS: Final = 2.0
"""Longest wait in seconds of a change while other processes change the file."""
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS entries (key TEXT PRIMARY KEY, value BLOB NOT NULL, revision INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS by_revision ON entries (revision);
"""
_T = TypeVar("_T")


async def open_local(folder: str, zone: str) -> "LocalCoordinator":
    """Open the table that a zone's collectors on one machine share, a file ``<zone>.fleet``; created if missing.

    Args:
        folder: folder of the file, created if missing.
        zone: name of the zone.

    Raises:
        ConfigError: the name of the zone is invalid, or the file cannot be used.
    """
    return await asyncio.to_thread(LocalCoordinator, Path(folder or "."), checked_name(zone, "zone"))


class LocalCoordinator:
    """The shared table of a zone's collectors on one machine, in the SQLite file ``<folder>/<zone>.fleet``.

    Creating the object opens the file, and creates folder and file if they are missing; it blocks for that time.

    Args:
        folder: folder of the file.
        zone: name of the zone, which must be valid.

    Attributes:
        path: path of the file.

    Raises:
        ConfigError: the file cannot be used.
    """

    def __init__(self, folder: Path, zone: str) -> None:
        self.path: Path = folder / f"{zone}.fleet"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with contextlib.closing(sqlite3.connect(self.path, isolation_level=None, timeout=LOCKED_SECONDS)) as made:
                self.path.chmod(0o600)
                made.execute("PRAGMA journal_mode=WAL")
                made.executescript(_SCHEMA)
            self._identity = _identity(self.path)
            self._openings = 0
            self._opened: _OpenFile | None = self._open()
        except (OSError, sqlite3.Error) as error:
            raise ConfigError(f"the coordinator's file cannot be used: {error}", file=str(self.path)) from error
        self._outages = OutageLog()
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="busway-fleet")

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table, and return its revision. Arguments and errors: `Coordinator.create`."""
        return await self._in_thread(lambda file: _changed(file.database, key, value, None))

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has this revision, and return its new revision.

        Arguments and errors: `Coordinator.replace`.
        """
        return await self._in_thread(lambda file: _changed(file.database, key, value, revision))

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield the entries whose keys begin with ``prefix``, then their changes, until closed: `Coordinator.watch`."""
        first = True
        while True:
            if not first:
                yield SNAPSHOT_BEGINS
            first = False
            async with contextlib.aclosing(self._once(prefix)) as entries:
                async for entry in entries:
                    yield entry
            await asyncio.sleep(AGAIN)

    async def _once(self, prefix: str) -> AsyncGenerator[Entry, None]:
        """Yield the entries and their changes while the file stays open.

        Ends without an error when the file cannot be used, or was opened anew.
        """
        last, opening = 0, 0
        while True:
            try:
                now, found = await self._in_thread(lambda file, last=last: _since(file, prefix, last))  # type: ignore[misc]
            except CoordinatorDown as error:
                self._outages.lost(error.message)
                return
            if opening and now != opening:
                return
            for entry in found:
                last = entry.revision
                yield entry
            if not opening:
                opening = now
                self._outages.complete()
                yield SNAPSHOT_ENDS
            await asyncio.sleep(LOOK_EVERY)

    async def close(self) -> None:
        """Close the file of the shared table, after waiting for changes in progress."""
        await asyncio.to_thread(self._thread.shutdown)
        with self._lock:
            if self._opened is not None:
                self._opened.database.close()

    async def _in_thread(self, work: "Callable[[_OpenFile], _T]") -> _T:
        """Call a function with the open file in the thread of this coordinator, and return its result.

        After an error of SQLite, other than that the file is locked, the file is closed; the next call opens it anew.

        Raises:
            CoordinatorDown: the file cannot be used; nothing was changed.
            OutcomeUnknown, RevisionConflict, ConfigError: raised by ``work``.
        """

        def locked() -> _T:
            with self._lock:
                file = self._usable()
                try:
                    return work(file)
                except (sqlite3.Error, OutcomeUnknown) as error:
                    if not _is_locked(error):
                        self._opened = None
                        file.database.close()  # and with it a transaction that is not committed
                    raise

        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, locked)
        except OutcomeUnknown as error:
            raise OutcomeUnknown(f"{self.path} does not confirm: {error.message}") from error
        except (OSError, sqlite3.Error) as error:
            raise CoordinatorDown(f"{self.path} cannot be used: {error}") from error

    def _usable(self) -> "_OpenFile":
        """Return the open file, opened anew after an error.

        Raises:
            OSError: the path names no file, or another file than at the start (rule 4).
            sqlite3.Error: the file cannot be opened.
        """
        if _identity(self.path) != self._identity:
            raise FileExistsError("another file has its place; put the first one back, or start this program again")
        if self._opened is None:
            self._opened = self._open()
        return self._opened

    def _open(self) -> "_OpenFile":
        database = sqlite3.connect(
            f"{self.path.absolute().as_uri()}?mode=rw",
            uri=True,
            isolation_level=None,
            check_same_thread=False,
            timeout=LOCKED_SECONDS,
        )
        try:
            database.execute("PRAGMA journal_mode=WAL")
            database.execute("PRAGMA synchronous=FULL")
        except BaseException:
            database.close()
            raise
        self._openings += 1
        return _OpenFile(database, self._openings)


@dataclass(frozen=True, slots=True)
class _OpenFile:
    """The SQLite file of the shared table while it is open.

    Attributes:
        database: the SQLite connection to the file.
        opening: number of this opening: 1 for the first, and one more each time that the file was opened anew.
    """

    database: sqlite3.Connection
    opening: int


def _identity(path: Path) -> tuple[int, int]:
    """Return the device number and inode of a file, which are the same under any name of the file."""
    found = path.stat()
    return found.st_dev, found.st_ino


def _is_locked(error: Exception) -> bool:
    """Whether an error of SQLite says only that another process changes the file now; then nothing was changed."""
    return isinstance(error, sqlite3.Error) and error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY


def _changed(database: sqlite3.Connection, key: str, value: bytes, revision: int | None) -> int:
    """Change an entry if it has this revision, and return its new revision; revision None adds a new entry.

    Raises:
        ConfigError: the value is longer than `LONGEST_VALUE`; nothing was changed.
        RevisionConflict: the entry has another revision, or for None exists; nothing was changed.
        OutcomeUnknown: the change was not confirmed; it may have been made.
        sqlite3.Error: the file is locked, or cannot be used; nothing is changed if the database is closed now.
    """
    if len(value) > LONGEST_VALUE:
        raise ConfigError(f"an entry has up to {LONGEST_VALUE} bytes, not {len(value)}", key=key)
    database.execute("BEGIN IMMEDIATE")
    row = database.execute("SELECT revision FROM entries WHERE key = ?", (key,)).fetchone()
    present = None if row is None else int(row[0])
    if present != revision:
        database.execute("ROLLBACK")
        raise RevisionConflict(f"{key} has revision {present}, not {revision}")
    (newest,) = database.execute("SELECT coalesce(max(revision), 0) + 1 FROM entries").fetchone()
    database.execute("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", (key, value, newest))
    try:
        database.execute("COMMIT")
    except sqlite3.Error as error:  # others may find what was written before the error
        raise OutcomeUnknown(str(error)) from error
    return int(newest)


def _since(file: _OpenFile, prefix: str, last: int) -> tuple[int, list[Entry]]:
    """Return the number of the file's opening, and the entries that have a key prefix and a revision above ``last``.

    The entries are in the order of their revisions.
    """
    rows = file.database.execute(
        "SELECT key, value, revision FROM entries WHERE revision > ? ORDER BY revision", (last,)
    )
    return file.opening, [Entry(key, bytes(value), revision) for key, value, revision in rows if key.startswith(prefix)]
