"""Shows the last values of points for Prometheus to scrape. A scrape never polls a device.

Knows what was committed last; the format is prometheus-client's (``busway[metrics]``).

1. Only points that the patterns name are shown, because each is a time series that Prometheus keeps.
2. Bad values, texts and values older than ``stale`` seconds are left out, so that a series ends instead of standing
   still.
3. If a device is not read (suspended, without connection, in maintenance), its last values are shown as bad with that
   reason, until each point is read again: no value stays good while it only grows old.
4. If the store could not be written for some seconds, no value is replaced by a newer one, so all values are shown as
   bad.
5. A good value that was not read again when it was due is shown as held, which is uncertain (`held_values`): the link
   is overloaded or waits for a reply, or polling has ended by a defect. Its age counts from the end of its transaction,
   however long its commit had to wait.
6. A point that is no longer in the configuration has no last value.
7. When the clock is set, earlier last values move with the samples of the store, so that later ones replace them.
"""

import math
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, Final

from ....errors import ConfigError
from ....extras import require
from ....observe.http import HttpService, bind_tcp
from ....observe.http_messages import HttpRequest, HttpResponse
from ....observe.metrics.http_endpoint import render
from ....options.text import host_and_port
from ....points.name_patterns import is_meant, point_pattern
from ..alarms.events import RaisedAlarm
from ..held_values import age_of
from ..samples import (
    NANOSECONDS,
    PointGroup,
    Quality,
    Reason,
    SampleBatch,
    SampleValue,
    StateInterval,
    mended_batch,
    mended_interval,
    quality_of,
)
from ..store.writer import Commit

_FORGET_ABOVE: Final = 10_000
"""Number of kept batches above which batches are removed whose points all have a newer sample."""


