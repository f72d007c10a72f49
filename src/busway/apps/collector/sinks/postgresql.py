"""Sink that writes samples to PostgreSQL or TimescaleDB: COPY into a temporary table, then one upsert.

Knows SQL; the protocol is asyncpg's (``busway[postgresql]``).

1. A batch is one transaction. The key is (device, point, time): a batch that is sent again changes nothing.
2. PostgreSQL has microseconds: ``time`` is rounded down, and ``nanoseconds`` has the rest. Of samples of a point in the
   same microsecond only the last is stored.
3. The table is created if it does not exist; with ``timescale`` it becomes a hypertable.
4. Alarm events go to a table of their own, which is created with the first event. An event is identified by device,
   point, time, its commit number and its place in that commit: one that is sent again replaces itself.
5. Samples of a fleet have the revision of its configuration. The column for it is added with the first such sample; if
   the table belongs to another user, samples are written without it.
6. Gaps of ownership (`DeviceGap`) go to a table of their own, one row for each device and epoch. Its begin moves to the
   newest sample of the device within the gap, in the transaction that writes the gap or the sample: the order in which
   they come does not matter.
7. Errors about values (a type, a range, a constraint, an error of a trigger) mean that the database refuses these
   samples. After any other error the batch is sent again later.
"""

import logging
import re
import ssl
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....options.sinks import PostgresqlOptions
from ..samples import Reason, SampleValue
from ..store.committed_samples import CommittedAlarm, CommittedSample
from .hidden_secrets import HiddenSecrets
from .interface import DeviceGap, SinkDown, SinkRefused

_log = logging.getLogger("busway.sinks")
_USUAL: Final = PostgresqlOptions()
_COLUMNS: Final = ("time", "device", "point", "value", "text", "reason", "half_width", "nanoseconds")
_REVISION: Final = "revision"
_TABLE: Final = """
CREATE TABLE IF NOT EXISTS {table} (
    time timestamptz NOT NULL, device text NOT NULL, point text NOT NULL, value double precision, text text,
    reason smallint NOT NULL, half_width bigint NOT NULL, nanoseconds smallint NOT NULL,
    PRIMARY KEY (device, point, time)
)"""
_ARRIVING: Final = """
CREATE TEMPORARY TABLE arriving (
    time timestamptz, device text, point text, value double precision, text text, reason smallint, half_width bigint,
    nanoseconds smallint, revision bigint
)"""
"""The temporary table to which samples are copied. The server checks whether they fit the real table at the upsert."""
_ALARM_COLUMNS: Final = (
    "time", "device", "point", "kind", "event", "value", "value_text", "text", "by", "nanoseconds", "commit_number",
    "place",
)  # fmt: skip
_ALARM_TABLE: Final = """
CREATE TABLE IF NOT EXISTS {table} (
    time timestamptz NOT NULL, device text NOT NULL, point text NOT NULL, kind text NOT NULL, event text NOT NULL,
    value double precision, value_text text, text text NOT NULL, by text NOT NULL, nanoseconds smallint NOT NULL,
    commit_number bigint NOT NULL, place integer NOT NULL, PRIMARY KEY (device, point, time, commit_number, place)
)"""
_GAP_TABLE: Final = """
CREATE TABLE IF NOT EXISTS {table} (
    device text NOT NULL, epoch text NOT NULL, begins timestamptz NOT NULL, ends timestamptz NOT NULL,
    PRIMARY KEY (device, epoch)
)"""
_ADD_GAP: Final = """
INSERT INTO {table} AS known (device, epoch, begins, ends)
SELECT $1, $2, greatest($3::timestamptz, (
    SELECT max(newest) FROM unnest($5::text[]) AS wanted (name), LATERAL (
        SELECT max(time) AS newest FROM {samples}
        WHERE device = $1 AND point = wanted.name AND time >= $3 AND time < $4 AND reason <> {reason}
    ) AS found
)), $4
ON CONFLICT (device, epoch) DO UPDATE SET begins = greatest(known.begins, excluded.begins)"""
_SHRINK_GAPS: Final = """
UPDATE {table} AS known SET begins = found.newest
FROM (
    SELECT gap.device, gap.epoch, max(sample.time) AS newest
    FROM {table} AS gap JOIN arriving AS sample
    ON sample.device = gap.device AND sample.time > gap.begins AND sample.time < gap.ends
    WHERE sample.reason <> {reason} AND gap.ends > (SELECT min(time) FROM arriving)
    GROUP BY gap.device, gap.epoch
) AS found
WHERE known.device = found.device AND known.epoch = found.epoch"""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_NAME: Final = re.compile(r"[a-z_][a-z0-9_]{0,62}(\.[a-z_][a-z0-9_]{0,62})?")


