"""Dashboards for Grafana, as JSON: for the collector's page for Prometheus, and for the table of a PostgreSQL sink."""

from importlib.resources import files
from typing import Final

from ....errors import ConfigError

KINDS: Final = ("prometheus", "postgresql")


def dashboard(kind: str) -> str:
    """Return a dashboard as JSON that Grafana imports.

    Args:
        kind: ``prometheus`` for the collector's page for Prometheus, or ``postgresql`` for the table of a PostgreSQL
            sink.

    Raises:
        ConfigError: ``kind`` is neither of them.
    """
    if kind not in KINDS:
        raise ConfigError(f"there are dashboards for {' and '.join(KINDS)}, not for {kind!r}", key="dashboard")
    return files(__name__).joinpath(f"{kind}.json").read_text("utf-8")
