"""The tables of the page about sinks are sinks."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from busway.apps.collector.sinks.options import make_sink
from busway.config.files.sinks import SentSection, sink_section

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "send-samples-on.md").read_text("utf-8")
ALL = [table for block in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL) for table in tomllib.loads(block)["sink"]]
TABLES = [table for table in ALL if not table["url"].startswith("prometheus:")]  # that is a page, and no sink

SECTIONS = dict(re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
SERVERS = {
    "MQTT": "mosquitto",
    "Sparkplug B": "mosquitto",
    "PostgreSQL and TimescaleDB": "postgresql",
    "InfluxDB, VictoriaMetrics, QuestDB": "victoria-metrics",
    "NATS JetStream": "nats-server",
    "Prometheus": "prometheus",
}
"""The server of each section, as Debian's package is called."""


def test_each_section_with_a_server_says_how_to_start_one() -> None:
    """Each of these packages starts its server by itself; that of NATS has no JetStream then."""
    of_servers = {name for name, text in SECTIONS.items() if re.search(r'^url = "(?!file:)', text, re.MULTILINE)}
    assert of_servers == set(SERVERS)
    for name, package in SERVERS.items():
        assert re.search(rf"\bapt-get install {package}\b", SECTIONS[name]), name
    commands = SECTIONS["NATS JetStream"]
    assert commands.index("systemctl disable --now nats-server") < commands.index("\nnats-server -js -a 127.0.0.1 -sd ")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["url"])
def test_each_table_makes_a_sink(table: dict[str, Any], tmp_path: Path) -> None:
    for package in ("aiomqtt", "asyncpg", "httpx", "nats"):
        pytest.importorskip(package)
    secret = tmp_path / "secret"
    secret.write_text("x")
    secret.chmod(0o600)
    values = {name: str(secret) if name.endswith("_file") else value for name, value in table.items()}
    section = sink_section(values)
    assert isinstance(section, SentSection)
    sink, options = make_sink(section)
    assert sink is not None
    assert options.points


def test_there_is_one_for_each_kind() -> None:
    schemes = {table["url"].partition(":")[0] for table in TABLES}
    assert schemes == {
        "mqtt",
        "mqtts",
        "postgresql",
        "influxdb+http",
        "influxdb+https",
        "nats",
        "file",
        "sparkplug+mqtt",
    }
