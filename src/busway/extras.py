"""Optional packages: the check that a package is installed, and the error that says how to install it.

Knows which extra of busway installs which package (pyproject.toml declares the extras); imports none of the packages.
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
"""By import name of an optional package, the extra of busway that installs it: ``serialx`` → ``serial``.

The package is then installed by ``pip install 'busway[serial]'``.
"""


def require(package: str, purpose: str, *, key: str | None = None) -> None:
    """Raise `MissingExtra` unless ``package`` is installed; returns nothing, and does not import the package.

    Args:
        package: import name of the package, a key of `EXTRA_OF`.
        purpose: what needs the package, as the subject of the error message: ``a serial port``.
        key: name of the option that needs the package, for the error; None if it is no option.
    """
    try:
        is_there = find_spec(package) is not None
    except (ImportError, ValueError):  # ValueError: it is loaded, and not from a file
        is_there = False
    if not is_there:
        raise MissingExtra(package, EXTRA_OF[package], purpose=purpose, key=key)


def missing_extra(error: ImportError) -> MissingExtra | None:
    """Return a `MissingExtra` if ``error`` is the failed import of an optional package; None otherwise.

    The package must be a key of `EXTRA_OF`; the import of a module in it, or of a package around it, counts too. The
    message of the new error says that "this command" needs the package. The new error is returned, not raised.
    """
    name = f"{error.name or ''}."
    for package, extra in EXTRA_OF.items():
        # A module of the package, or, of google.protobuf, the package around it.
        if name.startswith(f"{package}.") or package.startswith(name):
            return MissingExtra(package, extra, purpose="this command")
    return None
