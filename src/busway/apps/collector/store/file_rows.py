"""Rows and sums of samples, as the files of a store give them, whatever their format.

Pure: knows no file.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..samples import Reason

Row = tuple[int, int, Any, int, int, int]
"""Time, point, stored value, reason, half width, commit number: as a segment holds them, for loops over millions."""


@dataclass(slots=True)
class Sums:
    """Count, total, minimum, maximum and worst reason of one point in one time bucket; `add` combines two of them.

    Attributes:
        count: numbers that were not bad.
        low, high: the least and the greatest of them.
        total: their sum.
        samples: all samples, bad ones and texts too.
        reason: the worst reason, 0 where all were good.
    """

    count: int
    low: float | None
    high: float | None
    total: float | int
    samples: int
    reason: int

    def add(self, other: "Sums") -> None:
        """Add the sums (count, total, …) of other samples of the same time bucket."""
        self.count += other.count
        self.total += other.total
        self.samples += other.samples
        self.reason = max(self.reason, other.reason)
        if other.low is not None:
            self.low = other.low if self.low is None else min(self.low, other.low)
        if other.high is not None:
            self.high = other.high if self.high is None else max(self.high, other.high)


SumsByBucket = dict[tuple[int, int], Sums]
"""The sums of samples, by the number of the time bucket (time // its length) and the id of the point."""


def number_of(value: Any) -> float | None:  # Any: what SQLite has
    """Return a stored value as sums have it, a float; None for a text or nothing. Eight bytes are a large integer."""
    if isinstance(value, bytes):
        return float(int.from_bytes(value, "big"))
    return float(value) if isinstance(value, int | float) else None


def sums_of_rows(rows: Sequence[Row], bucket: int) -> SumsByBucket:
    """Return count, total, minimum and maximum of samples by time bucket and point.

    It is for samples that were merged from several files; `part_sums` reads the sums of one file.

    Args:
        rows: the samples.
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
    """Add sums to others, by bucket and point."""
    for key, one in found.items():
        if key in sums:
            sums[key].add(one)
        else:
            sums[key] = one
