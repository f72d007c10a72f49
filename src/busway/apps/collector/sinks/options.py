"""Builds a sink, and the options of its delivery, from a table ``[[sink]]``.

Knows the keys of each kind; knows no store. The scheme of the URL says what kind it is.

1. Secrets come from a file (``password_file``, ``token_file``) or from the environment (``password_variable``,
   ``token_variable``). One in the URL is refused, so that it is in no configuration, no list of processes and no log.
2. A file with a secret that others can read is refused.
3. What is wrong names the sink and the key.
"""

import os
import ssl
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Final
from urllib.parse import SplitResult, unquote, urlsplit

from ....errors import ConfigError
from ....points.point_rules import ReportRule
from ....safe_files import read_safely
from ....values.refusal import shown
from .delivery import DeliveryOptions
from .interface import Sink

_LONGEST_SECRET: Final = 4096


@dataclass(frozen=True, slots=True)
class _Kind:
    """One kind of sink: its keys, and how it is created."""

    keys: frozenset[str]
    make: Callable[[SplitResult, "SinkTable"], Sink]


class SinkTable:
    """The table of one sink, whose values are checked for their types when read."""

    def __init__(self, name: str, values: Mapping[str, Any], folder: Path | None = None) -> None:  # TOML
        self._name, self._values, self._folder = name, values, folder

    def kept_file(self, kind: str) -> Path | None:
        """Path of a file where a sink keeps data over a restart; None without one."""
        return None if self._folder is None else self._folder / f"{kind}-{self._name}.json"

    def refuse(self, key: str, what: str) -> ConfigError:
        """The error about one key of the table."""
        return ConfigError(f"sink {self._name}: {what}", key=key)

    def get(self, key: str, kind: type | tuple[type, ...], default: Any = None) -> Any:
        """The value of a key, if it has the given type. Raises `ConfigError` otherwise."""
        value = self._values.get(key, default)
        if value is default:
            return default
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            names = " or ".join(each.__name__ for each in (kind if isinstance(kind, tuple) else (kind,)))
            raise self.refuse(key, f"{names} is needed, not {value!r}")
        return value

    def number(self, key: str, default: float) -> float:
        return float(self.get(key, (int, float), default))

    def secret(self, key: str) -> str | None:
        """A secret, from the file or the variable that the table names; None for none."""
        file, variable = self.get(f"{key}_file", str), self.get(f"{key}_variable", str)
        if file is not None and variable is not None:
            raise self.refuse(f"{key}_file", f"{key}_file and {key}_variable exclude each other")
        if variable is not None:
            if variable not in os.environ:
                raise self.refuse(f"{key}_variable", f"the environment has no {variable}")
            return os.environ[variable]
        return None if file is None else _secret_of(file)

    def tls(self, wanted: bool) -> ssl.SSLContext | None:
        """The TLS context if the URL asks for TLS; else None."""
        given = {name: self.get(name, str) for name in ("authority", "certificate", "key")}
        if not wanted:
            for name, value in given.items():
                if value is not None:
                    raise self.refuse(name, "is for a URL that encrypts")
            return None
        return tls_context(**given)


def _secret_of(file: str) -> str:
    mode = os.stat(file).st_mode if os.path.exists(file) else 0
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError("holds a secret and can be read by others; chmod 600 it", file=file)
    return read_safely(file, most=_LONGEST_SECRET).decode("utf-8", "replace").strip("\r\n")


def tls_context(authority: str | None = None, certificate: str | None = None, key: str | None = None) -> ssl.SSLContext:
    """A TLS context that checks the server's certificate against an authority, by default those of the system.

    Raises:
        ConfigError: a file cannot be used.
    """
    try:
        context = ssl.create_default_context(cafile=authority)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        if certificate is not None:
            context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        name = authority if certificate is None else certificate
        raise ConfigError(f"cannot be used for TLS: {error}", file=name) from error
    return context


def make_sink(name: str, values: Mapping[str, Any], folder: Path | None = None) -> tuple[Sink, DeliveryOptions]:
    """Build a sink and its delivery options from its table.

    Args:
        name: of the sink.
        values: the other keys of the table; ``url`` must be there.
        folder: of the store, for what a sink has to keep over a restart; None where nothing is kept.

    Raises:
        ConfigError: a key or value cannot be, or a secret cannot be had; names the sink.
        MissingExtra: a package that the sink needs is not installed.
    """
    table = SinkTable(name, values, folder)
    url = table.get("url", str)
    if url is None:
        raise table.refuse("url", "needs a url, such as mqtt://broker:1883")
    parts = urlsplit(url)
    kind = _KINDS.get(parts.scheme)
    if kind is None:
        raise table.refuse("url", f"{parts.scheme or shown(url)} is no kind of sink; there are {', '.join(_KINDS)}")
    _check_port(parts, table)
    if parts.password is not None:
        raise table.refuse("url", "a password does not belong here; name a file by password_file")
    known = kind.keys | _COMMON
    for key in values:
        if key not in known:
            near = get_close_matches(key, known, 1)
            raise table.refuse(
                key, f"unknown key{f', is {near[0]} meant' if near else ''}; there are {', '.join(sorted(known))}"
            )
    return kind.make(parts, table), _delivery(table)


_REPORT: Final = frozenset({"report", "period", "deadband", "deadband_percent", "max_silence"})
_COMMON: Final = frozenset({"name", "url", "points", "most", "age", "keep"}) | _REPORT
_TLS: Final = frozenset({"authority", "certificate", "key"})
_PASSWORD: Final = frozenset({"password_file", "password_variable"})
_TOKEN: Final = frozenset({"token_file", "token_variable"})


