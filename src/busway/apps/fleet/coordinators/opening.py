"""Opens the coordinator of a fleet by its URL, whose scheme names the backend; loads only that one."""

from dataclasses import dataclass
from importlib import import_module
from urllib.parse import urlsplit

from ....errors import ConfigError
from ..coordinator import Coordinator


@dataclass(frozen=True, slots=True)
class CoordinatorOptions:
    """Options of the connection to the table that collectors share: user, credentials, TLS files, replicas.

    Attributes:
        user, password, token: credentials for the server; None where the URL or the credentials file says all.
        credentials: path of a NATS credentials file; None for none.
        ca, certificate, key: paths of PEM files for TLS; None for those of the system, or for none.
        replicas: servers that must keep each entry, 1…5 (NATS).
        answer: seconds after which a change without an answer has an unknown outcome.
    """

    user: str | None = None
    password: str | None = None
    token: str | None = None
    credentials: str | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    replicas: int = 1
    answer: float = 2.5


async def open_coordinator(url: str, zone: str, options: CoordinatorOptions | None = None) -> Coordinator:
    """Open the table that the collectors of a zone share, in a file, NATS or PostgreSQL; created if missing.

    Args:
        url: ``local:FOLDER`` for the collectors of one machine, ``nats://host:4222`` (several hosts with commas,
            ``tls://`` for encryption), or ``postgresql://user@host/database``.
        zone: the name of the zone.
        options: how it is reached.

    Raises:
        ConfigError: the URL or the zone cannot be, the server is too old, has too few replicas or refuses the rights.
        CoordinatorDown: the server cannot be reached.
        MissingExtra: a package for this backend is not installed.
    """
    options = options or CoordinatorOptions()
    scheme = urlsplit(url).scheme
    if scheme == "local":
        found = import_module(".local", __package__)
        return await found.open_local(url.removeprefix("local:"), zone)  # type: ignore[no-any-return]
    if scheme in ("nats", "tls"):
        found = import_module(".nats", __package__)
        return await found.open_nats(url, zone, options)  # type: ignore[no-any-return]
    if scheme in ("postgresql", "postgres"):
        found = import_module(".postgresql", __package__)
        return await found.open_postgresql(url, zone, options)  # type: ignore[no-any-return]
    raise ConfigError(
        f"a coordinator is local:FOLDER, nats://host:4222 or postgresql://user@host/database, not {url!r}",
        key="coordinator",
    )
