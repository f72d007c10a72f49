"""Makes a sink, and the options of its delivery, from a table ``[[sink]]`` of the collector file.

Knows sections and sinks; knows no store.

1. Secrets come from a file (``password_file``, ``token_file``) or from the environment (``password_variable``,
   ``token_variable``), so that they are in no configuration, no list of processes and no log.
2. A file with a secret that others can read is refused.
"""

import os
import ssl
import stat
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from ....config.files import sinks
from ....config.files.sinks import SentSection
from ....errors import ConfigError
from ....options.sinks import (
    CertificateOptions,
    DeliveryOptions,
    FileOptions,
    InfluxOptions,
    MqttOptions,
    NatsOptions,
    PostgresqlOptions,
    SparkplugOptions,
)
from ....points.name_patterns import point_pattern
from ....safe_files import read_safely
from .interface import Sink

_LONGEST_SECRET: Final = 4096


def make_sink(section: SentSection, folder: Path | None = None) -> tuple[Sink, DeliveryOptions]:
    """Create a sink and the options of its delivery from a table of the collector file. Nothing is connected yet.

    Args:
        section: the sink's table ``[[sink]]``; its paths are already joined to the folder of the collector file.
        folder: the store's folder, where a Sparkplug sink keeps a number over a restart; None to keep nothing.

    Returns:
        The sink; and the options, in which a device alone has become the pattern ``device/*``.

    Raises:
        ConfigError: values exclude each other or are not valid, or a certificate, password or token cannot be used;
            names the key or the file.
        MissingExtra: a package that the sink needs is not installed.
    """
    options = section.built(DeliveryOptions)
    points = tuple(map(point_pattern, options.points))
    return _MAKERS[type(section)](section, folder), replace(options, points=points)


def broker(section: SentSection) -> dict[str, Any]:  # arguments of different types
    """Return the arguments with which an MQTT client connects: ``host``, ``port``, ``tls``, ``user``, ``password``.

    Raises:
        ConfigError: the URL names no host, or a certificate, password or token cannot be used.
    """
    encrypts = section.parts.scheme.endswith("mqtts")
    port = section.parts.port or (8883 if encrypts else 1883)
    return {"host": _host(section), "port": port, "tls": tls(section, encrypts), **_login(section)}


def nats_server(section: SentSection) -> dict[str, Any]:  # arguments of different types
    """Return the arguments with which a NATS client connects: ``url``, ``tls``, ``token``, ``user``, ``password``.

    Raises:
        ConfigError: the URL names no host, or a certificate, password or token cannot be used.
    """
    parts = section.parts
    url = parts._replace(netloc=f"{_host(section)}:{parts.port or 4222}").geturl()
    return {
        "url": url,
        "tls": tls(section, parts.scheme == "tls"),
        "token": secret(section, "token"),
        **_login(section),
    }


def _host(section: SentSection) -> str:
    if not section.parts.hostname:
        raise ConfigError("names no host", key="url")
    return section.parts.hostname


def _login(section: SentSection) -> dict[str, str | None]:
    user = section.parts.username
    return {"user": None if user is None else unquote(user), "password": secret(section, "password")}


def secret(section: SentSection, key: str) -> str | None:
    """Return a password or token, read from the file or the environment variable that a table names.

    Args:
        section: the table of the collector file.
        key: ``password`` or ``token``.

    Returns:
        The secret, from a file without line breaks at its ends; None if the table names neither file nor variable.

    Raises:
        ConfigError: the table names file and variable, the variable is not set, or the file cannot be read, is longer
            than 4096 bytes or can be read by other users.
    """
    file, variable = getattr(section, f"{key}_file"), getattr(section, f"{key}_variable")
    if file is not None and variable is not None:
        raise ConfigError(f"{key}_file and {key}_variable exclude each other", key=f"{key}_file")
    if variable is not None:
        if variable not in os.environ:
            raise ConfigError(f"the environment has no {variable}", key=f"{key}_variable")
        return os.environ[variable]
    return None if file is None else _secret_of(file)


