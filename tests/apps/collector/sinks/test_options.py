"""A table of a sink: its keys, its secrets, and the errors of those that cannot be used."""

from pathlib import Path
from typing import Any

import pytest

from busway.apps.collector.sinks.interface import Sink
from busway.apps.collector.sinks.options import make_sink, tls_context
from busway.config.files.section import FileProblems
from busway.config.files.sinks import SentSection, sink_section
from busway.errors import ConfigError
from busway.options.sinks import DeliveryOptions
from busway.points import ReportRule

pytest.importorskip("aiomqtt")


def made(table: dict[str, Any]) -> tuple[Sink, DeliveryOptions]:
    section = sink_section({"name": "s", **table})
    assert isinstance(section, SentSection)
    return make_sink(section)


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
    sink, options = made({"url": url})
    assert type(sink).__name__ == kind
    assert options.points == ("*",)


def test_how_samples_are_handed_on_is_in_the_table_too() -> None:
    _, options = made(
        {
            "url": "file:///x.csv",
            "points": ["meter-7", "*/power"],
            "most": 100,
            "age": 5.0,
            "keep": 3600.0,
            "report": {"when": "change", "deadband": "2 %", "max_silence": 60.0},
        },
    )
    assert options.points == ("meter-7/*", "*/power")
    assert (options.most, options.age, options.keep) == (100, 5.0, 3600.0)
    assert options.report == ReportRule("change", None, 2.0, True, 60.0)


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({}, "is missing; there are mqtt, mqtts"),
        ({"url": "kafka://x"}, "kafka is no kind of sink; there are mqtt, mqtts"),
        ({"url": "mqtt://u:secret@broker"}, "a password does not belong here"),
        ({"url": "postgresql://u@db/plant?sslmode=require&password=secret"}, "a password does not belong here"),
        ({"url": "influxdb+http://db/write?db=plant&u=me&p=secret"}, "a password does not belong here"),
        ({"url": "mqtt://broker", "topci": "x"}, "unknown key; is it topic?"),
        ({"url": "mqtt://broker", "topic": "plant"}, "a topic has {device}"),
        ({"url": "mqtt://broker", "topic": 5}, "must be a text, not 5"),
        ({"url": "mqtt://broker", "authority": "ca.pem"}, "is for a URL that encrypts"),
        ({"url": "mqtts://broker", "authority": "/nothing.pem"}, "cannot be used for TLS"),
        ({"url": "mqtt://broker", "password_variable": "BUSWAY_NOT_SET"}, "the environment has no BUSWAY_NOT_SET"),
        ({"url": "mqtt://"}, "names no host"),
        ({"url": "sparkplug+mqtt://broker", "group": "plant"}, "is missing"),
        ({"url": "sparkplug+mqtt://broker", "group": "a/b", "edge_node": "hall"}, "a name without / + #"),
        ({"url": "mqtt://broker", "discovery": "homeassistant"}, "needs per_point"),
        ({"url": "file:///x.xlsx"}, "files are csv, jsonl or parquet"),
        ({"url": "file:///x.csv", "most": True}, "must be a whole number, not True"),
        ({"url": "file:///x.csv", "most": 0}, "must be 1…100000, not 0"),
        ({"url": "postgresql://db:x/plant"}, "its host or port cannot be: HOST:PORT is needed"),
        ({"url": "mqtt://[::1"}, "its host or port cannot be: HOST:PORT is needed"),
        ({"url": "file:///x.csv", "report": "never"}, "must be 'every', 'change' or 'change_or_period', not 'never'"),
        ({"url": "file:///x.csv", "points": []}, "must be a list of patterns"),
    ],
)
def test_what_cannot_be_is_one_sentence(table: dict[str, Any], says: str) -> None:
    with pytest.raises((ConfigError, FileProblems)) as refused:
        made(table)
    assert says in str(refused.value)
    assert "secret" not in str(refused.value)


def test_of_the_files_for_tls_the_one_that_cannot_be_used_is_named() -> None:
    for given, says in (
        (("/no-ca.pem", "/no-own.pem", "/no-key.pem"), "/no-ca.pem: cannot be used for TLS: "),
        ((None, "/no-own.pem", None), "/no-own.pem: cannot be used for TLS: "),
        ((None, "/no-own.pem", "/no-key.pem"), "/no-own.pem: cannot be used for TLS with the key /no-key.pem: "),
    ):
        with pytest.raises(ConfigError) as refused:
            tls_context(*given)
        assert str(refused.value).startswith(says)


def test_a_secret_comes_from_a_file_or_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = tmp_path / "password"
    secret.write_text("geheim\n")
    table = {"url": "mqtt://collector@broker", "password_file": str(secret)}
    with pytest.raises(ConfigError, match="can be read by others"):
        made(table)
    secret.chmod(0o600)
    sink, _ = made(table)
    assert sink._address["password"] == "geheim"  # type: ignore[attr-defined]
    monkeypatch.setenv("BROKER_PASSWORD", "anders")
    sink, _ = made({"url": "mqtt://collector@broker", "password_variable": "BROKER_PASSWORD"})
    assert sink._address["password"] == "anders"  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match="exclude each other"):
        made({**table, "password_variable": "BROKER_PASSWORD"})
    assert "geheim" not in repr(sink)
