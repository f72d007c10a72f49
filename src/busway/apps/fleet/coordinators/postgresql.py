"""The coordinator on PostgreSQL: one table of the database has the entries of all zones.

Knows SQL; the protocol is asyncpg's (``busway[postgresql]``).

1. A change is one ``UPDATE … WHERE revision = …``; the database compares and sets.
2. Each change sends a ``NOTIFY`` with its key. A watch reads the entries with these keys. Every `COMPARE_EVERY` seconds
   it reads all entries and compares their revisions, so that changes whose notification was lost are found.
3. Each entry has the time of its change by the server's clock. A collector compares that with its own clock.
4. Changes that were confirmed must survive a crash of the server: ``fsync`` and ``synchronous_commit`` must be on.
"""

import asyncio
import contextlib
import hashlib
from collections.abc import AsyncGenerator
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ...collector.sinks.options import tls_context
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
from .opening import CoordinatorOptions, hidden_secrets
from .outages import OutageLog

COMPARE_EVERY: Final = 2.0
OLDEST: Final = 120_000
_SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS busway_fleet (
    zone text NOT NULL, key text NOT NULL, value bytea NOT NULL, revision bigint NOT NULL,
    changed timestamptz NOT NULL, PRIMARY KEY (zone, key)
);
CREATE SEQUENCE IF NOT EXISTS busway_fleet_revision;
"""
_CREATE: Final = """
INSERT INTO busway_fleet VALUES ($1, $2, $3, nextval('busway_fleet_revision'), clock_timestamp())
ON CONFLICT DO NOTHING RETURNING revision, pg_notify($4, $2)
"""
_REPLACE: Final = """
UPDATE busway_fleet SET value = $3, revision = nextval('busway_fleet_revision'), changed = clock_timestamp()
WHERE zone = $1 AND key = $2 AND revision = $5 RETURNING revision, pg_notify($4, $2)
"""
_READ: Final = "SELECT key, value, revision, extract(epoch FROM changed)::float8 FROM busway_fleet WHERE zone = $1"


async def open_postgresql(url: str, zone: str, options: CoordinatorOptions) -> "PostgresqlCoordinator":
    """Connect to the table that a zone's collectors share in PostgreSQL; the table is created if missing.

    Args:
        url: ``postgresql://user@host/database``.
        zone: name of the zone.
        options: credentials, certificates and the timeout of the connection.

    Raises:
        ConfigError: the name of the zone is invalid, or the server is too old, refuses the credentials or rights, or
            can lose confirmed changes in a crash (rule 4).
        CoordinatorDown: the server cannot be used now.
        MissingExtra: the package asyncpg is not installed.
    """
    require("asyncpg", "a coordinator on PostgreSQL")
    coordinator = PostgresqlCoordinator(url, checked_name(zone, "zone"), options)
    await coordinator.open()
    return coordinator


def _errors(pg: Any) -> tuple[type[Exception], ...]:
    """Return the exceptions that asyncpg raises if a server is away, ends a connection or reports an error."""
    return pg.PostgresError, pg.InterfaceError, pg.InternalClientError, OSError, TimeoutError


def _channel(zone: str) -> str:
    """Return the name of the ``NOTIFY`` channel for changes of a zone, of at most 63 bytes as PostgreSQL wants."""
    name = f"busway_fleet_{zone}"
    return name if len(name) < 64 else f"busway_fleet_{hashlib.blake2b(zone.encode(), digest_size=16).hexdigest()}"


class PostgresqlCoordinator:
    """The shared table of a zone's collectors in PostgreSQL: the rows of the zone in the table ``busway_fleet``."""

    def __init__(self, url: str, zone: str, options: CoordinatorOptions) -> None:
        self._url, self._zone, self._options = url, zone, options
        self._secrets = hidden_secrets(url, options)
        self._channel = _channel(zone)
        self._pool: Any = None
        self._outages = OutageLog()

    def _words(self, error: Exception) -> str:
        return self._secrets.hide(error) or type(error).__name__

    async def open(self) -> None:
        """Connect to PostgreSQL, check version and settings of the server, and create the table if missing.

        Raises:
            ConfigError: the server is too old, refuses the credentials or rights, or can lose confirmed changes in a
                crash (rule 4).
            CoordinatorDown: the server cannot be used now.
        """
        pg, shown = import_module("asyncpg"), self._secrets.hide(self._url)
        try:
            async with asyncio.timeout(4 * self._options.answer):
                self._pool = await pg.create_pool(
                    self._url, min_size=1, max_size=8, command_timeout=self._options.answer, **self._access()
                )
            async with self._pool.acquire() as connection:
                await self._check(connection)
                async with connection.transaction():
                    await connection.execute("SELECT pg_advisory_xact_lock(hashtext('busway_fleet'))")
                    await connection.execute(_SCHEMA)
        except (pg.InvalidPasswordError, pg.InvalidAuthorizationSpecificationError) as error:
            await self.close()
            raise ConfigError(f"{shown} refuses the credentials: {self._words(error)}", key="coordinator") from error
        except pg.InsufficientPrivilegeError as error:
            await self.close()
            raise ConfigError(
                f"the table busway_fleet cannot be used: {self._words(error)}", key="coordinator"
            ) from error
        except _errors(pg) as error:
            await self.close()
            raise CoordinatorDown(f"{shown} cannot be used: {self._words(error)}", endpoint=shown) from error
        except ConfigError:
            await self.close()
            raise

    def _access(self) -> dict[str, Any]:
        given: dict[str, Any] = {"user": self._options.user, "password": self._options.password}
        if self._options.ca or self._options.certificate:
            given["ssl"] = tls_context(self._options.ca, self._options.certificate, self._options.key)
        return {name: value for name, value in given.items() if value is not None}

    async def _check(self, connection: Any) -> None:
        if int(await connection.fetchval("SHOW server_version_num")) < OLDEST:
            version = await connection.fetchval("SHOW server_version")
            raise ConfigError(f"the server is PostgreSQL {version}; 12 or newer is needed", key="coordinator")
        for name in ("fsync", "synchronous_commit"):
            if await connection.fetchval(f"SHOW {name}") == "off":
                raise ConfigError(
                    f"the server has {name} = off: what it confirms may be lost, and two collectors own one link",
                    key="coordinator",
                )

    async def create(self, key: str, value: bytes) -> int:
        """Add a new entry to the shared table, and return its revision. Arguments and errors: `Coordinator.create`."""
        return await self._changed(key, value, _CREATE)

    async def replace(self, key: str, value: bytes, revision: int) -> int:
        """Change an entry of the shared table if it still has this revision, and return its new revision.

        Arguments and errors: `Coordinator.replace`.
        """
        return await self._changed(key, value, _REPLACE, revision)

    async def _changed(self, key: str, value: bytes, statement: str, *revision: int) -> int:
        pg = import_module("asyncpg")
        if len(value) > LONGEST_VALUE:
            raise ConfigError(f"an entry has up to {LONGEST_VALUE} bytes, not {len(value)}", key=key)
        try:
            async with asyncio.timeout(self._options.answer):
                connection = await self._pool.acquire()
        except _errors(pg) as error:
            raise CoordinatorDown(f"no connection to the database: {self._words(error)}") from error
        try:
            made = await connection.fetchval(statement, self._zone, key, value, self._channel, *revision)
        except _errors(pg) as error:
            raise OutcomeUnknown(f"the database does not confirm: {self._words(error)}") from error
        finally:
            with contextlib.suppress(*_errors(pg)):
                await self._pool.release(connection, timeout=1.0)
        if made is None:
            raise RevisionConflict(f"{key} has not revision {revision[0] if revision else 'none'}")
        return int(made)

    async def watch(self, prefix: str = "") -> AsyncGenerator[Entry, None]:
        """Yield the entries whose keys begin with ``prefix``, then their changes, until closed: `Coordinator.watch`."""
        first, was_complete = True, False
        while True:
            if not first:
                yield SNAPSHOT_BEGINS
            first = False
            async with contextlib.aclosing(self._once(prefix, was_complete=was_complete)) as entries:
                async for entry in entries:
                    was_complete = was_complete or entry is SNAPSHOT_ENDS
                    yield entry
            await asyncio.sleep(0.2)

    async def _once(self, prefix: str, *, was_complete: bool) -> AsyncGenerator[Entry, None]:
        """Yield the entries, then `SNAPSHOT_ENDS`, then changes, over one connection to the database.

        Ends without an error when the connection is lost or the database reports an error.

        Raises:
            ConfigError: the role has no right to read the table, and ``was_complete`` is False.
        """
        pg = import_module("asyncpg")
        told: set[str] = set()
        wake = asyncio.Event()

        def notified(_connection: object, _pid: int, _channel: str, key: str) -> None:
            told.add(key)
            wake.set()

        connection = None
        try:
            options = {"timeout": self._options.answer, "command_timeout": 2 * self._options.answer}
            connection = await pg.connect(self._url, **options, **self._access())
            await connection.add_listener(self._channel, notified)
            seen: dict[str, int] = {}
            is_complete = False
            compared = 0.0
            loop = asyncio.get_running_loop()
            while True:
                wake.clear()
                keys, told_now = None, set(told)
                if loop.time() < compared + COMPARE_EVERY:
                    keys = sorted(told_now)
                else:
                    compared = loop.time()
                told -= told_now
                for entry in await self._read(connection, prefix, keys):
                    if entry.revision > seen.get(entry.key, 0):
                        seen[entry.key] = entry.revision
                        yield entry
                if not is_complete:
                    is_complete = True
                    self._outages.complete()
                    yield SNAPSHOT_ENDS
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(max(0.0, compared + COMPARE_EVERY - loop.time())):
                        await wake.wait()
        except _errors(pg) as error:
            if isinstance(error, pg.InsufficientPrivilegeError) and not was_complete:
                raise ConfigError(
                    f"the table busway_fleet cannot be read: {self._words(error)}", key="coordinator"
                ) from error
            self._outages.lost(self._words(error))
            return
        finally:
            if connection is not None:
                connection.terminate()

    async def _read(self, connection: Any, prefix: str, keys: list[str] | None) -> list[Entry]:
        if keys is None:
            rows = await connection.fetch(f"{_READ} ORDER BY revision", self._zone)
        elif keys:
            rows = await connection.fetch(f"{_READ} AND key = ANY($2) ORDER BY revision", self._zone, keys)
        else:
            return []
        return [
            Entry(key, bytes(value), revision, time) for key, value, revision, time in rows if key.startswith(prefix)
        ]

    async def close(self) -> None:
        """Close the connections for changes at once. The connection of a watch ends with the watch."""
        if self._pool is not None:
            self._pool.terminate()
