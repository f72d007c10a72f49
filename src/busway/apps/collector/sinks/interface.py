"""The interface of sinks, which send samples to other systems, and their errors."""

import asyncio
from collections.abc import Awaitable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from ....errors import ModbusError
from ....points.point import Point
from ..store.committed_samples import CommittedAlarm, CommittedSample


class SinkDown(ModbusError):
    """Error: a sink's receiver cannot be reached or accepts nothing now. The same samples are sent again later."""


class SinkRefused(ModbusError):
    """Error: a sink's receiver refuses these samples for good. They are set aside; others are sent."""


class Sink(Protocol):
    """Interface of a sink, which sends samples to one other system, its receiver.

    Calls do not overlap. After a failure the same samples may be sent again; device, point, time and commit identify
    them.
    """

    async def open(self) -> None:
        """Connect to the sink's receiver. Raises `SinkDown`."""

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Send samples; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some may have arrived. `close` and `open` follow before it is called again.
            SinkRefused: the receiver would refuse them again.
        """

    async def close(self) -> None:
        """Disconnect from the sink's receiver; raises nothing."""


@dataclass(frozen=True, slots=True)
class DeviceGap:
    """A time in which no collector of a fleet read a device, because its link had no owner.

    Attributes:
        device: name of the device.
        points: names of its points that the sink gets.
        epoch: the ownership that ended the gap; with the device it identifies the gap.
        begin: nanoseconds since 1970 UTC. The true begin is the newest sample of the device in the gap, if there is one
            or one comes later.
        end: nanoseconds since 1970 UTC.
    """

    device: str
    points: Sequence[str]
    epoch: str
    begin: int
    end: int


@runtime_checkable
class GapSink(Protocol):
    """Interface of a sink that keeps gaps of ownership as intervals, and lets samples that arrive later shrink them."""

    async def send_gaps(self, gaps: Sequence[DeviceGap]) -> None:
        """Send gaps; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some may have arrived; all are sent again.
            SinkRefused: the receiver would refuse them again.
        """


@runtime_checkable
class AlarmSink(Protocol):
    """Interface of a sink that sends alarm events too. They are sent after the samples of the same commit."""

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Send alarm events; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some may have arrived; all are sent again.
            SinkRefused: the receiver would refuse them again.
        """


@runtime_checkable
class CurrentSink(Protocol):
    """Interface of a sink whose receiver shows current values separately from historical values, which arrive late.

    It stays connected while nothing is to be sent, and is connected again after the connection was lost.
    """

    def remember(self, samples: Sequence[CommittedSample]) -> None:
        """Learn the last samples that the receiver got before a restart; called once, before `open`."""

    async def show_current(self, points: Collection[tuple[str, str]] | None) -> None:
        """Have the receiver show the current values; called while open, whenever no stored samples wait any more.

        Args:
            points: device and name of each point that there is; the receiver is to show no others. None for all points.

        Raises:
            SinkDown: the connection is lost, or the receiver must not be sent anything now.
        """

    async def disturbed(self) -> None:
        """Return as soon as `show_current` should be called, because the connection may have ended; until then wait."""


@runtime_checkable
class DescribedSink(Protocol):
    """Interface of a sink that also sends its receiver descriptions of the points, such as their units of measure."""

    def describe(self, points: Mapping[tuple[str, str], Point]) -> None:
        """Use the points of a configuration, by device and name; called again for another one, from any thread."""


@runtime_checkable
class TopicSink(Protocol):
    """Interface of a sink that replaces some characters of names in topics, so that two names may become one."""

    def place_of(self, device: str, point: str) -> tuple[str, str]:
        """Return the names that the receiver uses for a device and a point.

        Returns:
            The name of the device, and the name of the point within the device. The receiver could not tell two points
            with equal results apart.
        """


async def all_taken(sendings: Iterable[Awaitable[object]]) -> None:
    """Wait until all messages are sent, accepted or failed; raise the most important error.

    Args:
        sendings: one awaitable for each message.

    Raises:
        SinkRefused: a message was refused for good; this error goes before others.
        Exception: the first other error of a message.
    """
    results = await asyncio.gather(*sendings, return_exceptions=True)
    errors = [each for each in results if isinstance(each, BaseException)]
    for error in sorted(errors, key=lambda each: not isinstance(each, SinkRefused)):
        raise error
