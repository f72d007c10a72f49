"""The journal of commands: a record of each command and its result, in one SQLite file beside the store's manifest.

Knows commands and results; knows no device and no clock.

1. A command is recorded, durably, before anything is sent (``synchronous=FULL``: each transaction ends with an fsync),
   and its result before the caller gets it.
2. A command that is open when the collector starts was cut off by the end of an earlier process: it may have been sent.
   It ends as unknown, and is not sent again.
3. At most `MOST_KEPT` results are kept, and none for longer than samples: when a further command is recorded, the
   oldest tenth of too many results is deleted, and up to `_AGED_AT_ONCE` that are too old; the log says so. Of a
   deleted result whose key was given by a caller, only the key is remembered, as 16 bytes. If `MOST_KEYS` of these are
   remembered, further commands with keys of callers are refused, so that none is sent twice.
4. The lock of the store makes this process the only one that writes here.
"""

import hashlib
import json
import logging
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from ....errors import ConfigError, Overloaded
from ..store.database import open_database, transaction
from ..store.folder import COMMANDS, sync_folder
from .command import MADE, CommandResult, CommandState, OldValue, PointCommand

MOST_KEPT: Final = 100_000
MOST_KEYS: Final = 10_000_000
CUT_OFF: Final = "the collector ended before the answer was recorded: it may have been written, and is not sent again"

_AGED_AT_ONCE: Final = 100
"""Most results that are deleted for their age when one further command is recorded."""
_log = logging.getLogger("busway.collector")

