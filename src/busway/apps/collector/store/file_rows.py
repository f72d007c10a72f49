"""Rows and sums of samples: the form in which samples are read from files of a store, whatever their format.

Pure: knows no file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..samples import Reason

FileRow = tuple[int, int, Any, int, int, int]
"""A sample as stored: time (nanoseconds since 1970 UTC), id of the point, value as SQLite stores it (`stored_value`),
number of the reason, half width (nanoseconds), commit number. A tuple, because it is fast.
"""


@dataclass(slots=True)
class Sums:
    """Count, total, minimum, maximum and worst reason of one point in one time bucket; `add` combines two of them.

    Attributes:
        count: how many samples are numbers (states count as 0 and 1) and not bad.
        low, high: the smallest and the largest of these numbers; None if there are none.
        total: the sum of these numbers.
        samples: how many samples there are in all, bad ones and texts too.
        reason: number of the worst reason of all samples; 0 if all are good.
    """

    count: int
    low: float | None
    high: float | None
    total: float | int
    samples: int
    reason: int

    def add(self, other: "Sums") -> None:
        """Add the sums of other samples of the same point and time bucket to these; changes this object."""
        self.count += other.count
        self.total += other.total
        self.samples += other.samples
        self.reason = max(self.reason, other.reason)
        if other.low is not None:
            self.low = other.low if self.low is None else min(self.low, other.low)
        if other.high is not None:
            self.high = other.high if self.high is None else max(self.high, other.high)


SumsByBucket = dict[tuple[int, int], Sums]
"""The sums of samples, by number of the time bucket (time // length of a bucket, nanoseconds) and id of the point."""


def number_of(value: Any) -> float | None:  # Any: what SQLite has
    """Convert a value as SQLite stores it to a float; None for a text, NaN or no value.

    Bytes are an unsigned integer of 64 bits. States are 0 and 1.
    """
    if isinstance(value, bytes):
        return float(int.from_bytes(value, "big"))
    return float(value) if isinstance(value, int | float) else None


def sums_of_rows(rows: Sequence[FileRow], bucket: int) -> SumsByBucket:
    """Return count, total, minimum, maximum and worst reason of samples by time bucket and point.

    It is for samples that were merged from several files; `part_sums` reads the sums of one file.

    Args:
        rows: the samples, each only once.
        bucket: length of a time bucket in nanoseconds.
    """
    found: SumsByBucket = {}
    for time, point, value, reason, _, _ in rows:
        number = number_of(value) if reason < Reason.TIMEOUT else None
        one = Sums(0, None, None, 0, 1, reason) if number is None else Sums(1, number, number, number, 1, reason)
        key = (time // bucket, point)
        if key in found:
            found[key].add(one)
        else:
            found[key] = one
    return found


def add_sums(sums: SumsByBucket, found: SumsByBucket) -> None:
    """Add the sums ``found`` to ``sums``, by bucket and point; changes ``sums``, and may keep objects of ``found``."""
    for key, one in found.items():
        if key in sums:
            sums[key].add(one)
        else:
            sums[key] = one