def _secret_of(file: str) -> str:
    mode = os.stat(file).st_mode if os.path.exists(file) else 0
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError("holds a secret and can be read by others; chmod 600 it", file=file)
    return read_safely(file, most=_LONGEST_SECRET).decode("utf-8", "replace").strip("\r\n")


def tls(section: SentSection, wanted: bool) -> ssl.SSLContext | None:
    """Return the TLS context for a table's certificate options if TLS is wanted, else None.

    Args:
        section: the table.
        wanted: whether the URL of the table asks for TLS.

    Raises:
        ConfigError: a file cannot be used, or the table has certificate options and its URL asks for no TLS.
    """
    given = section.options_of(CertificateOptions)
    if wanted:
        return tls_context(**given)
    for name in given:
        raise ConfigError("is for a URL that encrypts", key=name)
    return None


def tls_context(authority: str | None = None, certificate: str | None = None, key: str | None = None) -> ssl.SSLContext:
    """Return a TLS context that checks a server's certificate; TLS 1.2 or later.

    Args:
        authority: file with the certificates of trusted authorities; None for the system's own.
        certificate: file with the client's own certificate; None for none.
        key: file with the private key of ``certificate``; None if the certificate file contains it.

    Raises:
        ConfigError: a file cannot be used.
    """
    name, together = authority, ""
    try:
        context = ssl.create_default_context(cafile=authority)
        context.sslsocket_class = _Socket
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        if certificate is not None:
            name, together = certificate, "" if key is None else f" with the key {key}"
            context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"cannot be used for TLS{together}: {error}", file=name) from error
    return context


class _Socket(ssl.SSLSocket):
    """A TLS socket that closes itself if its handshake fails; the MQTT library would leave it open."""

    def do_handshake(self, block: bool = False) -> None:
        """Perform the TLS handshake; if it fails, close the socket and raise `OSError`."""
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


def _mqtt(section: SentSection, folder: Path | None) -> Sink:
    from .mqtt import MqttSink

    return MqttSink(**broker(section), **section.options_of(MqttOptions))


def _sparkplug(section: SentSection, folder: Path | None) -> Sink:
    from .sparkplug import SparkplugSink

    number_file = None if folder is None else folder / f"sparkplug-{section.name}.json"
    return SparkplugSink(**broker(section), **section.options_of(SparkplugOptions), number_file=number_file)


def _postgresql(section: SentSection, folder: Path | None) -> Sink:
    from .postgresql import PostgresqlSink

    query = section.parts.query
    encrypts = "sslmode=" in query and "sslmode=disable" not in query
    wanted = encrypts or bool(section.options_of(CertificateOptions))
    options = section.options_of(PostgresqlOptions)
    return PostgresqlSink(section.url, password=secret(section, "password"), tls=tls(section, wanted), **options)


def _influxdb(section: SentSection, folder: Path | None) -> Sink:
    from .influxdb import InfluxSink

    url = section.url.removeprefix("influxdb+")
    context = tls(section, url.startswith("https"))
    return InfluxSink(url, token=secret(section, "token"), tls=context, **section.options_of(InfluxOptions))


def _nats(section: SentSection, folder: Path | None) -> Sink:
    from .nats import NatsSink

    return NatsSink(**nats_server(section), **section.options_of(NatsOptions))


def _file(section: SentSection, folder: Path | None) -> Sink:
    from .files import FileSink

    return FileSink(unquote(section.parts.netloc + section.parts.path), section.built(FileOptions).format)


_MAKERS: Final[Mapping[type[SentSection], Callable[[SentSection, Path | None], Sink]]] = {
    sinks.MqttSinkSection: _mqtt,
    sinks.SparkplugSinkSection: _sparkplug,
    sinks.PostgresqlSinkSection: _postgresql,
    sinks.InfluxSinkSection: _influxdb,
    sinks.NatsSinkSection: _nats,
    sinks.FileSinkSection: _file,
}
