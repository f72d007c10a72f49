"""The samples of a zone's stream that one sink gets: its points, by report rules, as beside the store of one collector.

Knows patterns and report rules; what has to stay with a store is refused by name.

1. A rule compares with the last sample that the sink has taken since this process began: after a start the first sample
   of each point is passed on.
2. A sample from before that one is passed on whatever the rule says, such as those of a collector that was away: they
   come between others, and what the sink lacks without them is not known.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Final

from ...errors import ConfigError
from ...options.sinks import DeliveryOptions
from ...points.point import Point
from ...points.point_rules import ReportRule
from ..collector.configuration import CollectorConfiguration
from ..collector.samples import NANOSECONDS
from ..collector.sinks.files import FileSink
from ..collector.sinks.interface import AlarmSink, DescribedSink, Sink
from ..collector.sinks.sparkplug import SparkplugSink
from ..collector.store.committed_samples import CommittedSample

_EVERY: Final = ReportRule()
_Point = tuple[str, str]


class ChosenSamples:
    """A sink that gets only the points and the samples that its options and the report rules of points name.

    Args:
        sink: gets the chosen samples.
        options: of the sink; batches are the stream's.
        rules: by device and point, the report rules of points, where the sink has none of its own.
        points: by device and point, what a sink that describes points to its receiver tells of them; None for nothing.
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

    async def open(self) -> None:
        """Connect to the sink's receiver. Raises `SinkDown`."""
        await self._sink.open()

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Send the chosen ones of these samples. Raises `SinkDown`, `SinkRefused`: then they may be sent again."""
        fresh: dict[_Point, CommittedSample] = {}
        chosen = [each for each in samples if self._is_chosen(each, fresh)]
        if chosen:
            await self._sink.send(chosen)
        self._reported.update(fresh)

    async def close(self) -> None:
        """Disconnect from the sink's receiver; raises nothing."""
        await self._sink.close()

    def _is_chosen(self, sample: CommittedSample, fresh: dict[_Point, CommittedSample]) -> bool:
        point = (sample.device, sample.point)
        if not self._is_named(point):
            return False
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

    def _is_named(self, point: _Point) -> bool:
        found = self._named.get(point)
        if found is None:
            found = any(fnmatchcase("/".join(point), pattern) for pattern in self._options.points)
            self._named[point] = found
        return found


def refuse_what_needs_a_store(configuration: CollectorConfiguration, sink: str | None = None) -> None:
    """Raise `ConfigError` for a sink that works only beside the store of one collector.

    Args:
        configuration: of the zone.
        sink: its name; None for all of the configuration.
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
    """Return the names of sinks that take events of alarms, where the configuration has alarms: a stream has none."""
    if not any(point.alarms for device in configuration.devices.values() for point in device.points):
        return []
    return [name for name, (made, _) in configuration.sinks.items() if isinstance(made, AlarmSink)]
