"""Passes on to one sink only the samples of a zone's stream that the sink wants: its points, by report rules.

It chooses by the same options and rules as a sink beside the store of one collector. Knows patterns and report rules;
a sink that needs a store is refused, with its name in the error.

1. A rule compares a sample with the last one of its point that the sink has taken since this process began: after a
   start the first sample of each point is passed on.
2. A sample that is older than the last one, such as one of a collector that was away, is passed on under every rule: it
   comes between others, and no rule can tell whether the sink needs it.
3. A sink gets for a gap of ownership what it gets for any time without reads: one sample without a value for each
   point, at the begin of the gap, with the reason `Reason.OWNERSHIP`; rules do not hold it back. The gap begins after
   the newest sample of the device that has passed here, and its mark never has the time of that sample, which it would
   replace. A sink that keeps gaps itself (`GapSink`) gets the gap instead. Either way the first sample of each point
   after the gap is passed on: no value holds through a gap.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from ...errors import ConfigError
from ...options.sinks import DeliveryOptions
from ...points.name_patterns import is_meant
from ...points.point import Point
from ...points.point_rules import ReportRule
from ..collector.configuration import CollectorConfiguration
from ..collector.samples import NANOSECONDS, Reason
from ..collector.sinks.files import FileSink
from ..collector.sinks.interface import AlarmSink, DescribedSink, DeviceGap, GapSink, Sink
from ..collector.sinks.sparkplug import SparkplugSink
from ..collector.store.committed_samples import CommittedSample
from .ownership_gaps import OwnershipGap, true_begin

_EVERY: Final = ReportRule()
_AFTER: Final = 1000
"""Nanoseconds from the newest sample to the begin of a gap: the finest step that all sinks can tell apart."""
_MOST_PLACED: Final = 100_000
"""Most begins of gaps that are remembered."""
_Point = tuple[str, str]


class ChosenSamples:
    """A sink that passes on to another sink only the samples chosen by that sink's options and the report rules.

    Args:
        sink: the sink that gets the chosen samples.
        options: options of that sink: patterns of its points, and its report rule if it has one. Options about the size
            of batches have no effect, as batches come from the stream.
        rules: by device and point, the report rules of points, used if the sink has none of its own. Every sample of a
            point that is missing is passed on.
        points: by device and point, all points of the configuration: some sinks describe them to their receiver, and
            `send_gap` needs them to mark gaps. None for none: gaps then have no effect.
    """

    def __init__(
        self,
        sink: Sink,
        options: DeliveryOptions,
        rules: Mapping[_Point, ReportRule],
        points: Mapping[_Point, Point] | None = None,
    ) -> None:
        if points is not None and isinstance(sink, DescribedSink):
            sink.describe(points)
        self._sink, self._options, self._rules = sink, options, rules
        self._named: dict[_Point, bool] = {}
        self._reported: dict[_Point, CommittedSample] = {}
        self._newest: dict[str, int] = {}
        self._placed: dict[tuple[str, str], tuple[int, int]] = {}
        self._units: dict[str, dict[str, str]] = {}
        for (device, point), each in (points or {}).items():
            self._units.setdefault(device, {})[point] = each.unit_of_measure

    async def open(self) -> None:
        """Connect to the sink's receiver. Raises `SinkDown`."""
        await self._sink.open()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Send those samples that the sink wants; when this returns, the receiver has accepted them.

        Raises:
            SinkDown: some samples may have arrived. Give the same samples again later: the same ones are chosen.
            SinkRefused: the receiver refuses the samples, and would refuse them again.
        """
        fresh: dict[_Point, CommittedSample] = {}
        chosen = [each for each in samples if self._is_chosen(each, fresh)]
        if chosen:
            await self._sink.send(chosen)
        self._reported.update(fresh)
        for sample in samples:
            if sample.reason != Reason.OWNERSHIP and sample.time > self._newest.get(sample.device, 0):
                self._newest[sample.device] = sample.time

    async def send_gap(self, gap: OwnershipGap) -> list[CommittedSample]:
        """Send a gap of ownership to a sink that keeps gaps (`GapSink`), and return an empty list.

        For any other sink nothing is sent: the result is the samples without a value that mark the gap, one for each
        wanted point; the caller passes them to `send` (rule 3).

        Raises:
            SinkDown: the gap may have arrived; give it again later.
            SinkRefused: the receiver refuses the gap, and would refuse it again.
        """
        gaps = [
            DeviceGap(device, points, str(gap.epoch), self._place_of(gap, device)[0], gap.end)
            for device in gap.devices
            if (points := [point for point in self._units.get(device, ()) if self._is_named((device, point))])
        ]
        if not isinstance(self._sink, GapSink):
            return [mark for each in gaps for mark in self._marks(each, gap)]
        if gaps:
            await self._sink.send_gaps(gaps)
        for each in gaps:
            for key in ((each.device, point) for point in each.points):
                if key in self._reported and self._reported[key].time < gap.end:
                    del self._reported[key]
        return []

    def _marks(self, each: DeviceGap, gap: OwnershipGap) -> Iterator[CommittedSample]:
        _, time = self._place_of(gap, each.device)
        for point in each.points:
            unit = self._units[each.device][point]
            yield CommittedSample(gap.commit, each.device, point, time, 0, None, Reason.OWNERSHIP, unit)

    def _place_of(self, gap: OwnershipGap, device: str) -> tuple[int, int]:
        """Return the begin of a gap of a device and the time of the sample that marks it, nanoseconds since 1970 UTC.

        The begin is that of `true_begin`, by the newest sample of the device that has passed here so far. The result
        for a gap is remembered and returned again; when `_MOST_PLACED` results are remembered, all are forgotten.
        """
        key = device, str(gap.epoch)
        found = self._placed.get(key)
        if found is None:
            if len(self._placed) >= _MOST_PLACED:
                self._placed.clear()
            newest = self._newest.get(device, 0)
            begin = true_begin(gap.begin, gap.end, [newest])
            mark = begin + _AFTER if begin - _AFTER < newest <= begin else begin
            found = self._placed[key] = begin, mark
        return found

    async def close(self) -> None:
        """Disconnect from the sink's receiver; raises nothing."""
        await self._sink.close()

    def _is_chosen(self, sample: CommittedSample, fresh: dict[_Point, CommittedSample]) -> bool:
        point = (sample.device, sample.point)
        if not self._is_named(point):
            return False
        if sample.reason == Reason.OWNERSHIP:
            if self._is_newest(sample, fresh):
                fresh[point] = sample
            return True
        rule = self._options.report or self._rules.get(point, _EVERY)
        if rule.when == "every":
            return True
        last = fresh.get(point) or self._reported.get(point)
        if last is not None:
            if sample.time < last.time:
                return True
            silence = (sample.time - last.time) / NANOSECONDS
            if not rule.passes((last.value, last.reason), (sample.value, sample.reason), silence):
                return False
        fresh[point] = sample
        return True

    def _is_newest(self, sample: CommittedSample, fresh: Mapping[_Point, CommittedSample]) -> bool:
        point = sample.device, sample.point
        last = fresh.get(point) or self._reported.get(point)
        return last is None or sample.time >= last.time

    def _is_named(self, point: _Point) -> bool:
        found = self._named.get(point)
        if found is None:
            found = any(is_meant("/".join(point), pattern) for pattern in self._options.points)
            self._named[point] = found
        return found


def refuse_what_needs_a_store(configuration: CollectorConfiguration, sink: str | None = None) -> None:
    """Raise `ConfigError` if a sink cannot take samples from a stream, because it needs the store of one collector.

    These are Sparkplug sinks, and sinks whose files are named by commits.

    Args:
        configuration: the configuration of the zone.
        sink: name of the sink to check; None for all sinks of the configuration.
    """
    for name, (made, _) in configuration.sinks.items():
        if sink not in (None, name):
            continue
        reason = ""
        if isinstance(made, SparkplugSink):
            reason = "Sparkplug needs the store of a collector: run it without --stream"
        elif isinstance(made, FileSink) and made.is_named_by_commits:
            reason = "Parquet files are called by commits, which several collectors count: take csv or jsonl"
        if reason:
            raise ConfigError(reason, file=configuration.name, key=f"sink.{name}")


def sinks_without_alarms(configuration: CollectorConfiguration) -> list[str]:
    """Return the names of the sinks that would get alarm events from a store, and get none from a stream.

    Empty if no point of the configuration has an alarm.
    """
    if not any(point.alarms for device in configuration.devices.values() for point in device.points):
        return []
    return [name for name, (made, _) in configuration.sinks.items() if isinstance(made, AlarmSink)]
