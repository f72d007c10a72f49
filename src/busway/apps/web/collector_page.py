"""The web page of a collector, and the HTTP API below it.

Knows a running collector, its store and HTTP; asks no device.

1. Only stored samples are shown: present values come from commits, history from the store.
2. A trend has at most `MOST_BUCKETS` buckets, and at most `MOST_QUERIES` trends are read from the store at once.
3. On a loopback address callers without a token may view; on other addresses they are refused. No caller writes without
   a role for it. The tokens are created once, in a file that only its owner can read, by default in the folder
   of the store.
"""

import asyncio
import contextlib
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from fastapi import FastAPI, Query
from starlette.exceptions import HTTPException
from starlette.routing import WebSocketRoute

from ...config.paths import within
from ...options.tls import TlsParameters
from ...points.point import Point
from ..collector.collector import Collector
from ..collector.configuration import CollectorConfiguration
from ..collector.preview import CollectorPreview, preview
from ..collector.report_rules import store_rules
from ..collector.samples import NANOSECONDS, Quality, SampleValue, quality_of, reason_text
from ..collector.store.query_results import BucketTable
from ..collector.store.store_reader import Store
from ..collector.store.writer import Commit
from .access_tokens import TOKEN_FILE, KeptTokens
from .application import PageModule
from .collector_alarms import AlarmApi
from .collector_commands import CommandsApi
from .collector_log import MOST_LINES, CollectorLog
from .collector_messages import (
    CollectedDevices,
    CollectedPoint,
    CollectedPoints,
    CollectedValues,
    CollectorAnswer,
    DeviceAnswer,
    LinkAnswer,
    LinksAnswer,
    LogAnswer,
    LogLevel,
    ReadAnswer,
    SilentDevice,
    SinkAnswer,
    SinksAnswer,
    TrendAnswer,
)
from .collector_stream import CollectorStream
from .hosting import HostedPage
from .messages import Failure, plain_value
from .request_guard import ROLES, PageAccessRules, Role

if TYPE_CHECKING:
    from .fleet_page import FleetApi

PERCENTILES: Final = (0.5, 0.9, 0.99)
MOST_BUCKETS: Final = 2000
MOST_QUERIES: Final = 2
MOST_READS: Final = 2000
"""Largest number of planned reads that ``/api/links`` lists; the others are counted."""
_PLAN_SECONDS: Final = 30.0
"""Seconds for which ``/api/links`` shows the same read plans; then they are computed again."""
_LONGEST: Final = 366 * 86_400.0
_MILLION: Final = 1_000_000


class CollectorPage(HostedPage):
    """The web page of a running collector with its API; it is served while the ``async with`` block lasts.

    Tokens, TLS and subjects of client certificates are those of ``[page_access]`` in the collector's file.

    Args:
        collector: the running collector.
        at: host and port to listen on; port 0 takes a free port.
        fleet: the route that shows the collector's fleet; None for a collector outside a fleet.

    Attributes:
        token_path: the file with the page's tokens; created by `start` if it does not exist.
        title, description: title and description of the OpenAPI document.
        name: name of the page's module.
        api: the routes that only read.
        commands: the routes for commands and the configuration.

    Raises:
        ConfigError: the address is invalid. Raised by `start`: the file of tokens cannot be read or created.
    """

    title = "busway collector"
    description = "Last values, history, links, devices and sinks of a collector."
    name = "collector"

    def __init__(self, collector: Collector, at: str, fleet: "FleetApi | None" = None) -> None:
        configuration = collector.configuration
        access = configuration.file.page_access
        super().__init__(at, key="page", tls=_tls_of(configuration))
        self.token_path: Path = (
            Path(configuration.store) / TOKEN_FILE
            if access.tokens is None
            else Path(within(configuration.name, access.tokens))
        )
        self._subjects = {subject: ROLES[label] for subject, label in access.subjects.items()}
        self._collector = collector
        self._fleet = fleet
        self.api: CollectorApi = CollectorApi(collector, is_in_fleet=fleet is not None)
        self.commands: CommandsApi = CommandsApi(collector)

    def _rules(self, *, local: bool) -> PageAccessRules:
        kept = KeptTokens(self.token_path)
        return PageAccessRules(kept.current, self._subjects, Role.VIEW if local else None, is_loopback=local)

    def _lasting(self) -> contextlib.AbstractContextManager[object]:
        return self.api.log

    def modules(self) -> list[PageModule]:
        """Return the modules that the page shows: the collector, and its fleet if it is in one."""
        return [self, *([] if self._fleet is None else [self._fleet])]

    def add_to(self, application: FastAPI) -> None:
        """Add the routes of the collector to a FastAPI application."""
        self.api.add_to(application)
        self.commands.add_to(application)
        AlarmApi(self._collector).add_to(application)


