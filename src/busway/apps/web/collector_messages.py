"""Responses of the HTTP API of a collector's page, as data classes.

Knows nothing but the form of responses. Times are milliseconds since 1970 UTC, except those of trends: seconds since
1970 UTC, as the chart of the page needs them.
"""

from typing import Literal

from pydantic import Field

from .messages import Answer, Plain


class CollectorAnswer(Answer):
    """Response: name, size and store of a collector."""

    name: str
    store: str
    devices: int
    samples: int = Field(description="Samples stored since the start.")
    waiting: int = Field(description="Samples that are not yet committed.")
    lost: int = Field(description="Samples that could not be stored.")
    error: str | None = Field(description="What is wrong with the store.")
    restart_needed: list[str] = Field(description="Keys of the file whose changes hold after the next start.")
    refused: list[str] = Field(description="Lines and keys for which the file was refused when it was read last.")
    in_fleet: bool = Field(default=False, description="Whether it is one of a fleet; /api/fleet shows its zone then.")


class CollectedPoint(Answer):
    """Response: one point that is collected, with its type and unit of measure."""

    device: str
    point: str
    unit_of_measure: str
    kind: Literal["number", "state", "text"]
    enumeration: dict[str, int] = Field(
        default_factory=dict, description="Numbers by name; each can be written by name."
    )
    flags: dict[str, int] = Field(default_factory=dict, description="Bits of a whole number by name.")
    writable: bool


class CollectedPoints(Answer):
    """Response: all points that the collector reads."""

    revision: int = Field(
        description="Names this list: another number after each change and each start. The stream has it too."
    )
    points: list[CollectedPoint]


class CollectedValues(Answer):
    """Response: last committed values, in columns with an entry for each point."""

    now: int = Field(description="Time of the answer; the age of a value is the difference.")
    value: list[Plain | None]
    quality: list[str] = Field(description="good, uncertain, bad; empty for a point that was not read yet.")
    reason: list[str]
    time: list[int | None]


class DeviceAnswer(Answer):
    """Response: the status of a polled device."""

    name: str
    link: str
    state: str
    reads: int
    failures: int
    skipped: int
    last_error: str
    learnt: list[str]
    silent_since: int | None = Field(description="Since when it is not polled; null while it is.")


class CollectedDevices(Answer):
    """Response: the status of all polled devices."""

    now: int
    devices: list[DeviceAnswer]


class SilentDevice(Answer):
    """Response: a device that is not polled, and since when."""

    device: str
    since: int


class LinkAnswer(Answer):
    """Response: the load of a link, in seconds of reads per second."""

    name: str
    planned: float
    busy: float = Field(description="Since the start.")
    probing: float = Field(description="The part of it that went to silent devices.")
    latency: list[float] = Field(description="Seconds within which 50, 90 and 99 % of the last reads came.")
    silent: list[SilentDevice]
    problems: list[str]


class ReadAnswer(Answer):
    """Response: one planned read request of a link."""

    link: str
    device: str
    poll_class: str
    first: str
    count: int
    points: int
    seconds: float


class LinksAnswer(Answer):
    """Response: the load of all links, and their planned reads."""

    now: int
    links: list[LinkAnswer]
    reads: list[ReadAnswer]
    more_reads: int = Field(description="Reads that are left out.")


class SinkAnswer(Answer):
    """Response: the status of a sink, a system that gets the samples."""

    name: str
    behind: int = Field(description="Commits that it has not taken yet.")
    sent: int
    lost: int
    set_aside: int
    error: str | None


class SinksAnswer(Answer):
    """Response: the status of all sinks."""

    sinks: list[SinkAnswer]
    prometheus: list[str] = Field(description="URLs of pages for Prometheus.")


LogLevel = Literal["debug", "info", "warning", "error"]


class LogLine(Answer):
    """Response: one log message of the collector."""

    number: int = Field(description="Greater than that of every message before.")
    at: int
    level: LogLevel
    source: str
    text: str


class LogAnswer(Answer):
    """Response: the latest log messages of the collector."""

    lines: list[LogLine]
    dropped: int = Field(description="Older messages that are no longer kept.")


class TrendAnswer(Answer):
    """Response: the history of a point for a chart; null where nothing is known."""

    begin: float
    end: float
    time: list[float]
    minimum: list[float | None]
    maximum: list[float | None]
    mean: list[float | None]
