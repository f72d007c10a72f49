"""A table of a sink: its keys, its secrets, and what is said of those that cannot be."""

from pathlib import Path
from typing import Any

import pytest

from busway.apps.collector.sinks.options import make_sink
from busway.errors import ConfigError

pytest.importorskip("aiomqtt")


@pytest.mark.parametrize(
    ("url", "kind", "package"),
    [
        ("mqtt://broker", "MqttSink", "aiomqtt"),
        ("mqtts://collector@broker:8883", "MqttSink", "aiomqtt"),
        ("postgresql://collector@db:5432/plant", "PostgresqlSink", "asyncpg"),
        ("influxdb+http://host:8428/write", "InfluxSink", "httpx"),
        ("influxdb+https://host:8086/api/v2/write?org=o&bucket=b", "InfluxSink", "httpx"),
        ("nats://host", "NatsSink", "nats"),
        ("file:///data/samples-{date}.csv", "FileSink", "json"),
        ("file://samples.jsonl", "FileSink", "json"),
    ],
)
def test_the_scheme_says_the_kind(url: str, kind: str, package: str) -> None:
    pytest.importorskip(package)
    sink, options = make_sink("s", {"url": url})
    assert type(sink).__name__ == kind
    assert options.points == ("*",)


def test_how_samples_are_handed_on_is_in_the_table_too() -> None:
    _, options = make_sink(
        "s",
        {
            "url": "file:///x.csv",
            "points": ["meter-7", "*/power"],
            "most": 100,
            "age": 5,
            "keep": 3600,
            "report": "change",
            "deadband_percent": 2,
            "max_silence": 60,
        },
    )
    assert options.points == ("meter-7/*", "*/power")
    assert (options.most, options.age, options.keep) == (100, 5.0, 3600.0)
    assert (options.report.when, options.report.deadband, options.report.percent) == ("change", 2.0, True)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({}, "sink s: needs a url"),
        ({"url": "kafka://x"}, "sink s: kafka is no kind of sink; there are mqtt, mqtts"),
        ({"url": "mqtt://u:secret@broker"}, "a password does not belong here"),
        ({"url": "mqtt://broker", "topci": "x"}, "unknown key, is topic meant"),
        ({"url": "mqtt://broker", "topic": "plant"}, "a topic has {device}"),
        ({"url": "mqtt://broker", "topic": 5}, "str is needed, not 5"),
        ({"url": "mqtt://broker", "authority": "ca.pem"}, "is for a URL that encrypts"),
        ({"url": "mqtts://broker", "authority": "/nothing.pem"}, "cannot be used for TLS"),
        ({"url": "mqtt://broker", "password_variable": "BUSWAY_NOT_SET"}, "the environment has no BUSWAY_NOT_SET"),
        ({"url": "mqtt://"}, "names no host"),
        ({"url": "sparkplug+mqtt://broker", "group": "plant"}, "names of a group and an edge node"),
        ({"url": "sparkplug+mqtt://broker", "group": "a/b", "edge_node": "hall"}, "a name without / + #"),
        ({"url": "mqtt://broker", "discovery": "homeassistant"}, "needs per_point"),
        ({"url": "file:///x.xlsx"}, "files are csv, jsonl or parquet"),
        ({"url": "file:///x.csv", "most": True}, "int is needed, not True"),
        ({"url": "file:///x.csv", "most": 0}, "1…100000 samples"),
        ({"url": "postgresql://db:x/plant"}, "Port could not be cast to integer"),
        ({"url": "file:///x.csv", "report": "never"}, "is every, change or change_or_period"),
        ({"url": "file:///x.csv", "points": []}, "a list of patterns"),
    ],
)
def test_what_cannot_be_is_one_sentence(table: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        make_sink("s", table)
    assert says in str(refused.value)
    assert "secret" not in str(refused.value)


def test_a_secret_comes_from_a_file_or_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = tmp_path / "password"
    secret.write_text("geheim\n")
    table = {"url": "mqtt://collector@broker", "password_file": str(secret)}
    with pytest.raises(ConfigError, match="can be read by others"):
        make_sink("s", table)
    secret.chmod(0o600)
    sink, _ = make_sink("s", table)
    assert sink._address["password"] == "geheim"  # type: ignore[attr-defined]
    monkeypatch.setenv("BROKER_PASSWORD", "anders")
    sink, _ = make_sink("s", {"url": "mqtt://collector@broker", "password_variable": "BROKER_PASSWORD"})
    assert sink._address["password"] == "anders"  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="exclude each other"):
        make_sink("s", {**table, "password_variable": "BROKER_PASSWORD"})
    assert "geheim" not in repr(sink)
