"""Sink that writes samples to PostgreSQL or TimescaleDB: COPY into a temporary table, then one upsert.

Knows SQL; the protocol is asyncpg's (``busway[postgresql]``).

1. A batch is one transaction. The key is (device, point, time): a batch that comes again changes nothing.
2. PostgreSQL has microseconds: ``time`` is rounded down, and ``nanoseconds`` has the rest.
3. The table is made where it is not there; with ``timescale`` it becomes a hypertable.
"""

import re
import ssl
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import PostgresqlOptions
from ..samples import Value
from ..store.committed_samples import CommittedSample
from .interface import SinkDown, SinkRefused

_USUAL: Final = PostgresqlOptions()
_COLUMNS: Final = ("time", "device", "point", "value", "text", "reason", "half_width", "nanoseconds")
_TABLE: Final = """
CREATE TABLE IF NOT EXISTS {table} (
    time timestamptz NOT NULL, device text NOT NULL, point text NOT NULL, value double precision, text text,
    reason smallint NOT NULL, half_width bigint NOT NULL, nanoseconds smallint NOT NULL,
    PRIMARY KEY (device, point, time)
)"""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_NAME: Final = re.compile(r"[a-z_][a-z0-9_]{0,62}(\.[a-z_][a-z0-9_]{0,62})?")


class PostgresqlSink:
    """Sink that writes samples to a PostgreSQL table."""

    def __init__(
        self,
        url: str,
        *,
        table: str = _USUAL.table,
        password: str | None = None,
        tls: ssl.SSLContext | None = None,
        timescale: bool = _USUAL.timescale,
        timeout: float = 30.0,
    ) -> None:
        """Set the database to write to; nothing is sent yet.

        Args:
            url: ``postgresql://user@host:5432/database``, without a password.
            table: name of the table, ``schema.table`` where it is not in the search path; small letters, digits, ``_``.
            password: of the user.
            tls: how to encrypt; None for as the server wants.
            timescale: make the table a hypertable; the extension must be in the database.
            timeout: seconds for each command.

        Raises:
            ConfigError: the table has no such name.
            MissingExtra: asyncpg is not installed.
        """
        require("asyncpg", "a sink to PostgreSQL")
        if _NAME.fullmatch(table) is None:
            raise ConfigError(f"a table is called by small letters, digits and _, not {table!r}", key="table")
        self._url, self._table, self._timescale = url, table, timescale
        self._options: dict[str, Any] = {"password": password, "timeout": timeout, "command_timeout": timeout}
        if tls is not None:
            self._options["ssl"] = tls
        self._connection: Any = None  # asyncpg is loaded when it is used

    async def open(self) -> None:
        """Connect to the database, and create the table if it is missing. Raises `SinkDown`."""
        pg = import_module("asyncpg")
        try:
            self._connection = await pg.connect(self._url, **self._options)
            await self._connection.execute(_TABLE.format(table=self._table))
            if self._timescale:
                await self._connection.execute(
                    "SELECT create_hypertable($1::regclass, 'time', if_not_exists => true)", self._table
                )
            columns = ", ".join(_COLUMNS)
            await self._connection.execute(
                f"CREATE TEMPORARY TABLE arriving AS SELECT {columns} FROM {self._table} WITH NO DATA"
            )
        except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError) as error:
            raise SinkDown(f"the database cannot be used: {error or type(error).__name__}") from error

    async def close(self) -> None:
        """Disconnect from the database."""
        connection, self._connection = self._connection, None
        if connection is not None:
            pg = import_module("asyncpg")
            try:
                await connection.close(timeout=2.0)
            except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError):  # it is gone already
                connection.terminate()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Write samples to the table in one transaction. Raises `SinkDown`, `SinkRefused`."""
        pg = import_module("asyncpg")
        columns = ", ".join(_COLUMNS)
        changed = ", ".join(f"{name} = excluded.{name}" for name in _COLUMNS[3:])
        try:
            async with self._connection.transaction():
                await self._connection.execute("TRUNCATE arriving")
                await self._connection.copy_records_to_table(
                    "arriving", records=[_record(sample) for sample in samples], columns=_COLUMNS
                )
                await self._connection.execute(
                    f"INSERT INTO {self._table} ({columns})"
                    f" SELECT DISTINCT ON (device, point, time) {columns} FROM arriving"
                    f" ORDER BY device, point, time, nanoseconds DESC"
                    f" ON CONFLICT (device, point, time) DO UPDATE SET {changed}"
                )
        except (pg.DataError, pg.IntegrityConstraintViolationError) as error:
            raise SinkRefused(f"the database refuses: {error}") from error
        except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError) as error:
            raise SinkDown(f"the database does not take samples: {error or type(error).__name__}") from error


def _record(sample: CommittedSample) -> tuple[Any, ...]:  # as asyncpg wants it
    microseconds, rest = divmod(sample.time, 1000)
    moment = _EPOCH + timedelta(microseconds=microseconds)
    number, text = number_and_text(sample.value)
    return moment, sample.device, sample.point, number, text, sample.reason, sample.half_width, rest


def number_and_text(value: Value | None) -> tuple[float | None, str | None]:
    """Return a value as float and text: the text of a text, or the digits of an integer that no float holds."""
    if value is None or isinstance(value, str):
        return None, value
    number = float(value)
    return number, str(value) if isinstance(value, int) and int(number) != value else None