class PostgresqlSink:
    """Sink that writes samples and alarm events to tables of a PostgreSQL or TimescaleDB database."""

    def __init__(
        self,
        url: str,
        *,
        table: str = _USUAL.table,
        alarm_table: str = _USUAL.alarm_table,
        gap_table: str = _USUAL.gap_table,
        password: str | None = None,
        tls: ssl.SSLContext | None = None,
        timescale: bool = _USUAL.timescale,
        timeout: float = 30.0,
    ) -> None:
        """Set the database and options of the sink; nothing is sent yet.

        Args:
            url: ``postgresql://user@host:5432/database``, without a password.
            table: name of the table of samples, or ``schema.table``; each name has small letters, digits and ``_``, 63
                at most, and begins with no digit.
            alarm_table: name of the table of alarm events, in the same form.
            gap_table: name of the table of gaps of ownership, in the same form.
            password: the user's password; None for none.
            tls: the TLS context; None to leave encryption to the server and the URL.
            timescale: whether the tables of samples and alarm events become hypertables of TimescaleDB; the extension
                must be in the database.
            timeout: seconds for connecting, and for each command.

        Raises:
            ConfigError: the name of a table has other characters.
            MissingExtra: asyncpg is not installed.
        """
        require("asyncpg", "a sink to PostgreSQL")
        for key, name in (("table", table), ("alarm_table", alarm_table), ("gap_table", gap_table)):
            if _NAME.fullmatch(name) is None:
                raise ConfigError(f"a table is called by small letters, digits and _, not {name!r}", key=key)
        self._url, self._table, self._alarm_table, self._timescale = url, table, alarm_table, timescale
        self._gap_table = gap_table
        self._options: dict[str, Any] = {"password": password, "timeout": timeout, "command_timeout": timeout}
        self._secrets = HiddenSecrets(password)
        if tls is not None:
            self._options["ssl"] = tls
        self._connection: Any = None  # asyncpg is loaded when it is used
        self._has_alarm_table = self._has_gap_table = False
        self._has_revision = self._lacks_revision = False

    async def open(self) -> None:
        """Connect to the database, and create the table of samples if it is missing.

        Raises:
            SinkDown: the database cannot be reached, or the table can be neither found nor created.
        """
        pg = import_module("asyncpg")
        try:
            self._connection = await pg.connect(self._url, **self._options)
            self._has_alarm_table = self._has_revision = self._lacks_revision = False
            await self._make_table(_TABLE, self._table)
            await self._connection.execute(_ARRIVING)
            asked = "SELECT to_regclass($1) IS NOT NULL"
            self._has_gap_table = await self._connection.fetchval(asked, self._gap_table)
        except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError) as error:
            raise SinkDown(f"the database cannot be used: {self._words(error)}") from error

    def _words(self, error: Exception) -> str:
        return self._secrets.hide(error) or type(error).__name__

    async def _make_table(self, made: str, name: str) -> None:
        await self._connection.execute(made.format(table=name))
        if self._timescale:
            await self._connection.execute(
                "SELECT create_hypertable($1::regclass, 'time', if_not_exists => true)", name
            )

    async def close(self) -> None:
        """Disconnect the sink from its PostgreSQL database."""
        connection, self._connection = self._connection, None
        if connection is not None:
            pg = import_module("asyncpg")
            try:
                await connection.close(timeout=2.0)
            except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError):  # it is gone already
                connection.terminate()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Write samples to the table, and move the begin of gaps that contain them, in one transaction (rules 1 and 6).

        If a sample has a revision, the column for it is added before (rule 5).

        Raises:
            SinkRefused: the database refuses the values of a sample; none is written.
            SinkDown: any other error; if no answer came, the samples may have been written.
        """
        if not self._has_revision and not self._lacks_revision and any(sample.revision for sample in samples):
            await self._add_revision()
        names = (*_COLUMNS, _REVISION) if self._has_revision else _COLUMNS
        columns = ", ".join(names)
        changed = ", ".join(f"{name} = excluded.{name}" for name in names[3:])
        async with self._writing():
            await self._connection.execute("TRUNCATE arriving")
            await self._connection.copy_records_to_table(
                "arriving", records=[_record(sample) for sample in samples], columns=(*_COLUMNS, _REVISION)
            )
            await self._connection.execute(
                f"INSERT INTO {self._table} ({columns})"
                f" SELECT DISTINCT ON (device, point, time) {columns} FROM arriving"
                f" ORDER BY device, point, time, nanoseconds DESC, ctid DESC"  # of equal times the one that came last
                f" ON CONFLICT (device, point, time) DO UPDATE SET {changed}"
            )
            if self._has_gap_table:
                await self._connection.execute(_SHRINK_GAPS.format(table=self._gap_table, reason=int(Reason.OWNERSHIP)))

    async def _add_revision(self) -> None:
        """Add the column for revisions to the table of samples if it is missing; if the user may not, only log that."""
        pg = import_module("asyncpg")
        asked = (
            "SELECT count(*) FROM pg_attribute"
            " WHERE attrelid = $1::text::regclass AND attname = $2 AND NOT attisdropped"
        )
        try:
            async with self._writing():
                if not await self._connection.fetchval(asked, self._table, _REVISION):
                    await self._connection.execute(f"ALTER TABLE {self._table} ADD COLUMN {_REVISION} bigint")
            self._has_revision = True
        except SinkDown as error:
            if not isinstance(error.__cause__, pg.InsufficientPrivilegeError):
                raise
            self._lacks_revision = True
            _log.warning("the table %s has no column for the revision of samples: %s", self._table, error)

    async def send_gaps(self, gaps: Sequence[DeviceGap]) -> None:
        """Write gaps of ownership to their table in one transaction. Raises errors like `send`.

        The table is created if it is missing. A gap that is sent again changes nothing, or moves the begin of its row
        to a later time.
        """
        async with self._writing():
            if not self._has_gap_table:
                await self._connection.execute(_GAP_TABLE.format(table=self._gap_table))
            await self._connection.executemany(
                _ADD_GAP.format(table=self._gap_table, samples=self._table, reason=int(Reason.OWNERSHIP)),
                [(gap.device, gap.epoch, _moment(gap.begin)[0], _moment(gap.end)[0], list(gap.points)) for gap in gaps],
            )
        self._has_gap_table = True

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Write alarm events to their table in one transaction. Raises errors like `send`.

        The table is created if it is missing.
        """
        changed = ", ".join(f"{name} = excluded.{name}" for name in _ALARM_COLUMNS)
        values = ", ".join(f"${place}" for place in range(1, len(_ALARM_COLUMNS) + 1))
        async with self._writing():
            if not self._has_alarm_table:
                await self._make_table(_ALARM_TABLE, self._alarm_table)
            await self._connection.executemany(
                f"INSERT INTO {self._alarm_table} ({', '.join(_ALARM_COLUMNS)}) VALUES ({values})"
                f" ON CONFLICT (device, point, time, commit_number, place) DO UPDATE SET {changed}",
                [_alarm_record(alarm) for alarm in alarms],
            )
        self._has_alarm_table = True

    @asynccontextmanager
    async def _writing(self) -> AsyncIterator[None]:
        """Context manager for a transaction of the database; its errors are raised as errors of sinks.

        Raises:
            SinkRefused: the database rejects the values.
            SinkDown: any other error of the database or the connection.
        """
        pg = import_module("asyncpg")
        if self._connection is None:
            raise SinkDown("the database is not connected")
        about_values = (
            pg.DataError,
            pg.IntegrityConstraintViolationError,
            pg.PLPGSQLError,
            pg.ProgramLimitExceededError,
        )
        try:
            async with self._connection.transaction():
                yield
        except (*about_values, UnicodeEncodeError) as error:
            raise SinkRefused(f"the database refuses: {self._words(error)}") from error
        except (pg.PostgresError, pg.InterfaceError, OSError, TimeoutError) as error:
            raise SinkDown(f"the database does not take samples: {self._words(error)}") from error


