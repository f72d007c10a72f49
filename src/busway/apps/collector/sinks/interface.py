"""The interface of sinks, which send samples to other systems, and their errors."""

import asyncio
from collections.abc import Awaitable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from ....errors import ModbusError
from ....points.point import Point
from ..store.committed_samples import CommittedAlarm, CommittedSample


class SinkDown(ModbusError):
    """Error: a sink's receiver cannot be reached or accepts nothing now. The same samples will be sent again later."""


class SinkRefused(ModbusError):
    """Error: a sink's receiver refuses some of the samples for good. The delivery finds these and sets them aside."""


class Sink(Protocol):
    """Interface of a sink, which sends samples to one other system, its receiver.

    Calls do not overlap. After a failure the same samples may be sent again; device, point, time and commit identify
    them.
    """

    async def open(self) -> None:
        """Connect to the sink's receiver.

        Raises:
            SinkDown: it cannot be reached or used now. The caller calls `close` before it calls `open` again.
        """

    async def send(self, samples: Sequence[CommittedSample]) -> None:
        """Send samples; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some samples may have arrived. The caller calls `close` and `open` before it sends them all again.
            SinkRefused: the receiver refuses at least one of them for good.
        """

    async def close(self) -> None:
        """Disconnect from the sink's receiver; raises nothing."""


@dataclass(frozen=True, slots=True)
class DeviceGap:
    """A time in which no collector of a fleet read a device, because its link had no owner.

    Attributes:
        device: name of the device.
        points: names of its points that the sink gets.
        epoch: identifies the ownership of the link that ended the gap, as text; with the device it identifies the gap.
        begin: nanoseconds since 1970 UTC. If the sink has, or gets later, samples of the device within the gap, the
            newest of them is the true begin.
        end: nanoseconds since 1970 UTC.
    """

    device: str
    points: Sequence[str]
    epoch: str
    begin: int
    end: int


@runtime_checkable
class GapSink(Protocol):
    """Interface of a sink that stores gaps of ownership as intervals; samples that arrive later move their begin."""

    async def send_gaps(self, gaps: Sequence[DeviceGap]) -> None:
        """Send gaps; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some gaps may have arrived; all will be sent again.
            SinkRefused: the receiver refuses at least one of them for good.
        """


@runtime_checkable
class AlarmSink(Protocol):
    """Interface of a sink that sends alarm events too. They are sent after the samples of the same commit."""

    async def send_alarms(self, alarms: Sequence[CommittedAlarm]) -> None:
        """Send alarm events; when it returns, the receiver has accepted them.

        Raises:
            SinkDown: some events may have arrived; all will be sent again.
            SinkRefused: the receiver refuses at least one of them for good.
        """


@runtime_checkable
class CurrentSink(Protocol):
    """Interface of a sink whose receiver shows current values, apart from historical values that arrive late.

    The delivery keeps it connected while nothing is to be sent, and connects it again after the connection was lost.
    """

    def remember(self, samples: Sequence[CommittedSample]) -> None:
        """Learn which samples the receiver got last before a restart; called once, before `open`.

        Args:
            samples: the last sent sample of each point of which only some samples are sent, in no particular order.
        """

    async def show_current(self, points: Collection[tuple[str, str]] | None) -> None:
        """Have the receiver show the current values; called while open, whenever no stored samples wait any more.

        Args:
            points: device and name of each point that exists; the receiver must show no others. None for all points.

        Raises:
            SinkDown: the connection is lost, or the receiver must not be sent anything now.
        """

    async def disturbed(self) -> None:
        """Wait until `show_current` should be called again, because the connection may have ended."""


@runtime_checkable
class DescribedSink(Protocol):
    """Interface of a sink that also sends its receiver descriptions of the points, such as their units of measure."""

    def describe(self, points: Mapping[tuple[str, str], Point]) -> None:
        """Set the points to describe, by device and name.

        Called before `open`, and again for each new configuration, from any thread, also during `send`.
        """


@runtime_checkable
class TopicSink(Protocol):
    """Interface of a sink that replaces some characters of names in topics, so that two names can become the same."""

    def place_of(self, device: str, point: str) -> tuple[str, str]:
        """Return the names that the receiver uses for a device and a point.

        Returns:
            The name of the device, and the name of the point within the device. The receiver could not tell two points
            with equal results apart.
        """


@runtime_checkable
class OwnTopicSink(Protocol):
    """Interface of a sink with topics of its own, such as that of its status, which no device may have."""

    def own_topic(self, device: str, point: str) -> str:
        """Return the topic for samples of a point if it is one of the sink's own topics; else an empty text."""


async def all_taken(sendings: Iterable[Awaitable[object]]) -> None:
    """Wait until all messages are accepted or have failed, then raise the most important error, if any.

    Args:
        sendings: one awaitable for each message.

    Raises:
        SinkRefused: a message was refused for good; this error is raised even if others came first.
        Exception: the error of the first message that failed in another way.
    """
    results = await asyncio.gather(*sendings, return_exceptions=True)
    errors = [each for each in results if isinstance(each, BaseException)]
    for error in sorted(errors, key=lambda each: not isinstance(each, SinkRefused)):
        raise error
