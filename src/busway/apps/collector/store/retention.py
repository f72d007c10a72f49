"""Retention: chooses the files of a store to delete, because they are too old or the store is too large.

Pure. Knows parts; the writer deletes them. Files are deleted even if a sink has not got their samples: the manifest
counts what that sink has lost.

A part whose samples may replace samples of an earlier part counts as at least as new as that earlier part: if it were
deleted first, the replaced samples would appear again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from ....errors import ConfigError
from .manifest import StorePart


@dataclass(frozen=True, slots=True)
class Retention:
    """The limits of a store: files whose samples are all too old, and the oldest files of a larger store, are deleted.

    Attributes:
        age: seconds for which samples are kept; None for ever.
        size: most bytes of all files with samples together, at least 1 000 000; None for no limit.

    Raises:
        ConfigError: ``age`` is not above 0, or ``size`` is too small.
    """

    age: float | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        if self.age is not None and self.age <= 0:
            raise ConfigError(f"samples are kept for more than {self.age:g} s", key="age")
        if self.size is not None and self.size < 1_000_000:
            raise ConfigError(f"a store has at least 1 MB, not {self.size} bytes", key="size")


def parts_to_drop(parts: Sequence[StorePart], retention: Retention, now: int) -> list[StorePart]:
    """Return the finished parts (files) to be deleted by the limits of retention, oldest first; never the open segment.

    Args:
        parts: all parts of the store, the open segment too: its bytes count.
        retention: the limits.
        now: the present time, nanoseconds since 1970 UTC.
    """
    ages = _ages(parts)
    finished = sorted((part for part in parts if part.kind != "open"), key=lambda part: (ages[part.id], part.id))
    dropped = []
    if retention.age is not None:
        oldest = now - int(retention.age * 1_000_000_000)
        dropped = [part for part in finished if ages[part.id] < oldest]
    if retention.size is not None:
        left = [part for part in finished if part not in dropped]
        total = sum(part.bytes or 0 for part in parts if part not in dropped)
        for part in left:
            if total <= retention.size:
                break
            dropped.append(part)
            total -= part.bytes or 0
    return dropped


def _ages(parts: Sequence[StorePart]) -> dict[int, int]:
    """Return for each part, by its id, the time that decides how old it is, in nanoseconds since 1970 UTC.

    It is the time of its last sample (of its last commit if it has no samples), or that of an earlier part that
    overlaps it, if that is later.
    """
    ages: dict[int, int] = {}
    before: list[tuple[int, int, int, int]] = []  # begin, end and age of each part, and the latest end up to it
    newest = 0
    for part in sorted(parts, key=lambda part: (part.segment, part.id)):
        age = part.high or part.alive or 0
        if part.low is not None and part.high is not None:
            for begin, end, other, latest in reversed(before):
                if latest < part.low:
                    break
                if begin <= part.high and part.low <= end:
                    age = max(age, other)
            newest = max(newest, part.high)
            before.append((part.low, part.high, age, newest))
        ages[part.id] = age
    return ages