def _moment(time: int) -> tuple[datetime, int]:
    """Return a time in nanoseconds since 1970 UTC as whole microseconds, and the remaining nanoseconds."""
    microseconds, rest = divmod(time, 1000)
    return _EPOCH + timedelta(microseconds=microseconds), rest


def _record(sample: CommittedSample) -> tuple[Any, ...]:  # as asyncpg wants it
    moment, rest = _moment(sample.time)
    number, text = number_and_text(sample.value)
    return (
        moment,
        sample.device,
        sample.point,
        number,
        text,
        sample.reason,
        sample.half_width,
        rest,
        sample.revision or None,
    )


def _alarm_record(alarm: CommittedAlarm) -> tuple[Any, ...]:  # as asyncpg wants it
    event = alarm.event
    moment, rest = _moment(event.at)
    number, text = number_and_text(event.value)
    key = (moment, event.device, event.point, event.limit, event.kind.value)
    return *key, number, text, event.text, event.by, rest, alarm.commit, alarm.place


def number_and_text(value: SampleValue | None) -> tuple[float | None, str | None]:
    """Return a value for the columns ``value`` and ``text`` of the table.

    Returns:
        The value as float, None for a text or no value; and the text, or the digits of an integer that no float can
        represent exactly, else None.
    """
    if value is None or isinstance(value, str):
        return None, value
    number = float(value)
    return number, str(value) if isinstance(value, int) and int(number) != value else None
