"""Samples: the value of a point at a time, its quality, and the reason if it is not good.

Pure: knows no clock, file or socket. The poller makes samples, the store keeps them, sinks hand them on.

1. Times are nanoseconds since 1970 UTC (``int``). The time of a sample is the middle of its transaction; half of the
   transaction's length is kept beside it. Lengths of other things are seconds, as everywhere.
2. How far a sample can be trusted is one number, its reason. The quality follows from the reason by a table; reason 0
   is good.
3. A bad sample can be without a value. A good or uncertain sample always has one.
4. One read makes one `SampleBatch`, with columns; a `Sample` object is made only where a single sample is needed.
   400 000 values per second leave 2.5 µs for each.
5. Every read gives each of its points a sample. Time without reads is a `StateInterval` of the device, and time in
   which nothing was collected at all is a `Gap`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from ...errors import InvalidRequest
from ...points.quality import Quality, Reason, exception_code_of, exception_reason, quality_of, reason_text
from ...values.unfit_values import shown
from .sample_clock import NANOSECONDS, ClockCorrection

__all__ = [
    "NANOSECONDS",
    "CounterState",
    "Gap",
    "PointDescription",
    "PointGroup",
    "Quality",
    "Reason",
    "Sample",
    "SampleBatch",
    "SampleValue",
    "StateInterval",
    "exception_code_of",
    "exception_reason",
    "failed_batch",
    "mended_batch",
    "mended_interval",
    "quality_of",
    "reason_text",
]

SampleValue = bool | int | float | str
"""The value of a point: a state, a number or a text. The store cannot keep integers below -2**63 or above 2**64 - 1."""


@dataclass(frozen=True, slots=True)
class Sample:
    """The value of one point at one time, with its quality.

    Attributes:
        device: name of the device.
        point: name of the point.
        time: nanoseconds since 1970 UTC, the middle of the transaction.
        half_width: half the length of the transaction, nanoseconds.
        value: the value; None only in a bad sample, which may have one too.
        reason: why the sample is not good: a `Reason`, or a number from `exception_reason`; 0 for good.

    Raises:
        InvalidRequest: the value is None, and the reason is not bad.
    """

    device: str
    point: str
    time: int
    half_width: int
    value: SampleValue | None
    reason: int = Reason.NONE

    def __post_init__(self) -> None:
        if self.value is None and self.reason < Reason.TIMEOUT:
            raise InvalidRequest(f"a sample without a value is bad, and needs a reason: {self.device}, {self.point}")

    @property
    def quality(self) -> Quality:
        """The quality of the sample: good, uncertain or bad."""
        return quality_of(self.reason)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class PointGroup:
    """The points of one device that one read fetches, in the order of their values; shared by many batches.

    Two groups are equal only if they are the same object, so that a look-up by group costs the same for any number of
    points.

    Attributes:
        device: name of the device.
        points: names of the points, one or more, each once.

    Raises:
        InvalidRequest: there is no point, or one point twice.
    """

    device: str
    points: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.points:
            raise InvalidRequest(f"a group of points of {self.device} is empty")
        if len(set(self.points)) != len(self.points):
            raise InvalidRequest(f"a point stands twice in a group of {self.device}")


@dataclass(frozen=True, slots=True)
class CounterState:
    """The state of an accumulator: the running total of a counter, stored so that it continues after a restart.

    Attributes:
        point: name of the point.
        total: the present total.
        last: the last reading of the counter.
    """

    point: str
    total: float
    last: float


@dataclass(frozen=True, slots=True)
class SampleBatch:
    """The samples of one read, one for each point, as columns of values and reasons; iterating gives each `Sample`.

    Attributes:
        group: the device and its points.
        time: nanoseconds since 1970 UTC, the middle of the transaction.
        half_width: half the length of the transaction, nanoseconds.
        values: one for each point of the group, in order; None only where the reason is bad.
        reasons: one reason for each point, or one number for all; 0 for good. See `Sample`.
        counters: the states of the group's accumulators after these samples; part of the same commit.

    Raises:
        InvalidRequest: there are more or fewer values or reasons than points.
    """

    group: PointGroup
    time: int
    half_width: int
    values: Sequence[SampleValue | None]
    reasons: Sequence[int] | int = 0
    counters: Sequence[CounterState] = ()

    def __post_init__(self) -> None:
        count = len(self.group.points)
        if len(self.values) != count:
            raise InvalidRequest(f"{count} points of {self.group.device} need as many values, not {len(self.values)}")
        if not isinstance(self.reasons, int) and len(self.reasons) != count:
            raise InvalidRequest(f"{count} points of {self.group.device} need as many reasons, not {len(self.reasons)}")

    @property
    def device(self) -> str:
        """Name of the device that was read."""
        return self.group.device

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the points that were read, in the order of the values."""
        return self.group.points

    def __len__(self) -> int:
        return len(self.group.points)

    def reason_column(self) -> Sequence[int]:
        """Return the reason of each sample, in the order of the points; 0 for good."""
        return (self.reasons,) * len(self) if isinstance(self.reasons, int) else self.reasons

    def __iter__(self) -> Iterator[Sample]:
        for point, value, reason in zip(self.points, self.values, self.reason_column(), strict=True):
            yield Sample(self.device, point, self.time, self.half_width, value, reason)


