"""Opens the coordinator of a fleet by its URL, whose scheme names the backend; loads only the code of that backend.

1. Servers and collectors can be started at the same time: a server that does not answer yet is asked again for
   `CoordinatorOptions.start` seconds, and the log says so. An error that waiting cannot cure is raised at once.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Final, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from ....errors import ConfigError, ModbusError
from ...collector.sinks.hidden_secrets import HiddenSecrets
from ..coordinator import Coordinator, CoordinatorDown

LAST_PORT: Final = 65_535
ASK_EVERY: Final = 0.5
"""Seconds from a failed try to the next one."""
_log = logging.getLogger("busway.fleet")
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class CoordinatorOptions:
    """Options of the connection to the table that collectors share: user, credentials, TLS files, replicas.

    Attributes:
        user, password, token: credentials for the server; None if they are in the URL or the credentials file.
        credentials: path of a NATS credentials file, or of a file with the seed of a key pair; None for none.
        ca: path of a PEM file with the authorities of the server's certificate; None for the system's own.
        certificate, key: paths of PEM files with the client's certificate and its key; None for none.
        replicas: number of servers that must keep each entry, 1…5 (NATS).
        domain: JetStream domain of the edge site that has the table, asked through the centre (NATS); None for the
            server that the URL names.
        answer: seconds to wait for the answer to a change; after them its outcome is unknown.
        start: seconds for which a server that does not answer is asked again when the coordinator is opened; 0 to ask
            once. Servers that were started just now have to elect a leader.
    """

    user: str | None = None
    password: str | None = None
    token: str | None = None
    credentials: str | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    replicas: int = 1
    domain: str | None = None
    answer: float = 2.5
    start: float = 30.0


async def open_coordinator(url: str, zone: str, options: CoordinatorOptions | None = None) -> Coordinator:
    """Open the table that the collectors of a zone share, in a file, NATS or PostgreSQL; created if missing.

    Args:
        url: ``local:FOLDER`` for the collectors of one machine, ``nats://host:4222`` (several hosts with commas,
            ``tls://`` for encryption), or ``postgresql://user@host/database``.
        zone: name of the zone.
        options: credentials, certificates and timeouts of the connection; None for the defaults.

    Raises:
        ConfigError: the URL or the name of the zone is invalid, a file for TLS or credentials cannot be used, or the
            server is too old, has too few replicas or refuses the rights.
        CoordinatorDown: the server could not be reached or used for ``options.start`` seconds.
        MissingExtra: a package for this backend is not installed.
    """
    options = options or CoordinatorOptions()
    scheme = url.partition(":")[0].lower()
    if scheme == "local":
        if not url.removeprefix("local:"):
            raise ConfigError("local:FOLDER needs a folder", key="coordinator")
        found = import_module(".local", __package__)
        return await found.open_local(url.removeprefix("local:"), zone)  # type: ignore[no-any-return]
    if scheme in ("nats", "tls", "postgresql", "postgres"):
        _check_hosts(url, hidden_secrets(url, options))
    if scheme in ("nats", "tls"):
        found = import_module(".nats", __package__)
        return await until_up(lambda: found.open_nats(url, zone, options), CoordinatorDown, options.start)
    if scheme in ("postgresql", "postgres"):
        found = import_module(".postgresql", __package__)
        return await until_up(lambda: found.open_postgresql(url, zone, options), CoordinatorDown, options.start)
    shown = hidden_secrets(url, options).hide(url)
    raise ConfigError(
        f"a coordinator is local:FOLDER, nats://host:4222 or postgresql://user@host/database, not {shown!r}",
        key="coordinator",
    )


def _check_hosts(url: str, secrets: HiddenSecrets) -> None:
    """Raise `ConfigError` if a host or port in the URL of a coordinator is invalid.

    Args:
        url: URL for NATS or PostgreSQL.
        secrets: hides the secrets of the URL in the error.
    """
    scheme, _, rest = url.partition("://")
    is_database = scheme in ("postgresql", "postgres")
    place, _, query = rest.partition("?")
    hosts = place.partition("/")[0].rpartition("@")[2] if is_database else place
    ports = [value for name, value in parse_qsl(query) if is_database and name == "port"]
    try:
        for each in hosts.split(","):
            parts = urlsplit(f"//{each.strip()}")
            if not (parts.hostname or is_database) or parts.port == 0:
                raise ValueError("no host" if parts.port != 0 else "port 0")
        for port in ports:
            if not 1 <= int(port) <= LAST_PORT:
                raise ValueError(f"port {port}")
    except ValueError as error:
        raise ConfigError(
            f"{secrets.hide(url)!r} names a host or port that cannot be ({secrets.hide(error)}); "
            f"HOST:PORT is needed, with a port from 1 to {LAST_PORT}",
            key="coordinator",
        ) from None


def hidden_secrets(url: str, options: CoordinatorOptions) -> HiddenSecrets:
    """Return an object that hides a coordinator's passwords and tokens in texts, such as errors.

    Args:
        url: URL of the coordinator. In a URL of NATS a user without a password is a token, and is hidden too.
        options: options of the connection, with a password or token of their own.
    """
    scheme, _, rest = url.partition("://")
    is_database = scheme in ("postgresql", "postgres")
    found = [value for name, value in parse_qsl(rest.partition("?")[2]) if "password" in name]
    for each in [rest] if is_database else rest.split(","):
        user, _, password = each.rpartition("@")[0].partition(":")
        found += [password] if password or is_database else [user]
    return HiddenSecrets(options.password, options.token, *found, *map(unquote, found))


async def until_up(ask: Callable[[], Awaitable[_T]], down: type[ModbusError], seconds: float) -> _T:
    """Call a function again and again until its server is up, and return its result; the first failure is logged.

    Args:
        ask: asks the server once.
        down: the error that ``ask`` raises while the server is not up. It is raised here once the time is over; any
            other error is raised at once.
        seconds: seconds after which ``ask`` is not called again; 0 to call it once.
    """
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    waits = False
    while True:
        try:
            found = await ask()
        except down as error:
            if loop.time() + ASK_EVERY > until:
                raise
            if not waits:
                _log.warning("%s; it is asked again for %g s", error, seconds)
            waits = True
            await asyncio.sleep(ASK_EVERY)
        else:
            if waits:
                _log.warning("the server answers now")
            return found
