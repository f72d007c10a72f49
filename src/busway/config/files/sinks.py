"""Keys of ``[[sink]]`` in collector files, one section class for each kind of sink, which the URL's scheme chooses.

Knows the keys; what they mean is declared in `busway.options.sinks`, and `busway.apps.collector.sinks` makes the sinks.

An example is in `docs/how-to/send-samples-on.md`.
"""

from collections.abc import Mapping
from functools import reduce
from operator import or_
from typing import Annotated, Any, Final, Literal
from urllib.parse import SplitResult, parse_qsl, urlsplit

from pydantic import AfterValidator, BeforeValidator

from ...options import sinks
from ...options.declaration import Name, Range
from ...values.unfit_values import shown
from .options import OptionSection, with_options_of
from .points import Report
from .section import FileProblems, Section
from .toml_source import read_section

_SECRETS: Final = frozenset({"p", "passwd", "password", "sslpassword", "token"})
"""Keys after ``?`` that hold a password or token in URLs of PostgreSQL and InfluxDB; such a URL is refused."""


def _checked_url(url: str) -> str:
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError:  # what stands in the place of a port may be a part of a password: it is not shown
        raise ValueError("its host or port cannot be: HOST:PORT is needed, with a port 0…65535") from None
    given = {key.lower() for key, _ in parse_qsl(parts.query, keep_blank_values=True)}
    if parts.password is not None or given & _SECRETS:
        raise ValueError("a password does not belong here; name a file by password_file or token_file")
    return url


def _checked_points(patterns: list[str]) -> list[str]:
    if not patterns or not all("/" in each for each in patterns):
        raise ValueError('names what may be written: ["meter-7/setpoint", "pump-*/speed"]')
    return patterns


class SinkSection(OptionSection):
    """``[[sink]]`` of a collector file: another system that gets the samples."""

    name: Annotated[
        str,
        Name("a name of letters, digits, - _ and .", r"(?!\.)[\w.-]+"),
        "its place in the store has this name.",
    ]
    url: Annotated[str, AfterValidator(_checked_url), "where to, and by its scheme what kind; never with a password."]

    @property
    def parts(self) -> SplitResult:
        """The parts of the sink's URL, as ``urllib.parse.urlsplit`` gives them: host, port, user, path."""
        return urlsplit(self.url)


@with_options_of(sinks.DeliveryOptions)
class SentSection(SinkSection):
    """Base of the sections of sinks that send samples in batches, which is all but ``prometheus://``."""

    report: Annotated[
        Report | None, "which samples are handed on, as `report` of a point; None: what the points say."
    ] = None

    def options_of(self, *kinds: type[Any]) -> dict[str, Any]:  # parameter classes, and values of several types
        """Return the options of the given parameter classes that this sink's table sets, by name.

        ``report`` is returned as a `ReportRule`.
        """
        found = super().options_of(*kinds)
        return found if self.report is None or "report" not in found else found | {"report": self.report.described()}


class CommandsSection(Section):
    """``commands`` of a sink: which points may be written by messages from the sink's server."""

    points: Annotated[
        list[str],
        AfterValidator(_checked_points),
        "patterns `device/point` of what may be written from there.",
    ]
    role: Annotated[
        Literal["operate", "configure"],
        "the role of all messages from there: points whose rule asks for `configure` need that.",
    ] = "operate"
    seconds: Annotated[
        float,
        Range(0, sinks.LONGEST_SECONDS, above=True),
        "seconds within which a command that does not say until when is sent, or else expires.",
    ] = 10.0


class MqttCommandsSection(CommandsSection):
    """``commands`` of an MQTT sink: which points messages from its broker may write."""

    topic: Annotated[str, "topic of commands; `{device}` and `{point}` are levels of their own."] = (
        "busway/{device}/{point}/set"
    )