def _delivery(table: SinkTable) -> DeliveryOptions:
    points = table.get("points", list, ["*"])
    if not points or not all(isinstance(each, str) for each in points):
        raise table.refuse("points", "a list of patterns such as meter-7/* is needed")
    whole = tuple(each if "/" in each or each == "*" else f"{each}/*" for each in points)
    percent = table.get("deadband_percent", (int, float))
    when = table.get("report", str, "every")
    if when not in ("every", "change", "change_or_period"):
        raise table.refuse("report", f"is every, change or change_or_period, not {when!r}")
    report = ReportRule(
        when,
        period=table.get("period", (int, float)),
        deadband=float(percent) if percent is not None else table.number("deadband", 0.0),
        percent=percent is not None,
        max_silence=table.get("max_silence", (int, float)),
    )
    try:
        return DeliveryOptions(
            points=whole,
            most=table.get("most", int, 5000),
            age=table.number("age", 1.0),
            keep=table.number("keep", 7 * 86_400.0),
            report=report,
        )
    except ConfigError as error:
        raise table.refuse(error.key or "sink", error.message) from error


def _mqtt(parts: SplitResult, table: SinkTable) -> Sink:
    from .mqtt import MqttSink

    encrypts = parts.scheme == "mqtts"
    return MqttSink(
        host_of(parts, table),
        parts.port or (8883 if encrypts else 1883),
        topic=table.get("topic", str, "busway/{device}"),
        per_point=table.get("per_point", bool, False),
        retain=table.get("retain", bool, False),
        discovery=table.get("discovery", str),
        user=None if parts.username is None else unquote(parts.username),
        password=table.secret("password"),
        tls=table.tls(encrypts),
        client_id=table.get("client_id", str),
    )


def _sparkplug(parts: SplitResult, table: SinkTable) -> Sink:
    from .sparkplug import SparkplugSink

    encrypts = parts.scheme.endswith("mqtts")
    names = {key: table.get(key, str) for key in ("group", "edge_node")}
    for key, name in names.items():
        if name is None:
            raise table.refuse(key, "Sparkplug needs the names of a group and an edge node")
    return SparkplugSink(
        host_of(parts, table),
        parts.port or (8883 if encrypts else 1883),
        **names,
        primary_host=table.get("primary_host", str),
        number_file=table.kept_file("sparkplug"),
        user=None if parts.username is None else unquote(parts.username),
        password=table.secret("password"),
        tls=table.tls(encrypts),
        client_id=table.get("client_id", str),
    )


def _postgresql(parts: SplitResult, table: SinkTable) -> Sink:
    from .postgresql import PostgresqlSink

    encrypts = "sslmode=" in parts.query and "sslmode=disable" not in parts.query
    has_files = any(table.get(name, str) is not None for name in _TLS)
    return PostgresqlSink(
        parts.geturl(),
        table=table.get("table", str, "samples"),
        password=table.secret("password"),
        tls=table.tls(True) if has_files or encrypts else None,
        timescale=table.get("timescale", bool, False),
    )


def _influxdb(parts: SplitResult, table: SinkTable) -> Sink:
    from .influxdb import InfluxSink

    scheme = parts.scheme.removeprefix("influxdb+")
    return InfluxSink(
        parts._replace(scheme=scheme).geturl(),
        measurement=table.get("measurement", str, "samples"),
        token=table.secret("token"),
        tls=table.tls(scheme == "https"),
    )


def _nats(parts: SplitResult, table: SinkTable) -> Sink:
    from .nats import NatsSink

    return NatsSink(
        parts._replace(netloc=f"{host_of(parts, table)}:{parts.port or 4222}").geturl(),
        subject=table.get("subject", str, "busway.{device}"),
        stream=table.get("stream", str),
        user=None if parts.username is None else unquote(parts.username),
        password=table.secret("password"),
        token=table.secret("token"),
        tls=table.tls(parts.scheme == "tls"),
    )


def _file(parts: SplitResult, table: SinkTable) -> Sink:
    from .files import FileSink

    return FileSink(unquote(parts.netloc + parts.path), table.get("format", str))


def host_of(parts: SplitResult, table: SinkTable) -> str:
    """The host of a URL. Raises `ConfigError` where it names none."""
    if not parts.hostname:
        raise table.refuse("url", "names no host")
    return parts.hostname


def _check_port(parts: SplitResult, table: SinkTable) -> None:
    try:
        _ = parts.port
    except ValueError as error:
        raise table.refuse("url", str(error)) from error


_MQTT: Final = frozenset({"topic", "per_point", "retain", "discovery", "client_id"}) | _PASSWORD | _TLS
_SPARKPLUG: Final = frozenset({"group", "edge_node", "primary_host", "client_id"}) | _PASSWORD | _TLS
_KINDS: Final = {
    "mqtt": _Kind(_MQTT, _mqtt),
    "mqtts": _Kind(_MQTT, _mqtt),
    "sparkplug+mqtt": _Kind(_SPARKPLUG, _sparkplug),
    "sparkplug+mqtts": _Kind(_SPARKPLUG, _sparkplug),
    "postgresql": _Kind(frozenset({"table", "timescale"}) | _PASSWORD | _TLS, _postgresql),
    "influxdb+http": _Kind(frozenset({"measurement"}) | _TOKEN | _TLS, _influxdb),
    "influxdb+https": _Kind(frozenset({"measurement"}) | _TOKEN | _TLS, _influxdb),
    "nats": _Kind(frozenset({"subject", "stream"}) | _PASSWORD | _TOKEN | _TLS, _nats),
    "tls": _Kind(frozenset({"subject", "stream"}) | _PASSWORD | _TOKEN | _TLS, _nats),
    "file": _Kind(frozenset({"format"}), _file),
}
