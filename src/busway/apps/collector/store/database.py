"""Opens connections to the SQLite files of a store, and makes transactions on them.

Knows SQLite; knows no table. The modules that open a file decide which pragmas it has: `segment`, `manifest`, and the
journal of commands.
"""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final
from urllib.parse import quote

_TIMEOUT: Final = 10.0
"""Seconds to wait while another connection has the file locked."""


def open_database(path: Path, *statements: str, script: str = "", makes: bool = True) -> sqlite3.Connection:
    """Open a SQLite database file in autocommit mode; several threads can use the connection, one at a time.

    While another connection has the file locked, a statement waits for up to 10 s.

    Args:
        path: the file.
        statements: SQL statements that are executed first.
        script: an SQL script that is executed after the statements; empty for none.
        makes: whether the file is created if it is missing.

    Raises:
        sqlite3.Error: the file is missing (with ``makes`` False), cannot be opened, or a statement failed; the file is
            closed again.
    """
    name = os.fspath(path) if makes else f"file:{quote(os.fspath(path))}?mode=rw"
    database = sqlite3.connect(name, uri=not makes, isolation_level=None, check_same_thread=False, timeout=_TIMEOUT)
    with ExitStack() as unless_open:
        unless_open.callback(database.close)
        for statement in statements:
            database.execute(statement)
        if script:
            database.executescript(script)
        unless_open.pop_all()
    return database


@contextmanager
def name_if_damaged(path: Path) -> Iterator[None]:
    """Context manager that adds the name of a file to an error of SQLite which says that the file is damaged."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        if type(error) is not sqlite3.DatabaseError:  # a subclass: the file may be sound
            raise
        raise sqlite3.DatabaseError(f"{path.name} is damaged: {error}") from error


@contextmanager
def transaction(database: sqlite3.Connection) -> Iterator[None]:
    """Context manager for a transaction: it is committed when the block ends, and undone if the block raises an error.

    Raises:
        sqlite3.Error: the transaction cannot be begun or committed.
    """
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
        database.execute("COMMIT")
    finally:
        if database.in_transaction:  # something was raised
            database.execute("ROLLBACK")