class NatsCommandsSection(CommandsSection):
    """``commands`` of a NATS sink: which points messages from its server may write."""

    subject: Annotated[str, "subject of commands; `{device}` and `{point}` are levels of their own."] = (
        "busway.{device}.{point}.set"
    )


@with_options_of(sinks.MqttOptions, sinks.PasswordOptions, sinks.CertificateOptions)
class MqttSinkSection(SentSection):
    """``[[sink]]`` with ``mqtt://`` or ``mqtts://``: an MQTT broker that gets the samples."""

    commands: Annotated[MqttCommandsSection | None, "which points may be written by messages."] = None


@with_options_of(sinks.SparkplugOptions, sinks.PasswordOptions, sinks.CertificateOptions)
class SparkplugSinkSection(SentSection):
    """``[[sink]]`` with ``sparkplug+mqtt://`` or ``sparkplug+mqtts://``: a Sparkplug B broker."""

    commands: Annotated[CommandsSection | None, "which points host applications may write."] = None


@with_options_of(sinks.PostgresqlOptions, sinks.PasswordOptions, sinks.CertificateOptions)
class PostgresqlSinkSection(SentSection):
    """``[[sink]]`` with ``postgresql://``: a database that gets the samples."""


@with_options_of(sinks.InfluxOptions, sinks.TokenOptions, sinks.CertificateOptions)
class InfluxSinkSection(SentSection):
    """``[[sink]]`` with ``influxdb+http://`` or ``influxdb+https://``: a server of InfluxDB line protocol."""


@with_options_of(sinks.NatsOptions, sinks.PasswordOptions, sinks.TokenOptions, sinks.CertificateOptions)
class NatsSinkSection(SentSection):
    """``[[sink]]`` with ``nats://`` or ``tls://``: a server of NATS JetStream."""

    commands: Annotated[NatsCommandsSection | None, "which points may be written by messages."] = None


@with_options_of(sinks.FileOptions)
class FileSinkSection(SentSection):
    """``[[sink]]`` with ``file://``: files that get the samples."""


class PrometheusSinkSection(SinkSection):
    """``[[sink]]`` with ``prometheus://``: a page of last values that Prometheus scrapes."""

    points: Annotated[
        list[str],
        Name('a list of patterns such as "meter-7/*"'),
        "patterns `device/point` of what it shows; a device alone means all its points.",
    ]
    stale: Annotated[float, Range(0, 1e9, above=True), "seconds after which a value is left out."] = 300.0


KINDS: Final[Mapping[str, type[SinkSection]]] = {
    "mqtt": MqttSinkSection,
    "mqtts": MqttSinkSection,
    "sparkplug+mqtt": SparkplugSinkSection,
    "sparkplug+mqtts": SparkplugSinkSection,
    "postgresql": PostgresqlSinkSection,
    "influxdb+http": InfluxSinkSection,
    "influxdb+https": InfluxSinkSection,
    "nats": NatsSinkSection,
    "tls": NatsSinkSection,
    "file": FileSinkSection,
    "prometheus": PrometheusSinkSection,
}
"""The sections by the scheme of the sink's URL. To add one: its options, its section here, and what makes the sink."""


def sink_section(value: Any) -> SinkSection:  # the value in the file, of any type
    """Return a table ``[[sink]]`` as an object of the section class for the scheme of its ``url``.

    An object of such a class is returned unchanged. Raises `FileProblems` if the table is invalid.
    """
    if isinstance(value, SinkSection):
        return value
    if not isinstance(value, dict):
        raise FileProblems([((), f"must be a table, not {shown(value)}")])
    url = value.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    kind = KINDS.get(scheme)
    if kind is None:
        given = "is missing" if url is None else f"{scheme or shown(url)} is no kind of sink"
        raise FileProblems([(("url",), f"{given}; there are {', '.join(KINDS)}")])
    return read_section(kind, value)


AnySink = Annotated[
    SinkSection, BeforeValidator(sink_section, json_schema_input_type=reduce(or_, dict.fromkeys(KINDS.values())))
]
