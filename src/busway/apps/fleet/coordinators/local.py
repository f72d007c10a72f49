"""The coordinator for collectors on one machine: an SQLite file that they share. Needs no server and no package.

1. The lock of SQLite makes changes one after the other; a change is on disk when it is confirmed.
2. Watches look every `LOOK_EVERY` seconds for revisions that are newer than the last they have seen.
"""

import asyncio
import sqlite3
import threading
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeVar

from ....errors import ConfigError
from ..coordinator import LONGEST_VALUE, SNAPSHOT_ENDS, CoordinatorDown, Entry, RevisionConflict
from ..shards import checked_name

LOOK_EVERY: Final = 0.1
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
        ConfigError: the zone has no valid name, or the file cannot be used.
    """
    return await asyncio.to_thread(LocalCoordinator, Path(folder or "."), checked_name(zone, "zone"))


class LocalCoordinator:
    """The shared table of a zone's collectors on one machine, in the SQLite file ``<folder>/<zone>.fleet``.

    Attributes:
        path: path of the file.

    Raises:
        ConfigError: the file cannot be used.
    """

    def __init__(self, folder: Path, zone: str) -> None:
        self.path: Path = folder / f"{zone}.fleet"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._database = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False, timeout=2.0)
            self.path.chmod(0o600)
            self._database.execute("PRAGMA journal_mode=WAL")
            self._database.execute("PRAGMA synchronous=FULL")
            self._database.executescript(_SCHEMA)
        except (OSError, sqlite3.Error) as error:
            raise ConfigError(f"the coordinator's file cannot be used: {error}", file=str(self.path)) from error
        self._lock = threading.Lock()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="busway-fleet")

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table, and return its revision. Arguments and errors: `Coordinator.create`."""
        return await self._in_thread(lambda: self._changed(key, value, None))

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has this revision, and return its new revision.

        Arguments and errors: `Coordinator.replace`.
        """
        return await self._in_thread(lambda: self._changed(key, value, revision))

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield the entries whose keys begin with ``prefix``, then their changes, until closed.

        As `Coordinator.watch`, but the watch never begins again.

        Raises:
            CoordinatorDown: the file cannot be read.
        """
        last = 0
        first = True
        while True:
            for entry in await self._in_thread(lambda last=last: self._since(prefix, last)):  # type: ignore[misc]
                last = entry.revision
                yield entry
            if first:
                first = False
                yield SNAPSHOT_ENDS
            await asyncio.sleep(LOOK_EVERY)

    async def close(self) -> None:
        """Close the file of the shared table, after the change that is being made."""
        await asyncio.to_thread(self._thread.shutdown)
        with self._lock:
            self._database.close()

    def _changed(self, key: str, value: bytes, revision: int | None) -> int:
        if len(value) > LONGEST_VALUE:
            raise ConfigError(f"an entry has up to {LONGEST_VALUE} bytes, not {len(value)}", key=key)
        self._database.execute("BEGIN IMMEDIATE")
        try:
            row = self._database.execute("SELECT revision FROM entries WHERE key = ?", (key,)).fetchone()
            present = None if row is None else int(row[0])
            if present != revision:
                raise RevisionConflict(f"{key} has revision {present}, not {revision}")
            (newest,) = self._database.execute("SELECT coalesce(max(revision), 0) + 1 FROM entries").fetchone()
            self._database.execute("INSERT OR REPLACE INTO entries VALUES (?, ?, ?)", (key, value, newest))
        except BaseException:
            self._database.execute("ROLLBACK")
            raise
        self._database.execute("COMMIT")
        return int(newest)

    def _since(self, prefix: str, last: int) -> list[Entry]:
        rows = self._database.execute(
            "SELECT key, value, revision FROM entries WHERE revision > ? ORDER BY revision", (last,)
        )
        return [Entry(key, bytes(value), revision) for key, value, revision in rows if key.startswith(prefix)]

    async def _in_thread(self, work: Callable[[], _T]) -> _T:
        def locked() -> _T:
            with self._lock:
                return work()

        try:
            return await asyncio.get_running_loop().run_in_executor(self._thread, locked)
        except sqlite3.Error as error:
            raise CoordinatorDown(f"{self.path} cannot be used: {error}") from error