def _tls_of(configuration: CollectorConfiguration) -> TlsParameters | None:
    """Return the TLS files of the page, from ``[page_access]``; None if there is no certificate: HTTP is used."""
    access = configuration.file.page_access
    if access.certificate is None:
        return None

    def path(name: str | None) -> str | None:
        return None if name is None else within(configuration.name, name)

    return TlsParameters(
        certificate=path(access.certificate),
        key=path(access.key),
        password_file=path(access.password_file),
        authority=path(access.authority),
        revocation_list=path(access.revocation_list),
    )


class CollectorApi:
    """Routes of the collector's page that only read: points, values, devices, links, sinks, log, trends.

    Args:
        collector: the running collector.
        is_in_fleet: whether the collector belongs to a fleet, which the page then shows, too.

    Attributes:
        stream: the WebSockets of the open pages.
        log: the latest log messages; installed while the page is served.
    """

    def __init__(self, collector: Collector, *, is_in_fleet: bool = False) -> None:
        self._collector, self._is_in_fleet = collector, is_in_fleet
        self.stream: CollectorStream = CollectorStream(collector)
        self.log: CollectorLog = CollectorLog()
        self._newest = 0
        self._queries = asyncio.Semaphore(MOST_QUERIES)
        self._planned: tuple[float, CollectorPreview] | None = None
        self._planning = asyncio.Lock()
        collector.subscribe(self._committed)

    def _committed(self, commit: Commit) -> None:
        self._newest = commit.number

    def add_to(self, application: FastAPI) -> None:
        """Add these routes and the WebSocket ``/stream`` to a FastAPI application."""
        add = application.add_api_route
        add("/api/collector", self.get_collector, methods=["GET"], summary="The collector and its store")
        add("/api/points", self.list_points, methods=["GET"], summary="The points that are collected")
        add("/api/values", self.list_values, methods=["GET"], summary="The last committed value of each point")
        add("/api/devices", self.list_devices, methods=["GET"], summary="The devices, and what was learnt of them")
        add("/api/links", self.list_links, methods=["GET"], summary="The links, their load and their reads")
        add("/api/log", self.list_log, methods=["GET"], summary="What the collector said last, the newest first")
        add("/api/sinks", self.list_sinks, methods=["GET"], summary="The sinks, and how far behind they are")
        application.routes.append(WebSocketRoute("/stream", self.stream.serve))
        add(
            "/api/trend",
            self.get_trend,
            methods=["GET"],
            summary="The history of a point, in buckets",
            responses={404: {"model": Failure, "description": "There is no such point."}},
        )

    async def get_collector(self) -> CollectorAnswer:
        """Return name, number of devices and store of the collector, its last error, and whether it needs a restart."""
        configuration, store = self._collector.configuration, self._collector.store_status()
        return CollectorAnswer(
            name=Path(configuration.name).stem,
            store=configuration.store,
            devices=len(configuration.devices),
            samples=store.samples,
            waiting=store.waiting,
            lost=store.lost,
            error=store.error or store.upkeep_error,
            restart_needed=self._collector.restart_needed,
            refused=self._collector.refused_file,
            in_fleet=self._is_in_fleet,
        )

    async def list_points(self) -> CollectedPoints:
        """Return all collected points, without values: device, name, unit of measure, kind, names of values.

        The order is that of the configuration; the columns of ``/api/values`` have the same order.
        """
        self.stream.refresh()
        return CollectedPoints(
            revision=self.stream.revision,
            points=[
                CollectedPoint(
                    device=device.name,
                    point=point.name,
                    unit_of_measure=point.unit_of_measure,
                    kind=_kind(point),
                    enumeration=dict(point.conversion.names),
                    flags=dict(point.conversion.flags),
                    writable=point.writing is not None,
                )
                for device in self._collector.configuration.devices.values()
                for point in device.points
            ],
        )

    async def list_values(self) -> CollectedValues:
        """Return the last values as columns, which have an entry for each point in the order of ``/api/points``.

        For a point that was not read since the start, value and time are null.
        """
        values, reasons, times = await asyncio.to_thread(self.stream.refresh().columns)
        return CollectedValues(
            now=time.time_ns() // _MILLION,
            value=[plain_value(value) for value in values],
            quality=[
                quality_of(reason).label if at or reason else "" for reason, at in zip(reasons, times, strict=True)
            ],
            reason=[reason_text(reason) if reason else "" for reason in reasons],
            time=[at or None for at in times],
        )

    async def list_devices(self) -> CollectedDevices:
        """Return the status of each device: state, numbers of reads and failures, last error, and what was learnt."""
        return CollectedDevices(
            now=time.time_ns() // _MILLION,
            devices=[
                DeviceAnswer(
                    name=each.name,
                    link=each.link,
                    state=each.state,
                    reads=each.reads,
                    failures=each.failures,
                    skipped=each.skipped,
                    last_error=each.last_error,
                    learnt=list(each.learnt),
                    silent_since=None if each.silent_since is None else each.silent_since // _MILLION,
                )
                for each in self._collector.status()
            ],
        )

    async def list_links(self) -> LinksAnswer:
        """Return the planned and the real load of each link, and the planned reads with the estimated time of each."""
        planned, real = await self._plan(), self._collector.loads()
        latencies, silent = self._collector.latencies(PERCENTILES), self._silent()
        devices = self._collector.configuration.devices
        return LinksAnswer(
            now=time.time_ns() // _MILLION,
            links=[
                LinkAnswer(
                    name=load.link,
                    planned=load.load,
                    busy=real.get(load.link, (0.0, 0.0))[0],
                    probing=real.get(load.link, (0.0, 0.0))[1],
                    latency=latencies.get(load.link, []),
                    silent=silent.get(load.link, []),
                    problems=list(load.problems),
                )
                for load in planned.loads
            ],
            reads=[
                ReadAnswer(
                    link=devices[read.device].link if read.device in devices else "",
                    device=read.device,
                    poll_class=read.poll_class,
                    first=read.first,
                    count=read.count,
                    points=read.points,
                    seconds=read.seconds,
                )
                for read in planned.reads[:MOST_READS]
            ],
            more_reads=max(len(planned.reads) - MOST_READS, 0),
        )

    def _silent(self) -> dict[str, list[SilentDevice]]:
        found: dict[str, list[SilentDevice]] = {}
        for each in self._collector.status():
            if each.silent_since is not None:
                silent = SilentDevice(device=each.name, since=each.silent_since // _MILLION)
                found.setdefault(each.link, []).append(silent)
        return found

    async def _plan(self) -> CollectorPreview:
        async with self._planning:
            now = time.monotonic()
            if self._planned is None or now - self._planned[0] > _PLAN_SECONDS:
                collector = self._collector
                made = await asyncio.to_thread(preview, collector.configuration, collector.knowledge)
                self._planned = now, made
            return self._planned[1]

    async def list_sinks(self) -> SinksAnswer:
        """Return the status of each sink: how far behind it is, what was sent and lost, and its last error."""
        return SinksAnswer(
            sinks=[
                SinkAnswer(
                    name=each.name,
                    behind=max(self._newest - each.cursor, 0),
                    sent=each.sent,
                    lost=each.lost,
                    set_aside=each.set_aside,
                    error=each.error,
                )
                for each in self._collector.sink_statuses()
            ],
            prometheus=self._collector.pages,
        )

    async def list_log(
        self,
        limit: Annotated[int, Query(ge=1, le=MOST_LINES)] = 200,
        level: Annotated[LogLevel, Query(description="The least level.")] = "info",
        search: Annotated[str, Query(max_length=200)] = "",
    ) -> LogAnswer:
        """Return the log messages of a level or above that contain all searched words, the newest first.

        Searched are source and text of the last messages that are kept; upper and lower case count the same.
        """
        return self.log.lines(limit, level, search)

    async def get_trend(
        self,
        device: Annotated[str, Query(max_length=200)],
        point: Annotated[str, Query(max_length=200)],
        seconds: Annotated[float, Query(ge=1, le=_LONGEST, description="How far back.")] = 3600.0,
        buckets: Annotated[int, Query(ge=10, le=MOST_BUCKETS)] = 600,
    ) -> TrendAnswer:
        """Return minimum, maximum and mean of a point in each bucket of time; null where nothing is known.

        A bucket is at least 1 ms long. An unknown point is answered with 404.
        """
        configuration = self._collector.configuration
        known = configuration.devices.get(device)
        if known is None or all(each.name != point for each in known.points):
            raise HTTPException(404, f"there is no point {device}/{point}")
        classes = [configuration.periods[each] for each in known.items if each in configuration.periods]
        length = max(seconds / buckets, 0.001)
        now = time.time_ns()
        async with self._queries:
            table = await asyncio.to_thread(
                _read, configuration.store, f"{device}/{point}", now - int(seconds * NANOSECONDS), length
            )
        if (device, point) not in store_rules(configuration, device):
            return _trend(table, now, seconds, max(3 * max(classes, default=1.0), 2 * length))
        return _held_trend(_trend(table, now, seconds, math.inf, length), self._collector.values.last(device, point))


def _kind(point: Point) -> Literal["number", "state", "text"]:
    """Return the kind of value that a user enters for a point: a number, a state (on or off), or a text."""
    if point.type.startswith("bit"):
        return "state"
    return "text" if point.type.startswith(("string", "ip", "eui")) else "number"


def _read(folder: str, point: str, since: int, bucket: float) -> BucketTable:
    return Store(folder).read(point, since=since, bucket=bucket)


def _trend(table: BucketTable, now: int, seconds: float, longest: float, held: float = math.inf) -> TrendAnswer:
    """Return the columns of a chart from the buckets of a point; its times are seconds since 1970 UTC.

    Args:
        table: the buckets that have samples.
        now: end of the chart, nanoseconds since 1970 UTC.
        seconds: length of the chart in seconds.
        longest: seconds. Between two times that are further apart than this, the chart has a gap (nulls).
        held: seconds. Between two times that are further apart than twice this, the earlier mean is repeated ``held``
            seconds before the later time, so that the chart shows a step. Infinite: no value is repeated.
    """
    answer = TrendAnswer(
        begin=now / NANOSECONDS - seconds, end=now / NANOSECONDS, time=[], minimum=[], maximum=[], mean=[]
    )
    for at, low, high, mean in zip(table.time, table.minimum, table.maximum, table.mean, strict=True):
        moment = at / NANOSECONDS
        if answer.time and moment - answer.time[-1] > longest:
            _add(answer, (answer.time[-1] + moment) / 2, None, None, None)
        elif answer.time and moment - answer.time[-1] > 2 * held:
            _add(answer, moment - held, *(answer.mean[-1],) * 3)
        _add(answer, moment, low, high, mean)
    return answer


def _held_trend(answer: TrendAnswer, last: tuple[SampleValue | None, int, int] | None) -> TrendAnswer:
    """Extend a chart to the time at which the point was read last, with its last value. Changes and returns ``answer``.

    For points of which the store keeps only changes. An empty chart gets the last value at its begin, too.

    Args:
        answer: the chart.
        last: value, reason code and time (nanoseconds since 1970 UTC) of the point's last sample; None without a
            sample. A value that is bad or no number extends nothing.
    """
    value, reason, time = last or (None, 0, 0)
    if isinstance(value, int | float) and math.isfinite(value) and quality_of(reason) is not Quality.BAD:
        if not answer.time:  # no change, no gap
            _add(answer, answer.begin, value, value, value)
        if answer.mean[-1] is not None and time / NANOSECONDS > answer.time[-1]:
            _add(answer, time / NANOSECONDS, value, value, value)
    return answer


def _add(answer: TrendAnswer, at: float, low: float | None, high: float | None, mean: float | None) -> None:
    answer.time.append(at)
    for column, value in ((answer.minimum, low), (answer.maximum, high), (answer.mean, mean)):
        column.append(None if value is None else float(value))