class LastValues:
    """The last stored sample of each point. Safe from any thread.

    If a report rule drops the sample of a later read, the stored value is shown with the time of that read. The thread
    that commits calls `update` with each commit.

    Args:
        is_behind: returns whether commits have failed or hung for some seconds, so that newer samples wait (rule 4).
        limits: by device and point, seconds after which a value is held (rule 5); points without a limit never are.
        moment: returns seconds of the monotonic clock.

    Attributes:
        is_behind: as the argument.
        limits: the present limits; `configure` replaces them.
    """

    def __init__(
        self,
        is_behind: Callable[[], bool] = lambda: False,
        limits: Mapping[tuple[str, str], float] | None = None,
        moment: Callable[[], float] = time.monotonic,
    ) -> None:
        self.is_behind: Callable[[], bool] = is_behind
        self.limits: Mapping[tuple[str, str], float] = limits or {}
        self._moment = moment
        self._lock = threading.Lock()
        self._points: frozenset[tuple[str, str]] | None = None
        self._batches: dict[PointGroup, SampleBatch] = {}
        self._taken_at: dict[PointGroup, float] = {}
        self._forget_above = _FORGET_ABOVE
        self._intervals: dict[str, StateInterval] = {}

    def update(self, commit: Commit) -> None:
        """Take over the samples and intervals of a commit that the store has just made.

        Intervals that stand for skipped rounds (`Reason.SKIPPED`) are ignored.

        If the commit has a correction of times, the known samples and intervals are corrected before (rule 7).
        """
        with self._lock:
            correction = commit.correction
            if correction is not None:
                self._batches = {group: mended_batch(each, correction) for group, each in self._batches.items()}
                self._intervals = {name: mended_interval(each, correction) for name, each in self._intervals.items()}
            for batch in commit.last_values:
                self._batches[batch.group] = batch
                self._taken_at[batch.group] = commit.moment - age_of(batch, commit.at)
            for each in commit.intervals:
                if isinstance(each, StateInterval) and each.reason != Reason.SKIPPED:
                    self._intervals[each.device] = each
            if len(self._batches) > self._forget_above:
                self._forget_covered()
                self._forget_above = max(_FORGET_ABOVE, 2 * len(self._batches))

    def configure(self, limits: Mapping[tuple[str, str], float], points: Collection[tuple[str, str]]) -> None:
        """Use the limits and points of a configuration that was read again (rule 6).

        `last` and `samples` no longer give values of other points. Values of devices without points are forgotten.

        Args:
            limits: by device and point, seconds after which a value is held.
            points: device and name of each point.
        """
        with self._lock:
            self.limits, self._points = limits, frozenset(points)
            devices = {device for device, _ in points}
            self._batches = {group: each for group, each in self._batches.items() if group.device in devices}
            self._taken_at = {group: self._taken_at[group] for group in self._batches}

    def reads(self) -> list[tuple[SampleBatch, float]]:
        """Return the last read of each group of points, with the time of its end in seconds of the monotonic clock.

        If a point is in several groups, its last value is in the latest of their reads.
        """
        with self._lock:
            return [(batch, self._taken_at[group]) for group, batch in self._batches.items()]

    def _is_known(self, device: str, point: str) -> bool:
        return self._points is None or (device, point) in self._points

    def _forget_covered(self) -> None:
        """Remove batches whose points all have a newer sample in another batch.

        Call with the lock held.
        """
        latest = self._latest()
        used = {id(batch) for batch, _ in latest.values()}
        self._batches = {group: batch for group, batch in self._batches.items() if id(batch) in used}
        self._taken_at = {group: self._taken_at[group] for group in self._batches}

    def _latest(self) -> dict[tuple[str, str], tuple[SampleBatch, int]]:
        found: dict[tuple[str, str], tuple[SampleBatch, int]] = {}
        for batch in self._batches.values():
            for index, point in enumerate(batch.points):
                known = found.get((batch.device, point))
                if known is None or known[0].time <= batch.time:
                    found[batch.device, point] = (batch, index)
        return found

    def _reason(self, batch: SampleBatch, point: str, reason: int) -> int:
        """Return the number of the reason to show for a last value now, 0 for good (rules 3 to 5).

        Call with the lock held.

        Args:
            batch: the read that gave the value.
            point: name of the point.
            reason: the reason of the sample, 0 for good.
        """
        shown = self._reason_not_read(batch.device, reason, batch.time)
        if shown:
            return shown
        age = self._moment() - self._taken_at[batch.group]
        return Reason.HELD if age > self.limits.get((batch.device, point), math.inf) else shown

    def _reason_not_read(self, device: str, reason: int, time: int) -> int:
        interval = self._intervals.get(device)
        if interval is None or (interval.end is not None and time > interval.begin):
            return Reason.LOST if quality_of(reason) is not Quality.BAD and self.is_behind() else reason
        keeps = quality_of(reason) is Quality.BAD and interval.reason != Reason.MAINTENANCE
        return reason if keeps else interval.reason

    def reason_of(self, device: str) -> int:
        """Return the number of the reason why a device is not read now; 0 while it is read."""
        with self._lock:
            interval = self._intervals.get(device)
        return 0 if interval is None or interval.end is not None else interval.reason

    def intervals(self) -> dict[str, StateInterval]:
        """Return for each device the last interval in which it was not read; its end is None while it lasts.

        Skipped rounds are not such intervals. Devices without an interval since the start are left out.
        """
        with self._lock:
            return dict(self._intervals)

    def last(self, device: str, point: str) -> tuple[SampleValue | None, int, int] | None:
        """Return value, number of the reason and time of the last sample of one point; None if there is no sample.

        The time is in nanoseconds since 1970 UTC. The reason, 0 for good, is the one to show now, which may differ from
        that of the sample (rules 3 to 5).
        """
        found: tuple[SampleValue | None, int, int] | None = None
        with self._lock:
            for batch in self._batches.values():
                if batch.device != device or not self._is_known(device, point):
                    continue
                if point in batch.points and (found is None or batch.time >= found[2]):
                    index = batch.points.index(point)
                    reason = batch.reasons if isinstance(batch.reasons, int) else batch.reasons[index]
                    found = batch.values[index], self._reason(batch, point, reason), batch.time
        return found

    def samples(self) -> Iterator[tuple[str, str, SampleValue | None, int, int]]:
        """Yield device, point, value, number of the reason and time of the last sample of each point, ordered by name.

        Times are nanoseconds since 1970 UTC. The reason, 0 for good, is the one to show now, which may differ from that
        of the sample (rules 3 to 5).
        """
        with self._lock:
            found = []
            for (device, point), (batch, index) in sorted(self._latest().items()):
                if not self._is_known(device, point):
                    continue
                reason = self._reason(batch, point, batch.reason_column()[index])
                found.append((device, point, batch.values[index], reason, batch.time))
        yield from found


