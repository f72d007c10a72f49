"""Options of sinks: which samples a sink gets, in what batches, and the options of each kind of sink."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, Final

from ..errors import ConfigError
from ..points.point_rules import ReportRule
from .declaration import Mark, Name, Range, check

LONGEST_SECONDS: Final = 86_400.0
"""Longest time until a command expires that is accepted, in seconds."""


@dataclass(frozen=True, slots=True)
class DeliveryOptions:
    """Options of all sinks to which samples are sent: which samples, and in what batches."""

    points: Annotated[
        tuple[str, ...],
        Name("a list of patterns such as meter-7/*"),
        "patterns `device/point` of what it gets; a device alone means all its points.",
    ] = ("*",)
    most: Annotated[int, Range(1, 100_000), "samples in one batch."] = 5000
    age: Annotated[float, Range(0, 3600), "seconds for which samples are collected before they are sent."] = 1.0
    keep: Annotated[
        float,
        Range(1, 1e9),
        "seconds for which samples wait for a sink that is down, at least `age`. Older ones are dropped for it, oldest",
        "first, and counted.",
    ] = 7 * 86_400.0
    report: Annotated[ReportRule | None, "which samples are handed on; None: what the points say."] = None

    def __post_init__(self) -> None:
        check(self)
        if self.keep < self.age:
            raise ConfigError(f"must be at least age, {self.age:g}, not {self.keep:g}", key="keep")


@dataclass(frozen=True, slots=True)
class PasswordOptions:
    """Options of a sink that say where its password is read from; the user name is in the URL."""

    password_file: Annotated[str | None, Mark.FILE, "file with the password, readable by its owner alone."] = None
    password_variable: Annotated[str | None, "variable of the environment that has it instead."] = None


@dataclass(frozen=True, slots=True)
class TokenOptions:
    """Options of a sink that say where its access token is read from."""

    token_file: Annotated[str | None, Mark.FILE, "file with the token, readable by its owner alone."] = None
    token_variable: Annotated[str | None, "variable of the environment that has it instead."] = None


@dataclass(frozen=True, slots=True)
class CertificateOptions:
    """Options of a sink whose URL means TLS: files with certificates in PEM."""

    authority: Annotated[
        str | None, Mark.FILE, "file with the authority of the server's certificate; None: those of the system."
    ] = None
    certificate: Annotated[str | None, Mark.FILE, "file with a client certificate."] = None
    key: Annotated[str | None, Mark.FILE, "file with its private key; None where it stands in the same file."] = None


@dataclass(frozen=True, slots=True)
class MqttOptions:
    """Options of a sink that publishes samples by MQTT 5."""

    topic: Annotated[str, "topic of the samples; has `{device}`. `/`, `+` and `#` in names become `_`."] = (
        "busway/{device}"
    )
    per_point: Annotated[bool, "whether each sample is a message of its own, on `topic/{point}`."] = False
    retain: Annotated[bool, "whether the broker keeps the last message of each topic."] = False
    discovery: Annotated[
        str | None,
        "prefix of Home Assistant's discovery, `homeassistant`: points appear there as entities. Needs `per_point`.",
    ] = None
    client_id: Annotated[str | None, "names this client to the broker; None: a random one."] = None


@dataclass(frozen=True, slots=True)
class SparkplugOptions:
    """Options of a sink that publishes samples by Sparkplug B."""

    group: Annotated[str, Name("the name of a group"), "name of the group in all topics."]
    edge_node: Annotated[
        str,
        Name("the name of an edge node"),
        "name of the edge node in all topics; in a fleet with `{collector}`, which is the name of each collector.",
    ]
    primary_host: Annotated[
        str | None,
        "name of the host application without which nothing is sent: samples wait in the store while it is offline.",
    ] = None
    client_id: Annotated[str | None, "names this client to the broker; None: a random one."] = None


@dataclass(frozen=True, slots=True)
class PostgresqlOptions:
    """Options of a sink that writes samples to PostgreSQL or TimescaleDB."""

    table: Annotated[
        str, "name of the table, `schema.table` where it is not in the search path: small letters, digits, `_`."
    ] = "samples"
    alarm_table: Annotated[str, "name of the table of events of alarms, made with the first of them."] = "alarms"
    gap_table: Annotated[
        str, "name of the table of gaps of ownership, made with the first of them; a fleet with a stream has them."
    ] = "ownership_gaps"
    timescale: Annotated[bool, "whether the tables are made hypertables; the database must have the extension."] = False


@dataclass(frozen=True, slots=True)
class InfluxOptions:
    """Options of a sink that posts samples in InfluxDB line protocol."""

    measurement: Annotated[str, "the measurement of samples."] = "samples"
    alarm_measurement: Annotated[str, "the measurement of events of alarms."] = "alarms"


@dataclass(frozen=True, slots=True)
class NatsOptions:
    """Options of a sink that publishes samples to NATS JetStream."""

    subject: Annotated[str, "subject of the samples; has `{device}`."] = "busway.{device}"
    stream: Annotated[
        str | None, "stream that is made where it is not there; None: a stream must have the subjects."
    ] = None


class FileFormat(Enum):
    """Formats of the files that a sink of samples writes."""

    CSV = "csv"
    JSON_LINES = "jsonl"
    PARQUET = "parquet"


@dataclass(frozen=True, slots=True)
class FileOptions:
    """Options of a sink that writes samples to files."""

    format: Annotated[FileFormat | None, "the format; None: what the name ends with."] = None
