"""Results of store queries: columns of samples or buckets, also as Arrow, pandas or polars tables if installed.

Knows columns; knows no file.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final

from ....extras import require
from ..samples import Gap, Quality, Sample, SampleValue, StateInterval, quality_of, reason_text

EXACT: Final = 2**53
"""Every integer whose absolute value is at most this is exactly representable as float."""


class ColumnTable(ABC):
    """Base class of query results: named columns of equal length, which become tables of Arrow, pandas or polars."""

    __slots__ = ()

    @abstractmethod
    def columns(self) -> dict[str, list[Any]]:  # columns have different types
        """Return the columns of the result by name."""

    def to_arrow(self) -> Any:  # pyarrow has no types of its own
        """Return the result as `pyarrow.Table` with the columns of `columns`; ``time`` is a timestamp[ns] in UTC.

        Columns of numbers are int64 if all their values are integers below 2**63, else float64.

        Raises:
            MissingExtra: pyarrow is not installed.
        """
        return _arrow_table(self.columns())

    def to_pandas(self) -> Any:  # pandas may not be there to check
        """Return the result as `pandas.DataFrame`, with the columns of `to_arrow`.

        Raises:
            MissingExtra: pandas or pyarrow is not installed.
        """
        require("pandas", "a data frame")
        return self.to_arrow().to_pandas()

    def to_polars(self) -> Any:  # polars may not be there to check
        """Return the result as `polars.DataFrame`, with the columns of `to_arrow`.

        Raises:
            MissingExtra: polars or pyarrow is not installed.
        """
        require("polars", "a data frame")
        return import_module("polars").from_arrow(self.to_arrow())


@dataclass(frozen=True, slots=True)
class SampleTable(ColumnTable):
    """Samples from a store in columns, ordered by time; each column has one entry for each sample.

    An interval in which a device was not read, or a gap, appears as one sample without a value for each point
    concerned, with the reason of the interval, at its begin or at the begin of the wanted time if that is later.

    Attributes:
        device, point: names.
        time: nanoseconds since 1970 UTC, the middle of the transaction.
        half_width: half the length of the transaction, nanoseconds.
        value: values; None for a bad sample without a value.
        reason: numbers of reasons, 0 for good.
        intervals: intervals that overlap the wanted time, in which a device with wanted points was not read. This is no
            column: it has one entry for each interval.
        gaps: gaps that overlap the wanted time, in which samples of all devices are missing; one entry for each gap.
    """

    device: list[str] = field(default_factory=list)
    point: list[str] = field(default_factory=list)
    time: list[int] = field(default_factory=list)
    half_width: list[int] = field(default_factory=list)
    value: list[SampleValue | None] = field(default_factory=list)
    reason: list[int] = field(default_factory=list)
    intervals: list[StateInterval] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[Sample]:
        columns = (self.device, self.point, self.time, self.half_width, self.value, self.reason)
        for device, point, time, half_width, value, reason in zip(*columns, strict=True):
            yield Sample(device, point, time, half_width, value, reason)

    @property
    def quality(self) -> list[Quality]:
        """The quality of each sample: good, uncertain or bad."""
        return [quality_of(reason) for reason in self.reason]

    def columns(self) -> dict[str, list[Any]]:  # columns have different types
        """Return the columns by name: numbers in ``value``, texts in ``text``, quality and reason in words.

        An integer that no float represents exactly has its digits in ``text`` too, because tables may convert the
        column ``value`` to floats.
        """
        return {
            "time": self.time,
            "device": self.device,
            "point": self.point,
            "value": [_number(value) for value in self.value],
            "text": [_text(value) for value in self.value],
            "quality": [quality.name.lower() for quality in self.quality],
            "reason": [reason_text(reason) for reason in self.reason],
            "half_width": self.half_width,
        }


@dataclass(frozen=True, slots=True)
class BucketTable(ColumnTable):
    """Minimum, maximum and mean of points by time bucket, in columns, ordered by time, device and point.

    Attributes:
        device, point: names.
        time: nanoseconds since 1970 UTC at which the bucket begins, a multiple of the length of buckets. The first
            bucket can begin before the wanted time, but has only samples of the wanted time.
        minimum, maximum, mean: of those samples in the bucket that are numbers and not bad; None if there are none.
        count: how many samples these are.
        samples: how many samples there are in all, bad ones and texts too; 0 if the point was not read in the bucket.
        reason: number of the worst reason in the bucket: of its samples, and of gaps and intervals in which the point
            was not read; 0 if all was good.
    """

    device: list[str] = field(default_factory=list)
    point: list[str] = field(default_factory=list)
    time: list[int] = field(default_factory=list)
    minimum: list[float | int | None] = field(default_factory=list)
    maximum: list[float | int | None] = field(default_factory=list)
    mean: list[float | None] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    samples: list[int] = field(default_factory=list)
    reason: list[int] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.time)

    def columns(self) -> dict[str, list[Any]]:  # columns have different types
        """Return the columns by name, with quality and reason in words."""
        return {
            "time": self.time,
            "device": self.device,
            "point": self.point,
            "minimum": self.minimum,
            "maximum": self.maximum,
            "mean": self.mean,
            "count": self.count,
            "samples": self.samples,
            "quality": [quality_of(reason).name.lower() for reason in self.reason],
            "reason": [reason_text(reason) for reason in self.reason],
        }


def _number(value: SampleValue | None) -> float | int | None:
    return None if value is None or isinstance(value, str) else value


def _text(value: SampleValue | None) -> str | None:
    if isinstance(value, int) and abs(value) > EXACT and int(float(value)) != value:
        return str(value)
    return value if isinstance(value, str) else None


def _arrow_table(columns: dict[str, list[Any]]) -> Any:
    require("pyarrow", "a table of Arrow")
    pa = import_module("pyarrow")
    arrays = {}
    for name, values in columns.items():
        if name == "time":
            arrays[name] = pa.array(values, pa.timestamp("ns", "UTC"))
        elif name in ("value", "minimum", "maximum", "mean"):
            arrays[name] = _numbers(pa, values)
        elif name in ("device", "point", "quality", "reason", "text"):
            arrays[name] = pa.array(values, pa.string()).dictionary_encode()
        else:
            arrays[name] = pa.array(values, pa.int64())
    return pa.table(arrays)


def _numbers(pa: Any, values: list[Any]) -> Any:
    """Return a column of pyarrow: int64 if all values are integers below 2**63, else float64; None becomes null."""
    if {type(value) for value in values} == {int} and max(values) < 2**63:
        return pa.array(values, pa.int64())
    return pa.array([None if value is None else float(value) for value in values], pa.float64())