def failed_batch(group: PointGroup, time: int, half_width: int, reason: int) -> SampleBatch:
    """Return the samples of a read that failed: one for each point, without value, all for the same reason.

    Raises:
        InvalidRequest: the quality of the reason is not bad.
    """
    if quality_of(reason) is not Quality.BAD:
        raise InvalidRequest(f"{shown(reason_text(reason))} is no reason for which a read fails")
    return SampleBatch(group, time, half_width, (None,) * len(group.points), reason)


def mended_batch(batch: SampleBatch, correction: ClockCorrection) -> SampleBatch:
    """Return the samples of a read with their corrected time.

    Samples that were uncertain only because of the clock (`Reason.CLOCK`) become good. A batch whose time the
    correction does not cover is returned unchanged.
    """
    if not correction.begin <= batch.time < correction.end:
        return batch
    reasons = [0 if each == Reason.CLOCK else each for each in batch.reason_column()]
    return replace(batch, time=correction.corrected(batch.time), reasons=reasons if any(reasons) else 0)


@dataclass(frozen=True, slots=True)
class StateInterval:
    """A period in which a device was not read, and why; it stands for bad samples of all points of the device.

    Attributes:
        device: name of the device.
        begin: begin of the period, nanoseconds since 1970 UTC; the period includes it.
        end: end of the period, nanoseconds since 1970 UTC, not included; None while the period lasts.
        reason: why the device was not read, a bad `Reason`.

    Raises:
        InvalidRequest: the end is before the begin, or the reason is not bad.
    """

    device: str
    begin: int
    end: int | None
    reason: int

    def __post_init__(self) -> None:
        _check_interval(self.begin, self.end, self.reason)


def mended_interval(interval: StateInterval, correction: ClockCorrection) -> StateInterval:
    """Return an interval with its begin and end corrected, each only if the correction covers it.

    The end is never before the begin.
    """
    begin, end = correction.corrected(interval.begin), interval.end
    return replace(interval, begin=begin, end=None if end is None else max(begin, correction.corrected(end)))


@dataclass(frozen=True, slots=True)
class Gap:
    """A period in which samples of all devices are missing, and why.

    Attributes:
        begin: begin of the period, nanoseconds since 1970 UTC; the period includes it.
        end: end of the period, nanoseconds since 1970 UTC, not included.
        reason: why samples are missing, a bad `Reason`.
        lost: number of samples that were made but could not be stored; 0 if none were made.

    Raises:
        InvalidRequest: the end is before the begin, or the reason is not bad.
    """

    begin: int
    end: int
    reason: int
    lost: int = 0

    def __post_init__(self) -> None:
        _check_interval(self.begin, self.end, self.reason)


def _check_interval(begin: int, end: int | None, reason: int) -> None:
    if end is not None and end < begin:
        raise InvalidRequest(f"an interval ends at {end} ns, before it begins at {begin} ns")
    if quality_of(reason) is not Quality.BAD:
        raise InvalidRequest(f"{shown(reason_text(reason))} is no reason for time without samples")


@dataclass(frozen=True, slots=True)
class PointDescription:
    """What the store and sinks know of a point beside its samples, such as its unit of measure.

    Attributes:
        device: name of the device.
        point: name of the point.
        unit_of_measure: such as ``V``; empty for none.
        is_state: whether the values of the point are states: on or off.
        was: name that the point had before; samples stored under that name belong to this point. None for no such name.
        is_float32: whether values are numbers of type float32 as the device holds them, without a scale.
    """

    device: str
    point: str
    unit_of_measure: str = ""
    is_state: bool = False
    was: str | None = None
    is_float32: bool = False
