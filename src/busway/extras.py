"""Optional packages: checks that one is installed, and the error that says how to install it.

Knows which extra of busway brings which package (pyproject.toml declares them); imports none of them.
"""

from importlib.util import find_spec
from typing import Final

from .errors import MissingExtra

EXTRA_OF: Final = {
    "serialx": "serial",
    "typer": "cli",
    "rich": "cli",
    "pydantic": "files",
    "cryptography": "tls",
    "prometheus_client": "metrics",
    "fastapi": "web",
    "starlette": "web",
    "uvicorn": "web",
    "websockets": "web",
    "pyarrow": "store",
    "adbc_driver_sqlite": "store",
    "aiomqtt": "mqtt",
    "google.protobuf": "sparkplug",
    "asyncpg": "postgresql",
    "httpx": "influxdb",
    "nats": "nats",
    "nkeys": "nats",
    "msgpack": "fleet",
    "yaml": "yaml",
    "pandas": "frames",
    "polars": "frames",
    "modbus_connection": "modbus_connection",
}
"""The extra that brings a package, by the name it is imported by."""


def require(package: str, purpose: str, *, key: str | None = None) -> None:
    """Raise `MissingExtra` unless ``package`` can be imported; it is looked for, not imported.

    Args:
        package: one of `EXTRA_OF`.
        purpose: what needs it, as the subject of the sentence: ``a serial port``.
        key: the option that asked for it, if one did.
    """
    try:
        is_there = find_spec(package) is not None
    except (ImportError, ValueError):  # ValueError: it is loaded, and not from a file
        is_there = False
    if not is_there:
        raise MissingExtra(package, EXTRA_OF[package], purpose=purpose, key=key)


def missing_extra(error: ImportError) -> MissingExtra | None:
    """The error for the user if a failed import was that of an optional package; None otherwise."""
    package = (error.name or "").partition(".")[0]
    if package not in EXTRA_OF:
        return None
    return MissingExtra(package, EXTRA_OF[package], purpose="this command")