_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS commands (
    number INTEGER PRIMARY KEY AUTOINCREMENT, key TEXT NOT NULL UNIQUE, at REAL NOT NULL, "by" TEXT NOT NULL,
    origin TEXT NOT NULL, device TEXT NOT NULL, point TEXT NOT NULL, value TEXT NOT NULL, expires REAL NOT NULL,
    old TEXT, state TEXT NOT NULL, read_back TEXT, reason TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS used_keys (digest BLOB PRIMARY KEY) WITHOUT ROWID;
"""
_COLUMNS: Final = 'key, at, "by", origin, device, point, value, expires, old, state, read_back, reason'


class CommandJournal:
    """The record of all commands of one collector and their results; usable from any thread.

    Args:
        folder: the folder of the store, whose lock this process holds.
        most: most results that are kept.
        most_keys: most keys given by callers that are remembered without their results.
        keep: seconds for which results are kept; None for ever. The attribute ``keep`` can be set later.

    Raises:
        ConfigError: the file cannot be opened; names it.
    """

    def __init__(
        self, folder: Path, *, most: int = MOST_KEPT, most_keys: int = MOST_KEYS, keep: float | None = None
    ) -> None:
        self.path: Path = folder / COMMANDS
        self._most, self._most_keys = most, most_keys
        self.keep: float | None = keep
        self._lock = threading.Lock()
        try:
            self._database = open_database(self.path, "PRAGMA synchronous=FULL")
            with ExitStack() as unless_open:
                unless_open.callback(self._database.close)
                self.path.chmod(0o600)  # before there is a write-ahead log, which has the rights of the file
                self._database.execute("PRAGMA journal_mode=WAL")
                self._database.executescript(_SCHEMA)
                self._kept: int = self._database.execute("SELECT count(*) FROM commands").fetchone()[0]
                self._used: int = self._database.execute("SELECT count(*) FROM used_keys").fetchone()[0]
                sync_folder(folder)
                unless_open.pop_all()
        except (sqlite3.Error, OSError) as error:
            raise ConfigError(f"the journal of commands cannot be used: {error}", file=str(self.path)) from error

    def close(self) -> None:
        """Close the file of the journal."""
        with self._lock:
            self._database.close()

    def end_cut_off(self) -> list[CommandResult]:
        """Record commands that an earlier process left open as unknown, and return their results; for the start.

        Such a command may have been executed before that process ended (rule 2). Call this once, before other methods.

        Raises:
            OSError: the file cannot be read or written.
        """
        with self._in_use("written"):
            found = [_result(row) for row in self._rows("WHERE state = ?", (CommandState.OPEN.value,))]
            ended = [each.finished(CommandState.UNKNOWN, CUT_OFF) for each in found]
            with transaction(self._database):
                for each in ended:
                    self._set(each)
        return ended

    def take(self, result: CommandResult) -> CommandResult | None:
        """Record a command under its key, durably. If the key was used before, record nothing.

        In the same transaction, results beyond the limits of the journal are deleted (rule 3).

        Args:
            result: open for a command that will be sent, or finished for one that will not.

        Returns:
            None if the command is recorded now. Else the result of the first command with this key, which may still be
            open; or a refusal if that result is no longer kept.

        Raises:
            Overloaded: the key is a caller's, and no further keys of callers can be remembered (rule 3); nothing is
                recorded.
            OSError: the file cannot be read or written; nothing is recorded.
        """
        key = result.command.key
        with self._in_use("written"):
            known = self._known(result)
            if known is not None:
                return known
            is_callers = not key.startswith(MADE)
            if is_callers and self._used >= self._most_keys:
                raise Overloaded(f"{self._most_keys} keys of callers are remembered, the limit: send it without a key")
            counted = self._kept, self._used
            try:
                with transaction(self._database):
                    self._add(result)
            except sqlite3.Error:
                self._kept, self._used = counted
                raise
        return None

    def known(self, result: CommandResult) -> CommandResult | None:
        """Return what `take` would return for a command whose key was used before; None for a new key. Records nothing.

        Raises:
            OSError: the file cannot be read.
        """
        with self._in_use():
            return self._known(result)

    def finish(self, result: CommandResult) -> None:
        """Record the final result of a command that `take` recorded as open, durably.

        Raises:
            OSError: the file cannot be read or written; nothing is recorded.
        """
        with self._in_use("written"), transaction(self._database):
            self._set(result)

    def find(self, key: str) -> CommandResult | None:
        """Return the result recorded under a key; None if there is none, or only the key is kept.

        Raises:
            OSError: the file cannot be read.
        """
        with self._in_use():
            return self._found(key)

    def newest(self, limit: int) -> list[CommandResult]:
        """Return the results of the commands recorded last, newest first, ``limit`` at most; open ones too.

        Raises:
            OSError: the file cannot be read.
        """
        with self._in_use():
            return [_result(row) for row in self._rows("ORDER BY number DESC LIMIT ?", (limit,))]

    @contextmanager
    def _in_use(self, what: str = "read") -> Iterator[None]:
        """Return a context manager that holds the journal's lock and turns errors of SQLite into `OSError`."""
        with self._lock:
            try:
                yield
            except sqlite3.Error as error:
                raise OSError(f"the journal of commands cannot be {what}: {error}") from error

    # SQL; the lock is held.

    def _known(self, result: CommandResult) -> CommandResult | None:
        key = result.command.key
        found = self._found(key)
        if found is None and self._is_used(key):
            return result.finished(CommandState.REFUSED, "this key was used before, long ago; nothing was sent now")
        return found

    def _found(self, key: str) -> CommandResult | None:
        rows = self._rows("WHERE key = ?", (key,))
        return _result(rows[0]) if rows else None

    def _rows(self, rest: str, values: tuple[Any, ...]) -> list[tuple[Any, ...]]:  # Any: SQLite's columns
        return self._database.execute(f"SELECT {_COLUMNS} FROM commands {rest}", values).fetchall()

    def _is_used(self, key: str) -> bool:
        return bool(self._database.execute("SELECT 1 FROM used_keys WHERE digest = ?", (_digest(key),)).fetchone())

    def _add(self, result: CommandResult) -> None:
        command = result.command
        self._database.execute(
            f"INSERT INTO commands ({_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                command.key,
                result.at,
                command.by,
                command.origin,
                command.device,
                command.point,
                json.dumps(command.value),
                command.expires,
                _old_text(result.old),
                result.state.value,
                json.dumps(result.read_back),
                result.reason,
            ),
        )
        self._kept += 1
        self._drop_old(result.at)

    def _drop_old(self, now: float) -> None:
        """Delete the oldest tenth of the results if there are too many, and up to `_AGED_AT_ONCE` that are too old.

        Keys of callers are remembered. Open commands are not deleted. Call in a transaction.

        Args:
            now: seconds since 1970 UTC.
        """
        surplus = self._kept - self._most + self._most // 10 if self._kept > self._most else 0
        oldest = now - self.keep if self.keep is not None else 0.0
        found = self._database.execute(
            "SELECT number, key, at FROM commands WHERE state != ? ORDER BY number LIMIT ?",
            (CommandState.OPEN.value, max(surplus, _AGED_AT_ONCE)),
        ).fetchall()
        rows = [(number, key) for place, (number, key, at) in enumerate(found) if place < surplus or at < oldest]
        if not rows:
            return
        _log.info("%d results of old commands are no longer kept; keys of callers are remembered", len(rows))
        digests = [(_digest(key),) for _, key in rows if not key.startswith(MADE)]
        self._database.executemany("INSERT OR IGNORE INTO used_keys VALUES (?)", digests)
        self._used += len(digests)
        self._database.executemany("DELETE FROM commands WHERE number = ?", [(number,) for number, _ in rows])
        self._kept -= len(rows)

    def _set(self, result: CommandResult) -> None:
        self._database.execute(
            "UPDATE commands SET state = ?, read_back = ?, reason = ?, old = ? WHERE key = ?",
            (
                result.state.value,
                json.dumps(result.read_back),
                result.reason,
                _old_text(result.old),
                result.command.key,
            ),
        )


def _digest(key: str) -> bytes:
    return hashlib.sha256(key.encode()).digest()[:16]


def _old_text(old: OldValue | None) -> str | None:
    return None if old is None else json.dumps([old.value, old.quality, old.time])


def _result(row: tuple[Any, ...]) -> CommandResult:  # Any: SQLite's columns
    key, at, by, origin, device, point, value, expires, old, state, read_back, reason = row
    return CommandResult(
        PointCommand(key, device, point, json.loads(value), by, origin, expires),
        CommandState(state),
        at,
        None if old is None else OldValue(*json.loads(old)),
        json.loads(read_back),
        reason,
    )