class PrometheusPage:
    """HTTP service with the last values for Prometheus, ``http://HOST:PORT/metrics``, in a thread of its own.

    Attributes:
        url: URL of the values.
    """

    def __init__(
        self,
        where: str,
        points: Sequence[str],
        values: LastValues,
        *,
        stale: float = 300.0,
        alarms: Callable[[], Sequence[RaisedAlarm]] = tuple,
        more: Callable[[], Iterable[Any]] = tuple,
        now: Callable[[], int] = time.time_ns,
    ) -> None:
        """Begin to listen for scrapes, in a new thread.

        Args:
            where: address and port, such as ``127.0.0.1:9503``; port 0 takes a free port. Every host that reaches the
                address can read the values.
            points: patterns ``device/point`` of the points to show, at least one; a device alone means all its points.
                Alarms of these points are shown too.
            values: the last values.
            stale: seconds after which a value is left out.
            alarms: returns the alarms that are active or not acknowledged; called in the thread of the service.
            more: returns further families of metrics of prometheus-client; called in the thread of the service.
            now: returns nanoseconds since 1970 UTC.

        Raises:
            ConfigError: there is no pattern, or ``where`` is no address.
            LinkDown: the address cannot be bound.
            MissingExtra: prometheus-client is not installed.
        """
        require("prometheus_client", "a page for Prometheus")
        if not points:
            raise ConfigError('names no point; points = ["meter-7/*"] shows those of a device', key="points")
        # Now, and not at the first scrape: by then an update may have put other files into their place.
        for name in ("prometheus_client.core", "busway.observe.http_connection"):
            import_module(name)
        self._values, self._now = values, now
        self._alarms, self._more = alarms, more
        self.configure(points, stale)
        self._service = HttpService(bind_tcp(*host_and_port(where, "url")), self._answer, name="busway prometheus")
        host, port = self._service.socket.getsockname()[:2]
        self.url: str = f"http://{host}:{port}/metrics"
        self._service.start()

    def configure(self, points: Sequence[str], stale: float) -> None:
        """Set new patterns ``device/point`` of the points to show, and new seconds after which a value is left out.

        As when the page is made, a device alone means all its points.
        """
        self._points, self._stale = tuple(map(point_pattern, points)), stale

    def close(self) -> None:
        """Stop listening for scrapes, and end the thread of the service."""
        self._service.stop()

    def _answer(self, request: HttpRequest) -> HttpResponse:
        from prometheus_client import CollectorRegistry

        registry = CollectorRegistry()
        registry.register(_Collected(self._families))
        return render(registry, request.headers.get("accept", ""))

    def _families(self) -> Iterator[Any]:
        from prometheus_client.core import GaugeMetricFamily

        labels = ["device", "point"]
        value = GaugeMetricFamily("busway_point_value", "Last value of a point.", labels=labels)
        moment = GaugeMetricFamily(
            "busway_point_time_seconds", "When it was read, seconds since 1970 UTC.", labels=labels
        )
        uncertain = GaugeMetricFamily(
            "busway_point_uncertain", "1 for each value that is uncertain: held, out of range, clock.", labels=labels
        )
        oldest = self._now() - int(self._stale * NANOSECONDS)
        for device, point, found, reason, at in self._values.samples():
            if found is None or isinstance(found, str) or quality_of(reason) is Quality.BAD or at < oldest:
                continue
            if any(is_meant(f"{device}/{point}", pattern) for pattern in self._points):
                value.add_metric([device, point], float(found))
                moment.add_metric([device, point], at / NANOSECONDS)
                if reason:
                    uncertain.add_metric([device, point], 1.0)
        yield value
        yield moment
        yield uncertain
        yield from self._alarm_families()
        yield from self._more()

    def _alarm_families(self) -> Iterator[Any]:
        from prometheus_client.core import GaugeMetricFamily

        names = ["device", "point", "limit"]
        active = GaugeMetricFamily("busway_alarm_active", "1 for each active alarm.", labels=names)
        waiting = GaugeMetricFamily(
            "busway_alarm_unacknowledged", "1 for each alarm that waits for a person.", labels=names
        )
        for alarm in self._alarms():
            if any(is_meant(f"{alarm.device}/{alarm.point}", pattern) for pattern in self._points):
                for family, holds in ((active, alarm.state.is_active), (waiting, alarm.state.is_unacknowledged)):
                    if holds:
                        family.add_metric(list(alarm.key), 1.0)
        yield active
        yield waiting


class _Collected:
    """Gives the metrics to the Prometheus client library, which calls `collect` at each scrape."""

    def __init__(self, families: Callable[[], Iterator[Any]]) -> None:
        self._families = families

    def collect(self) -> Iterator[Any]:
        return self._families()
