"""Dashboards for Grafana: one for the collector's page for Prometheus, one for the table of a PostgreSQL sink."""

from importlib.resources import files
from typing import Final

from ....errors import ConfigError

KINDS: Final = ("prometheus", "postgresql")


def dashboard(kind: str) -> str:
    """Return a dashboard as JSON that Grafana imports.

    Args:
        kind: one of `KINDS`: for the collector's page for Prometheus, or for the table of a PostgreSQL sink.

    Raises:
        ConfigError: there is no such dashboard.
    """
    if kind not in KINDS:
        raise ConfigError(f"there are dashboards for {' and '.join(KINDS)}, not for {kind!r}", key="dashboard")
    return files(__name__).joinpath(f"{kind}.json").read_text("utf-8")
